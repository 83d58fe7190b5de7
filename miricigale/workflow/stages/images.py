"""Stages 4 to 10: scenes, ramps, rates, calibrated images, mosaics, prior, kernels."""

import logging

import astropy.units as u
import numpy as np

from miricigale import depth, detector, photometry, psf, reduction, scene
from miricigale.utils.random import stream
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.morphology import read_stamps
from miricigale.workflow.perturbation import Perturbation
from miricigale.workflow.stages.exposures import (
    EXPOSURE_RESOURCES,
    IMAGE_RESOURCES,
    IMAGES,
    KERNEL,
    exposure_memory,
    exposure_plan,
    exposure_units,
    pointing_of,
    study_background,
    study_exposures,
)
from miricigale.workflow.stages.grids import (
    PATCHED,
    grid_of,
    mosaic_memory,
    of_patch,
    parts_of,
    patch_bands,
    patch_exposures,
    patch_plan,
    study_patches,
    truth_bands,
)
from miricigale.workflow.truths import CUTOUTS, reference, study_truths

log = logging.getLogger(__name__)


def reducer_of(config, n_threads=None):
    """Return the reducer that a configuration describes."""
    options = config.reduction
    return reduction.Reducer(
        backend=options.backend,
        jump_threshold=options.jump_threshold,
        background=reduction.BackgroundSettings(
            options.background,
            box=options.background_box,
            filter_size=options.background_filter,
            plane=options.background_plane,
            negative_threshold=options.negative_threshold,
            negative_noise=options.negative_noise,
        ),
        mosaics=reduction.MosaicSettings(pixfrac=options.pixfrac),
        # the detector that the analysis assumes, also where a truth has another one
        references="simulated",
        n_threads=n_threads,
    )


def background_of(config, exposure):
    """Return the background of an exposure, which those of a pointing share: it moves with the telescope."""
    return scene.Background(
        study_background(config, exposure.filter),
        center=pointing_of(config, exposure),
        gradient=config.scene.background_gradient / u.arcmin,
        position_angle=config.scene.gradient_angle * u.deg,
    )


def imager_of(config, properties=None):
    """Return the detector that a configuration describes."""
    imager = detector.Detector.miri_imager(properties=properties)
    if config.detector.residual:
        imager = imager.replace(detector.Residual(config.detector.residual))
    if not config.detector.cosmic_rays:
        imager = imager.without(detector.CosmicRays)
    return imager


def expose_and_reduce(
    config, exposure, catalog, *, seed, perturbation=None, n_threads=None, tell=None, keep=None
):
    """
    Take one exposure of a catalog from the scene to the calibrated image.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    catalog : `~astropy.table.QTable`
        Sources with fluxes in the exposure's filter.
    seed : int
        Seed of the detector.
    perturbation : `~miricigale.workflow.perturbation.Perturbation`, optional
        Where sky and detector differ from what the reduction assumes; nothing by default.
    n_threads : int, optional
        Threads; it changes nothing in the result.
    tell : callable, optional
        Called with the `~miricigale.depth.SaturationForecast`, before anything is exposed.
    keep : callable, optional
        Called with the `~miricigale.detector.Ramp`, to write it.

    Returns
    -------
    rate, cal : `~astropy.nddata.CCDData`
        In DN/s and in MJy/sr, background subtracted unless that of dithers will be (`mosaics_of`).
    """
    perturbation = perturbation or Perturbation({}, seed)
    band = exposure.filter
    sky = scene.Scene(
        perturbation.catalog(catalog, band),
        exposure=exposure,
        psf=perturbation.psf(band),
        cutouts=perturbation.stamps,
        agn=perturbation.point_column(band),
        background=background_of(config, exposure),
        n_threads=n_threads,
    )
    imager = imager_of(config, perturbation.detector)
    image = perturbation.with_flat(sky.render(), exposure)
    if tell is not None:
        tell(imager.forecast(image, exposure, sources=sky.truth))
    return expose_image(config, imager, image, exposure, seed=seed, n_threads=n_threads, keep=keep)


