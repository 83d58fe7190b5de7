"""
Files of JWST level 1b (``*_uncal.fits``), written and read with astropy alone.

The counts stand in ``SCI`` as unsigned 16-bit numbers (BZERO 32768). A constant ASDF stub
of a hundred bytes is what the official pipeline needs to recognize the file. Keywords
follow the JWST keyword dictionary; those that the pipeline asks for are all there.
"""

import contextlib
import functools
import json
import os
import threading
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.time import Time, TimeDelta

from miricigale.detector.effects import effect_from_record
from miricigale.instrument import DQ, Exposure, reference_pixel_mask
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import open_fits
from miricigale.utils.store import plain_value, replacing

__all__ = ["header", "read", "row_writer", "write"]

_ASDF = (
    b"#ASDF 1.0.0\n#ASDF_STANDARD 1.6.0\n%YAML 1.1\n%TAG ! tag:stsci.edu:asdf/\n"
    b"--- !core/asdf-1.1.0\nmeta: {}\n...\n"
)

# bytes converted at a time
_CHUNK = 2**26

_START = "2022-06-21T00:00:00"
_REFERENCE = np.uint32(DQ.REFERENCE_PIXEL | DQ.NON_SCIENCE)


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
    with row_writer(path, ramp.exposure, **options) as (write_rows, finish):
        write_rows(slice(0, ramp.shape[2]), ramp.data)
        finish(ramp.pixel_dq, ramp.effects, ramp.meta)
    return Path(path)


@contextlib.contextmanager
def row_writer(path, exposure, *, start=None, filename=None, overwrite=False):
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

    Yields
    ------
    write_rows : callable
        Takes a slice of detector rows and their counts (uint16, shape (n_int, n_group, n_row,
        nx)), in any order and from any thread.
    finish : callable
        To be called last, with the pixel_dq, effects and meta of a `~miricigale.detector.Ramp`.

    Raises
    ------
    OSError
        If the file exists and ``overwrite`` is False.
    """
    path = Path(path)
    primary, science = header(exposure, filename=filename or path.name, start=start)
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

            yield write_rows, functools.partial(_append, partial)


def _append(partial, pixel_dq, effects, meta):
    """Add what level 1b does not know: flags, effects and provenance."""
    meta = dict(meta)
    if effects is not None:
        meta["effects"] = [effect.record() for effect in effects]
    text = json.dumps(meta, default=plain_value).encode()
    with fits.open(partial, mode="append") as hdus:
        hdus.append(fits.ImageHDU(np.asarray(pixel_dq), name="SIM_PIXELDQ"))
        if meta:
            hdus.append(_bytes_table(text, "JSON", "SIM_META"))
        # the pipeline looks for it last
        hdus.append(_bytes_table(_ASDF, "ASDF_METADATA", "ASDF"))


def _chunks(flat):
    step = _CHUNK // flat.itemsize
    for start in range(0, flat.size, step):
        yield flat[start : start + step]


def _bytes_table(text, column, name):
    array = np.frombuffer(text, np.uint8)[None]
    fields = [fits.Column(name=column, format=f"{array.size}B", array=array)]
    return fits.BinTableHDU.from_columns(fields, name=name)


def read(path):
    """
    Read a level-1b file of the MIRI imager, our own or real.

    Parameters
    ----------
    path : path-like
        The file.

    Returns
    -------
    values : dict
        Arguments of `~miricigale.detector.Ramp`. The exposure is made from the keywords, its
        counts from the data; a dither is the position number in the pattern, from 0. In a file
        that is not ours the reference pixels alone are flagged, and it is not known what acted.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, truncated or not of that kind.
    """
    path, wanted = Path(path), "a level-1b file of the MIRI imager"
    try:
        with open_fits(path, wanted=wanted, memmap=True, do_not_scale_image_data=True) as hdus:
            return _read(path, hdus)
    except (AttributeError, KeyError, SyntaxError, TypeError, ValueError, OSError) as err:
        if isinstance(err, DataError):
            raise
        msg = f"{path} cannot be read as {wanted}: {err}"
        raise DataError(msg) from err


def _read(path, hdus):
    if "SCI" not in hdus:
        msg = f"{path} is no level-1b file: it has no SCI extension"
        raise DataError(msg)
    science, primary = hdus["SCI"], hdus[0].header
    if primary.get("INSTRUME") != "MIRI" or primary.get("EXP_TYPE") != "MIR_IMAGE":
        kind = f"{primary.get('INSTRUME')} {primary.get('EXP_TYPE')}"
        msg = f"{path} must be a MIRI MIR_IMAGE exposure, got {kind}"
        raise DataError(msg)
    head = science.header
    scaling = (head.get("BITPIX"), head.get("BZERO", 0), head.get("BSCALE", 1), head["NAXIS"])
    if scaling != (16, 32768, 1, 4):
        msg = f"{path} must hold unsigned 16-bit counts on four axes (level 1b) in SCI"
        raise DataError(msg)
    raw = science.data
    data = np.empty(raw.shape, np.uint16)
    for into, part in zip(_chunks(data.reshape(-1)), _chunks(raw.reshape(-1)), strict=True):
        np.bitwise_xor(part.astype(np.int16).view(np.uint16), np.uint16(0x8000), out=into)

    def keyword(name, default=None):
        value = head.get(name, primary.get(name, default))
        if value is None:
            msg = f"{path} has no keyword {name}"
            raise DataError(msg)
        return value

    exposure = Exposure(
        f"miri.{keyword('FILTER').lower()}",
        readout=keyword("READPATT"),
        n_groups=data.shape[1],
        n_integrations=data.shape[0],
        subarray=keyword("SUBARRAY"),
        pointing=SkyCoord(keyword("RA_REF") * u.deg, keyword("DEC_REF") * u.deg),
        roll=keyword("ROLL_REF") * u.deg,
        dither=int(keyword("PATT_NUM", 1)) - 1,
    )
    if data.shape[2:] != exposure.shape:
        wanted = f"{exposure.shape} pixels for {exposure.subarray}"
        msg = f"{path} must have {wanted}, got {data.shape[2:]}"
        raise DataError(msg)
    values = {"data": data, "exposure": exposure}
    values["meta"] = {"origin": primary.get("ORIGIN", "unknown"), "filename": path.name}
    if "SIM_META" in hdus:
        values["meta"] = json.loads(hdus["SIM_META"].data["JSON"][0].tobytes())
        records = values["meta"].pop("effects", None)
        if records is not None:
            values["effects"] = [effect_from_record(record) for record in records]
    if "SIM_PIXELDQ" in hdus:
        # unsigned 32 bits as FITS keeps them: BZERO 2^31
        stored = hdus["SIM_PIXELDQ"].data.astype(np.int32).view(np.uint32)
        values["pixel_dq"] = stored ^ np.uint32(2**31)
    else:
        mask = reference_pixel_mask(subarray=exposure.subarray)
        values["pixel_dq"] = np.where(mask, _REFERENCE, np.uint32(0))
    return values
