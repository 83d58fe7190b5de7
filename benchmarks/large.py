"""
Memory and time of a fit from file to file: a long catalog and a small grid, or the paper's at known redshifts.

    python benchmarks/large.py [--n 200000] [--chunk-rows 10000] [--threads 1] [--few] [--kind parquet] [--kill]
    python benchmarks/large.py --workers 2 [--n 10000000] ...
    python benchmarks/large.py --known [--n 10000]

With ``--known`` the grid is that of Yang et al. 2021 (24 million models, 21 bands), objects are fitted at their
known redshifts in one process, and CPU seconds are printed beside those of the loop of ``benchmarks/fit.py``.
Otherwise the catalog is written a piece at a time, and fitted on the nodes of a small grid; with ``--few`` one of
12 redshifts, 24 galaxies and 6 bands, for long catalogs. Peak memory is that of a process of its own, for this
catalog and for one a tenth as long: the difference is what a longer catalog costs. The page of ``miricigale fit``
is made too. With ``--kill`` a third fit is killed with -9 again and again, and its files are compared. With
``--workers`` the pieces are fitted by processes of dask, of which one is killed with -9 when a tenth of the files
are there; ten pieces are fitted in this process once more, and the files compared.
"""

import argparse
import hashlib
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import astropy.units as u
import fit
import numpy as np
from astropy.table import QTable

from miricigale.fitting import BayesFitter, GridSettings, fit_file, open_results
from miricigale.fitting.catalogs.page import fit_page
from miricigale.sed import SEDModel
from miricigale.utils.row_files import open_rows, write_rows

