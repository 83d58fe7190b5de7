"""Units that files of spectra in text state in their comments and names of columns."""

import re
import warnings

import astropy.units as u

from miricigale.filters.curve_files import unit_of_comments
from miricigale.utils.exceptions import DataError, data_error
from miricigale.utils.files import packed_open
from miricigale.utils.units import flux_unit

#: Text at the start of a file in which units are looked for.
_HEAD = 1 << 16
#: Behind the name of a column, in brackets or after an underscore.
_UNIT = r"\s*[\[(](?P<unit>[^\[\]]+?)[\])](?=[\s,;|]|$)"
_FLUX = re.compile(rf"\b(?:flux\w*|f_?nu|f_?lam(?:bda)?|s_?nu)\b{_UNIT}", re.IGNORECASE)
_ENDING = re.compile(r"\bflux_(?P<unit>[munkM]?(?:icro)?Jy)\b", re.IGNORECASE)
#: Frequencies and energies in place of wavelengths.
_FREQUENCY = re.compile(
    r"\b(?:freq\w*|nu|energy)\s*[\[(]\s*[kMGT]?(?:Hz|eV)\s*[\])]", re.IGNORECASE
)
#: Fluxes times frequencies or wavelengths.
_TIMES = re.compile(
    r"\b(?:nu_?\*?_?[fls]_?nu|lam(?:bda)?_?\*?_?[fl]_?lam(?:bda)?)\b", re.IGNORECASE
)
#: An Angstrom as most spectra write it, which is an ampere in units.
_ANGSTROM = re.compile(r"(?<![A-Za-z])A(?![A-Za-z])")
#: Fluxes per frequency, whose unit nothing says.
_BARE_FNU = re.compile(r"\b(?:f_?nu|s_?nu)\b", re.IGNORECASE)


def stated_units(path, colnames):
    """
    Find the units that a text file of a spectrum states.

    Parameters
    ----------
    path : path-like
        The file, packed or not.
    colnames : iterable of str
        Names of its columns as they were read.

    Returns
    -------
    wave, flux : `~astropy.units.UnitBase` or None
        None where nothing is stated, or the file is no text.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If two units of wavelengths are named, the unit of the fluxes is unknown, fluxes are per frequency without
        a unit, or columns are frequencies, energies, or fluxes times frequencies or wavelengths.
    """
    with packed_open(path) as stream:
        head = stream.read(_HEAD)
    if head.startswith(b"SIMPLE") or b"\0" in head:
        return None, None
    lines = head.decode("utf-8", "replace").splitlines()
    texts = [line.lstrip("# ").strip() for line in lines if line.startswith("#")]
    texts.append(" ".join(colnames))
    for text in texts:
        if _FREQUENCY.search(text):
            raise data_error(path, f"has frequencies or energies in place of wavelengths: {text!r}")
    # the unit of a flux may hold one of length
    of_waves = [_FLUX.sub("", text) for text in texts]
    return _wave_unit(of_waves, path), _flux_unit(texts, path)


def _wave_unit(texts, path):
    """Return the unit of the wavelengths; the words of the line of the columns count first."""
    try:
        return unit_of_comments(texts, path)
    except DataError as err:
        if "does not state" in str(err):
            return None
        raise


def _flux_unit(texts, path):
    """Return the unit of the fluxes in brackets behind their name."""
    for text in texts:
        match = _FLUX.search(text) or _ENDING.search(text)
        if match is not None:
            unit_text = _ANGSTROM.sub("Angstrom", match["unit"])
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", u.UnitsWarning)
                unit = flux_unit(unit_text) or u.Unit(unit_text, parse_strict="silent")
            if isinstance(unit, u.UnrecognizedUnit):
                problem = f"names {match['unit']!r} as the unit of its fluxes, which is none that is known"
                raise data_error(path, problem)
            return unit
    for text in texts:
        if _TIMES.search(text):
            raise data_error(path, f"has fluxes times frequencies or wavelengths: {text!r}")
    if any(map(_BARE_FNU.search, texts)):
        raise data_error(
            path, "has fluxes per frequency without a unit: write it behind, as fnu(uJy)"
        )
    return None
