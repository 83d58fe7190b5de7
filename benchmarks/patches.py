"""
Photometry of a large mosaic in patches beside the same as a whole: time, largest memory, and how fluxes differ.

    python benchmarks/patches.py FOLDER --size 3000 --patch-size 0 1500 1000
    python benchmarks/patches.py FOLDER --size 3000 --noiseless --points --patch-size 0 1000 --overlap 1 3 10
    python benchmarks/patches.py FOLDER --size 12000 --patch-size 3000 --threads 2

Galaxies and points, 150 for each square arcmin, through the PSFs of F444W and F770W on pixels of 0.06
arcsec. Each measurement is a process of its own; that of the largest memory is told. Mosaics stay in the folder.
"""

import argparse
import resource
import subprocess
import sys
import time
from multiprocessing import Process
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable
from scipy.signal import oaconvolve

from miricigale.instrument import north_up_wcs
from miricigale.photometry import detect_sources, measure_files, read_mosaic
from miricigale.profiles import sersic_image
from miricigale.psf import MatchingKernel, filter_psf
from miricigale.utils.parallel import process_pool
from miricigale.utils.tables import match_sky
from miricigale.workflow import measure_patches
from photometry import CENTER, FINE

BANDS = {"nircam.f444w": 0.004, "miri.f770w": 0.02}


def galaxies(rng):
    """64 galaxies and a point, 121 x 121 pixels."""
    found = [
        sersic_image((121, 121), x=60, y=60, r_eff=rng.uniform(2, 7), n=rng.choice([1.0, 1.5, 2.5]),
                     axis_ratio=rng.uniform(0.3, 1), theta=rng.uniform(0, np.pi))
        for _ in range(64)
    ]  # fmt: skip
    return [*found, np.pad([[1.0]], 60)]


def write_mosaics(folder, size, noiseless, points, density=150.0):
    """The prior, the image and the kernel between them, a strip of the sky at a time."""
    rng = np.random.default_rng(1)
    form = {"pixel_scale": FINE, "pa": 0 * u.deg, "grid_angle": 0 * u.deg}
    kernel = MatchingKernel.from_psfs(
        *(filter_psf(band, **form) for band in BANDS), pixel_scale=FINE, extent=6 * u.arcsec
    )
    kernel.write(folder / "kernel.fits", overwrite=True)
    n = int(density * (size * FINE.to_value(u.arcmin)) ** 2)
    x, y = rng.integers(60, size - 60, (2, n))
    kinds = np.where(rng.random(n) < (1.0 if points else 0.2), 64, rng.integers(0, 64, n))
    lights = 10 ** rng.uniform(-0.7, 1.3, n), 10 ** rng.uniform(-0.5, 1.5, n)
    shapes = galaxies(rng)
    wcs = north_up_wcs(CENTER, FINE, (size, size))
    header = wcs.to_header()
    if points:
        sky = wcs.pixel_to_world(x, y)
        catalog = QTable({"id": np.arange(1, n + 1), "ra": sky.ra.deg, "dec": sky.dec.deg})
        catalog.write(folder / "catalog.fits")
    for (band, noise), light, psf in zip(
        BANDS.items(), lights, (kernel.source, kernel.target), strict=True
    ):
        stamps = [oaconvolve(one, psf) for one in shapes]
        half = len(stamps[0]) // 2
        instrument, name = band.upper().split(".")
        header.update(INSTRUME=instrument, FILTER=name, BUNIT="uJy", PA_APER=0.0)
        hdus = [fits.PrimaryHDU()]
        hdus += [fits.ImageHDU(np.zeros((1, 1), np.float32), header, name="SCI")]
        path, step = folder / f"{band}.fits", 1000
        with open(path, "wb") as stream:
            stream.write(hdus[0].header.tostring().encode())
            for extension in ("SCI", "ERR"):
                head = hdus[1].header.copy()
                head.update(NAXIS1=size, NAXIS2=size, EXTNAME=extension)
                stream.write(head.tostring().encode())
                for start in range(0, size, step):
                    rows = min(step, size - start)
                    strip = np.full((rows, size), noise)
                    if extension == "SCI":
                        strip = np.zeros((rows + 4 * half, size + 2 * half))
                        near = (y > start - half - 1) & (y < start + rows + half)
                        for k in np.flatnonzero(near):
                            i, j = y[k] - start + half, x[k]
                            strip[i : i + 2 * half + 1, j : j + 2 * half + 1] += (
                                light[k] * stamps[kinds[k]]
                            )
                        strip = strip[2 * half :][:rows, half:-half]
                        if not noiseless:
                            strip = strip + rng.normal(0, noise, strip.shape)
                    stream.write(strip.astype(">f4").tobytes())
                stream.write(bytes(-stream.tell() % 2880))


