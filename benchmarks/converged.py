"""
Scatter, bias and cost of posteriors between the nodes of the survey grid, for real sources.

    MIRICIGALE_DATA=../shared/data python benchmarks/converged.py [--sources 40] [--scrambles 5]
        [--effective 600] [--bias 5000]

Sources are those of `benchmarks/ceers.py`, half of them with S/N above 5 in two MIRI bands. Shown are the CPU
time of an object on nodes alone and between them; the scatter of the 16th, 50th and 84th percentiles over
scrambles of the quasi-random points, in units of half the 68 % interval; the shift of their mean from fits with
an effective number of ``--bias``; and the part that is flagged as not converged. In a checkout from before, in
which draws followed from ids, the scatter is over ids, and ``--effective`` is the number of draws.
"""

import argparse
import os
import time
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
from ceers import sample

from miricigale.fitting import BayesFitter, FitFlags, GridSettings, SurveyCalibration
from miricigale.fitting.grid.continuation import Continuation
from miricigale.sed import SEDModel

QUANTITIES = ("redshift", "frac_agn", "stellar_mass", "sfr", "dust_luminosity")
LEVELS = (0.16, 0.5, 0.84)
#: Flag of what is not converged; checkouts from before have none.
FLAG = int(getattr(FitFlags, "NOT_CONVERGED", 0))


def scrambled(fitter, scramble, effective):
    """A fitter with other quasi-random points; where draws follow from ids, with the same ones."""
    backend = fitter.backend
    between, given = backend.between, replace(backend.given, interpolate=effective)
    if "scramble" in {field.name for field in fields(Continuation)}:
        between = replace(between, scramble=scramble)
    new = fitter.replace()
    new.backend = replace(backend, between=between, given=given)
    return new


def percentiles(fitter, table, scramble):
    """Percentiles, shape (n_quantities, n, 3), flags, and CPU ms an object."""
    table = table.copy()
    table["id"] = [f"{scramble}-{i}" for i in range(len(table))]
    start = time.process_time()
    results = fitter.fit(table)
    spent = 1e3 * (time.process_time() - start) / len(table)
    values = np.array([results.percentile(name, LEVELS).value for name in QUANTITIES])
    return values, np.asarray(results.flags) & FLAG != 0, spent


def below(values):
    """Percentages of finite values below 0.15 and 0.3."""
    values = np.abs(values[np.isfinite(values)])
    return f"{100 * np.mean(values < 0.15):5.1f} {100 * np.mean(values < 0.3):5.1f}"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[1])
    parser.add_argument("--sources", type=int, default=40)
    parser.add_argument("--scrambles", type=int, default=5)
    parser.add_argument("--effective", type=int, default=GridSettings().interpolate)
    parser.add_argument("--bias", type=int, default=0)
    args = parser.parse_args()
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers" / "ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    rng, half = np.random.default_rng(5), args.sources // 2
    rows = [rng.choice(len(table), half, replace=False)]
    rows.append(rng.choice(np.flatnonzero(n_miri >= 2), args.sources - half, replace=False))
    table = table[np.concatenate(rows)]
    calibration, axes = SurveyCalibration.survey(), SEDModel.survey_axes()
    fitter = BayesFitter(SEDModel.survey(), bands, axes=axes, calibration=calibration)
    nodes = fitter.replace(settings=replace(fitter.backend.given, interpolate=0))
    for one in (nodes, fitter):
        one.fit(table[:2])
    print(f"nodes alone {percentiles(nodes, table, 0)[2]:.1f} ms an object")
    runs = []
    for scramble in range(1, args.scrambles + 1):
        runs.append(percentiles(scrambled(fitter, scramble, args.effective), table, scramble))
    values = np.array([run[0] for run in runs])
    flagged = np.mean([run[1] for run in runs], axis=0) > 0.5
    print(f"between nodes {np.mean([run[2] for run in runs]):.1f} ms an object")
    print(f"not converged {100 * np.mean(flagged):.0f} %")
    width = np.median(0.5 * (values[..., 2] - values[..., 0]), axis=0)
    width = np.where(width > 0, width, np.nan)[..., None]
    scatter = values.std(axis=0, ddof=1) / width
    print("part of percentiles with scatter below 0.15 and 0.3 half-widths:")
    print("all", below(scatter), "converged", below(scatter[:, ~flagged]))
    for name, each in zip(QUANTITIES, scatter, strict=True):
        print(f"{name:16s}", below(each), "90 %", np.nanpercentile(each, 90, axis=0).round(2))
    if args.bias:
        more = percentiles(scrambled(fitter, 99, args.bias), table, 99)[0]
        shift = (values.mean(axis=0) - more) / width
        print(f"shift from {args.bias}, part below 0.15 and 0.3: all", below(shift))
        print(
            "converged", below(shift[:, ~flagged]), "median", np.nanmedian(np.abs(shift)).round(3)
        )


if __name__ == "__main__":
    main()
