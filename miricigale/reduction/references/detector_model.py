"""What a `Reducer` takes the detector of an exposure for: its own constants, or reference files."""

import numpy as np
from astropy.time import Time
from scipy.ndimage import convolve

from miricigale.detector import Charge, Ramp
from miricigale.filters.band_names import band_label
from miricigale.instrument import (
    REFERENCES,
    Exposure,
    ExposureHistory,
    ImageFacts,
    flat_field,
    imager_filters,
    photmjsr,
    subarrays,
)
from miricigale.reduction.references.reference_maps import (
    on_day,
    photom_row,
    read_flat,
    read_photom,
)
from miricigale.reduction.references.references import BRIGHTNESS, SLOPES, needed, own_maps
from miricigale.utils.exceptions import ReferenceWarning, warn
from miricigale.utils.options import check_that, check_type

#: Signal over that in the full frame: Gordon et al. 2025, AJ 169, 6, as in the script that makes their photom
#: references (STScI-MIRI/ImagingFluxCal, create_photom_reffile.py).
_PARTS = {"FULL": 1.0, "BRIGHTSKY": 1.005, "SUB256": 0.98, "SUB128": 1.0, "SUB64": 0.966}


def imager_response(photom=None, *, date=None):
    """
    Count rates by filter and sub-array on a day, over those of the full frame at the start of the mission.

    Parameters
    ----------
    photom : path-like, optional
        A photom reference of CRDS (``jwst_miri_photom_*.fits``) with the coefficients of the loss; without it
        the response is that of the sub-arrays alone.
    date : `~astropy.time.Time` or str, optional
        Day, such as ``"2026-11-26"``; needed with ``photom``.

    Returns
    -------
    response : tuple of (str, str, float)
        Filter, sub-array, and factor, for ``DetectorProperties(response=...)``.

    Raises
    ------
    ValueError
        If only one of ``photom`` and ``date`` is given.
    `~miricigale.utils.exceptions.DataError`
        If the file is no such reference, or lacks a filter or sub-array.

    Notes
    -----
    The loss is the conversion on the first day of the coefficients (t0) over that on ``date``; it is as the
    pipeline has it: exponential, linear and power-law tables multiplied. The package has no coefficients of its
    own. F2550W lost about 21 % in the first year, shorter bands less.

    References
    ----------
    Gordon et al. 2025, AJ, 169, 6.

    Examples
    --------
    >>> from miricigale.depth import sensitivity
    >>> from miricigale.instrument import miri_detector
    >>> from miricigale.reduction import imager_response
    >>> response = imager_response("jwst_miri_photom.fits", date="2026-11-26")  # doctest: +SKIP
    >>> detector = miri_detector().replace(response=response)  # doctest: +SKIP
    >>> print(sensitivity("F2550W", detector=detector))  # doctest: +SKIP
    >>> miri_detector().replace(response=imager_response()).relative_response("miri.f770w", "SUB64")
    0.966
    """
    wanted = "both given, or neither"
    check_that(bool(photom) == bool(date), "photom, date", wanted, f"{photom!r}, {date!r}")
    if not photom:
        return tuple((name, *row) for name in imager_filters() for row in _PARTS.items())
    day = Time(date).mjd
    responses = []
    for name in imager_filters():
        conversion, times = photom_row(photom, name, "FULL")
        start = min((row["t0"] for row in times.values()), default=day)
        first = on_day(conversion, times, start)
        for part in subarrays():
            responses.append((name, part, first / on_day(*photom_row(photom, name, part), day)))
    return tuple(responses)


_OWN = "of the simulated detector"
_OTHER = (
    "it was made by another detector than miri_detector(), {}: give 'references' or 'properties' "
    "(references='simulated' takes it for miri_detector())"
)


def is_own(reducer, history):
    """
    Tell whether the constants of the simulated detector are those of an exposure.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Its ``references`` decide, or without them who made the exposure.
    history : `~miricigale.instrument.ExposureHistory`
        Of the exposure.

    Returns
    -------
    own : bool

    Raises
    ------
    ValueError
        If the history says that another detector made it than that of the reducer.
    """
    if reducer.references is not None:
        return reducer.references == "simulated"
    differs = history.gain is not None and history.gain != reducer.detector.gain
    if history.simulated and reducer.properties is None and differs:
        raise ValueError(_OTHER.format(f"one with a gain of {history.gain:g} e-/DN"))
    return history.simulated


