"""Files of filter curves."""

import re
from dataclasses import field
from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.utils.curve_columns import curve_columns, unit_of_wavelengths
from miricigale.utils.exceptions import DataError, data_error, file_errors
from miricigale.utils.files import packed_open, unpacked_size
from miricigale.utils.meta import full_meta
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_data
from miricigale.utils.table_files import read_table
from miricigale.utils.table_formats import TABLE_FORMATS, table_suffix
from miricigale.utils.text_tables import is_number_text
from miricigale.utils.units import WAVE, own_unit
from miricigale.utils.values import value_class

#: Units of wavelengths as headers name them.
_UNITS = {
    u.um: r"um|µm|μm|microns?|micromet(?:er|re)s?",
    u.nm: r"nm|nanomet(?:er|re)s?",
    u.AA: r"AA|Å|Ang(?:str[oö]ms?)?|(?<=[(\[])A(?=[)\]])",
}
_UNIT = {
    unit: re.compile(rf"(?<![A-Za-z])(?:{names})(?![A-Za-z])", re.IGNORECASE)
    for unit, names in _UNITS.items()
}
#: A wavelength in a description, such as "pivot 7.7 um", says nothing of the columns.
_MEASURED = re.compile(r"\d[ \t]*$")
#: What the first column is called.
_WAVE_WORD = re.compile(r"wave|lambda|λ|\bwl\b", re.IGNORECASE)
#: What descriptions of columns have, and those of filters in general have not.
_ABOUT_COLUMNS = re.compile(rf"{_WAVE_WORD.pattern}|\bin\b|\bunits?\b", re.IGNORECASE)
#: What counts the light, in comments and in the parameters of a VOTable.
_DETECTOR = re.compile(r"detector[\s_]*(?:type)?\s*[:=\t ]\s*(energy|photon|[01])\b", re.IGNORECASE)
#: Keywords of tables that say it, in lower case and without underscores.
_DETECTOR_KEYWORDS = ("detectortype", "detector", "dettype")
#: The same in files of CIGALE, as a comment of its own.
_KINDS = ("photon", "energy")
_ENERGY = re.compile(r"\s*(?:0$|energy\b)", re.IGNORECASE)
#: Names of columns of the throughput.
_THROUGHPUT = re.compile(
    r"through|transm|response|(?:^|[_\W])(?:thr\w*|trans)(?:$|[_\W])", re.IGNORECASE
)
#: Percent behind the name of a column.
_PERCENT = re.compile(r"[\[(]\s*(?:%|percent|per cent)\s*[\])]", re.IGNORECASE)
#: Two numbers with a comma in place of the point, such as "7,5 0,1".
_DECIMAL_COMMA = re.compile(r"[+-]?\d+,\d+[\s;]+[+-]?\d+,\d+\s*$")
#: Part of the peak down to which a negative throughput is noise.
_NOISE = 0.05
#: Relative width of a vertical edge, a wavelength that is there twice.
_EDGE = 1e-7


