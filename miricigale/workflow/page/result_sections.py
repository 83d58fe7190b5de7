"""Sections on the fits of all truths, in the order of Yang et al. 2021."""

import numpy as np

from miricigale.evaluation import (
    REDSHIFT_BINS,
    coverage_table,
    feature_residuals,
    selection_table,
    study_confusion,
)
from miricigale.evaluation.estimates import outlier_share
from miricigale.filters import Filter
from miricigale.pages import Missing, number
from miricigale.utils.named_values import first_value
from miricigale.workflow.labels import (
    SET_LABELS,
    band_label,
    browse,
    class_label,
    parameter_label,
    truth_label,
)
from miricigale.workflow.page import source_figures, study_figures
from miricigale.workflow.page.numbers import FEWEST
from miricigale.workflow.page.study_figures import CLASS_COLUMNS, FEATURES
from miricigale.workflow.stages.conditions import CONDITIONS
from miricigale.workflow.stages.fits import true_ranks
from miricigale.workflow.stages.inputs import FitPieces
from miricigale.workflow.stages.sample import typical_source
from miricigale.workflow.stages.skies import NEAR, PER_WHOLE, sky_numbers
from miricigale.workflow.truths import FIELD

#: fracAGN of the truths of which a source is shown in detail.
EXAMPLES = (0.0, 0.4)
#: Parameters whose posteriors are compared with the truth, in its table as in the fit.
COVERED = ("redshift", "frac_agn", "stellar_mass", "sfr_100myr", "dust_luminosity")
#: Those whose ranks are drawn.
RANKED = ("redshift", "frac_agn", "stellar_mass")


def write_results(page, numbers):
    """
    Write all sections on the fits; without a sample one sentence.

    ``numbers`` are those of the fits of the whole samples with their errors
    (`~miricigale.workflow.page.numbers.whole_sample`).
    """
    if not any(truth.sample.any() for truth in page.study.truths):
        n_left_out = page.metrics["n_left_out"].items()
        reasons = [f"{name.replace('_', ' ')} {n}" for name, n in n_left_out if n]
        page.section("no_fits", left_out=", ".join(reasons))
        return
    _write_examples(page)
    rows = _fit_rows(page, numbers)
    _write_redshifts(page, rows)
    _write_fractions(page, rows)
    _write_figure(page, "disk", study_figures.disk_figure(page.study))
    of_truths = ""
    if len(page.study.with_agn) > 1:
        of_truths = ", of all truths together"
    xrays = study_figures.xray_figure(page.study, page.context.seed)
    _write_figure(page, "xrays", xrays, of_truths=of_truths)
    if len(page.study.truths) > 1:
        _write_classes(page)
    _write_features(page)
    _write_coverage(page)


def _write_figure(page, name, figure, **facts):
    """Write a section of one figure, if there is one."""
    if figure is not None:
        page.section(name)
        page.figure("figure", figure, **facts)


# ---------------------------------------------------------------------- single sources


def _write_examples(page):
    """Write the section on one source by fracAGN, and on fits to sources of single truths."""
    study = page.study
    # the id of a typical source by truth
    keys = {}
    for truth in study.truths:
        tables = page.truth_tables[truth.name]
        if "all" in tables.fits:
            fitted = np.isfinite(tables.fits["all"]["chi2_best"])
            key = typical_source(tables.sample, fitted, study.bands[-1])
            if key is not None:
                keys[truth.name] = key
    page.section("examples")
    if not keys:
        page.text("none")
        return
    if "mass" in page.first.truth.colnames:
        key = first_value(keys)
        link = browse(page.first.name, key, key)
        page.figure("spectra", source_figures.spectra_figure(study, key, page.model), source=link)
    truths = [study.at(fraction) for fraction in EXAMPLES]
    truths = [truth for truth in truths if truth is not None]
    for truth in truths or [page.first]:
        if truth.name in keys:
            key = keys[truth.name]
            row = truth.truth[np.asarray(truth.truth["id"]) == key][0]
            results = page.truth_tables[truth.name].results
            figure = source_figures.example_figure(results, row, key, page.model)
            link = browse(truth.name, key, key)
            page.figure("fit", figure, truth=truth_label(truth), source=link)


