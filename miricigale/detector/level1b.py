"""
Files of JWST level 1b (``*_uncal.fits``), written with astropy alone.

The counts stand in ``SCI`` as unsigned 16-bit numbers (BZERO 32768). A constant ASDF stub
of a hundred bytes is what the official pipeline needs to recognize the file. Keywords
follow the JWST keyword dictionary; those that the pipeline asks for are all there.
"""

import contextlib
import dataclasses
import functools
import json
import os
import threading
from pathlib import Path

import numpy as np
from astropy.io import fits
from astropy.table import Table
from astropy.time import Time, TimeDelta

from miricigale.instrument import kept_keywords, placed_keywords
from miricigale.instrument.asdf_extension import asdf_extension, bytes_table
from miricigale.instrument.product_files import jwst_product
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import replacing
from miricigale.utils.meta import plain_value
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import declared

_START = "2022-06-21T00:00:00"


def header(exposure, *, filename="", start=None):
    """
    Return the headers of the primary and the SCI extension of a file (without the structural keywords).

    ``start`` is the `~astropy.time.Time` when the exposure began; 2022-06-21 plus an hour for each
    dither if not given.
    """
    if start is None:
        start = Time(_START, scale="utc") + TimeDelta(exposure.dither * 3600.0, format="sec")
    elif not isinstance(start, Time) or not start.isscalar:
        raise argument_error("start", "one astropy Time", repr(start))
    duration = TimeDelta(exposure.duration.to_value("s"), format="sec")
    # as in real files, only the linear part of the WCS stands here
    wcs = exposure.wcs.wcs
    pointing = exposure.pointing_keywords()
    matrix = wcs.pc * np.asarray(wcs.cdelt)[:, None] if not wcs.has_cd() else wcs.cd
    times = {
        "TFRAME": exposure.frame_time, "TGROUP": exposure.group_time, "EFFINTTM": exposure.integration_time,
        "EFFEXPTM": exposure.exposure_time, "DURATION": exposure.duration,
    }  # fmt: skip
    days = {"EXPSTART": start, "EXPMID": start + duration / 2, "EXPEND": start + duration}
    n_int = exposure.n_integrations
    number = exposure.dither + 1
    name = exposure.filter.rpartition(".")[2]
    values = pointing | {
        # not the time of writing: the same exposure gives the same bytes
        "DATE": days["EXPEND"].utc.isot, "DATE-OBS": start.utc.isot[:10], "TIME-OBS": start.utc.isot[11:],
        "FILENAME": filename, "FILTER": name.upper(), "READPATT": exposure.readout,
        "TARG_RA": pointing["RA_REF"], "TARG_DEC": pointing["DEC_REF"],
        "APERNAME": f"MIRIM_{pointing['SUBARRAY']}",
        "NINTS": n_int, "INTEND": n_int, "NGROUPS": exposure.n_groups, "NFRAMES": exposure.n_frames,
        "NSAMPLES": 9 if exposure.readout.startswith("SLOW") else 1,
        "EXPOSURE": f"{number:05d}", "PATT_NUM": number,
        **{name: time.to_value("s") for name, time in times.items()},
        **{name: day.utc.mjd for name, day in days.items()},
        **{f"CRPIX{i + 1}": float(wcs.crpix[i]) for i in range(2)},
        **{f"CRVAL{i + 1}": float(wcs.crval[i]) for i in range(2)},
        **{f"PC{i + 1}_{j + 1}": float(matrix[i, j]) for i, j in np.ndindex(2, 2)},
    }  # fmt: skip
    parts = declared("miricigale.detector", "level1b.toml")
    primary, science = (
        fits.Header([(key, values.get(key, value), text) for key, (value, text) in part.items()])
        for part in parts.values()
    )
    if exposure.n_frames > 1:
        # by which the sum of frames was divided: the pipeline scales what differs from NFRAMES
        card = ("FRMDIVSR", exposure.n_frames, "divisor of the sum of frames in a group")
        primary.insert("NFRAMES", card, after=True)
    return primary, science


def keywords(exposure):
    """Return the keywords of an exposure in one header."""
    primary, science = header(exposure)
    primary.update(science)
    return primary


def write(path, ramp, *, start=None, filename=None, overwrite=False):
    """Write a level-1b file: see `~miricigale.detector.Ramp.write`."""
    check_that(
        ramp.data.dtype == np.uint16, "data", "counts (uint16) to be written", ramp.data.dtype
    )
    if jwst_product(path) not in (None, "uncal"):
        wanted = "a name that is not of another product of JWST: ramps are x_uncal.fits"
        raise argument_error("path", wanted, repr(os.fspath(path)))
    options = {"start": start, "filename": filename, "overwrite": overwrite}
    if not ramp.simulated and ramp.observed:
        # the keywords of the observation, and none of a simulation
        options["observation"] = ramp.header
    with row_writer(path, ramp.exposure, **options) as (write_rows, finish):
        write_rows(slice(0, ramp.shape[2]), ramp.data)
        finish(ramp.pixel_dq, ramp.effects, ramp.meta, ramp.properties)
    return Path(path)


