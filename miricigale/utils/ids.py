"""Ids of objects: the column that holds them, and their values."""

import re

import numpy as np

from miricigale.utils.exceptions import CatalogWarning, argument_error, warn
from miricigale.utils.missing_values import between_missing, own_mask
from miricigale.utils.options import check_that

#: Names of columns of ids, in lower case and without what stands between words; the first is preferred.
_NAMES = (
    "id", "number", "objectid", "objid", "idobj", "sourceid", "srcid", "targetid", "galaxyid", "galid", "catid",
)  # fmt: skip
#: The number of a segment, which is an id where nothing else is.
_LABEL = "label"
#: What pandas calls the index that it wrote into text without a name.
WRITTEN_INDEX = "Unnamed: 0"
#: Names that ids often have, but other things too.
_LIKELY = ("name", "designation", "iauname", "object", "source", "target", "seq", "recno", "index")
_ID_PART = re.compile(r"(?:^|[_\-. ])id(?:$|[_\-. ])", re.IGNORECASE)
_ID_END = re.compile(r"[a-z](?:Id|ID)$|[A-Z]ID$")
#: Ids listed in a message.
_LISTED = 3


def _plain_name(name):
    """A name in lower case, without a byte-order mark, a comment's mark and what stands between words."""
    return re.sub(r"[\ufeff#\s_\-.]+", "", str(name)).lower()


def is_id_name(name):
    """Whether a column of this name holds ids by its name alone."""
    return _plain_name(name) in _NAMES + (_LABEL,)


def id_column(colnames, argument, *, labels=True):
    """
    Return the name of the column of ids.

    That is ``id``; else the one with this name in another case (``ID``); else the only one with another
    usual name of ids (``NUMBER``, ``object_id``, ``objid``, ``source_id``, ``TARGETID``, ...), whatever its case
    and underscores; else ``label``.

    Parameters
    ----------
    colnames : iterable of str
        Names of the columns.
    argument : str
        What the table is called in messages.
    labels : bool, optional
        Whether ``label`` is a name of ids.

    Returns
    -------
    name : str or None
        None if no column has such a name.

    Raises
    ------
    ValueError
        If several columns could be it.
    """
    colnames = list(colnames)
    if "id" in colnames:
        return "id"
    for group in (_NAMES[:1], _NAMES[1:], (_LABEL,) if labels else ()):
        names = [name for name in colnames if _plain_name(name) in group]
        if len(names) == 1:
            return names[0]
        if names:
            wanted = "a table with one column of ids, or with one of the name 'id'"
            how = f"name the right one 'id', or give columns={{'id': {names[0]!r}}} with a map of columns"
            raise argument_error(argument, wanted, f"{' and '.join(map(repr, names))} ({how})")
    return None


def is_written_index(name, colnames, values):
    """
    Whether a column is the index of a frame that pandas wrote into text without a name, and holds ids.

    Parameters
    ----------
    name : str
        Its name; pandas reads ``Unnamed: 0``.
    colnames : iterable of str
        Names of all columns; another one that is called as ids are is preferred.
    values : array_like, shape (n,)
        Its values; an index that counts the rows from 0 says nothing.

    Returns
    -------
    bool
    """
    if name != WRITTEN_INDEX or any(map(is_id_name, colnames)):
        return False
    values = np.ma.getdata(values)
    return not np.array_equal(values, np.arange(len(values)))


def likely_ids(table):
    """Names of columns of distinct numbers or texts that look like ids, though not by a usual name."""
    names = []
    for name in table.colnames:
        kind = getattr(getattr(table[name], "dtype", None), "kind", "")
        stem = _plain_name(name)
        looks = _ID_PART.search(name) or _ID_END.search(name)
        # source_name, objname
        looks = looks or stem in _LIKELY or stem.endswith("name")
        if looks and kind in "iufUSO" and table[name].ndim == 1 and _is_distinct(table[name]):
            names.append(name)
    return names


