"""Which reference files a reduction uses: named, and read into maps of the detector."""

import dataclasses
import numbers
from pathlib import Path

import numpy as np

from miricigale.instrument import (
    DQ,
    REFERENCES,
    ExposureHistory,
    bad_pixel_mask,
    reference_pixel_mask,
)
from miricigale.reduction.references.measured_noise import measure_noise
from miricigale.reduction.references.reference_maps import READERS
from miricigale.utils.exceptions import ReferenceWarning, argument_error, data_error, warn
from miricigale.utils.files import is_path
from miricigale.utils.named_values import without
from miricigale.utils.options import check_that

#: What slopes need, and what surface brightness needs beside them.
SLOPES = ("mask", "saturation", "linearity", "dark", "gain", "read_noise")
BRIGHTNESS = ("flat", "photom")

#: References that may be numbers instead of files, with their units.
_NUMBERS = {"gain": "e-/DN", "read_noise": "DN", "bias": "DN", "saturation": "DN"}

#: Fraction of the simulated detector's saturation from which groups are left out.
_SATURATION = 0.98

#: References that may be measured on the ramp itself.
_MEASURED = ("gain", "read_noise")


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorMaps:
    """
    What the reduction of a ramp takes the detector for.

    Numbers hold for all pixels; maps have one value for each.

    Parameters
    ----------
    gain, read_noise, bias, saturation : float or `~numpy.ndarray`, shape (ny, nx)
        Electrons per DN; DN of one read; DN of an empty pixel; raw DN.
    slow_noise : float or `~numpy.ndarray`, shape (ny, nx)
        DN that the read-out adds from one group to the next, a random walk.
    linearity : tuple of float or `~numpy.ndarray`, shape (n, ny, nx)
        Polynomial, lowest power first, from DN above the bias to linear DN.
    reset, dark : `~numpy.ndarray` or None
        DN of each group, (integrations, groups, ny, nx).
    pixel_dq : `~numpy.ndarray` of int64, shape (ny, nx), or int
        Flags of pixels, bits as in `~miricigale.instrument.DQ`.
    dark_rate : float
        DN/s that are taken off the slopes.
    used : dict of str to str
        The file or the constant that each came from, by the names of `ReferenceFiles`.

    Examples
    --------
    >>> from miricigale.reduction import DetectorMaps
    >>> maps = DetectorMaps(gain=4.0, read_noise=6.0, bias=11000.0)
    >>> maps.gain, maps.linearity
    (4.0, (0.0, 1.0))
    """

    gain: object
    read_noise: object
    slow_noise: object = 0.0
    bias: object = 0.0
    saturation: object = np.inf
    linearity: object = (0.0, 1.0)
    reset: np.ndarray | None = None
    dark: np.ndarray | None = None
    pixel_dq: object = 0
    dark_rate: float = 0.0
    used: dict = dataclasses.field(default_factory=dict)

    def integration(self, number):
        """
        Return the maps for one integration alone.

        Parameters
        ----------
        number : int
            From 0.

        Returns
        -------
        maps : `DetectorMaps`
        """
        parts = {}
        for name in ("reset", "dark"):
            if (array := getattr(self, name)) is not None:
                k = min(number, len(array) - 1)
                parts[name] = array[k : k + 1]
        return dataclasses.replace(self, **parts)


def own_maps(properties, ramp):
    """
    Return the package's own detector, for ramps that it simulated or that are taken for such.

    Parameters
    ----------
    properties : `~miricigale.instrument.DetectorProperties`
        Of the detector.
    ramp : `~miricigale.detector.Ramp` or `~miricigale.detector.Charge`
        What another pipeline has done to it is not done again; its flags have the bad pixels if its history
        is known.

    Returns
    -------
    maps : `DetectorMaps`
    """
    history = ramp.history
    part = {"subarray": ramp.exposure.subarray}
    origin = "of the simulated detector"
    limit = properties.bias + _SATURATION * properties.saturation_dn
    sources = {
        "mask": f"bad and reference pixels {origin}",
        "saturation": f"{limit:.8g} DN {origin}",
        "bias": f"{properties.bias:.8g} DN {origin}",
        "linearity": f"{', '.join(f'{c:.4g}' for c in properties.nonlinearity)} {origin}",
        "dark": f"{properties.dark_current:.4g} e-/s {origin}, off the slopes",
        "gain": f"{properties.gain:.6g} e-/DN {origin}",
        "read_noise": f"{properties.read_noise:.6g} DN {origin}",
    }
    values = {"bias": properties.bias, "saturation": limit, "linearity": properties.nonlinearity}
    done = {name for name in sources if history.done(name)}
    if "dark" not in done:
        values["dark_rate"] = properties.dark_current / properties.gain
    if not history.simulated and "mask" not in done:
        masks = (bad_pixel_mask, DQ.DO_NOT_USE), (reference_pixel_mask, DQ.REFERENCE_PIXEL)
        values["pixel_dq"] = sum(mask(**part) * np.int64(flag) for mask, flag in masks)
    sources |= dict.fromkeys(done, "done before")
    values = without(values, done)
    return DetectorMaps(
        gain=properties.gain, read_noise=properties.read_noise, **values, used=sources
    )


