"""Whether the posteriors of a run are as wide as they should be: a section of the report."""

import astropy.units as u

from miricigale.evaluation import coverage_table, posterior_ranks
from miricigale.pages import Missing, number
from miricigale.workflow.stages import truth_figures
from miricigale.workflow.stages.figures import SET_LABELS
from miricigale.workflow.stages.truth_figures import parameter_label, truth_label

__all__ = ["coverage_of", "posterior_ranks_of", "share_cell", "write_coverage"]

#: Parameters whose posteriors are held against the truth: of the fit, and in the table of the truth.
COVERED = ("redshift", "frac_agn", "stellar_mass", "sfr_100myr", "dust_luminosity")
#: Those whose ranks are drawn.
RANKED = ("redshift", "frac_agn", "stellar_mass")


def share_cell(row, name):
    """A share of a row with its interval: text, or why there is none."""
    none = "no such source"
    low, high = (number(row[f"{name}_{end}"], ".0f", none, scale=100) for end in ("low", "high"))
    if isinstance(low, Missing):
        return low
    return f"{100 * row[name]:.0f} % ({low} to {high})"


def posterior_ranks_of(tables, seed):
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


def coverage_of(ranks):
    """Coverage by ``<set> <parameter>`` (`~miricigale.evaluation.coverage_table`) of such ranks."""
    return coverage_table({" ".join(key): values for key, values in ranks.items()})


def write_coverage(page):
    """Ranks of the truth in the posteriors, and how many are within central intervals."""
    one = page.study.truths[0]
    ranks = posterior_ranks_of(page.every[one.name], page.seed)
    table = coverage_of(ranks)
    if len(table) == 0:
        return
    page.report.section(
        "Coverage of the posteriors",
        f"The fits allow for {100 * page.model_error:g} % of model error that the truth does not have: "
        "posteriors are wider than they would have to be.",
    )
    page.figure(
        truth_figures.rank_figure({k: v for k, v in ranks.items() if k[1] in RANKED}),
        f"Ranks of the true values in their posteriors, injected {truth_label(one)}; right posteriors "
        "give 1 throughout (gray: 1 sigma of chance), too wide ones fewer ranks near 0 and 1, too narrow "
        "ones more.",
    )
    rows = {}
    for row in table:
        rows.setdefault(row["name"], []).append(row)
    page.report.table(
        [
            (
                SET_LABELS[name.partition(" ")[0]],
                parameter_label(name.partition(" ")[2]),
                parts[0]["n"],
                *(share_cell(part, "share") for part in parts),
                f"{parts[0]['mean_rank']:.2f}",
            )
            for name, parts in rows.items()
        ],
        header=("fit", "parameter", "sources", "in 68 %", "in 95 %", "mean rank"),
        caption="Share of the true values in the central intervals of their posteriors, with its own "
        "68 % interval. Mean rank: 0.5 without bias, lower where the fits are too high",
        text=2,
    )
