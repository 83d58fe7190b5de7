"""Dither patterns: offsets of the pointing along the axes of the imager."""

import os
import re
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table

from miricigale.instrument.published_tables import table
from miricigale.instrument.siaf import aperture, imager_columns, vector_angles
from miricigale.instrument.wcs import tangent_offset
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import reading, unpacked_size
from miricigale.utils.named_values import first_value
from miricigale.utils.options import check_data, check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import require_columns
from miricigale.utils.units import ANGLE, check_count, to_array

# sides of the pixel at the reference, arcsec (SIAF)
_PIXEL = (0.110497, 0.111336)

#: Apertures of the imager's full array, and types of exposures, in APT's list of pointings.
_FULL = ("MIRIM_FULL", "MIRIM_ILLUM")
_USED = ("SCIENCE", "PARALLEL")
#: Points of the cycling patterns.
_N_CYCLING = 311
#: Half pixels in turn.
_PHASES = ((0.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.0, 0.5))


@cached
def _cycling(name):
    from scipy.stats.qmc import Halton

    sigma, limit = table("dithers")["cycling"][name]
    # evenly spread over 0 to 1 from any start; without the first, which is zero
    share, turn = Halton(2, scramble=False).random(_N_CYCLING + 1)[1:].T
    inner = (0.4 * limit if name == "cycling-small" else 0.0) ** 2 / (2 * sigma**2)
    a = np.exp(-inner)
    b = np.exp(-((limit - 1) ** 2) / (2 * sigma**2))
    radius = sigma * np.sqrt(-2 * np.log(a - share * (a - b)))
    angle = 2 * np.pi * turn
    points = np.round(np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1))
    points += np.array(_PHASES)[np.arange(_N_CYCLING) % 4]
    points.flags.writeable = False
    return points


def _points(pattern):
    fixed = table("dithers")["points"]
    if pattern in fixed:
        return np.array(fixed[pattern])
    return _cycling(pattern)


def dither_patterns():
    """
    Return the names of the patterns.

    Examples
    --------
    >>> from miricigale.instrument import dither_patterns
    >>> dither_patterns()
    ('ceers', '4-point', 'none', 'cycling-small', 'cycling-medium', 'cycling-large')
    """
    patterns = []
    for kind in table("dithers").values():
        patterns += list(kind)
    return tuple(patterns)


@takes_other_keywords
def dither_offsets(pattern, n=None, *, start=0):
    """
    Return the offsets of the pointing.

    Parameters
    ----------
    pattern : str, path-like, `~astropy.units.Quantity` or `~astropy.table.Table`
        ``"ceers"`` (3 points within 3.1" of the center, or 6 within 5"), ``"4-point"`` (a box
        of 2.2" by 3.4" with half-pixel phases), ``"cycling-small"``, ``"cycling-medium"`` or
        ``"cycling-large"`` (311 points within 1.2", 7" or 14", Gaussian, half-pixel phases in
        turn of four), ``"none"``; or offsets: of shape (m, 2), a table with ``x_offset`` and
        ``y_offset``, or the `~pathlib.Path` of a file for `read_dithers`.
    n : int, optional
        How many; all of the pattern's by default. Named patterns start again, shifted by a
        quarter pixel, when they are used up.
    start : int, optional
        Which of the pattern's points comes first, from 0, as cycling patterns continue from tile to
        tile.

    Returns
    -------
    offsets : `~astropy.units.Quantity`, shape (n, 2)
        Along the ideal +x and +y axes, arcsec.

    Raises
    ------
    KeyError
        If there is no such pattern.
    ValueError
        If ``n`` is smaller than 1, or with ``start`` larger than a table of offsets.

    Examples
    --------
    >>> from miricigale.instrument import dither_offsets
    >>> dither_offsets("4-point").round(2)
    <Quantity [[ 1.1 ,  1.67],
               [-1.16,  1.73],
               [-1.1 , -1.73],
               [ 1.16, -1.67]] arcsec>
    """
    if n is not None:
        n = check_count(n, "n")
    start = check_count(start, "start", 0)
    if isinstance(pattern, str):
        # APT writes 4-POINT
        pattern = pattern.lower()
        check_names([pattern], "dither pattern", dither_patterns())
        points = _points(pattern)
        number = start + np.arange(len(points) if n is None else n)
        turns, step = np.divmod(number, len(points))
        return (points[step] + 0.25 * turns[:, None]) * np.array(_PIXEL) * ANGLE
    if isinstance(pattern, os.PathLike):
        pattern = read_dithers(pattern)
    elif isinstance(pattern, Table):
        pattern = _table_offsets(pattern, "pattern")
    offsets = to_array(pattern, ANGLE, "pattern", ndim=2, finite=True)
    if n is None:
        last = len(offsets)
    else:
        last = start + n
    if offsets.shape[1] != 2 or len(offsets) < last or last <= start:
        raise argument_error("pattern", f"offsets of shape ({last}, 2)", f"shape {offsets.shape}")
    return offsets[start:last] * ANGLE


