"""From images with units and coordinates to the plain arrays that photometry works on."""

import astropy.units as u
import numpy as np
from astropy.nddata import CCDData, StdDevUncertainty, UnknownUncertainty
from astropy.stats import mad_std
from astropy.wcs.utils import pixel_to_pixel, proj_plane_pixel_scales

from miricigale.instrument import ImageFacts, north_up_wcs, pixel_area_map
from miricigale.photometry.images.fields import legendre_terms
from miricigale.photometry.images.sky_noise import mask_filled
from miricigale.utils.arrays import is_inside, nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.positions import middle_pixel, plain_positions
from miricigale.utils.units import FNU, SURFACE_BRIGHTNESS, scalar
from miricigale.utils.values import value_class

#: Attempts to place each of some sources apart from each other.
_ATTEMPTS = 50

#: Noise of an image over its brightest pixel below which it was drawn without: rounding of numbers.
_LEAST_NOISE = 1e-9

#: uJy per MJy.
_MICRO = 1e12


@value_class
class ImageArrays:
    """An image as arrays of flux per pixel."""

    #: (ny, nx): Data and noise in uJy per pixel; zero and infinite where not usable.
    flux: np.ndarray
    sigma: np.ndarray
    usable: np.ndarray  # (ny, nx): False where masked, not finite or without noise.
    area: np.ndarray  # (ny, nx): uJy per MJy/sr: the solid angle of each pixel.
    wcs: object  # The image's coordinates.


@value_class
class FitArrays:
    """An image as templates are fitted to it, in single precision: images can be large."""

    flux: np.ndarray  # (ny, nx): Data in uJy per pixel, zero where not usable.
    inverse_sigma: np.ndarray  # (ny, nx): Inverse of the noise, zero where not usable.
    #: As for `ImageArrays`.
    usable: np.ndarray
    wcs: object
    measured_noise: bool  # Whether the noise was measured on the image for want of an uncertainty.
    noise_correction: float = 1.0  # As the image states it (`ImageFacts`).

    def new(self):
        """Make a new image of zeros."""
        return np.zeros(self.usable.shape, np.float32)

    def areas(self, out=None):
        """Calculate the ``area`` of `ImageArrays` (uJy per MJy/sr) once more."""
        if out is None:
            out = self.new()
        return _areas(self.wcs, out)

    def sky_columns(self, order):
        """Draw the terms of the sky, a polynomial of an order, in uJy per pixel for 1 MJy/sr."""
        area = self.areas()
        if order == 0:
            return [area]
        y, x = np.ogrid[: area.shape[0], : area.shape[1]]
        columns = []
        for term in legendre_terms(x, y, area.shape, order):
            columns.append(np.multiply(area, term, out=self.new(), casting="same_kind"))
        return columns

    def whitened(self, image):
        """Divide an image by the noise; zero where not usable."""
        return np.multiply(image, self.inverse_sigma, out=self.new())


def _areas(wcs, out):
    area = pixel_area_map(wcs, out.shape, out=out)
    area *= _MICRO
    return area


def image_arrays(image, name, dtype=float, *, fitted=False):
    """
    Take a `~astropy.nddata.CCDData` apart.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Two-dimensional, in units of surface brightness or of the flux in a pixel, with a celestial WCS.
        Without an uncertainty the noise is 1.4826 times the median absolute deviation of the image.
    name : str
        The argument's name, for messages.
    dtype : type, optional
        That of the arrays; single precision for large images.
    fitted : bool, optional
        Whether its noise counts, as in fits of templates to it or of profiles that become templates: an image
        without an uncertainty that was drawn without noise is refused then.

    Returns
    -------
    arrays : `ImageArrays`

    Raises
    ------
    TypeError
        If it is no CCDData.
    ValueError
        If it is not two-dimensional or has no celestial WCS or no usable pixel.
    `~astropy.units.UnitsError`
        If the unit is neither of surface brightness nor of flux density.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If areas of one number, such as 0 or -99, are taken as without data.
    """
    (data, factor), (noise, noise_factor), usable = _checked(image, name, fitted)
    area = _areas(image.wcs, np.empty(usable.shape, dtype))
    # in the wanted precision at once, for images can be large
    flux = np.multiply(data, factor, dtype=dtype, casting="same_kind")
    sigma = np.multiply(noise, noise_factor, dtype=dtype, casting="same_kind")
    # a surface brightness, and not the flux in each pixel
    if not image.unit.is_equivalent(FNU):
        flux *= area
        sigma *= area
    flux[~usable] = 0.0
    sigma[~usable] = np.inf
    return ImageArrays(flux, sigma, usable, area, image.wcs)