def needed(references, header, history, *, names, product):
    """
    Return the reference files for one exposure, complete or with a warning.

    Parameters
    ----------
    references : `ReferenceFiles`, `~miricigale.reduction.ReferenceCache`, "none" or None
        As a `~miricigale.reduction.Reducer` has them.
    header : mapping
        Keywords of the exposure.
    history : `~miricigale.instrument.ExposureHistory`
        Of the exposure.
    names : tuple of str
        References that are needed.
    product : str
        What they are needed for, for messages.

    Returns
    -------
    references : `ReferenceFiles`

    Raises
    ------
    ValueError
        If there are none, or some are missing and that is not allowed.

    Warns
    -----
    `~miricigale.utils.exceptions.ReferenceWarning`
        If some are missing and that is allowed.
    """
    if references is None:
        lacks = ", ".join(ReferenceFiles().missing(history, names=names))
        reason = f"the package's Detector did not simulate (needed: {lacks})"
        if history.origin == "unrecorded":
            reason = "the package simulated (ORIGIN), with a detector that its file does not state any more"
        msg = (
            f"'references' must be given for {product} of an exposure that {reason}: ReferenceFiles, a "
            "ReferenceCache, 'simulated' for miri_detector(), or 'none' for slopes in DN/s without corrections"
        )
        raise ValueError(msg)
    if isinstance(references, str):
        references = ReferenceFiles(gain="measured", read_noise="measured", incomplete=True)
    elif not isinstance(references, ReferenceFiles):
        references = references.find(header)
    missing = references.missing(history, names=names)
    if missing and not references.incomplete:
        wanted = f"complete for {product} (or incomplete=True, to do without)"
        raise argument_error("references", wanted, f"none for {', '.join(missing)}")
    if missing:
        msg = f"{product} without references for {', '.join(missing)}: these steps are left out"
        warn(msg, ReferenceWarning)
    return references


