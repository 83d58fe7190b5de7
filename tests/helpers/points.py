"""Point sources as the stage of forced photometry finds them: mosaics of both grids and the prior."""

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty

from helpers.scenes import CENTER, catalog_at
from miricigale.instrument import north_up_wcs
from miricigale.photometry import detect_sources
from miricigale.psf import hst_psf
from miricigale.scene import Scene, highres_image
from miricigale.workflow.stages.images import mosaic_psf

PRIOR = "wfc3.f160w"


def point_catalog(x, y, rng, fluxes, center=CENTER):
    """Points within 0.1 arcsec of places about a center (arcsec), with fluxes (uJy) by band."""
    n = np.size(x)
    dx, dy = (np.ravel(place) + rng.uniform(-0.1, 0.1, n) for place in (x, y))
    sky = center.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
    return catalog_at(sky, **{band: flux * u.uJy for band, flux in fluxes.items()})


def save_prior(made, catalog, wcs):
    """Save the truth, the prior and its detections."""
    made.save_table("agn00/truth.ecsv", catalog)
    psf = hst_psf(PRIOR, pixel_scale=0.06 * u.arcsec)
    prior = highres_image(catalog, filter=PRIOR, wcs=wcs, psf=psf, seed=1)
    segmentation, detected = detect_sources(prior)
    made.save_image("f160w.fits", prior)
    made.save_image("segm.fits", prior, segmentation=np.asarray(segmentation.data, np.int32))
    made.save_table("detections.ecsv", detected)


def save_points(made, catalog, band, rng, *, width):
    """Save mosaics of a band on the native and the fine grid (``width`` arcsec), prior and detections."""
    for suffix, scale in (("", 0.11), ("_fine", 0.06)):
        size = round(width / scale)
        wcs = north_up_wcs(CENTER, scale * u.arcsec, (size, size))
        wcs.pixel_shape = size, size
        psf = mosaic_psf(made.config, band, scale)
        image = Scene(catalog, filter=band, wcs=wcs, psf=psf).render()
        noise = np.full(image.shape, 0.1 * 0.06 / scale)
        mosaic = CCDData(
            image.data + rng.normal(0, noise),
            unit="MJy/sr",
            wcs=wcs,
            uncertainty=StdDevUncertainty(noise),
            mask=np.zeros(image.shape, bool),
        )
        made.save_image(f"agn00/mosaic_{band}{suffix}.fits", mosaic)
    save_prior(made, catalog, wcs)