# ---------------------------------------------------------------------- redshift, AGN fraction


def _fit_rows(page, numbers):
    """Return the fits of all truths: plain numbers of the sample, and by quantity those with errors."""
    labels = {truth.name: truth_label(truth) for truth in page.study.truths}
    rows = []
    for name, truth in page.metrics["truths"].items():
        for unit, fit in truth["fits"].items():
            row = {"injected": labels[name], "fit": SET_LABELS[unit]} | fit
            row["outliers"] = fit["photoz_n_outliers"]
            if unit in _BROWSED_SETS:
                row["outliers"] = browse(name, row["outliers"], show=f"outliers_{unit}")
            for quantity in _QUANTITIES:
                estimate = numbers[name, unit, quantity]
                row[quantity] = estimate["value"]
                row[f"{quantity}_err"] = 0.5 * (estimate["high"] - estimate["low"])
            rows.append(row)
    return rows


#: Sets of bands whose outliers and fracAGN the source browser lists.
_BROWSED_SETS = ("all", "none")


#: Quantities of the fits that are shown with their errors.
_QUANTITIES = ("z_bias", "z_scatter", "z_outliers", "frac_offset", "frac_scatter", "width")


def _outliers(truth, rows, **ranges):
    """Return a cell: outliers without and with MIRI among some rows of the sample, and their number."""
    without_miri = truth.redshift_error("none")
    with_miri = truth.redshift_error("all")
    rows = rows & np.isfinite(without_miri)
    if not rows.any():
        return "none"
    shares = [100 * outlier_share(errors[rows]) for errors in (without_miri, with_miri)]
    text = f"{shares[0]:.1f} and {shares[1]:.1f} % ({np.count_nonzero(rows)})"
    if ranges:
        return browse(truth.name, text, show="outliers", **ranges)
    return text


#: Mass (Msun) below which a source is doubtful.
DOUBTFUL_MASS = 1e8
#: Reduced chi2 of its input fit above which a source is doubtful.
DOUBTFUL_CHI2 = 2.0


def _outlier_rows(page):
    """Yield outliers of each truth by true redshift (keys "0" to "4"), and without doubtful sources."""
    chi2 = FitPieces(page.context, "input_seds", len(page.tables.truth)).of("reduced_chi2")
    # the end of the first bin
    z_min = REDSHIFT_BINS[0][1]
    for truth in page.study.truths:
        if not {"all", "none"} <= set(truth.fits):
            continue
        z = truth.true("redshift")
        row = {"injected": truth_label(truth)}
        row["every"] = _outliers(truth, z > 0, redshift="0..")
        for k, (low, high) in enumerate(REDSHIFT_BINS):
            span = f"{low:g}..{high:g}".removesuffix("inf")
            row[str(k)] = _outliers(truth, (z >= low) & (z < high), redshift=span)
        row["redshift"] = _outliers(truth, z >= z_min, redshift=f"{z_min:g}..")
        row["mass"] = _outliers(truth, truth.true("stellar_mass") >= DOUBTFUL_MASS)
        row["chi2"] = _outliers(truth, ~(chi2 > DOUBTFUL_CHI2)[truth.sample])
        if "redshift_source" in truth.truth.colnames:
            is_spec = truth.truth["redshift_source"][truth.sample] == "spec"
            row["spec"] = _outliers(truth, is_spec)
        yield row


