"""The page of a fitted catalog: redshifts, how well models fit, fractions, examples, what was left out."""

import dataclasses
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.evaluation import photoz_metrics
from miricigale.evaluation.classes import CLASS_LIMITS
from miricigale.filters.catalog_files import MappedRows
from miricigale.fitting import FitFlags
from miricigale.fitting.catalogs.browser import browser_step, write_browser
from miricigale.fitting.catalogs.catalog_rows import open_catalog
from miricigale.fitting.catalogs.classes import classes_of, classes_section
from miricigale.fitting.catalogs.page_numbers import fit_numbers, known_redshifts
from miricigale.fitting.data.likelihood import unused_bands
from miricigale.fitting.results.drawing import fitted_curves
from miricigale.fitting.results.object_plots import draw_objects
from miricigale.pages import Link, Page, SectionWriter
from miricigale.plotting.axes import WIDTH, new_figure, plain_text
from miricigale.plotting.comparison import plot_redshifts
from miricigale.utils.arrays import finite_values, thinning_step
from miricigale.utils.named_values import convert_values, without
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import row_dicts

#: Largest number of examples on the page.
_N_EXAMPLES = 6
#: Largest number of points in a drawing.
_MAX_POINTS = 5000
#: Objects of a longer catalog whose numbers are on the page, spread evenly over it: half of them at least.
_MAX_OBJECTS = 400_000
_FIRST_COLOR = "#1d4ed8"
_SECOND_COLOR = "#c2410c"
#: Fluxes in a band for which a median is drawn.
_MIN_FLUXES = 5
#: Letters of a setting that are shown.
_MAX_LETTERS = 200
#: Least AGN fraction, by the posterior's median, of a selected AGN.
_AGN_LIMIT = CLASS_LIMITS[1]
#: Reduced chi2 of a poor fit.
_POOR_CHI2 = 10.0
#: Part of the objects with a poor fit, or at an end of the redshifts, above which the page has a notice.
_NOTICE_SHARE = 0.1


def fit_page(results, path, *, catalog_map=None, hdu=None, z_spec=None, browser=None):
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
    browser : path-like, optional
        Where the page will be written: a page that shows the objects one by one is written beside it, as
        ``sources.html`` with a folder ``sources``, and linked.

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

    if isinstance(results, dict):
        classes = results
    else:
        classes = {"galaxy": results}
    results = classes["galaxy"]
    job = results.job
    rows = open_catalog(
        path,
        job["chunk_rows"],
        hdu=hdu,
        catalog_map=catalog_map,
        flux_unit=job["catalogue"]["flux_unit"],
    )
    step = thinning_step(len(results), _MAX_OBJECTS)
    all_numbers = fit_numbers(results, step)
    numbers = all_numbers
    numbers.meta["known"], numbers["z_known"] = known_redshifts(rows, z_spec, step)
    columns = None
    if len(classes) > 1:
        columns = classes_of(classes, step)
    with_redshift = numbers
    text = "text"
    if columns is not None:
        text = "classes"
        # of the fits of the classes, as in the table
        numbers["flags"] = columns["flags"]
        with_redshift = _of_classes(numbers, columns)
        # fits of stars and quasars with galaxies say nothing about the fit
        numbers = numbers[np.isin(columns["class"], ["galaxy", ""])]
    subtitle = f"{len(results)} objects, {len(numbers.meta['filters'])} bands"
    title = f"Fits of {Path(path).name}"
    report = Page(title, subtitle=subtitle)
    page = SectionWriter(report, declared("miricigale.fitting"))
    if step > 1:
        page.notice("thinned", step=step, n=len(all_numbers))
    _notices(page, numbers)
    non_galaxies = " or ".join(list(classes)[1:])
    page.section("summary", text, n=len(numbers), n_all=len(all_numbers), others=non_galaxies)
    _summary(page, numbers)
    curves = fitted_curves(next(iter(results.parts())))
    if browser is not None and len(all_numbers):
        name = write_browser(browser, title, results, all_numbers, curves, step=step)
        _link(page, name, step * browser_step(len(all_numbers)))
    if columns is not None:
        classes_section(page, columns, list(classes), all_numbers["ids"])
    _redshifts(page, with_redshift, text)
    _calibration(page, measured_calibration(results))
    _goodness(page, numbers, curves)
    _physics(page, numbers)
    _examples(page, results, all_numbers, step, curves)
    _left_out(page, rows, all_numbers)
    _settings(page, results)
    return page.report


