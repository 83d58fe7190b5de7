"""Right ascension and declination of pixels, whatever the frame and the order of the axes of a WCS."""

import astropy.units as u
from astropy.coordinates import ICRS, SkyCoord

from miricigale.utils.exceptions import argument_error


def lon_lat(wcs, x, y):
    """
    Return the longitude and latitude of pixels in the frame of a WCS.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Two celestial axes, of which either may be the first: FITS allows CTYPE1 = DEC--TAN.
    x, y : `~numpy.ndarray`, shape (n,)
        Pixel positions, 0-based.

    Returns
    -------
    lon, lat : `~numpy.ndarray`, shape (n,)
        In deg.
    """
    world = wcs.all_pix2world(x, y, 0)
    return world[wcs.wcs.lng], world[wcs.wcs.lat]


def pixel_to_radec(wcs, x, y):
    """
    Return the right ascension and declination (ICRS) of pixels.

    Parameters
    ----------
    wcs, x, y
        As for `lon_lat`; the frame may be another one, such as that of the Galaxy.

    Returns
    -------
    ra, dec : `~numpy.ndarray`, shape (n,)
        In deg.
    """
    lon, lat = lon_lat(wcs, x, y)
    frame = _frame(wcs)
    if isinstance(frame, ICRS):
        return lon, lat
    sky = SkyCoord(lon, lat, unit="deg", frame=frame).icrs
    return sky.ra.deg, sky.dec.deg


def radec_axes(wcs, ra, dec):
    """
    Return the values on the axes of a WCS, in their order and frame, of right ascension and declination.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        As for `lon_lat`.
    ra, dec : `~numpy.ndarray`, shape (n,)
        ICRS, in deg.

    Returns
    -------
    first, second : `~numpy.ndarray`, shape (n,)
        What ``wcs.all_world2pix`` takes, in deg.
    """
    frame = _frame(wcs)
    if isinstance(frame, ICRS):
        lon = ra
        lat = dec
    else:
        sky = SkyCoord(ra, dec, unit="deg").transform_to(frame)
        lon = sky.spherical.lon.deg
        lat = sky.spherical.lat.deg
    if wcs.wcs.lng < wcs.wcs.lat:
        return lon, lat
    return lat, lon


def grid_angle(wcs, shape):
    """
    Return the position angle of an image's +y axis at its middle.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Celestial, in any frame.
    shape : tuple of int
        ``(ny, nx)``.

    Returns
    -------
    angle : `~astropy.units.Quantity`
        In deg, east of the north of right ascension and declination (ICRS).

    Raises
    ------
    ValueError
        If the image is mirrored (east to the right where north is up).
    """
    x = (shape[1] - 1) / 2
    y = (shape[0] - 1) / 2
    middle = wcs.pixel_to_world(x, y).icrs
    up = wcs.pixel_to_world(x, y + 1).icrs
    right = wcs.pixel_to_world(x + 1, y).icrs
    angle = middle.position_angle(up).to(u.deg)
    turn = (angle - middle.position_angle(right)).to_value(u.deg) % 360
    if turn > 180:
        raise argument_error(
            "wcs",
            "of an image of the sky (east left of north)",
            "a mirrored one: flip the pixels and the coordinates along one axis",
        )
    return angle


def _frame(wcs):
    """Return the celestial frame of a WCS; sets it up, so that its ``lng`` and ``lat`` are known."""
    from astropy.wcs.utils import wcs_to_celestial_frame

    wcs.wcs.set()
    return wcs_to_celestial_frame(wcs)