BANDS = ["megacam.u", "acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "irac.ch2"]
BANDS += ["miri.f770w", "miri.f1000w", "miri.f1500w", "miri.f2100w"]


def make_grid(few):
    axes = SEDModel.yang2021_axes("quick")
    axes = {name: axes[name] for name in ("tau", "age", "ebv", "alpha")[: 3 if few else 4]}
    axes["redshift"] = np.expm1(np.linspace(np.log(1.1), np.log(5.0), 12 if few else 30))
    return SEDModel.yang2021(agn=False).grid(axes, BANDS[:: 2 if few else 1])


def catalog(grid, n, step=20000):
    """Models of the grid with errors of 10 %, ``step`` rows at a time."""
    rng = np.random.default_rng(1)
    for start in range(0, n, step):
        size = min(step, n - start)
        z = rng.integers(grid.redshift.size, size=size)
        g = np.array([rng.choice(np.flatnonzero(grid.allowed[i])) for i in z])
        flux = 1e10 * grid.flux(z, g)
        table = QTable({"id": start + np.arange(size)})
        for i, name in enumerate(grid.filters):
            error = 0.1 * flux[:, i]
            table[name] = (flux[:, i] + error * rng.normal(size=size)) * u.uJy
            table[f"{name}_err"] = error * u.uJy
        yield table


def write_catalog(path, grid, n):
    write_rows(path, catalog(grid, n), n)


def fitter_of(few):
    """Fitter, and a warm-up that compiles what it needs."""
    fitter = BayesFitter(make_grid(few), settings=GridSettings(interpolate=0))
    bands = fitter.backend.filters
    fitter.fit(QTable({"id": [0], **{c: [1.0] * u.uJy for b in bands for c in (b, f"{b}_err")}}))
    return fitter


def on_workers(folder, n, chunk_rows, few, kind, n_workers):
    """Fit a catalog on workers of dask, of which one is killed; compare some parts with those of one process."""
    import distributed

    fitter = fitter_of(few)
    grid = fitter.backend.grid
    path, out = folder / f"catalog.{kind}", folder / "out"
    write_catalog(path, grid, n)
    print(f"{grid!r}; {n} rows, {path.stat().st_size / 1e6:.0f} MB", flush=True)
    options = {"n_workers": n_workers, "threads_per_worker": 1, "dashboard_address": ":0"}
    n_parts = -(-n // chunk_rows)
    with (
        distributed.LocalCluster(**options) as cluster,
        distributed.Client(cluster) as client,
        ThreadPoolExecutor(1) as other,
    ):

        def kill():
            while not (out / f"part-{n_parts // 10:05d}.fits").exists():
                time.sleep(0.1)
            pids = client.run(os.getpid).values()
            os.kill(min(pids), signal.SIGKILL)

        killed = other.submit(kill)
        start, cpu = time.time(), os.times()
        results = fit_file(fitter, path, out, chunk_rows=chunk_rows, executor=client.get_executor())
        killed.result()
        fitted = time.time() - start
    spent = sum(os.times()[:4]) - sum(cpu[:4])
    size = sum(one.stat().st_size for one in results.paths)
    loop = fit.loop_time(grid, grid.n_allowed, len(grid.filters))
    print(
        f"{len(results)} fitted in {fitted:.0f} s, {size / 1e9:.1f} GB, {peak():.0f} MB of the driver's memory"
    )
    print(
        f"{1e3 * spent / n:.3f} ms of CPU an object, driver and workers; plain loop {1e3 * loop:.3f} ms"
    )
    rows, mine = open_rows(path, chunk_rows), folder / f"some.{kind}"
    some = np.random.default_rng(1).choice(n_parts, size=min(10, n_parts), replace=False)
    differ = 0
    for i in some:
        write_rows(mine, [rows.chunk(i)], rows.span(i)[1] - rows.span(i)[0], overwrite=True)
        again = fit_file(fitter, mine, folder / "some", chunk_rows=chunk_rows, resume=False)
        differ += digest(again.paths[0]) != digest(results.paths[i])
    print(f"one worker killed; {len(some)} of {n_parts} parts made here, of which differ: {differ}")


def one(folder, n, chunk_rows, threads, few, kind):
    """Fit a catalog and print seconds and peak memory."""
    fitter = fitter_of(few)
    grid = fitter.backend.grid
    before, path = peak(), folder / f"{n}.{kind}"
    start, cpu = time.time(), time.process_time()
    with ThreadPoolExecutor(threads) as executor:
        results = fit_file(
            fitter,
            path,
            folder / f"out{n}",
            chunk_rows=chunk_rows,
            executor=executor if threads > 1 else None,
        )
    cpu = time.process_time() - cpu
    fitted = time.time() - start
    start = time.time()
    results.write_table(folder / f"table{n}.{kind}", overwrite=True)
    joined = time.time() - start
    start = time.time()
    fit_file(fitter, path, folder / f"out{n}", chunk_rows=chunk_rows)
    again = time.time() - start
    of_fit = peak()
    fit_page(results, path).write(folder / f"page{n}.html")
    loop = fit.loop_time(grid, grid.n_allowed, len(grid.filters))
    print(fitted, joined, again, before, of_fit, peak(), cpu, loop)


def peak():
    """Peak memory so far, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def killed(run, folder, n, kind):
    """Kill a fit after more and more seconds until it ends; the files that differ from those of a whole one."""
    old, path = folder / f"out{n}", folder / f"whole{n}"
    old.rename(path)
    whole = {**checksums(path), "table": digest(folder / f"table{n}.{kind}")}
    kills, wait = 0, 12.0
    while True:
        with subprocess.Popen(run, stdout=subprocess.DEVNULL) as process:
            try:
                process.wait(wait)
                break
            except subprocess.TimeoutExpired:
                process.kill()
                kills, wait = kills + 1, 1.3 * wait
    again = {**checksums(old), "table": digest(folder / f"table{n}.{kind}")}
    differ = [name for name in {*whole, *again} if whole.get(name) != again.get(name)]
    print(f"killed {kills} times: {len(whole)} files, of which differ: {differ}")


def checksums(folder):
    """Checksums of the files of a fit by name."""
    return {one.name: digest(one) for one in folder.iterdir() if one.name != ".fit.lock"}


def digest(path):
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def known(n, chunk_rows):
    """Fit a catalog at known redshifts with the paper's grid; print CPU seconds."""
    grid = SEDModel.yang2021().grid(SEDModel.yang2021_axes("fit"), list(fit.DEPTHS))
    fitter, table = BayesFitter(grid), fit.make_photometry(grid, n)
    fitter.fit(table[:2], redshift="redshift")
    with tempfile.TemporaryDirectory() as folder:
        table.write(Path(folder) / "catalog.fits")
        start = time.process_time()
        fit_file(
            fitter,
            Path(folder) / "catalog.fits",
            Path(folder) / "out",
            redshift="redshift",
            chunk_rows=chunk_rows,
        )
        spent = time.process_time() - start
    loop = fit.loop_time(grid, grid.n_allowed, len(grid.filters))
    print(
        f"{grid!r}, known redshifts: {n} objects in {spent:.1f} CPU-s, {1e3 * spent / n:.2f} ms each"
    )
    print(f"100,000 objects: {1e5 * spent / n / 60:.1f} CPU-min; plain loop {loop:.2f} s an object")


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--n", type=int, default=200_000, help="objects")
    parser.add_argument("--chunk-rows", type=int, default=10_000)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--workers", type=int, default=0, help="of dask, one of which is killed")
    parser.add_argument("--known", action="store_true", help="known redshifts, the paper's grid")
    parser.add_argument("--few", action="store_true", help="a smaller grid in fewer bands")
    parser.add_argument("--kind", choices=["fits", "parquet"], default="fits", help="of files")
    parser.add_argument("--kill", action="store_true", help="kill a fit, and compare its files")
    parser.add_argument("--one", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        more = options.threads, options.few, options.kind
        one(options.one, options.n, options.chunk_rows, *more)
        return
    if options.known:
        known(options.n, options.chunk_rows)
        return
    if options.workers:
        with tempfile.TemporaryDirectory() as folder:
            given = options.n, options.chunk_rows, options.few, options.kind, options.workers
            on_workers(Path(folder), *given)
        return
    grid, kind = make_grid(options.few), options.kind
    print(f"{grid!r}; {options.chunk_rows} rows a part, {options.threads} threads")
    print(
        f"{'objects':>8s} {'input':>8s} {'results':>8s} {'fit':>8s} {'rate':>8s} {'join':>7s}",
        end="",
    )
    print(f" {'resume':>7s} {'before':>8s} {'peak':>8s} {'page':>8s} {'CPU':>8s} {'loop':>8s}")
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        for n in (options.n // 10, options.n):
            write_catalog(folder / f"{n}.{kind}", grid, n)
            run = [sys.executable, __file__, "--one", str(folder), "--n", str(n)]
            run += ["--chunk-rows", str(options.chunk_rows), "--threads", str(options.threads)]
            run += ["--kind", kind, *(["--few"] if options.few else [])]
            env = {**os.environ, "OMP_NUM_THREADS": "1"}
            text = subprocess.check_output(run, text=True, env=env).split()
            fitted, joined, again, before, of_fit, of_page, cpu, loop = map(float, text[-8:])
            size = (folder / f"{n}.{kind}").stat().st_size / 1e6
            results = open_results(folder / f"out{n}")
            out = sum(path.stat().st_size for path in results.paths) / 1e6
            print(
                f"{n:8d} {size:5.0f} MB {out:5.0f} MB {fitted:6.0f} s {n / fitted:4.0f} /s "
                f"{joined:5.0f} s {again:5.1f} s {before:5.0f} MB {of_fit:5.0f} MB {of_page:5.0f} MB "
                f"{1e3 * cpu / n:5.3f} ms {1e3 * loop:5.3f} ms",
                flush=True,
            )
            if options.kill:
                killed(run, folder, n, kind)
                shutil.rmtree(folder / f"whole{n}")
            shutil.rmtree(folder / f"out{n}")


if __name__ == "__main__":
    main()