def fit_arrays(image, name):
    """Take a `~astropy.nddata.CCDData` apart for a fit of templates; see `image_arrays`."""
    arrays = image_arrays(image, name, np.float32, fitted=True)
    inverse = np.divide(np.float32(1), arrays.sigma, out=arrays.sigma)
    return FitArrays(
        flux=arrays.flux,
        inverse_sigma=inverse,
        usable=arrays.usable,
        wcs=arrays.wcs,
        measured_noise=image.uncertainty is None,
        noise_correction=ImageFacts.of(image).noise_correction,
    )


def _checked(image, name, fitted):
    """Return data and noise, each with its factor to MJy/sr or to uJy in a pixel, and the usable pixels."""
    if not isinstance(image, CCDData):
        msg = f"'{name}' must be a CCDData, got {type(image).__name__}"
        raise TypeError(msg)
    data = np.asarray(image.data)
    check_that(data.ndim == 2, name, "a two-dimensional image", f"shape {data.shape}")
    if image.wcs is None or not image.wcs.has_celestial:
        raise argument_error(name, "an image with a celestial WCS", "one without")
    unit = FNU if image.unit.is_equivalent(FNU) else SURFACE_BRIGHTNESS
    factor = scalar(1 * image.unit, unit, name)
    # pixels with a value, a positive noise, and no mark
    usable = np.isfinite(data)
    if image.mask is not None:
        usable &= ~np.asarray(image.mask, bool)
    if image.uncertainty is None:
        spread = 0.0
        if usable.any():
            spread = mad_std(np.asarray(data[usable], float))
            # an image drawn without noise is 0 in most pixels, to rounding
            peak = np.max(np.abs(data[usable]))
            is_clean = peak > 0 and spread <= _LEAST_NOISE * peak
            wanted = "an image with noise that can be measured, or with an uncertainty"
            got = f"a median absolute deviation of {spread:.2g} below a peak of {peak:.2g}"
            check_that(not (fitted and is_clean), name, wanted, got)
        noise = np.broadcast_to(np.float64(spread), data.shape), factor
    else:
        # which takes the size of what is below 0
        negative = np.count_nonzero(np.asarray(image.uncertainty.array)[usable] < 0)
        wanted = "an image with uncertainties of 0 (no data) or more"
        check_that(not negative, name, wanted, f"{negative} pixels below 0")
        wanted = "an image with a StdDevUncertainty, VarianceUncertainty or InverseVariance"
        kind = type(image.uncertainty)
        check_that(kind is not UnknownUncertainty, name, wanted, kind.__name__)
        # inverse variances of 0, which is no data, are infinite
        with np.errstate(divide="ignore"):
            sigma = image.uncertainty.represent_as(StdDevUncertainty)
        scale = factor
        if sigma.unit is not None:
            scale = float((1 * sigma.unit).to_value(unit))
        noise = np.asarray(sigma.array), scale
    usable &= np.isfinite(noise[0]) & (noise[0] > 0)
    mask_filled(data, usable, f"'{name}'")
    check_that(usable.any(), name, "an image with usable pixels", "none (masked, NaN or no noise)")
    return (data, factor), noise, usable


def pixel_scale(wcs):
    """Return the mean pixel scale of a WCS at its reference, in arcsec."""
    return float(np.sqrt(np.prod(proj_plane_pixel_scales(wcs.celestial))) * 3600.0)


def lengths(vectors):
    """Return the lengths of vectors (x, y), shape (n, 2)."""
    return np.hypot(vectors[:, 0], vectors[:, 1])


def draw_places(usable, n, separation, rng):
    """
    Draw places on usable pixels, apart from each other.

    Parameters
    ----------
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels on which a source may be.
    n : int
        How many.
    separation : float
        Least distance in pixels.
    rng : `~numpy.random.Generator`
        Random numbers.

    Returns
    -------
    xy : `~numpy.ndarray`, shape (m, 2)
        Pixel positions; fewer than ``n`` where there is no room.
    """
    y, x = np.nonzero(usable)
    places = np.empty((n, 2))
    m = 0
    for _ in range(_ATTEMPTS * n):
        if m == n or not len(x):
            break
        k = rng.integers(len(x))
        place = np.array([x[k], y[k]]) + rng.uniform(-0.5, 0.5, 2)
        if m and np.min(np.hypot(*(places[:m] - place).T)) < separation:
            continue
        places[m] = place
        m += 1
    return places[:m]


