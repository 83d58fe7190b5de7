"""Templates of sources as FITS files: stamps of all sizes one after the other, grids exact."""

import json

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

from miricigale.photometry.cutouts import Cutout
from miricigale.photometry.shapes import FITTED, not_fitted
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits, write_fits
from miricigale.utils.tables import ascii_ids

__all__ = ["grid_text", "read_templates", "text_grid", "write_templates"]


def _exact(has_cd):
    """Names of the numbers of a WCS that a header rounds."""
    return ("crpix", "crval", "cd") if has_cd else ("crpix", "crval", "cdelt", "pc")


def grid_text(wcs):
    """
    A WCS as text.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Celestial, of two axes.

    Returns
    -------
    text : str
        JSON: its header, and all digits of what a header rounds.

    Raises
    ------
    ValueError
        If a header cannot hold it, such as one with lookup tables.
    """
    exact = {name: getattr(wcs.wcs, name).tolist() for name in _exact(wcs.wcs.has_cd())}
    cards = wcs.to_header(relax=True).cards
    header = {c.keyword: c.value for c in cards if c.keyword not in ("COMMENT", "HISTORY", "")}
    text = json.dumps({"header": header, **exact})
    x = y = np.array([0.0, 1000.0])
    again = text_grid(text).pixel_to_world_values(x, y)
    if not np.allclose(again, wcs.pixel_to_world_values(x, y), rtol=0, atol=1e-9):
        raise argument_error("wcs", "one that a FITS header can hold", f"{wcs!r}")
    return text


def text_grid(text):
    """
    The WCS that `grid_text` wrote.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
    """
    state = json.loads(text)
    wcs = WCS(fits.Header(state["header"]))
    has_cd = "cd" in state
    if has_cd:
        # the header has PC and CDELT instead
        del wcs.wcs.pc
    for name in _exact(has_cd):
        setattr(wcs.wcs, name, state[name])
    wcs.wcs.set()
    return wcs


def write_templates(templates, path, *, overwrite):
    """
    Write templates.

    Parameters
    ----------
    templates : `~miricigale.photometry.SourceTemplates`
        The templates.
    path : path-like
        The file.
    overwrite : bool
        Whether a file that is there is replaced.
    """
    table = Table({"id": ascii_ids(templates.id, "id")})
    table["ra"], table["dec"] = templates.sky.ra.deg, templates.sky.dec.deg
    for name in ("sersic", "flags", "snr", "flux", "components"):
        if getattr(templates, name) is not None:
            table[name] = getattr(templates, name)
    for name in FITTED.names:
        table[f"fitted_{name}"] = templates.fitted[name]
    layers = [
        (row, one) for row, light in enumerate(templates.light) if light for one in light.layers
    ]
    stamps = [one.data for _, one in layers]
    rows = Table(
        {
            "row": np.array([row for row, _ in layers], int),
            "corner": np.array([one.origin for _, one in layers], int).reshape(-1, 2),
            "shape": np.array([one.shape for one in stamps], int).reshape(-1, 2),
            "noise": np.array([one.noise for _, one in layers], float),
            "convolved": np.array([one.convolved for _, one in layers], bool),
        }
    )
    pixels = np.concatenate([one.ravel() for one in stamps] or [np.zeros(1)])
    primary = fits.PrimaryHDU()
    primary.header["META"] = json.dumps(templates.meta, default=str)
    if templates.wcs is not None:
        primary.header["GRID"] = grid_text(templates.wcs)
    hdus = [
        primary,
        fits.BinTableHDU(table, name="SOURCES"),
        fits.BinTableHDU(rows, name="LAYERS"),
        fits.ImageHDU(pixels, name="PIXELS"),
    ]
    if templates.psf is not None:
        hdus.append(fits.ImageHDU(templates.psf, name="PSF"))
    write_fits(hdus, path, overwrite=overwrite)


def read_templates(cls, path):
    """
    Read templates.

    Parameters
    ----------
    cls : type
        `~miricigale.photometry.SourceTemplates`.
    path : path-like
        The file.

    Returns
    -------
    templates : `~miricigale.photometry.SourceTemplates`

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, something else or incomplete.
    """
    with open_fits(path, wanted="templates of sources") as hdus:
        try:
            header = hdus[0].header
            table = Table(hdus["SOURCES"].data)
            rows = Table(hdus["LAYERS"].data)
            pixels = _native(hdus["PIXELS"].data)
            light = [None] * len(table)
            ends = np.cumsum(np.prod(np.asarray(rows["shape"], int), axis=1))
            # the last layer of a source first: each is what is added to the one before
            for k in range(len(rows) - 1, -1, -1):
                shape = tuple(int(n) for n in rows["shape"][k])
                data = pixels[ends[k] - shape[0] * shape[1] : ends[k]].reshape(shape)
                row = int(rows["row"][k])
                light[row] = Cutout(
                    data,
                    tuple(int(c) for c in rows["corner"][k]),
                    noise=float(rows["noise"][k]),
                    convolved=bool(rows["convolved"][k]),
                    rest=light[row],
                )
            fitted = not_fitted(len(table))
            for name in FITTED.names:
                fitted[name] = table[f"fitted_{name}"]
            return cls(
                id=_native(table["id"]),
                sky=SkyCoord(_native(table["ra"]), _native(table["dec"]), unit="deg"),
                light=light,
                sersic=_native(table["sersic"]),
                flags=_native(table["flags"]),
                snr=_native(table["snr"]),
                fitted=fitted,
                **{k: _native(table[k]) for k in ("flux", "components") if k in table.colnames},
                wcs=text_grid(header["GRID"]) if "GRID" in header else None,
                psf=_native(hdus["PSF"].data) if "PSF" in hdus else None,
                meta=json.loads(header["META"]),
            )
        except (KeyError, IndexError, TypeError, ValueError) as err:
            msg = f"{path} is not a complete file of templates: {err}"
            raise DataError(msg) from err


def _native(values):
    values = np.asarray(values)
    return np.array(values, dtype=values.dtype.newbyteorder("="))
