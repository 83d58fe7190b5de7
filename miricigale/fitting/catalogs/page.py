"""The page of a fitted catalog: redshifts, how well models fit, fractions, examples, what was left out."""

import dataclasses
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.evaluation import photoz_metrics
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.filters.catalog_files import MappedRows
from miricigale.fitting import FitFlags
from miricigale.fitting.catalogs.catalog_rows import open_catalog
from miricigale.fitting.catalogs.classes import classes_of, classes_section
from miricigale.fitting.catalogs.page_numbers import fit_numbers, known_redshifts
from miricigale.fitting.data.likelihood import unused_bands
from miricigale.fitting.results.drawing import fitted_curves
from miricigale.fitting.results.object_plots import draw_objects
from miricigale.pages import Page, SectionWriter
from miricigale.plotting.axes import WIDTH, new_figure, plain_text
from miricigale.plotting.comparison import plot_redshifts
from miricigale.utils.package_tables import declared

#: Examples on the page, and points in a drawing.
_EXAMPLES, _POINTS = 6, 5000
#: Objects of a longer catalog whose numbers are on the page, spread evenly over it: half of them at least.
_MOST = 400_000
_COLOR, _SECOND = "#1d4ed8", "#c2410c"
#: Fluxes in a band for which a median is drawn.
_FEW = 5
#: Letters of a setting that are shown.
_LONG = 200
#: Least AGN fraction, by the posterior's median, of a selected AGN.
_AGN = CLASS_LIMITS[1]
#: Reduced chi2 of a poor fit, and part of the objects with it, or at an end of the redshifts, from which that is a
#: notice.
_POOR, _WIDESPREAD = 10.0, 0.1


