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
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.page import paper
from miricigale.workflow.page.derived_sections import (
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
from miricigale.workflow.stages import rivals, variants
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
    needs=(*_IMAGES, *_TABLES),
    sections=("run.name", "catalog", "sed", *IMAGES, "patches", *_MEASURED, "report"),
    resources=lambda: (*sed_resources(), *EXPOSURE_RESOURCES),
    plan=exposure_plan,
    memory=sources_memory,
)
def make_report(context, _):
    """Stage 14: the page with its figures, and the numbers as JSON."""
    config, truths, model = context.config, study_truths(context.config), sed.SEDModel.yang2021()
    every = {name: StudyTables(context, name) for name in truths}
    shown, bands = reference(config), config.exposures.filters
    area = _field_area(context, shown)
    patch = shown_patch(config)
    own = study_patches(config)[patch].bands
    path = of_patch(f"{shown}/mosaic_{{}}", patch)
    mosaics = {name: context.image(f"{path.format(name)}.fits") for name in own}
    metrics = study_metrics(config, every[shown], area)
    # those of whose sky the analysis knows all
    known = {name: truth for name, truth in truths.items() if not truth.perturbations}
    tables = {name: every[name] for name in known}
    others = rivals.read_rivals(context)
    study = paper.study_results(config, known, tables, metrics)
    path = of_patch("kernel_{}", patch)
    kernels = {n: MatchingKernel.read(context.path(f"{path.format(n)}.fits")) for n in own}
    extra = paper.extra_numbers(study, metrics, kernels)
    extra |= rivals.source_extractor_numbers(others, context.seed)
    study = dataclasses.replace(study, extra=extra)
    numbers = study_numbers(study, seed=context.seed, n_draws=300)
    context.save_table("report/numbers.ecsv", numbers)
    numbers = whole_sample(numbers)
    metrics["truths"] = {
        name: truth_metrics(truth, tables[name], numbers, bands, context.seed)
        for name, truth in known.items()
    }
    metrics["fits"] = metrics["truths"][shown]["fits"]
    if metrics["n_sample"] == 0:
        log.warning("no source is left to fit: %s", metrics["n_left_out"])
    # JSON does not know NaN
    text = json.dumps(json.loads(json.dumps(metrics), parse_constant=lambda _: None), indent=1)
    context.save("report/metrics.json", lambda path: path.write_text(text, encoding="utf-8"))
    subtitle = f"{metrics['n_field']} galaxies in {field_text(config)}, injected fracAGN "
    subtitle += f"{', '.join(map(str, config.sed.frac_agn))}, seed {context.seed}"
    title = f"miricigale: {config.run.name}"
    report = Page(title, subtitle=subtitle, dpi=config.report.dpi)
    page = StudyPage(report, context, tables, study, metrics, kernels, model, area)
    write_summary(page, truths, numbers, stand_ins(config, model))
    write_exposures(page)
    write_images(page, mosaics, patch)
    write_detections(page)
    write_photometry(page)
    write_rivals(page, others)
    write_errors(page)
    calculator = {name: entry["etc_limit"] for name, entry in metrics["bands"].items()}
    matched = page.tables.matched
    switched = write_variants(page, matched, calculator)
    write_results(page, numbers)
    write_experiments(page, tables)
    reasons = variants.measured_reasons(switched, config)
    paper.write_comparison(page, reasons, paper.differences_of(config, metrics, model))
    write_perturbed(page, truths, every)
    write_inputs(page)
    write_origin(page, [page.tables.truth.meta, matched.meta])
    context.save("report/index.html", lambda path: report.write(path))


def _field_area(context, truth):
    """Solid angle of the field of all bands, that of each patch in its core."""
    config, area = context.config, 0 * u.arcmin**2
    for patch, one in study_patches(config).items():
        if one.bands == tuple(config.exposures.filters):
            path = of_patch(f"{truth}/mosaic_{{}}", patch)
            mosaics = [context.image(f"{path.format(band)}.fits") for band in one.bands]
            area += footprint_area(mosaics, _core_of(config, patch, mosaics[0].wcs))
    return area


def _core_of(config, patch, wcs):
    """Which pixels of a mosaic are in the core of its patch."""
    if not patch:
        return True
    grid, whole = patch_grid(config), grid_of(config, config.highres.pixel_scale)
    nx, ny = wcs.pixel_shape
    # both grids have the same axes
    x = pixel_to_pixel(wcs, whole, np.arange(nx), np.zeros(nx))[0]
    y = pixel_to_pixel(wcs, whole, np.zeros(ny), np.arange(ny))[1]
    holder = grid.holder(np.stack(np.meshgrid(x, y), axis=-1))
    return (holder == grid.names.index(patch)).reshape(ny, nx)
