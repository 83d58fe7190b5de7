"""The check of the whole chain with bright point sources on a grid."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale import depth, photometry
from miricigale.instrument import mosaic_wcs, tangent_offset
from miricigale.utils.random import text_key
from miricigale.utils.tables import error_column, match_sky
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.labels import end_bands
from miricigale.workflow.stages.exposures import (
    EXPOSURE_RESOURCES,
    IMAGES,
    band_exposures,
    band_names,
    exposure_memory,
    exposure_plan,
)
from miricigale.workflow.stages.grids import shown_patch
from miricigale.workflow.stages.images import (
    DETECTION,
    expose_and_reduce,
    measured_mosaic,
    mosaic_psf,
    prior_image,
    reducer_of,
)
from miricigale.workflow.stages.measure import photometer_of
from miricigale.workflow.stages.sample import in_field

#: Radius of the PSF stamps of Yang et al. 2021, at which f_aper is reported.
STAMP_RADIUS = 1.5 * u.arcsec
#: Flux of the point sources on the high-resolution image: bright, so that noise is no matter.
PRIOR_FLUX = 30 * u.uJy


def point_catalog(exposure, band_flux, prior, *, spacing, seed):
    """
    Put point sources on a grid over the field of an exposure, as `~miricigale.scene.Scene` takes them.

    ``band_flux`` is their flux in its filter, ``prior`` the filter of the high-resolution image and
    ``spacing`` in arcsec; each is moved by a random part of a pixel.
    """
    rng = np.random.default_rng(seed)
    steps = np.arange(-70, 70.1, spacing)
    x, y = np.meshgrid(steps, steps)
    x = x.ravel() + rng.uniform(-0.1, 0.1, x.size)
    y = y.ravel() + rng.uniform(-0.1, 0.1, y.size)
    positions = []
    for offset in zip(x * u.arcsec, y * u.arcsec, strict=True):
        positions.append(tangent_offset(exposure.pointing, *offset, exposure.pa_aper))
    catalog = QTable({"id": np.arange(1, len(positions) + 1), "sky": SkyCoord(positions)})
    catalog["redshift"] = np.nan
    catalog["profile"] = "point"
    catalog["half_light_radius"] = 0.0 * u.arcsec
    catalog["position_angle"] = 0.0 * u.deg
    catalog["sersic_index"] = 1.0
    catalog["axis_ratio"] = 1.0
    catalog[exposure.filter] = band_flux.to(u.uJy)
    catalog[prior] = PRIOR_FLUX
    return catalog


@stage(
    "points",
    "point sources",
    version=9,
    needs=("kernels",),
    sections=IMAGES + ("patches", "highres") + DETECTION + ("photometry.method", "point_sources"),
    resources=EXPOSURE_RESOURCES,
    units=lambda config: band_names(config) if config.point_sources.enabled else (),
    plan=exposure_plan,
    memory=exposure_memory,
)
def measure_point_sources(context, name):
    """Simulate, reduce and measure bright point sources in one band, as the study does."""
    config = context.config
    options = config.point_sources
    prior = config.highres.filter
    exposure = band_exposures(config, name)[0]
    flux = options.signal_to_noise * depth.scaled_limit(name, exposure.exposure_time, n_sigma=1.0)
    # random streams other than those of the exposures of the study
    seed = (context.seed + text_key(f"points/{name}")) % 2**63
    catalog = point_catalog(exposure, flux, prior, spacing=options.spacing, seed=seed)
    _, cal = expose_and_reduce(config, exposure, catalog, seed=seed, n_threads=context.n_threads)
    reducer = reducer_of(config)
    if reducer.background.method == "dithers":
        # there are none of this field
        cal, _ = reducer.subtract_background(cal)
    _, scale = measured_mosaic(config)
    mosaic = reducer.mosaic([cal], mosaic_wcs([exposure], scale * u.arcsec))
    mosaic, _ = reducer.subtract_background(mosaic)
    wcs = mosaic_wcs([exposure], config.highres.pixel_scale * u.arcsec)
    highres, segmentation, detected = prior_image(config, catalog, wcs, seed=seed)
    photometer = photometer_of(context, name, config.photometry.method, shown_patch(config))
    result = photometer.measure(mosaic, highres, segmentation, detected)
    table = catalog["id", "sky"]
    table["flux_true"] = catalog[name]
    index, _ = match_sky(detected["sky"], catalog["sky"], radius=0.3 * u.arcsec)
    measured = result.to_table()
    matched = index >= 0
    for column in ("flux", error_column("flux")):
        table[column] = np.where(matched, measured[column][index].value, np.nan) * u.uJy
    table["flags"] = np.where(matched, np.asarray(measured["flags"])[index], 0)
    table["in_field"] = in_field(table["sky"], [mosaic])
    # the two factors of Yang et al. 2021; they are reported and not applied
    blur = mosaic_psf(config, name, scale)
    inside = np.asarray(table["in_field"])
    table.meta["f_aper"] = photometry.aperture_correction(blur, STAMP_RADIUS)
    if np.any(inside):
        factor, error = photometry.flux_scaling(
            mosaic, table["sky"][inside], table["flux_true"][inside], blur
        )
        table.meta["f_scaling"] = factor
        table.meta["f_scaling_err"] = error
    context.save_table(f"points/{name}.ecsv", table)
    if name in end_bands(config.exposures.filters):
        context.save_image(f"points/{name}_mosaic.fits", mosaic)
