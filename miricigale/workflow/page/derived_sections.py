"""Sections of the page on what was measured besides: experiments, rivals, variants, perturbed skies."""

import numpy as np

from miricigale.evaluation import PUBLISHED
from miricigale.pages import Missing, number, sentence
from miricigale.utils.tables import described_rows
from miricigale.workflow.derived import NO_SOURCE, rows_of
from miricigale.workflow.labels import band_label, texts_of
from miricigale.workflow.page.band_figures import rival_figure, variant_figure
from miricigale.workflow.stages.experiments import (
    AGN_ERROR,
    N_FREE,
    experiment_numbers,
    ranked_table,
)
from miricigale.workflow.stages.exposures import band_names
from miricigale.workflow.stages.perturbed import NONE, perturbation_costs
from miricigale.workflow.stages.rivals import (
    RIVALS,
    SE_BAND,
    blind_offset,
    rival_counts,
    rival_numbers,
)
from miricigale.workflow.stages.variants import (
    RATES,
    STUDY,
    variant_numbers,
)
from miricigale.workflow.truths import ALL, variant_changes


def write_experiments(page, tables):
    """
    Write the section on the further fits; ``tables`` are the ``StudyTables`` of all truths by name.

    Each is compared with the fit of the study with all bands of the same sources.
    """
    context = page.context
    names = page.config.fit.experiments
    if not names:
        return
    rows = []
    for truth, study in tables.items():
        reference = ranked_table(study.results["all"], study.sample, context.seed)
        fits = [("study", reference)]
        for name, table in context.tables(f"{truth}/experiments", names).items():
            if 0 < len(table) < len(reference):
                # of the study's fit, the same sources
                fits.append(("study", rows_of(reference, table["id"])))
            fits.append((name, table))
        for name, table in fits:
            row = {"truth": truth, "experiment": name, "n_sources": len(table)}
            rows.append(row | experiment_numbers(study.sample, table))
    texts = {key: key.replace("_", " ") for key in rows[0]}
    texts |= {"truth": "Sky", "experiment": "Fit", "n_sources": "Sources"}
    numbers = described_rows(rows, texts)
    declared = texts_of("experiments")
    sentences = " ".join(declared["sentences"][name] for name in names)
    sentences = sentence(sentences, {"n_free": N_FREE, "agn_error": AGN_ERROR})
    page.numbers("experiments", numbers, sentences=sentences)
    labels = declared["labels"]
    page.table("table", [dict(row) | {"fit": labels[row["experiment"]]} for row in numbers])


def write_rivals(page, tables):
    """Write the section on rival photometry, unless there are no tables."""
    if not tables:
        return
    numbers = rival_numbers(tables)
    page.numbers("rivals", numbers)
    # rows by group, and by band, with a cell for each method
    groups = {}
    bands = {}
    for row in numbers:
        label = RIVALS[row["method"]]
        cell = number(row["median"], "+.1f %", NO_SOURCE, error=row["scatter"])
        if not isinstance(cell, Missing):
            cell += f" ({row['n']})"
        if row["band"] == "all" and row["kind"] != "all":
            group = {"by": row["kind"], "sources": row["group"], "in the group": row["n_group"]}
            group = groups.setdefault((row["kind"], row["group"]), group)
            group[label] = cell
        elif row["band"] != "all" and row["kind"] == "all":
            band = {"band": band_label(row["band"]), "above 5 sigma": row["n_group"]}
            band = bands.setdefault(row["band"], band)
            band[label] = cell
            band[f"pulls, {label}"] = number(row["pull_scatter"], ".1f", NO_SOURCE)
    shown = SE_BAND
    if SE_BAND not in tables:
        shown = next(iter(tables))
    page.figure("figure", rival_figure(tables[shown]), band=band_label(shown))
    page.table("groups", groups.values())
    page.table("bands", bands.values())
    rows = []
    for name, table in tables.items():
        counts = rival_counts(table)
        offset = blind_offset(table, page.context.seed)
        row = {"band": band_label(name), "offset": offset.value, "offset_err": offset.error}
        row |= {key: count.n for key, count in counts.items()}
        row["share"] = counts["missed"].value
        rows.append(row)
    page.table("source_extractor", rows)


#: What variant images are called: where the key is on, and where it is off.
_VARIANTS = texts_of("variants")["labels"]


