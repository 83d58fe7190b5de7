"""
Redshifts of real galaxies with `SEDModel.survey`: CEERS sources in HST, NIRCam and MIRI bands.

    MIRICIGALE_DATA=../shared/data python benchmarks/ceers.py [--n 386] [--grid grid.fits] [--flat] [--mocks]
        [--times] [--sampler 200 interpolate|nautilus]

The catalog is the part of that of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers; of it sources with S/N above
5 in two MIRI bands and five others. Published redshifts in steps of 0.025 are photometric, from the same HST and
NIRCam bands; the others, nearly all of F160W < 24, where 3D-HST has grism redshifts, are shown apart.
Template error, zero points, priors of all parameters and the errors of the MIRI bands (which the catalog measured
apart) are measured on one half and used on the other, and the other way round; ``--flat`` leaves the priors flat.
``--mocks`` fits the best models with noise of these errors again: what chi2 is if errors are right. ``--sampler``
fits some sources with continuous parameters too, and does nothing else. The last lines are what
`TemplateError.survey` and `SEDModel.survey_priors` hold: means of both halves.
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
    TemplateError,
    apply_zero_points,
    calibrate_zero_points,
    leave_out,
    measure_band_errors,
    measure_priors,
    measure_template_error,
    mock_analysis,
)
from miricigale.sed import ModelGrid, SEDModel

OUTLIER = 0.15


def sample(path):
    """Sources of the catalog, and all bands."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = read_catalog_photometry(path, "ceers")
    bands = [name for name in table.colnames if f"{name}_err" in table.colnames]
    for name in bands:
        # -99 is no error
        table[f"{name}_err"][~(table[f"{name}_err"] > 0)] = np.nan
    signal = np.array([np.nan_to_num((table[b] / table[f"{b}_err"]).value) for b in bands])
    miri = np.array([b.startswith("miri") for b in bands])
    good = ((signal[miri] > 5).sum(0) >= 2) & ((signal[~miri] > 5).sum(0) >= 5)
    return table[good], bands


def calibrated(grid, bands, table, flat):
    """
    Template error, errors of MIRI bands, zero points and priors, of sources at their published redshifts.

    Priors and zero points are those of fits with errors of 10 % (30 % in MIRI). The errors of MIRI are those of
    what HST and NIRCam predict, and the template error is what residuals have beside them; a few turns, for each
    needs the other. Zero points stay in the template error, which is for catalogs of which they are not known.
    """
    miri = [b for b in bands if b.startswith("miri")]
    errors = {b: 0.3 if b in miri else 0.1 for b in bands}
    priors = None
    for _ in range(1 if flat else 6):
        fit = BayesFitter(grid, bands, model_error=errors, priors=priors).fit(
            table, redshift="redshift"
        )
        priors, before = None if flat else measure_priors(fit), priors
    error, points = measure_template_error(fit), calibrate_zero_points(fit, reference="wfc3.f160w")
    measured = [b for b in miri if np.any(table[f"{b}_err"] > 0)]
    for _ in range(5):
        fitter = BayesFitter(grid, bands, model_error=0.0, template_error=error, priors=before)
        left = leave_out(fitter, table, measured, redshift="redshift")
        factor, part = measure_band_errors(left, error)
        own = dict.fromkeys(miri, part)
        fitter = BayesFitter(grid, bands, model_error=own, template_error=error, priors=before)
        fit = fitter.fit(with_errors(table, factor), redshift="redshift")
        error = measure_template_error(fit, model_error=own)
    return error, (factor, part), points, before


def with_errors(table, factor):
    """The catalog with the errors of its MIRI bands multiplied."""
    table = table.copy()
    for name in table.colnames:
        if name.startswith("miri") and name.endswith("_err"):
            table[name] *= factor
    return table


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
    pull = (results.flux - results.best_flux) / results.sigma
    pull[~np.isfinite(results.sigma)] = np.nan
    out = []
    for part in (pivot < 3, pivot >= 3):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            out.append(np.nanmedian(np.nanmean(pull[rows][:, part] ** 2, axis=1)))
    return out


