"""Sections on the fits of all truths, in the order of Yang et al. 2021."""

import numpy as np

from miricigale.evaluation import (
    REDSHIFT_BINS,
    coverage_table,
    feature_residuals,
    selection_table,
    study_confusion,
)
from miricigale.filters import Filter
from miricigale.pages import Missing, number
from miricigale.workflow.page import source_figures, study_figures
from miricigale.workflow.page.labels import (
    SET_LABELS,
    band_label,
    browse,
    class_label,
    parameter_label,
    truth_label,
)
from miricigale.workflow.page.numbers import FEWEST, true_ranks
from miricigale.workflow.page.study_figures import CLASS_COLUMNS, FEATURES
from miricigale.workflow.stages.conditions import CONDITIONS
from miricigale.workflow.stages.sample import typical_source

#: fracAGN of the truths of which a source is shown in detail.
EXAMPLES = (0.0, 0.4)
#: Parameters whose posteriors are compared with the truth, in its table as in the fit.
COVERED = ("redshift", "frac_agn", "stellar_mass", "sfr_100myr", "dust_luminosity")
#: Those whose ranks are drawn.
RANKED = ("redshift", "frac_agn", "stellar_mass")


def write_results(page, numbers, binned):
    """
    All sections on the fits; without a sample one sentence.

    ``numbers`` are those of the fits of the whole samples with their errors
    (`~miricigale.workflow.page.numbers.whole_sample`), ``binned`` the table that they are of.
    """
    if not any(one.sample.any() for one in page.study.truths):
        left = page.metrics["n_left_out"].items()
        reasons = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in left if n)
        page.section("no_fits", left_out=reasons)
        return
    _write_examples(page)
    rows = _fit_rows(page, numbers)
    _write_redshifts(page, rows, binned)
    _write_fractions(page, rows)
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
        if fits is not None:
            keys[one.name] = typical_source(tables.sample, fits.fitted, study.bands[-1])
    page.section("examples")
    key = next((key for key in keys.values() if key is not None), None)
    if key is None:
        page.text("none")
        return
    if "mass" in page.first.truth.colnames:
        link = browse(page.first.name, key, key)
        page.figure("spectra", source_figures.spectra_figure(study, key, page.model), source=link)
    chosen = [one for fraction in EXAMPLES if (one := study.at(fraction)) is not None]
    for one in chosen or [page.first]:
        key = keys.get(one.name)
        if key is not None:
            row = one.truth[np.asarray(one.truth["id"]) == key][0]
            results = page.every[one.name].results
            figure = source_figures.example_figure(results, row, key, page.model)
            link = browse(one.name, key, key)
            page.figure("fit", figure, truth=truth_label(one), source=link)


# ---------------------------------------------------------------------- redshift, AGN fraction


def _fit_rows(page, numbers):
    """The fits of all truths: plain numbers of the sample, and by quantity those with errors."""
    labels = {one.name: truth_label(one) for one in page.study.truths}
    rows = []
    for name, truth in page.metrics["truths"].items():
        for unit, fit in truth["fits"].items():
            row = {"injected": labels[name], "fit": SET_LABELS[unit], **fit}
            n = fit["photoz_n_outliers"]
            # the source browser lists the outliers of these
            listed = unit in ("all", "none")
            row["outliers"] = browse(name, n, show=f"outliers_{unit}") if listed else n
            for quantity in _QUANTITIES:
                found = numbers[name, unit, quantity]
                row[quantity] = found["value"]
                row[f"{quantity}_err"] = 0.5 * (found["high"] - found["low"])
            rows.append(row)
    return rows


#: Quantities of the fits that are shown with their errors.
_QUANTITIES = ("z_bias", "z_scatter", "z_outliers", "frac_offset", "frac_scatter", "width")


def _binned_outliers(page, binned):
    """Outliers without and with MIRI in each bin of true redshift, a row for each truth."""
    rows = binned[np.asarray(binned["quantity"]) == "z_outliers"]
    found = {(r["truth"], r["band_set"], r["z_low"], r["z_high"]): r for r in rows}
    for one in page.study.truths:
        if {"all", "none"} <= set(one.fits):
            row = {"injected": truth_label(one)}
            for k, span in enumerate(REDSHIFT_BINS):
                both = [found[one.name, name, *span] for name in ("none", "all")]
                shares = " and ".join(f"{100 * r['value']:.1f}" for r in both)
                text = f"{shares} % ({both[0]['n']})" if both[0]["n"] else 0
                where = {
                    "show": "outliers",
                    "redshift": "{:g}..{:g}".format(*span).removesuffix("inf"),
                }
                row[str(k)] = browse(one.name, text, **where) or "none"
            yield row


