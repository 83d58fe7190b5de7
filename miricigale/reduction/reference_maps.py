"""Reference files of CRDS, read for one exposure: arrays, and flags of pixels."""

import numpy as np

from miricigale.instrument import DQ, READOUT_NAMES, aperture, joined_header
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits
from miricigale.utils.parallel import check_memory

#: Values of keywords that fit any exposure.
_ANY = ("", "N/A", "ANY", "GENERIC", "*")

_WANTED = "a {} reference of CRDS (FITS with {})"

_SPOILT = int(DQ.DO_NOT_USE)


def _refuse(path, kind, what, got, wanted):
    msg = f"{path} is no {kind} reference for this exposure: its {what} is {got}, not {wanted}"
    raise DataError(msg)


def _check(path, kind, header, exposure, *, reftype, filtered=False, timed=False):
    """Refuse a reference of another kind, detector, filter or read-out."""
    names = ("REFTYPE", "INSTRUME", "DETECTOR", "FILTER", "READPATT")
    stated = {name: str(header.get(name, "")).strip().upper() for name in names}
    stated["READPATT"] = READOUT_NAMES.get(stated["READPATT"], stated["READPATT"])
    wanted = {"REFTYPE": reftype.upper(), "INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE"}
    wanted["READPATT"] = exposure.readout
    if filtered and exposure.filter is not None:
        wanted["FILTER"] = exposure.filter.rpartition(".")[2].upper()
    for name, value in wanted.items():
        if stated[name] not in (value, *_ANY):
            _refuse(path, kind, name, stated[name], value)
    for name, value in {"NFRAMES": 1, "GROUPGAP": 0}.items() if timed else ():
        if header.get(name, value) != value:
            _refuse(path, kind, name, header[name], value)


def _cut(path, kind, array, header, exposure):
    """The part of a reference, (..., ny, nx), that an exposure sees."""
    part = exposure.aperture
    full = aperture("FULL")
    if all(f"SUBSTRT{axis}" in header for axis in (1, 2)):
        origin = (int(header["SUBSTRT1"]) - 1, int(header["SUBSTRT2"]) - 1)
    elif array.shape[-2:] == full.shape:
        origin = (0, 0)
    elif array.shape[-2:] == part.shape and str(header.get("SUBARRAY", "")).strip() == part.name:
        origin = part.origin
    else:
        msg = (
            f"{path} does not state which part of the detector it covers: {array.shape[-2:]} pixels "
            "without SUBSTRT1 and SUBSTRT2"
        )
        raise DataError(msg)
    x, y = (own - other for own, other in zip(part.origin, origin, strict=True))
    ny, nx = part.shape
    if x < 0 or y < 0 or y + ny > array.shape[-2] or x + nx > array.shape[-1]:
        msg = (
            f"{path} is no {kind} reference for this exposure: it covers {array.shape[-2:]} pixels "
            f"from column {origin[0] + 1}, row {origin[1] + 1} on, and not {part.name}"
        )
        raise DataError(msg)
    return array[..., y : y + ny, x : x + nx]


def _flags(path, kind, hdus, header, exposure):
    """Flags of a reference by the names in its legend, as `DQ`."""
    shape = exposure.shape
    if "DQ" not in hdus or hdus["DQ"].data is None:
        return np.zeros(shape, np.int64)
    stored = hdus["DQ"].data
    # those of groups and integrations together
    stored = np.bitwise_or.reduce(stored.reshape(-1, *stored.shape[-2:]), axis=0)
    stored = _cut(path, kind, stored, header, exposure).astype(np.int64)
    table = hdus["DQ_DEF"].data if "DQ_DEF" in hdus else None
    if table is None or len(table) == 0:
        return stored & 0xFFFFFFFF
    out = np.zeros(shape, np.int64)
    known = {flag.name: int(flag) for flag in DQ}
    for row in table:
        name = str(row["NAME"]).strip().upper()
        if name in known:
            out[stored & int(row["VALUE"]) != 0] |= known[name]
    return out


