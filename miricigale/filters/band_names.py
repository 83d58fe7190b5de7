"""Names of bands: of CIGALE, old and new, and of surveys, for ours."""

import re
import warnings

import astropy.units as u

from miricigale.filters.library import FILTERS, SEDPY, curve_folder
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.package_tables import declared
from miricigale.utils.units import FNU, flux_unit

# between the parts of a name, and the endings of the files of curves
_BETWEEN = re.compile(r"[\s._/:-]+")
_ENDING = re.compile(r"\.(dat|txt|par|res|filter)$", re.IGNORECASE)
# bands that are one of a single instrument, whatever is before them
_ALONE = re.compile(r"f\d+\w*|ch[1-4]|j[123]|h[12]|f850lp")
# a unit at the end of the name of a column: "F770W [uJy]", "f_F770W_nJy"
_UNIT = re.compile(
    r"(?P<name>.+?)\s*(?:[\[(](?P<inner>[^\[\]]+)[\])]|_(?P<suffix>[num]?Jy|nanomaggies))"
)
_XRAY = re.compile(r"xray_boxcar_(\d+(?:p\d+)?)to(\d+(?:p\d+)?)keV")


@cached
def _tables():
    """Return the names without a rule, rules of CIGALE's names, and rules of names written in any way."""
    tables = declared("miricigale.filters", "band_names.toml")
    rules = [(re.compile(rule), ours, *back) for rule, ours, *back in tables["rules"]]
    patterns = [(re.compile(rule, re.IGNORECASE), ours) for rule, ours in tables["free"]]
    return tables["names"], rules, patterns


@cached
def _curves():
    return frozenset(path.stem for path in curve_folder().glob("*.par"))


def _is_here(name):
    if name.startswith(SEDPY):
        return name.removeprefix(SEDPY) in _curves()
    return name in FILTERS.names()


@cached
def find_filter(text):
    """
    Filter that a name in any of the usual forms is.

    Parameters
    ----------
    text : str
        A name of the library, its band alone where that leaves no choice (``F770W``), a curve of astro-sedpy,
        or a name of CIGALE's, EAZY's, the SVO's, 3D-HST's or of papers: ``JWST/MIRI.F770W``,
        ``wfc3_ir_f160w``, ``IRAC 3.6``, ``sdss_r``.

    Returns
    -------
    name : str or None
        A name for `~miricigale.filters.Filter.from_name`; None if there is no such curve here.

    Examples
    --------
    >>> from miricigale.filters import find_filter
    >>> find_filter("JWST/MIRI.F770W"), find_filter("sdss_r")
    ('miri.f770w', 'sedpy.sdss_r0')
    """
    lower = text.lower()
    is_short = _ALONE.fullmatch(lower)
    matches = [n for n in FILTERS.names() if lower in (n, n.partition(".")[2] if is_short else n)]
    if len(matches) == 1:
        return matches[0]
    name = filter_of_band(text)
    if name is None and text in _curves():
        ours = [name for name in FILTERS.names() if FILTERS.metadata(name)["curve"] == text]
        if ours:
            name = ours[0]
        else:
            name = SEDPY + text
    return name


def curves_of_band(band):
    """
    List the filters that a band without its camera may be.

    Parameters
    ----------
    band : str
        Such as ``"Ks"``.

    Returns
    -------
    names : list of str
        Names for `~miricigale.filters.Filter.from_name` that end in it.
    """
    names = [*FILTERS.names(), *(SEDPY + curve for curve in _curves())]
    return [name for name in sorted(names) if re.split("[._]", name)[-1].lower() == band.lower()]


def unknown_filter(name):
    """Make the `KeyError` of a name that no filter has: cameras that have such a band, or the nearest names."""
    with_cameras = curves_of_band(name)
    if with_cameras:
        msg = f"no filter {name!r} without its camera: {', '.join(with_cameras)}"
        return KeyError(msg)
    camera = name.lower()
    if any(filter_name.startswith(f"{camera}.") for filter_name in FILTERS.names()):
        msg = f"no filter {name!r}, which is a camera: FilterSet('{camera}.*') has its filters"
        return KeyError(msg)
    return unknown_name("filter", name, FILTERS.names())


