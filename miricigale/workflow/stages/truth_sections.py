"""Sections of the report on what was found of the truths, in the order of Yang et al. 2021."""

import dataclasses

import numpy as np
from astropy.table import QTable

from miricigale.evaluation import (
    CLASS_NAMES,
    StudyResults,
    feature_residuals,
    selection_table,
    study_confusion,
)
from miricigale.filters import Filter
from miricigale.pages import Missing, Page, number
from miricigale.sed import SEDModel
from miricigale.workflow.stages import conditions, figures, truth_figures
from miricigale.workflow.stages.coverage import share_cell, write_coverage
from miricigale.workflow.stages.figures import SET_LABELS, band_label
from miricigale.workflow.stages.sample import typical_source
from miricigale.workflow.stages.truth_figures import FEATURES, truth_label

__all__ = ["ResultsPage", "percent", "write_results"]

#: fracAGN of the truths of which a source is shown in detail.
EXAMPLES = (0.0, 0.4)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ResultsPage:
    """
    What the sections of a page read, and the report that they fill.

    ``every`` are `~miricigale.workflow.stages.metrics.StudyTables` by truth, the reference first; ``numbers``
    those of the fits with their errors (`~miricigale.evaluation.study_numbers`), ``shares`` true AGN shares of
    the 5-15 um light of all sources by truth, empty without AGN; ``model`` is that of the fits and
    ``model_error`` their relative error.
    """

    report: Page
    study: StudyResults
    every: dict
    metrics: dict
    numbers: QTable
    shares: dict
    model: SEDModel
    model_error: float
    seed: int

    def figure(self, figure, caption):
        """Add a figure to the page, unless there is none."""
        if figure is not None:
            self.report.figure(figure, caption)

    def of_fit(self, truth, unit, quantity, spec, *, scale=1):
        """A number of a fit of the whole sample with its bootstrap error, or why there is none."""
        table, none = self.numbers, "no source fitted"
        rows = (table["truth"] == truth) & (table["band_set"] == unit)
        rows &= (table["quantity"] == quantity) & (table["z_low"] == 0) & np.isinf(table["z_high"])
        if not np.any(rows) or not np.isfinite(table["value"][rows][0]):
            return number(np.nan, spec, none)
        row = table[rows][0]
        value, error = (scale * x for x in (row["value"], 0.5 * (row["high"] - row["low"])))
        return (
            f"{value:{spec}} ± {error:{spec.lstrip('+')}}"
            if np.isfinite(error)
            else f"{value:{spec}}"
        )

    @property
    def fitted(self):
        """The truths of which sources were fitted."""
        return [one for one in self.study.truths if one.sample.any()]


def percent(value, reason, spec=".1f"):
    """A share as percent, or why there is none."""
    return number(value, f"{{:{spec}}} %", reason, scale=100)


def write_results(page):
    """All sections on the fits; without a sample one sentence."""
    if not page.fitted:
        page.report.section("Redshift and AGN fraction")
        left = ", ".join(
            f"{name.replace('_', ' ')} {n}" for name, n in page.metrics["n_left_out"].items() if n
        )
        page.report.text(
            f"No source is left to fit. Why the {page.metrics['n_catalog']} sources of the "
            f"catalog were left out, each for one reason or more: {left}."
        )
        return
    write_examples(page)
    write_redshifts(page)
    write_fractions(page)
    write_luminosities(page)
    write_xrays(page)
    write_classes(page)
    write_features(page)
    write_coverage(page)


# ---------------------------------------------------------------------- single sources


def _example(page, one):
    """Id of a source of a truth to be shown; None if none was fitted with MIRI."""
    tables = page.every[one.name]
    fits = tables.results.get("all")
    if fits is None:
        return None
    return typical_source(tables.sample, fits.fitted, page.study.bands[-1])


def write_examples(page):
    """One source by fracAGN, and fits to sources of single truths."""
    report, study = page.report, page.study
    report.section("Example sources")
    keys = {one.name: _example(page, one) for one in study.truths}
    first = study.truths[0]
    if all(key is None for key in keys.values()):
        report.text("No source of the sample could be fitted with MIRI.")
        return
    key = next(key for key in keys.values() if key is not None)
    if "mass" in first.truth.colnames:
        page.figure(
            truth_figures.spectra_figure(study, key, page.model),
            f"Spectra of source {key} with AGN of several fracAGN, the galaxy unchanged; bars: widths of the "
            "MIRI bands, dotted: PAH features at their rest wavelengths in µm.",
        )
    chosen = [study.at(fraction) for fraction in EXAMPLES]
    chosen = [one for one in chosen if one is not None] or [first]
    for one in chosen:
        key = keys[one.name]
        if key is None:
            continue
        row = one.truth[np.asarray(one.truth["id"]) == key][0]
        results = page.every[one.name].results
        page.figure(
            truth_figures.example_figure(results, row, key, page.model),
            f"Injected {truth_label(one)}, source {key}: photometry and best models, residuals of the fit "
            "with MIRI, and the posteriors of redshift and AGN fraction with and without MIRI; "
            "contours hold 68 and 95 %.",
        )


