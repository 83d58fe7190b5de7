"""
Light of galaxies at 1.3 to 5 um of rest wavelength: MIRI fluxes of CEERS over what HST and NIRCam predict.

    MIRICIGALE_DATA=../shared/data python benchmarks/rest_light.py [--redshifts]

Sources of the part of the catalog of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers with S/N above 5 in seven
bands, two of them MIRI's, are fitted in HST and NIRCam bands at their published redshifts, on the nodes of
`survey_axes`, and MIRI fluxes predicted (`leave_out`). Shown is the median of ln(measured / predicted) by rest
wavelength, of fluxes of S/N above 15 by the catalog, whose errors are too small by 3.3: for models with all of the
3.3 um feature of Draine & Li 2007, with the part that `SEDModel.survey` has, with none, and without dust emission,
without AGN and with them. Then the evidence of strengths of the feature, of all bands with the errors of `MIRI`,
at the published redshifts. ``--redshifts`` prints redshifts with all of the feature and with that part instead.
"""

import argparse
import dataclasses
import itertools
import os
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from ceers import row, sample

from miricigale.fitting import BayesFitter, GridSettings, SurveyCalibration, leave_out
from miricigale.fitting.data.template_error import pivots
from miricigale.sed import SEDModel

EDGES = np.array([1.3, 1.6, 2.0, 2.4, 2.8, 3.2, 3.6, 4.2, 5.0, 7.0, 11.0])
LEAST = 15.0
#: Factor of the catalog's errors of MIRI, and part of the flux, measured by hand on other sources.
MIRI = (3.3, 0.15)
PART = SEDModel.survey(libraries="bundled").component("dust").parameters["pah_33"].default
MODELS = {
    "all of the 3.3 um feature": {"pah_33": [1.0]},
    "as in SEDModel.survey": {"pah_33": [PART]},
    "without the feature": {"pah_33": [0.0]},
    "without dust emission": {"dust_excess": [0.0]},
}
NODES = GridSettings(interpolate=0)


def calibration(bands):
    """That of surveys, with the errors of MIRI."""
    survey = SurveyCalibration.survey()
    table = survey.bands[:0].copy()
    for band in bands:
        table.add_row([band, 0, 1.0, 0.0, *MIRI, 0.0])
    return dataclasses.replace(survey, bands=table)


def fitter(bands, miri, **axes):
    """How sources are fitted, on a grid of `survey_axes` with some axes changed."""
    grid = SEDModel.survey().grid(SEDModel.survey_axes() | axes, bands)
    return BayesFitter(grid, bands, calibration=calibration(miri), settings=NODES)


def by_wavelength(table, bands, miri):
    """Print medians of ln(measured / predicted)."""
    rest = pivots(miri).to_value(u.um) / (1 + np.asarray(table["redshift"], float)[:, None])
    print(" " * 38, *(f"{low:4.1f}-{high:.1f}  " for low, high in itertools.pairwise(EDGES)))
    for agn, fractions in (("no AGN", [0.0]), ("AGN", SEDModel.survey_axes()["frac_agn"])):
        for name, changed in MODELS.items():
            if agn == "AGN" and "dust_excess" in changed:
                continue  # AGN fractions refer to the dust
            one = fitter(bands, miri, frac_agn=fractions, **changed)
            found = leave_out(one, table, miri, redshift="redshift")
            error = found.flux_err / MIRI[0]
            good = (found.flux > LEAST * error) & (found.predicted > 0)
            ratio = np.log(np.where(good, found.flux / found.predicted, 1.0))
            text = []
            for low, high in itertools.pairwise(EDGES):
                some = ratio[good & (rest >= low) & (rest < high)]
                wide = 1.25 * mad_std(some) / np.sqrt(some.size)
                text.append(f"{np.median(some):+.2f}+-{wide:.2f}")
            print(f"{agn:6s} {name:30s}", " ".join(text))
    counts = [np.sum(good & (rest >= a) & (rest < b)) for a, b in itertools.pairwise(EDGES)]
    print(f"{'fluxes':37s}", *(f"{n:6d}    " for n in counts))


def by_strength(table, bands, miri):
    """Print the evidence of strengths of the feature."""
    print("\nstrength of the 3.3 um feature, ln of the evidence over that of 1")
    values = (1.0, 0.4, 0.2, 0.1, 0.0)
    fits = (fitter(bands, miri, pah_33=[x]).fit(table, redshift="redshift") for x in values)
    evidence = np.array([fit.log_evidence for fit in fits])
    for value, each in zip(values, (evidence - evidence[0]).sum(axis=1), strict=True):
        print(f"{value:5.2f} {each:+8.1f}")


def redshifts(table, bands, miri):
    """Print redshifts before and after."""
    true = np.asarray(table["redshift"], float)
    apart = np.abs(true / 0.025 - np.round(true / 0.025)) > 1e-3
    optical = [band for band in bands if band not in miri]
    print("                                      n     bias sigma_MAD  out.,%  in 68 %")
    for used in (optical, bands):
        for name, changed in list(MODELS.items())[:2]:
            fit = fitter(used, [band for band in miri if band in used], **changed).fit(table)
            row(f"{len(used)} bands, {name}", fit, true, np.ones(len(true), bool))
            row("  not in steps of 0.025", fit, true, apart)
            print(f"  ln of the evidence: {np.sum(fit.log_evidence):.1f}")


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--redshifts", action="store_true", help="redshifts instead")
    args = parser.parse_args()
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    table, miri = table[n_miri >= 2], [band for band in bands if band.startswith("miri")]
    if args.redshifts:
        redshifts(table, bands, miri)
        return
    by_wavelength(table, bands, miri)
    by_strength(table, bands, miri)


if __name__ == "__main__":
    main()
