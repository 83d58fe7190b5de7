"""What a `Reducer` takes the detector of an exposure for: its own constants, or reference files."""

import numpy as np
from astropy.time import Time
from scipy.ndimage import convolve

from miricigale.detector import Charge, Ramp
from miricigale.instrument import Exposure, ImageFacts, flat_field, photmjsr
from miricigale.reduction.reference_maps import read_flat, read_photom
from miricigale.reduction.references import BRIGHTNESS, SLOPES, STEP_OF, needed, own_maps
from miricigale.utils.exceptions import ReferenceWarning, argument_error, warn

_OWN = "of the simulated detector"


def is_own(reducer, ramp):
    """
    Whether the constants of the simulated detector are those of a ramp.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Its ``references`` decide, or without them who made the ramp.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        What was exposed.

    Returns
    -------
    own : bool
    """
    if reducer.references is not None:
        return reducer.references == "simulated"
    return isinstance(ramp, Charge) or ramp.simulated


def maps_of(reducer, ramp):
    """
    What the detector of a ramp is taken for.

    Parameters are those of `is_own`.

    Returns
    -------
    maps : `~miricigale.reduction.DetectorMaps`

    Raises
    ------
    ValueError
        If it is no ramp, there are no references for it, or another detector made it.
    """
    if not isinstance(ramp, (Ramp, Charge)):
        raise argument_error("ramp", "a Ramp or a Charge", type(ramp).__name__)
    if is_own(reducer, ramp):
        stated = reducer.references is not None or reducer.properties is not None
        if not stated and ramp.properties not in (None, reducer.detector):
            msg = (
                f"the ramp was made by another detector than miri_detector(), {ramp.properties}: "
                "give 'references' or 'properties' (references='simulated' takes it for miri_detector())"
            )
            raise ValueError(msg)
        return own_maps(reducer.detector, _steps_of(ramp))
    if isinstance(ramp, Charge):
        wanted = "None or 'simulated' for a Charge, which has no counts"
        raise argument_error("references", wanted, repr(reducer.references))
    files = needed(reducer.references, ramp.header, ramp.steps, names=SLOPES, what="slopes")
    return files.maps(ramp)


def history_of(reducer, ramp, maps):
    """
    What the header of a rate says of its references and steps.

    Parameters
    ----------
    reducer, ramp
        As for `is_own`.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector was taken for.

    Returns
    -------
    meta : dict
        ``simulated``, ``reference_<name>`` for each reference and, of ramps whose references are files,
        ``steps`` and ``day`` (MJD).
    """
    meta = {f"reference_{name}": text for name, text in maps.used.items()}
    if is_own(reducer, ramp):
        done = {"steps": sorted({*_steps_of(ramp), "ramp_fit"})} if _steps_of(ramp) else {}
        return {"simulated": True, **meta, **done}
    used = {STEP_OF.get(name) for name, text in maps.used.items() if text != "none"}
    meta["steps"] = sorted((used - {None}) | set(ramp.steps) | {"ramp_fit"})
    if (day := middle_of(ramp.header)) is not None:
        meta["day"] = day
    return {"simulated": False, **meta}


def _steps_of(ramp):
    """What another pipeline has done to a ramp."""
    return getattr(ramp, "steps", frozenset())


def brightness_of(reducer, rate):
    """
    What turns slopes into surface brightness.

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
    if reducer.references == "simulated" or (reducer.references is None and facts.simulated):
        detector, flattened = reducer.detector, "flat" in facts.steps
        flat = flat_field(facts.filter, subarray=facts.subarray)
        if facts.ipc:
            # blurred as the image is: a uniform sky comes out uniform
            flat = convolve(flat, np.asarray(detector.ipc_kernel, np.float32), mode="nearest")
        values = {
            "dark": 0.0 if "dark" in facts.steps else detector.dark_current / detector.gain,
            "flat": 1.0 if flattened else flat,
            "conversion": photmjsr(facts.filter, gain=detector.gain)
            / detector.relative_response(facts.filter, facts.subarray),
        }
        flat = "done before" if flattened else f"flat field {_OWN}"
        used = {"flat": flat, "photom": f"conversion {_OWN}"}
        return values, {f"reference_{name}": text for name, text in used.items()}
    exposure = Exposure(
        facts.filter if facts.filter.startswith("miri.") else f"miri.{facts.band}",
        readout=rate.meta.get("readout", "FASTR1"),
        n_groups=2,
        subarray=facts.subarray,
        pointing=None,
        roll=None,
    )
    what, header = "surface brightness", _header(exposure, facts.day)
    files = needed(reducer.references, header, facts.steps, names=BRIGHTNESS, what=what)
    if files.photom is None:
        raise argument_error("references", f"given with 'photom' for {what}", "none")
    flat, flags, used = 1.0, None, {"flat": "none", "photom": files.photom.name}
    if "flat" in facts.steps:
        used["flat"] = "done before"
    elif files.flat is not None:
        flat, flags = read_flat(files.flat, exposure)
        used["flat"] = files.flat.name
    if "dark" not in facts.steps:
        msg = "the dark current is in the slopes still: it becomes a part of the background"
        warn(msg, ReferenceWarning)
    conversion = read_photom(files.photom, exposure, facts.day)
    values = {"dark": 0.0, "flat": flat, "conversion": conversion, "flags": flags}
    meta = {f"reference_{name}": text for name, text in used.items()}
    done = {"photom"} if used["flat"] == "none" else {"photom", "flat"}
    meta["steps"] = sorted(done | set(facts.steps))
    return values, meta


def _header(exposure, day):
    """Keywords by which references of a rate are found."""
    header = {
        "DETECTOR": "MIRIMAGE",
        "EXP_TYPE": "MIR_IMAGE",
        "FILTER": exposure.filter.rpartition(".")[2].upper(),
        "SUBARRAY": exposure.subarray,
        "READPATT": exposure.readout,
    }
    if day is not None:
        header["DATE-OBS"], header["TIME-OBS"] = Time(day, format="mjd").isot.split("T")
    return header


def middle_of(header):
    """Middle of an exposure (MJD), or its start where that is all that is known."""
    for name in ("EXPMID", "EXPSTART"):
        if np.isfinite(day := float(header.get(name) or np.nan)):
            return day
    try:
        start = Time(f"{header['DATE-OBS']}T{header.get('TIME-OBS', '00:00:00')}", scale="utc")
    except (KeyError, ValueError):
        return None
    return float(start.mjd)
