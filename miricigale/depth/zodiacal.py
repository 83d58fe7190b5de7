"""How bright zodiacal light and background are: by level, by ecliptic latitude, by position and date."""

import astropy.units as u
import numpy as np
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord, get_sun
from astropy.table import QTable
from astropy.time import Time

from miricigale.filters import Filter
from miricigale.instrument import background_level
from miricigale.instrument.published_tables import filter_row, imager_filter
from miricigale.refdata import locate
from miricigale.utils.caching import cached
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import as_position
from miricigale.utils.units import SURFACE_BRIGHTNESS, scalar

#: Angles from the Sun, deg, between which the telescope may look.
_FIELD_OF_REGARD = (85.0, 135.0)


@cached(copies=True)
def _table():
    return QTable.read(locate("instrument.zodiacal"), format="ascii.ecsv")


def zodiacal_levels():
    """
    Return the names of the levels of `zodiacal_factor`, from dark to bright.

    Examples
    --------
    >>> from miricigale.depth import zodiacal_levels
    >>> zodiacal_levels()
    ('low', 'medium', 'high')
    """
    return tuple(dict.fromkeys(map(str, _table()["level"])))


@takes_other_keywords
def zodiacal_factor(filter, level="medium", *, position=None, date=None):
    """
    Zodiacal light over the low one, which `~miricigale.instrument.background_level` takes as its ``zodi``.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    level : str, optional
        ``"low"``, ``"medium"`` or ``"high"``: the 10th, 50th and 90th percentile over the days on
        which the position can be seen, or, without a position, over the whole sky.
    position : `~astropy.coordinates.SkyCoord`, optional
        Where the telescope looks; its ecliptic latitude counts.
    date : `~astropy.time.Time` or str, optional
        With a position: the light of that day, in place of a level. Needs the package zodipy.

    Returns
    -------
    factor : float

    Raises
    ------
    ImportError
        If a date is given and zodipy is not installed.
    KeyError
        If the filter or level is not known.
    ValueError
        If a date comes without a position, or the position is too near to the Sun, or too far from
        it, to be seen on that day.

    Notes
    -----
    After the model of Kelsall et al. 1998 [1]_ as ZodiPy [2]_ evaluates it at the pivot wavelengths,
    from L2 and between 85 and 135 degrees from the Sun: ``tools/make_zodiacal.py``. Approximations:
    percentiles are over four ecliptic longitudes, latitudes between those of the table are
    interpolated, north and south are alike, and light of the Galaxy and stray light are not in it.

    References
    ----------
    .. [1] Kelsall et al. 1998, ApJ 508, 44
    .. [2] San 2024, JOSS 9, 6648

    Examples
    --------
    >>> from miricigale.depth import zodiacal_factor
    >>> [round(zodiacal_factor("F770W", level), 2) for level in ("low", "medium", "high")]
    [0.99, 1.34, 2.16]
    """
    name = imager_filter(filter)
    if position is not None:
        position = as_position(position, "position")
    if date is not None:
        check_that(position is not None, "date", "given with a position", date)
        return _factor_on(name, position, Time(date))
    check_names([level], "level of the zodiacal light", zodiacal_levels())
    rows = _table()[_table()["level"] == level]
    latitude = rows["latitude"].to_value(u.deg)
    if position is None:
        return float(rows[name][np.isnan(latitude)][0])
    ecliptic = position.transform_to(BarycentricMeanEcliptic)
    is_known = np.isfinite(latitude)
    return float(np.interp(abs(ecliptic.lat.deg), latitude[is_known], rows[name][is_known]))


@takes_other_keywords
def sky_background(filter, level="low", *, position=None, date=None):
    """
    Return the background of sky and telescope by level, position or day.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    level : str or `~astropy.units.Quantity`, optional
        ``"low"``, ``"medium"`` or ``"high"`` zodiacal light as in `zodiacal_factor`, or the surface
        brightness itself. ``"low"`` without a position is the low background of the package
        (`~miricigale.instrument.background_level`).
    position, date : optional
        As in `zodiacal_factor`.

    Returns
    -------
    background : `~astropy.units.Quantity`
        In MJy/sr.

    Raises
    ------
    ImportError, KeyError, ValueError
        As `zodiacal_factor`; or if a surface brightness is negative, or comes with a position or a
        date.
    `~astropy.units.UnitsError`
        If a quantity is no surface brightness.

    Examples
    --------
    >>> from miricigale.depth import sky_background
    >>> print(", ".join(f"{sky_background('miri.f1000w', k):.1f}" for k in ("low", "medium", "high")))
    11.5 MJy / sr, 14.7 MJy / sr, 21.7 MJy / sr
    """
    if isinstance(level, u.Quantity):
        filter_row(filter)
        value = scalar(level, SURFACE_BRIGHTNESS, "level")
        check_that(value >= 0, "level", "at least 0", level)
        for name, argument in (("position", position), ("date", date)):
            check_that(argument is None, name, "left out with a surface brightness", argument)
        return value * SURFACE_BRIGHTNESS
    if level == "low" and position is None and date is None:
        return background_level(filter)
    zodi = zodiacal_factor(filter, level, position=position, date=date)
    return background_level(filter, zodi=zodi)


def _factor_on(name, position, date):
    """Return the light of the model of Kelsall et al. 1998 on a day, over the low one."""
    sun = get_sun(date)
    angle = position.separation(SkyCoord(sun.ra, sun.dec)).deg
    nearest, farthest = _FIELD_OF_REGARD
    wanted = f"a day on which the position is {nearest:g} to {farthest:g} deg from the Sun"
    check_that(nearest <= angle <= farthest, "date", wanted, f"{date.isot[:10]} ({angle:.0f} deg)")
    zodipy = require("zodipy", extra="background")
    place = SkyCoord(position.ra, position.dec, obstime=date)
    light = zodipy.Model(Filter.from_name(name).pivot).evaluate(place, obspos="semb-l2")
    low = background_level(name) - background_level(name, zodi="none")
    return float(light.squeeze() / low)
