"""
Where the pixels of the MIRI imager look.

The chain is that of the Science Instrument Aperture File: pixel -> ideal plane (a
polynomial of degree 4) -> telescope frame V2, V3 -> sky (rotations of the sphere). Pixels
are 0-based here, with integers at their centers.
"""

import dataclasses

import astropy.units as u
import numpy as np
from astropy.coordinates.matrix_utilities import rotation_matrix

from miricigale.instrument.published_tables import table
from miricigale.utils.caching import cached
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_names

_ARCSEC = np.pi / 180 / 3600


@dataclasses.dataclass(frozen=True)
class Aperture:
    """
    A sub-array of the imager.

    Parameters
    ----------
    name : str
        ``"FULL"``, ``"BRIGHTSKY"``, ``"SUB256"``, ``"SUB128"`` or ``"SUB64"``.
    origin : tuple of int
        Column and row of its first pixel in the full frame, 0-based.
    shape : tuple of int
        Rows and columns, ``(ny, nx)``.
    reference : tuple of float
        Reference pixel ``(x, y)`` in the sub-array, 0-based.
    v2, v3 : float
        Telescope coordinates of the reference pixel, arcsec.
    v3_ideal_y_angle : float
        Angle of the ideal +y axis from +V3 towards +V2, deg.
    parity : int
        -1 when ideal +x points to -V2.

    Examples
    --------
    >>> from miricigale.instrument import aperture
    >>> sub64 = aperture("SUB64")
    >>> sub64.origin, sub64.shape
    ((0, 778), (64, 72))
    """

    name: str
    origin: tuple
    shape: tuple
    reference: tuple
    v2: float
    v3: float
    v3_ideal_y_angle: float
    parity: int

    @property
    def slices(self):
        """Slices ``[y, x]`` that cut the sub-array out of a full frame."""
        x, y = self.origin
        ny, nx = self.shape
        return slice(y, y + ny), slice(x, x + nx)


def subarrays():
    """
    Return the names of the sub-arrays, ``"FULL"`` first.

    Examples
    --------
    >>> from miricigale.instrument import subarrays
    >>> subarrays()
    ('FULL', 'BRIGHTSKY', 'SUB256', 'SUB128', 'SUB64')
    """
    return tuple(table("siaf")["subarrays"])


def imager_columns():
    """
    Return the first and last (excluded) column of the full frame that sees the sky through the filters.

    Examples
    --------
    >>> from miricigale.instrument import imager_columns
    >>> imager_columns()
    (359, 1027)
    """
    return tuple(table("siaf")["imager_columns"])


@cached
def aperture(name="FULL"):
    """
    Look up a sub-array.

    Parameters
    ----------
    name : str, optional
        One of `subarrays`, or its name in the SIAF, such as ``"MIRIM_FULL"``.

    Returns
    -------
    aperture : `Aperture`

    Raises
    ------
    KeyError
        If there is no such sub-array; the message lists the known ones.

    Examples
    --------
    >>> from miricigale.instrument import aperture
    >>> aperture("BRIGHTSKY").shape
    (512, 512)
    """
    siaf = table("siaf")
    name = name.removeprefix("MIRIM_")
    check_names([name], "sub-array", siaf["subarrays"])
    row = siaf["subarrays"][name]
    nx, ny = row["size"]
    return Aperture(
        name=name,
        origin=tuple(row["origin"]),
        shape=(ny, nx),
        reference=(row["reference"][0] - 1, row["reference"][1] - 1),
        v2=row["v2"],
        v3=row["v3"],
        v3_ideal_y_angle=siaf["v3_ideal_y_angle"],
        parity=siaf["parity"],
    )


def _ideal(x, y):
    """Return the ideal coordinates (arcsec) of pixel offsets to the reference of the full frame."""
    # row i: the coefficients of x^(i-j) y^j
    sums = []
    for axis in ("x_ideal", "y_ideal"):
        total = np.zeros(np.broadcast(x, y).shape)
        for i, row in enumerate(table("siaf")[axis]):
            for j, coefficient in enumerate(row):
                total = total + coefficient * x ** (i - j) * y**j
        sums.append(total)
    return sums