@takes_other_keywords
def tile_offsets(n_x, n_y, *, overlap=0.1):
    """
    Return the offsets of the pointings of a mosaic of fields side by side.

    Parameters
    ----------
    n_x, n_y : int
        Fields along the axes of the imager.
    overlap : float, optional
        Share of its side that a field has in common with the next one, 0 to less than 1.

    Returns
    -------
    offsets : `~astropy.units.Quantity`, shape (n_x * n_y, 2)
        Along the ideal +x and +y axes, arcsec, with mean 0, row by row (x first), for
        `~miricigale.instrument.Exposure.dithered`. The field is the part of the full frame that sees
        the sky through the imaging filters.

    Raises
    ------
    ValueError
        If a number is smaller than 1, or ``overlap`` is out of its range.

    Examples
    --------
    >>> from miricigale.instrument import tile_offsets
    >>> tile_offsets(2, 1, overlap=0.1).round(1)
    <Quantity [[-33.2,   0. ],
               [ 33.2,   0. ]] arcsec>
    """
    n_x = check_count(n_x, "n_x")
    n_y = check_count(n_y, "n_y")
    check_that(0 <= overlap < 1, "overlap", "at least 0 and less than 1", overlap)
    first, last = imager_columns()
    sides = np.array([last - first, aperture("FULL").shape[0]]) * _PIXEL
    row, column = np.divmod(np.arange(n_x * n_y), n_x)
    steps = np.stack([column - (n_x - 1) / 2, row - (n_y - 1) / 2], axis=1)
    return steps * sides * (1 - overlap) * ANGLE


def _table_offsets(table, argument):
    names = ("x_offset", "y_offset")
    require_columns(table, names, argument, units=dict.fromkeys(names, ANGLE))
    columns = [to_array(table[name], ANGLE, name, finite=True) for name in names]
    return np.stack(columns, axis=1) * ANGLE


def read_dithers(path, *, observation=None, exposure=None):
    """
    Read the offsets of one dither pattern from a table or from APT's list of pointings.

    APT's list states where the target lies in the aperture's ideal frame (``IdlX`` = ``BaseX`` + ``DithX``): where
    ``DithX`` and ``DithY`` are larger, the telescope looks that much further along -x and -y.

    Parameters
    ----------
    path : path-like
        A table with the columns ``x_offset`` and ``y_offset`` and their units (ECSV, FITS), or
        the list that APT exports as ``.pointing``: of this the rows of MIRI imager apertures
        (``MIRIM_...``) that are exposures of science or in parallel are taken, one for each
        dither. Tiles of a mosaic, whose places are in ``DithX`` and ``DithY`` too, are to have one pattern.
    observation : int, optional
        Number of the observation, for a list of several.
    exposure : int, optional
        Number of the exposure in the observation (column ``Exp``; each filter has one of its own), for
        exposures whose dithers differ.

    Returns
    -------
    offsets : `~astropy.units.Quantity`, shape (n, 2)
        Of the pointing along the ideal +x and +y axes, arcsec. Those of a list are about the mean of all exposures
        of the tile, where `read_centers` has the imager look.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or no offsets in it.
    ValueError
        If a list has several observations with such rows, or exposures with other dithers, and none,
        or another, is asked for; if tiles of a mosaic have other dithers than one another; or if a table
        comes with an observation or an exposure, which it has not.

    References
    ----------
    The sign is that of ``XOFFSET`` and ``YOFFSET`` in headers, from which the official pipeline has the target
    (``jwst.assign_wcs.miri.store_dithered_position``).

    Examples
    --------
    >>> from miricigale.instrument import Exposure, read_dithers
    >>> offsets = read_dithers("program.pointing", observation=3)  # doctest: +SKIP
    >>> exposure = Exposure("F770W", n_groups=100, pointing="53.1 -27.8")
    >>> dithers = exposure.dithered(offsets)  # doctest: +SKIP
    """
    path = Path(path).expanduser()
    if not path.is_file():
        msg = f"no file of dithers {str(path)!r}"
        raise DataError(msg)
    unpacked_size(path)
    if path.suffix.lower() == ".pointing":
        return _read_pointings(path, observation, exposure)
    for name, number in (("observation", observation), ("exposure", exposure)):
        check_that(number is None, name, "left out, but for a .pointing file", number)
    with reading(path, "a table"):
        return _table_offsets(read_table(path, wanted="a table"), path.name)


