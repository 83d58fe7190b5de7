"""World coordinates of the imager and of mosaics, as `astropy.wcs.WCS`."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.instrument.siaf import (
    aperture,
    attitude_matrix,
    pixel_to_v2v3,
    unit_vector,
    v2v3_to_sky,
    vector_angles,
)
from miricigale.instrument.sky_axes import lon_lat, pixel_to_radec
from miricigale.utils.caching import cached
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import as_position
from miricigale.utils.units import positive, scalar, to_array

_SIP_ORDER = 5
_SIP_INVERSE_ORDER = 8


def _radec(position, name):
    """Return the right ascension and declination of one position (`as_position`), in deg."""
    position = as_position(position, name)
    return float(position.ra.deg), float(position.dec.deg)


def pixel_to_sky(x, y, pointing, roll, *, subarray="FULL"):
    """
    Return the sky positions of pixels by the full spherical transformation, without a fit.

    Parameters
    ----------
    x, y : array_like
        Pixel positions, 0-based.
    pointing : `~astropy.coordinates.SkyCoord`
        Where the reference pixel of the sub-array looks.
    roll : `~astropy.units.Quantity`
        Position angle of +V3 at the reference pixel, east of north.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.

    Returns
    -------
    sky : `~astropy.coordinates.SkyCoord`

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import pixel_to_sky
    >>> field = SkyCoord(53.1, -27.8, unit="deg")
    >>> pixel_to_sky(692.5, 511.5, field, 35 * u.deg).to_string(precision=3)
    '53.100 -27.800'
    """
    ra, dec = _radec(pointing, "pointing")
    roll = scalar(roll, u.deg, "roll")
    part = aperture(subarray)
    # the reference through the polynomial, so that it looks exactly at the pointing
    v2, v3 = pixel_to_v2v3(*part.reference, subarray=subarray)
    matrix = attitude_matrix(ra, dec, roll, v2=float(v2), v3=float(v3))
    v2, v3 = pixel_to_v2v3(x, y, subarray=subarray)
    ra, dec = v2v3_to_sky(v2, v3, matrix)
    return SkyCoord(ra, dec, unit="deg")


def scaled_fit(x, y, values, order):
    """Return the least-squares polynomial without a constant, as a (order+1)^2 table."""
    sx = np.abs(x).max()
    sy = np.abs(y).max()
    powers = [(i, n - i) for n in range(1, order + 1) for i in range(n, -1, -1)]
    design = np.stack([(x / sx) ** i * (y / sy) ** j for i, j in powers], axis=1)
    solution = np.linalg.lstsq(design, values, rcond=None)[0]
    tables = np.zeros((values.shape[1], order + 1, order + 1))
    for (i, j), row in zip(powers, solution, strict=True):
        tables[:, i, j] = row / (sx**i * sy**j)
    return tables


def chebyshev_pixels(shape):
    """Return x and y of 40 x 40 Chebyshev nodes on an image: fits are as good at its edge as inside."""
    ny, nx = shape
    nodes = np.cos(np.pi * (np.arange(40) + 0.5) / 40)
    return np.meshgrid((nx / 2) * (1 + nodes) - 0.5, (ny / 2) * (1 + nodes) - 0.5)


@cached
def _sip(subarray):
    """
    Return the CD matrix at roll 0 (deg / pixel) and SIP tables of a sub-array.

    In the tangent plane at the reference pixel the sky is a rotation of the telescope
    frame, so one fit serves every pointing and roll.
    """
    part = aperture(subarray)
    gx, gy = chebyshev_pixels(part.shape)
    v2_ref, v3_ref = pixel_to_v2v3(*part.reference, subarray=subarray)
    matrix = attitude_matrix(0.0, 0.0, 0.0, v2=float(v2_ref), v3=float(v3_ref))
    v2, v3 = pixel_to_v2v3(gx, gy, subarray=subarray)
    ra, dec = v2v3_to_sky(v2, v3, matrix)
    # gnomonic coordinates (deg) about (0, 0)
    vector = unit_vector(np.radians(ra), np.radians(dec))
    xi = np.degrees(vector[1] / vector[0])
    eta = np.degrees(vector[2] / vector[0])
    dx = (gx - part.reference[0]).ravel()
    dy = (gy - part.reference[1]).ravel()
    forward = scaled_fit(dx, dy, np.stack([xi.ravel(), eta.ravel()], axis=1), _SIP_ORDER)
    cd = np.array([[t[1, 0], t[0, 1]] for t in forward])
    forward[:, 1, 0] = forward[:, 0, 1] = 0
    a, b = np.tensordot(np.linalg.inv(cd), forward, axes=1)
    # the inverse: pixel offsets as corrections of the linear ones
    plane = np.linalg.inv(cd) @ np.stack([xi.ravel(), eta.ravel()])
    shift = np.stack([dx - plane[0], dy - plane[1]], axis=1)
    ap, bp = scaled_fit(plane[0], plane[1], shift, _SIP_INVERSE_ORDER)
    return cd, a, b, ap, bp


@takes_other_keywords
def imager_wcs(pointing, roll, *, subarray="FULL"):
    """
    Return the world coordinates of an exposure, as TAN-SIP.

    Parameters
    ----------
    pointing : `~astropy.coordinates.SkyCoord`
        Where the reference pixel of the sub-array looks.
    roll : `~astropy.units.Quantity`
        Position angle of +V3 at the reference pixel, east of north.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        With ``pixel_shape`` (nx, ny). It equals the full transformation (`pixel_to_sky`)
        to 1e-5 mas in every pixel; the reference pixel is exact.

    Raises
    ------
    ValueError
        If ``pointing`` is not one position.
    KeyError
        If there is no such sub-array.

    References
    ----------
    Shupe et al. 2005, ASP Conf. 347, 491 (SIP).

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import imager_wcs
    >>> wcs = imager_wcs(SkyCoord(53.1, -27.8, unit="deg"), 35 * u.deg)
    >>> wcs.pixel_to_world(692.5, 511.5).to_string(precision=3)
    '53.100 -27.800'
    """
    ra, dec = _radec(pointing, "pointing")
    roll = scalar(roll, u.deg, "roll")
    from astropy.wcs import Sip

    part = aperture(subarray)
    cd, a, b, ap, bp = _sip(subarray)
    wcs = _gnomonic((ra, dec), [n + 1 for n in part.reference], part.shape, "-SIP")
    cos = np.cos(np.radians(roll))
    sin = np.sin(np.radians(roll))
    wcs.wcs.cd = np.array([[cos, sin], [-sin, cos]]) @ cd
    wcs.sip = Sip(a, b, ap, bp, wcs.wcs.crpix)
    wcs.wcs.set()
    return wcs


def _gnomonic(center, reference, shape, distortion=""):
    """Return a tangential WCS of a shape about a position, (ra, dec) in deg, without its scale."""
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    wcs.wcs.ctype = [f"RA---TAN{distortion}", f"DEC--TAN{distortion}"]
    wcs.wcs.cunit = ["deg", "deg"]
    wcs.wcs.radesys = "ICRS"
    wcs.wcs.crval = center
    wcs.wcs.crpix = reference
    wcs.pixel_shape = shape[::-1]
    return wcs


def tangent_offset(pointing, x_offset, y_offset, pa):
    """
    Move along axes turned on the sky.

    Parameters
    ----------
    pointing : `~astropy.coordinates.SkyCoord`
        Where the movement starts.
    x_offset, y_offset : `~astropy.units.Quantity`
        Offsets in the tangent plane; +x lies 90 deg west of +y, as in the ideal frame of
        the imager.
    pa : `~astropy.units.Quantity`
        Position angle of +y, east of north.

    Returns
    -------
    position : `~astropy.coordinates.SkyCoord`

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import tangent_offset
    >>> field = SkyCoord(53.1, 0.0, unit="deg")
    >>> moved = tangent_offset(
    ...     field, 0 * u.arcsec, 36 * u.arcsec, pa=90 * u.deg
    ... )  # +y is east
    >>> moved.to_string(precision=3)
    '53.110 0.000'
    """
    ra, dec = map(np.radians, _radec(pointing, "pointing"))
    x = to_array(x_offset, u.rad, "x_offset")
    y = to_array(y_offset, u.rad, "y_offset")
    pa = scalar(pa, u.rad, "pa")
    east = -x * np.cos(pa) + y * np.sin(pa)
    north = x * np.sin(pa) + y * np.cos(pa)
    radial = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    to_east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    to_north = np.cross(radial, to_east)
    vector = radial + np.multiply.outer(east, to_east) + np.multiply.outer(north, to_north)
    lon, lat = vector_angles(np.moveaxis(vector, -1, 0))
    return SkyCoord(lon, lat, unit="rad")


def pixel_area_map(wcs, shape, out=None):
    """
    Return the solid angle of each pixel.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Two celestial axes, distorted or not, of any frame and in any order.
    shape : tuple of int
        ``(ny, nx)``.
    out : `~numpy.ndarray`, shape (ny, nx), optional
        Filled with the map and returned, some rows at a time.

    Returns
    -------
    area : `~numpy.ndarray`, shape (ny, nx)
        In sr. The Jacobian of the WCS on a coarse grid, joined by bicubic splines.

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import imager_wcs, pixel_area_map
    >>> wcs = imager_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0 * u.deg, subarray="SUB64")
    >>> area = pixel_area_map(wcs, (64, 72)) * u.sr
    >>> area.mean().to("arcsec2").round(5)
    <Quantity 0.01213 arcsec2>
    """
    from scipy.interpolate import make_interp_spline

    ny, nx = shape
    nodes = [np.linspace(0, n - 1, min(max(n, 6), 33)) for n in (ny, nx)]
    x, y = np.meshgrid(nodes[1], nodes[0])

    def direction(dx, dy):
        lon, lat = lon_lat(wcs, (x + dx).ravel(), (y + dy).ravel())
        return unit_vector(np.radians(lon), np.radians(lat))

    step = 0.5
    along_x = (direction(step, 0) - direction(-step, 0)) / (2 * step)
    along_y = (direction(0, step) - direction(0, -step)) / (2 * step)
    area = np.linalg.norm(np.cross(along_x, along_y, axis=0), axis=0).reshape(x.shape)
    if out is None:
        out = np.empty(shape)
    # bicubic splines as products: values at the nodes to those at all pixels, axis by axis
    down, along = (
        make_interp_spline(axis_nodes, np.eye(len(axis_nodes)))(np.arange(n))
        for axis_nodes, n in zip(nodes, shape, strict=True)
    )
    # about the mean, so that all digits are those of its changes
    mean = area.mean()
    change = (down @ (area / mean - 1)).astype(out.dtype)
    along = np.ascontiguousarray(along.T, out.dtype)
    for first in range(0, ny, 256):
        part = out[first : first + 256]
        np.matmul(change[first : first + 256], along, out=part)
        part += 1
        part *= mean
    return out


@takes_other_keywords
def north_up_wcs(center, pixel_scale, shape):
    """
    Return the undistorted gnomonic coordinates with north up and east left.

    Parameters
    ----------
    center : `~astropy.coordinates.SkyCoord`
        Position of the center of the image.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel.
    shape : tuple of int
        ``(ny, nx)``.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        With ``pixel_shape`` (nx, ny).

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import north_up_wcs
    >>> wcs = north_up_wcs(
    ...     SkyCoord(53.1, -27.8, unit="deg"), 0.06 * u.arcsec, (300, 400)
    ... )
    >>> wcs.pixel_shape
    (400, 300)
    """
    ra, dec = _radec(center, "center")
    scale = positive(pixel_scale, u.deg, "pixel_scale")
    ny, nx = map(int, shape)
    check_that(ny >= 1 and nx >= 1, "shape", "two positive integers", shape)
    wcs = _gnomonic((ra, dec), [(nx + 1) / 2, (ny + 1) / 2], (ny, nx))
    wcs.wcs.cdelt = [-scale, scale]
    wcs.wcs.set()
    return wcs


@takes_other_keywords
def mosaic_wcs(exposures, pixel_scale):
    """
    Return the smallest north-up grid that holds every pixel of the exposures.

    Parameters
    ----------
    exposures : iterable of `~miricigale.instrument.Exposure` or `~astropy.wcs.WCS`
        What is to be covered; a WCS must have its ``pixel_shape``.
    pixel_scale : `~astropy.units.Quantity`
        Side of a pixel of the mosaic.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
        With ``pixel_shape`` (nx, ny).

    Raises
    ------
    ValueError
        If there are no exposures, or a WCS has no shape.

    Examples
    --------
    >>> from astropy.coordinates import SkyCoord
    >>> import astropy.units as u
    >>> from miricigale.instrument import Exposure, mosaic_wcs
    >>> exposure = Exposure(
    ...     "F770W", n_groups=10, pointing=SkyCoord(53.1, -27.8, unit="deg")
    ... )
    >>> mosaic_wcs(exposure.dithered("ceers", 3), 0.06 * u.arcsec).pixel_shape
    (2136, 2072)
    """
    from astropy.wcs import WCS

    wcss = []
    for item in exposures:
        if not isinstance(item, WCS):
            wcss.append(getattr(item, "wcs", item))
        else:
            wcss.append(item)
    check_that(wcss, "exposures", "at least one exposure", "none")
    ra = []
    dec = []
    for wcs in wcss:
        check_that(
            wcs.pixel_shape is not None, "exposures", "WCSs with a pixel_shape", "one without"
        )
        nx, ny = wcs.pixel_shape
        # distorted edges bulge between the corners
        tx = np.linspace(-0.5, nx - 0.5, 17)
        ty = np.linspace(-0.5, ny - 0.5, 17)
        x = np.concatenate([tx, tx, np.full(17, -0.5), np.full(17, nx - 0.5)])
        y = np.concatenate([np.full(17, -0.5), np.full(17, ny - 0.5), ty, ty])
        edge = pixel_to_radec(wcs, x, y)
        ra.append(edge[0])
        dec.append(edge[1])
    ra = np.concatenate(ra)
    dec = np.concatenate(dec)
    mean = unit_vector(np.radians(ra), np.radians(dec)).mean(axis=1)
    lon, lat = vector_angles(mean)
    start = SkyCoord(lon, lat, unit="rad")
    # twice: the second time about the middle of the box that the first found
    for _ in range(2):
        grid = north_up_wcs(start, pixel_scale, (1, 1))
        x, y = grid.all_world2pix(ra, dec, 0)
        middle_x = (x.min() + x.max()) / 2
        middle_y = (y.min() + y.max()) / 2
        ra_middle, dec_middle = grid.all_pix2world(middle_x, middle_y, 0)
        start = SkyCoord(ra_middle, dec_middle, unit="deg")
    shape = [int(np.ceil(np.ptp(t))) for t in (y, x)]
    return north_up_wcs(start, pixel_scale, shape)