def _header(hdus, path, kind, extension):
    """Keywords of a file that must have an extension."""
    if extension not in hdus:
        wanted = _WANTED.format(kind, extension)
        msg = f"{path} cannot be read as {wanted}: it has {[hdu.name for hdu in hdus]}"
        raise DataError(msg)
    return joined_header(hdus, extension)


def _read(path, exposure, kind, reftype, extension="SCI", **options):
    """Array, header and flags of a reference."""
    wanted = _WANTED.format(kind, extension)
    with open_fits(path, wanted=wanted) as hdus:
        header = _header(hdus, path, kind, extension)
        _check(path, kind, header, exposure, reftype=reftype, **options)
        shape = hdus[extension].shape
        if len(shape) < 2:
            msg = f"{path} cannot be read as {wanted}: {extension} is no image"
            raise DataError(msg)
        n_bytes = 4 * np.prod(shape[:-2], dtype=float) * np.prod(exposure.shape)
        check_memory(n_bytes, f"the {kind} reference {path}", advice="use one with fewer groups")
        array = _cut(path, kind, hdus[extension].data, header, exposure)
        array = np.ascontiguousarray(array, np.float32)
        return array, _flags(path, kind, hdus, header, exposure)


def read_mask(path, exposure):
    """Flags of bad pixels; there is no other value."""
    with open_fits(path, wanted=_WANTED.format("mask", "DQ")) as hdus:
        header = _header(hdus, path, "mask", "DQ")
        _check(path, "mask", header, exposure, reftype="MASK")
        return None, _flags(path, "mask", hdus, header, exposure)


def read_saturation(path, exposure):
    """Raw DN from which a group is saturated; infinite where it is not known."""
    limit, flags = _read(path, exposure, "saturation", "SATURATION")
    unknown = ~np.isfinite(limit) | ((flags & DQ.NO_SAT_CHECK) != 0)
    flags[unknown] |= int(DQ.NO_SAT_CHECK)
    return np.where(unknown, np.inf, limit), flags


def read_bias(path, exposure):
    """Level of an empty pixel, DN."""
    level, flags = _read(path, exposure, "bias", "SUPERBIAS")
    bad = ~np.isfinite(level) | ((flags & DQ.UNRELIABLE_BIAS) != 0)
    flags[bad] |= int(DQ.UNRELIABLE_BIAS)
    return np.nan_to_num(level, posinf=0.0, neginf=0.0), flags


def read_linearity(path, exposure):
    """Coefficients of the polynomial to linear DN; none where the file says so."""
    coef, flags = _read(path, exposure, "linearity", "LINEARITY", extension="COEFFS")
    if coef.ndim != 3 or len(coef) < 2:
        msg = f"{path} must hold coefficients (n, ny, nx) in COEFFS, got shape {coef.shape}"
        raise DataError(msg)
    bad = ~np.isfinite(coef).all(axis=0) | ((flags & DQ.NO_LIN_CORR) != 0)
    flags[bad] |= int(DQ.NO_LIN_CORR)
    # as in the pipeline: no correction, and a flag
    coef[:, bad] = 0.0
    coef[1, bad] = 1.0
    return coef, flags


def _by_group(path, exposure, kind, reftype):
    """Array (integrations, groups, ny, nx) of a reference that has groups."""
    array, flags = _read(path, exposure, kind, reftype, timed=True)
    if array.ndim == 3:
        array = array[None]
    if array.ndim != 4:
        msg = f"{path} must hold groups (integrations, groups, ny, nx), got shape {array.shape}"
        raise DataError(msg)
    # what is not known is not subtracted, as in the pipeline
    return np.nan_to_num(array, copy=False, posinf=0.0, neginf=0.0), flags


def read_reset(path, exposure):
    """DN of the first groups after a reset."""
    return _by_group(path, exposure, "reset", "RESET")


def read_dark(path, exposure):
    """Linear DN of each group."""
    return _by_group(path, exposure, "dark", "DARK")


