"""PSFs measured from stars, with photutils' builder of effective PSFs."""

import math
import numbers
import warnings

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.nddata import NDData
from astropy.table import Table
from astropy.utils.exceptions import AstropyUserWarning
from astropy.wcs.utils import proj_plane_pixel_scales
from photutils.psf import EPSFBuilder, EPSFStars, extract_stars

from miricigale.psf.effects import EFFECTS
from miricigale.psf.model import make_psf
from miricigale.psf.resample import psf_image
from miricigale.utils.exceptions import argument_error, warn
from miricigale.utils.options import check_that
from miricigale.utils.units import ANGLE, check_count, positive, to_array


def _as_list(value, kinds):
    return [value] if isinstance(value, kinds) else list(value)


def _checked_images(images):
    images = _as_list(images, NDData)
    check_that(images, "images", "at least one image", "none")
    for k, image in enumerate(images):
        if not isinstance(image, NDData) or np.ndim(image.data) != 2:
            got = f"{type(image).__name__} (images[{k}])"
            raise argument_error("images", "NDData or CCDData of two dimensions", got)
    return images


def _pixel_scale(images, pixel_scale):
    """Geometric mean of the pixel's sides in arcsec."""
    if pixel_scale is not None:
        return positive(pixel_scale, ANGLE, "pixel_scale")
    wcs = images[0].wcs
    check_that(wcs is not None, "pixel_scale", "given for images without world coordinates", None)
    sides = proj_plane_pixel_scales(getattr(wcs, "celestial", wcs))
    return float(np.sqrt(np.prod(sides))) * 3600


def _catalogs(images, stars):
    """One table of ``x`` and ``y`` for each image."""
    tables = _as_list(stars, Table)
    if len(tables) == 1 and "sky" in tables[0].colnames:
        sky = tables[0]["sky"]
        if not isinstance(sky, SkyCoord):
            raise argument_error("stars", "a table with SkyCoord in 'sky'", type(sky).__name__)
        missing = [k for k, image in enumerate(images) if image.wcs is None]
        check_that(not missing, "stars", "'x' and 'y' for images without a WCS", missing)
        places = [image.wcs.world_to_pixel(sky) for image in images]
        return [Table({"x": np.atleast_1d(x), "y": np.atleast_1d(y)}) for x, y in places]
    wanted = f"a table with 'sky', or one with 'x' and 'y' for each of {len(images)} images"
    check_that(len(tables) == len(images), "stars", wanted, f"{len(tables)} tables")
    for table in tables:
        if not {"x", "y"} <= set(table.colnames):
            raise argument_error("stars", "tables with 'x' and 'y', or 'sky'", table.colnames)
    return [Table({"x": np.asarray(t["x"], float), "y": np.asarray(t["y"], float)}) for t in tables]


def _stamps(images, tables, size):
    """The stars' stamps, and how many there were to be."""
    stamps, half = [], size // 2
    for image, table in zip(images, tables, strict=True):
        data = np.array(image.data, dtype=float)
        mask = ~np.isfinite(data)
        if image.mask is not None:
            mask |= np.asarray(image.mask, dtype=bool)
        data[mask] = 0.0
        ny, nx = data.shape
        x, y = np.asarray(table["x"]), np.asarray(table["y"])
        # one pixel more than the stamp: photutils refuses those that touch the edge
        inside = (x >= half + 1) & (x <= nx - 2 - half) & (y >= half + 1) & (y <= ny - 2 - half)
        if np.any(inside):
            cleaned = NDData(data, mask=mask, uncertainty=image.uncertainty)
            chosen = table[inside]
            # a first guess; photutils' own fills masked pixels by a triangulation of each stamp
            corners = np.rint([chosen["y"], chosen["x"]]).astype(int).T - half
            chosen["flux"] = [data[j : j + size, i : i + size].sum() for j, i in corners]
            stamps += extract_stars(cleaned, chosen, size=size).all_stars
    return stamps, sum(len(table) for table in tables)


