"""Stage 11: forced photometry."""

import numpy as np

from miricigale import photometry, psf
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.stages.exposures import (
    IMAGE_RESOURCES,
    KERNEL,
    exposure_plan,
    mosaic_memory,
    truth_bands,
)
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf, prior_psf


@stage(
    "templates",
    "templates of the sources",
    version=2,
    needs=("highres",),
    sections=("highres.filter", "highres.pixel_scale"),
    memory=mosaic_memory,
)
def make_templates(context, _):
    """Stage 11, once for all bands: what the detected sources look like on the prior."""
    templates = photometry.SourceTemplates.from_images(
        *_detections(context), psf=prior_psf(context.config), n_threads=context.n_threads
    )
    context.save_result("templates.fits", templates)


@stage(
    "photometry",
    "forced photometry",
    version=6,
    needs=("mosaics", "highres", "kernels", "templates"),
    sections=(*KERNEL, "photometry.method"),
    resources=IMAGE_RESOURCES,
    units=truth_bands,
    plan=exposure_plan,
    memory=mosaic_memory,
)
def measure_photometry(context, unit):
    """Stage 11: forced photometry of one band, on its own grid or by the steps of Yang et al. 2021."""
    truth, name = unit.split("/")
    suffix, _ = measured_mosaic(context.config)
    mosaic = context.image(f"{truth}/mosaic_{name}{suffix}.fits")
    result = measure_band(context, mosaic, name, context.config.photometry.method)
    context.save_table(f"{truth}/photometry/{name}.ecsv", result.to_table())
    context.save_image(f"{truth}/photometry/{name}_model.fits", result.model_image)
    context.save_image(f"{truth}/photometry/{name}_residual.fits", result.residual_image)


def photometer_of(context, name, method):
    """Photometer of one band: of the package, or by the steps of Yang et al. 2021 (images not scaled)."""
    config = context.config
    if method == "yang2021":
        blur = mosaic_psf(config, name, config.highres.pixel_scale)
        return photometry.Yang2021Photometer(prior_psf(config), blur, n_threads=context.n_threads)
    # the constant absorbs the light of faint sources and of wings in the background
    options = {"background_order": 0, "n_threads": context.n_threads}
    kernel = psf.MatchingKernel.read(context.path(f"kernel_{name}.fits"))
    return photometry.ForcedPhotometer(kernel, **options)


def measure_band(context, mosaic, name, method):
    """Result of the forced photometry of a mosaic of one band, ``"package"`` or ``"yang2021"``."""
    photometer = photometer_of(context, name, method)
    if method == "yang2021":
        # on the grid of the prior
        return photometer.measure(mosaic, *_detections(context))
    templates = photometry.SourceTemplates.read(context.path("templates.fits"))
    return photometer.measure(mosaic, templates=templates)


def _detections(context):
    """The high-resolution image, the labels of its segments, and the detected sources."""
    image, (_, labels) = context.image("f160w.fits"), context.image("segm.fits", "segmentation")
    return image, labels.astype(np.int32), context.table("detections.ecsv")


def joined_photometry(tables):
    """Join tables of results by band into one, with a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    return photometry.join_bands({name: table[columns] for name, table in tables.items()})
