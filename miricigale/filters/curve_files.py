"""Files of filter curves."""

import re
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.utils.exceptions import data_error
from miricigale.utils.files import unpacked_size
from miricigale.utils.missing import floats
from miricigale.utils.table_files import TABLE_FORMATS, read_table

# units that a header may name
_UNITS = re.compile(r"\b(um|microns?|nm|AA|Angstroms?)\b", re.IGNORECASE)


def read_curve(path, unit=None):
    """
    Read a filter curve; see `~miricigale.filters.Filter.read`.

    Parameters
    ----------
    path : path-like
        The file.
    unit : `~astropy.units.Unit`, optional
        Unit of the wavelengths; else the one in the file.

    Returns
    -------
    wave : `~astropy.units.Quantity`, shape (n,)
        Ascending wavelengths.
    throughput : `~numpy.ndarray`, shape (n,)
        Response to photons.
    name : str
        The one in the file, else that of the file.
    """
    path = Path(path).expanduser()
    return _of_table(path, unit) if path.suffix.lower() in TABLE_FORMATS else _of_text(path, unit)


def _of_table(path, unit):
    table = read_table(path, wanted="a filter")
    columns = [table[name] for name in table.colnames[:2]]
    has = getattr(columns[0], "unit", None) if columns else None
    if len(columns) < 2 or (unit is None and has is None):
        what = "has not two columns, the first with a unit of wavelength"
        raise data_error(path, f"{what}: give 'unit' if it has none")
    wave = floats(columns[0])
    name = str(table.meta.get("name") or table.meta.get("NAME") or path.stem)
    return wave * u.Unit(unit or has), floats(columns[1]), name


def _of_text(path, unit):
    unpacked_size(path)
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise data_error(path, f"cannot be read as a filter: {err}") from None
    comments = [line.lstrip("# ").strip() for line in lines if line.startswith("#")]
    try:
        data = np.array([line.split()[:2] for line in lines if line[:1] not in ("#", "")], float)
        wave, throughput = data.T
    except ValueError:
        raise data_error(path, "is no filter: it has not two columns of numbers") from None
    # as in CIGALE's files, which are in Angstrom
    kinds = [text.lower() for text in comments[:3] if text.lower() in ("photon", "energy")]
    named = kinds and comments[0].lower() not in kinds
    if unit is None:
        found = _UNITS.search(" ".join(comments))
        if not kinds and found is None:
            raise data_error(path, "does not state the unit of its wavelengths: give 'unit'")
        by_letter = {"u": u.um, "m": u.um, "n": u.nm, "a": u.AA}
        unit = u.AA if kinds else by_letter[found[1][0].lower()]
    order = np.argsort(wave)
    wave, throughput = wave[order], throughput[order]
    if kinds[:1] == ["energy"]:
        throughput = throughput / (wave / wave.mean())
    return wave * u.Unit(unit), throughput, comments[0] if named else path.stem
