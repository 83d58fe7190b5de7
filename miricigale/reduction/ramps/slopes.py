"""Slopes of the ramps of an exposure: which groups take part, and what is taken off them."""

import dataclasses

import numpy as np

from miricigale.detector import (
    Charge,
    FirstFrame,
    InterpixelCapacitance,
    LastFrame,
    ResetAnomaly,
    ResetDecay,
)
from miricigale.instrument import DQ
from miricigale.reduction.ramps._jwst import fit_steps
from miricigale.reduction.ramps.rampfit import fit_groups
from miricigale.reduction.ramps.reference_pixels import reference_channels, reference_drift
from miricigale.reduction.ramps.settling import note_settling
from miricigale.reduction.ramps.simulated_slopes import draw_groups
from miricigale.reduction.references.detector_model import is_own
from miricigale.utils.exceptions import ReductionWarning, argument_error, data_error, warn

# flags of a ramp's pixels that forbid a slope
_UNUSABLE = DQ.DO_NOT_USE | DQ.NON_SCIENCE | DQ.REFERENCE_PIXEL | DQ.DEAD


def fit_slopes(reducer, ramp, maps, progress_bar=False, *, first=0):
    """
    Fit the ramps of an exposure with a known detector.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Settings.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        Counts in DN; or what was collected, whose slopes are drawn.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector is taken for.
    progress_bar : bool, optional
        Whether a progress bar is shown.
    first : int, optional
        Which integration of the exposure the ramp begins with, from 0.

    Returns
    -------
    fit : `~miricigale.reduction.RampFit`

    Raises
    ------
    ValueError
        If fewer than two groups are left.
    """
    exposure = ramp.exposure
    detector = reducer.detector
    history = ramp.history
    dq = ramp.pixel_dq.astype(np.int64) | maps.pixel_dq
    if not isinstance(ramp, Charge) and ramp.data.dtype.kind in "iu":
        # counts of 0 are of pixels that were not read: the bias is thousands
        unread = np.all((ramp.data[:, 0] == 0) & (ramp.data[:, -1] == 0), axis=0)
        dq[unread] |= DQ.DO_NOT_USE | DQ.DEAD
    reference = (dq & DQ.REFERENCE_PIXEL) != 0
    usable = (dq & _UNUSABLE) == 0
    n_group = exposure.n_groups
    skip_first, skip_last = _skipped(reducer, ramp)
    if skip_first + skip_last > n_group - 2:
        msg = f"at most {n_group - 2} groups together for {n_group} groups"
        raise argument_error("skip_first, skip_last", msg, f"{skip_first}, {skip_last}")
    drift = _anomaly(reducer, ramp, maps, first)
    factor = 1.0
    if shares_charge(reducer, ramp):
        factor = float(np.sum(detector.ipc_kernel**2))
    part = skip_first, n_group - skip_last
    thresholds = reducer.jump_threshold, reducer.ramps.neighbor_threshold
    if reducer.backend == "jwst":
        offsets = np.broadcast_to(drift, (exposure.n_integrations, n_group))
        fit = fit_steps(reducer, ramp, maps, reset=offsets, skipped=(skip_first, skip_last))
    elif isinstance(ramp, Charge):
        fit = draw_groups(
            ramp, maps, drift, usable, part, thresholds=thresholds, poisson_factor=factor
        )
    else:
        if "jump" in history.steps:
            # the pipeline found them, and flags of groups mark them
            thresholds = None, None
        fit = fit_groups(
            ramp.data,
            maps,
            group_time=ramp.group_time,
            n_frames=exposure.n_frames,
            drift=_drift(reducer, ramp, maps, reference, drift),
            usable=usable,
            group_dq=_group_flags(ramp, usable),
            first_group=part[0],
            last_group=part[1],
            jump_threshold=thresholds[0],
            neighbor_threshold=thresholds[1],
            shower_threshold=reducer.ramps.shower_threshold,
            poisson_factor=factor,
            n_threads=reducer.n_threads,
            progress_bar=progress_bar,
        )
    fit.flags[...] |= dq
    fit.rate[...] -= np.float32(maps.dark_rate)
    fit.flags[~usable] |= int(DQ.DO_NOT_USE)
    if history.simulated:
        # it is known what acted
        return fit
    return dataclasses.replace(fit, settling=note_settling(ramp, maps, skip_first, fit.flags))


