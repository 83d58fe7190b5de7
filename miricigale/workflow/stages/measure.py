"""Stage 11: forced photometry."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale import photometry, psf
from miricigale.utils.tables import error_column
from miricigale.workflow.stage import stage
from miricigale.workflow.stages.exposures import (
    IMAGE_RESOURCES,
    KERNEL,
    exposure_plan,
    mosaic_memory,
    truth_bands,
)
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf

__all__ = ["make_templates", "measure_band", "measure_photometry", "yang2021_photometer"]


@stage(
    "templates",
    "templates of the sources",
    version=2,
    needs=("highres",),
    sections=("highres.filter", "highres.pixel_scale"),
    memory=mosaic_memory,
    kernels=("photometry",),
)
def make_templates(context, _):
    """Stage 11, once for all bands: what the detected sources look like on the prior."""
    options = context.config.highres
    _, labels = context.image("segm.fits", "segmentation")
    templates = photometry.SourceTemplates.from_images(
        context.image("f160w.fits"),
        labels.astype(np.int32),
        QTable.read(context.path("detections.ecsv")),
        psf=psf.hst_psf(options.filter, pixel_scale=options.pixel_scale * u.arcsec),
        n_threads=context.n_threads,
    )
    context.save_result("templates.fits", templates)


@stage(
    "photometry",
    "forced photometry",
    version=5,
    needs={
        "mosaics": lambda config, unit: (unit,),
        "highres": None,
        "kernels": lambda config, unit: (unit.partition("/")[2],),
        "templates": None,
    },
    sections=(*KERNEL, "photometry.method"),
    resources=IMAGE_RESOURCES,
    units=truth_bands,
    plan=exposure_plan,
    memory=mosaic_memory,
    kernels=("photometry",),
)
def measure_photometry(context, unit):
    """Stage 11: forced photometry of one band, on its own grid or by the steps of Yang et al. 2021."""
    truth, name = unit.split("/")
    suffix, _ = measured_mosaic(context.config)
    mosaic = context.image(f"{truth}/mosaic_{name}{suffix}.fits")
    result = measure_band(context, mosaic, name, context.config.photometry.method)
    table = result.to_table()
    context.save_table(f"{truth}/photometry/{name}.ecsv", table)
    context.save_image(f"{truth}/photometry/{name}_model.fits", result.model_image)
    context.save_image(f"{truth}/photometry/{name}_residual.fits", result.residual_image)


def measure_band(context, mosaic, name, method):
    """Result of the forced photometry of a mosaic of one band, ``"package"`` or ``"yang2021"``."""
    if method == "yang2021":
        return _as_yang2021(context, mosaic, name)
    kernel = psf.MatchingKernel.read(context.path(f"kernel_{name}.fits"))
    # the constant absorbs the light of faint sources and of wings in the background
    return photometry.ForcedPhotometer(
        kernel, fit_background=True, n_threads=context.n_threads
    ).measure(
        mosaic,
        templates=photometry.SourceTemplates.read(context.path("templates.fits")),
    )


def joined_photometry(tables):
    """Join tables of results by band into one, with a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    return photometry.join_bands({name: table[columns] for name, table in tables.items()})


def yang2021_photometer(config, name, n_threads):
    """Photometer of one band by the steps of Yang et al. 2021, without a scaling of the image."""
    options = config.highres
    return photometry.Yang2021Photometer(
        psf.hst_psf(options.filter, pixel_scale=options.pixel_scale * u.arcsec),
        mosaic_psf(config, name, options.pixel_scale),
        n_threads=n_threads,
    )


def _as_yang2021(context, mosaic, name):
    """Forced photometry of one band by the steps of Yang et al. 2021, on the grid of the prior."""
    _, labels = context.image("segm.fits", "segmentation")
    return yang2021_photometer(context.config, name, context.n_threads).measure(
        mosaic,
        context.image("f160w.fits"),
        labels.astype(np.int32),
        QTable.read(context.path("detections.ecsv")),
    )
