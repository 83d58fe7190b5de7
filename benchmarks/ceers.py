"""
Redshifts of real galaxies with `SEDModel.survey`: CEERS sources in HST, NIRCam and MIRI bands.

    MIRICIGALE_DATA=../shared/data python benchmarks/ceers.py [--n 386] [--grid grid.fits] [--zero-points]

The catalog is the part of that of Lisiecki et al. 2025 in $MIRICIGALE_DATA/ceers; of it sources with S/N above
5 in two MIRI bands and five others. Most of the published redshifts are photometric, many in steps of 0.025: those
that are not (spectra and grisms among them) are shown apart. Template error, errors of the MIRI bands (which the
catalog measured apart) and zero points are measured on one half and used on the other, and the other way round;
``--preset`` takes `TemplateError.survey` instead, which was measured on all of them. Zero points are printed, and
applied with ``--zero-points`` only.
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std

from miricigale.filters import FilterSet, read_catalog_photometry
from miricigale.fitting import (
    BayesFitter,
    FitResults,
    TemplateError,
    apply_zero_points,
    calibrate_zero_points,
    measure_band_errors,
    measure_template_error,
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


def calibrated(grid, bands, table):
    """
    Template error, errors of MIRI bands and zero points of sources at their published redshifts.

    Of one fit with errors of 10 % (30 % in MIRI): where the errors found are those of the next fit they shrink
    from fit to fit, as those of the bands that a fit follows best are taken for small.
    """
    miri = [b for b in bands if b.startswith("miri")]
    start = {b: 0.3 if b in miri else 0.1 for b in bands}
    fit = BayesFitter(grid, bands, model_error=start).fit(table, redshift="redshift")
    points = calibrate_zero_points(fit, reference="wfc3.f160w")
    own = measure_band_errors(fit, measure_template_error(fit), miri)
    return measure_template_error(fit, model_error=own), own, points


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


def worst_tenth(results, table, bands, true):
    """What the tenth with the largest errors in redshift has in common: medians of it and of all."""
    middle = results.percentile("redshift", 0.5).value.reshape(-1)
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


def main():
    """Print the tables."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--n", type=int, help="sources, drawn at random (all)")
    parser.add_argument("--grid", type=Path, help="keep the grid in this file")
    parser.add_argument("--preset", action="store_true", help="TemplateError.survey for all")
    parser.add_argument("--zero-points", action="store_true", help="apply those of the other half")
    parser.add_argument("--miri-error", type=float, help="of all MIRI bands (those measured)")
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
    halves = [table[h::2] for h in (0, 1)]
    found = [calibrated(grid, bands, half) for half in halves]
    print("band, factor of each half")
    for a, b in zip(found[0][2], found[1][2], strict=True):
        print(f"  {a['band']:14s} {a['factor']:.3f} {b['factor']:.3f} +- {a['factor_err']:.3f}")
    print("errors of bands that are not the models', of each half")
    for name in found[0][1]:
        print(f"  {name:14s} " + " ".join(f"{one[1][name]:.3f}" for one in found))
    print("rest wavelength in um, template error of each half")
    for wave in sorted({*found[0][0].wave.value, *found[1][0].wave.value}):
        print(f"  {wave:6.2f} " + " ".join(f"{one[0](wave * u.um):.3f}" for one in found))
    optical = [b for b in bands if not b.startswith("miri")]
    true = np.concatenate([np.asarray(half["redshift"], float) for half in halves])
    steps = true / 0.025
    apart = np.abs(steps - np.round(steps)) > 1e-3
    whole = np.ones(true.size, bool)
    joined = {name: np.concatenate([half[name] for half in halves]) for name in table.colnames}
    print("\n                                      n     bias sigma_MAD  out.,%  in 68 %")
    for label, used in (("HST, NIRCam", optical), ("HST, NIRCam, MIRI", bands)):
        parts, times = [], []
        for h, half in enumerate(halves):
            error, own, points = found[1 - h]
            error = TemplateError.survey() if args.preset else error
            half = apply_zero_points(half, points) if args.zero_points else half
            if args.miri_error is not None:
                own = dict.fromkeys(own, args.miri_error)
            own = {name: own.get(name, 0.0) for name in used}
            fitter = BayesFitter(grid, used, model_error=own, template_error=error)
            start = time.process_time()
            parts.append(fitter.fit(half))
            times.append(time.process_time() - start)
        results = FitResults.concatenate(parts)
        row(label, results, true, whole)
        row("  redshifts not in steps of 0.025", results, true, apart)
        below, above = chi2_parts(results, bands, whole)
        print(
            f"  {1e3 * sum(times) / len(true):.0f} ms of CPU an object; median of mean squared pulls "
            f"{below:.2f} below 3 um, {above:.2f} above; reduced chi2 {np.median(results.reduced_chi2):.2f}"
        )
    print("\nworst tenth, with MIRI: medians                  all")
    worst_tenth(results, joined, bands, true)


if __name__ == "__main__":
    main()