def maps_of(reducer, ramp):
    """
    Return what the detector of a ramp is taken for.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        With references.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        What was exposed.

    Returns
    -------
    maps : `~miricigale.reduction.DetectorMaps`

    Raises
    ------
    ValueError
        If it is no ramp, there are no references for it, or another detector made it.
    """
    check_type(ramp, "ramp", (Ramp, Charge), "a Ramp or a Charge")
    history = ramp.history
    if is_own(reducer, history):
        has_references = reducer.references is not None or reducer.properties is not None
        if not has_references and ramp.properties not in (None, reducer.detector):
            raise ValueError(_OTHER.format(ramp.properties))
        return own_maps(reducer.detector, ramp)
    wanted = "None or 'simulated' for a Charge, which has no counts"
    check_that(not isinstance(ramp, Charge), "references", wanted, repr(reducer.references))
    files = needed(reducer.references, ramp.header, history, names=SLOPES, product="slopes")
    return files.maps(ramp)


def history_of(reducer, ramp, maps):
    """
    Return the history of the slopes of a ramp.

    Parameters
    ----------
    reducer, ramp
        As for `maps_of`.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector was taken for.

    Returns
    -------
    history : `~miricigale.instrument.ExposureHistory`
    """
    before = ramp.history
    simulated = is_own(reducer, before)
    names = {name for name, text in maps.used.items() if text != "none" and name in REFERENCES}
    # the own bias is a part of the own linearity
    steps = {REFERENCES[name] for name in names} - ({"superbias"} if simulated else set()) - {None}
    return before.replace(
        origin="simulated" if simulated else "other",
        steps=before.steps | steps | {"ramp_fit"},
        references=maps.used,
        gain=float(np.median(maps.gain)),
    )


def brightness_of(reducer, rate):
    """
    Return what turns slopes into surface brightness.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        With references.
    rate : `~astropy.nddata.CCDData`
        With filter and sub-array in its meta dictionary.

    Returns
    -------
    values : dict
        Arguments of `~miricigale.reduction.calibrate`.
    meta : dict
        Where they come from, for the header.

    Raises
    ------
    ValueError
        If there are no references for it.
    """
    facts = ImageFacts.of(rate)
    history = ExposureHistory.of(rate)
    flattened = history.done("flat")
    if is_own(reducer, history):
        detector = reducer.detector
        flat = flat_field(facts.filter, subarray=facts.subarray)
        if facts.ipc:
            # blurred as the image is: a uniform sky comes out uniform
            flat = convolve(flat, np.asarray(detector.ipc_kernel, np.float32), mode="nearest")
        values = {
            "flat": 1.0 if flattened else flat,
            "conversion": photmjsr(facts.filter, gain=detector.gain)
            / detector.relative_response(facts.filter, facts.subarray),
        }
        flat = "done before"
        if not flattened:
            flat = f"flat field {_OWN}"
        reference_names = {"flat": flat, "photom": f"conversion {_OWN}"}
    else:
        values, reference_names = _from_files(reducer, rate, facts, history)
    if not history.done("dark"):
        msg = "nothing says that the dark current was taken out of the slopes: it becomes a part of the background"
        warn(msg, ReferenceWarning)
    if reference_names["flat"] == "none":
        steps = {"photom"}
    else:
        steps = {"photom", "flat"}
    references = {**history.references, **reference_names}
    return values, history.replace(steps=history.steps | steps, references=references).meta()


def _from_files(reducer, rate, facts, history):
    """Return the flat field, conversion and flags of reference files, and their names."""
    exposure = Exposure(
        facts.filter if facts.filter.startswith("miri.") else f"miri.{facts.band}",
        readout=rate.meta.get("readout", "FASTR1"),
        n_groups=2,
        subarray=facts.subarray,
        pointing=None,
        roll=None,
    )
    quantity = "surface brightness"
    header = _header(exposure, history.day)
    files = needed(reducer.references, header, history, names=BRIGHTNESS, product=quantity)
    check_that(
        files.photom is not None, "references", f"given with 'photom' for {quantity}", "none"
    )
    flat = 1.0
    flags = None
    references = {"flat": "none", "photom": files.photom.name}
    if history.done("flat"):
        references["flat"] = "done before"
    elif files.flat is not None:
        flat, flags = read_flat(files.flat, exposure)
        references["flat"] = files.flat.name
    conversion = read_photom(files.photom, exposure, history.day)
    return {"flat": flat, "conversion": conversion, "flags": flags}, references


def _header(exposure, day):
    """Return the keywords by which references of a rate are found."""
    header = {
        "DETECTOR": "MIRIMAGE", "EXP_TYPE": "MIR_IMAGE", "FILTER": band_label(exposure.filter),
        "SUBARRAY": exposure.subarray, "READPATT": exposure.readout,
    }  # fmt: skip
    if day is not None:
        header["DATE-OBS"], header["TIME-OBS"] = Time(day, format="mjd").isot.split("T")
    return header