def _write_redshifts(page, rows):
    """Write the section on photometric redshifts."""
    page.section("redshifts")
    if len(page.tables.sample):
        true = page.tables.sample["redshift"]
        fits = {SET_LABELS[unit]: (true, fit) for unit, fit in page.tables.fits.items()}
        page.figure("scatter", study_figures.redshift_figure(fits))
    page.figure("errors", study_figures.histogram_figure(page.study, "redshift"))
    page.table("table", rows)
    if outliers := list(_outlier_rows(page)):
        page.table("bins", outliers)
        page.table("doubtful", outliers)
    groups = []
    for unit, fit in page.metrics["fits"].items():
        for group, bit in CONDITIONS.items():
            row = {"fit": SET_LABELS[unit], "group": group} | fit["conditions"][group]
            # isolated ones have no flag that the browser could list them by
            if bit and unit in _BROWSED_SETS:
                name = page.first.name
                row["n"] = browse(name, row["n"], show="sample", flag=group)
                row["photoz_n_outliers"] = browse(
                    name, row["photoz_n_outliers"], show=f"outliers_{unit}", flag=group
                )
            groups.append(row)
    page.table("conditions", groups)


def _write_fractions(page, rows):
    """Write the section on AGN fractions."""
    study = page.study
    page.section("fractions", "truths" if len(study.truths) > 1 else "text")
    if len(page.tables.sample):
        page.figure("differences", study_figures.histogram_figure(study, "difference"))
    page.figure("means", study_figures.histogram_figure(study, "fraction"))
    page.figure("widths", study_figures.histogram_figure(study, "width"))
    page.table("table", rows)


# ---------------------------------------------------------------------- classes


def _share(row, name):
    """Return a share of a row with its interval, or why there is none."""
    if not np.isfinite(row[name]):
        return Missing("no such source")
    low = 100 * row[f"{name}_low"]
    high = 100 * row[f"{name}_high"]
    return f"{100 * row[name]:.0f} % ({low:.0f} to {high:.0f})"


def _write_classes(page):
    """Write the section on classes by fracAGN, and on selections in a realistic field."""
    study = page.study
    page.section("classes")
    tables = {}
    rows = []
    for unit in ("all", "none"):
        if unit in page.first.fits and any(t.frac_agn is not None for t in study.truths):
            table = study_confusion(study, unit)
            tables[SET_LABELS[unit]] = table
            rows += _class_rows(table, SET_LABELS[unit])
    if rows:
        page.figure("figure", study_figures.class_figure(tables))
        page.table("table", rows)
    for truth in study.truths:
        if truth.frac_agn is None and truth.fits:
            rows = [_selection(truth, row) for row in selection_table(truth)]
            if truth.name == FIELD and len(skies := sky_numbers(page.context)):
                page.context.save_table("report/skies.ecsv", skies)
                rows += [_forecast(row) for row in skies]
            page.table(
                "selection",
                rows,
                truth=truth_label(truth),
                n_near=2 * NEAR + 1,
                per_whole=PER_WHOLE,
            )


def _class_rows(table, label):
    """Return rows of the page of a table of `~miricigale.evaluation.study_confusion`."""
    rows = []
    for counts in table:
        row = {
            "fit": label,
            "true class": class_label(counts["class"]),
            "sources": counts["n"],
        }
        for name in CLASS_COLUMNS:
            if name in table.colnames:
                row[f"found {class_label(name)}"] = counts[name]
        row["completeness"] = _share(counts, "completeness")
        row["purity"] = _share(counts, "purity")
        rows.append(row)
    return rows


def _selection_row(row):
    """Return what rows on selections of AGN by fracAGN have in common."""
    return {
        "fit": SET_LABELS[row["band_set"]],
        "limit": row["limit"],
        "agn": row["n_wanted"],
        "completeness": _share(row, "completeness"),
        "purity": _share(row, "purity"),
    }


def _forecast(row):
    """Return a row on a selection of AGN in many skies without images."""
    shown = _selection_row(row)
    shown["wanted"] = f"{row['wanted']:.1f}"
    shown["selected"] = f"{row['selected']:.1f}"
    shown["skies"] = f"{row['n_skies']}, forecast"
    return shown


