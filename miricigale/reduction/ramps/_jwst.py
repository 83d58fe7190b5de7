"""Slopes by the steps of the official pipeline (``jwst``), from the same ramps and references."""

import tempfile
import warnings
from pathlib import Path

import numpy as np
from numpy.polynomial import Polynomial

from miricigale.detector import Ramp
from miricigale.instrument import DQ
from miricigale.reduction.ramps.rampfit import fit_result
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.optional_packages import require

#: Gain that stands for none: no photon noise.
_NO_NOISE = 1e12


def fit_steps(reducer, ramp, maps, *, reset, skipped):
    """
    Fit the ramps of an exposure by saturation, reset, linearity, dark, refpix, jump and ramp_fit.

    Parameters
    ----------
    reducer : `~miricigale.reduction.Reducer`
        Settings: thresholds of jumps, correction by reference pixels (the pipeline's own, or none).
    ramp : `~miricigale.detector.Ramp`
        Level 1b.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector is taken for; given to the steps as their references.
    reset : `~numpy.ndarray`, shape (n_int, n_group)
        Offset of each group after a reset, DN, beside that of ``maps``.
    skipped : tuple of int
        Groups left out at the start and the end of integrations.

    Returns
    -------
    fit : `~miricigale.reduction.RampFit`
        The pipeline does not state the significance of jumps: NaN. ``n_used`` counts differences of
        groups without a flag.

    Raises
    ------
    ImportError
        If the pipeline is not installed.
    ValueError
        If the ramp is not level 1b, or the references cannot be the pipeline's.

    Notes
    -----
    The steps run at their defaults but for what the settings say. Slow noise of the read-out and shared
    charge (``ipc``) are not known to them.
    """
    require("jwst", extra="jwst")
    if not isinstance(ramp, Ramp) or ramp.history.steps or ramp.data.dtype != np.uint16:
        raise argument_error("ramp", "a ramp of level 1b with backend='jwst'", repr(ramp))
    from jwst.dark_current import DarkCurrentStep
    from jwst.jump import JumpStep
    from jwst.linearity import LinearityStep
    from jwst.ramp_fitting import RampFitStep
    from jwst.refpix import RefPixStep
    from jwst.reset import ResetStep
    from jwst.saturation import SaturationStep
    from stdatamodels.jwst import datamodels

    models = _References(ramp, maps, datamodels)
    steps = [(SaturationStep, {}, {"saturation": models.saturation(), "superbias": "N/A"})]
    if maps.reset is not None or np.any(reset):
        steps.append((ResetStep, {}, {"reset": models.reset(reset)}))
    if len(maps.linearity) > 2 or np.any(np.asarray(maps.linearity)[0] != 0):
        steps.append((LinearityStep, {}, {"linearity": models.linearity()}))
    if maps.dark is not None:
        steps.append((DarkCurrentStep, {}, {"dark": models.dark()}))
    if reducer.ramps.reference_correction is not False:
        steps.append((RefPixStep, {}, {"refpix": "N/A", "sirskernel": "N/A"}))
    noise = {"gain": models.gain(), "readnoise": models.read_noise()}
    if reducer.jump_threshold is not None:
        limits = ("", "three_group_", "four_group_")
        options = {f"{name}rejection_threshold": reducer.jump_threshold for name in limits}
        options["flag_4_neighbors"] = reducer.ramps.neighbor_threshold is not None
        if reducer.ramps.neighbor_threshold is not None:
            options["min_jump_to_flag_neighbors"] = reducer.ramps.neighbor_threshold
        steps.append((JumpStep, options, noise))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        # the models speak of optional keywords that no step reads
        warnings.simplefilter("ignore")
        path = ramp.write(Path(folder) / "ramp_uncal.fits")
        with datamodels.RampModel(str(path)) as model:
            dq = ramp.pixel_dq.astype(np.int64) | maps.pixel_dq
            model.pixeldq = (dq & 0xFFFFFFFF).astype(np.uint32)
            model.groupdq = np.zeros(ramp.shape, np.uint8)
            first = skipped[0]
            last = ramp.shape[1] - skipped[1]
            model.groupdq[:, :first] |= np.uint8(DQ.DO_NOT_USE)
            model.groupdq[:, last:] |= np.uint8(DQ.DO_NOT_USE)
            for kind, options, references in steps:
                model = _run(kind, model, options, references)
            groups = np.array(model.groupdq)
            rate, _ = _run(RampFitStep, model, {}, noise)
            planes = [np.array(getattr(rate, n)) for n in ("data", "var_poisson", "var_rnoise")]
            flags = np.array(rate.dq).astype(np.int64)
    return _result(planes, flags, groups, first, last)


def _run(kind, model, options, references):
    """Run a step with settings and references of its own; ``run`` would ask CRDS for its context."""
    step = kind(**options)
    for name, value in references.items():
        setattr(step, f"override_{name}", value)
    return step.process(model)


