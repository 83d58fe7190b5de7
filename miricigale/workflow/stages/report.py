"""Stage 14: truth and results to numbers, figures and one page."""

import dataclasses
import json
import logging

import numpy as np

from miricigale import sed
from miricigale.evaluation import study_numbers
from miricigale.pages import Page
from miricigale.workflow.stage import stage
from miricigale.workflow.stages import (
    comparison,
    experiments,
    perturbed,
    provenance,
    rivals,
    variants,
)
from miricigale.workflow.stages.exposures import (
    EXPOSURE_RESOURCES,
    GRID,
    exposure_plan,
)
from miricigale.workflow.stages.image_sections import ImageSections, field_text
from miricigale.workflow.stages.input_sections import write_inputs
from miricigale.workflow.stages.inputs import sed_resources
from miricigale.workflow.stages.metrics import StudyTables, study_metrics, truth_metrics
from miricigale.workflow.stages.sample import footprint_area
from miricigale.workflow.stages.truth_sections import ResultsPage, write_results
from miricigale.workflow.truths import reference, study_truths

__all__ = ["make_report"]

log = logging.getLogger(__name__)


@stage(
    "report",
    "report",
    version=7,
    needs=(
        "catalog",
        "truth",
        "exposures",
        "mosaics",
        "highres",
        "kernels",
        "photometry",
        "points",
        "errors",
        "matches",
        "rivals",
        "variants",
        "fits",
        "experiments",
    ),
    sections=(
        *GRID,
        "run.name",
        "catalog",
        "sed",
        "scene",
        "detector",
        "highres.filter",
        "highres.pixel_scale",
        "photometry.method",
        "photometry.rivals",
        "reduction",
        "fit",
        "errors",
        "point_sources",
        "perturb",
        "variants",
        "report",
    ),
    resources=lambda: (*sed_resources(), *EXPOSURE_RESOURCES),
    plan=exposure_plan,
    kernels=("fit",),
)
def make_report(context, _):
    """Stage 14: the page with its figures, and the numbers as JSON."""
    config = context.config
    bands, truths = config.exposures.filters, study_truths(config)
    every = {name: StudyTables.read(context, name) for name in truths}
    shown = reference(config)
    tables = every[shown]
    mosaics = {name: context.image(f"{shown}/mosaic_{name}.fits") for name in bands}
    area = footprint_area(mosaics.values())
    metrics = study_metrics(config, tables, area)
    model = sed.SEDModel.yang2021()
    # those of whose sky the analysis knows all
    known = {name: truth for name, truth in truths.items() if not truth.perturbations}
    others = rivals.read_rivals(context)
    known_tables = {name: every[name] for name in known}
    study = comparison.study_results(config, known, known_tables, metrics)
    shares = comparison.agn_shares(study, model)
    extra = comparison.extra_numbers(study, metrics, shares, context.seed)
    extra |= rivals.source_extractor_numbers(others, context.seed)
    study = dataclasses.replace(study, extra=extra)
    numbers = study_numbers(study, seed=context.seed, n_draws=300)
    context.save_table("report/numbers.ecsv", numbers)
    metrics["truths"] = {
        name: truth_metrics(truth, every[name], numbers, bands) for name, truth in known.items()
    }
    metrics["fits"] = metrics["truths"][shown]["fits"]
    if metrics["n_sample"] == 0:
        log.warning("no source is left to fit: %s", metrics["n_left_out"])
    text = json.dumps(_without_nan(metrics), indent=1, allow_nan=False)
    context.save("report/metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    report = Page(
        f"miricigale: {config.run.name}",
        subtitle=(
            f"{metrics['n_field']} galaxies in {field_text(config)}, injected fracAGN "
            f"{', '.join(map(str, config.sed.frac_agn))}, seed {context.seed}"
        ),
        notices=provenance.stand_ins(config, model),
        dpi=config.report.dpi,
    )
    writer = ImageSections(context, report, tables, metrics, study, mosaics, truths[shown])
    writer.summary()
    report.links("The sources one by one:", [(name, f"sources-{name}.html") for name in truths])
    provenance.write_exposures(context, report, metrics, shown)
    writer.images()
    writer.detections()
    writer.photometry()
    rivals.write_rivals(context, report, others)
    writer.errors()
    calculator = {name: entry["etc_limit"] for name, entry in metrics["bands"].items()}
    switched = variants.write_variants(context, report, tables.matched, calculator)
    write_results(
        ResultsPage(
            report,
            study,
            known_tables,
            metrics,
            numbers,
            shares,
            model,
            config.fit.model_error,
            context.seed,
        )
    )
    experiments.write_experiments(context, report, known_tables)
    reasons, sentences = comparison.reasons_of(config, metrics, model)
    variants.add_reasons(reasons, switched, config)
    comparison.write_comparison(context, report, study, reasons, sentences)
    perturbed.write_perturbed(context, report, truths, every)
    write_inputs(report, tables, metrics, config, area)
    provenance.write_origin(report, config, model, [tables.truth.meta, tables.matched.meta])
    context.save("report/index.html", lambda path: report.write(path))


def _without_nan(values):
    """The same values with None for NaN, which JSON does not know."""
    if isinstance(values, dict):
        return {key: _without_nan(value) for key, value in values.items()}
    if isinstance(values, list):
        return [_without_nan(value) for value in values]
    return None if isinstance(values, float) and not np.isfinite(values) else values


#: Why numbers of the fits are missing.
