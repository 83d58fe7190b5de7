"""Ramps from files of the JWST pipeline, of level 1b or with some of its steps done."""

import json
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.detector.effects.order import effect_from_record
from miricigale.instrument import (
    DQ,
    DetectorProperties,
    Exposure,
    check_imager,
    exposure_keywords,
    joined_header,
    reference_pixel_mask,
    steps_done,
)
from miricigale.utils.exceptions import DataError, DetectorWarning, data_error, warn
from miricigale.utils.files import open_fits
from miricigale.utils.options import check_data
from miricigale.utils.parallel import check_memory

_WANTED = "a ramp of the MIRI imager"

#: Units of counts in headers, in lower case.
_COUNTS = ("", "dn", "adu", "count", "counts", "ct")

_REFERENCE = np.uint32(DQ.REFERENCE_PIXEL | DQ.NON_SCIENCE)

#: Kinds of exposures that are imager ramps; ground tests state none.
_KINDS = ("MIR_IMAGE", "MIR_DARKIMG", "MIR_FLATIMAGE", "ANY", "N/A", "")


def read(path):
    """
    Read the ramp of an exposure of the MIRI imager, our own or real.

    Parameters
    ----------
    path : path-like
        The file: level 1b, or what a step of calwebb_detector1 before the ramp fit saved.

    Returns
    -------
    values : dict
        Arguments of `~miricigale.detector.Ramp`. The exposure is made from the keywords; a dither
        is the position number in the pattern, from 0. In level 1b that is not ours the reference
        pixels alone are flagged, and it is not known what acted.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing, truncated or not of that kind, or its header contradicts its data.
    MemoryError
        If the ramp is larger than the memory.
    """
    path = Path(path)
    try:
        with open_fits(path, wanted=_WANTED, memmap=True, do_not_scale_image_data=True) as hdus:
            return _read(path, hdus)
    except (AttributeError, KeyError, SyntaxError, TypeError, ValueError, OSError) as err:
        if isinstance(err, DataError):
            raise
        raise data_error(path, f"cannot be read as {_WANTED}: {err}") from err


def _read(path, hdus):
    check_data("SCI" in hdus, path, "is no ramp: it has no SCI extension")
    header = joined_header(hdus)
    sim_meta = None
    if "SIM_META" in hdus:
        sim_meta = json.loads(hdus["SIM_META"].data["JSON"][0].tobytes())
    check_imager(path, header, kinds=_KINDS, own=sim_meta)
    shape = _ramp_shape(path, hdus["SCI"].header)
    _check_unit(path, hdus["SCI"].header)
    exposure = _exposure(path, header, shape)
    _check_header(path, header, exposure)
    check_memory(
        sum(hdus[name].size for name in ("SCI", "GROUPDQ") if name in hdus),
        f"the ramp of {path}, shape {shape},",
        advice="split the file by integrations",
    )
    values = {
        "data": _counts(hdus["SCI"]),
        "exposure": exposure,
        "steps": steps_done(header),
        "header": header,
        "meta": {"origin": header.get("ORIGIN", "unknown"), "filename": path.name},
    }
    if sim_meta is not None:
        values["meta"] = sim_meta
        sim_meta.pop("filter", None)
        if (records := values["meta"].pop("effects", None)) is not None:
            values["effects"] = [effect_from_record(record) for record in records]
        if (properties := values["meta"].pop("properties", None)) is not None:
            values["properties"] = DetectorProperties(**properties)
    return values | _flags(path, hdus, exposure, shape)


def _check_unit(path, head):
    """Refuse a ramp that states another unit than counts."""
    unit = str(head.get("BUNIT", "") or "").strip()
    check_data(
        unit.lower() in _COUNTS, path, f"must hold a ramp in DN, got the unit {unit!r} in SCI"
    )


def _ramp_shape(path, head):
    scaling = (head.get("BITPIX"), head.get("BZERO", 0), head.get("BSCALE", 1))
    if head["NAXIS"] != 4 or scaling not in ((16, 32768, 1), (-32, 0, 1), (-64, 0, 1)):
        wanted = (
            "must hold a ramp in SCI: four axes (integration, group, y, x) of unsigned 16-bit "
            f"counts or of floats, got {head['NAXIS']} axes of BITPIX {scaling[0]} with BZERO {scaling[1]}"
        )
        raise data_error(path, wanted)
    return tuple(int(head[f"NAXIS{axis}"]) for axis in (4, 3, 2, 1))


def _exposure(path, header, shape):
    """Return the exposure that the keywords and the shape describe."""
    n_int, n_group, *size = shape
    name, readout, part, dither = exposure_keywords(header)
    for key, value in (("READPATT", readout), ("SUBARRAY", part)):
        check_data(value is not None, path, f"has no keyword {key}")
    pointed = [header.get(key) for key in ("RA_REF", "DEC_REF", "ROLL_REF")]
    is_stated = [value is not None for value in pointed]
    if any(is_stated) and not all(is_stated):
        raise data_error(path, f"must have all of RA_REF, DEC_REF, ROLL_REF or none, got {pointed}")
    pointing = None
    roll = None
    if all(is_stated):
        pointing = SkyCoord(pointed[0], pointed[1], unit="deg")
        roll = pointed[2] * u.deg
    exposure = Exposure(
        name,
        readout=readout,
        n_groups=n_group,
        n_integrations=n_int,
        subarray=part,
        pointing=pointing,
        roll=roll,
        dither=dither,
    )
    wanted = f"must have {exposure.shape} pixels for {exposure.subarray}"
    check_data(tuple(size) == exposure.shape, path, f"{wanted}, got {tuple(size)}")
    return exposure


