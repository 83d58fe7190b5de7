"""Sections of the page on what was measured besides: experiments, rivals, variants, perturbed skies."""

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
from miricigale.workflow.stages.perturbed import EFFECT_LABELS, NONE, perturbation_costs
from miricigale.workflow.stages.rivals import (
    RIVALS,
    SE_BAND,
    blind_offset,
    rival_counts,
    rival_numbers,
)
from miricigale.workflow.stages.variants import (
    STUDY,
    variant_entries,
    variant_label,
    variant_numbers,
)
from miricigale.workflow.truths import ALL, variant_changes


def write_experiments(page, every):
    """
    Write the section on the further fits; ``every`` are the ``StudyTables`` of all truths by name.

    Each is compared with the fit of the study with all bands of the same sources.
    """
    context, names = page.context, page.config.fit.experiments
    if not names:
        return
    rows = []
    for of, study in every.items():
        own = ranked_table(study.results["all"], study.sample, context.seed)
        fits = [("study", own)]
        for name, table in context.tables(f"{of}/experiments", names).items():
            if 0 < len(table) < len(own):
                fits.append(("study", rows_of(own, table["id"])))
            fits.append((name, table))
        for name, table in fits:
            row = {"truth": of, "experiment": name, "n_sources": len(table)}
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
    # by group of each band: what is shown for each method
    groups, bands = {}, {}
    for row in numbers:
        label = RIVALS[row["method"]]
        cell = number(row["median"], "+.1f %", NO_SOURCE, error=row["scatter"])
        if not isinstance(cell, Missing):
            cell += f" ({row['n']})"
        if row["band"] == "all" and row["kind"] != "all":
            known = {"by": row["kind"], "sources": row["group"], "in the group": row["n_group"]}
            groups.setdefault((row["kind"], row["group"]), known)[label] = cell
        elif row["band"] != "all" and row["kind"] == "all":
            known = {"band": band_label(row["band"]), "above 5 sigma": row["n_group"]}
            pulls = number(row["pull_scatter"], ".1f", NO_SOURCE)
            bands.setdefault(row["band"], known).update({label: cell, f"pulls, {label}": pulls})
    shown = SE_BAND if SE_BAND in tables else next(iter(tables))
    page.figure("figure", rival_figure(tables[shown]), band=band_label(shown))
    page.table("groups", groups.values())
    page.table("bands", bands.values())
    rows = []
    for name, table in tables.items():
        counts, offset = rival_counts(table), blind_offset(table, page.context.seed)
        row = {"band": band_label(name), "offset": offset.value, "offset_err": offset.error}
        row |= {key: one.n for key, one in counts.items()}
        rows.append(row | {"share": counts["missed"].value})
    page.table("source_extractor", rows)


def write_variants(page, matched, limits):
    """
    Write the section on variant images.

    ``matched`` is of the reference truth, ``limits`` are those of the calculator by band.

    Returns the numbers, or None where there are no variants.
    """
    context, config, changes = page.context, page.config, variant_changes(page.config)
    if not changes:
        return None
    bands = band_names(config)
    tables = {name: context.tables(f"variants/{name}", bands) for name in changes}
    options = {"statistic": config.errors.statistic, "bin_size": config.errors.bin_size}
    table = variant_numbers(matched, tables, limits, seed=context.seed, **options)
    gradient = texts_of("optional")["gradient"] if "gradient" in changes else ""
    page.numbers("variants", table, gradient=gradient)
    labels = {name: variant_label(name, changes) for name in (STUDY, *changes)}
    page.figure("figure", variant_figure(table, labels))
    page.table("table", variant_entries(table, changes))
    return table


def write_perturbed(page, truths, every):
    """Write the section with one table, if there are perturbed truths."""
    config = page.config
    table = perturbation_costs(truths, every, config.exposures.filters, seed=page.context.seed)
    if len(table) == 0:
        return
    found = set(table["perturbation"])
    effects = [t for name, t in texts_of("perturbations")["effects"].items() if name in found]
    effects = sentence("; ".join(effects), {"size": config.perturb})
    together = " and together" if ALL in found else ""
    page.numbers("perturbations", table, effects=effects, together=together)
    rows = {}
    for row in table:
        known = {"sky": row["truth"], "perturbation": EFFECT_LABELS[row["perturbation"]]}
        cells = rows.setdefault((row["truth"], row["perturbation"]), known)
        cells[_header(row["quantity"])] = _cell(row)
    page.table("table", rows.values())


def _header(quantity):
    first, _, rest = quantity.partition(" ")
    return f"{band_label(first)} {rest}" if "." in first else quantity


def _cell(row):
    """Text of a value and its change; per cent but for scatter of redshifts and fracAGN."""
    share = "." in row["quantity"] or row["quantity"].endswith("outliers")
    spec, alone = ".1f %" if share else ".4f", row["perturbation"] == NONE
    signed = "+" if row["quantity"].endswith("offset") else ""
    error = row["value_err"] if alone else None
    cell = number(row["value"], signed + spec, "no source", error=error)
    if alone or isinstance(cell, Missing):
        return cell
    return f"{cell} ({number(row['change'], f'+{spec}', '', error=row['change_err'])})"
