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

from miricigale.utils.exceptions import argument_error
from miricigale.utils.store import plain_value, replacing

_ASDF = (
    b"#ASDF 1.0.0\n#ASDF_STANDARD 1.6.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n"
    b"--- !core/asdf-1.1.0\nmeta: {}\n...\n"
)

_START = "2022-06-21T00:00:00"


def header(exposure, *, filename="", start=None):
    """
    Headers of the primary and the SCI extension of a file (without the structural keywords).

    ``start`` is the `~astropy.time.Time` when the exposure began; 2022-06-21 plus an hour for each
    dither if not given.
    """
    if start is None:
        start = Time(_START, scale="utc") + TimeDelta(exposure.dither * 3600.0, format="sec")
    elif not isinstance(start, Time) or not start.isscalar:
        raise argument_error("start", "one astropy Time", repr(start))
    duration = TimeDelta(exposure.duration.to_value("s"), format="sec")
    where = exposure.pointing_keywords()
    frame = exposure.frame_time.to_value("s")
    group = exposure.group_time.to_value("s")
    date, clock = start.utc.isot.split("T")
    name = exposure.filter.rsplit(".", 1)[-1].upper()
    primary = {
        # not the time of writing: the same exposure gives the same bytes
        "DATE": ((start + duration).utc.isot, "UTC date at end of simulated exposure"),
        "ORIGIN": ("miricigale", "simulated data"),
        "TELESCOP": ("JWST", "telescope"),
        "FILENAME": (filename, "name of the file"),
        "DATAMODL": ("Level1bModel", "type of data model"),
        "TITLE": ("simulated MIRI imaging", "proposal title"),
        "DATE-OBS": (date, "UTC date at start of exposure"),
        "TIME-OBS": (clock, "UTC time at start of exposure"),
        "PROGRAM": ("01345", "program number"),
        "OBSERVTN": ("001", "observation number"),
        "VISIT": ("001", "visit number"),
        "VISITGRP": ("01", "visit group identifier"),
        "SEQ_ID": ("1", "parallel sequence identifier"),
        "ACT_ID": ("01", "activity identifier"),
        "EXPOSURE": (f"{exposure.dither + 1:05d}", "exposure request number"),
        "OBS_ID": ("V01345001001P0000000001101", "programmatic observation identifier"),
        "VISIT_ID": ("01345001001", "visit identifier"),
        "TARGTYPE": ("FIXED", "type of target"),
        "TARGCAT": ("SIM", "target name"),
        "TARG_RA": (where["RA_REF"], "[deg] target RA"),
        "TARG_DEC": (where["DEC_REF"], "[deg] target Dec"),
        "INSTRUME": ("MIRI", "instrument"),
        "DETECTOR": ("MIRIMAGE", "detector"),
        "FILTER": (name, "filter"),
        "BAND": ("N/A", "MRS band"),
        "CHANNEL": ("N/A", "MRS channel"),
        "EXP_TYPE": ("MIR_IMAGE", "type of data in the exposure"),
        "EXPSTART": (start.utc.mjd, "[d] MJD at start of exposure"),
        "EXPMID": ((start + duration / 2).utc.mjd, "[d] MJD at middle of exposure"),
        "EXPEND": ((start + duration).utc.mjd, "[d] MJD at end of exposure"),
        "READPATT": (exposure.readout, "readout pattern"),
        "NINTS": (exposure.n_integrations, "number of integrations"),
        "NGROUPS": (exposure.n_groups, "number of groups in an integration"),
        "NFRAMES": (1, "number of frames in a group"),
        "GROUPGAP": (0, "frames dropped between groups"),
        "DRPFRMS1": (0, "frames dropped before the first group"),
        "NSAMPLES": (9 if exposure.readout.startswith("SLOW") else 1, "A/D samples per read"),
        "TSAMPLE": (10.0, "[us] time between samples"),
        "TFRAME": (frame, "[s] time between frames"),
        "TGROUP": (group, "[s] time between groups"),
        "EFFINTTM": (exposure.integration_time.to_value("s"), "[s] effective integration time"),
        "EFFEXPTM": (exposure.exposure_time.to_value("s"), "[s] effective exposure time"),
        "DURATION": (exposure.duration.to_value("s"), "[s] duration of the exposure"),
        "NRSTSTRT": (1, "resets at start of exposure"),
        "NRESETS": (1, "resets between integrations"),
        "ZEROFRAM": (False, "whether a zero frame was downlinked"),
        "DATAPROB": (False, "whether there were data problems"),
        "INTSTART": (1, "first integration in this file"),
        "INTEND": (exposure.n_integrations, "last integration in this file"),
        "SUBARRAY": (where["SUBARRAY"], "sub-array"),
        "SUBSTRT1": (where["SUBSTRT1"], "first pixel along axis 1"),
        "SUBSTRT2": (where["SUBSTRT2"], "first pixel along axis 2"),
        "SUBSIZE1": (where["SUBSIZE1"], "pixels along axis 1"),
        "SUBSIZE2": (where["SUBSIZE2"], "pixels along axis 2"),
        "FASTAXIS": (1, "direction of fast readout"),
        "SLOWAXIS": (2, "direction of slow readout"),
        "PATT_NUM": (exposure.dither + 1, "position number in the dither pattern"),
        "APERNAME": (f"MIRIM_{where['SUBARRAY']}", "SIAF aperture"),
    }
    # as in real files, only the linear part of the WCS stands here
    wcs = exposure.wcs.wcs
    matrix = wcs.pc * np.asarray(wcs.cdelt)[:, None] if not wcs.has_cd() else wcs.cd
    science = {
        "BUNIT": ("DN", "unit of the data"),
        "RADESYS": ("ICRS", "reference frame"),
        "RA_V1": (where["RA_V1"], "[deg] RA of telescope V1 axis"),
        "DEC_V1": (where["DEC_V1"], "[deg] Dec of telescope V1 axis"),
        "PA_V3": (where["PA_V3"], "[deg] position angle of telescope V3 axis"),
        "PA_APER": (where["PA_APER"], "[deg] position angle of the aperture"),
        "VA_SCALE": (1.0, "velocity aberration scale factor"),
        "WCSAXES": (2, "number of coordinate axes"),
        "CTYPE1": ("RA---TAN", "first axis"),
        "CTYPE2": ("DEC--TAN", "second axis"),
        "CUNIT1": ("deg", "unit of the first axis"),
        "CUNIT2": ("deg", "unit of the second axis"),
        "CRPIX1": (float(wcs.crpix[0]), "reference pixel, axis 1"),
        "CRPIX2": (float(wcs.crpix[1]), "reference pixel, axis 2"),
        "CRVAL1": (float(wcs.crval[0]), "RA of the reference pixel"),
        "CRVAL2": (float(wcs.crval[1]), "Dec of the reference pixel"),
        "CDELT1": (1.0, "scale of axis 1"),
        "CDELT2": (1.0, "scale of axis 2"),
        "PC1_1": (float(matrix[0, 0]), "linear transformation"),
        "PC1_2": (float(matrix[0, 1]), "linear transformation"),
        "PC2_1": (float(matrix[1, 0]), "linear transformation"),
        "PC2_2": (float(matrix[1, 1]), "linear transformation"),
        "V2_REF": (where["V2_REF"], "[arcsec] V2 of the reference point"),
        "V3_REF": (where["V3_REF"], "[arcsec] V3 of the reference point"),
        "VPARITY": (where["VPARITY"], "parity between ideal x and V2"),
        "V3I_YANG": (where["V3I_YANG"], "[deg] angle from V3 to ideal y"),
        "RA_REF": (where["RA_REF"], "[deg] RA of the reference point"),
        "DEC_REF": (where["DEC_REF"], "[deg] Dec of the reference point"),
        "ROLL_REF": (where["ROLL_REF"], "[deg] V3 roll at the reference point"),
    }
    return tuple(
        fits.Header([fits.Card(key, *value) for key, value in cards.items()])
        for cards in (primary, science)
    )


