"""
Measure the calibration that fits of real galaxies have by default, on sources of CEERS.

    python tools/make_calibration.py CATALOG [--full FILE] [--measured FILE]

Writes miricigale/refdata/files/sed/survey_calibration.ecsv and prints its checksum for resources.toml. ``CATALOG``
is the photometry of Lisiecki et al. 2025, or a part of it; of it sources with S/N above 5 in seven bands and a
published redshift of 0.1 to 5.5. ``--full`` writes the calibration with what is of that catalog alone, too: zero
points, errors of its bands, wrong fluxes. ``--measured`` takes such a file in place of a new `calibrate`.

Residuals at known redshifts are smaller than errors of models, as a template bends to the fluxes. So errors of
models are scaled by one factor: that by which free redshifts are predicted best, with errors of bands that the
catalog measures itself (`calibrate_bands`), as fits have by default. The score is the mean logarithm of the
posterior's density at the known redshift (Gneiting & Raftery 2007, JASA 102, 359). Sources are those that no
benchmark scores: with S/N above 5 in one MIRI band or none, and not among the 300 at random of
``benchmarks/band_errors.py``. They are fitted in HST and NIRCam bands.
"""

import argparse
import dataclasses
import hashlib
from pathlib import Path

import numpy as np

from miricigale.filters import read_catalog_photometry
from miricigale.fitting import (
    BayesFitter,
    GridSettings,
    SurveyCalibration,
    TemplateError,
    calibrate,
    calibrate_bands,
)
from miricigale.sed import SEDModel

SCALES = (1.0, 1.2, 1.4)
#: Share of known redshifts that may be wrong, and their density in (z - known) / (1 + known).
WRONG = 0.05
WRONG_DENSITY = 0.5
#: Sources that ``benchmarks/band_errors.py`` takes at random, and its seed.
N_SCORED = 300
SCORED_SEED = 5
#: Sources in steps of 0.025, whose redshifts are photometric, beside all others.
N_IN_STEPS = 300

OUT = Path(__file__).parents[1] / "miricigale/refdata/files/sed/survey_calibration.ecsv"


def sample(path):
    """Sources of the catalog with fluxes enough, and all bands."""
    table = read_catalog_photometry(path, "ceers")
    bands = [name for name in table.colnames if f"{name}_err" in table.colnames]
    for name in bands:
        # -99 is no error
        none = ~(table[f"{name}_err"] > 0)
        table[name][none] = table[f"{name}_err"][none] = np.nan
    signal = np.array([np.nan_to_num((table[b] / table[f"{b}_err"]).value) for b in bands])
    z = np.asarray(table["redshift"], float)
    return table[((signal > 5).sum(axis=0) >= 7) & (z > 0.1) & (z < 5.5)], bands


def scale_sources(table, bands):
    """Rows of the sources on which the scale of the errors of models is measured."""
    signal = np.array([(table[b] / table[f"{b}_err"]).value for b in bands if "miri" in b])
    n_miri = np.count_nonzero(np.nan_to_num(signal) > 5, axis=0)
    scored = np.random.default_rng(SCORED_SEED).choice(len(table), N_SCORED, replace=False)
    free = n_miri < 2
    free[scored] = False
    z = np.asarray(table["redshift"], float)
    in_steps = np.abs(z / 0.025 - np.round(z / 0.025)) < 1e-3
    chosen = np.random.default_rng(1).choice(
        np.flatnonzero(free & in_steps), N_IN_STEPS, replace=False
    )
    return np.sort(np.append(np.flatnonzero(free & ~in_steps), chosen))


def scaled(calibration, scale):
    """Return a calibration with errors of models that are larger by a factor."""
    error = calibration.template_error
    half_difference = scale * calibration.errors["template_error"]
    return dataclasses.replace(
        calibration,
        template_error=TemplateError(error.wave, scale * error.error),
        errors=calibration.errors | {"template_error": half_difference},
    )


def score(calibration, catalog, sources, bands):
    """Mean logarithm of the posterior's density at the known redshifts."""
    settings = GridSettings(interpolate=0)
    model = SEDModel.survey()
    fitter = BayesFitter(model, bands, calibration=calibration, settings=settings)
    measured = calibrate_bands(fitter, catalog)
    optical = [band for band in bands if not band.startswith("miri")]
    fitter = BayesFitter(model, optical, calibration=measured, settings=settings)
    results = fitter.fit(sources)
    nodes = results.axes["redshift"].values
    densities = results.pdf["redshift"] / np.gradient(nodes)
    logs = []
    for z, density in zip(np.asarray(sources["redshift"], float), densities, strict=True):
        at_known = (1.0 + z) * np.interp(z, nodes, density)
        logs.append(np.log((1.0 - WRONG) * at_known + WRONG * WRONG_DENSITY))
    return np.mean(logs)


def model_error_scale(calibration, path, table, bands):
    """Factor of the errors of models where the score is largest, on a parabola through `SCALES`."""
    catalog = read_catalog_photometry(path, "ceers")
    sources = table[scale_sources(table, bands)]
    scores = [score(scaled(calibration, scale), catalog, sources, bands) for scale in SCALES]
    print("scores of", dict(zip(SCALES, scores, strict=True)))
    curvature, slope, _ = np.polyfit(SCALES, scores, 2)
    if curvature >= 0:
        raise SystemExit("the score has no maximum")
    return round(-0.5 * slope / curvature, 2)


def main():
    """Measure, and write."""
    parser = argparse.ArgumentParser()
    parser.add_argument("catalog", type=Path)
    parser.add_argument("--full", type=Path)
    parser.add_argument("--measured", type=Path)
    args = parser.parse_args()
    table, bands = sample(args.catalog)
    if args.measured:
        calibration = SurveyCalibration.read(args.measured)
    else:
        # not with what it is to make
        fitter = BayesFitter(SEDModel.survey(), bands, calibration=None)
        calibration = calibrate(fitter, table, reference="wfc3.f160w", name="CEERS")
        print(calibration.scores)
    if args.full:
        calibration.write(args.full, overwrite=True)
    shipped = dataclasses.replace(calibration, bands=calibration.bands[:0])
    scale = model_error_scale(shipped, args.catalog, table, bands)
    print(f"errors of models are scaled by {scale}")
    scaled(shipped, scale).write(OUT, overwrite=True)
    print(hashlib.sha256(OUT.read_bytes()).hexdigest())


if __name__ == "__main__":
    main()
