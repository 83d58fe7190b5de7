"""
What says how far a fit of real sources can be trusted: odds, pulls of bands left out, AGN, and little red dots.

    python benchmarks/trust.py FOLDER [--grid GRID] [odds] [pulls] [agn] [dots]

FOLDER has the folders ceers, stardust, cigale_seyferts and lrd with the files that are read below; GRID is the
grid of `SEDModel.survey` in the bands of CEERS, made if it is not there. Errors are those of
`SurveyCalibration.survey`, 10 % of the flux with far-infrared bands.

odds: sources with S/N above 5 in seven bands, by `redshift_odds`: outliers, and expected ones.
pulls: up to 100 sources of S/N above 5 a band: scatter of pulls of `leave_out`, and of `left_out_pulls`.
agn: at known redshift, with flat fractions and `agn_fraction_prior`: median fraction, sources with more than 0.4,
those of them with a ratio of evidences of AGN above 5 and 150 (posterior odds of a fraction above 0 over the
prior's), and all with a ratio above 5.
dots: little red dots of COSMOS-Web, and sources of CEERS, as galaxies and as little red dots: classes, and
redshifts of the classes against published ones.
"""

import argparse
import itertools
import time
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table
from far_infrared import read as read_stardust

from miricigale import BayesFitter, SEDModel
from miricigale.cigale import read_cigale_results, read_pcigale_ini
from miricigale.evaluation import photoz_metrics
from miricigale.filters import read_catalog_photometry
from miricigale.fitting import (
    FitFlags,
    GridSettings,
    MassFunction,
    SurveyCalibration,
    agn_fraction_prior,
    compare_classes,
    leave_out,
    red_dot_prior,
)
from miricigale.fitting.results.pulls import left_out_pulls
from miricigale.sed import ModelGrid, red_dot_axes, red_dots, template_grid

ERRORS = {"model_error": 0.0, "template_error": SurveyCalibration.survey().template_error}
DOT_BANDS = {
    "814": "acs.f814w", "115": "nircam.f115w", "150": "nircam.f150w", "277": "nircam.f277w",
    "444": "nircam.f444w", "770": "miri.f770w",
}  # fmt: skip


def ceers(folder):
    """Sources of S/N above 5 in seven bands, their bands, S/N, and which have it in two MIRI bands."""
    table = read_catalog_photometry(folder / "ceers/ceers_photometry_part.fits", "ceers")
    bands = [name for name in table.colnames if f"{name}_err" in table.colnames]
    for name in bands:
        bad = ~(np.array(table[f"{name}_err"]) > 0)
        table[name][bad] = table[f"{name}_err"][bad] = np.nan
    signal = np.array([np.nan_to_num((table[b] / table[f"{b}_err"]).value) for b in bands])
    miri = np.array([b.startswith("miri") for b in bands])
    z = np.array(table["redshift"], float)
    good = ((signal > 5).sum(0) >= 7) & (z > 0.1) & (z < 5.5)
    return table[good], bands, signal[:, good], ((signal[miri] > 5).sum(0) >= 2)[good]


def odds(grid, data):
    table, bands, _, two = data
    z = np.array(table["redshift"], float)
    edges = [0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.001]
    for label, names in (("without", [b for b in bands if b[:4] != "miri"]), ("with", bands)):
        for part in (None, 0.05):
            results = BayesFitter(grid, names, outliers=part, **ERRORS).fit(table)
            off = np.abs(results.median("redshift").value - z) / (1 + z) > 0.15
            own = results.redshift_odds
            for what, some in (("all", np.ones(z.size, bool)), ("two MIRI", two)):
                print(
                    f"{what}, {label} MIRI, outliers={part}: {100 * off[some].mean():.1f} % outliers, "
                    f"expected {100 * (1 - own[some].mean()):.1f} %"
                )
                for low, high in itertools.pairwise(edges):
                    rows = some & (own >= low) & (own < high)
                    print(f"  {low:.2f} {rows.sum():5d} {100 * off[rows].mean():5.1f} %")


