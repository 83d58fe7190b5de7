"""
Redshifts of real galaxies with `SEDModel.survey`: CEERS sources in HST, NIRCam and MIRI bands.

    MIRICIGALE_DATA=../shared/data python benchmarks/ceers.py [--grid grid.fits] [--mocks] [--times]
        [--sampler 200 interpolate|nautilus]

The catalog is the part of that of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers; of it sources with S/N above
5 in seven bands and redshift 0.1 to 5.5. Shown are 600 at random, those with S/N above 5 in two MIRI bands, and of
these the ones whose published redshifts are not in steps of 0.025: those in steps are photometric, from the same
HST and NIRCam bands; the others are nearly all of F160W < 24, where 3D-HST has grism redshifts.
Each half of the sources is fitted with `calibrate` of the other, and without. ``--mocks`` fits the best models
with noise of these errors again: what chi2 is if errors are right. ``--sampler`` fits some sources with continuous
parameters too, and does nothing else.
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from fit import loop_time, time_each

from miricigale.filters import FilterSet, read_catalog_photometry
from miricigale.fitting import (
    BayesFitter,
    FitResults,
    GridSettings,
    SamplerSettings,
    SurveyCalibration,
    calibrate,
    mock_analysis,
)
from miricigale.sed import ModelGrid, SEDModel

OUTLIER = 0.15


def sample(path):
    """Sources of the catalog, all bands, and in how many of MIRI each has S/N above 5."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = read_catalog_photometry(path, "ceers")
    bands = [name for name in table.colnames if f"{name}_err" in table.colnames]
    for name in bands:
        # -99 is no error
        none = ~(table[f"{name}_err"] > 0)
        table[name][none] = table[f"{name}_err"][none] = np.nan
    signal = np.array([np.nan_to_num((table[b] / table[f"{b}_err"]).value) for b in bands]) > 5
    miri, z = np.array([b.startswith("miri") for b in bands]), np.asarray(table["redshift"], float)
    good = (signal.sum(axis=0) >= 7) & (z > 0.1) & (z < 5.5)
    return table[good], bands, signal[miri].sum(axis=0)[good]


def row(label, results, true, rows):
    """One line of the table of redshifts."""
    low, middle, high = results.percentile("redshift", (0.16, 0.5, 0.84)).value.T
    off = ((middle - true) / (1 + true))[rows]
    inside = ((true >= low) & (true <= high))[rows]
    print(
        f"{label:34s} {off.size:4d} {np.median(off):+8.4f} {mad_std(off):8.4f} "
        f"{100 * np.mean(np.abs(off) > OUTLIER):7.1f} {100 * np.mean(inside):7.0f}"
    )


