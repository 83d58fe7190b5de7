"""Stage 14: truth and results to numbers, figures and one page."""

import dataclasses
import json
import logging

import astropy.units as u
import numpy as np
from astropy.wcs.utils import pixel_to_pixel

from miricigale import sed
from miricigale.evaluation import study_numbers
from miricigale.pages import Page
from miricigale.psf import MatchingKernel
from miricigale.utils.named_values import subset
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.page import paper
from miricigale.workflow.page.derived_sections import (
    measured_reasons,
    write_experiments,
    write_perturbed,
    write_rivals,
    write_variants,
)
from miricigale.workflow.page.image_sections import (
    field_text,
    write_detections,
    write_images,
    write_summary,
)
from miricigale.workflow.page.numbers import StudyTables, study_metrics, truth_metrics, whole_sample
from miricigale.workflow.page.photometry_sections import (
    write_errors,
    write_inputs,
    write_photometry,
)
from miricigale.workflow.page.provenance import stand_ins, write_exposures, write_origin
from miricigale.workflow.page.result_sections import write_results
from miricigale.workflow.page.study_page import StudyPage
from miricigale.workflow.stages import rivals
from miricigale.workflow.stages.exposures import EXPOSURE_RESOURCES, IMAGES, exposure_plan
from miricigale.workflow.stages.grids import (
    grid_of,
    of_patch,
    patch_grid,
    shown_patch,
    study_patches,
)
from miricigale.workflow.stages.inputs import sed_resources, sources_memory
from miricigale.workflow.stages.sample import footprint_area
from miricigale.workflow.truths import reference, study_truths

log = logging.getLogger(__name__)


#: Stages whose products are read: of the inputs and images, and of the measurements.
_IMAGES = ("catalog", "seds", "exposures", "mosaics", "highres", "kernels", "points", "variants")
_TABLES = ("truth", "photometry", "errors", "matches", "rivals", "fits", "experiments", "skies")
#: Sections of the configuration on the measurements.
_MEASURED = ("highres", "photometry", "errors", "fit", "point_sources", "perturb", "variants")


@stage(
    "report",
    "report",
    version=11,
    needs=_IMAGES + _TABLES,
    sections=("run.name", "catalog", "sed") + IMAGES + ("patches",) + _MEASURED + ("report",),
    resources=lambda: (*sed_resources(), *EXPOSURE_RESOURCES),
    plan=exposure_plan,
    memory=sources_memory,
)
def make_report(context, _):
    """Stage 14: the page with its figures, and the numbers as JSON."""
    config = context.config
    truths = study_truths(config)
    shown = reference(config)
    model = sed.SEDModel.yang2021()
    tables = {name: StudyTables(context, name) for name in truths}
    # truths of whose sky the analysis knows all
    unperturbed = {name: truth for name, truth in truths.items() if not truth.perturbations}
    study_tables = subset(tables, unperturbed)
    area = _field_area(context, shown)
    metrics = study_metrics(config, tables[shown], area)
    study = paper.study_results(config, unperturbed, study_tables, metrics)
    patch = shown_patch(config)
    mosaics, kernels = _patch_products(context, shown, patch)
    rival_tables = rivals.read_rivals(context)
    extra = paper.extra_numbers(study, metrics, kernels)
    extra |= rivals.source_extractor_numbers(rival_tables, context.seed)
    study = dataclasses.replace(study, extra=extra)
    numbers = _save_numbers(context, study, unperturbed, tables, metrics)
    subtitle = f"{metrics['n_field']} galaxies in {field_text(config)}, injected fracAGN "
    subtitle += f"{', '.join(map(str, config.sed.frac_agn))}, seed {context.seed}"
    title = f"miricigale: {config.run.name}"
    report = Page(title, subtitle=subtitle, dpi=config.report.dpi)
    page = StudyPage(report, context, study_tables, study, metrics, kernels, model, area)
    write_summary(page, truths, numbers, stand_ins(config, model))
    write_exposures(page)
    write_images(page, mosaics, patch)
    write_detections(page)
    write_photometry(page)
    write_rivals(page, rival_tables)
    write_errors(page)
    calculator = {name: entry["etc_limit"] for name, entry in metrics["bands"].items()}
    matched = page.tables.matched
    variants = write_variants(page, matched, calculator)
    write_results(page, numbers)
    write_experiments(page, study_tables)
    reasons = measured_reasons(variants, config)
    paper.write_comparison(page, reasons, paper.differences_of(config, metrics, model))
    write_perturbed(page, truths, tables)
    write_inputs(page)
    write_origin(page, [page.tables.truth.meta, matched.meta])
    context.save("report/index.html", lambda path: report.write(path))


def _save_numbers(context, study, truths, tables, metrics):
    """Save the numbers of the fits, add those of the whole samples to ``metrics``, and return these."""
    numbers = study_numbers(study, seed=context.seed, n_draws=300)
    context.save_table("report/numbers.ecsv", numbers)
    numbers = whole_sample(numbers)
    metrics["truths"] = {}
    for name, truth in truths.items():
        metrics["truths"][name] = truth_metrics(
            truth, tables[name], numbers, study.bands, context.seed
        )
    metrics["fits"] = metrics["truths"][study.truths[0].name]["fits"]
    if metrics["n_sample"] == 0:
        log.warning("no source is left to fit: %s", metrics["n_left_out"])
    _save_metrics(context, metrics)
    return numbers


def _patch_products(context, truth, patch):
    """Return the mosaics and kernels of a patch by band, as the truth of this name has them."""
    mosaics = {}
    kernels = {}
    for name in study_patches(context.config)[patch].bands:
        mosaics[name] = context.image(f"{of_patch(f'{truth}/mosaic_{name}', patch)}.fits")
        path = context.path(f"{of_patch(f'kernel_{name}', patch)}.fits")
        kernels[name] = MatchingKernel.read(path)
    return mosaics, kernels


def _save_metrics(context, metrics):
    """Save the numbers as JSON, with null for NaN, which JSON does not know."""
    values = json.loads(json.dumps(metrics), parse_constant=lambda _: None)
    text = json.dumps(values, indent=1)
    context.save("report/metrics.json", lambda path: path.write_text(text, encoding="utf-8"))


def _field_area(context, truth):
    """Return the solid angle of the field of all bands, that of each patch in its core."""
    config = context.config
    area = 0 * u.arcmin**2
    for name, patch in study_patches(config).items():
        if patch.bands == tuple(config.exposures.filters):
            mosaics = []
            for band in patch.bands:
                path = of_patch(f"{truth}/mosaic_{band}", name)
                mosaics.append(context.image(f"{path}.fits"))
            area += footprint_area(mosaics, _core_of(config, name, mosaics[0].wcs))
    return area


def _core_of(config, patch, wcs):
    """Tell which pixels of a mosaic are in the core of its patch."""
    if not patch:
        return True
    grid = patch_grid(config)
    prior = grid_of(config, config.highres.pixel_scale)
    nx, ny = wcs.pixel_shape
    # both grids have the same axes
    x = pixel_to_pixel(wcs, prior, np.arange(nx), np.zeros(nx))[0]
    y = pixel_to_pixel(wcs, prior, np.zeros(ny), np.arange(ny))[1]
    holder = grid.holder(np.stack(np.meshgrid(x, y), axis=-1))
    return (holder == grid.names.index(patch)).reshape(ny, nx)
