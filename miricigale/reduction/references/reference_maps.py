"""Reference files of CRDS, read for one exposure: arrays, and flags of pixels."""

import functools

import numpy as np

from miricigale.filters.band_names import band_label
from miricigale.instrument import DQ, READOUT_NAMES, aperture, frame_pattern, joined_header
from miricigale.instrument.history import TYPES
from miricigale.instrument.keywords import header_text, keyword_text
from miricigale.utils.exceptions import data_error
from miricigale.utils.files import open_fits
from miricigale.utils.options import check_data
from miricigale.utils.parallel import check_memory

#: Values of keywords that fit any exposure.
_ANY = ("", "N/A", "ANY", "GENERIC", "*")

#: References of one value for each pixel: the flag of pixels without one, and what stands there then.
_VALUES = {
    "saturation": (DQ.NO_SAT_CHECK, np.inf),
    "gain": (DQ.NO_GAIN_VALUE, np.nan),
    "read_noise": (DQ.UNRELIABLE_ERROR, np.nan),
    "flat": (DQ.NO_FLAT_FIELD, 1.0),
}

#: References of which every usable pixel needs a value above zero.
_POSITIVE = ("gain", "read_noise", "flat")


def _wanted(name, extension):
    return f"a {name.replace('_', ' ')} reference of CRDS (FITS with {extension})"


def _mismatch(path, name, problem):
    """Return the error that says why a file is no reference for an exposure."""
    return data_error(
        path, f"is no {name.replace('_', ' ')} reference for this exposure: {problem}"
    )


def _header(hdus, path, name, extension, exposure=None):
    """Return the keywords of a reference; one of another kind, detector, filter or read-out is refused."""
    extensions = f"it has {[hdu.name for hdu in hdus]}"
    check_data(
        extension in hdus, path, f"cannot be read as {_wanted(name, extension)}: {extensions}"
    )
    header = joined_header(hdus, extension)
    wanted = {"REFTYPE": TYPES.get(name, name).upper(), "INSTRUME": "MIRI", "DETECTOR": "MIRIMAGE"}
    patterns = _ANY
    if exposure is not None:
        wanted["READPATT"] = exposure.readout
        # references of single frames serve groups that are their means
        patterns = (frame_pattern(exposure.readout),) + _ANY
    if name == "flat" and exposure.filter is not None:
        wanted["FILTER"] = band_label(exposure.filter)
    for key, value in wanted.items():
        keyword_value = keyword_text(header.get, key)
        keyword_value = READOUT_NAMES.get(keyword_value, keyword_value)
        allowed = _ANY
        if key == "READPATT":
            allowed = patterns
        if keyword_value not in (value, *allowed):
            raise _mismatch(path, name, f"its {key} is {keyword_value}, not {value}")
    for key, values in {"NFRAMES": _frame_counts(exposure), "GROUPGAP": (0,)}.items():
        if name in ("reset", "dark") and header.get(key, values[0]) not in values:
            raise _mismatch(path, name, f"its {key} is {header[key]}, not {values[0]}")
    return header


def _frame_counts(exposure):
    """Return the frames in a group of references of groups: those of the exposure, or one."""
    if exposure is None:
        return (1,)
    return (exposure.n_frames, 1)


def _cut(path, name, array, header, exposure):
    """Return the part of a reference, (..., ny, nx), that an exposure sees."""
    part = exposure.aperture
    full = aperture("FULL")
    if all(f"SUBSTRT{axis}" in header for axis in (1, 2)):
        origin = (int(header["SUBSTRT1"]) - 1, int(header["SUBSTRT2"]) - 1)
    elif array.shape[-2:] == full.shape:
        origin = (0, 0)
    elif array.shape[-2:] == part.shape and header_text(header, "SUBARRAY") == part.name:
        origin = part.origin
    else:
        got = f"{array.shape[-2:]} pixels without SUBSTRT1 and SUBSTRT2"
        raise data_error(path, f"does not state which part of the detector it covers: {got}")
    x, y = (
        part_start - map_start for part_start, map_start in zip(part.origin, origin, strict=True)
    )
    ny, nx = part.shape
    if x < 0 or y < 0 or y + ny > array.shape[-2] or x + nx > array.shape[-1]:
        covered = f"{array.shape[-2:]} pixels from column {origin[0] + 1}, row {origin[1] + 1} on"
        raise _mismatch(path, name, f"it covers {covered}, and not {part.name}")
    return array[..., y : y + ny, x : x + nx]