def _result(planes, flags, groups, first, last):
    """Return a `RampFit` of the pipeline's planes and flags of groups."""
    rate, var_poisson, var_read = (plane.astype(np.float32) for plane in planes)
    unusable = (flags & int(DQ.DO_NOT_USE)) != 0
    for plane in (rate, var_poisson, var_read):
        plane[unusable] = np.nan
    bad = np.uint8(DQ.DO_NOT_USE | DQ.SATURATED)
    jumped = (groups & np.uint8(DQ.JUMP_DET)) != 0
    good = (groups & bad) == 0
    n_used = (good[:, 1:] & good[:, :-1] & ~jumped[:, 1:]).sum(axis=(0, 1)).astype(np.int16)
    jumped &= good
    jumped[:, : first + 1] = jumped[:, last:] = False
    k, g, y, x = np.nonzero(jumped)
    # differences are counted from the first group that takes part
    events = np.stack([y, x, k, g - first - 1, nans(k.size)], axis=1)
    number = jumped.sum(axis=(0, 1)).astype(np.int16)
    return fit_result(rate, var_poisson, var_read, n_used, number, flags, events, first)


class _References:
    """Reference models of the pipeline, from the maps of a detector."""

    def __init__(self, ramp, maps, datamodels):
        self._exposure = ramp.exposure
        self._maps = maps
        self._kinds = datamodels
        self._shape = ramp.shape[2:]

    def _model(self, kind, **arrays):
        model = getattr(self._kinds, kind)(**arrays)
        part = self._exposure.aperture
        ny, nx = self._shape
        meta = {
            "name": self._exposure.subarray, "xstart": part.origin[0] + 1, "ystart": part.origin[1] + 1,
            "xsize": nx, "ysize": ny, "fastaxis": 1, "slowaxis": 2,
        }  # fmt: skip
        for name, value in meta.items():
            setattr(model.meta.subarray, name, value)
        model.meta.instrument.name = "MIRI"
        model.meta.instrument.detector = "MIRIMAGE"
        model.meta.description = "what miricigale takes the detector for"
        return model

    def _full(self, values):
        return np.broadcast_to(np.asarray(values, np.float32), self._shape).copy()

    def _good(self):
        return np.zeros(self._shape, np.uint32)

    def saturation(self):
        limit = np.minimum(self._full(self._maps.saturation), 2.0**16 - 1)
        return self._model("SaturationModel", data=limit, dq=self._good())

    def gain(self):
        gain = np.minimum(self._full(self._maps.gain), _NO_NOISE)
        return self._model("GainModel", data=gain)

    def read_noise(self):
        # that of a difference of two reads, with the rounding of each
        variance = 2 * (np.square(self._full(self._maps.read_noise)) + 1 / 12)
        return self._model("ReadnoiseModel", data=np.sqrt(variance))

    def linearity(self):
        coefficients = np.asarray(self._maps.linearity, float)
        bias = self._maps.bias
        if np.any(np.asarray(bias) != 0):
            if coefficients.ndim != 1 or np.ndim(bias):
                raise argument_error(
                    "references",
                    "with one bias and one polynomial for all pixels, or no bias, for the pipeline",
                    "maps of both",
                )
            # the pipeline's polynomial is one of raw DN
            shift = Polynomial([-float(bias), 1.0])
            coefficients = (Polynomial(coefficients)(shift) + float(bias)).coef
        if coefficients.ndim == 1:
            coefficients = coefficients[:, None, None]
        shape = (len(coefficients), *self._shape)
        planes = np.broadcast_to(coefficients, shape).astype(np.float32)
        return self._model("LinearityModel", coeffs=planes, dq=self._good())

    def reset(self, offsets):
        """Return the anomaly of each group and integration, of references and settings together."""
        reset_map = self._maps.reset
        n_int, n_group = offsets.shape
        total = np.zeros((n_int, n_group, *self._shape), np.float32)
        total += offsets[:, :, None, None].astype(np.float32)
        if reset_map is not None:
            n_groups = min(reset_map.shape[1], n_group)
            for k in range(n_int):
                total[k, :n_groups] += np.nan_to_num(
                    reset_map[min(k, len(reset_map) - 1), :n_groups]
                )
        return self._timed("ResetModel", total, self._good())

    def dark(self):
        dark = np.nan_to_num(self._maps.dark).astype(np.float32)
        model = self._timed("DarkMIRIModel", dark, np.zeros((1, 1, *self._shape), np.uint32))
        model.meta.exposure.average_dark_current = 0.0
        return model

    def _timed(self, kind, data, dq):
        model = self._model(kind, data=data)
        model.dq = dq
        exposure = model.meta.exposure
        exposure.readpatt = self._exposure.readout
        exposure.nframes = self._exposure.n_frames
        exposure.groupgap = 0
        exposure.nints, exposure.ngroups = data.shape[:2]
        return model
