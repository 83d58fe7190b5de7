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
    rows = _fit_rows(page, numbers)
    _write_redshifts(page, rows)
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
        if "all" in tables.fits:
            fitted = np.isfinite(tables.fits["all"]["chi2_best"])
            keys[one.name] = typical_source(tables.sample, fitted, study.bands[-1])
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


def _outliers(one, rows, **where):
    """A cell: outliers without and with MIRI among some rows of the sample, and their number."""
    errors = [one.redshift_error(name) for name in ("none", "all")]
    rows = rows & np.isfinite(errors[0])
    if not rows.any():
        return "none"
    shares = " and ".join(f"{100 * outlier_share(error[rows]):.1f}" for error in errors)
    text = f"{shares} % ({np.count_nonzero(rows)})"
    return browse(one.name, text, show="outliers", **where) if where else text


#: Mass (Msun) below which a source is doubtful, and reduced chi2 of its input fit above which it is.
DOUBTFUL_MASS, DOUBTFUL_CHI2 = 1e8, 2.0


def _outlier_rows(page):
    """Outliers of each truth by true redshift (keys "0" to "4"), and without doubtful sources."""
    chi2 = FitPieces(page.context, "input_seds", len(page.tables.truth)).of("reduced_chi2")
    for one in page.study.truths:
        if not {"all", "none"} <= set(one.fits):
            continue
        z, least = one.true("redshift"), REDSHIFT_BINS[0][1]
        row = {"injected": truth_label(one), "every": _outliers(one, z > 0, redshift="0..")}
        for k, (low, high) in enumerate(REDSHIFT_BINS):
            span = f"{low:g}..{high:g}".removesuffix("inf")
            row[str(k)] = _outliers(one, (z >= low) & (z < high), redshift=span)
        row["redshift"] = _outliers(one, z >= least, redshift=f"{least:g}..")
        row["mass"] = _outliers(one, one.true("stellar_mass") >= DOUBTFUL_MASS)
        row["chi2"] = _outliers(one, ~(chi2 > DOUBTFUL_CHI2)[one.sample])
        if "redshift_source" in one.truth.colnames:
            row["spec"] = _outliers(one, one.truth["redshift_source"][one.sample] == "spec")
        yield row


def _write_redshifts(page, rows):
    """Photometric redshifts."""
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
        for group in CONDITIONS:
            row = {"fit": SET_LABELS[unit], "group": group, **fit["conditions"][group]}
            # isolated ones have no flag that the browser could list them by
            if CONDITIONS[group] and unit in ("all", "none"):
                for key, show in (("n", "sample"), ("photoz_n_outliers", f"outliers_{unit}")):
                    row[key] = browse(page.first.name, row[key], show=show, flag=group)
            groups.append(row)
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
            rows = [_selection(one, row) for row in selection_table(one)]
            if one.name == FIELD and len(skies := sky_numbers(page.context)):
                page.context.save_table("report/skies.ecsv", skies)
                rows += [_selection(one, row) for row in skies]
            facts = {"n_near": 2 * NEAR + 1, "per_whole": PER_WHOLE}
            page.table("selection", rows, truth=truth_label(one), **facts)


def _selection(one, row):
    """A row on a selection of AGN by fracAGN: of the sky with images, or (``n_skies``) of many without."""
    unit, limit = row["band_set"], row["limit"]
    shown = {"fit": SET_LABELS[unit], "limit": limit, "agn": row["n_wanted"]} | _quality(row)
    if "n_skies" in row.colnames:
        shown |= {key: f"{row[key]:.1f}" for key in ("wanted", "selected")}
        return shown | {"skies": f"{row['n_skies']}, forecast"}
    span, n = f"{limit:g}..", row["n_selected"]
    wanted = browse(one.name, row["n_wanted"], frac_agn=span)
    # the browser has the columns of these
    listed = {f"frac_agn_{unit}": span} if unit in ("all", "none") else {}
    selected = browse(one.name, n, **listed) if listed else n
    return shown | {"skies": "1, images", "wanted": wanted, "selected": selected}


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
            row = {"band and feature": f"{band_label(band)}, {rest.value:g} µm"}
            row |= {"sources with it": inside.n, "median residual": _residual(inside)}
            rows.append(row | {"of the others": _residual(outside)})
    page.table("table", rows)


def _residual(estimate):
    # a median of fewer, and its error, say nothing
    known = estimate.n >= FEWEST and np.isfinite(estimate.error)
    value = estimate.value if known else None
    reason = f"fewer than {FEWEST} sources above 5 sigma"
    return number(value, "+.3f", reason, error=estimate.error)


def widths(table):
    """How many posteriors are narrower and broader than their errors say, of the rows of their central 68 %."""
    known = table[np.isfinite(table["share"])]
    narrow = np.count_nonzero(known["share_high"] < known["level"])
    broad = np.count_nonzero(known["share_low"] > known["level"])
    right = len(known) - narrow - broad
    verdicts = {"most are too narrow": narrow, "most are too wide": broad, "most are right": right}
    most = max(verdicts, key=verdicts.get)
    verdict = most if 2 * verdicts[most] > len(known) else "they differ"
    counts = {"n_narrow": narrow, "n_broad": broad, "n_right": right}
    return {"n_sets": len(known), **counts, "verdict": verdict}


def _write_coverage(page):
    """Ranks of the truth in the posteriors, and how many are within central intervals."""
    tables = page.tables
    ranks = {
        (unit, name): true_ranks(results, tables.sample, name, page.context.seed)
        for unit, results in tables.results.items()
        for name in COVERED
        if name in tables.truth.colnames and len(tables.fits[unit])
    }
    if not ranks:
        return
    table = coverage_table({" ".join(key): values for key, values in ranks.items()})
    page.section("coverage", **widths(table[::2]))
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
