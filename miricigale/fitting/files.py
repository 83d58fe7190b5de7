"""Results of fits as FITS files."""

import json
from dataclasses import fields
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.fitting.priors import GridAxis
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits, writing
from miricigale.utils.tables import ascii_ids

__all__ = [
    "axes_from_plain",
    "axes_to_plain",
    "native",
    "read_results",
    "read_text",
    "text_hdu",
    "write_results",
]

_FORMAT = "miricigale-fitresults-3"
#: Files of the format before have no joint posteriors of pairs.
_READABLE = (_FORMAT, "miricigale-fitresults-2")
_DICTS = ("pdf", "best")
_TUPLES = ("filters", "quantities", "descriptions", "intensive")


def write_results(results, path, *, overwrite=False):
    """
    Write results: a table extension of all arrays, and a text extension of all else.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        The results.
    path : path-like
        The file.
    overwrite : bool, optional
        Whether a file that is there is replaced.

    Raises
    ------
    ValueError
        If an id is text that is not ASCII, or ends in a blank.
    """
    from astropy.table import Table

    ascii_ids(results.ids, "ids")
    table = Table()
    for item in fields(results):
        value = getattr(results, item.name)
        if isinstance(value, np.ndarray):
            table[item.name] = value
    for name in _DICTS:
        for key, value in getattr(results, name).items():
            table[f"{name}:{key}"] = value
    for i, weights in enumerate(results.pairs.values()):
        table[f"pair:{i}"] = weights
    text = {name: getattr(results, name) for name in (*_TUPLES, "meta")}
    text["pairs"] = [list(names) for names in results.pairs]
    text["units"] = [u.Unit(unit).to_string() for unit in results.units]
    text["shapes"] = {name: table[name].shape[1:] for name in table.colnames}
    text["axes"] = axes_to_plain(results.axes)
    empty = [name for name in table.colnames if table[name].size == 0 and len(table)]
    table.remove_columns(empty)
    hdus = [fits.PrimaryHDU(header=fits.Header({"FORMAT": _FORMAT}))]
    hdus.append(text_hdu(text))
    hdu = fits.table_to_hdu(table)
    hdu.name = "RESULTS"
    hdus.append(hdu)
    with writing(path):
        fits.HDUList(hdus).writeto(Path(path), overwrite=overwrite, output_verify="exception")


def read_results(cls, path):
    """
    Read results.

    Parameters
    ----------
    cls : type
        `~miricigale.fitting.FitResults`.
    path : path-like
        The file.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, something else or incomplete.
    """
    from astropy.table import Table

    try:
        with open_fits(path, wanted="fit results", memmap=False) as hdus:
            if hdus[0].header.get("FORMAT") not in _READABLE:
                msg = f"{path} holds no fit results (no FORMAT = {_FORMAT!r} in its header)"
                raise DataError(msg)
            text = read_text(hdus)
            table = Table.read(hdus["RESULTS"], character_as_bytes=False)
        n = len(table)
        columns = {
            name: np.asarray(table[name]).reshape(n, *shape)
            if name in table.colnames
            else np.zeros((n, *shape))
            for name, shape in text["shapes"].items()
        }
        values = {name: tuple(text[name]) for name in _TUPLES}
        values |= {"meta": text["meta"], "units": tuple(u.Unit(x) for x in text["units"])}
        values["axes"] = axes_from_plain(text["axes"])
        for name in _DICTS:
            start = f"{name}:"
            values[name] = {
                key.removeprefix(start): native(array)
                for key, array in columns.items()
                if key.startswith(start)
            }
        values["pairs"] = {
            tuple(names): native(columns[f"pair:{i}"])
            for i, names in enumerate(text.get("pairs", ()))
        }
        values |= {name: native(array) for name, array in columns.items() if ":" not in name}
        if "axis_moments" in columns:
            from miricigale.fitting.continuous_results import ContinuousResults

            cls = ContinuousResults
        return cls(**values)
    except (KeyError, ValueError, TypeError) as err:
        msg = f"{path} is not a complete file of fit results: {err}"
        raise DataError(msg) from err


def axes_to_plain(axes):
    """Turn axes without their shares into what JSON knows."""
    return {
        name: {
            "values": axis.values.tolist(),
            "unit": u.Unit(axis.unit).to_string(),
            "kind": axis.kind,
            "weights": axis.weights.tolist(),
            "bounds": list(axis.bounds),
        }
        for name, axis in axes.items()
    }


def axes_from_plain(text, shares=None):
    """Make axes of what `axes_to_plain` returned; ``shares`` by name are part of them."""
    return {
        name: GridAxis(
            name,
            np.array(axis["values"]),
            u.Unit(axis["unit"]),
            axis["kind"],
            np.array(axis["weights"]),
            (shares or {}).get(name),
            tuple(axis["bounds"]),
        )
        for name, axis in text.items()
    }


def text_hdu(text):
    """Put a dict into an extension ``TEXT``, as JSON: header cards are too short for it."""
    data = np.frombuffer(json.dumps(text, default=_plain).encode(), dtype=np.uint8)
    return fits.ImageHDU(data, name="TEXT")


def read_text(hdus):
    """Read the dict that `text_hdu` wrote."""
    return json.loads(bytes(np.asarray(hdus["TEXT"].data)).decode())


def native(array):
    """Bring an array to the byte order of the machine."""
    return array.astype(array.dtype.newbyteorder("=")) if array.dtype.kind in "fiu" else array


def _plain(value):
    """Turn numpy numbers and arrays into what JSON knows."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    return str(value)
