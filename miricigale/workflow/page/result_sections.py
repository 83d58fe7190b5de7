"""Sections on the fits of all truths, in the order of Yang et al. 2021."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import (
    CLASS_NAMES,
    coverage_table,
    feature_residuals,
    posterior_ranks,
    selection_table,
    study_confusion,
)
from miricigale.filters import Filter
from miricigale.pages import Missing, number, percent
from miricigale.workflow.page import study_figures
from miricigale.workflow.page.labels import (
    CLASS_LABELS,
    SET_LABELS,
    band_label,
    browse,
    parameter_label,
    truth_label,
)
from miricigale.workflow.page.numbers import FEWEST
from miricigale.workflow.page.study_figures import FEATURES
from miricigale.workflow.stages.conditions import CONDITIONS
from miricigale.workflow.stages.sample import typical_source

__all__ = ["write_results"]

#: fracAGN of the truths of which a source is shown in detail.
EXAMPLES = (0.0, 0.4)
#: Parameters whose posteriors are compared with the truth, in its table as in the fit.
COVERED = ("redshift", "frac_agn", "stellar_mass", "sfr_100myr", "dust_luminosity")
#: Those whose ranks are drawn.
RANKED = ("redshift", "frac_agn", "stellar_mass")
_NONE = "no source fitted"


def write_results(page, numbers):
    """
    All sections on the fits; without a sample one sentence.

    ``numbers`` are those of the fits of the whole samples with their errors
    (`~miricigale.workflow.page.numbers.whole_sample`).
    """
    if not any(one.sample.any() for one in page.study.truths):
        left = page.metrics["n_left_out"].items()
        reasons = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in left if n)
        page.section("no_fits", left_out=reasons)
        return
    _write_examples(page)
    _write_redshifts(page, numbers)
    _write_fractions(page, numbers)
    _write_figure(page, "disk", study_figures.disk_figure(page.study))
    several = ", of all truths together" if len(page.study.with_agn) > 1 else ""
    xrays = study_figures.xray_figure(page.study, page.context.seed)
    _write_figure(page, "xrays", xrays, of_truths=several)
    if len(page.study.truths) > 1:
        _write_classes(page)
    _write_features(page)
    _write_coverage(page)


def _write_figure(page, name, figure, **facts):
    """A section of one figure, if there is one."""
    if figure is not None:
        page.section(name)
        page.figure("figure", figure, **facts)


# ---------------------------------------------------------------------- single sources


def _write_examples(page):
    """One source by fracAGN, and fits to sources of single truths."""
    study, keys = page.study, {}
    for one in study.truths:
        tables = page.every[one.name]
        fits = tables.results.get("all")
        keys[one.name] = fits and typical_source(tables.sample, fits.fitted, study.bands[-1])
    page.section("examples")
    key = next((key for key in keys.values() if key is not None), None)
    if key is None:
        page.text("none")
        return
    if "mass" in page.first.truth.colnames:
        link = browse(page.first.name, key, key)
        page.figure("spectra", study_figures.spectra_figure(study, key, page.model), source=link)
    chosen = [one for fraction in EXAMPLES if (one := study.at(fraction)) is not None]
    for one in chosen or [page.first]:
        key = keys[one.name]
        if key is not None:
            row = one.truth[np.asarray(one.truth["id"]) == key][0]
            results = page.every[one.name].results
            figure = study_figures.example_figure(results, row, key, page.model)
            link = browse(one.name, key, key)
            page.figure("fit", figure, truth=truth_label(one), source=link)


# ---------------------------------------------------------------------- redshift, AGN fraction


def _table_of_fits(page, numbers, columns):
    """
    A table with a row for each truth and set of bands.

    ``columns`` are by header: quantity, format and scale of a number with its error, or a function of
    name of the truth, set and plain numbers of the fit.
    """
    labels = {one.name: truth_label(one) for one in page.study.truths}

    def cell(column, name, unit, fit):
        if callable(column):
            return column(name, unit, fit)
        quantity, spec, scale = column
        row = numbers[name, unit, quantity]
        error = 0.5 * (row["high"] - row["low"])
        return number(row["value"], spec, _NONE, error=error, scale=scale)

    page.table(
        "table",
        [
            (name, unit, fit)
            for name, truth in page.metrics["truths"].items()
            for unit, fit in truth["fits"].items()
        ],
        {
            "injected": lambda x: labels[x[0]],
            "fit": lambda x: SET_LABELS[x[1]],
            **{
                header: (lambda x, column=column: cell(column, *x))
                for header, column in columns.items()
            },
        },
        text=2,
    )


def _outliers(name, unit, fit):
    """Number of outliers, with a link to their list for the sets that the source browser compares."""
    n = fit["photoz_n_outliers"]
    return browse(name, n, show=f"outliers_{unit}") if unit in ("all", "none") else n


def _write_redshifts(page, numbers):
    """Photometric redshifts."""
    page.section("redshifts")
    if len(page.tables.sample):
        figure = study_figures.redshift_figure(page.tables.sample, page.tables.fits)
        page.figure("scatter", figure)
    page.figure("errors", study_figures.histogram_figure(page.study, "redshift"))
    columns = {
        "sources": lambda name, unit, fit: fit["n"],
        "dz/(1+z) median": ("z_bias", "+.4f", 1),
        "sigma_MAD": ("z_scatter", ".4f", 1),
        "outliers": _outliers,
        "share (%)": ("z_outliers", ".1f", 100),
        "z in 16-84 %": lambda name, unit, fit: percent(fit["redshift_coverage"], _NONE, ".0f"),
    }
    _table_of_fits(page, numbers, columns)
    if page.study.with_agn:
        page.text("outliers")
    none = "no such source in the fit"
    page.table(
        "conditions",
        [
            (unit, group, fit["conditions"][group])
            for unit, fit in page.metrics["fits"].items()
            for group in CONDITIONS
        ],
        {
            "fit": lambda x: SET_LABELS[x[0]],
            "condition in any band": lambda x: x[1],
            "sources": lambda x: x[2]["n"],
            "sigma_MAD": lambda x: number(x[2]["photoz_sigma_mad"], ".4f", none),
            "outliers": lambda x: x[2]["photoz_n_outliers"],
        },
        text=2,
    )


def _write_fractions(page, numbers):
    """AGN fractions."""
    study = page.study
    page.section("fractions", text="truths" if len(study.truths) > 1 else "text")
    if sum(one.frac_agn is not None and one.sample.any() for one in study.truths) > 1:
        page.figure("bins", study_figures.fraction_bins_figure(study))
    page.figure("means", study_figures.histogram_figure(study, "fraction"))
    page.figure("widths", study_figures.histogram_figure(study, "width"))
    columns = {
        "fracAGN offset": ("frac_offset", "+.3f", 1),
        "scatter": ("frac_scatter", ".3f", 1),
        "width": ("width", ".3f", 1),
    }
    _table_of_fits(page, numbers, columns)


# ---------------------------------------------------------------------- classes


def _share(name):
    """Cell of a share of a row with its interval, or why there is none."""

    def cell(row):
        if not np.isfinite(row[name]):
            return Missing("no such source")
        low, high = (100 * row[f"{name}_{end}"] for end in ("low", "high"))
        return f"{100 * row[name]:.0f} % ({low:.0f} to {high:.0f})"

    return cell


_QUALITY = {name: _share(name) for name in ("completeness", "purity")}


def _write_classes(page):
    """Classes by fracAGN and by colors, and selections in a realistic field."""
    study = page.study
    page.section("classes")
    sets = [name for name in ("all", "none") if name in page.first.fits]
    if sets and any(one.frac_agn is not None for one in study.truths):
        tables = {unit: study_confusion(study, unit) for unit in sets}
        for unit, table in tables.items():
            page.figure("figure", study_figures.class_figure(table), set=SET_LABELS[unit])
        names = [n for n in (*CLASS_NAMES, "unknown") if n in tables[sets[0]].colnames]
        page.table(
            "table",
            [{"fit": SET_LABELS[unit], **row} for unit, table in tables.items() for row in table],
            {
                "fit": lambda row: row["fit"],
                "true class": lambda row: CLASS_LABELS.get(row["class"], row["class"]),
                "sources": lambda row: row["n"],
                **{
                    f"found {CLASS_LABELS.get(name, name)}": lambda row, name=name: row[name]
                    for name in names
                },
                **_QUALITY,
            },
            text=2,
        )
    if page.shares:
        page.figure("colors", study_figures.color_figure(study, page.shares))
    for one in study.truths:
        if one.frac_agn is None and one.fits:
            columns = {
                "fit": lambda row: SET_LABELS[row["band_set"]],
                "fracAGN at least": lambda row: f"{row['limit']:g}",
                "AGN": lambda row: row["n_wanted"],
                "selected": lambda row: row["n_selected"],
                **_QUALITY,
            }
            page.table("selection", selection_table(one), columns, truth=truth_label(one))


# ---------------------------------------------------------------------- features, coverage


def _write_features(page):
    """Residuals of the fits where PAH features are within the bands."""
    results = page.tables.results.get("all")
    if results is None or not page.first.sample.any():
        return
    residuals = study_figures.band_residuals(results, page.study.bands)
    redshift = page.first.true("redshift")
    page.section("features")
    page.figure("figure", study_figures.residual_figure(redshift, residuals))
    rows = []
    for band, values in residuals.items():
        own = Filter.from_name(band)
        options = {"pivot": own.pivot, "filter_width": own.width, "seed": page.context.seed}
        for rest in FEATURES:
            inside, outside = feature_residuals(values, redshift, feature=rest, **options)
            rows.append((f"{band_label(band)}, {rest.value:g} µm", inside, outside))
    columns = {
        "band and feature": lambda x: x[0],
        "sources with it": lambda x: x[1].n,
        "median residual": lambda x: _residual(x[1]),
        "of the others": lambda x: _residual(x[2]),
    }
    page.table("table", rows, columns)


def _residual(estimate):
    # a median of fewer, and its error, say nothing
    if estimate.n < FEWEST or not np.isfinite(estimate.error):
        return Missing(f"fewer than {FEWEST} sources above 5 sigma")
    return number(estimate.value, "+.3f", "", error=estimate.error)


def _posterior_ranks(tables, seed):
    """
    Ranks of the true values of a truth in their posteriors, by set of bands and parameter.

    Ranks are randomized within cells of the grid, for injected fractions lie on its nodes.
    """
    ranks = {}
    for unit, results in tables.results.items():
        for name in COVERED:
            if name in tables.truth.colnames and len(results):
                values, levels = results.cdf(name)
                true = u.Quantity(tables.sample[name]).to_value(values.unit)
                ranks[unit, name] = posterior_ranks(true, values.value, levels, seed=seed)
    return ranks


def _write_coverage(page):
    """Ranks of the truth in the posteriors, and how many are within central intervals."""
    ranks, share = _posterior_ranks(page.tables, page.context.seed), _share("share")
    if not ranks:
        return
    table = coverage_table({" ".join(key): values for key, values in ranks.items()})
    page.section("coverage")
    drawn = {key: values for key, values in ranks.items() if key[1] in RANKED}
    page.figure("figure", study_figures.rank_figure(drawn))
    columns = {
        "fit": lambda x: SET_LABELS[x[0][0]],
        "parameter": lambda x: parameter_label(x[0][1]),
        "sources": lambda x: x[1]["n"],
        "in 68 %": lambda x: share(x[1]),
        "in 95 %": lambda x: share(x[2]),
        "mean rank": lambda x: f"{x[1]['mean_rank']:.2f}",
    }
    # the table has a row for each of the two intervals
    page.table("table", zip(ranks, table[::2], table[1::2], strict=True), columns, text=2)