def _is_distinct(column):
    """Whether no value of a column occurs twice, and none is missing."""
    values = np.ma.getdata(getattr(column, "unmasked", column)).tolist()
    return not np.any(own_mask(column)) and len(set(values)) == len(values)


def counted_ids(table, argument, start=0):
    """
    Return ids that count rows from 1, for a table without ids.

    Parameters
    ----------
    table : `~astropy.table.Table`
        The table.
    argument : str
        What it is called in messages.
    start : int, optional
        Rows before it, in earlier pieces of a file.

    Returns
    -------
    ids : `~numpy.ndarray` of int, shape (n,)

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If a column looks like ids; of the first piece only.
    """
    names = likely_ids(table)
    if names and start == 0:
        text = f"{argument}: no column 'id'; rows are counted from 1, though {names[0]!r} looks like ids"
        warn(f"{text} (name it 'id', or give columns={{'id': {names[0]!r}}})", CatalogWarning)
    return np.arange(start + 1, start + len(table) + 1)


def ids_and_missing(column, argument):
    """
    Return ids as an array of integers or text, and where there is none.

    Whole numbers stay what they are, in 64 bits or unsigned, and a unit counts for nothing. Floats that are whole
    become integers, as tables with a missing id store them; other floats become text.

    Parameters
    ----------
    column : array_like, shape (n,)
        A column of a table, masked or not.
    argument : str
        What the table is called in messages.

    Returns
    -------
    ids : `~numpy.ndarray`, shape (n,)
        Arbitrary where they are missing.
    missing : `~numpy.ndarray` of bool, shape (n,)
        Masked, NaN, None or empty.

    Raises
    ------
    ValueError
        If there are several ids in a row, ids of different kinds or that are neither numbers nor text, bytes that
        are not UTF-8 or whole numbers in floats of too few digits, which are not exact.
    """
    mask = np.asarray(own_mask(column))
    column = getattr(column, "unmasked", column)
    ids = np.ma.getdata(getattr(column, "value", column))
    check_that(ids.ndim == 1, argument, "a table with one id in a row", ids.shape)
    wanted = "a table with ids as integers or text"
    check_that(ids.dtype.kind in "iufSUO", argument, wanted, f"the type {ids.dtype}")
    missing = np.broadcast_to(mask, ids.shape).copy()
    if ids.dtype.kind in "US":
        missing |= np.char.str_len(ids) == 0
    if ids.dtype.kind == "O":
        missing |= np.array([_is_empty(key) for key in ids.tolist()], dtype=bool)
        ids = _of_objects(ids, missing, argument)
    if ids.dtype.kind == "S":
        ids = _decoded(ids, argument)
    if ids.dtype.kind == "f":
        missing |= np.isnan(ids)
        ids = _of_floats(ids, missing, argument)
    # FITS takes numbers of one byte for true and false
    if ids.dtype == np.int8:
        ids = ids.astype(np.int16)
    return ids.astype(ids.dtype.newbyteorder("=")), missing


def _is_empty(key):
    """Whether an id is None, NaN, pandas' NA or no text."""
    if key is None or (isinstance(key, (str, bytes)) and not key):
        return True
    # NaN and NaT differ from themselves; NA is neither true nor false
    return type(key).__name__ == "NAType" or (not isinstance(key, (str, bytes)) and key != key)


def _of_objects(ids, missing, argument):
    """Ids of Python objects as an array of one kind."""
    present = [key for key, gone in zip(ids.tolist(), missing.tolist(), strict=True) if not gone]
    kinds = sorted({type(key).__name__ for key in present})
    check_that(len(kinds) < 2, argument, "a table with ids of one kind", kinds)
    if not present:
        return ids.astype(str)
    values = np.array(present)
    if values.dtype.kind == "O" and kinds == ["int"]:
        # beyond 64 bits
        values = values.astype(str)
    return between_missing(values, missing)