def _flags(path, name, hdus, header, exposure):
    """Return the flags of a reference by the names in its legend, as `DQ`."""
    shape = exposure.shape
    if "DQ" not in hdus or hdus["DQ"].data is None:
        return np.zeros(shape, np.int64)
    stored = hdus["DQ"].data
    # those of groups and integrations together
    stored = np.bitwise_or.reduce(stored.reshape((-1,) + stored.shape[-2:]), axis=0)
    stored = _cut(path, name, stored, header, exposure).astype(np.int64)
    table = None
    if "DQ_DEF" in hdus:
        table = hdus["DQ_DEF"].data
    if table is None or len(table) == 0:
        return stored & 0xFFFFFFFF
    out = np.zeros(shape, np.int64)
    bits = {flag.name: int(flag) for flag in DQ}
    for row in table:
        flag = str(row["NAME"]).strip().upper()
        if flag in bits:
            out[stored & int(row["VALUE"]) != 0] |= bits[flag]
    return out


def _read(path, exposure, name, extension="SCI"):
    """Return the array and flags of a reference."""
    array, flags, _ = _read_with_header(path, exposure, name, extension)
    return array, flags


def _read_with_header(path, exposure, name, extension="SCI"):
    """Return the array, flags and keywords of a reference."""
    wanted = _wanted(name, extension)
    with open_fits(path, wanted=wanted) as hdus:
        header = _header(hdus, path, name, extension, exposure)
        shape = hdus[extension].shape
        check_data(len(shape) >= 2, path, f"cannot be read as {wanted}: {extension} is no image")
        n_bytes = 4 * np.prod(shape[:-2], dtype=float) * np.prod(exposure.shape)
        check_memory(n_bytes, f"the {name} reference {path}", advice="use one with fewer groups")
        array = _cut(path, name, hdus[extension].data, header, exposure)
        array = np.ascontiguousarray(array, np.float32)
        return array, _flags(path, name, hdus, header, exposure), header


def _read_values(path, exposure, name):
    """Return the value of each pixel; those without one are flagged, and not to be used where they need it."""
    values, flags = _read(path, exposure, name)
    flag, options = _VALUES[name]
    bad = ~np.isfinite(values) | ((flags & flag) != 0)
    if name in _POSITIVE:
        bad |= ~(values > 0)
        flags[bad] |= int(DQ.DO_NOT_USE)
    flags[bad] |= int(flag)
    return np.where(bad, np.float32(options), values), flags


def _read_noise(path, exposure):
    """Return the noise of one read, DN: CRDS has that of a difference of two."""
    noise, flags = _read_values(path, exposure, "read_noise")
    return noise / np.float32(np.sqrt(2)), flags


def _read_bias(path, exposure):
    """Return the level of an empty pixel, DN."""
    level, flags = _read(path, exposure, "bias")
    flags[~np.isfinite(level)] |= int(DQ.UNRELIABLE_BIAS)
    return np.nan_to_num(level, posinf=0.0, neginf=0.0), flags


def _read_linearity(path, exposure):
    """Return the coefficients of the polynomial to linear DN; none where the file says so."""
    coef, flags = _read(path, exposure, "linearity", "COEFFS")
    wanted = "must hold coefficients (n, ny, nx) in COEFFS"
    check_data(coef.ndim == 3 and len(coef) >= 2, path, f"{wanted}, got shape {coef.shape}")
    bad = ~np.isfinite(coef).all(axis=0) | ((flags & DQ.NO_LIN_CORR) != 0)
    flags[bad] |= int(DQ.NO_LIN_CORR)
    # as in the pipeline: no correction, and a flag
    coef[:, bad] = 0.0
    coef[1, bad] = 1.0
    return coef, flags


def _read_groups(path, exposure, name):
    """Return the DN of each group, (integrations, groups, ny, nx)."""
    array, flags, header = _read_with_header(path, exposure, name)
    if array.ndim == 3:
        array = array[None]
    wanted = "must hold groups (integrations, groups, ny, nx)"
    check_data(array.ndim == 4, path, f"{wanted}, got shape {array.shape}")
    # what is not known is not subtracted, as in the pipeline
    array = np.nan_to_num(array, copy=False, posinf=0.0, neginf=0.0)
    if exposure.n_frames > header.get("NFRAMES", 1):
        array = _averaged_groups(array, exposure.n_frames, complete=name == "dark")
    return array, flags