def pulls(grid, data):
    table, bands, signal, _ = data
    fitter, rng = BayesFitter(grid, bands, **ERRORS), np.random.default_rng(1)
    for name, own in zip(bands, signal, strict=True):
        rows = np.flatnonzero(own > 5)
        if rows.size < 30:
            continue
        rows = np.sort(rng.choice(rows, min(100, rows.size), replace=False))
        left, i = leave_out(fitter, table[rows], [name]), fitter.bands.index(name)
        results = fitter.fit(table[rows])
        start = time.process_time()
        ours = left_out_pulls(results)[:, i]
        ms = 1e3 * (time.process_time() - start) / rows.size
        error = np.hypot(results.sigma[:, i], left.predicted_std[:, 0])
        theirs = (left.flux - left.predicted)[:, 0] / error
        both = [1.4826 * np.nanmedian(np.abs(one)) for one in (theirs, ours)]
        print(f"{name:14s} {rows.size:4d} {both[0]:.2f} {both[1]:.2f} ({ms:.3f} ms an object)")


def agn_line(label, results, prior, rows=None):
    """Print what a fit says of AGN."""
    rows = results.fitted if rows is None else rows & results.fitted
    none = np.maximum(results.pdf["frac_agn"][rows, 0], 1e-300)
    ratio = (1 - none) / none * prior[0] / (1 - prior[0])
    middle = results.median("frac_agn").value[rows]
    high = middle > 0.4
    print(
        f"{label:44s} {rows.sum():4d} {np.median(middle):.3f} {100 * high.mean():5.1f} % "
        f"{100 * np.mean(high & (ratio > 5)):5.1f} % {100 * np.mean(high & (ratio > 150)):5.1f} % "
        f"ratio alone {100 * np.mean(ratio > 5):5.1f} %",
        flush=True,
    )


def agn(grid, data, folder):
    table, bands, _, two = data
    far, far_bands, _ = read_stardust(folder / "stardust")
    theirs = Table.read(folder / "stardust/stardust_results_100.fits")
    share = dict(zip(theirs["ID"], theirs["f_agn"], strict=True))
    share = np.array([share[key] for key in far["id"]])
    run = folder / "cigale_seyferts/group1_0a90"
    setup = read_pcigale_ini(run / "pcigale.ini")
    seyferts = setup.catalog(run / setup.data_file.name)
    cigale = np.array(read_cigale_results(run / "results.fits")["bayes.agn.fracAGN"])
    near = SEDModel.survey_axes("far-infrared") | {"redshift": np.geomspace(1.001, 1.3, 60) - 1}
    # type 1 and 2
    near |= {"inclination": [30.0, 70.0], "frac_agn": [0.0, 0.1, 0.3, 0.5, 0.7, 0.9]}
    seyfert_bands = [b for b in seyferts.colnames if f"{b}_err" in seyferts.colnames]
    model = SEDModel.survey()
    axes = SEDModel.survey_axes("far-infrared")
    cosmos = BayesFitter(model, far_bands, axes=axes)
    local = BayesFitter(model, seyfert_bands, axes=near)
    plain = BayesFitter(grid, bands, **ERRORS)
    for kind in ("flat", "prior"):

        def prior(fitter, kind=kind):
            nodes = fitter.grid.frac_agn
            weights = np.full(nodes.size, 1 / nodes.size)
            return weights if kind == "flat" else agn_fraction_prior(nodes)

        def fit(fitter, some, name, prior=prior):
            return fitter.replace(priors={"frac_agn": prior(fitter)}).fit(some, redshift=name)

        found = fit(cosmos, far, "z")
        agn_line(f"COSMOS, far-infrared, {kind}", found, prior(cosmos))
        agn_line(f"  Stardust's f_agn < 0.05, {kind}", found, prior(cosmos), share < 0.05)
        found = fit(plain, table[two], "redshift")
        agn_line(f"CEERS, two MIRI bands, {kind}", found, prior(plain))
        found = fit(local, seyferts, "redshift")
        for low, high in ((0.0, 0.2), (0.2, 0.4), (0.4, 1.0)):
            rows = (cigale >= low) & (cigale < high)
            label = f"Seyferts, CIGALE's fracAGN {low:g}-{high:g}, {kind}"
            agn_line(label, found, prior(local), rows)


