"""
Redshifts of CEERS sources with errors of the bands that are measured on the catalog, without known redshifts.

    MIRICIGALE_DATA=../shared/data python benchmarks/band_errors.py [--interpolate 600] [--random 300]

The whole catalog (the part of that of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers) is measured with
`calibrate_bands`. Fitted are sources with S/N above 5 in seven bands: some at random, those with S/N above 5 in
one MIRI band and those in two or more; from HST and NIRCam, and with MIRI; with errors as published, with the
prior of the errors alone, and with those that were measured. Published redshifts in steps of 0.025 are
photometric; the others are scored apart. Expected outliers are the posterior's: the probability beyond 0.15 (1 +
z) of the median. Outliers with MIRI and without are paired.
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import numpy as np
from astropy.stats import mad_std
from ceers import OUTLIER, sample

from miricigale.filters import read_catalog_photometry
from miricigale.fitting import BayesFitter, GridSettings, SurveyCalibration, calibrate_bands
from miricigale.sed import SEDModel


def score(label, results, true, finer):
    """Print one line of the table; returns which sources are outliers."""
    low, middle, high = results.percentile("redshift", (0.16, 0.5, 0.84)).value.T
    off = (middle - true) / (1 + true)
    outlier = np.abs(off) > OUTLIER
    inside = (true >= low) & (true <= high)
    nodes = results.axes["redshift"].values
    near = np.abs(nodes - middle[:, None]) <= OUTLIER * (1 + middle[:, None])
    expected = 1 - np.sum(results.pdf["redshift"] * near, axis=1)
    numbers = [off.size, np.median(off), mad_std(off)]
    for rows in (np.ones(off.size, bool), finer):
        numbers += [100 * np.mean(some[rows]) for some in (outlier, expected, inside)]
    text = "{:36s} {:4d} {:+8.4f} {:7.4f} {:6.1f} {:6.1f} {:5.0f}   {:6.1f} {:6.1f} {:5.0f}"
    print(text.format(label, *numbers), flush=True)
    return outlier


def main():
    """Print the calibration and the scores."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--interpolate", type=int, default=600, help="as of GridSettings")
    parser.add_argument("--random", type=int, default=300, help="sources at random")
    args = parser.parse_args()
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        catalog = read_catalog_photometry(path, "ceers")
    true = np.asarray(table["redshift"], float)
    finer = np.abs(true / 0.025 - np.round(true / 0.025)) > 1e-3
    grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
    published = SurveyCalibration.survey()
    settings = GridSettings(interpolate=args.interpolate)
    fitter = BayesFitter(grid, bands, calibration=published, settings=settings)
    start = time.process_time()
    measured = calibrate_bands(fitter, catalog)
    print(measured.summary())
    print(f"{len(catalog)} sources, {time.process_time() - start:.0f} s of CPU")
    chosen = np.random.default_rng(5).choice(len(table), args.random, replace=False)
    samples = {"random": np.sort(chosen)}
    samples["two in MIRI"] = np.flatnonzero(n_miri >= 2)
    samples["one in MIRI"] = np.flatnonzero(n_miri == 1)
    calibrations = {
        "published": published,
        "prior": published.with_prior_errors(bands),
        "measured": measured,
    }
    optical = [band for band in bands if not band.startswith("miri")]
    print(f"{'':36s}    n     bias    NMAD   out.%  exp.%   68%   finer out.%  exp.%   68%")
    for name, rows in samples.items():
        outliers = {}
        for kind, calibration in calibrations.items():
            for label, used in (("", optical), (" and MIRI", bands)):
                some = BayesFitter(grid, used, calibration=calibration, settings=settings)
                results = some.fit(table[rows])
                text = f"{name}: {kind}{label}"
                outliers[kind + label] = score(text, results, true[rows], finer[rows])
        for kind in calibrations:
            without, with_miri = outliers[kind], outliers[f"{kind} and MIRI"]
            lost = np.count_nonzero(with_miri & ~without)
            gained = np.count_nonzero(without & ~with_miri)
            print(f"  {kind}: with MIRI {lost} become outliers, {gained} cease to be")


if __name__ == "__main__":
    main()
