"""Layout of tables in text files: comments, separators, and names of columns that stand twice."""

import csv
import io
import re

import numpy as np

from miricigale.utils.exceptions import CatalogWarning, warn
from miricigale.utils.files import has_match, packed_open
from miricigale.utils.ids import WRITTEN_INDEX, is_id_name
from miricigale.utils.missing_values import is_missing_word

_BOM = "\ufeff"
#: Between the cells of files that are called .csv; the comma is the first choice.
_SEPARATORS = (",", ";", "\t", "|")
#: Text in which the names of the columns are looked for.
_HEAD = 1 << 20
#: Lines in which bars, rules and units are looked for.
_BARRED = 50
#: A line between names and rows: of Markdown, or after the units of VizieR.
_RULE = re.compile(r"[-:|;,\t ]+")
#: A line after the first that begins with the mark of a comment.
_LATER_COMMENT = re.compile(rb"\n#")
#: First line of a catalog of SExtractor: number, name and meaning of the first column.
_SEXTRACTOR = re.compile(rb"#\s*1\s+[A-Za-z]\w*(?:\s|$)")


def is_sextractor(start):
    """Whether a file that begins with these bytes has a line of comment for each column, as of SExtractor."""
    return _SEXTRACTOR.match(start) is not None


def _head(path):
    """Return the beginning of a text file, packed or not."""
    with packed_open(path) as stream:
        return stream.read(_HEAD).decode("utf-8-sig", "replace")


def csv_layout(path):
    """
    Find out how a file of comma-separated values is written.

    Parameters
    ----------
    path : path-like
        The file, packed or not.

    Returns
    -------
    separator : str
        The comma, or a semicolon, tab, bar or blank where the names of the columns have none.
    n_comments : int
        Lines before the names of the columns, all of which begin with ``#``. The names may stand in such a line
        themselves, the last one, if the next line has numbers.
    """
    lines = _head(path).splitlines()
    n_comments = 0
    while n_comments < len(lines) and _is_comment(lines[n_comments]):
        n_comments += 1
    if n_comments == len(lines):
        return ",", 0
    header = lines[n_comments]
    separator = _separator(lines[n_comments:])
    if n_comments and _holds_names(lines[n_comments - 1], header, separator):
        n_comments -= 1
    return separator, n_comments


def is_barred(start):
    """Whether every line of a text that begins with these bytes stands between bars, as in Markdown."""
    lines = start.decode("utf-8", "replace").splitlines()[:_BARRED]
    lines = [line.strip() for line in lines if line.strip()]
    # tables of IPAC have bars in their header alone
    return len(lines) > 1 and all(line.startswith("|") and line.endswith("|") for line in lines)


def _lines(source, path):
    """Return the lines of a source, which is the file or its lines."""
    if not isinstance(source, str):
        return source
    with packed_open(path) as stream:
        return stream.read().decode("utf-8-sig").splitlines()


def plain_rows(source, path, separator):
    """
    Leave rules, outer bars and the line of units of VizieR out of a CSV, and name a first column without a name.

    Parameters
    ----------
    source : str or list of str
        The file, or its lines from the names of the columns on.
    path : path-like
        The file.
    separator : str
        Between the cells.

    Returns
    -------
    source : str or list of str
        The same if there is nothing of these.
    units : dict of str to str
        Units of the columns that have one.
    """
    if isinstance(source, str):
        head = _head(path).splitlines()
    else:
        head = source
    head = [line for line in head[:_BARRED] if line.strip()]
    barred = separator == "|" and is_barred("\n".join(head).encode())
    unnamed = bool(head) and re.match(rf'(?:""|\s*){re.escape(separator)}', head[0].strip("\n"))
    rule = 0
    for number, line in enumerate(head[1:3], start=1):
        if _RULE.fullmatch(line.strip()) and "-" in line:
            rule = number
    if not (barred or unnamed or rule):
        return source, {}
    lines = [line for line in _lines(source, path) if line.strip()]
    if barred:
        lines = [line.strip()[1:-1] for line in lines]
    cells = list(csv.reader(lines[:3], delimiter=separator))
    names = [name.strip() for name in cells[0]]
    if not barred and unnamed and not names[0]:
        # the index of a DataFrame, as pandas writes and calls it
        lines[0] = f"{WRITTEN_INDEX}{lines[0].lstrip(' ').removeprefix(chr(34) * 2)}"
        names[0] = WRITTEN_INDEX
    units = {}
    if rule == 2:
        for name, unit in zip(names, cells[1], strict=False):
            if unit.strip():
                units[name] = unit.strip()
    return lines[:1] + lines[1 + rule :], units