def _selection(truth, row):
    """Return a row on a selection of AGN in the sky with images."""
    unit = row["band_set"]
    span = f"{row['limit']:g}.."
    shown = _selection_row(row)
    shown["skies"] = "1, images"
    shown["wanted"] = browse(truth.name, row["n_wanted"], frac_agn=span)
    shown["selected"] = row["n_selected"]
    if unit in _BROWSED_SETS:
        span = {f"frac_agn_{unit}": span}
        shown["selected"] = browse(truth.name, shown["selected"], **span)
    return shown


# ---------------------------------------------------------------------- features, coverage


def _write_features(page):
    """Write the section on residuals of the fits where PAH features are within the bands."""
    results = page.tables.results.get("all")
    if results is None or not page.first.sample.any():
        return
    residuals = study_figures.band_residuals(results, page.study.bands)
    redshift = page.first.true("redshift")
    page.section("features")
    page.figure("figure", study_figures.residual_figure(redshift, residuals))
    rows = []
    for band, values in residuals.items():
        filter = Filter.from_name(band)
        for feature in FEATURES:
            inside, outside = feature_residuals(
                values,
                redshift,
                feature=feature,
                pivot=filter.pivot,
                filter_width=filter.width,
                seed=page.context.seed,
            )
            row = {
                "band and feature": f"{band_label(band)}, {feature.value:g} µm",
                "sources with it": inside.n,
                "median residual": _residual(inside),
                "of the others": _residual(outside),
            }
            rows.append(row)
    page.table("table", rows)


def _residual(estimate):
    """Return the text of a median residual; that of fewer sources, and its error, say nothing."""
    value = None
    if estimate.n >= FEWEST and np.isfinite(estimate.error):
        value = estimate.value
    reason = f"fewer than {FEWEST} sources above 5 sigma"
    return number(value, "+.3f", reason, error=estimate.error)


def widths(table):
    """Count posteriors that are narrower and broader than their errors say, of the rows of their central 68 %."""
    sets = table[np.isfinite(table["share"])]
    n_narrow = np.count_nonzero(sets["share_high"] < sets["level"])
    n_broad = np.count_nonzero(sets["share_low"] > sets["level"])
    n_right = len(sets) - n_narrow - n_broad
    verdict = "they differ"
    for n, text in ((n_narrow, "too narrow"), (n_broad, "too wide"), (n_right, "right")):
        if 2 * n > len(sets):
            verdict = f"most are {text}"
    return {
        "n_sets": len(sets),
        "n_narrow": n_narrow,
        "n_broad": n_broad,
        "n_right": n_right,
        "verdict": verdict,
    }


def _write_coverage(page):
    """Write the section on ranks of the truth in the posteriors, and how many are within central intervals."""
    tables = page.tables
    ranks = {}
    for unit, results in tables.results.items():
        for name in COVERED:
            if name in tables.truth.colnames and len(tables.fits[unit]):
                values = true_ranks(results, tables.sample, name, page.context.seed)
                ranks[unit, name] = values
    if not ranks:
        return
    table = coverage_table({" ".join(key): values for key, values in ranks.items()})
    # the table has a row for each of the two intervals
    within_68 = table[::2]
    within_95 = table[1::2]
    page.section("coverage", **widths(within_68))
    drawn = {key: values for key, values in ranks.items() if key[1] in RANKED}
    page.figure("figure", study_figures.rank_figure(drawn))
    rows = []
    for k, (unit, name) in enumerate(ranks):
        row = {
            "fit": SET_LABELS[unit],
            "parameter": parameter_label(name),
            "sources": within_68["n"][k],
            "in 68 %": _share(within_68[k], "share"),
            "in 95 %": _share(within_95[k], "share"),
            "mean rank": f"{within_68['mean_rank'][k]:.2f}",
        }
        rows.append(row)
    page.table("table", rows)