def _check_header(path, header, exposure):
    """Refuse a header that contradicts its data or its read-out pattern."""
    part = exposure.aperture
    n_frames = exposure.n_frames
    frame = exposure.frame_time.to_value("s")
    n_int = exposure.n_integrations
    if "INTSTART" in header and "INTEND" in header:
        n_int = header["INTEND"] - header["INTSTART"] + 1
    elif "NINTS" in header:
        n_int = header["NINTS"]
    part_name, pattern = f"of {part.name}", f"of {exposure.readout}"
    wanted = {
        "NGROUPS": (header.get("NGROUPS"), exposure.n_groups, "in SCI"),
        "NINTS": (n_int, exposure.n_integrations, "in SCI"),
        "NFRAMES": (header.get("NFRAMES"), n_frames, pattern),
        "FRMDIVSR": (header.get("FRMDIVSR"), n_frames, pattern),
        "GROUPGAP": (header.get("GROUPGAP"), 0, pattern),
        "SUBSIZE1": (header.get("SUBSIZE1"), part.shape[1], part_name),
        "SUBSIZE2": (header.get("SUBSIZE2"), part.shape[0], part_name),
        "SUBSTRT1": (header.get("SUBSTRT1"), part.origin[0] + 1, part_name),
        "SUBSTRT2": (header.get("SUBSTRT2"), part.origin[1] + 1, part_name),
    }
    if header.get("NFRAMES") == 1 and header.get("FRMDIVSR", n_frames) == n_frames:
        # before calwebb_detector1 has multiplied them, for groups that are averaged on board
        del wanted["NFRAMES"]
    for name, (in_header, true, context) in wanted.items():
        conflict = f"{name} is {in_header} in the header and {true} {context}"
        check_data(
            not (in_header is not None and in_header != true),
            path,
            f"contradicts itself: {conflict}",
        )
    times = {"TFRAME": frame, "TGROUP": n_frames * frame}
    for name, true in times.items():
        in_header = header.get(name)
        if name == "TGROUP" and n_frames > 1 and _is_time(in_header, frame):
            warn(
                f"{path}: TGROUP = {in_header} s is the time of a frame, as in files of 2023 and before; "
                f"a group of {exposure.readout} takes {true:.6g} s, which is used",
                DetectorWarning,
            )
        elif in_header is not None and not _is_time(in_header, true):
            truth = f"the frame of {exposure.readout} {exposure.subarray} takes {frame} s"
            group = "one group" if n_frames == 1 else f"one of {n_frames} of a group"
            conflict = f"{name} = {in_header} s, but {truth}, and is {group}"
            raise data_error(path, f"contradicts itself: {conflict}")


def _is_time(value, true):
    """Tell whether a time in a header is that of the table, which is rounded to a millisecond or three digits."""
    return value is not None and abs(value - true) < 5e-3 * true


def _counts(hdu):
    """Return the counts as they are kept, in the byte order of the machine."""
    if hdu.data.dtype.kind == "f":
        return np.asarray(hdu.data, np.float32)
    data = hdu.data.astype(np.uint16)
    # BZERO 32768: the top bit is turned
    data ^= np.uint16(0x8000)
    return data


def _flags(path, hdus, exposure, shape):
    """Return the flags of pixels and groups, as far as the file has them; reference pixels are always known."""
    pixel_dq = np.zeros(shape[2:], np.uint32)
    planes = {"SIM_PIXELDQ", "PIXELDQ"} & {hdu.name for hdu in hdus}
    for name in sorted(planes):
        stored = np.asarray(hdus[name].data)
        wanted = f"must have flags of {shape[2:]} pixels in {name}"
        check_data(stored.shape == shape[2:], path, f"{wanted}, got {stored.shape}")
        wanted = f"must have flags that are integers in {name}"
        check_data(stored.dtype.kind in "iu", path, f"{wanted}, got {stored.dtype}")
        # unsigned integers are kept in FITS less 2^31, which BZERO says
        bits = stored.astype(np.int64) + int(hdus[name].header.get("BZERO", 0))
        pixel_dq = pixel_dq | bits.astype(np.uint32)
    if "SIM_PIXELDQ" not in planes:
        mask = reference_pixel_mask(subarray=exposure.subarray)
        pixel_dq = np.where(mask, pixel_dq | _REFERENCE, pixel_dq)
    values = {"pixel_dq": pixel_dq}
    if "GROUPDQ" in hdus:
        group_dq = np.asarray(hdus["GROUPDQ"].data).astype(np.uint8)
        wanted = f"must have flags of shape {shape} in GROUPDQ"
        check_data(group_dq.shape == shape, path, f"{wanted}, got {group_dq.shape}")
        values["group_dq"] = group_dq
    return values