def write_segments(folder):
    """Segments of the whole prior."""
    prior = read_mosaic(folder / "nircam.f444w.fits")
    found = detect_sources(prior)[0].data.astype(np.int32)
    fits.PrimaryHDU(found, prior.wcs.to_header()).writeto(folder / "segments.fits")


def one(folder, patch_size, overlap, threads, noiseless):
    """Measure as a whole (0) or in patches; print seconds, sources and the largest memory of a process."""
    image, prior = (folder / f"{band}.fits" for band in reversed(BANDS))
    options = {"kernel": folder / "kernel.fits", "second_pass": False}
    if (folder / "segments.fits").exists():
        # templates that do not depend on what else is in a patch
        options |= {"segmentation": folder / "segments.fits", "wings": False}
    if (folder / "catalog.fits").exists():
        options |= {"catalog": folder / "catalog.fits", "template": "psf"}
    if noiseless:
        options["background_order"] = None
    output = folder / f"table-{patch_size}-{overlap:g}.fits"
    options |= {"output": output, "overwrite": True, "n_threads": threads}
    begin = time.perf_counter()
    if patch_size == 0:
        table = measure_files(image, prior, **options)
    else:
        with process_pool(threads) as executor:
            table = measure_patches(
                image, prior, folder / f"run-{patch_size}-{overlap:g}", patch_size=patch_size,
                overlap=overlap * u.arcsec, executor=executor, pages=False, **options,
            )  # fmt: skip
    wall = time.perf_counter() - begin
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    cpu = sum(one.ru_utime + one.ru_stime for one in used)
    print(len(table), wall, cpu, *(one.ru_maxrss / 1e6 for one in used))


def compare(whole, table):
    """How fluxes differ from those of the whole image, as parts of its errors and of its fluxes."""
    index, _ = match_sky(table["sky"], whole["sky"], radius=0.03 * u.arcsec)
    whole, table = whole[index >= 0], table[index[index >= 0]]
    flux, other, error = (
        one.value for one in (whole["miri.f770w"], table["miri.f770w"], whole["miri.f770w_err"])
    )
    same = np.asarray(whole["miri.f770w_template"]) == np.asarray(table["miri.f770w_template"])
    print(f"    {len(index)} whole, {len(table)} the same, {np.sum(~same)} of another template")
    for what, part in (("errors", error), ("fluxes", np.abs(flux))):
        for rows, which in (
            (np.isfinite(flux), "all"),
            (np.isfinite(flux) & same, "same template"),
        ):
            values = (np.abs(other - flux) / part)[rows]
            shares = ", ".join(f"{np.quantile(values, q):.2g}" for q in (0.5, 0.9, 0.99, 1))
            print(f"    part of {what}, {which}: median, 90 %, 99 %, largest {shares}")


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=3000, help="pixels across")
    parser.add_argument("--patch-size", type=int, nargs="+", default=[0], help="0: as a whole")
    parser.add_argument("--overlap", type=float, nargs="+", default=[10.0], help="arcsec")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--noiseless", action="store_true")
    parser.add_argument("--points", action="store_true", help="no galaxies, at known positions")
    parser.add_argument("--segments", action="store_true", help="of the whole prior, without wings")
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    folder = options.folder
    if options.one:
        size, overlap = options.patch_size[0], options.overlap[0]
        one(folder, size, overlap, options.threads, options.noiseless)
        return
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / "kernel.fits").exists():
        # a process of its own, for the largest memory of a parent counts as its children's
        form = folder, options.size, options.noiseless, options.points
        work = [Process(target=write_mosaics, args=form)]
        work += [Process(target=write_segments, args=(folder,))] * options.segments
        for process in work:
            process.start()
            process.join()
    whole = None
    for size in options.patch_size:
        for overlap in options.overlap if size else (0.0,):
            run = [sys.executable, __file__, str(folder), "--one", "--patch-size", str(size)]
            run += ["--overlap", str(overlap), "--threads", str(options.threads)]
            run += ["--noiseless"] * options.noiseless
            text = subprocess.check_output(run, text=True).split()
            n, wall, cpu, own, other = map(float, text[-5:])
            print(
                f"{size:6d} px, {overlap:4.1f} arcsec: {n:7.0f} sources, {wall:7.1f} s, {cpu:7.1f} "
                f"CPU-s, largest process {max(own, other):.2f} GB",
                flush=True,
            )
            table = QTable.read(folder / f"table-{size}-{overlap:g}.fits")
            if size == 0:
                whole = table
            elif whole is not None:
                compare(whole, table)


if __name__ == "__main__":
    main()