def chi2_parts(results, bands, rows):
    """Medians over objects of the mean squared pull below and above 3 um."""
    pivot = np.array([one.pivot.to_value(u.um) for one in FilterSet.from_names(bands)])
    columns = [results.filters.index(band) for band in bands]
    pull = (results.flux - results.best_flux) / results.sigma
    pull[~np.isfinite(results.sigma)] = np.nan
    pull, out = pull[:, columns], []
    for part in (pivot < 3, pivot >= 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            out.append(np.nanmedian(np.nanmean(pull[rows][:, part] ** 2, axis=1)))
    return out


def time_known(fitter, table, n=2000):
    """Print CPU times at known redshifts, of rows of the catalog with new noise."""
    rng = np.random.default_rng(7)
    table = table[rng.integers(len(table), size=n)]
    table["id"] = np.arange(n)
    for name in fitter.bands:
        noise = rng.normal(size=n) * table[f"{name}_err"].to_value(u.uJy)
        table[name] += np.nan_to_num(noise) * u.uJy
    fitter.fit(table[:8], redshift="redshift")
    start = time.process_time()
    fitter.fit(table, redshift="redshift")
    each = (time.process_time() - start) / n
    print(
        f"  known redshifts: {1e3 * each:.1f} ms of CPU an object, 100,000 {each * 1e5 / 60:.1f} min"
    )


def worst_tenth(results, table, bands, true):
    """What the tenth with the largest errors in redshift has in common: medians of it and of all."""
    middle = results.percentile("redshift", 0.5).value
    off = np.abs(middle - true) / (1 + true)
    worst = off >= np.quantile(off, 0.9)
    flux = {b: table[b].to_value(u.uJy) for b in bands}
    pull = np.abs((results.flux - results.best_flux) / results.sigma)
    miri = [i for i, b in enumerate(results.filters) if b.startswith("miri")]
    pull[~np.isfinite(results.sigma)] = np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        facts = {
            "published redshift": true,
            "F444W, AB": 23.9 - 2.5 * np.log10(flux["nircam.f444w"]),
            "F770W / F444W": flux["miri.f770w"] / flux["nircam.f444w"],
            "bands": results.n_bands,
            "reduced chi2": results.reduced_chi2,
            "largest pull in MIRI": np.nanmax(pull[:, miri], axis=1),
            "frac_agn": results.mean("frac_agn").value,
            "a_v": results.mean("a_v").value,
            "std of z / (1 + z)": results.std("redshift").value / (1 + true),
        }
        for name, values in facts.items():
            values = np.where(np.isfinite(values), values, np.nan)
            print(f"  {name:24s} {np.nanmedian(values[worst]):8.2f} {np.nanmedian(values):8.2f}")


def _continuous():
    """Priors of a sampler over the ranges of the grid's axes."""
    axes = SEDModel.survey_axes()
    flat = ("slope", "ebv", "q_pah", "frac_agn", "redshift")
    priors = {name: (axes[name][0], axes[name][-1]) for name in flat}
    priors |= {name: (axes[name][0], axes[name][-1], "log") for name in ("tau", "age")}
    return priors | {name: axes[name].tolist() for name in ("f_burst", "metallicity")}


def compare(table, grid, n, engine):
    """Redshifts and masses with continuous parameters beside those of the grid, with errors of 6 and 30 %."""
    table = table[np.sort(np.random.default_rng(3).permutation(len(table))[:n])]
    bands = list(grid.filters)
    errors = {b: 0.3 if b.startswith("miri") else 0.06 for b in bands}
    ours = BayesFitter(grid, bands, model_error=errors).fit(table)
    if engine == "interpolate":
        settings = GridSettings(finer=SEDModel.survey())
        fitter = BayesFitter(grid, bands, model_error=errors, settings=settings)
    else:
        fitter = BayesFitter(
            SEDModel.survey(),
            bands,
            model_error=errors,
            priors=_continuous(),
            engine=engine,
            settings=SamplerSettings(n_live=300, n_effective=500),
        )
    start = time.process_time()
    theirs = fitter.fit(table, seed=1)
    print(f"\n{n} with {engine}: {(time.process_time() - start) / n:.2f} s of CPU an object")
    z = [one.percentile("redshift", (0.16, 0.5, 0.84)).value for one in (ours, theirs)]
    mass = [np.log10(one.percentile("mass", 0.5).value).ravel() for one in (ours, theirs)]
    off = (z[1][:, 1] - z[0][:, 1]) / (1 + z[0][:, 1])
    near = np.abs(off) < OUTLIER
    print(
        f"redshift: median {np.median(off):+.4f}, sigma_MAD {mad_std(off):.4f}, beyond 0.15 {np.sum(~near)}"
    )
    wide = [np.median((q[:, 2] - q[:, 0]) / (1 + q[:, 1])) for q in z]
    print(f"median width of 68 % intervals over 1 + z: grid {wide[0]:.3f}, sampler {wide[1]:.3f}")
    apart = (mass[1] - mass[0])[near]
    print(
        f"log mass of the same redshift: median {np.median(apart):+.3f}, sigma_MAD {mad_std(apart):.3f}"
    )
    true = np.asarray(table["redshift"], float)
    for label, one in (("grid", ours), ("sampler", theirs)):
        row(f"  {label}", one, true, np.ones(n, bool))


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--grid", type=Path, help="keep the grid in this file")
    parser.add_argument(
        "--times", action="store_true", help="of each object, and of the plain loop"
    )
    parser.add_argument("--mocks", action="store_true", help="what chi2 is if errors are right")
    parser.add_argument("--sampler", nargs=2, metavar=("N", "ENGINE"), help="fit N with a sampler")
    args = parser.parse_args()
    path = Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits"
    table, bands, n_miri = sample(path)
    start = time.process_time()
    if args.grid and args.grid.exists():
        grid = ModelGrid.read(args.grid)
    else:
        grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
        if args.grid:
            grid.write(args.grid)
    print(f"{grid}, {time.process_time() - start:.0f} s")
    if args.sampler:
        compare(table[n_miri >= 2], grid, int(args.sampler[0]), args.sampler[1])
        return
    halves, start = [np.arange(h, len(table), 2) for h in (0, 1)], time.process_time()
    found = [
        calibrate(BayesFitter(grid, bands), table[half], reference="wfc3.f160w", name=f"half {h}")
        for h, half in enumerate(halves)
    ]
    print(f"calibrations of {len(table)} sources: {time.process_time() - start:.0f} s of CPU")
    print("band           zero points   errors times  of the flux   allowed wrong  wrong")
    for a, b in zip(found[0].bands, found[1].bands, strict=True):
        each = [
            [one[name] for name in list(a.colnames)[2:] if name[-3:] != "err"] for one in (a, b)
        ]
        print(f"{a['band']:14s}", *(f"{x:6.3f} {y:6.3f} " for x, y in zip(*each, strict=True)))
    for name in found[0].priors:
        print(name, *(one.priors[name][1].round(3) for one in found))
    error = [one.template_error for one in found]
    for wave, *each in zip(error[0].wave, error[0].error, error[1](error[0].wave), strict=True):
        print(f"{wave:7.3f} {each[0]:.3f} {each[1]:.3f}")
    true = np.asarray(table["redshift"], float)
    apart = np.abs(true / 0.025 - np.round(true / 0.025)) > 1e-3
    chosen = np.random.default_rng(5).choice(len(table), 600, replace=False)
    samples = {"two in MIRI": n_miri >= 2, "  of them not in steps of 0.025": (n_miri >= 2) & apart}
    samples = {"random": np.isin(np.arange(len(table)), chosen), **samples}
    some = np.any(list(samples.values()), axis=0)
    optical = [b for b in bands if not b.startswith("miri")]
    print("\n                                      n     bias sigma_MAD  out.,%  in 68 %")
    for label, used in (("HST, NIRCam", optical), ("HST, NIRCam, MIRI", bands)):
        for what in ("as given, errors of 10 %", "SurveyCalibration.survey()", "calibrated"):
            parts, rows, mocks, known, times, spent = [], [], [], [], [], 0.0
            for half, other in zip(halves, found[::-1], strict=True):
                mine = half[some[half]]
                use = {"as": None, "Su": SurveyCalibration.survey(), "ca": other}[what[:2]]
                fitter, part = BayesFitter(grid, used, calibration=use), table[mine]
                start = time.process_time()
                parts.append(fitter.fit(part))
                spent += time.process_time() - start
                rows.append(mine)
                if args.times and use is other:
                    times.extend(time_each(fitter, part[:60]))
                if args.mocks and use is other:
                    mock = mock_analysis(fitter, parts[-1], part, seed=1, model_error=True)
                    mocks.append(mock.recovered)
                    at = {"redshift": "redshift"}
                    fit = fitter.fit(part, **at)
                    known.append(mock_analysis(fitter, fit, part, seed=1, model_error=True, **at))
            results, rows = FitResults.concatenate(parts), np.concatenate(rows)
            print(f"{label}, {what}: {1e3 * spent / rows.size:.0f} ms of CPU an object")
            for name, mask in samples.items():
                row(name, results, true[rows], mask[rows])
        if args.times:
            print(
                f"  one by one: median {np.median(times):.0f} ms, 95 % {np.quantile(times, 0.95):.0f} ms"
            )
            time_known(fitter, table)
        groups = {"": parts, " of mocks": mocks}
        groups |= {" at known redshifts": [one.truth for one in known]}
        groups |= {" of mocks at known redshifts": [one.recovered for one in known]}
        for what, fits in groups.items():
            if fits:
                one = FitResults.concatenate(fits)
                below, above = chi2_parts(one, used, np.ones(len(one), bool))
                text = f"{below:.2f} below 3 um, {above:.2f} above"
                print(f"  median of mean squared pulls{what}: {text}")
    print("\nworst tenth, with MIRI: medians                  all")
    miri = (n_miri >= 2)[rows]
    worst_tenth(results[miri], table[rows][miri], bands, true[rows][miri])
    if args.times:
        model = SEDModel.yang2021(libraries="bundled")
        n_models = model.grid(SEDModel.yang2021_axes(), ["wfc3.f160w"]).n_allowed
        seconds = loop_time(None, n_models, 21)
        print(f"plain loop over the grid of Yang et al. 2021: {seconds:.2f} s an object")


if __name__ == "__main__":
    main()