def pixel_to_v2v3(x, y, *, subarray="FULL"):
    """
    Return the telescope coordinates of pixels.

    Parameters
    ----------
    x, y : array_like
        Pixel positions in the sub-array, 0-based.
    subarray : str, optional
        One of `subarrays`. All use the polynomial of the full frame, to which the
        sub-arrays' own expansions in the SIAF agree to 0.001 mas.

    Returns
    -------
    v2, v3 : `~numpy.ndarray`
        In arcsec.

    Examples
    --------
    >>> from miricigale.instrument import pixel_to_v2v3
    >>> v2, v3 = pixel_to_v2v3(692.5, 511.5)
    >>> print(f"{v2:.1f}, {v3:.1f} arcsec")
    -453.3, -373.7 arcsec
    """
    full = aperture("FULL")
    part = aperture(subarray)
    x = floats(x) + part.origin[0] - full.reference[0]
    y = floats(y) + part.origin[1] - full.reference[1]
    x_ideal, y_ideal = _ideal(x, y)
    angle = np.radians(full.v3_ideal_y_angle)
    cos = np.cos(angle)
    sin = np.sin(angle)
    v2 = full.v2 + full.parity * x_ideal * cos + y_ideal * sin
    v3 = full.v3 - full.parity * x_ideal * sin + y_ideal * cos
    return v2, v3


def attitude_matrix(ra, dec, roll, *, v2, v3):
    """
    Return the rotation from the telescope frame to the sky.

    Parameters
    ----------
    ra, dec : float
        Where the point (v2, v3) looks, deg.
    roll : float
        Position angle of +V3 there, east of north, deg.
    v2, v3 : float
        Telescope coordinates of the point, arcsec.

    Returns
    -------
    matrix : `~numpy.ndarray`, shape (3, 3)
        Multiplies unit vectors of the telescope frame.

    References
    ----------
    JWST-STScI-001550, "Description and use of the JWST Science Instrument Aperture File".

    Examples
    --------
    >>> from miricigale.instrument import aperture, attitude_matrix, v2v3_to_sky
    >>> full = aperture("FULL")
    >>> matrix = attitude_matrix(53.1, -27.8, 35.0, v2=full.v2, v3=full.v3)
    >>> ra, dec = v2v3_to_sky(full.v2, full.v3, matrix)
    >>> print(f"{ra:.4f} {dec:.4f}")
    53.1000 -27.8000
    """
    ra, dec, roll = np.radians([ra, dec, roll])
    # astropy turns the axes, not the vectors
    return (
        rotation_matrix(-ra * u.rad, "z")
        @ rotation_matrix(dec * u.rad, "y")
        @ rotation_matrix(roll * u.rad, "x")
        @ rotation_matrix(-v3 * _ARCSEC * u.rad, "y")
        @ rotation_matrix(v2 * _ARCSEC * u.rad, "z")
    )


def unit_vector(longitude, latitude):
    """Return the unit vectors of angles in radians, the three components first."""
    cos = np.cos(latitude)
    return np.stack([cos * np.cos(longitude), cos * np.sin(longitude), np.sin(latitude)])


def vector_angles(vector):
    """Return the longitude and latitude (rad) of vectors, the three components first."""
    x, y, z = vector
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def v2v3_to_sky(v2, v3, matrix):
    """
    Return the sky positions of telescope coordinates.

    Parameters
    ----------
    v2, v3 : array_like
        In arcsec.
    matrix : `~numpy.ndarray`, shape (3, 3)
        From `attitude_matrix`.

    Returns
    -------
    ra, dec : `~numpy.ndarray`
        In deg, ra in 0-360.

    Examples
    --------
    >>> from miricigale.instrument import attitude_matrix, pixel_to_v2v3, v2v3_to_sky
    >>> v2, v3 = pixel_to_v2v3(100.0, 200.0)
    >>> matrix = attitude_matrix(53.1, -27.8, 35.0, v2=-453.0, v3=-373.0)
    >>> ra, dec = v2v3_to_sky(v2, v3, matrix)
    >>> print(f"{ra:.3f} {dec:.3f}")
    53.109 -27.819
    """
    vector = unit_vector(floats(v2) * _ARCSEC, floats(v3) * _ARCSEC)
    vector = np.tensordot(matrix, vector, axes=1)
    ra, dec = vector_angles(vector)
    return np.degrees(ra) % 360, np.degrees(dec)
