"""What all truths of a run say together, and beside Yang et al. 2021: sections of the report."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import (
    Missing,
    StudyResults,
    TruthResults,
    compare_with_paper,
    comparison_rows,
    coverage_table,
    number,
    posterior_ranks,
    selection_table,
    study_confusion,
    study_numbers,
)
from miricigale.workflow.stages.conditions import ConditionFlags
from miricigale.workflow.stages.figures import SET_LABELS
from miricigale.workflow.stages.sample import SampleFlags, matched_errors
from miricigale.workflow.truths import FIELD

__all__ = [
    "coverage_of",
    "study_results",
    "write_comparison",
    "write_coverage",
    "write_truths",
]

#: Parameters whose posteriors are held against the truth: of the fit, and in the table of the truth.
COVERED = ("redshift", "frac_agn", "stellar_mass", "sfr_100myr", "dust_luminosity")
_OUT = SampleFlags.OUTSIDE_FIELD | SampleFlags.STAR | SampleFlags.NO_MODEL


def _truth_results(truth, tables, bands):
    """One truth as `~miricigale.evaluation.TruthResults`."""
    matched = tables.matched
    near = int(ConditionFlags.CROWDED)
    return TruthResults(
        truth.name,
        None if truth.frac_agn == FIELD else truth.frac_agn,
        tables.truth,
        matched,
        tables.fits,
        (np.asarray(matched["selection"]) & _OUT) == 0,
        {name: (np.asarray(matched[f"{name}_condition"]) & near) > 0 for name in bands},
    )


def study_results(config, truths, every, metrics):
    """
    All truths as `~miricigale.evaluation.StudyResults`.

    ``truths`` and ``every`` are `~miricigale.workflow.truths.Truth` and ``StudyTables`` by name, the
    reference first; ``metrics`` are those of the report.
    """
    bands = config.exposures.filters
    reference = next(iter(every.values()))
    # the paper's limits are where the median absolute difference is a fifth of the flux
    errors = matched_errors(
        reference.matched,
        (np.asarray(reference.matched["selection"]) & SampleFlags.OUTSIDE_FIELD) == 0,
        bands,
        statistic="median_abs",
        bin_size=config.errors.bin_size,
    )
    return StudyResults(
        tuple(_truth_results(truths[name], tables, bands) for name, tables in every.items()),
        bands,
        config.highres.filter,
        {name: float(errors.limiting_magnitude(name).value) for name in bands},
        {name: metrics["bands"][name]["etc_limit"] for name in bands},
    )


def coverage_of(tables, seed):
    """
    Coverage of the posteriors of a truth, as `~miricigale.evaluation.coverage_table`.

    Names are ``<set> <parameter>``. Ranks are randomized within cells of the grid, for injected
    fractions lie on its nodes.
    """
    ranks = {}
    for unit, results in tables.results.items():
        for name in COVERED:
            if name in tables.truth.colnames and len(results):
                values, levels = results.cdf(name)
                true = u.Quantity(tables.sample[name]).to_value(values.unit)
                found = posterior_ranks(true, values.value, levels, seed=seed)
                ranks[f"{unit} {name}"] = found
    return coverage_table(ranks)


def write_truths(context, report, study, metrics, columns):
    """
    Sections on all truths together; without a second one there are none.

    ``columns`` are those of a table of fits, header to the cell of a set of bands and its metrics.
    """
    context.save_table("report/numbers.ecsv", study_numbers(study, seed=context.seed, n_draws=300))
    if len(study.truths) < 2:
        return
    report.section(
        "AGN of different strength",
        "The same galaxies with AGN of other strength, each sky exposed, reduced, measured and fitted "
        "alike. Every source has an AGN drawn from the ranges of Yang et al. 2021, or, in the realistic "
        "field, one of the luminosity that the luminosity function of Ueda et al. 2014 gives to galaxies of "
        "its mass and redshift; errors of the fluxes are by the error function of the first truth.",
    )
    rows = [
        (_told(truth["frac_agn"]), *(cell(entry) for cell in columns.values()))
        for truth in metrics["truths"].values()
        for entry in truth["fits"].items()
    ]
    report.table(
        rows,
        header=("injected fracAGN", *columns),
        caption="Sources detected in enough MIRI bands, the same with each set of bands",
        text=2,
    )
    for unit in ("all", "none"):
        if unit in study.truths[0].fits:
            _write_confusion(report, study, unit)
    for one in study.truths:
        if one.frac_agn is None:
            _write_selection(report, one)


def write_coverage(report, tables, model_error, seed):
    """Table of the coverage of the posteriors of a truth."""
    table = coverage_of(tables, seed)
    if len(table) == 0:
        return
    rows = {}
    for row in table:
        rows.setdefault(row["name"], []).append(row)
    report.table(
        [
            (
                SET_LABELS[name.partition(" ")[0]],
                name.partition(" ")[2].replace("_", " "),
                parts[0]["n"],
                *(_share(part, "share") for part in parts),
                f"{parts[0]['mean_rank']:.2f}",
            )
            for name, parts in rows.items()
        ],
        header=("fit", "parameter", "sources", "in 68 %", "in 95 %", "mean rank"),
        caption="Share of the true values in the central intervals of their posteriors, with its own "
        f"68 % interval; the fits allow for {100 * model_error:g} % of model error that the truth "
        "does not have, so that more than 68 % is to be expected. Mean rank: 0.5 without bias, lower "
        "where the fits are too high",
        text=2,
    )


def _told(frac_agn):
    return "realistic field" if frac_agn == FIELD else f"{frac_agn:g}"


def _share(row, name):
    none = "no such source"
    low, high = (number(row[f"{name}_{end}"], ".0f", none, scale=100) for end in ("low", "high"))
    if isinstance(low, Missing):
        return low
    return f"{100 * row[name]:.0f} % ({low} to {high})"


def _write_confusion(report, study, unit):
    table = study_confusion(study, unit)
    names = [name for name in table.colnames if name in (*table["class"], "unknown")]
    report.table(
        [
            (
                row["class"],
                row["n"],
                *(row[name] for name in names),
                _share(row, "completeness"),
                _share(row, "purity"),
            )
            for row in table
        ],
        header=(
            "true class",
            "sources",
            *(f"found {name}" for name in names),
            "completeness",
            "purity",
        ),
        caption=f"Classes by fracAGN (galaxy below 0.1, composite below 0.4) {SET_LABELS[unit]}, of all "
        "truths of one fracAGN together; unknown: in the field, but not in the fit",
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
                _share(row, "completeness"),
                _share(row, "purity"),
            )
            for row in table
        ],
        header=("fit", "fracAGN at least", "AGN", "selected", "completeness", "purity"),
        caption="Selections of AGN by the posterior mean of fracAGN, among all galaxies of the "
        "realistic field",
    )


def write_comparison(context, report, study, as_paper):
    """The section that holds all numbers of Yang et al. 2021 against those of the run."""
    table = compare_with_paper(study, seed=context.seed)
    context.save_table("report/paper.ecsv", table)
    note = "" if as_paper else " This run has other exposures or bands than the paper's."
    report.section(
        "Beside Yang et al. 2021",
        "Every number of the paper's results, and this run's with its bootstrap error. It is another field, with "
        "its own noise: conclusions are to be compared, not digits. [?] marks numbers that were not read "
        f"in the paper itself; completeness is the share of the field's galaxies that a number is of.{note}",
    )
    report.table(
        comparison_rows(table),
        header=("part", "number", "paper", "here", "completeness", "verdict"),
        caption="Numbers of Yang et al. 2021 and of this run",
        text=2,
    )