def _write_redshifts(page, rows, binned):
    """Photometric redshifts."""
    page.section("redshifts")
    if len(page.tables.sample):
        true = page.tables.sample["redshift"]
        fits = {SET_LABELS[unit]: (true, fit) for unit, fit in page.tables.fits.items()}
        figure = study_figures.redshift_figure(fits)
        page.figure("scatter", figure)
    page.figure("errors", study_figures.histogram_figure(page.study, "redshift"))
    page.table("table", rows)
    page.table("bins", list(_binned_outliers(page, binned)))
    groups = [
        {"fit": SET_LABELS[unit], "group": group, **fit["conditions"][group]}
        for unit, fit in page.metrics["fits"].items()
        for group in CONDITIONS
    ]
    page.table("conditions", groups)


def _write_fractions(page, rows):
    """AGN fractions."""
    study = page.study
    page.section("fractions", "truths" if len(study.truths) > 1 else "text")
    if len(page.tables.sample):
        page.figure("differences", study_figures.histogram_figure(study, "difference"))
    page.figure("means", study_figures.histogram_figure(study, "fraction"))
    page.figure("widths", study_figures.histogram_figure(study, "width"))
    page.table("table", rows)


# ---------------------------------------------------------------------- classes


def _share(row, name):
    """A share of a row with its interval, or why there is none."""
    if not np.isfinite(row[name]):
        return Missing("no such source")
    low, high = (100 * row[f"{name}_{end}"] for end in ("low", "high"))
    return f"{100 * row[name]:.0f} % ({low:.0f} to {high:.0f})"


def _quality(row):
    return {name: _share(row, name) for name in ("completeness", "purity")}


def _write_classes(page):
    """Classes by fracAGN, and selections in a realistic field."""
    study, rows, tables = page.study, [], {}
    page.section("classes")
    for unit in ("all", "none"):
        if unit in page.first.fits and any(one.frac_agn is not None for one in study.truths):
            table, label = study_confusion(study, unit), SET_LABELS[unit]
            tables[label] = table
            found = {f"found {class_label(n)}": n for n in CLASS_COLUMNS if n in table.colnames}
            rows += [
                {"fit": label, "true class": class_label(row["class"]), "sources": row["n"]}
                | {header: row[name] for header, name in found.items()}
                | _quality(row)
                for row in table
            ]
    if rows:
        page.figure("figure", study_figures.class_figure(tables))
        page.table("table", rows)
    for one in study.truths:
        if one.frac_agn is None and one.fits:
            rows = [
                {"fit": SET_LABELS[row["band_set"]], **row, **_quality(row)}
                for row in selection_table(one)
            ]
            page.table("selection", rows, truth=truth_label(one))


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
            rows.append(
                {
                    "band and feature": f"{band_label(band)}, {rest.value:g} µm",
                    "sources with it": inside.n,
                    "median residual": _residual(inside),
                    "of the others": _residual(outside),
                }
            )
    page.table("table", rows)


def _residual(estimate):
    # a median of fewer, and its error, say nothing
    known = estimate.n >= FEWEST and np.isfinite(estimate.error)
    value = estimate.value if known else None
    reason = f"fewer than {FEWEST} sources above 5 sigma"
    return number(value, "+.3f", reason, error=estimate.error)


def _write_coverage(page):
    """Ranks of the truth in the posteriors, and how many are within central intervals."""
    tables = page.tables
    ranks = {
        (unit, name): true_ranks(results, tables.sample, name, page.context.seed)
        for unit, results in tables.results.items()
        for name in COVERED
        if name in tables.truth.colnames and len(results)
    }
    if not ranks:
        return
    table = coverage_table({" ".join(key): values for key, values in ranks.items()})
    page.section("coverage")
    drawn = {key: values for key, values in ranks.items() if key[1] in RANKED}
    page.figure("figure", study_figures.rank_figure(drawn))
    # the table has a row for each of the two intervals
    rows = [
        {
            "fit": SET_LABELS[unit],
            "parameter": parameter_label(name),
            "sources": first["n"],
            "in 68 %": _share(first, "share"),
            "in 95 %": _share(second, "share"),
            "mean rank": f"{first['mean_rank']:.2f}",
        }
        for (unit, name), first, second in zip(ranks, table[::2], table[1::2], strict=True)
    ]
    page.table("table", rows)
