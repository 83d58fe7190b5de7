"""Dither patterns: offsets of the pointing along the axes of the imager."""

import astropy.units as u
import numpy as np

from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.units import to_array

__all__ = ["dither_offsets", "dither_patterns"]

# sides of the pixel at the reference, arcsec (SIAF)
_PIXEL = (0.110497, 0.111336)

# In pixels, (x, y): steps of a few arcsec step over bad pixels and cosmic rays, and the
# fractions (thirds, halves) sample the pixel grid evenly. They have the form of the
# observatory's patterns, not the digits of its tables.
_PATTERNS = {
    # three points on a slanted line, thirds of a pixel apart in phase; three more fill the
    # sixths
    "ceers": [
        (0.0, 0.0),
        (-22.0 - 1 / 3, 14.0 + 1 / 3),
        (23.0 + 1 / 3, -15.0 + 2 / 3),
        (12.0 + 1 / 2, 30.0 + 1 / 2),
        (-33.0 + 1 / 6, -9.0 - 1 / 6),
        (34.0 - 1 / 6, -28.0 + 1 / 6),
    ],
    # a box whose corners differ by half a pixel in x, in y, in both
    "4-point": [
        (10.0, 15.0),
        (-10.5, 15.5),
        (-10.0, -15.5),
        (10.5, -15.0),
    ],
    "none": [(0.0, 0.0)],
}


def dither_patterns():
    """Names of the patterns."""
    return tuple(_PATTERNS)


def dither_offsets(pattern, n):
    """
    Offsets of the pointing.

    Parameters
    ----------
    pattern : str or `~astropy.units.Quantity`
        ``"ceers"`` (3 points within 2.6" of the centre, or 6 within 5"), ``"4-point"`` (a box of 2" by 3" with
        half-pixel phases), ``"none"``, or a table of offsets of shape (m, 2).
    n : int
        How many; patterns start again, shifted by a quarter pixel, when they are used up.

    Returns
    -------
    offsets : `~astropy.units.Quantity`, shape (n, 2)
        Along the ideal +x and +y axes, arcsec.

    Raises
    ------
    KeyError
        If there is no such pattern.
    ValueError
        If ``n`` is smaller than 1, or larger than a table of offsets.
    """
    if n < 1 or int(n) != n:
        raise argument_error("n", "a positive integer", n)
    if not isinstance(pattern, str):
        offsets = to_array(pattern, u.arcsec, "pattern", ndim=2, finite=True)
        if offsets.shape[1] != 2 or offsets.shape[0] < n:
            raise argument_error("pattern", f"offsets of shape ({n}, 2)", f"shape {offsets.shape}")
        return offsets[:n] * u.arcsec
    if pattern not in _PATTERNS:
        raise unknown_name("dither pattern", pattern, _PATTERNS)
    points = np.array(_PATTERNS[pattern])
    turns, step = np.divmod(np.arange(int(n)), len(points))
    return (points[step] + 0.25 * turns[:, None]) * np.array(_PIXEL) * u.arcsec