def _averaged_groups(array, n_frames, *, complete):
    """
    Return the means of so many frames, (integrations, groups, ny, nx), as the pipeline makes them of a dark.

    A ``complete`` reference has no value beyond its frames, so that a last part of a group is left out; else
    there is no signal in the frames beyond.
    """
    n_int, n_all = array.shape[:2]
    if not complete:
        array = np.pad(array, ((0, 0), (0, -n_all % n_frames), (0, 0), (0, 0)))
    n_groups = array.shape[1] // n_frames
    frames = array[:, : n_groups * n_frames]
    groups = frames.reshape((n_int, n_groups, n_frames) + array.shape[2:])
    return groups.mean(axis=2, dtype=np.float32)


#: Readers of the references of slopes, in the order of their use: each gives values (or None) and flags.
READERS = {
    # flags of bad pixels; there is no other value
    "mask": lambda path, exposure: (None, _read(path, exposure, "mask", "DQ")[1]),
    "saturation": functools.partial(_read_values, name="saturation"),
    "bias": _read_bias,
    "reset": functools.partial(_read_groups, name="reset"),
    "linearity": _read_linearity,
    "dark": functools.partial(_read_groups, name="dark"),
    "gain": functools.partial(_read_values, name="gain"),
    "read_noise": _read_noise,
}

read_flat = functools.partial(_read_values, name="flat")


def read_photom(path, exposure, day):
    """
    Return the MJy/sr per DN/s of the filter and sub-array of an exposure.

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
    conversion, times = photom_row(path, exposure.filter, exposure.subarray)
    problem = "has a conversion that depends on time, and the exposure does not state when"
    check_data(not (times and day is None), path, problem)
    return on_day(conversion, times, day)


def photom_row(path, filter, subarray):
    """Conversion of a filter and sub-array in a photom reference, and the rows of its dependence on time."""
    short = band_label(filter)
    with open_fits(path, wanted=_wanted("photom", "PHOTOM")) as hdus:
        _header(hdus, path, "photom", "PHOTOM")
        rows = hdus["PHOTOM"].data
        columns = (map(str.upper, map(str.strip, rows[key])) for key in ("filter", "subarray"))
        keys = list(zip(*columns, strict=True))
        wanted = [(short, part) for part in (subarray, "GENERIC")]
        key_columns = [keys.index(key) for key in wanted if key in keys]
        check_data(key_columns, path, f"has no row for {short} and {subarray}")
        conversion = float(rows["photmjsr"][key_columns[0]])
        times = {
            name: {key.lower(): float(hdus[name].data[key][key_columns[0]]) for key in hdus[name].data.names
                   if key.lower() not in ("filter", "subarray")}
            for name in ("TIMECOEFF", *_TIMES) if name in hdus and hdus[name].data is not None
        }  # fmt: skip
    problem = f"has no conversion for {short} and {subarray}: {conversion}"
    check_data(np.isfinite(conversion) and conversion > 0, path, problem)
    return conversion, times


def on_day(conversion, times, day):
    """Return a conversion on a day (MJD): the tables of the pipeline divide it, the older one is added."""
    for name, row in times.items():
        if name == "TIMECOEFF":
            conversion += row["amplitude"] * np.exp(-(day - row["t0"]) / row["tau"])
        else:
            conversion /= _TIMES[name](day, **row)
    return float(conversion)


#: Relative response by time, of the tables of a photom reference.
_TIMES = {
    "TIMECOEFF_LINEAR": lambda day, t0, lossperyear: 1 - lossperyear * (day - t0) / 365,
    "TIMECOEFF_EXPONENTIAL": lambda day, t0, amplitude, tau, const: (
        amplitude * np.exp(-(day - t0) / tau) + const
    ),
    "TIMECOEFF_POWERLAW": lambda day, t0, year1value, tsoft, alpha: (
        (day - t0 + tsoft) ** alpha * year1value / (365 + tsoft) ** alpha
    ),
}


def read_variance(read_noise, n_frames, *, rounded):
    """
    Return the variance of the read-out of a group, DN^2: a read, or the mean of several that are independent.

    Parameters
    ----------
    read_noise : float or `~numpy.ndarray`
        Of one read, DN.
    n_frames : int
        Reads of a group.
    rounded : bool
        Whether reads are whole numbers, and their mean too.

    Returns
    -------
    variance : float or `~numpy.ndarray`
    """
    variance = np.square(read_noise)
    if not rounded:
        return variance / n_frames
    # a sum of whole numbers over M is rounded to one of M values
    return (variance + 1 / 12) / n_frames + (1 - 1 / n_frames**2) / 12