def _link(page, name, step):
    """Link the page of single objects, which has one in ``step``."""
    shown = "all objects"
    if step > 1:
        shown = f"one object in {step}"
    page.text("browser", browser=Link("one by one", name), shown=shown)


def _of_classes(numbers, columns):
    """Return the numbers of all objects but stars, with the redshifts of their classes."""
    out = numbers.copy()
    if not numbers.meta["fixed"]:
        percentiles = ("redshift_p16", "redshift_p50", "redshift_p84")
        out["z"] = np.column_stack([columns[name] for name in percentiles])
    return out[columns["class"] != "star"]


def _bands(numbers):
    """Iterate over bands: name, and finite flux ratios and pulls of all objects."""
    for i, name in enumerate(numbers.meta["filters"]):
        ratio = numbers["ratio"][:, i]
        pull = numbers["pull"][:, i]
        yield name, finite_values(ratio).astype(float), finite_values(pull)


def _notices(page, numbers):
    good = numbers["good"]
    if len(numbers) and not good.any():
        page.notice("nothing")
        return
    poor = numbers["chi2"][good] > _POOR_CHI2
    edge = numbers["flags"][good] & FitFlags.REDSHIFT_EDGE != 0
    for name, is_affected in (("high_chi2", poor), ("redshift_edge", edge)):
        share = _mean(is_affected)
        if share > _NOTICE_SHARE:
            page.notice(name, share=100 * share, limit=_POOR_CHI2)
    for name, ratio, _ in _bands(numbers):
        if ratio.size >= 30 and not 0.8 < np.median(ratio) < 1.25:
            page.notice("band", band=name, ratio=np.median(ratio), n=ratio.size)


def _summary(page, numbers):
    good = numbers[numbers["good"]]
    values = {
        "n": len(numbers),
        "n_good": len(good),
        "n_clean": np.count_nonzero(good["flags"] == 0),
    }
    values |= {"n_bands": _median(good["n_bands"]), "chi2": _median(good["chi2"])}
    if not numbers.meta["fixed"]:
        low, z, high = good["z"].T
        values |= {"z": _median(z), "width": _median((high - low) / 2 / (1 + z))}
    if np.isfinite(numbers["frac"]).any():
        values["agn"] = _mean(good["frac"][:, 1] >= _AGN_LIMIT)
    page.items(values, agn_limit=_AGN_LIMIT)


def _median(values):
    values = finite_values(values)
    if len(values):
        return np.median(values)
    return np.nan


def _mean(values):
    if len(values):
        return np.mean(values)
    return np.nan


def _draw_counts(ax, xlabel, bins, samples):
    """Draw histograms of samples by label, the first filled, the others as outlines."""
    for k, (label, values) in enumerate(samples.items()):
        if k:
            style = {"histtype": "step", "color": _FIRST_COLOR}
        else:
            style = {"color": "0.75"}
        ax.hist(values, bins, label=plain_text(label), **style)
    if len(samples) > 1:
        ax.legend(frameon=False, fontsize=8)
    ax.set(xlabel=xlabel, ylabel="objects")


def _redshifts(page, numbers, text):
    if numbers.meta["fixed"]:
        page.section("redshifts", "given")
        return
    page.section("redshifts", text)
    samples = {"fitted": numbers["z"][numbers["good"], 1]}
    is_known = numbers["good"] & np.isfinite(numbers["z_known"])
    name = numbers.meta["known"]
    figure, axes = new_figure(1, 1 + is_known.any(), size=(WIDTH / 2, 4.2))
    caption = "alone"
    if is_known.any():
        caption = "compared"
        z = numbers["z_known"][is_known]
        low, middle, high = numbers["z"][is_known].T
        metrics = dataclasses.asdict(photoz_metrics(z, middle))
        page.items(metrics | {"n": len(z), "inside": np.mean((low <= z) & (z <= high))}, name=name)
        step = _step(len(z))
        plot_redshifts(z[::step], middle[::step], ax=axes[0, 0])
        axes[0, 0].set(xlabel=plain_text(name), ylabel="fitted redshift (median)")
        samples[name] = z
    bins = np.histogram_bin_edges(np.concatenate(list(samples.values())), 40)
    _draw_counts(axes[0, -1], "redshift", bins, samples)
    page.figure(caption, figure, name=name)


