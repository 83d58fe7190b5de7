"""Files of the package: written completely or not at all; arrays, tables and text in one FITS layout."""

import contextlib
import json

import numpy as np
from astropy.io import fits
from astropy.table import Table

from miricigale.utils.exceptions import data_error, file_errors
from miricigale.utils.files import open_fits, replacing, write_fits
from miricigale.utils.fits_tables import table_hdu
from miricigale.utils.meta import plain_value, undated
from miricigale.utils.units import header_unit

_TEXT = "TEXT"


def write_parts(path, layout, *, shown=None, text=None, arrays=None, tables=None, overwrite=False):
    """
    Write arrays, tables and text to one FITS file; the same content gives the same bytes.

    Parameters
    ----------
    path : path-like
        The file.
    layout : str
        Name and version of what it holds; the keyword ``FORMAT`` of the primary header.
    shown : `~astropy.table.QTable`, optional
        The table that users of other programs want: the first extension, ``TABLE``, which is not read back.
    text : dict, optional
        Anything that JSON knows, and numbers and arrays of numpy: header cards are too short for
        it. Extension ``TEXT``.
    arrays : dict of str to `~numpy.ndarray`, optional
        An image extension for each; truth values are stored as 0 and 1, quantities with their unit in
        ``BUNIT``. Arrays without elements are left out, for FITS cannot hold them.
    tables : dict of str to `~astropy.table.Table`, optional
        A binary table extension for each, without the ``meta`` of the table. Text is ASCII.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    OSError
        See `replacing`.
    """
    hdus = [fits.PrimaryHDU(header=fits.Header({"FORMAT": layout}))]
    if shown is not None:
        shown = shown.copy(copy_data=False)
        shown.meta = undated(shown.meta)
        hdus.append(table_hdu(shown))
        hdus[-1].name = "TABLE"
    if text is not None:
        data = np.frombuffer(json.dumps(text, default=plain_value).encode(), dtype=np.uint8)
        hdus.append(fits.ImageHDU(data, name=_TEXT))
    for name, array in (arrays or {}).items():
        unit = getattr(array, "unit", None)
        array = np.asarray(array)
        if array.size:
            hdu = fits.ImageHDU(array.astype(np.uint8) if array.dtype == bool else array, name=name)
            if unit is not None:
                hdu.header["BUNIT"] = header_unit(unit)
            hdus.append(hdu)
    for name, table in (tables or {}).items():
        if not isinstance(table, Table):
            table = Table(table)
        table = table.copy(copy_data=False)
        table.meta = {}
        hdus.append(fits.table_to_hdu(table))
        hdus[-1].name = name
    with replacing(path, overwrite=overwrite) as partial:
        write_fits(hdus, partial)


@contextlib.contextmanager
def open_parts(path, layouts, *, wanted, memmap=False):
    """
    Open a file that `write_parts` wrote; what is wrong with it in the ``with`` block names it.

    Parameters
    ----------
    path : path-like
        The file.
    layouts : tuple of str
        Layouts that the reader knows.
    wanted : str
        What the file should hold, for the message, such as ``"fit results"``.
    memmap : bool, optional
        Whether arrays stay on the disk until they are used.

    Yields
    ------
    parts : `Parts`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, truncated or of another layout, or if the block finds it incomplete
        (a `KeyError`, `IndexError`, `TypeError` or `ValueError`).
    """
    with open_fits(path, wanted=wanted, memmap=memmap) as hdus:
        layout = hdus[0].header.get("FORMAT")
        if layout not in layouts:
            raise data_error(path, _foreign(str(layout), layouts[0], wanted))
        with file_errors(path, f"is not a complete file of {wanted}", fits.VerifyError):
            yield Parts(hdus)


def _foreign(layout, package, wanted):
    """What is said of a file of another layout: of another version of the package, or something else."""
    stem, _, number = layout.rpartition("-")
    if number.isdecimal() and stem == package.rpartition("-")[0]:
        return (
            f"holds {wanted} in the layout {layout!r} of another version of the package, and this one reads "
            f"{package!r}: make the file again with this version, or read it with the one that wrote it"
        )
    return f"holds no {wanted} (no FORMAT = {package!r} in its header)"


class Parts:
    """
    What a file of `write_parts` holds.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The open file.

    Attributes
    ----------
    layout : str
        Name and version of the layout.
    text : dict
        The text, empty if there is none.
    """

    def __init__(self, hdus):
        self._hdus = hdus
        self.layout = hdus[0].header["FORMAT"]
        self._names = {hdu.name for hdu in hdus}
        self.text = {}
        if _TEXT in self._names:
            self.text = json.loads(bytes(np.asarray(hdus[_TEXT].data)).decode())

    def __contains__(self, name):
        return name.upper() in self._names

    def array(self, name):
        """Array by name, in the byte order of the machine; truth values are 0 and 1."""
        return native(self._hdus[name].data)

    def mapped(self, name):
        """Array as it stands in the file, on the disk until it is used; not to be written to."""
        data = self._hdus[name].data
        data.flags.writeable = False
        return data

    def table(self, name, cls=Table):
        """Table by name (a `~astropy.table.Table`, or another class); its meta empty."""
        table = cls.read(self._hdus[name], character_as_bytes=False)
        table.meta.clear()
        return table

    def columns(self, name, *, rows=None):
        """Arrays of the columns of a table of plain numbers and text, or of these rows of it, by name; copies."""
        data = self._hdus[name].data
        if rows is not None:
            data = data[rows]
        return {column: native(data[column]).copy() for column in data.names}


def native(array):
    """Array in the byte order of the machine; the same one where it is."""
    array = np.asarray(array)
    return array.astype(array.dtype.newbyteorder("="), copy=False)