def time_known(grid, used, table, n=2000):
    """Print CPU times at known redshifts, of rows of the catalog with new noise."""
    rng = np.random.default_rng(7)
    table = table[rng.integers(len(table), size=n)]
    table["id"] = np.arange(n)
    for name in used:
        table[name] += (
            np.nan_to_num(rng.normal(size=n) * table[f"{name}_err"].to_value(u.uJy)) * u.uJy
        )
    own = {name: 0.2 if name.startswith("miri") else 0.0 for name in used}
    error, priors = TemplateError.survey(), SEDModel.survey_priors()
    fitter = BayesFitter(grid, used, model_error=own, template_error=error, priors=priors)
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
        settings = GridSettings(interpolate=400, finer=SEDModel.survey())
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
    parser.add_argument("--n", type=int, help="sources, drawn at random (all)")
    parser.add_argument("--grid", type=Path, help="keep the grid in this file")
    parser.add_argument("--flat", action="store_true", help="priors that are flat in the nodes")
    parser.add_argument(
        "--times", action="store_true", help="of each object, and of the plain loop"
    )
    parser.add_argument("--mocks", action="store_true", help="what chi2 is if errors are right")
    parser.add_argument("--sampler", nargs=2, metavar=("N", "ENGINE"), help="fit N with a sampler")
    args = parser.parse_args()
    table, bands = sample(Path(os.environ["MIRICIGALE_DATA"]) / "ceers/ceers_photometry_part.fits")
    if args.n:
        table = table[np.sort(np.random.default_rng(1).permutation(len(table))[: args.n])]
    start = time.process_time()
    if args.grid and args.grid.exists():
        grid = ModelGrid.read(args.grid)
    else:
        grid = SEDModel.survey().grid(SEDModel.survey_axes(), bands)
        if args.grid:
            grid.write(args.grid)
    print(f"{grid}, {time.process_time() - start:.0f} s")
    if args.sampler:
        compare(table, grid, int(args.sampler[0]), args.sampler[1])
        return
    halves = [table[h::2] for h in (0, 1)]
    found = [calibrated(grid, bands, half, args.flat) for half in halves]
    print("band, factor of each half")
    for a, b in zip(found[0][2], found[1][2], strict=True):
        print(f"  {a['band']:14s} {a['factor']:.3f} {b['factor']:.3f} +- {a['factor_err']:.3f}")
    for factor, part in (one[1] for one in found):
        print(f"errors of MIRI: {factor:.2f} times those of the catalog and {100 * part:.0f} %")
    optical = [b for b in bands if not b.startswith("miri")]
    true = np.concatenate([np.asarray(half["redshift"], float) for half in halves])
    steps = true / 0.025
    apart = np.abs(steps - np.round(steps)) > 1e-3
    whole = np.ones(true.size, bool)
    joined = {name: np.concatenate([half[name] for half in halves]) for name in table.colnames}
    print("\n                                      n     bias sigma_MAD  out.,%  in 68 %")
    for label, used in (("HST, NIRCam", optical), ("HST, NIRCam, MIRI", bands)):
        parts, mocks, known, times, spent = [], [], [], [], 0.0
        for h, half in enumerate(halves):
            error, (factor, part), points, priors = found[1 - h]
            half = with_errors(apply_zero_points(half, points), factor)
            own = {name: part if name.startswith("miri") else 0.0 for name in used}
            fitter = BayesFitter(grid, used, model_error=own, template_error=error, priors=priors)
            start = time.process_time()
            parts.append(fitter.fit(half))
            spent += time.process_time() - start
            if args.times:
                times.extend(time_each(fitter, half))
            if args.mocks:
                mock = mock_analysis(fitter, parts[-1], half, seed=1, model_error=True)
                mocks.append(mock.recovered)
                at = {"redshift": "redshift"}
                fit = fitter.fit(half, **at)
                known.append(mock_analysis(fitter, fit, half, seed=1, model_error=True, **at))
        results = FitResults.concatenate(parts)
        row(label, results, true, whole)
        row("  redshifts not in steps of 0.025", results, true, apart)
        row("  in steps", results, true, ~apart)
        mean = 1e3 * spent / len(true)
        print(
            f"  {mean:.0f} ms of CPU an object; reduced chi2 {np.median(results.reduced_chi2):.2f}"
        )
        if args.times:
            print(
                f"  one by one: median {np.median(times):.0f} ms, 95 % {np.quantile(times, 0.95):.0f} ms"
            )
            time_known(grid, used, table)
        groups = {"": parts, " of mocks": mocks}
        groups |= {" at known redshifts": [one.truth for one in known]}
        groups |= {" of mocks at known redshifts": [one.recovered for one in known]}
        for what, some in groups.items():
            if some:
                one = FitResults.concatenate(some)
                below, above = chi2_parts(one, bands, whole)
                text = f"{below:.2f} below 3 um, {above:.2f} above"
                print(f"  median of mean squared pulls{what}: {text}")
    print("\nworst tenth, with MIRI: medians                  all")
    worst_tenth(results, joined, bands, true)
    if args.times:
        model = SEDModel.yang2021(libraries="bundled")
        n_models = model.grid(SEDModel.yang2021_axes(), ["wfc3.f160w"]).n_allowed
        seconds = loop_time(None, n_models, 21)
        print(f"plain loop over the grid of Yang et al. 2021: {seconds:.2f} s an object")
    error = np.mean([one[0](found[0][0].wave) for one in found], axis=0)
    print("TemplateError.survey", found[0][0].wave.value.round(2).tolist(), error.round(3).tolist())
    if not args.flat:
        for name in found[0][3]:
            print(name, np.mean([one[3][name] for one in found], axis=0).round(3).tolist())


if __name__ == "__main__":
    main()