def _calibration(page, calibration):
    """Show what was measured on the catalog: scores of known redshifts, and the errors of the bands."""
    if calibration is None:
        return
    if calibration.scores is None:
        page.section("calibration", "bands_only", name=calibration.name)
    else:
        page.section("calibration", "text", name=calibration.name)
        page.table("scores", row_dicts(calibration.scores))
    rows = row_dicts(calibration.bands)
    for row in rows:
        if row["zero_point_err"] == 0:
            row["zero_point_err"] = np.nan
        if row["n"] == 0:
            row |= {"n": "prior", "zero_point_err": np.nan, "wrong": np.nan}
    page.table("bands", rows)


def _step(n):
    """Return the step between n points that are drawn."""
    return max(1, n // _MAX_POINTS)


def _goodness(page, numbers, curves):
    page.section("goodness")
    figure, ((ax, of_bands),) = new_figure(1, 2, size=(WIDTH / 2, 3.6))
    chi2 = numbers["chi2"][numbers["good"]]
    bins = np.geomspace(1e-2, 1e3, 51)
    label = "reduced chi2 (those beyond in the outermost bins)"
    _draw_counts(ax, label, bins, {"": np.clip(chi2, 1e-2, 1e3)})
    ax.set(xscale="log")
    if len(chi2):
        ax.axvline(np.median(chi2), color=_FIRST_COLOR, lw=1, label="median")
        ax.legend(frameon=False)
    rows = []
    pivots = {curve.name: float(curve.pivot.value) for curve in curves}
    for name, ratio, pull in sorted(_bands(numbers), key=lambda band: pivots[band[0]]):
        if ratio.size:
            low, middle, high = np.percentile(ratio, [16, 50, 84])
        else:
            low, middle, high = [np.nan] * 3
        if ratio.size >= _MIN_FLUXES:
            limits = [[middle - low], [high - middle]]
            of_bands.errorbar(len(rows), middle, limits, fmt="o", color=_FIRST_COLOR, ms=4, lw=1)
        row = {"band": name, "um": pivots[name], "n": ratio.size}
        row |= {"low": low, "middle": middle, "high": high}
        rows.append(row | {"pull": _median(pull), "beyond": _mean(np.abs(pull) > 3)})
    of_bands.axhline(1.0, color="0.6", lw=0.8)
    names = [plain_text(row["band"]) for row in rows]
    of_bands.set_xticks(range(len(names)), names, rotation=90, fontsize=7)
    of_bands.set(ylabel="flux over that of the best model", ylim=(0.4, 1.8))
    page.figure("figure", figure, few=_MIN_FLUXES)
    page.table("table", rows)


def _physics(page, numbers):
    numbers = numbers[numbers["good"] & (numbers["mass"][:, 1] > 0)]
    with_agn = np.isfinite(numbers["frac"]).any()
    if not len(numbers):
        return
    and_agn = ""
    and_fractions = ""
    color = _FIRST_COLOR
    if with_agn:
        and_agn = " and AGN"
        and_fractions = " and AGN fractions"
        color = "0.6"
    page.section("physics", and_agn=and_agn)
    figure, axes = new_figure(1, 1 + with_agn, size=(WIDTH / 2, 3.6))
    drawn = numbers[:: _step(len(numbers))]
    ax = axes[0, 0]
    mass = np.log10(drawn["mass"][:, 1])
    strong = drawn["frac"][:, 1] >= _AGN_LIMIT
    groups = {"others": (~strong, color)}
    if with_agn:
        groups |= {f"fracAGN at least {_AGN_LIMIT:g}": (strong, _SECOND_COLOR)}
    for label, (rows, color) in groups.items():
        ax.plot(drawn["z"][rows, 1], mass[rows], ".", ms=4, color=color, label=label)
    # a few extreme masses must not set the scale
    low, high = np.percentile(mass, [0.5, 99.5])
    ax.set(xlabel="redshift", ylabel="log stellar mass (Msun)", ylim=(low - 0.5, high + 0.5))
    if with_agn:
        ax.legend(frameon=False, fontsize=8)
        samples = {
            "posterior median": numbers["frac"][:, 1],
            "16th percentile": numbers["frac"][:, 0],
        }
        _draw_counts(axes[0, 1], "fracAGN", np.linspace(0, 1, 26), samples)
        axes[0, 1].set(yscale="log")
    page.figure("figure", figure, and_fractions=and_fractions)
    if with_agn:
        page.text("agn")


def _examples(page, results, numbers, step, curves):
    chosen = _choose(numbers)
    if not chosen:
        return
    page.section("examples")
    picked = list(results[np.array([step * row for row, _ in chosen])])
    titles = []
    for (_, reason), result in zip(chosen, picked, strict=True):
        z = ""
        if not numbers.meta["fixed"]:
            z = f"z = {result.best['redshift'].value:.2f}, "
        chi2 = f"reduced chi2 {result.reduced_chi2:.2f}"
        titles.append(f"{plain_text(result.ids)}: {z}{chi2} ({reason})")
    page.figure("figure", draw_objects(picked, curves, titles))


def _choose(numbers):
    """Choose the rows of the examples, with the reason: spread over chi2, and the surest AGN."""
    rows = np.flatnonzero(numbers["good"])
    if not rows.size:
        return []
    fitted = numbers[rows]
    # from the best to the worst fit
    order = rows[np.argsort(fitted["chi2"], kind="stable")]
    places = {0.1: "a good fit", 0.5: "median chi2", 0.9: "worst tenth", 1.0: "the worst fit"}
    chosen = {}
    for place, reason in places.items():
        chosen.setdefault(int(order[int(place * (order.size - 1))]), reason)
    selected = fitted["frac"][:, 1] >= _AGN_LIMIT
    if selected.any():
        # the AGN with the highest lower limit of its fraction
        surest = np.where(selected, fitted["frac"][:, 0], -1.0)
        chosen.setdefault(int(rows[np.argmax(surest)]), "surest AGN")
    high = np.where(fitted["flags"] == 0, fitted["z"][:, 0], -1.0)
    if high.max() > 0 and not numbers.meta["fixed"]:
        chosen.setdefault(int(rows[np.argmax(high)]), "highest redshift without a flag")
    return list(chosen.items())[:_N_EXAMPLES]


def _left_out(page, rows, numbers):
    page.section("left_out")
    filters = numbers.meta["filters"]
    bad = numbers["unusable"].sum(axis=0)
    lines = {
        "unused": unused_bands(rows.chunk(0), list(filters)),
        "empty": [name for name, ratio, _ in _bands(numbers) if not ratio.size],
        "errors": [f"{name} {n}" for name, n in zip(filters, bad, strict=True) if n],
    }
    if "wrong" in numbers.colnames:
        wrong = zip(filters, numbers["wrong"].sum(axis=0), strict=True)
        lines["wrong"] = [f"{name} {n}" for name, n in wrong if n]
    entries = []
    if isinstance(rows, MappedRows):
        entries = list(rows.messages())
    entries += [page.sentence(k, names=", ".join(names)) for k, names in lines.items() if names]
    page.report.bullets(entries or [page.sentence("nothing")])
    counts = [{"flag": "none", "meaning": "", "objects": np.count_nonzero(numbers["flags"] == 0)}]
    for value, (name, meaning) in FitFlags.meanings().items():
        n = np.count_nonzero(numbers["flags"] & value)
        if n:
            fitted = " Not fitted."
            if not value & FitFlags.UNFITTED:
                fitted = ""
            counts.append({"flag": f"{value} {name}", "meaning": meaning + fitted, "objects": n})
    page.table("flags", counts)


def _settings(page, results):
    page.section("settings")
    first = next(iter(results.parts()))
    settings = without(first.meta.get("fit", {}), ["filters"])
    if results.model is not None:
        settings |= results.model.recipe
    rows = convert_values(_setting_text, settings)
    for name, axis in first.axes.items():
        ends = f"from {axis.values[0]:g} to {axis.values[-1]:g} {u.Unit(axis.unit)}"
        rows[f"axis {name}"] = f"{axis.values.size} {ends}".strip()
    shorten = {
        name: f"{text[:_MAX_LETTERS]} ..."
        for name, text in rows.items()
        if len(text) >= _MAX_LETTERS
    }
    page.report.table((rows | shorten).items(), header=("", ""), text=2)


def _setting_text(value):
    if isinstance(value, dict):
        different = set(map(str, value.values()))
        if len(different) == 1:
            return f"{different.pop()} in all bands"
        return ", ".join(f"{name} {v}" for name, v in value.items())
    if isinstance(value, (list, tuple)):
        return "; ".join(map(str, value)) or "none"
    return str(value)