def read_gain(path, exposure):
    """Electrons per DN; pixels without are not to be used."""
    gain, flags = _read(path, exposure, "gain", "GAIN")
    bad = ~(np.isfinite(gain) & (gain > 0))
    flags[bad] |= int(DQ.NO_GAIN_VALUE) | _SPOILT
    return gain, flags


def read_noise(path, exposure):
    """Noise of one read, DN: CRDS has that of a difference of two."""
    noise, flags = _read(path, exposure, "read noise", "READNOISE")
    bad = ~(np.isfinite(noise) & (noise > 0))
    flags[bad] |= int(DQ.UNRELIABLE_ERROR) | _SPOILT
    return noise / np.float32(np.sqrt(2)), flags


def read_flat(path, exposure):
    """Relative response; pixels without are not to be used."""
    flat, flags = _read(path, exposure, "flat", "FLAT", filtered=True)
    bad = ~(np.isfinite(flat) & (flat > 0)) | ((flags & DQ.NO_FLAT_FIELD) != 0)
    flags[bad] |= int(DQ.NO_FLAT_FIELD) | _SPOILT
    return np.where(bad, np.float32(1), flat), flags


def read_photom(path, exposure, day):
    """
    MJy/sr per DN/s of the filter and sub-array of an exposure.

    Parameters
    ----------
    path : path-like
        The file.
    exposure : object
        With ``filter`` and ``subarray``.
    day : float or None
        Middle of the exposure (MJD); needed by files whose values depend on time.

    Returns
    -------
    conversion : float

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no row for them, or the time is needed and not known.
    """
    short = exposure.filter.rpartition(".")[2].upper()
    with open_fits(path, wanted=_WANTED.format("photom", "PHOTOM")) as hdus:
        header = _header(hdus, path, "photom", "PHOTOM")
        for name, value in (("REFTYPE", "PHOTOM"), ("INSTRUME", "MIRI"), ("DETECTOR", "MIRIMAGE")):
            if str(header.get(name, value)).strip().upper() not in (value, *_ANY):
                _refuse(path, "photom", name, header[name], value)
        rows = hdus["PHOTOM"].data
        columns = (
            [str(name).strip().upper() for name in rows[key]] for key in ("filter", "subarray")
        )
        keys = list(zip(*columns, strict=True))
        known = [
            keys.index((short, part))
            for part in (exposure.subarray, "GENERIC")
            if (short, part) in keys
        ]
        if not known:
            msg = f"{path} has no row for {short} and {exposure.subarray}"
            raise DataError(msg)
        conversion = float(rows["photmjsr"][known[0]])
        times = {
            name: {key.lower(): float(hdus[name].data[key][known[0]]) for key in hdus[name].data.names
                   if key.lower() not in ("filter", "subarray")}
            for name in ("TIMECOEFF", *_TIMES) if name in hdus and hdus[name].data is not None
        }  # fmt: skip
    if not (np.isfinite(conversion) and conversion > 0):
        msg = f"{path} has no conversion for {short} and {exposure.subarray}: {conversion}"
        raise DataError(msg)
    if times and day is None:
        msg = f"{path} has a conversion that depends on time, and the exposure does not state when"
        raise DataError(msg)
    if (old := times.pop("TIMECOEFF", None)) is not None:
        conversion += old["amplitude"] * np.exp(-(day - old["t0"]) / old["tau"])
    for name, row in times.items():
        conversion /= _TIMES[name](day, **row)
    return float(conversion)


def _linear(day, t0, lossperyear):
    return 1 - lossperyear * (day - t0) / 365


def _exponential(day, t0, amplitude, tau, const):
    return amplitude * np.exp(-(day - t0) / tau) + const


def _power_law(day, t0, year1value, tsoft, alpha):
    return (day - t0 + tsoft) ** alpha * year1value / (365 + tsoft) ** alpha


#: Relative response by time, of the tables of a photom reference.
_TIMES = {
    "TIMECOEFF_LINEAR": _linear,
    "TIMECOEFF_EXPONENTIAL": _exponential,
    "TIMECOEFF_POWERLAW": _power_law,
}