@dataclasses.dataclass(frozen=True, kw_only=True)
class ReferenceFiles:
    """
    The reference files of an exposure, in the formats of CRDS.

    Parameters
    ----------
    mask : path-like, optional
        Bad pixels: flags ``DQ`` with their legend ``DQ_DEF``.
    saturation : path-like or float, optional
        Raw DN from which a group is saturated.
    bias : path-like or float, optional
        Level of an empty pixel in DN (reference type ``superbias``). MIRI has none in CRDS: its
        linearity is a polynomial of raw DN.
    reset : path-like, optional
        DN of the first groups after a reset.
    linearity : path-like, optional
        Coefficients ``COEFFS`` (n, ny, nx), lowest power first, of the polynomial from DN above
        the bias (raw DN without a bias) to linear DN.
    dark : path-like, optional
        Linear DN of each group.
    gain : path-like, float or "measured", optional
        Electrons per DN.
    read_noise : path-like, float or "measured", optional
        As in CRDS, a file holds the noise of a difference of two reads, DN; a number is that of
        one read.
    flat : path-like, optional
        Relative response.
    photom : path-like, optional
        Table of MJy/sr per DN/s by filter and sub-array, with its dependence on time.
    incomplete : bool, optional
        Whether references that are missing are done without, with a warning that lists them.
    origin : str, optional
        Where they were chosen, such as a CRDS context, for headers.

    Raises
    ------
    ValueError
        If there is no such file, a number is out of range, or a reference cannot be measured.

    Notes
    -----
    ``"measured"`` takes gain and read noise from the scatter of the ramp's own groups
    (`measure_noise`); in sub-arrays without reference pixels (``SUB256``, ``BRIGHTSKY``) under an even sky
    the gain has slow noise of the read-out in it, and there is a warning. References of the full frame are
    cut to the sub-array of the exposure; one of
    another detector, filter, read-out pattern or part of the detector is refused.

    Examples
    --------
    >>> from miricigale.reduction import ReferenceFiles
    >>> ReferenceFiles(gain=5.5, read_noise="measured", incomplete=True).missing()
    ('mask', 'saturation', 'linearity', 'dark', 'flat', 'photom')
    """

    mask: object = None
    saturation: object = None
    bias: object = None
    reset: object = None
    linearity: object = None
    dark: object = None
    gain: object = None
    read_noise: object = None
    flat: object = None
    photom: object = None
    incomplete: bool = False
    origin: str | None = None

    def __post_init__(self):
        for name in self.names():
            value = getattr(self, name)
            if value is None or (value == "measured" and name in _MEASURED):
                continue
            if is_path(value):
                check_that(
                    Path(value).is_file(), name, "the path of a file", f"{value}: there is none"
                )
                object.__setattr__(self, name, Path(value))
                continue
            number = isinstance(value, numbers.Real) and not isinstance(value, bool)
            if name not in _NUMBERS or not number or not (np.isfinite(value) and value > 0):
                unit = ""
                if name in _NUMBERS:
                    unit = f" or a number above 0 in {_NUMBERS[name]}"
                measured = ""
                if name in _MEASURED:
                    measured = " or 'measured'"
                raise argument_error(name, f"a path{unit}{measured}", repr(value))

    @staticmethod
    def names():
        """Return the names of all references, in the order in which they are used."""
        return tuple(REFERENCES)

    replace = dataclasses.replace

    def missing(self, history=None, *, names=SLOPES + BRIGHTNESS):
        """
        Return the references that are needed and not given.

        Parameters
        ----------
        history : `~miricigale.instrument.ExposureHistory`, optional
            What the pipeline has done already.
        names : iterable of str, optional
            Of which references; of those for slopes and brightness by default.

        Returns
        -------
        names : tuple of str
        """
        if history is None:
            history = ExposureHistory()
        return tuple(n for n in names if getattr(self, n) is None and not history.done(n))

    def maps(self, ramp):
        """
        Return what the files say of the detector of a ramp.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp`
            Whose sub-array, read-out and groups they must fit; what was done to it is not done
            again.

        Returns
        -------
        maps : `DetectorMaps`
            What is missing leaves its step out; gain and read noise that are missing are
            measured.

        Raises
        ------
        ValueError
            If a file is for another detector, sub-array or read-out, or has too few groups.
        `~miricigale.utils.exceptions.DataError`
            If a file cannot be read as what it should be.
        """
        values = {"pixel_dq": np.zeros(ramp.exposure.shape, np.int64)}
        names = {}
        history = ramp.history
        for name, reader in READERS.items():
            value = getattr(self, name)
            if history.done(name):
                names[name] = "done before"
            elif isinstance(value, Path):
                reference_map, flags = reader(value, ramp.exposure)
                values["pixel_dq"] |= flags
                if reference_map is not None:
                    values[name] = reference_map
                names[name] = value.name
            elif value is not None and value != "measured":
                values[name] = float(value)
                names[name] = f"{value:.6g} {_NUMBERS[name]} (given)"
            else:
                names[name] = "none"
        if "saturation" not in values and not history.done("saturation"):
            if ramp.data.dtype.kind == "u":
                values["saturation"] = 65535.0
            else:
                values["saturation"] = np.inf
            names["saturation"] = "the highest number of the converter"
        if "dark" in values and values["dark"].shape[1] < ramp.shape[1]:
            got = f"it has {values['dark'].shape[1]} groups, and the ramp {ramp.shape[1]}"
            raise data_error(self.dark, f"is no dark reference for this exposure: {got}")
        if unknown := [name for name in _MEASURED if name not in values]:
            measured = measure_noise(ramp)
            for name in unknown:
                values[name] = getattr(measured, name)
                names[name] = measured.describe(name)
            if "gain" in unknown:
                values["slow_noise"] = measured.slow_noise
            if "gain" in unknown and measured.effective:
                warn(
                    f"the gain of {measured.gain:.3g} e-/DN is that of all noise that grows with time: the "
                    "light is even and there are no reference pixels, which would separate slow noise of the "
                    "read-out from photons (measure_noise). Give 'gain' if it is known",
                    ReferenceWarning,
                )
        if self.origin is not None:
            names["context"] = self.origin
        return DetectorMaps(**values, used=names)