def commas_for_tabs(source, path):
    """
    Put commas between the cells of a table with tabs: of two tabs in a row astropy makes one, and values move.

    Parameters
    ----------
    source : str or list of str
        The file, or its lines from the names of the columns on.
    path : path-like
        The file.

    Returns
    -------
    lines : list of str
    """
    rows = csv.reader(_lines(source, path), delimiter="\t")
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().splitlines()


def names_in_comments(text):
    """
    Find the names of the columns of plain text among several lines of comment before its rows.

    Parameters
    ----------
    text : str
        The start of the file.

    Returns
    -------
    names : list of str or None
        Those of the last line of comment that has as many words as the first row, one of which is called as ids
        are; None without such a line.
    """
    comments = []
    for line in text.removeprefix(_BOM).splitlines():
        if _is_comment(line):
            comments.append(line)
            continue
        n_cells = len(line.split())
        for comment in reversed(comments):
            names = comment.lstrip("# \t").split()
            if len(names) == n_cells and any(map(is_id_name, names)):
                return names
        return None
    return None


def _is_comment(line):
    """Whether a line is empty or begins with the mark of a comment."""
    return not line.strip() or line.startswith("#")


def _separator(lines):
    """What stands between the cells of a table: the comma, or what its first line has in place of it."""
    header = lines[0]
    for mark in _SEPARATORS:
        if mark in header:
            return mark
    n_words = len(header.split())
    if n_words > 1 and len(lines) > 1 and len(lines[1].split()) == n_words:
        return " "
    return ","


def _holds_names(comment, line, separator):
    """Whether the names of the columns stand in a comment, for the line after it has values."""
    cells = next(csv.reader([line], delimiter=separator))
    names = next(csv.reader([comment.lstrip("# ")], delimiter=separator))
    if len(names) == len(cells) and any(map(is_id_name, names)):
        return True
    return any(is_missing_word(cell) or is_number_text(cell) for cell in cells)


def is_number_text(cell):
    """Whether a cell is a number, which no name of a column is."""
    try:
        float(cell)
    except ValueError:
        return False
    return True


def without_comments(source, path, separator):
    """
    Leave lines of comment between and after the rows of a CSV out.

    Parameters
    ----------
    source : str or list of str
        The file, or its lines from the names of the columns on.
    path : path-like
        The file.
    separator : str
        Between the cells.

    Returns
    -------
    source : str or list of str
        The same if there is no such line: one that begins with ``#`` and has not as many cells as the first line,
        so that ids such as ``#1`` stay.
    """
    if isinstance(source, str) and not has_match(path, _LATER_COMMENT, overlap=1):
        return source
    lines = _lines(source, path)
    header = next((line for line in lines if line.strip()), "")
    n_cells = header.count(separator)
    rows = []
    for line in lines:
        is_comment = (
            line.startswith("#") and line is not header and line.count(separator) != n_cells
        )
        if not is_comment:
            rows.append(line)
    return rows


def drop_repeated(table, path):
    """
    Refuse columns of one name, of which astropy calls the second ``NAME_1``; leave copies out.

    Parameters
    ----------
    table : `~astropy.table.Table`
        As astropy read it; changed in place.
    path : path-like
        The text file, which tells such a name from one that stands there.

    Raises
    ------
    ValueError
        If two columns of one name differ.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of columns that are the same twice, of which the first is kept.
    """
    suspects = []
    for name in table.colnames:
        first, _, count = name.rpartition("_")
        if count.isdigit() and first in table.colnames:
            suspects.append((first, name))
    if not suspects:
        return
    head = _head(path)
    repeated = {}
    for first, name in suspects:
        stands_there = re.search(rf"(?<![\w.]){re.escape(name)}(?![\w.])", head)
        if not stands_there:
            repeated[name] = first
    for name, first in repeated.items():
        if not same_values(table[first], table[name]):
            raise ValueError(differ(first))
    table.remove_columns(list(repeated))
    warn_of_copies(repeated.values(), path)


def same_values(first, second):
    """Whether two columns hold the same, missing values included."""
    masks = [np.ma.getmaskarray(np.ma.asarray(column)) for column in (first, second)]
    values = [np.ma.getdata(np.ma.asarray(column)) for column in (first, second)]
    if values[0].shape != values[1].shape or not np.array_equal(*masks):
        return False
    present = [array[~masks[0]] for array in values]
    are_floats = all(array.dtype.kind == "f" for array in present)
    return np.array_equal(*present, equal_nan=are_floats)


def differ(name):
    """Words for columns of one name that differ."""
    return f"it has two columns {name!r} that differ: give each its own name"


def warn_of_copies(names, place):
    """Warn of columns that stand twice with the same values, if there are any."""
    names = sorted(set(names))
    if names:
        listed = ", ".join(map(repr, names))
        warn(f"{place}: columns that stand there twice are read once: {listed}", CatalogWarning)