def _rows(path):
    """Rows of APT's list of pointings: the number of the observation, and the columns of its header line."""
    current = 0
    for line in path.read_text(errors="replace").splitlines():
        words = line.split()
        if line.startswith("* "):
            number = re.search(r"\(Obs (\d+)\)", line) or re.search(r"Observation (\d+)", line)
            if number:
                current = int(number.group(1))
            else:
                current = current + 1
        if len(words) >= 19 and all(word.isdigit() for word in words[:4]):
            yield current, words


def read_centers(path, roll):
    """
    Read where the imager looks from APT's list of pointings.

    In this list the target is at the place ``IdlX``, ``IdlY`` of the aperture's ideal frame, also where the imager
    works in parallel.

    Parameters
    ----------
    path : path-like
        What APT exports as ``.pointing``. Exposures of science or in parallel with the full array
        (``MIRIM_FULL``, ``MIRIM_ILLUM``) are used. The list does not have their filters, times or roll.
    roll : `~astropy.units.Quantity`
        Position angle of V3 at the imager.

    Returns
    -------
    centers : list of `~astropy.coordinates.SkyCoord`
        Of each tile of each observation, where the imager looks in the middle of its dithers.
    detectors : list of str
        Apertures of exposures that are not used, with their types.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or no exposures of the imager's full array in it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.instrument import read_centers
    >>> centers, others = read_centers("program.pointing", 40 * u.deg)  # doctest: +SKIP
    """
    path = Path(path).expanduser()
    centers = {}
    detectors = set()
    unpacked_size(path)
    with reading(path, "a list of pointings"):
        for observation, words in _rows(path):
            if words[4] not in _FULL or words[18] not in _USED:
                detectors.add(f"{words[4]} ({words[18]})")
                continue
            place = [float(words[k]) for k in (7, 8, 15, 16)]
            centers.setdefault((observation, *words[:2]), []).append(place)
    check_data(centers, path, f"has no exposures of the full imager; it has {sorted(detectors)}")
    pa = roll + aperture().v3_ideal_y_angle * u.deg
    fields = []
    for places in centers.values():
        fields.append(_looks_at(*np.mean(places, axis=0), pa))
    return fields, sorted(detectors)


def _looks_at(ra, dec, x, y, pa):
    """Return the position of the reference pixel that has a target at a place of the ideal frame (deg, arcsec)."""
    target = center = SkyCoord(ra, dec, unit="deg")
    # north turns on the way: each step leaves some 1e-3 of what is missing
    for _ in range(8):
        missed = target.cartesian - tangent_offset(center, x * ANGLE, y * ANGLE, pa).cartesian
        center = SkyCoord(*vector_angles((center.cartesian + missed).xyz.value), unit="rad")
    return center


def _read_pointings(path, observation, exposure):
    """Return the offsets of the dithers of an exposure."""
    pointings = {}
    apertures = set()
    with reading(path, "a list of pointings"):
        for current, words in _rows(path):
            apertures.add(words[4])
            if not words[4].startswith("MIRIM") or words[18] not in _USED:
                continue
            target, tile, number, dither = map(int, words[:4])
            places = pointings.setdefault(current, {}).setdefault(number, {})
            offset = float(words[11]), float(words[12])
            places.setdefault((target, tile), {}).setdefault(dither, offset)
    check_data(pointings, path, f"has no exposures of MIRIM apertures; it has {sorted(apertures)}")
    exposures = pointings[_chosen("observation", observation, pointings)]
    positions = {}
    for places in exposures.values():
        for tile, offsets in places.items():
            positions.setdefault(tile, []).extend(offsets.values())
    patterns = {
        number: [
            np.mean(positions[k], axis=0) - list(position.values())
            for k, position in places.items()
        ]
        for number, places in exposures.items()
    }
    if exposure is not None or not _alike(
        [position for pattern in patterns.values() for position in pattern]
    ):
        patterns = {0: patterns[_chosen("exposure", exposure, patterns)]}
    offsets = first_value(patterns)
    if not _alike(offsets):
        msg = f"{path.name}: tiles of the observation have dithers that differ from one another"
        raise ValueError(msg)
    return offsets[0] * ANGLE


def _alike(patterns):
    """Tell whether patterns are the same, to the digits of the list."""
    first = patterns[0]
    return all(
        pattern.shape == first.shape and np.allclose(pattern, first, atol=2e-3)
        for pattern in patterns
    )


def _chosen(name, value, available):
    """Return the key that is asked for, or the only one."""
    if value is None and len(available) == 1:
        return next(iter(available))
    check_that(value in available, name, f"one of {sorted(available)}", value)
    return value