@value_class
class Curve:
    """
    A filter curve of a file.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Ascending wavelengths.
    throughput : `~numpy.ndarray`, shape (n,)
        Response to photons, not negative.
    name : str
        The one in the file, else that of the file.
    options : dict
        Further arguments of `~miricigale.filters.Filter` (``meta``, ``reference_wavelength``, ...).
    """

    wave: u.Quantity
    throughput: np.ndarray
    name: str
    options: dict = field(default_factory=dict)


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
    curve : `Curve`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is no curve, its numbers have commas in place of points, its unit is not known or not the only
        one that is named, a wavelength is there more than twice, or a throughput is below -5 % of the peak.
    """
    path = Path(path).expanduser()
    read = _of_text
    if table_suffix(path) in TABLE_FORMATS:
        read = _of_table
    wave, throughput, energy, name, options = read(path, unit)
    wave, throughput = _ascending(wave, throughput, path)
    if energy:
        # the energy of a photon goes as 1 / wavelength
        throughput = throughput / (wave / wave.mean()).value
    throughput, n_negative = _not_negative(throughput, path)
    meta = options.pop("meta", {})
    if n_negative:
        meta["n_negative"] = n_negative
    return Curve(wave, throughput, name, options | {"meta": meta})


def _ascending(wave, throughput, path):
    """Return a curve in the order of its wavelengths, with vertical edges of a finite width."""
    if wave.size and wave[0] > wave[-1]:
        # the sides of a vertical edge in their order
        wave = wave[::-1]
        throughput = throughput[::-1]
    order = np.argsort(wave, kind="stable")
    value = wave.value[order]
    throughput = throughput[order]
    repeated = np.append(np.diff(value) == 0, False)
    if repeated.size > 1:
        thrice = np.flatnonzero(repeated[:-1] & repeated[1:])
    else:
        thrice = np.zeros(0, int)
    problem = f"has the wavelength {value[thrice[0]] if thrice.size else 0:.8g} more than twice"
    check_data(not thrice.size, path, problem)
    twins = np.flatnonzero(repeated)
    # one of two equal points is enough
    equal = twins[throughput[twins] == throughput[twins + 1]]
    value[repeated] *= 1.0 - _EDGE
    keep = np.ones(value.size, dtype=bool)
    keep[equal] = False
    return value[keep] * wave.unit, throughput[keep]


def _not_negative(throughput, path):
    """Return the throughput with negative points at zero, and their number."""
    peak = np.nanmax(throughput, initial=0.0)
    lowest = np.nanmin(throughput, initial=0.0)
    problem = f"has a throughput of {lowest:.3g}, beside a peak of {peak:.3g}"
    check_data(lowest >= -_NOISE * peak, path, problem)
    negative = throughput < 0
    return np.where(negative, 0.0, throughput), int(np.count_nonzero(negative))


def _of_table(path, unit):
    table = read_table(path, wanted="a filter")
    if table_suffix(path) == ".csv" and any(map(is_number_text, table.colnames)):
        # without names of columns
        return _of_text(path, unit)
    wave_name, throughput_name = curve_columns(table, _THROUGHPUT, path)
    if unit is None:
        unit = _unit_of_column(table[wave_name], wave_name, path)
    with file_errors(path, "is no filter: its columns are not numbers"):
        wave = floats(table[wave_name]) * u.Unit(unit)
        throughput = floats(table[throughput_name])
    is_percent = str(getattr(table[throughput_name], "unit", "")) == "%"
    if is_percent or _PERCENT.search(throughput_name):
        throughput = throughput / 100
    meta = full_meta(table.meta)
    if table_suffix(path) in (".xml", ".vot", ".votable"):
        meta = _parameters(path) | meta
    keywords = {}
    for keyword, entry in meta.items():
        keywords[str(keyword).lower().replace("_", "")] = entry
    energy = any(_ENERGY.match(str(keywords.get(key, ""))) for key in _DETECTOR_KEYWORDS)
    name = keywords.get("name") or keywords.get("filterid") or path.stem
    options = {}
    for key, reference in (("reference_wavelength", WAVE), ("reference_temperature", u.K)):
        value = keywords.get(key.replace("_", ""))
        if value is not None:
            options[key] = float(value) * reference
    carried = ("citations", "flux_convention", "n_negative")
    carried_meta = {}
    for key in carried:
        if key in meta:
            carried_meta[key] = meta[key]
    options["meta"] = carried_meta
    return wave, throughput, energy, str(name), options


def _unit_of_column(column, name, path):
    """Unit of a column of wavelengths: its own, or the one in its name, such as ``wave_um`` or ``wave [AA]``."""
    unit = own_unit(column)
    if unit is not None:
        return unit_of_wavelengths(unit)
    try:
        return unit_of_comments([name], path)
    except DataError:
        problem = "has no unit of wavelength in the column or its name"
        raise data_error(path, f"{problem} {name!r}: give 'unit'") from None


def _parameters(path):
    """Return the parameters of the first table of a VOTable by name, as the SVO gives the type of the detector."""
    from astropy.io import votable

    with packed_open(path) as stream:
        first = votable.parse(stream, verify="ignore").get_first_table()
    parameters = {}
    for param in first.params:
        if param.name is not None:
            parameters[param.name] = param.value
    return parameters


def _of_text(path, unit):
    comments, rows = _text_rows(path)
    try:
        data = _two_columns(rows)
    except ValueError:
        raise data_error(path, "is no filter: it has not two columns of numbers") from None
    # as in CIGALE's files, which are in Angstrom
    kinds = [text.lower() for text in comments[:3] if text.lower() in _KINDS]
    if unit is None:
        if kinds:
            unit = _unit_beside_kind(comments, path)
        else:
            unit = unit_of_comments(comments, path)
    name = path.stem
    if kinds and comments[0].lower() not in kinds:
        name = comments[0]
    wave, throughput = data.T
    if any(_PERCENT.search(text) for text in comments):
        throughput = throughput / 100
    return wave * u.Unit(unit), throughput, _counts_energy(comments, kinds), name, {}


def _text_rows(path):
    """Return the comments of a text file, and the words of its rows of numbers."""
    unpacked_size(path)
    try:
        with packed_open(path) as stream:
            lines = stream.read().decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise data_error(path, f"cannot be read as a filter: {err}") from None
    comments = []
    rows = []
    for line in lines:
        line = line.strip()
        if line.startswith("#"):
            comments.append(line.lstrip("# ").strip())
        elif line:
            problem = f"has commas within its numbers, such as {line[:40]!r}: write points"
            check_data(not _DECIMAL_COMMA.match(line), path, problem)
            rows.append(line.partition("#")[0].replace(",", " ").split())
    if len(rows) > 2:
        first = rows[0]
        has_numbers = len(first) > 1 and all(map(is_number_text, first[:2]))
        if not has_numbers:
            # names of columns without a mark, or what LePhare has there: a number of rows and a name
            comments.append(" ".join(rows.pop(0)))
    return comments, rows


def _counts_energy(comments, kinds):
    """Whether a curve is of a detector that counts energy, by the first of CIGALE's kinds or another comment."""
    if kinds and kinds[0] == "energy":
        return True
    detector = _DETECTOR.search("\n".join(comments))
    return detector is not None and _ENERGY.match(detector[1]) is not None


