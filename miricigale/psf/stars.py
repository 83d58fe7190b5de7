"""PSFs measured from stars in images, with a model to begin with."""

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.stats import mad_std
from astropy.table import Table

from miricigale.instrument.image_planes import standard_deviation
from miricigale.psf.model import instrument_psf
from miricigale.psf.star_fit import TERMS, Star, StarPSF
from miricigale.utils.files import is_path, listed_images
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import as_positions
from miricigale.utils.tables import as_table
from miricigale.utils.units import ANGLE, positive


@takes_other_keywords
def psf_from_stars(images, stars, psf, *, fov=5 * ANGLE):
    """
    Correct a model PSF by stars in one or several (dithered) images.

    Each star in each image counts by itself: errors of the pointings do not widen the PSF. How much of the
    light is in the far wings stars hardly show; the model says it.

    Parameters
    ----------
    images : `~astropy.nddata.NDData` or sequence of them
        Images in any linear unit. Their ``mask`` and values that are not finite are left out; without an
        ``uncertainty`` the noise is measured.
    stars : `~astropy.table.Table`, `~astropy.coordinates.SkyCoord` or sequence of tables
        Positions on the sky for all images, which then need a WCS, or for each image a table with ``x`` and
        ``y`` in 0-based pixels, good to half a pixel; or files of tables. Isolated and not saturated: no star is
        judged here. Those whose stamps leave an image are left out.
    psf : `~photutils.psf.ImagePSF`
        The model on the images' pixels and axes, with its center in the middle.
    fov : `~astropy.units.Quantity`, optional
        Width of the stamps.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        The model corrected as far as stars that are left out confirm it
        (`~miricigale.psf.star_fit.StarPSF`). Its meta has ``n_images``, ``n_stamps`` (used),
        ``n_left_out``, ``correction`` (its kind), ``flux_err`` (of a point source by the PSF's error), and each of
        the terms.

    Raises
    ------
    ValueError
        If an argument is not what it should be, or no star is on an image.

    References
    ----------
    Anderson & King 2000, PASP 112, 1360.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.nddata import NDData
    >>> from astropy.table import Table
    >>> from miricigale.psf import gaussian_psf, psf_from_stars
    >>> y, x = np.mgrid[:80, :80]
    >>> stars = Table({"x": [20.0, 60.3, 19.6, 60.5], "y": [20.0, 20.5, 60.4, 59.8]})
    >>> light = [99 * np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a, b in stars.iterrows()]
    >>> noise = np.random.default_rng(1).normal(0, 0.1, x.shape)
    >>> model = gaussian_psf(0.45 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> psf = psf_from_stars(NDData(sum(light) + noise), stars, model, fov=3 * u.arcsec)
    >>> print(f"{psf.fwhm:.2f} of {psf.meta['n_stamps']} stars")
    0.47 arcsec of 4 stars
    """
    psf = instrument_psf(psf)
    cells = psf.n_cells
    ny, nx = psf.data.shape
    middle = ny == nx and ny % 2 == 1 and np.allclose(psf.origin, (nx // 2, ny // 2))
    check_that(middle, "psf", "square and odd, with its center in the middle", psf.data.shape)
    images = listed_images(images, reader="miricigale.photometry.read_mosaic")
    if is_path(stars):
        stars = as_table(stars, "stars")
    if isinstance(stars, (Table, SkyCoord)):
        stars = [stars] * len(images)
    else:
        stars = [as_table(table, "stars") if is_path(table) else table for table in stars]
    wanted = f"positions on the sky, or a table for each of {len(images)} images"
    check_that(len(stars) == len(images), "stars", wanted, f"{len(stars)} tables")
    half = round(
        0.5 * min(positive(fov, ANGLE, "fov"), 2 * psf.half_width) / psf.pixel_scale.value - 1
    )
    star_stamps = []
    wanted = 0
    for image, table in zip(images, stars, strict=True):
        data = np.asarray(image.data, float)
        use = np.isfinite(image.data)
        use &= True if image.mask is None else ~np.asarray(image.mask, bool)
        if image.uncertainty is None:
            sigma = np.full(data.shape, mad_std(data[use]))
        else:
            sigma = standard_deviation(image).array
        sigma = np.where(use & (sigma > 0), sigma, np.inf)
        for x, y in _places(image, table):
            wanted += 1
            if half <= x < data.shape[1] - half - 1 and half <= y < data.shape[0] - half - 1:
                i = round(x)
                j = round(y)
                v, u = np.mgrid[j - half : j + half + 1, i - half : i + half + 1]
                star_stamps.append(
                    Star(
                        np.where(use, data, 0.0)[v, u],
                        sigma[v, u],
                        (u - x) * cells,
                        (v - y) * cells,
                        area=cells**2,
                    )
                )
    check_that(star_stamps, "stars", "at least one with its stamp on an image", f"{wanted} without")
    fit = StarPSF(psf.data / cells**2, star_stamps)
    meta = {
        "n_images": len(images),
        "n_stamps": len(star_stamps),
        "n_left_out": wanted - len(star_stamps),
    }
    meta |= {"source": "stars", "correction": fit.kind, "flux_err": float(fit.error)}
    return psf.replace(
        fit.at() * cells**2, meta=meta | dict(zip(TERMS, fit.terms.tolist(), strict=True))
    )


def _places(image, stars):
    """Return the pixels x, y of stars on an image."""
    sky = stars
    if not isinstance(stars, SkyCoord):
        if "sky" not in stars.colnames and {"x", "y"} <= set(stars.colnames):
            return np.stack([np.asarray(stars[name], float) for name in "xy"], axis=1)
        wanted = "tables with 'x' and 'y', 'sky', or 'ra' and 'dec'"
        names = {name.lower() for name in stars.colnames}
        check_that("sky" in names or {"ra", "dec"} <= names, "stars", wanted, stars.colnames)
        sky = as_positions(stars, "stars")
    check_that(image.wcs is not None, "stars", "'x' and 'y' for images without a WCS", "the sky")
    return np.stack(np.atleast_1d(*image.wcs.world_to_pixel(sky)), axis=1)
