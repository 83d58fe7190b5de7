"""What an exposure leaves behind for those after it."""

import dataclasses

import astropy.units as u
import numpy as np

from miricigale.detector.ramp import Ramp
from miricigale.instrument import DQ, aperture, miri_detector
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_shape, check_that, check_type
from miricigale.utils.units import TIME, Frozen, frozen_array, scalar, to_array
from miricigale.utils.values import value_class

# pixels of a ramp without information on the light
_NO_LIGHT = DQ.DO_NOT_USE | DQ.NON_SCIENCE | DQ.REFERENCE_PIXEL | DQ.DEAD


@value_class
class Latent(Frozen):
    """
    What an exposure leaves behind for those after it.

    Parameters
    ----------
    rate : `~astropy.units.Quantity`, shape (ny, nx)
        Mean rate in electrons per second at which the pixels were filled: the charge at the
        end of the last integration over its time. Zero where nothing is remembered.
    gap : `~astropy.units.Quantity`
        Time from the end of that exposure to the start of the next one.
    subarray : str, optional
        Sub-array of the exposure; pixels are remembered in its frame.
    saturated : `~numpy.ndarray` of bool, shape (ny, nx), optional
        Which pixels were full; none by default.

    Raises
    ------
    KeyError
        If the sub-array is not known.
    ValueError
        If a rate or the gap is negative, or ``saturated`` has another shape.

    Notes
    -----
    To let time pass: ``latent.after(t)`` is the same exposure a time t later. Several
    exposures before add up (``previous=[...]`` of `~miricigale.detector.Detector.expose`).

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import Latent, Persistence
    >>> detector = Detector.miri_imager(Persistence())
    >>> bright = sky.copy()
    >>> bright[32, 36] = 1e6 * u.MJy / u.sr
    >>> latent = Latent.from_ramp(
    ...     detector.expose(bright, exposure, seed=1), gap=60 * u.s
    ... )
    >>> latent.after(5 * u.min)
    <Latent SUB64: 9 of 64 x 72 pixels, 360 s ago>
    """

    rate: u.Quantity
    gap: u.Quantity
    subarray: str = "FULL"
    saturated: np.ndarray | None = None

    def __post_init__(self):
        unit = u.electron / TIME
        aperture(self.subarray)
        rate = to_array(self.rate, unit, "rate", ndim=2, finite=True)
        if np.any(rate < 0):
            raise argument_error("rate", "nowhere negative", rate.min())
        gap = scalar(self.gap, TIME, "gap")
        check_that(gap >= 0, "gap", "at least 0 s", self.gap)
        rate = u.Quantity(frozen_array(rate), unit, copy=False)
        if self.saturated is None:
            full = np.zeros(rate.shape, bool)
        else:
            full = self.saturated
        check_shape(full, rate.shape, "saturated")
        self.__dict__.update(rate=rate, gap=gap * TIME, saturated=frozen_array(full, bool))

    @classmethod
    def from_ramp(cls, ramp, gap, *, threshold=0.1):
        """
        Return what a ramp leaves behind.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp`
            The exposure before, simulated or read; of a ramp without ``properties`` those of
            `~miricigale.instrument.miri_detector` are taken.
        gap : `~astropy.units.Quantity`
            Time from its end to the start of the next one.
        threshold : float, optional
            Pixels filled to less than this fraction of the full well leave nothing.

        Returns
        -------
        latent : `Latent`
            A saturated pixel counts as full at the end: its latent is a lower limit.
        """
        check_type(ramp, "ramp", Ramp, "a Ramp")
        check_that(0 <= threshold <= 1, "threshold", "a fraction of the full well", threshold)
        properties = ramp.properties or miri_detector()
        level = properties.linearize(np.asarray(ramp.data[-1, -1], float) - properties.bias)
        charge = np.clip(properties.gain * level, 0, properties.full_well)
        dark = (ramp.pixel_dq & np.uint32(_NO_LIGHT)) != 0
        charge[dark | (charge < threshold * properties.full_well)] = 0
        rate = charge * u.electron / ramp.exposure.integration_time
        # ramps of files may have no flags: counts within 1 % of the well are full too
        full = ((ramp.group_dq & DQ.SATURATED) != 0).any(axis=(0, 1)) & ~dark
        full |= charge > 0.99 * properties.full_well
        return cls(rate, gap, ramp.exposure.subarray, full)

    def after(self, time):
        """
        Let time pass.

        Parameters
        ----------
        time : `~astropy.units.Quantity`
            To be added to the gap.

        Returns
        -------
        latent : `Latent`
        """
        step = scalar(time, TIME, "time")
        return dataclasses.replace(self, gap=self.gap + step * TIME)

    def __repr__(self):
        ny, nx = self.rate.shape
        n = np.count_nonzero(self.rate.value)
        return f"<Latent {self.subarray}: {n} of {ny} x {nx} pixels, {self.gap.value:g} s ago>"


def checked_previous(previous, exposure):
    """Return the exposures before one, a `Latent` or several, as a tuple; those of other pixels are refused."""
    if previous is None:
        return ()
    if np.iterable(previous):
        previous = tuple(previous)
    else:
        previous = (previous,)
    for latent in previous:
        check_that(isinstance(latent, Latent), "previous", "a Latent or several", repr(latent))
        if latent.subarray != exposure.subarray or latent.rate.shape != exposure.shape:
            raise argument_error(
                "previous", f"of {exposure.subarray}, {exposure.shape} pixels", repr(latent)
            )
    return previous