# ---------------------------------------------------------------------- redshift, AGN fraction


def _table_of_fits(page, columns, caption):
    """A table with a row for each truth and set of bands: columns are header to the cell of a fit (by names)."""
    names = {one.name: truth_label(one) for one in page.study.truths}
    rows = [
        (names[name], SET_LABELS[unit], *(cell(name, unit, entry) for cell in columns.values()))
        for name, truth in page.metrics["truths"].items()
        for unit, entry in truth["fits"].items()
    ]
    page.report.table(rows, header=("injected", "fit", *columns), caption=caption, text=2)


def write_redshifts(page):
    """Photometric redshifts."""
    report, study = page.report, page.study
    report.section(
        "Redshifts",
        "Posterior means of the same sources, fitted with the existing bands alone and with MIRI.",
    )
    tables = next(iter(page.every.values()))
    if len(tables.sample):
        report.figure(
            figures.redshift_figure(tables.sample, tables.fits),
            f"Fitted against true redshift, injected {truth_label(study.truths[0])}; dashed: the limits "
            "beyond which a source is an outlier.",
        )
    report.figure(
        truth_figures.redshift_figure(study),
        "Redshift errors by injected fracAGN; the outermost bins hold all beyond them.",
    )
    none = "no source fitted"
    columns = {
        "sources": lambda name, unit, fit: fit["n"],
        "dz/(1+z) median": lambda name, unit, _: page.of_fit(name, unit, "z_bias", "+.4f"),
        "sigma_MAD": lambda name, unit, _: page.of_fit(name, unit, "z_scatter", ".4f"),
        "outliers": lambda name, unit, fit: fit["photoz_n_outliers"],
        "share (%)": lambda name, unit, _: page.of_fit(name, unit, "z_outliers", ".1f", scale=100),
        "z in 16-84 %": lambda name, unit, fit: percent(fit["redshift_coverage"], none, ".0f"),
    }
    _table_of_fits(
        page,
        columns,
        "Redshift against truth. Galaxies lie within the models of the fit, whose "
        f"{100 * page.model_error:g} % model error they do not have, so posteriors are wide. Sources are "
        "those detected in enough MIRI bands, the same with each set of bands; errors are of the bootstrap, of "
        "shares binomial",
    )
    if study.with_agn:
        report.text(
            "AGN of the sky have inclinations, dust distributions and polar dust that the templates of the fit "
            "have not, as in Yang et al. 2021: where the AGN outshines the galaxy, the redshift makes up for the "
            "difference. It is no matter of noise: AGN that are templates of the fit have no such outliers."
        )
    conditions.write_fits(report, page.metrics)


def write_fractions(page):
    """AGN fractions."""
    report, study = page.report, page.study
    text = "Posterior means and widths of fracAGN, which is fitted together with the redshift."
    if len(study.truths) > 1:
        text += (
            " The same galaxies have AGN of other strength in each sky, which is exposed, reduced, measured "
            "and fitted alike. Every source has an AGN drawn from the ranges of Yang et al. 2021, or, in "
            "the realistic field, one of the luminosity that the luminosity function of Ueda et al. 2014 gives "
            "to galaxies of its mass and redshift; all have the error function of the first truth."
        )
    report.section("AGN fraction", text)
    if len([one for one in page.fitted if one.frac_agn is not None]) > 1:
        report.figure(
            truth_figures.fraction_bins_figure(study),
            "Median and scatter (1.48 MAD) of the posterior means of fracAGN by bin of true redshift, of at "
            "least five sources each.",
        )
    report.figure(
        truth_figures.fraction_figure(study), "Posterior means of fracAGN by injected fracAGN."
    )
    report.figure(
        truth_figures.width_figure(study),
        "Standard deviations of the posteriors of fracAGN by injected fracAGN; those of a posterior "
        "without information are about 0.3.",
    )
    columns = {
        "fracAGN offset": lambda name, unit, _: page.of_fit(name, unit, "frac_offset", "+.3f"),
        "scatter": lambda name, unit, _: page.of_fit(name, unit, "frac_scatter", ".3f"),
        "width": lambda name, unit, _: page.of_fit(name, unit, "width", ".3f"),
    }
    _table_of_fits(
        page,
        columns,
        "Median and scatter of fitted minus true fracAGN, and median width of the posteriors, with their "
        "bootstrap errors",
    )


# ---------------------------------------------------------------------- luminosities


def write_luminosities(page):
    """Accretion power against the truth."""
    figure = truth_figures.disk_figure(page.study)
    if figure is not None:
        page.report.section("Luminosity of the accretion disk")
        page.figure(
            figure,
            "Fitted (posterior mean, with MIRI) against true luminosity of the accretion disk; gray: a factor "
            "of two.",
        )