def _decoded(ids, argument):
    """Bytes as text, as astropy reads them in FITS files."""
    try:
        return np.char.decode(ids, "utf-8")
    except UnicodeDecodeError as err:
        wanted = "a table with ids that are text, or bytes of text in UTF-8"
        raise argument_error(argument, wanted, f"{err.object!r}") from None


def _of_floats(ids, missing, argument):
    """Whole numbers as integers, and other numbers as text."""
    safe = np.where(missing, 0, ids)
    if not np.all(safe == np.round(safe)):
        return np.array([repr(value) for value in safe.tolist()])
    # below it every whole number is exact; the limit itself may be the next number, rounded
    limit = 2 ** min(np.finfo(ids.dtype).nmant + 1, 53)
    rows = np.flatnonzero(~(np.abs(safe) < limit))
    if rows.size:
        wanted = f"a table with ids as integers or text, for floats of {8 * ids.dtype.itemsize} bits are not exact"
        got = f"{float(safe[rows[0]])!r} in row {rows[0]} (from 0), of {rows.size} so large"
        raise argument_error(argument, wanted, got)
    return safe.astype(np.int64)


def ids_of_text(texts):
    """
    Return ids that stand as text in a file: integers if all are written as such, or the text.

    Parameters
    ----------
    texts : sequence of str
        As they stand in the file, '' for none.

    Returns
    -------
    ids : `~numpy.ndarray`
        Integers if all are whole numbers without leading zeros, sign + or exponent, and 64 bits hold them.
        ``7.0`` is such a number, ``0007`` and ``1E2`` are text.

    Examples
    --------
    >>> from miricigale.utils.ids import ids_of_text
    >>> ids_of_text(["7", "12"]), ids_of_text(["0007", "12"])
    (array([ 7, 12]), array(['0007', '12'], dtype='<U4'))
    """
    whole_number = re.compile(r"(-?(?:0|[1-9]\d*))(?:\.0*)?")
    matches = [whole_number.fullmatch(text) for text in texts]
    if all(matches) and matches:
        numbers = [int(match[1]) for match in matches]
        for dtype in (np.int64, np.uint64):
            limits = np.iinfo(dtype)
            if limits.min <= min(numbers) and max(numbers) <= limits.max:
                return np.array(numbers, dtype=dtype)
    return np.array(texts, dtype=str)


class Duplicates:
    """
    Rows of a catalog, seen in pieces, whose id occurred before.

    Attributes
    ----------
    n_rows : int
        Rows that repeat an id.
    first : list
        The first few of these ids, each once.
    """

    def __init__(self):
        self.n_rows = 0
        self.first = []

    def add(self, ids, earlier=None):
        """Take the ids of a piece; ``earlier`` (bool, shape (n,)) are those of earlier pieces."""
        is_repeated = np.ones(ids.size, dtype=bool)
        is_repeated[np.unique(ids, return_index=True)[1]] = False
        if earlier is not None:
            is_repeated |= earlier
        self.n_rows += int(np.count_nonzero(is_repeated))
        for key in ids[is_repeated].tolist():
            if len(self.first) == _LISTED:
                break
            if key not in self.first:
                self.first.append(key)

    def warn(self, argument, what="only the first row of each is fitted"):
        """Warn if there are any; ``what`` says what becomes of them."""
        if self.n_rows:
            examples = ", ".join(map(repr, self.first))
            if self.n_rows > len(self.first):
                examples += ", ..."
            rows = "1 row has"
            if self.n_rows != 1:
                rows = f"{self.n_rows} rows have"
            text = f"{argument}: {rows} an id that occurred before ({examples}); {what}"
            warn(text, CatalogWarning)


def warn_of_duplicates(ids, argument, **options):
    """Warn of ids that occur more than once, with the first three, masked ones aside; see `Duplicates.warn`."""
    duplicates = Duplicates()
    duplicates.add(np.ma.compressed(np.ma.asarray(ids)))
    duplicates.warn(argument, **options)