def stamp_starts(box):
    """Where the pixels of each of n stamps begin, one after another, and where the last ends: shape (n + 1,)."""
    return np.concatenate([[0], np.cumsum(box[:, 2] * box[:, 3])])


def pixels_to_sky(xy, wcs):
    """Return the coordinates of pixels (x, y), shape (n, 2)."""
    return wcs.pixel_to_world(xy[:, 0], xy[:, 1])


def sky_to_pixels(sky, wcs):
    """Return the pixels (x, y), shape (n, 2), of coordinates; NaN where they are masked."""
    return np.stack(wcs.world_to_pixel(plain_positions(sky)), axis=-1).reshape(-1, 2)


def same_grid(first, second):
    """Return whether two WCSs put a square of pixels at the same places (to 1e-3 pixel)."""
    x = np.array([0.0, 1000.0, 0.0, 1000.0])
    y = np.array([0.0, 0.0, 1000.0, 1000.0])
    place = second.world_to_pixel(first.pixel_to_world(x, y))
    return bool(np.all(np.abs(np.array(place) - [x, y]) < 1e-3))


def fine_wcs(image_wcs, shape, scale):
    """Make a north-up grid of pixels of ``scale`` arcsec about the middle of an image."""
    middle = image_wcs.pixel_to_world((shape[1] - 1) / 2, (shape[0] - 1) / 2).icrs
    return north_up_wcs(middle, scale * u.arcsec, (1, 1))


def sky_pixels(sky, wcs, shape, margin):
    """
    Return pixels (x, y) of those coordinates that are on or near an image, shape (n, 2).

    NaN for positions outside of the image, of a shape, and of a rim of ``margin`` pixels.
    """
    xy = nans((len(sky), 2))
    ny, nx = shape
    middle = wcs.pixel_to_world(*middle_pixel(shape))
    # a circle about the image: a WCS may fail, or wrap, far from it
    radius = 1.05 * (np.hypot(nx, ny) / 2 + margin) * pixel_scale(wcs)
    is_near = sky.separation(middle).arcsec < radius
    if is_near.any():
        xy[is_near] = sky_to_pixels(sky[is_near], wcs)
    low = -0.5 - margin
    x, y = xy.T
    # a NaN fails every comparison
    inside = (x > low) & (x < nx - 1 - low) & (y > low) & (y < ny - 1 - low)
    xy[~inside] = np.nan
    return xy


def nearest_values(plane, xy):
    """Return values of a plane at the nearest pixels, (n, 2) (0 outside), and whether a position is on it."""
    column, row = np.rint(np.where(np.isfinite(xy), xy, -1.0)).astype(int).T
    inside = is_inside(column, row, plane.shape)
    values = np.zeros(len(xy), plane.dtype)
    values[inside] = plane[row[inside], column[inside]]
    return values, inside


def local_maps(xy, half, image_wcs, grid_wcs):
    """
    Calculate quadratic maps from pixel offsets on an image to positions on a finer grid, shape (n, 2, 6).

    Coefficients of 1, u, v, u^2, u v, v^2 for x and y on the grid. They expand about the image positions
    ``xy``, (n, 2), and are exact at offsets of ``half`` pixels, (n,).
    """
    step = np.maximum(np.asarray(half, float), 2.0)
    u3, v3 = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 0.0, 1.0])
    x = xy[:, 0, None, None] + step[:, None, None] * u3
    y = xy[:, 1, None, None] + step[:, None, None] * v3
    if len(xy) == 0:
        return np.empty((0, 2, 6))
    fine = pixel_to_pixel(image_wcs, grid_wcs, x.ravel(), y.ravel())
    poly = np.empty((len(xy), 2, 6))
    for axis, values in enumerate(fine):
        # differences of the 3 x 3 positions about each source, [source, v, u]
        f = np.asarray(values).reshape(-1, 3, 3)
        poly[:, axis, 0] = f[:, 1, 1]
        # first derivatives along u and v
        poly[:, axis, 1] = (f[:, 1, 2] - f[:, 1, 0]) / (2 * step)
        poly[:, axis, 2] = (f[:, 2, 1] - f[:, 0, 1]) / (2 * step)
        # halves of the second derivatives, and the mixed one
        poly[:, axis, 3] = (f[:, 1, 2] - 2 * f[:, 1, 1] + f[:, 1, 0]) / (2 * step**2)
        poly[:, axis, 4] = (f[:, 2, 2] - f[:, 2, 0] - f[:, 0, 2] + f[:, 0, 0]) / (4 * step**2)
        poly[:, axis, 5] = (f[:, 2, 1] - 2 * f[:, 1, 1] + f[:, 0, 1]) / (2 * step**2)
    return poly