def write_xrays(page):
    """X-ray fluxes of the injected AGN and of those in the sample."""
    figure = truth_figures.xray_figure(page.study, page.seed)
    if figure is not None:
        several = ", of all truths together" if len(page.study.with_agn) > 1 else ""
        page.report.section("X-rays")
        page.figure(
            figure,
            f"X-ray fluxes of the AGN of the field{several}, from their light at 6 µm (Stern 2015), halved for "
            "absorption, and of those detected in enough MIRI bands to be fitted (found). Vertical lines: where "
            "half of these are, with its 68 % interval, and limits of X-ray surveys (dotted: estimates "
            "from abstracts, not published limits).",
        )


# ---------------------------------------------------------------------- classes


def write_classes(page):
    """Classes by fracAGN and by colors, and selections in a realistic field."""
    report, study = page.report, page.study
    if len(study.truths) < 2:
        return
    report.section("Classes")
    sets = [n for n in ("all", "none") if n in study.truths[0].fits]
    if sets and any(one.frac_agn is not None for one in study.truths):
        _write_confusion(page, sets)
    if page.shares:
        page.figure(
            truth_figures.color_figure(study, page.shares),
            "Measured colors of the fitted sources by class after Kirkpatrick et al. 2017 (AGN share of the "
            "5-15 µm light below 0.3, below 0.7, above), all truths together. Circles, fitted to these: AGN "
            "within the full one, composites within the dashed one.",
        )
    for one in study.truths:
        if one.frac_agn is None and one.fits:
            _write_selection(report, one)


def _write_confusion(page, sets):
    """Classes found by those of the truth, with each of some sets of bands."""
    told = "Classes by fracAGN (galaxy below 0.1, composite below 0.4)"
    tables = {unit: study_confusion(page.study, unit) for unit in sets}
    for unit, table in tables.items():
        page.figure(
            truth_figures.class_figure(table),
            f"{told} {SET_LABELS[unit]}: shares of the sources of each true class in the field.",
        )
    names = [name for name in (*CLASS_NAMES, "unknown") if name in tables[sets[0]].colnames]
    page.report.table(
        [
            (
                SET_LABELS[unit],
                truth_figures.CLASS_LABELS.get(row["class"], row["class"]),
                row["n"],
                *(row[name] for name in names),
                share_cell(row, "completeness"),
                share_cell(row, "purity"),
            )
            for unit, table in tables.items()
            for row in table
        ],
        header=(
            "fit",
            "true class",
            "sources",
            *(f"found {truth_figures.CLASS_LABELS.get(name, name)}" for name in names),
            "completeness",
            "purity",
        ),
        caption=f"{told}, of all truths of one fracAGN together, of the galaxies of the field. "
        "Purity is that of this mix of truths, not of a real field",
        text=2,
    )


def _write_selection(report, one):
    table = selection_table(one)
    report.table(
        [
            (
                SET_LABELS[row["band_set"]],
                f"{row['limit']:g}",
                row["n_wanted"],
                row["n_selected"],
                share_cell(row, "completeness"),
                share_cell(row, "purity"),
            )
            for row in table
        ],
        header=("fit", "fracAGN at least", "AGN", "selected", "completeness", "purity"),
        caption="Selections of AGN by the posterior mean of fracAGN, among all galaxies of: "
        f"{truth_figures.truth_label(one)}",
    )


# ---------------------------------------------------------------------- features


def write_features(page):
    """Residuals of the fits where PAH features are within the bands."""
    one = page.study.truths[0]
    results = page.every[one.name].results.get("all")
    if results is None or not one.sample.any():
        return
    residuals = truth_figures.band_residuals(results, page.study.bands)
    redshift = one.true("redshift")
    report = page.report
    report.section(
        "PAH features against residuals",
        "A feature that the templates of the fit lack, or have too much of, leaves a residual in the band "
        "that it falls into. Truth and fit have the same templates here, so that there is none to be expected; in "
        "observations a difference of 0.5 µm in the equivalent width at 6.2 µm would be 0.4 mag in F1500W at "
        "z = 1.5.",
    )
    report.figure(
        truth_figures.residual_figure(redshift, residuals),
        f"Measured minus best-model magnitudes of sources above 5 sigma, injected {truth_label(one)}. Shaded: "
        "redshifts at which a feature is within the band, with the median there.",
    )
    rows = []
    for band, values in residuals.items():
        own = Filter.from_name(band)
        for rest in FEATURES:
            inside, outside = feature_residuals(
                values,
                redshift,
                feature=rest,
                pivot=own.pivot,
                filter_width=own.width,
                seed=page.seed,
            )
            cells = [_plus_minus(median) for median in (inside, outside)]
            rows.append((f"{band_label(band)}, {rest.value:g} µm", inside.n, *cells))
    report.table(
        rows,
        header=("band and feature", "sources with it", "median residual", "of the others"),
        caption="Median residuals (mag) of sources with a PAH feature in a band, and of the others",
    )


#: Fewest sources whose median residual is told.
_FEWEST = 5


def _plus_minus(estimate):
    # a median of fewer, and its error, say nothing
    if estimate.n < _FEWEST or not np.isfinite(estimate.error):
        return Missing(f"fewer than {_FEWEST} sources above 5 sigma")
    return f"{estimate.value:+.3f} ± {estimate.error:.3f}"