def _group_flags(ramp, usable):
    """Flags of groups for the fit, with raw counts of 0 among those that are not used; None for none."""
    group_dq = ramp.group_dq
    if ramp.history.simulated and not ramp.history.steps:
        # the truth, until a pipeline has found its own
        group_dq = None
    if ramp.data.dtype.kind not in "iu":
        return group_dq
    # at the floor of the converter, as groups that were lost are
    at_floor = (ramp.data == 0) & usable
    if not at_floor.any():
        return group_dq
    lost = np.count_nonzero(at_floor.sum(axis=(2, 3)) > 0.5 * np.count_nonzero(usable))
    if lost:
        n_groups = at_floor.shape[0] * at_floor.shape[1]
        text = f"{lost} of {n_groups} groups have 0 DN in most pixels and are left out"
        warn(f"{ramp.meta.get('filename', 'the ramp')}: {text}", ReductionWarning)
    floor = np.uint8(DQ.AD_FLOOR | DQ.DO_NOT_USE)
    if group_dq is None:
        group_dq = np.zeros(ramp.data.shape, np.uint8)
    return np.where(at_floor, group_dq | floor, group_dq).astype(np.uint8)


def shares_charge(reducer, ramp):
    """
    Tell whether the charge of a ramp was coupled between neighbors.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Its ``ramps.ipc`` decides, or without it what the ramp says.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        What was exposed.

    Returns
    -------
    shares : bool
    """
    if reducer.ramps.ipc is not None:
        return bool(reducer.ramps.ipc)
    acted = ramp.shows(InterpixelCapacitance)
    if acted is None:
        return is_own(reducer, ramp.history)
    return acted


def _skipped(reducer, ramp):
    """Return the groups left out at the start and the end of the integrations of a ramp."""
    n_group = ramp.exposure.n_groups
    steps = ramp.history.steps
    first = reducer.skip_first
    last = reducer.skip_last
    if first is None:
        done = {"firstframe", "rscd"} & steps
        first = int(ramp.shows(FirstFrame) is not False and n_group > 3 and not done)
    if last is None:
        done = "lastframe" in steps
        last = int(ramp.shows(LastFrame) is not False and n_group > 2 and not done)
    return first, last


def _drift(reducer, ramp, maps, reference, drift):
    """
    Add the drift of the reference pixels to an offset of each group.

    It is measured after reset anomaly and dark, in the order of the official pipeline for MIRI: a dark with
    signal in the reference columns would be subtracted from the others twice.
    """
    how = reducer.ramps.reference_correction
    if how is None:
        how = ramp.history.simulated or (ramp.exposure.subarray == "FULL" and "channels")
    if not how or "refpix" in ramp.history.steps:
        return drift
    offsets = [
        reference_map for reference_map in (maps.reset, maps.dark) if reference_map is not None
    ]
    if how != "channels":
        return drift + _finite(reference_drift(ramp.data, reference, offsets), ramp)
    origin = ramp.exposure.aperture.origin
    channels = reference_channels(ramp.data, reference, origin=origin, offsets=offsets)
    _finite(channels, ramp)
    return np.broadcast_to(drift, ramp.shape[:2])[:, :, None, None] + channels


def _finite(drift, ramp):
    """Refuse a drift of reference pixels that are not finite."""
    if not np.isfinite(drift).all():
        path = ramp.meta.get("filename", "the ramp")
        problem = "has values that are not finite in the reference columns of SCI"
        raise data_error(path, f"{problem}: reference_correction=False leaves them out of account")
    return drift


def _anomaly(reducer, ramp, maps, first):
    """Return the offset of each group after a reset, DN, in addition to that of the references."""
    exposure = ramp.exposure
    anomaly = reducer.reset_anomaly
    problems = []
    if ramp.shows(ResetDecay) and exposure.n_integrations > 1:
        problems.append(("a decay after the resets between integrations", ""))
    if anomaly is None and maps.reset is None and ramp.shows(ResetAnomaly):
        problems.append(("a reset anomaly", "'reset_anomaly', or "))
    for problem, remedy in problems if reducer.skip_first is None else ():
        warn(
            f"the ramp shows {problem} that this Reducer leaves in: "
            f"give it {remedy}'skip_first' groups to be left out",
            ReductionWarning,
        )
    if anomaly is None:
        return 0.0
    # of each frame, and then the means of groups
    shape = (exposure.n_integrations, exposure.n_groups, exposure.n_frames)
    offsets = anomaly.offsets(first + shape[0], shape[1] * shape[2])[first:]
    return offsets.reshape(shape).mean(axis=2)
