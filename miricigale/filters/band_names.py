"""Names of bands: of CIGALE, old and new, and of surveys, for ours."""

import os
import re
import tomllib
from functools import cache
from importlib import resources as importlib_resources
from pathlib import Path

from miricigale.filters.filter import Filter
from miricigale.filters.library import SEDPY, curve_folder
from miricigale.utils.exceptions import argument_error

_XRAY = re.compile(r"xray_boxcar_(\d+(?:p\d+)?)to(\d+(?:p\d+)?)keV")


@cache
def _tables():
    """Names without a rule, rules of CIGALE's names, and rules of names written in any way."""
    text = (importlib_resources.files("miricigale.filters") / "band_names.toml").read_text("utf-8")
    tables = tomllib.loads(text)
    rules = [(re.compile(rule), ours, *back) for rule, ours, *back in tables["rules"]]
    free = [(re.compile(rule, re.IGNORECASE), ours) for rule, ours in tables["free"]]
    return tables["names"], rules, free


@cache
def _curves():
    return frozenset(path.stem for path in curve_folder().glob("*.par"))


def _is_here(name):
    if name.startswith(SEDPY):
        return name.removeprefix(SEDPY) in _curves()
    return name in Filter.names()


@cache
def filter_of_band(band):
    """
    Filter that a band of CIGALE is.

    Parameters
    ----------
    band : str
        A name of CIGALE's, such as ``IRAC1``, ``spitzer.irac.ch1`` or ``F770W``, one of ours, or the
        instrument and the band in any usual form (``VISTA_Ks``, ``decam.g``, ``newfirm_J1``).

    Returns
    -------
    name : str or None
        A name for `~miricigale.filters.Filter.from_name`; None if there is no such curve here.
    """
    if _is_here(band):
        return band
    names, _, free = _tables()
    if band in names:
        return names[band]
    name = _by_rule(band)
    if name is not None:
        return name
    for rule, ours in free:
        match = rule.fullmatch(band)
        written = (match[1].lower(), match[1].upper(), match[1].capitalize()) if match else ()
        for name in map(ours.format, written):
            if _is_here(name):
                return name
    return None


def _by_rule(band):
    """Filter of a band by CIGALE's own names, as they are written there; None if there is none."""
    for rule, ours, *_ in _tables()[1]:
        match = rule.fullmatch(band)
        name = None if match is None else ours.format(match[1], match[1].lower())
        if name is not None and _is_here(name):
            return name
    return None


@cache
def cigale_band(name):
    """
    Band of CIGALE that a filter is.

    Parameters
    ----------
    name : str
        Name of a filter here.

    Returns
    -------
    band : str
        CIGALE's name; ``name`` itself where CIGALE has none that we know.
    """
    names, rules, _ = _tables()
    for band, ours in names.items():
        if ours == name and band.startswith(("herschel", "cfht")):
            return band
    for _, ours, *back in rules:
        if not back:
            continue
        start, _, end = re.sub(r"\{\d\}", "\0", ours).partition("\0")
        if name.startswith(start) and name.endswith(end) and len(name) > len(start) + len(end):
            part = name[len(start) : len(name) - len(end)]
            for written in dict.fromkeys((part, part.upper())):
                band = back[0].format(written)
                if _by_rule(band) == name:
                    return band
    return name


def is_line(band):
    """Whether a band is an emission line, in W/m2."""
    return band.startswith(("line.", "linefilter."))


def xray_energies(band):
    """Lowest and highest energy in keV of a band of CIGALE such as ``xray_boxcar_0p5to2keV``; None of others."""
    match = _XRAY.fullmatch(band)
    ends = match and tuple(float(text.replace("p", ".")) for text in match.groups())
    return ends if ends and 0 < ends[0] < ends[1] else None


def band_filters(bands, known):
    """
    Filters of bands: a dict of our name to CIGALE's, and the bands without a filter here.

    ``known`` are filters that the user gave by CIGALE's names, as `given_filters` has them. Emission lines
    have no filter; two bands of the same filter are a ValueError. X-ray bands (`xray_energies`) keep their names.
    """
    filters, lost = {}, []
    for band in bands:
        given = known.get(band)
        own = filter_of_band(band) or (band if xray_energies(band) else None)
        name = own if given is None else given.name
        name = None if is_line(band) else name
        if name is None:
            lost.append(band)
        elif name in filters:
            msg = f"the bands {filters[name]} and {band} are both the filter {name}"
            raise ValueError(msg)
        else:
            filters[name] = band
    return filters, lost


def given_filters(names):
    """
    Filters that a user gave for bands.

    Parameters
    ----------
    names : dict of str to `~miricigale.filters.Filter`, str or path-like, or None
        By the band's name a filter, the name of one here, or the path of its file (see `Filter.read`); the
        filter of a file has the name of the band.

    Returns
    -------
    filters : dict of str to `~miricigale.filters.Filter`

    Raises
    ------
    KeyError
        If there is no filter of a name.
    `~miricigale.utils.exceptions.DataError`
        If a file cannot be read as a filter.
    ValueError
        If a value is something else.
    """
    out = {}
    for band, given in (names or {}).items():
        if isinstance(given, Filter):
            out[band] = given
        elif isinstance(given, os.PathLike) or (isinstance(given, str) and _is_path(given)):
            out[band] = Filter.read(Path(given).expanduser(), name=band)
        elif isinstance(given, str):
            out[band] = Filter.from_name(filter_of_band(given) or given)
        else:
            wanted = f"a dict whose value for {band!r} is a Filter, the name of one or the path of its file"
            raise argument_error("names", wanted, type(given).__name__)
    return out


def _is_path(text):
    if filter_of_band(text) is not None:
        return False
    return os.sep in text or Path(text).suffix in (".dat", ".txt", ".par") or Path(text).is_file()