def psf_from_stars(
    images,
    stars,
    *,
    fov=5 * u.arcsec,
    oversampling=2,
    pixel_scale=None,
    frame="detector",
    angle=0.0 * u.deg,
    includes=EFFECTS,
    enclosed=1.0,
    progress_bar=False,
):
    """
    Measure the PSF from stars in one or several (dithered) images.

    Photutils' `~photutils.psf.EPSFBuilder` stacks the residuals of all stars on a finer grid,
    centered on their fitted positions, until the positions settle. Each star in each image
    counts by itself: errors of the pointings do not widen the PSF.

    Parameters
    ----------
    images : `~astropy.nddata.NDData` or sequence of them
        Images in any linear unit, their background subtracted.
        Their ``mask`` and values that are not finite are left out, their ``uncertainty``
        weighs the fits.
    stars : `~astropy.table.Table` or sequence of them
        One table with ``sky`` for all images, which then need a WCS, or for each image a
        table with ``x`` and ``y`` in 0-based pixels, good to a pixel. Isolated and
        not saturated: no star is judged here. Those whose stamps leave an image are left out.
    fov : `~astropy.units.Quantity`, optional
        Width of the stamps.
    oversampling : int, optional
        Cells per pixel. The images must fill the sub-pixel phases: about ten times its
        square of stamps.
    pixel_scale : `~astropy.units.Quantity`, optional
        Side of a pixel; from the WCS of the first image if not given.
    frame, angle, includes
        As for `~miricigale.psf.make_psf`. Stars hold all that the detector does to light; those
        of a mosaic also ``"drizzle"``, and stand in the frame ``"sky"``.
    enclosed : float or `~photutils.psf.ImagePSF`, optional
        Fraction of a star's light within the stamp, or a PSF to take it from; it cannot be
        measured from stars. With 1 the encircled energies are those relative to the stamp.
    progress_bar : bool, optional
        Whether to show one.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        Its meta has ``n_images``, ``n_stamps``
        (used), ``n_left_out`` (off the images or not fitted), ``iterations`` and
        ``converged`` (positions settled to 0.001 pixel).

    Raises
    ------
    ValueError
        If an argument is out of its range, a WCS or the pixel scale is missing, or fewer
        than ``oversampling**2`` stamps are there: some phases would be empty.

    Warns
    -----
    `~astropy.utils.exceptions.AstropyUserWarning`
        If stars cannot be fitted.

    References
    ----------
    Anderson & King 2000, PASP 112, 1360; Anderson 2016, WFC3 ISR 2016-12.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.nddata import NDData
    >>> from astropy.table import Table
    >>> from miricigale.psf import psf_from_stars
    >>> y, x = np.mgrid[:80, :80]
    >>> stars = Table({"x": [20.0, 60.3, 19.6, 60.5], "y": [20.0, 20.5, 60.4, 59.8]})
    >>> light = [np.exp(-((x - a) ** 2 + (y - b) ** 2) / 8) for a, b in stars.iterrows()]
    >>> form = {"pixel_scale": 0.1 * u.arcsec, "fov": 3 * u.arcsec, "oversampling": 1}
    >>> psf = psf_from_stars(NDData(sum(light)), stars, **form)
    >>> print(f"{psf.fwhm:.2f} of {psf.meta['n_stamps']} stars")
    0.47 arcsec of 4 stars
    """
    images = _checked_images(images)
    scale = _pixel_scale(images, pixel_scale)
    check_count(oversampling, "oversampling")
    width = float(to_array(fov, ANGLE, "fov", ndim=0))
    size = 2 * round(0.5 * width / scale - 0.5) + 1
    check_that(size >= 7, "fov", f"at least 7 pixels of {scale:.4g} arcsec", fov)
    stamps, wanted = _stamps(images, _catalogs(images, stars), size)
    least = max(2, oversampling**2)
    if len(stamps) < least:
        raise argument_error("stars", f"at least {least} with stamps on the images", len(stamps))
    builder = EPSFBuilder(
        oversampling=int(oversampling),
        maxiters=10,
        smoothing_kernel="quartic",
        progress_bar=progress_bar,
    )
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = builder(EPSFStars(stamps))
    failed = int(result.n_excluded_stars)
    if failed:
        text = f"{failed} of {len(stamps)} stamps of stars could not be fitted and were left out"
        warn(text, AstropyUserWarning)
    for one in caught:
        # photutils says which star; the count above says it once
        if not issubclass(one.category, (AstropyUserWarning, RuntimeWarning)):
            warnings.warn_explicit(one.message, one.category, one.filename, one.lineno)
    share = _enclosed(enclosed, result.epsf.data.shape, oversampling, scale)
    return make_psf(
        np.asarray(result.epsf.data) * share,
        pixel_scale=scale * ANGLE,
        oversampling=int(oversampling),
        frame=frame,
        angle=angle,
        includes=includes,
        # 1 stands for a fraction that is not known
        total_known=share != 1,
        meta={
            "source": "stars",
            "n_images": len(images),
            "n_stamps": len(stamps) - failed,
            "n_left_out": wanted - len(stamps) + failed,
            "iterations": int(result.iterations),
            "converged": bool(result.converged),
        },
    )


def _enclosed(enclosed, shape, oversampling, scale):
    """Fraction of the light on the stamp's grid."""
    if isinstance(enclosed, numbers.Real):
        check_that(0 < enclosed <= 1, "enclosed", "above 0 and at most 1, or a PSF", enclosed)
        return float(enclosed)
    cell = scale / oversampling * ANGLE
    image = psf_image(enclosed, pixel_scale=cell, shape=shape)
    share = float(image.sum())
    if not (math.isfinite(share) and 0 < share <= 1.02):
        raise argument_error("enclosed", "a PSF that covers the stamp", f"{share:.3g} of its light")
    return min(share, 1.0)