def read_dots(path):
    """Little red dots: their table, and photometry."""
    raw = Table.read(path)
    table = QTable({"id": np.array(raw["id"])})
    for key, name in DOT_BANDS.items():
        magnitude, signal = (np.array(raw[f"{n}{key}"], float) for n in ("m", "snr"))
        seen = (magnitude > 0) & (signal > 0)
        flux = np.where(seen, 10 ** (0.4 * (23.9 - magnitude)), np.nan)
        error = np.where(seen, flux / signal, np.nan)
        # negative fluxes have no magnitude: S/N times the median error
        low = ~seen & (signal > -90)
        error[low] = np.nanmedian(error)
        flux[low] = (signal * error)[low]
        table[name], table[f"{name}_err"] = flux * u.uJy, error * u.uJy
    return raw, table


def dots(grid, data, folder):
    raw, table = read_dots(folder / "lrd/cosmosweb_lrds_every7th.ecsv")
    names = list(DOT_BANDS.values())
    # evidences are those of the nodes in any case
    alone = GridSettings(interpolate=0)
    settings = GridSettings(interpolate=0, mass_function=MassFunction())
    known = {"priors": {"frac_agn": agn_fraction_prior(grid.frac_agn)}, "settings": settings}
    for label, some, bands in (("red dots", table, names), ("CEERS", data[0], data[1])):
        z = red_dot_axes()["redshift"]
        shapes = template_grid(red_dots(), bands, redshift=z)
        prior = {"redshift": red_dot_prior(z)}
        dot = BayesFitter(shapes, bands, priors=prior, settings=alone, **ERRORS).fit(some)
        for kind, options in (("flat", {"settings": alone}), ("priors", known)):
            found = BayesFitter(grid, bands, **ERRORS, **options).fit(some)
            classes = compare_classes({"galaxy": found, "red_dot": dot})
            ratio, z = classes["log_ratio_red_dot"], found.median("redshift").value
            mass = np.log10(found.median("stellar_mass").value)
            called, low = classes["class"] == "red_dot", (found.flags & FitFlags.LOW_MASS) > 0
            print(
                f"{label}, {kind}: {len(some)}; galaxies at z < 1 {np.sum(z < 1)}, log M {np.median(mass):.1f}; "
                f"red dots {called.sum()}, beyond 150 to 1 {np.sum(ratio > 5)}, "
                f"of z < 1 {np.sum(called & (z < 1))}, "
                f"flagged {low.sum()}, neither of z < 1 {np.sum(~called & ~low & (z < 1))}",
            )
            if label == "CEERS":
                true = np.array(some["redshift"], float)
                off = np.abs(z - true) / (1 + true) > 0.15
                print(f"  outliers {off.mean():.3f}, of those flagged {off[low].mean():.3f}")
                for edge in (6, 6.5, 7):
                    rows = mass < edge
                    print(f"  log M < {edge}: {rows.sum()}, outliers {off[rows].mean():.2f}")
            else:
                theirs = np.array(raw["z_qso_med"], float)
                mine = classes["redshift_p50"]
                low, high = classes["redshift_p16"], classes["redshift_p84"]
                scores = photoz_metrics(theirs, mine)
                inside = np.mean((low <= theirs) & (theirs <= high))
                edge = np.sum((classes["flags"] & FitFlags.REDSHIFT_EDGE) > 0)
                print(
                    f"  redshift of the class against the published: bias {scores.bias:+.3f}, sigma_MAD "
                    f"{scores.sigma_mad:.3f}, beyond 0.15 {scores.outlier_fraction:.2f}, inside 16-84 % "
                    f"{inside:.2f}, at the edge of the axis {edge}"
                )
                print("  log M <6, <6.5, <7:", *[np.sum(mass < edge) for edge in (6, 6.5, 7)])


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("parts", nargs="*", default=["odds", "pulls", "agn", "dots"])
    parser.add_argument("--grid", type=Path)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    data = ceers(args.folder)
    if args.grid and args.grid.exists():
        grid = ModelGrid.read(args.grid)
    else:
        grid = SEDModel.survey().grid(SEDModel.survey_axes(), data[1])
    for part in args.parts:
        print(part)
        more = (args.folder,) if part in ("agn", "dots") else ()
        {"odds": odds, "pulls": pulls, "agn": agn, "dots": dots}[part](grid, data, *more)


if __name__ == "__main__":
    main()