def expose_image(config, imager, image, exposure, *, seed, n_threads=None, keep=None):
    """Return rate and calibrated image, as of `expose_and_reduce`, of a noiseless image on a detector."""
    if config.exposures.kind == "ramps":
        collect = imager.expose
    else:
        collect = imager.collect
    ramp = collect(image, exposure, seed=seed, n_threads=n_threads)
    if keep is not None:
        keep(ramp)
    reducer = reducer_of(config, n_threads)
    rate = reducer.fit_ramp(ramp)
    del ramp
    cal = reducer.calibrate(rate)
    if reducer.background.method != "dithers":
        cal, _ = reducer.subtract_background(cal)
    return rate, cal


def _sky_plan(config, unit):
    """Return the plan of an exposure, the perturbations of its truth, and whether that is the reference."""
    name = unit.partition("/")[0]
    plan = exposure_plan(config, unit)
    plan["is_reference"] = name == reference(config)
    if effects := dict(study_truths(config)[name].perturbations):
        plan["perturbations"] = effects
    return plan


@stage(
    "exposures",
    "exposure",
    version=12,
    needs=("truth",),
    sections=IMAGES + ("run.keep_level1b",),
    resources=EXPOSURE_RESOURCES,
    units=exposure_units,
    plan=_sky_plan,
    memory=exposure_memory,
)
def make_exposure(context, unit):
    """Stages 4 to 7 of one exposure: scene, ramp, rate, calibrated image."""
    config = context.config
    truth, name = unit.split("/")
    exposure = study_exposures(config)[name]

    def tell(forecast):
        log.info(forecast.describe())
        table = depth.forecast_table([forecast])
        context.save_table(f"{truth}/exposures/{name}_forecast.ecsv", table)

    def keep(ramp):
        filename = f"{name}_uncal.fits"
        context.save_result(f"{truth}/level1b/{filename}", ramp, filename=filename)

    effects = context.plan.get("perturbations", {})
    stamps = {}
    if CUTOUTS in effects:
        stamps = read_stamps(context.path(f"{truth}/stamps.fits"))
    rate, cal = expose_and_reduce(
        config,
        exposure,
        context.table(f"{truth}/truth.ecsv"),
        seed=context.seed,
        perturbation=Perturbation(effects, context.seed, stamps),
        n_threads=context.n_threads,
        tell=tell,
        keep=keep if config.run.keep_level1b else None,
    )
    context.save_image(f"{truth}/exposures/{name}_cal.fits", cal, dq=cal.flags)
    # the report shows what the subtraction of the background did to one exposure of a band
    if config.run.keep_level1b or (context.plan["is_reference"] and exposure.dither == 0):
        context.save_image(f"{truth}/exposures/{name}_rate.fits", rate, dq=rate.flags)


@stage(
    "mosaics",
    "mosaic",
    version=9,
    needs=("exposures",),
    sections=PATCHED + ("reduction",),
    units=truth_bands,
    reads=lambda config, unit: [f"{parts_of(unit)[0]}/{name}" for name in patch_plan(config, unit)],
    plan=patch_plan,
    memory=mosaic_memory,
)
def make_mosaic(context, unit):
    """Stage 8: drizzle the dithers of one band, on its own grid and on the prior's."""
    config = context.config
    truth, band, patch = parts_of(unit)
    names = patch_exposures(config, band, patch)
    images = [context.image(f"{truth}/exposures/{name}_cal.fits") for name in names]
    for label, mosaic, planes in mosaics_of(config, images, patch):
        name = of_patch(f"{truth}/mosaic_{band}{label}", patch)
        context.save_image(f"{name}.fits", mosaic, dq=mosaic.flags, **planes)


def mosaics_of(config, images, patch=""):
    """
    Make mosaics of a band, on its own grid (``""``) and on the prior's (``"_fine"``), with further planes.

    Those of a patch are on the first alone: the second is for whole fields, as Yang et al. 2021 measure them.
    """
    reducer = reducer_of(config)
    if reducer.background.method == "dithers":
        images, _ = reducer.subtract_dithers(images)
    scales = {"": config.reduction.pixel_scale}
    if not patch:
        scales["_fine"] = config.highres.pixel_scale
    for label, scale in scales.items():
        # outliers are found in the first pass, which returns the images with them masked
        drizzled, images = reducer.drizzle(images, grid_of(config, scale, patch))
        # second pass: background that remained after subtraction from single dithers
        mosaic, _ = reducer.subtract_background(drizzled.image)
        planes = {}
        if label == "":
            # how many exposures each pixel has: what errors follow
            planes["n_images"] = drizzled.n_images
        yield label, mosaic, planes


