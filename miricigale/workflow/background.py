"""The background of sky and telescope as options have it: by level, position or day."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.depth import sky_background
from miricigale.filters.band_names import band_label
from miricigale.utils.caching import cached
from miricigale.utils.units import SURFACE_BRIGHTNESS
from miricigale.workflow.options import require

#: Names of levels, and the percentiles that they are.
_PERCENTILES = {"low": 10, "medium": 50, "high": 90}


def check_levels(section, key, levels, n, date=""):
    """
    Refuse levels that are none, of another number than 1 or ``n``, or that a day makes useless.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        Naming ``section`` and ``key``, what was wanted and what came.
    """
    wanted = f"must have one level, or one for each band ({n})"
    require(len(levels) in (1, n), section, key, wanted, len(levels))
    wanted = f"must be one of {list(_PERCENTILES)} or a surface brightness such as '12.5 MJy/sr'"
    for level in levels:
        try:
            good = level in _PERCENTILES or 0 <= _read(level).value < np.inf
        except (TypeError, ValueError):
            good = False
        require(good, section, key, wanted, repr(level))
    wanted = "must be left out with a date, which says how bright the zodiacal light is"
    require(not date or tuple(levels) == ("low",), section, key, wanted, list(levels))


def _read(level):
    """Return the surface brightness that a text says."""
    return u.Quantity(level).to(SURFACE_BRIGHTNESS)


def of_filter(values, k):
    """Return the value of the k-th filter, of values of all filters or a single one for all."""
    if len(values) > 1:
        return values[k]
    return values[0]


def text_by_filter(texts):
    """Join the texts of filters into a sentence: the text alone where it is the same for all."""
    names = {}
    for filter, text in texts.items():
        names.setdefault(text, []).append(band_label(filter))
    if len(names) == 1:
        return next(iter(names))
    return "; ".join(f"{', '.join(filters)}: {text}" for text, filters in names.items())


def band_background(filter, filters, levels, *, position=None, date=""):
    """
    Return the background of one of several filters.

    Parameters
    ----------
    filter : str
        Which of ``filters``.
    filters : iterable of str
        All filters, in the order of the levels.
    levels : tuple of str
        Such as `check_levels` passes.
    position : `~astropy.coordinates.SkyCoord`, optional
        Where names and ``date`` are of; names are of the whole sky without it.
    date : str, optional
        The day, instead of a level.

    Returns
    -------
    background : `~astropy.units.Quantity`
        In MJy/sr.
    """
    level = of_filter(levels, list(filters).index(filter))
    if level not in _PERCENTILES:
        return sky_background(filter, _read(level))
    if position is None:
        return _named(filter, level, None, date)
    sky = position.icrs
    return _named(filter, level, (sky.ra.deg, sky.dec.deg), date)


@cached(maxsize=64)
def _named(filter, level, place, date):
    """Return the background of a named level, which every exposure asks for and which is slow for a day."""
    if place is None:
        return sky_background(filter, level)
    return sky_background(filter, level, position=SkyCoord(*place, unit="deg"), date=date or None)


def background_text(filters, levels, *, position=None, date=""):
    """Return what the background of filters is and where it is from; arguments as of `band_background`."""
    texts = {}
    for k, filter in enumerate(filters):
        texts[filter] = _source(of_filter(levels, k), position, date)
    return text_by_filter(texts)


def _source(level, position, date):
    """Return where the background of a level is from, in words."""
    if level not in _PERCENTILES:
        return f"{_read(level):g}, as given"
    if level == "low" and position is None:
        return "telescope and low zodiacal light (Rigby et al. 2023, jwst_backgrounds)"
    place = "the sky"
    days = place
    if position is not None:
        place = f"RA {position.icrs.ra.deg:.4f}, Dec {position.icrs.dec.deg:.4f}"
        days = f"the days on which {place} can be seen"
    light = f"{level} zodiacal light, the {_PERCENTILES.get(level)}th percentile over {days}"
    if date:
        light = f"zodiacal light of {date} at {place}"
    return f"telescope and {light} (Kelsall et al. 1998 by ZodiPy)"