def name_and_unit(text):
    """
    Take the unit off the end of the name of a column.

    Parameters
    ----------
    text : str
        Such as ``"F770W [uJy]"``, ``"flux_f770w(mJy)"`` or ``"f_F770W_nJy"``.

    Returns
    -------
    name : str
        Without the unit; the text itself if no unit of flux density and none of magnitudes ends it.
    unit : `~astropy.units.UnitBase` or `~astropy.units.FunctionUnitBase` or None
        None without one, and for magnitudes that do not say of which kind.
    """
    match = _UNIT.fullmatch(text)
    if match is None:
        return text, None
    word = match["inner"] or match["suffix"]
    if word.strip().lower() == "mag":
        return match["name"], None
    unit = flux_unit(word)
    if unit is None:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", u.UnitsWarning)
            unit = u.Unit(word, parse_strict="silent")
    is_flux = isinstance(unit, u.UnitBase) and unit.is_equivalent(FNU)
    if is_flux or unit == u.ABmag:
        return match["name"], unit
    return text, None


def band_label(name):
    """Return a filter's name without its instrument, in upper case: ``F770W`` for ``miri.f770w``."""
    return name.rpartition(".")[2].upper()


def known_filter(label, names, kind):
    """
    Filter out of some that a user means.

    Parameters
    ----------
    label : str or `~miricigale.filters.Filter`
        In any of the forms of `find_filter`.
    names : iterable of str
        Our names of those that may be meant.
    kind : str
        What they are called in messages.

    Returns
    -------
    name : str
        One of ``names``.

    Raises
    ------
    KeyError
        If it is none of them.
    """
    text = str(getattr(label, "name", label))
    name = text
    if text not in names:
        name = find_filter(text)
    if name not in names:
        raise unknown_name(kind, text, names)
    return name


def eazy_filter(number):
    """Filter of a number in EAZY's ``FILTER.RES.latest``; None if there is no such curve here."""
    groups = declared("miricigale.filters", "band_names.toml")["eazy"].items()
    return next((start + group[number] for start, group in groups if number in group), None)


@cached
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

    Examples
    --------
    >>> from miricigale.filters import filter_of_band
    >>> filter_of_band("IRAC1"), filter_of_band("VISTA_Ks")
    ('irac.ch1', 'sedpy.vista_vircam_Ks')
    """
    if _is_here(band):
        return band
    names, _, patterns = _tables()
    if name := names.get(band) or _by_rule(band):
        return name
    bare_name = _BETWEEN.sub(".", _ENDING.sub("", band.strip()))
    for rule, ours in patterns:
        match = rule.fullmatch(bare_name)
        if match is None:
            continue
        part = "".join(match.groups())
        for written in (part.lower(), part.upper(), part.capitalize()):
            name = ours.format(written)
            if _is_here(name):
                return name
    return None


def _by_rule(band):
    """Filter of a band by CIGALE's own names, as they are written there; None if there is none."""
    for rule, ours, *_ in _tables()[1]:
        match = rule.fullmatch(band)
        if match is None:
            continue
        name = ours.format(match[1], match[1].lower())
        if _is_here(name):
            return name
    return None


@cached
def cigale_band(name):
    """
    Return the band of CIGALE that a filter is.

    Parameters
    ----------
    name : str
        Name of a filter here.

    Returns
    -------
    band : str
        CIGALE's name; ``name`` itself where CIGALE has none that we know.

    Examples
    --------
    >>> from miricigale.filters import cigale_band
    >>> cigale_band("miri.f770w"), cigale_band("irac.ch1")
    ('jwst.miri.F770W', 'spitzer.irac.ch1')
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
    """Tell whether a band is an emission line, in W/m2."""
    return band.startswith(("line.", "linefilter."))


def xray_energies(band):
    """Lowest and highest energy in keV of a band of CIGALE such as ``xray_boxcar_0p5to2keV``; None of others."""
    match = _XRAY.fullmatch(band)
    ends = match and tuple(float(text.replace("p", ".")) for text in match.groups())
    if ends and 0 < ends[0] < ends[1]:
        return ends
    return None


def band_filters(bands, names):
    """
    Return the filters of bands: a dict of our name to CIGALE's, and the bands without a filter here.

    ``names`` are filters that the user gave by CIGALE's names, as `given_filters` has them. Emission lines
    have no filter; two bands of the same filter are a ValueError. X-ray bands (`xray_energies`) keep their names.
    """
    filters = {}
    lost = []
    for band in bands:
        filter_name = names.get(band)
        our_name = filter_of_band(band) or (band if xray_energies(band) else None)
        name = our_name
        if filter_name is not None:
            name = filter_name.name
        if is_line(band):
            name = None
        if name is None:
            lost.append(band)
        elif name in filters:
            msg = f"the bands {filters[name]} and {band} are both the filter {name}"
            raise ValueError(msg)
        else:
            filters[name] = band
    return filters, lost