def write(path, ramp, *, start=None, filename=None, overwrite=False):
    """Write a level-1b file: see `~miricigale.detector.Ramp.write`."""
    if ramp.data.dtype != np.uint16:
        raise argument_error("data", "counts (uint16) to be written", ramp.data.dtype)
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
    columns |= {f"int_{name}_MJD_UTC": begin + shift for name, shift in shifts.items()}
    columns |= {f"int_{name}_BJD_TDB": np.full(n_int, np.nan) for name in shifts}
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
        primary, science = observation.copy(), fits.Header({"BUNIT": "DN"})
        primary["FILENAME"] = filename
    begun = primary.get("EXPSTART")
    times = None if begun is None else _int_times(exposure, begun)
    shape = (exposure.n_integrations, exposure.n_groups, *exposure.shape)
    axes = [("NAXIS", len(shape))] + [(f"NAXIS{i + 1}", n) for i, n in enumerate(shape[::-1])]
    structure = [("XTENSION", "IMAGE"), ("BITPIX", 16), *axes, ("PCOUNT", 0), ("GCOUNT", 1)]
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

            yield write_rows, functools.partial(_append, partial, times)


def _append(partial, times, pixel_dq, effects, meta, properties):
    """Add what level 1b does not know: flags, effects and provenance."""
    meta = dict(meta)
    if effects is not None:
        meta["effects"] = [effect.record() for effect in effects]
    if properties is not None:
        # a response of no rows is not said
        meta["properties"] = {k: v for k, v in dataclasses.asdict(properties).items() if v != ()}
    text = json.dumps(meta, default=plain_value).encode()
    with fits.open(partial, mode="append") as hdus:
        if times is not None:
            hdus.append(times)
        hdus.append(fits.ImageHDU(np.asarray(pixel_dq), name="SIM_PIXELDQ"))
        if meta:
            hdus.append(_bytes_table(text, "JSON", "SIM_META"))
        # the pipeline looks for it last
        hdus.append(_bytes_table(_ASDF, "ASDF_METADATA", "ASDF"))


def _bytes_table(text, column, name):
    array = np.frombuffer(text, np.uint8)[None]
    fields = [fits.Column(name=column, format=f"{array.size}B", array=array)]
    return fits.BinTableHDU.from_columns(fields, name=name)
