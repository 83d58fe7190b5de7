"""
Time the grid fit on the grid of Yang et al. 2021: 24 million models, 21 bands.

    python benchmarks/fit.py [--n 200] [--kind fit|quick] [--threads 2] [--grid grid.fits]

Objects are models of the grid with 0.1-1 uJy noise in the optical to 10 uJy in the far bands,
the same error model as the fits of the paper, detected at 5 sigma in F160W. Times are of one
core; the first call, which compiles the kernels, is timed apart in a fresh cache.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting import BayesFitter, GridSettings
from miricigale.sed import ModelGrid, SEDModel

# 5-sigma depths, AB (Stefanon et al. 2017, FIDEL, CEERS)
DEPTHS = {
    "megacam.u": 27.1, "megacam.g": 27.3, "megacam.r": 27.2, "megacam.i": 27.0,
    "megacam.z": 26.1, "acs.f606w": 28.8, "acs.f814w": 28.2, "wfc3.f125w": 27.6,
    "wfc3.f140w": 26.8, "wfc3.f160w": 27.6, "irac.ch1": 23.9, "irac.ch2": 24.2,
    "irac.ch3": 22.5, "irac.ch4": 22.8, "mips.24": 19.3, "miri.f770w": 25.2,
    "miri.f1000w": 24.5, "miri.f1280w": 23.9, "miri.f1500w": 23.5, "miri.f1800w": 22.7,
    "miri.f2100w": 22.6,
}  # fmt: skip


def make_photometry(grid, n, *, seed=1, miri=True):
    """Models of the grid with noise."""
    rng = np.random.default_rng(seed)
    names = [name for name in grid.filters if miri or not name.startswith("miri")]
    sigma = np.array([(DEPTHS[name] * u.ABmag).to_value(u.uJy) / 5.0 for name in grid.filters])
    h = grid.filters.index("wfc3.f160w")
    rows, redshift = [], []
    while len(rows) < n:
        z = rng.integers(grid.redshift.size // 12, grid.redshift.size * 5 // 6)
        g = rng.choice(np.flatnonzero(grid.allowed[z]))
        k, f = rng.integers(max(grid.n_agn, 1)), rng.integers(grid.frac_agn.size)
        model = 10.0 ** rng.uniform(8.0, 11.5) * grid.flux(z, g, k, f)
        if model[h] > 5.0 * sigma[h]:
            rows.append(model + sigma * rng.normal(size=sigma.size))
            redshift.append(grid.redshift[z])
    flux = np.array(rows)
    table = QTable({"id": np.arange(n), "redshift": redshift})
    for name in names:
        i = grid.filters.index(name)
        table[name] = flux[:, i] * u.uJy
        table[f"{name}_err"] = np.full(n, sigma[i]) * u.uJy
    return table


def time_each(fitter, table):
    """CPU milliseconds of one core for every object."""
    engine = fitter.backend.engine
    fitter.fit(table[:1])
    # errors of results have the template error in them, which the engine adds
    data = fitter._reader.read(table)
    workspace = engine.workspace()
    prior = np.zeros(fitter.grid.redshift.size)
    flux = np.nan_to_num(data.flux)
    out = []
    for i in range(len(table)):
        start = time.thread_time()
        engine.fit(flux[i : i + 1], data.sigma[i : i + 1], prior[None], workspace=workspace)
        out.append(1e3 * (time.thread_time() - start))
    return np.array(out)


def with_limits(grid, table, sigmas=3.0):
    """Replace fluxes below so many sigma by upper limits there."""
    table = table.copy()
    for name in grid.filters:
        low = table[name] < sigmas * table[f"{name}_err"]
        table[f"{name}_limit"] = low
        table[name] = np.where(low, sigmas * table[f"{name}_err"], table[name])
    return table


def loop_time(grid, n_models, n_bands):
    """Seconds an object of the plain loop over an explicit table, scaled from 400 000 models."""
    rng = np.random.default_rng(0)
    n = 400_000
    model = [10 ** rng.normal(size=n) for _ in range(n_bands)]
    value = [rng.normal(size=n) for _ in range(7)]
    flux, inverse = rng.random(n_bands), np.full(n_bands, 10.0)
    start = time.thread_time()
    num, den = np.zeros(n), np.zeros(n)
    for b in range(n_bands):
        num += model[b] * (flux[b] * inverse[b])
        den += model[b] ** 2.0 * inverse[b]
    s = num / den
    chi2 = np.zeros(n)
    for b in range(n_bands):
        chi2 += np.square((model[b] * s - flux[b]) * inverse[b])
    like = np.exp(-0.5 * (chi2 - chi2.min()))
    like /= like.sum()
    for v in value:
        mean = np.einsum("i,i", v, like)
        np.sqrt(np.einsum("i,i,i", like, v - mean, v - mean))
    return (time.thread_time() - start) * n_models / n


def compile_time():
    """Seconds of the first call in a process whose cache is empty, and in the next process."""
    code = (
        "import sys, time; sys.path.insert(0, sys.argv[1]); import fit;"
        "g = fit.SEDModel.yang2021().grid(fit.SEDModel.yang2021_axes('quick'), list(fit.DEPTHS));"
        "t = fit.make_photometry(g, 2); f = fit.BayesFitter(g); s = time.time(); f.fit(t);"
        "print(time.time() - s)"
    )
    with tempfile.TemporaryDirectory() as folder:
        env = {**os.environ, "NUMBA_CACHE_DIR": folder}
        run = [sys.executable, "-c", code, os.path.dirname(os.path.abspath(__file__))]
        return [float(subprocess.check_output(run, env=env).split()[-1]) for _ in range(2)]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--n", type=int, default=200, help="objects")
    parser.add_argument("--kind", default="fit", help="axes of yang2021_axes")
    parser.add_argument("--grid", help="a grid written by ModelGrid.write")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args()
    start = time.time()
    if options.grid:
        grid = ModelGrid.read(options.grid)
    else:
        grid = SEDModel.yang2021().grid(SEDModel.yang2021_axes(options.kind), list(DEPTHS))
    print(f"{grid!r}, {grid.n_allowed:,} allowed, made in {time.time() - start:.1f} s")
    first, cached = compile_time()
    print(f"first call {first:.1f} s, from the cache {cached:.1f} s")
    fitter = BayesFitter(grid, settings=GridSettings(interpolate=0))
    print(
        f"{'case':32s} {'median':>7s} {'mean':>7s} {'95 %':>7s} {'max':>7s}  ms an object, one core"
    )
    loop = loop_time(grid, grid.n_allowed, len(grid.filters))
    mean = {}
    for label, miri, scale in (
        ("21 bands", True, 1.0),
        ("15 bands, without MIRI", False, 1.0),
        ("21 bands, errors x 10", True, 10.0),
    ):
        table = make_photometry(grid, options.n, miri=miri)
        for name in table.colnames:
            if name.endswith("_err"):
                table[name] *= scale
        ms = time_each(fitter, table)
        mean[label] = ms.mean()
        print(
            f"{label:32s} {np.median(ms):7.2f} {ms.mean():7.2f} {np.percentile(ms, 95):7.2f} "
            f"{ms.max():7.2f}"
        )
    table = make_photometry(grid, options.n)
    start = time.process_time()
    fitter.fit(table, redshift="redshift")
    spent = 1e3 * (time.process_time() - start) / options.n
    print(f"{'21 bands, known redshift':32s} {'':7s} {spent:7.2f}")
    between = BayesFitter(grid)
    # both have kernels of their own, which the first call compiles
    between.fit(table[:1])
    between.fit(table[:1], redshift="redshift")
    for label, known in (
        ("21 bands, between nodes", None),
        ("known redshift, between", "redshift"),
    ):
        start = time.process_time()
        between.fit(table, redshift=known)
        spent = 1e3 * (time.process_time() - start) / options.n
        print(f"{label:32s} {'':7s} {spent:7.2f}")
    few = with_limits(grid, table[: max(options.n // 8, 2)])
    # limits have kernels of their own, which the first call compiles
    fitter.fit(few[:1])
    ms = []
    for i in range(len(few)):
        start = time.thread_time()
        fitter.fit(few[i : i + 1])
        ms.append(1e3 * (time.thread_time() - start))
    limits = sum(np.sum(few[f"{name}_limit"]) for name in grid.filters) / len(few)
    label = f"below 3 sigma as limits ({limits:.1f})"
    print(
        f"{label:32s} {np.median(ms):7.2f} {np.mean(ms):7.2f} {np.percentile(ms, 95):7.2f} "
        f"{np.max(ms):7.2f}"
    )
    walls = []
    for n_threads in (1, options.threads):
        start = time.time()
        with ThreadPoolExecutor(n_threads) as pool:
            fitter.fit(table, executor=pool, chunk_size=16)
        walls.append(time.time() - start)
    print(f"{options.threads} threads: {walls[0] / walls[1]:.2f} times faster (wall clock)")
    print(f"plain loop {loop:.2f} s an object: {1e3 * loop / mean['21 bands']:.0f} times slower")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2
    print(f"peak memory {peak:.2f} GB")


if __name__ == "__main__":
    main()