def variant_label(name, changes):
    """Return the name of images on the page."""
    if name == STUDY:
        return "of the study"
    if name == RATES:
        return "the same, by rates"
    (values,) = changes[name].values()
    (value,) = values.values()
    return _VARIANTS[name][0 if value else 1]


def variant_entries(table, changes):
    """
    Return the rows of the table of variant images.

    ``table`` is of `~miricigale.workflow.stages.variants.variant_numbers`, ``changes`` of
    `~miricigale.workflow.truths.variant_changes`.
    """
    rows = []
    for numbers in table:
        row = dict(numbers)
        row["band"] = band_label(numbers["band"])
        row["images"] = variant_label(numbers["images"], changes)
        row["offset"] = numbers["limit"] - numbers["calculator"]
        rows.append(row)
    return rows


def measured_reasons(table, config):
    """
    Return the reasons of differences with the paper, by key of `~miricigale.evaluation.PUBLISHED`.

    Those of limits have what the variants change of them, of ``table``, which is None without variants.
    """
    reasons = {published.key: published.why for published in PUBLISHED}
    if table is None:
        return reasons
    changes = variant_changes(config)
    for row in table:
        key = f"limit.{row['band'].removeprefix('miri.')}"
        if key in reasons and row["images"] in _VARIANTS and np.isfinite(row["limit_change"]):
            cost = f"{variant_label(row['images'], changes)} {row['limit_change']:+.2f} mag"
            if reasons[key]:
                reasons[key] = f"{reasons[key]}; {cost}"
            else:
                reasons[key] = cost
    return reasons


def write_variants(page, matched, limits):
    """
    Write the section on variant images.

    ``matched`` is of the reference truth, ``limits`` are those of the calculator by band.

    Returns the numbers, or None where there are no variants.
    """
    context = page.context
    config = page.config
    changes = variant_changes(config)
    if not changes:
        return None
    bands = band_names(config)
    table = variant_numbers(
        matched,
        {name: context.tables(f"variants/{name}", bands) for name in changes},
        limits,
        seed=context.seed,
        statistic=config.errors.statistic,
        bin_size=config.errors.bin_size,
    )
    gradient = ""
    if "gradient" in changes:
        gradient = texts_of("optional")["gradient"]
    page.numbers("variants", table, gradient=gradient)
    labels = {name: variant_label(name, changes) for name in (STUDY, *changes)}
    page.figure("figure", variant_figure(table, labels))
    page.table("table", variant_entries(table, changes))
    return table


def write_perturbed(page, truths, tables):
    """Write the section with one table, if there are perturbed truths."""
    config = page.config
    costs = perturbation_costs(truths, tables, config.exposures.filters, seed=page.context.seed)
    if len(costs) == 0:
        return
    texts = texts_of("perturbations")
    names = set(costs["perturbation"])
    effects = "; ".join(text for name, text in texts["effects"].items() if name in names)
    effects = sentence(effects, {"size": config.perturb})
    together = ""
    if ALL in names:
        together = " and together"
    page.numbers("perturbations", costs, effects=effects, together=together)
    rows = {}
    for row in costs:
        sky = {"sky": row["truth"], "perturbation": texts["labels"][row["perturbation"]]}
        cells = rows.setdefault((row["truth"], row["perturbation"]), sky)
        cells[_header(row["quantity"])] = _cell(row)
    page.table("table", rows.values())


def _header(quantity):
    """Return the head of a column: a quantity whose first word may be a band."""
    band, _, name = quantity.partition(" ")
    if "." in band:
        return f"{band_label(band)} {name}"
    return quantity


def _cell(row):
    """Return the text of a value and its change; per cent but for scatter of redshifts and fracAGN."""
    quantity = row["quantity"]
    is_share = "." in quantity or quantity.endswith("outliers")
    spec = ".4f"
    if is_share:
        spec = ".1f %"
    signed = spec
    if quantity.endswith("offset"):
        signed = f"+{spec}"
    if row["perturbation"] == NONE:
        return number(row["value"], signed, "no source", error=row["value_err"])
    cell = number(row["value"], signed, "no source", error=None)
    if isinstance(cell, Missing):
        return cell
    return f"{cell} ({number(row['change'], f'+{spec}', '', error=row['change_err'])})"
