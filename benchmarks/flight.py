"""
Limits of a plan against those that surveys reach in flight.

    MIRICIGALE_DATA=... python benchmarks/flight.py

Prints the 5-sigma limits (AB) of points of each survey's exposures, with and without the factor of the plan, those
of the calculator's aperture, and the published ones; docs/accuracy/planning.rst has the sources. CEERS: median
error of the sources with 3 to 10 sigma of a published catalog, if the data folder has it. PRIMER: an image.
"""

import os
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import Table
from scipy.ndimage import binary_dilation
from scipy.signal import fftconvolve

from miricigale.depth import sensitivity
from miricigale.planning import load_plan
from miricigale.planning.exposures import band_plans

FOLDER = Path(os.environ.get("MIRICIGALE_DATA", "."))
#: Survey, band, time (s), dithers, 5-sigma limit (AB). SMILES states 0.2 and 18 uJy.
SURVEYS = [
    ("COSMOS-Web", "f770w", 1054.5, 4, 25.51),
    ("SMILES", "f560w", 654.9, 4, 23.9 - 2.5 * np.log10(0.2)),
    ("SMILES", "f2550w", 832.5, 4, 23.9 - 2.5 * np.log10(18)),
]


def ceers():
    """Limits of the errors of real sources, and their errors."""
    table = Table.read(FOLDER / "ceers" / "ceers_photometry_part.fits")
    for band in ("f1000w", "f1280w", "f1500w", "f1800w"):
        flux, error = (1e3 * table[f"jwst.miri.{band.upper()}{end}"].data for end in ("", "_err"))
        faint = (error > 0) & (flux > 3 * error) & (flux < 10 * error)
        limits = 23.9 - 2.5 * np.log10(5 * error[faint])
        draws = np.random.default_rng(0).choice(limits, (1000, faint.sum()))
        scatter = np.std(np.median(draws, axis=1))
        print(f"CEERS {band}: {faint.sum()} sources, {np.median(limits):.2f} +- {scatter:.2f}")
        yield "CEERS", band, 1665.0, 3, np.median(limits)


def primer():
    """Limits of an image of PRIMER-UDS: scatter of empty places in an aperture and in a fit."""
    folder = FOLDER / "uds"
    # pixels of 0.08", repeated 2 x 2
    image = fits.getdata(folder / "uds-test-f770w_sci.fits.gz").astype(float)
    image = image.reshape(410, 2, 500, 2).sum((1, 3))
    sources = fits.getdata(folder / "uds-test-LW_seg.fits.gz").reshape(410, 2, 500, 2)
    free = ~binary_dilation(sources.max((1, 3)) > 0, iterations=4)
    image = np.where(free, image - np.median(image[free]), 0)
    fine = fits.getdata(folder / "psf" / "uds-test-f770w_psf.fits.gz")[0]
    smooth = fftconvolve(fine, np.outer([0.5, 1, 0.5], [0.5, 1, 0.5]), mode="same")
    psf = smooth[2:99:2, 2:99:2]
    y, x = np.mgrid[-24:25, -24:25] * 0.08
    steps = (np.arange(5) - 2) * 0.016
    circle = np.mean([np.hypot(y + dy, x + dx) < 0.3 for dy in steps for dx in steps], axis=0)
    for label, weight in (("aperture of 0.3 arcsec", circle), ("fit", psf * (np.hypot(y, x) < 1))):
        weight = weight / np.sum(weight * psf)
        flux = fftconvolve(image, weight, mode="same")
        clean = fftconvolve(~free * 1.0, (weight != 0) * 1.0, mode="same") < 0.1
        clean[:13] = clean[-13:] = clean[:, :13] = clean[:, -13:] = False
        off = flux[clean] - np.median(flux[clean])
        sigma = 1.4826 * np.median(np.abs(off)) / 100
        print(f"PRIMER-UDS f770w, {label}: {23.9 - 2.5 * np.log10(5 * sigma):.2f}")


def main():
    rows = list(SURVEYS)
    if (FOLDER / "ceers").is_dir():
        rows += ceers()
        primer()
    for survey, band, time, dithers, published in rows:
        exposures = {"bands": [f"miri.{band}"], "time": time, "dithers": dithers}
        plans = []
        for excess in ({}, {"excess": 1.0}):
            config = load_plan(overrides={"exposures": exposures, "noise": excess})
            plans += band_plans(config).values()
        options = {"n_groups": plans[0].exposure.n_groups, "n_dithers": dithers}
        aperture = sensitivity(plans[0].filter, plans[0].time, method="aperture", **options)
        limits = [plan.errors().limiting_magnitude(plan.filter).value for plan in plans]
        print(
            f"{survey:10s} {band:6s} {time:6.0f} s  published {published:.2f}  plan {limits[0]:.2f}"
            f"  difference {limits[0] - published:+.2f}  excess 1: {limits[1]:.2f}"
            f"  aperture {aperture.to_value(u.ABmag):.2f}"
        )


if __name__ == "__main__":
    main()
