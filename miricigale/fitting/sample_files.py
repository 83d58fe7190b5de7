"""Draws from posteriors as FITS files."""

from pathlib import Path

import numpy as np
from astropy.io import fits

from miricigale.fitting.files import (
    axes_from_plain,
    axes_to_plain,
    native,
    read_text,
    text_hdu,
)
from miricigale.utils.content import content_sha256
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits, writing
from miricigale.utils.tables import ascii_ids

__all__ = ["read_samples", "write_samples"]

_FORMAT = "miricigale-samples-1"
_COLUMNS = ("ids", "flags", "index", "scale")


def write_samples(samples, path, *, overwrite=False):
    """
    Write samples: a table extension of the draws, a text extension, and the axes' shares.

    Parameters
    ----------
    samples : `~miricigale.fitting.Samples`
        The samples.
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

    ascii_ids(samples.ids, "ids")
    text = {
        "meta": samples.meta,
        "axes": axes_to_plain(samples.axes),
        "grid": {"sha256": content_sha256(samples.grid), "text": repr(samples.grid)},
        "n_draws": samples.n_draws,
    }
    table = Table({name: getattr(samples, name) for name in _COLUMNS})
    hdu = fits.table_to_hdu(table)
    hdu.name = "SAMPLES"
    hdus = [fits.PrimaryHDU(header=fits.Header({"FORMAT": _FORMAT})), text_hdu(text), hdu]
    for i, axis in enumerate(samples.axes.values()):
        if axis.share is not None:
            hdus.append(fits.ImageHDU(np.asarray(axis.share, dtype=float), name=f"SHARE{i}"))
    with writing(path):
        fits.HDUList(hdus).writeto(Path(path), overwrite=overwrite, output_verify="exception")


def read_samples(cls, path, grid, *, model=None):
    """
    Read samples.

    Parameters
    ----------
    cls : type
        `~miricigale.fitting.Samples`.
    path : path-like
        The file.
    grid : `~miricigale.sed.ModelGrid`
        The grid that was fitted.
    model : `~miricigale.sed.SEDModel`, optional
        The model that it was made from.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, something else or incomplete.
    ValueError
        If the grid is another.
    """
    from astropy.table import Table

    if not hasattr(grid, "galaxy_properties"):
        raise argument_error("grid", "the ModelGrid that was fitted", type(grid).__name__)
    try:
        with open_fits(path, wanted="samples", memmap=False) as hdus:
            if hdus[0].header.get("FORMAT") != _FORMAT:
                msg = f"{path} holds no samples (no FORMAT = {_FORMAT!r} in its header)"
                raise DataError(msg)
            text = read_text(hdus)
            names = {hdu.name for hdu in hdus}
            shares = {
                name: native(np.array(hdus[f"SHARE{i}"].data))
                for i, name in enumerate(text["axes"])
                if f"SHARE{i}" in names
            }
            table = Table.read(hdus["SAMPLES"], character_as_bytes=False)
        n, n_draws = len(table), int(text["n_draws"])
        columns = {name: native(np.asarray(table[name])) for name in _COLUMNS}
        columns["index"] = columns["index"].reshape(n, n_draws, 4)
        columns["scale"] = columns["scale"].reshape(n, n_draws)
        axes = axes_from_plain(text["axes"], shares)
        known, whose = text["grid"]["sha256"], text["grid"]["text"]
        meta = text["meta"]
    except (KeyError, ValueError, TypeError) as err:
        msg = f"{path} is not a complete file of samples: {err}"
        raise DataError(msg) from err
    if content_sha256(grid) != known:
        raise argument_error("grid", f"the one of the samples, {whose}", f"another, {grid!r}")
    return cls(grid=grid, model=model, meta=meta, axes=axes, **columns)