#: What the detection of sources on the high-resolution image depends on.
DETECTION = ("photometry.threshold", "photometry.n_pixels")


@stage(
    "highres",
    "high-resolution image",
    version=3,
    needs=("truth",),
    within=reference,
    sections=PATCHED + ("highres",) + DETECTION,
    resources=("filters.sedpy",),
    units=study_patches,
    plan=lambda config, _: {"exposures": exposure_plan(config), "truth": reference(config)},
    memory=mosaic_memory,
)
def make_highres(context, patch):
    """Stage 9: the high-resolution image, its segmentation and the detected sources."""
    config = context.config
    truth = context.table(f"{context.plan['truth']}/truth.ecsv")
    wcs = grid_of(config, config.highres.pixel_scale, patch)
    noise = None
    if patch:
        noise = patch_noise(config, patch, context.seed)
    image, segmentation, detected = prior_image(config, truth, wcs, seed=context.seed, noise=noise)
    context.save_image(f"{of_patch('f160w', patch)}.fits", image)
    segmentation = np.asarray(segmentation.data, np.int32)
    context.save_image(f"{of_patch('segm', patch)}.fits", image, segmentation=segmentation)
    context.save_table(f"{of_patch('detections', patch)}.ecsv", detected)


def patch_noise(config, patch, seed):
    """Draw standard normal numbers of a patch: a part of each row of the field, the same where patches overlap."""
    rows, columns = study_patches(config)[patch].box
    noise = []
    for y in range(rows.start, rows.stop):
        rng = stream(seed, "highres", str(y))
        noise.append(rng.standard_normal(columns.stop)[columns])
    return np.stack(noise)


def prior_psf(config):
    """Return the PSF of the high-resolution image."""
    options = config.highres
    return psf.hst_psf(options.filter, pixel_scale=options.pixel_scale * u.arcsec)


def prior_image(config, catalog, wcs, *, seed, noise=None):
    """Make the high-resolution image of a catalog, its segmentation and the table of detected sources."""
    image = scene.highres_image(
        catalog,
        filter=config.highres.filter,
        wcs=wcs,
        psf=prior_psf(config),
        depth=config.highres.depth * u.ABmag,
        seed=seed,
        noise=noise,
    )
    segmentation, detected = photometry.detect_sources(
        image,
        threshold=config.photometry.threshold,
        n_pixels=config.photometry.n_pixels,
    )
    return image, segmentation, detected


def mosaic_psf(config, name, scale, patch=""):
    """Return the PSF of the mosaic of one band on pixels of ``scale`` arcsec."""
    exposures = patch_exposures(config, name, patch).values()
    angles = u.Quantity([exposure.pa_aper for exposure in exposures])
    pixfrac = config.reduction.pixfrac
    return psf.psf_mosaic(psf.miri_psf(name), scale * u.arcsec, angles, pixfrac=pixfrac)


def measured_mosaic(config):
    """Return suffix and pixel scale (arcsec) of the mosaics that are measured."""
    # the steps of the paper take the prior's grid
    if config.photometry.method == "yang2021":
        return "_fine", config.highres.pixel_scale
    return "", config.reduction.pixel_scale


@stage(
    "kernels",
    "matching kernel",
    version=3,
    sections=KERNEL,
    resources=IMAGE_RESOURCES,
    units=patch_bands,
    plan=lambda config, unit: patch_plan(config, f"/{unit}"),
)
def make_kernel(context, unit):
    """Stage 10: the kernel from the high-resolution image to the mosaic of one band."""
    config = context.config
    _, name, patch = parts_of(f"/{unit}")
    kernel = psf.MatchingKernel.from_psfs(
        prior_psf(config),
        mosaic_psf(config, name, config.reduction.pixel_scale, patch),
        pixel_scale=config.highres.pixel_scale * u.arcsec,
        regularization=config.photometry.regularization,
    )
    context.save_result(f"{of_patch(f'kernel_{name}', patch)}.fits", kernel)