def _unit_beside_kind(comments, path):
    """Unit of a file of CIGALE's layout: Angstrom, unless a line says that its columns are in another one."""
    about_columns = []
    for text in comments:
        # a unit alone is that of the columns
        is_unit = any(unit.fullmatch(text.strip(" ()[]")) for unit in _UNIT.values())
        if is_unit or _ABOUT_COLUMNS.search(text):
            about_columns.append(text)
    try:
        return unit_of_comments(about_columns, path)
    except DataError as err:
        if "does not state" in str(err):
            return u.AA
        raise


def _two_columns(rows):
    """Return the wavelengths and throughput; of three columns the first of which counts the rows, the others."""
    if len(rows) < 2:
        raise ValueError
    numbered = all(len(row) == 3 for row in rows) and len(rows) > 2
    if numbered:
        counts = [float(row[0]) for row in rows]
        if counts in (list(range(1, len(rows) + 1)), list(range(len(rows)))):
            rows = [row[1:] for row in rows]
    return np.array([row[:2] for row in rows], dtype=float).reshape(len(rows), 2)


def unit_of_comments(comments, path):
    """
    Return the unit of the wavelengths that comments name.

    That of the line of the columns, which speaks of wavelengths, counts before that of other lines, and a unit
    after a number, which measures something, counts for nothing.

    Parameters
    ----------
    comments : list of str
        Lines.
    path : path-like
        The file, for messages.

    Returns
    -------
    unit : `~astropy.units.Unit`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If they name none, or several.
    """
    about_wave = [text for text in comments if _WAVE_WORD.search(text)]
    for lines in (about_wave, comments):
        named = []
        for unit, pattern in _UNIT.items():
            matches = [(text, match) for text in lines for match in pattern.finditer(text)]
            if any(not _MEASURED.search(text[: match.start()]) for text, match in matches):
                named.append(unit)
        if len(named) == 1:
            return named[0]
        if named:
            quoted = " and ".join(map(str, named))
            raise data_error(path, f"names {quoted} as units of its wavelengths: give 'unit'")
    raise data_error(path, "does not state the unit of its wavelengths: give 'unit'")