def fit_page(results, path, *, catalog_map=None, hdu=None, z_spec=None):
    """
    Make the page of a fitted catalog.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResultsFiles` or dict of it
        What `~miricigale.fitting.fit_catalog` returned, or
        `~miricigale.fitting.catalogs.classes.fit_classes`: then the page has a section on the classes.
    path : path-like
        The catalog that was fitted.
    catalog_map, hdu : optional
        As for the fit.
    z_spec : str, optional
        Column of known redshifts to compare with; by default the first of `KNOWN_REDSHIFTS` that is there.

    Returns
    -------
    page : `~miricigale.pages.Page`
        ``page.write(path)`` writes it, one HTML file.

    Raises
    ------
    ValueError
        If the catalog has no column ``z_spec``.
    """
    # what measures it loads the models
    from miricigale.fitting.catalogs.catalog_calibration import measured_calibration

    classes = results if isinstance(results, dict) else {"galaxy": results}
    results = classes["galaxy"]
    job = results.job
    names = {"catalog_map": catalog_map, "flux_unit": job["catalogue"]["flux_unit"]}
    rows = open_catalog(path, job["chunk_rows"], hdu=hdu, **names)
    step = max(1, -(-len(results) // _MOST))
    found = every = fit_numbers(results, step)
    found.meta["known"], found["z_known"] = known_redshifts(rows, z_spec, step)
    columns = classes_of(classes, step) if len(classes) > 1 else None
    with_redshift = found
    if columns is not None:
        # of the fits of the classes, as in the table
        found["flags"] = columns["flags"]
        with_redshift = _of_classes(found, columns)
        # fits of stars and quasars with galaxies say nothing about the fit
        found = found[np.isin(columns["class"], ["galaxy", ""])]
    subtitle = f"{len(results)} objects, {len(found.meta['filters'])} bands"
    report = Page(f"Fits of {Path(path).name}", subtitle=subtitle)
    page = SectionWriter(report, declared("miricigale.fitting"))
    if step > 1:
        page.notice("thinned", step=step, n=len(every))
    _notices(page, found)
    others = " or ".join(list(classes)[1:])
    facts = {"n": len(found), "n_all": len(every), "others": others}
    page.section("summary", "classes" if others else "text", **facts)
    _summary(page, found)
    if columns is not None:
        classes_section(page, columns, list(classes), every["ids"])
    _redshifts(page, with_redshift, "classes" if others else "text")
    _calibration(page, measured_calibration(results))
    curves = fitted_curves(next(iter(results.parts())))
    _goodness(page, found, curves)
    _physics(page, found)
    _examples(page, results, every, step, curves)
    _left_out(page, rows, every)
    _settings(page, results)
    return page.report


def _of_classes(found, columns):
    """Numbers of all objects but stars with the redshifts of their classes."""
    out = found.copy()
    if not found.meta["fixed"]:
        names = [f"redshift_{level}" for level in ("p16", "p50", "p84")]
        out["z"] = np.column_stack([columns[name] for name in names])
    return out[columns["class"] != "star"]


def _bands(found):
    """Iterate over bands: name, and finite flux ratios and pulls of all objects."""
    columns = (found.meta["filters"], found["ratio"].T, found["pull"].T)
    for name, ratio, pull in zip(*columns, strict=True):
        yield name, ratio[np.isfinite(ratio)].astype(float), pull[np.isfinite(pull)]


def _notices(page, found):
    good = found["good"]
    if len(found) and not good.any():
        page.notice("nothing")
        return
    poor = found["chi2"][good] > _POOR
    edge = found["flags"][good] & int(FitFlags.REDSHIFT_EDGE) != 0
    for name, some in (("high_chi2", poor), ("redshift_edge", edge)):
        share = _mean(some)
        if share > _WIDESPREAD:
            page.notice(name, share=100 * share, limit=_POOR)
    for name, ratio, _ in _bands(found):
        if ratio.size >= 30 and not 0.8 < np.median(ratio) < 1.25:
            page.notice("band", band=name, ratio=np.median(ratio), n=ratio.size)


def _summary(page, found):
    good = found[found["good"]]
    values = {"n": len(found), "n_good": len(good), "n_clean": np.count_nonzero(good["flags"] == 0)}
    values |= {"n_bands": _median(good["n_bands"]), "chi2": _median(good["chi2"])}
    if not found.meta["fixed"]:
        low, z, high = good["z"].T
        values |= {"z": _median(z), "width": _median((high - low) / 2 / (1 + z))}
    if np.isfinite(found["frac"]).any():
        values["agn"] = _mean(good["frac"][:, 1] >= _AGN)
    page.items(values, agn_limit=_AGN)


def _median(values):
    values = values[np.isfinite(values)]
    return np.median(values) if len(values) else np.nan


def _mean(values):
    return np.mean(values) if len(values) else np.nan


def _draw_counts(ax, xlabel, bins, samples):
    """Draw histograms of samples by label, the first filled, the others as outlines."""
    for k, (label, values) in enumerate(samples.items()):
        style = {"histtype": "step", "color": _COLOR} if k else {"color": "0.75"}
        ax.hist(values, bins, label=plain_text(label), **style)
    if len(samples) > 1:
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel=xlabel, ylabel="objects")


def _redshifts(page, found, text):
    page.section("redshifts", "given" if found.meta["fixed"] else text)
    if found.meta["fixed"]:
        return
    samples = {"fitted": found["z"][found["good"], 1]}
    some, name = found["good"] & np.isfinite(found["z_known"]), found.meta["known"]
    figure, axes = new_figure(1, 1 + some.any(), size=(WIDTH / 2, 4.2))
    if some.any():
        z, (low, middle, high) = found["z_known"][some], found["z"][some].T
        metrics = dataclasses.asdict(photoz_metrics(z, middle))
        page.items(metrics | {"n": len(z), "inside": np.mean((low <= z) & (z <= high))}, name=name)
        step = _step(len(z))
        plot_redshifts(z[::step], middle[::step], ax=axes[0, 0])
        axes[0, 0].set(xlabel=plain_text(name), ylabel="fitted redshift (median)")
        samples[name] = z
    bins = np.histogram_bin_edges(np.concatenate(list(samples.values())), 40)
    _draw_counts(axes[0, -1], "redshift", bins, samples)
    page.figure("compared" if some.any() else "alone", figure, name=name)


def _calibration(page, calibration):
    """What was measured on the catalog: redshifts of halves, where they were known, and the bands."""
    if calibration is None:
        return
    by_redshifts = calibration.scores is not None
    page.section("calibration", "text" if by_redshifts else "bands_only", name=calibration.name)
    if by_redshifts:
        page.table("scores", _rows(calibration.scores))
    rows = _rows(calibration.bands)
    for row in rows:
        if row["zero_point_err"] == 0:
            row["zero_point_err"] = np.nan
        if row["n"] == 0:
            row |= {"n": "prior", "zero_point_err": np.nan, "wrong": np.nan}
    page.table("bands", rows)


def _rows(table):
    return [dict(zip(table.colnames, row, strict=True)) for row in table.iterrows()]


def _step(n):
    """Every so many of n points are drawn."""
    return max(1, n // _POINTS)


def _goodness(page, found, curves):
    page.section("goodness")
    figure, ((ax, of_bands),) = new_figure(1, 2, size=(WIDTH / 2, 3.6))
    chi2, bins = found["chi2"][found["good"]], np.geomspace(1e-2, 1e3, 51)
    label = "reduced chi2 (those beyond in the outermost bins)"
    _draw_counts(ax, label, bins, {"": np.clip(chi2, 1e-2, 1e3)})
    ax.set(xscale="log")
    if len(chi2):
        ax.axvline(np.median(chi2), color=_COLOR, lw=1, label="median")
        ax.legend(frameon=False)
    rows = []
    pivots = {one.name: float(one.pivot.value) for one in curves}
    for name, ratio, pull in sorted(_bands(found), key=lambda band: pivots[band[0]]):
        low, middle, high = np.percentile(ratio, [16, 50, 84]) if ratio.size else [np.nan] * 3
        if ratio.size >= _FEW:
            limits = [[middle - low], [high - middle]]
            of_bands.errorbar(len(rows), middle, limits, fmt="o", color=_COLOR, ms=4, lw=1)
        row = {"band": name, "um": pivots[name], "n": ratio.size}
        row |= {"low": low, "middle": middle, "high": high}
        rows.append(row | {"pull": _median(pull), "beyond": _mean(np.abs(pull) > 3)})
    of_bands.axhline(1.0, color="0.6", lw=0.8)
    names = [plain_text(row["band"]) for row in rows]
    of_bands.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    of_bands.set(ylabel="flux over that of the best model", ylim=(0.4, 1.8))
    page.figure("figure", figure, few=_FEW)
    page.table("table", rows)


def _physics(page, found):
    found = found[found["good"] & (found["mass"][:, 1] > 0)]
    with_agn = np.isfinite(found["frac"]).any()
    if not len(found):
        return
    page.section("physics", and_agn=" and AGN" if with_agn else "")
    figure, axes = new_figure(1, 1 + with_agn, size=(WIDTH / 2, 3.6))
    drawn, ax = found[:: _step(len(found))], axes[0, 0]
    mass, strong = np.log10(drawn["mass"][:, 1]), drawn["frac"][:, 1] >= _AGN
    groups = {"others": (~strong, "0.6" if with_agn else _COLOR)}
    groups |= {f"fracAGN at least {_AGN:g}": (strong, _SECOND)} if with_agn else {}
    for label, (rows, color) in groups.items():
        ax.plot(drawn["z"][rows, 1], mass[rows], ".", ms=4, color=color, label=label)
    low, high = np.percentile(mass, [0.5, 99.5])
    ax.set(xlabel="redshift", ylabel="log stellar mass (Msun)", ylim=(low - 0.5, high + 0.5))
    if with_agn:
        ax.legend(frameon=False, fontsize=8)
        samples = {"posterior median": found["frac"][:, 1], "16th percentile": found["frac"][:, 0]}
        _draw_counts(axes[0, 1], "fracAGN", np.linspace(0, 1, 26), samples)
        axes[0, 1].set(yscale="log")
    page.figure("figure", figure, and_fractions=" and AGN fractions" if with_agn else "")
    if with_agn:
        page.text("agn")


def _examples(page, results, found, step, curves):
    chosen = _choose(found)
    if not chosen:
        return
    page.section("examples")
    picked = list(results[np.array([step * row for row, _ in chosen])])
    titles = []
    for (_, what), one in zip(chosen, picked, strict=True):
        z = "" if found.meta["fixed"] else f"z = {one.best['redshift'].value:.2f}, "
        chi2 = f"reduced chi2 {one.reduced_chi2:.2f}"
        titles.append(f"{plain_text(one.ids)}: {z}{chi2} ({what})")
    page.figure("figure", draw_objects(picked, curves, titles))


def _choose(found):
    """Rows to be shown, and why: spread over chi2, and the strongest AGN."""
    rows = np.flatnonzero(found["good"])
    if not rows.size:
        return []
    some = found[rows]
    order = rows[np.argsort(some["chi2"], kind="stable")]
    places = {0.1: "a good fit", 0.5: "median chi2", 0.9: "worst tenth", 1.0: "the worst fit"}
    chosen = {}
    for place, what in places.items():
        chosen.setdefault(int(order[int(place * (order.size - 1))]), what)
    selected = some["frac"][:, 1] >= _AGN
    if selected.any():
        # the one whose fraction is highest for certain
        surest = np.where(selected, some["frac"][:, 0], -1.0)
        chosen.setdefault(int(rows[np.argmax(surest)]), "surest AGN")
    high = np.where(some["flags"] == 0, some["z"][:, 0], -1.0)
    if high.max() > 0 and not found.meta["fixed"]:
        chosen.setdefault(int(rows[np.argmax(high)]), "highest redshift without a flag")
    return list(chosen.items())[:_EXAMPLES]


def _left_out(page, rows, found):
    page.section("left_out")
    filters, bad = found.meta["filters"], found["unusable"].sum(axis=0)
    lines = {
        "unused": unused_bands(rows.chunk(0), list(filters)),
        "empty": [name for name, ratio, _ in _bands(found) if not ratio.size],
        "errors": [f"{name} {n}" for name, n in zip(filters, bad, strict=True) if n],
    }
    if "wrong" in found.colnames:
        wrong = zip(filters, found["wrong"].sum(axis=0), strict=True)
        lines["wrong"] = [f"{name} {n}" for name, n in wrong if n]
    entries = list(rows.messages()) if isinstance(rows, MappedRows) else []
    entries += [page.sentence(k, names=", ".join(names)) for k, names in lines.items() if names]
    page.report.bullets(entries or [page.sentence("nothing")])
    counts = [{"flag": "none", "meaning": "", "objects": np.count_nonzero(found["flags"] == 0)}]
    for value, (name, meaning) in FitFlags.meanings().items():
        n = np.count_nonzero(found["flags"] & value)
        if n:
            fitted = "" if not value & int(FitFlags.UNFITTED) else " Not fitted."
            counts.append({"flag": f"{value} {name}", "meaning": meaning + fitted, "objects": n})
    page.table("flags", counts)


def _settings(page, results):
    page.section("settings")
    first = next(iter(results.parts()))
    settings = {name: v for name, v in first.meta.get("fit", {}).items() if name != "filters"}
    if results.model is not None:
        settings |= results.model.recipe
    rows = {name: _plain(value) for name, value in settings.items()}
    for name, axis in first.axes.items():
        ends = f"from {axis.values[0]:g} to {axis.values[-1]:g} {u.Unit(axis.unit)}"
        rows[f"axis {name}"] = f"{axis.values.size} {ends}".strip()
    shorten = {name: f"{text[:_LONG]} ..." for name, text in rows.items() if len(text) >= _LONG}
    page.report.table((rows | shorten).items(), header=("", ""), text=2)


def _plain(value):
    if isinstance(value, dict):
        different = set(map(str, value.values()))
        if len(different) == 1:
            return f"{different.pop()} in all bands"
        return ", ".join(f"{name} {v}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(map(str, value)) or "none"
    return str(value)
