"""
Latent images: what a pixel remembers of the exposures before.

References
----------
JWST User Documentation, MIRI detector performance, table 1 (latent images below 1 %);
Rieke et al. 2015, PASP 127, 665; Vasan et al. 2025, arXiv:2512.15477 (a deficit of 1.7 %
after saturation at F2100W, over hours: of the other sign, and not simulated).
"""

import dataclasses

import astropy.units as u
import numpy as np

from miricigale.detector import _core
from miricigale.detector.effects.base import Effect, check_ramp
from miricigale.detector.ramp import Ramp
from miricigale.instrument import DQ, aperture, miri_detector
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import TIME, frozen_array, to_array

__all__ = ["Latent", "Persistence"]

# pixels of a ramp that tell nothing of the light
_NO_LIGHT = DQ.DO_NOT_USE | DQ.NON_SCIENCE | DQ.REFERENCE_PIXEL | DQ.DEAD


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Latent:
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

    Raises
    ------
    KeyError
        If the sub-array is not known.
    ValueError
        If a rate or the gap is negative.

    Notes
    -----
    To forget, go on: ``latent.after(t)`` is the same exposure a time t later. Several
    exposures before add up (``previous=[...]`` of `~miricigale.detector.Detector.expose`).
    """

    rate: u.Quantity
    gap: u.Quantity
    subarray: str = "FULL"

    def __post_init__(self):
        unit = u.electron / TIME
        aperture(self.subarray)
        rate = to_array(self.rate, unit, "rate", ndim=2, finite=True)
        if np.any(rate < 0):
            raise argument_error("rate", "nowhere negative", rate.min())
        gap = float(to_array(self.gap, TIME, "gap", ndim=0, finite=True))
        if gap < 0:
            raise argument_error("gap", "at least 0 s", self.gap)
        object.__setattr__(self, "rate", u.Quantity(frozen_array(rate), unit, copy=False))
        object.__setattr__(self, "gap", gap * TIME)

    @classmethod
    def from_ramp(cls, ramp, gap, *, threshold=0.1, properties=None):
        """
        What a ramp leaves behind.

        Parameters
        ----------
        ramp : `~miricigale.detector.Ramp`
            The exposure before, simulated or read.
        gap : `~astropy.units.Quantity`
            Time from its end to the start of the next one.
        threshold : float, optional
            Pixels filled to less than this fraction of the full well leave nothing.
        properties : `~miricigale.instrument.DetectorProperties`, optional
            `~miricigale.instrument.miri_detector` if not given.

        Returns
        -------
        latent : `Latent`
            A saturated pixel counts as full at the end: its latent is a lower limit.
        """
        if not isinstance(ramp, Ramp):
            raise argument_error("ramp", "a Ramp", type(ramp).__name__)
        if not 0 <= threshold <= 1:
            raise argument_error("threshold", "a fraction of the full well", threshold)
        properties = miri_detector() if properties is None else properties
        level = properties.linearize(np.asarray(ramp.data[-1, -1], float) - properties.bias)
        charge = np.clip(properties.gain * level, 0, properties.full_well)
        dark = (ramp.pixel_dq & np.uint32(_NO_LIGHT)) != 0
        charge[dark | (charge < threshold * properties.full_well)] = 0
        rate = charge * u.electron / ramp.exposure.integration_time
        return cls(rate, gap, ramp.exposure.subarray)

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
        step = float(to_array(time, TIME, "time", ndim=0, finite=True))
        return dataclasses.replace(self, gap=self.gap + step * TIME)

    def __repr__(self):
        ny, nx = self.rate.shape
        n = np.count_nonzero(self.rate.value)
        return f"<Latent {self.subarray}: {n} of {ny} x {nx} pixels, {self.gap.value:g} s ago>"


@dataclasses.dataclass(frozen=True)
class Persistence(Effect):
    """
    Charge that previous exposures left and that comes free later, with Poisson noise.

    A pixel that was filled at the rate R collects, a time t after that exposure,
    ``R sum_k amplitudes[k] exp(-t / times[k])`` more electrons per second. Resets do not
    stop it: time goes on through all integrations and the reset frames between them.
    Without ``previous`` nothing happens. What is remembered was measured behind the interpixel
    capacitance, so that the effect stands after it.

    Parameters
    ----------
    amplitudes : tuple of float, optional
        Share of the former rate right after the end of the exposure. The published fact is
        that latent images are below 1 %; the defaults add up to 0.8 %, the split into a
        quick and a slow part is of our own.
    times : tuple of float, optional
        Time in s over which each part falls by a factor e; of our own (minutes).
    """

    amplitudes: tuple = (0.006, 0.002)
    times: tuple = (30.0, 300.0)

    def __post_init__(self):
        for name in ("amplitudes", "times"):
            values = tuple(float(v) for v in np.atleast_1d(getattr(self, name)))
            object.__setattr__(self, name, values)
        if not self.amplitudes or len(self.amplitudes) != len(self.times):
            got = f"{len(self.amplitudes)} and {len(self.times)}"
            raise argument_error("amplitudes, times", "of one length, at least one each", got)
        if not all(0 <= a <= 1 for a in self.amplitudes):
            raise argument_error("amplitudes", "shares from 0 to 1", self.amplitudes)
        if not all(np.isfinite(t) and t > 0 for t in self.times):
            raise argument_error("times", "positive", self.times)

    def released(self, exposure, gap):
        """
        Charge that comes free in each group for a former rate of one electron per second.

        Parameters
        ----------
        exposure : `~miricigale.instrument.Exposure`
            The exposure that suffers.
        gap : `~astropy.units.Quantity`
            Time between the two.

        Returns
        -------
        charge : `~numpy.ndarray`, shape (n_int, n_group)
            In electrons; the integral of the decay over the time of each group.
        """
        frame = exposure.frame_time.to_value(TIME)
        step = exposure.group_time.to_value(TIME)
        integration = exposure.integration_time.to_value(TIME) + frame
        start = float(to_array(gap, TIME, "gap", ndim=0)) + integration * np.arange(
            exposure.n_integrations
        )
        start = start[:, None] + step * np.arange(exposure.n_groups)
        return sum(
            a * t * np.exp(-start / t) * -np.expm1(-step / t)
            for a, t in zip(self.amplitudes, self.times, strict=True)
        )

    def apply(self, array, block):
        """Add the charge that comes free."""
        ramp = check_ramp(array, block, self)
        if not block.previous:
            return ramp
        rates = np.stack([latent.rate.value[block.rows] for latent in block.previous])
        released = np.stack(
            [self.released(block.exposure, latent.gap) for latent in block.previous]
        )
        _core.add_latent(ramp, rates, released, block.key, block.rows.start)
        return ramp