def _int_times(exposure, start):
    """Table INT_TIMES of JWST: begin, middle and end of each integration; barycentric times are unknown."""
    n_int = exposure.n_integrations
    length = exposure.integration_time.to_value("day")
    step = length + exposure.frame_time.to_value("day")
    begin = start + step * np.arange(n_int)
    shifts = {"start": 0.0, "mid": length / 2, "end": length}
    columns = {"integration_number": np.arange(1, n_int + 1, dtype=np.int32)}
    for name, shift in shifts.items():
        columns[f"int_{name}_MJD_UTC"] = begin + shift
    for name in shifts:
        columns[f"int_{name}_BJD_TDB"] = nans(n_int)
    return fits.BinTableHDU(Table(columns), name="INT_TIMES")


@contextlib.contextmanager
def row_writer(path, exposure, *, start=None, filename=None, overwrite=False, observation=None):
    """
    Write a level-1b file block by block.

    Parameters
    ----------
    path : path-like
        The file; it appears under its name only when the context ends without an error.
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    start, filename, overwrite : optional
        As for `write`.
    observation : `~astropy.io.fits.Header`, optional
        Keywords of an observation, in place of those of a simulation.

    Yields
    ------
    write_rows : callable
        Takes a slice of detector rows and their counts (uint16, shape (n_int, n_group, n_row,
        nx)), in any order and from any thread.
    finish : callable
        To be called last, with the pixel_dq, effects, meta and properties of a
        `~miricigale.detector.Ramp`.

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is False.
    """
    path = Path(path)
    filename = filename or path.name
    if observation is None:
        primary, science = header(exposure, filename=filename, start=start)
    else:
        primary, science = placed_keywords(kept_keywords(observation))
        primary["FILENAME"] = filename
        science["BUNIT"] = "DN"
    begun = primary.get("EXPSTART")
    times = None
    if begun is not None:
        times = _int_times(exposure, begun)
    shape = (exposure.n_integrations, exposure.n_groups) + exposure.shape
    axes = [("NAXIS", len(shape))] + [(f"NAXIS{i + 1}", n) for i, n in enumerate(shape[::-1])]
    structure = [("XTENSION", "IMAGE"), ("BITPIX", 16)] + axes + [("PCOUNT", 0), ("GCOUNT", 1)]
    scaling = [("EXTNAME", "SCI"), ("BZERO", 32768), ("BSCALE", 1)]
    science = fits.Header(structure + scaling) + science
    lock = threading.Lock()
    with replacing(path, overwrite=overwrite) as partial:
        fits.PrimaryHDU(header=primary).writeto(partial)
        with open(partial, "r+b", buffering=0) as handle:
            handle.seek(0, os.SEEK_END)
            handle.write(science.tostring().encode("ascii"))
            begin = handle.tell()
            # FITS files are made of blocks of 2880 bytes
            handle.truncate(begin + -(-2 * int(np.prod(shape)) // 2880) * 2880)

            def write_rows(rows, counts):
                _, n_group, ny, nx = shape
                for i, g in np.ndindex(*shape[:2]):
                    # BZERO 32768: the top bit is turned
                    stored = (counts[i, g] ^ np.uint16(0x8000)).astype(">u2")
                    with lock:
                        handle.seek(begin + 2 * nx * ((i * n_group + g) * ny + rows.start))
                        if handle.write(stored.data) != stored.nbytes:
                            msg = f"{path} could not be written: is the disk full?"
                            raise OSError(msg)

            yield write_rows, functools.partial(_append, partial, times, exposure.filter)


def _append(partial, times, name, pixel_dq, effects, meta, properties):
    """Add what level 1b does not know: flags, effects and provenance."""
    meta = dict(meta)
    if effects is not None:
        meta |= {"filter": name, "effects": [effect.record() for effect in effects]}
    if properties is not None:
        # a response of no rows is not said
        meta["properties"] = {k: v for k, v in dataclasses.asdict(properties).items() if v != ()}
    text = json.dumps(meta, default=plain_value).encode()
    with fits.open(partial, mode="append") as hdus:
        if times is not None:
            hdus.append(times)
        hdus.append(fits.ImageHDU(np.asarray(pixel_dq), name="SIM_PIXELDQ"))
        if meta:
            hdus.append(bytes_table(text, "JSON", "SIM_META"))
        # the pipeline looks for it last
        hdus.append(asdf_extension())
