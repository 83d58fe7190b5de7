"""
What resets do to the ramps of MIRI: the anomaly and the decay after one, the first and last frame.

The effects act on DN above the bias, after `Nonlinearity` and before `Bias`: in the same
place as the steps of the official pipeline that undo them (reset, rscd, lastframe; all but
the second before the linearity correction). Reference pixels do not show them: a drift
that they shared would be gone with the reference-pixel correction.

Published is how the effects run, not one number for how strong they are; every amplitude
below is of our own, plausible in size, and can be given.

References
----------
Morrison et al. 2023, PASP 135, 075004, arXiv:2308.16327 (detector effects in flight and the
pipeline's algorithms); Ressler et al. 2015, PASP 127, 675; documentation of the JWST pipeline,
steps ``reset``, ``rscd``, ``firstframe`` and ``lastframe``.
"""

import dataclasses

import numpy as np

from miricigale.detector.effects.base import Effect, check_amounts, check_finite, check_share
from miricigale.utils.options import check_that


@dataclasses.dataclass(frozen=True)
class ResetAnomaly(Effect):
    """
    The level right after a reset, which settles exponentially.

    Group g (from 0) is offset by ``amplitude exp(-g / groups)``, whatever the signal and
    in every pixel alike. The decay belongs to the number of the group rather than to time,
    and has gone by about group 15; the amplitude changes over the first integrations.
    (The spatial structure that real first groups show in addition is not simulated.)

    Parameters
    ----------
    amplitudes : tuple of float, optional
        Offset of the first group in DN, for the first integration, the second, and so on;
        the last holds for all further ones. The published fact is that they differ up to
        the second integration; these values are of our own.
    groups : float, optional
        Number of groups in which the offset falls by a factor e. The default, 4, leaves
        3 % at the 15th group.

    Examples
    --------
    >>> from miricigale.detector import ResetAnomaly
    >>> anomaly = ResetAnomaly(amplitudes=(-40.0, -10.0))
    >>> anomaly.offsets(n_integrations=2, n_groups=4).round(1)
    array([[-40. , -31.2, -24.3, -18.9],
           [-10. ,  -7.8,  -6.1,  -4.7]])
    """

    amplitudes: tuple = (-30.0, -20.0)
    groups: float = 4.0

    def __post_init__(self):
        amplitudes = tuple(map(float, np.atleast_1d(self.amplitudes)))
        object.__setattr__(self, "amplitudes", amplitudes)
        check_that(amplitudes, "amplitudes", "at least one amplitude", "none")
        check_finite(amplitudes=amplitudes)
        check_amounts(above_zero=True, groups=self.groups)

    def offsets(self, n_integrations, n_groups):
        """
        Return the offset of each group.

        Parameters
        ----------
        n_integrations, n_groups : int
            Of the exposure.

        Returns
        -------
        offsets : `~numpy.ndarray`, shape (n_integrations, n_groups)
            In DN.
        """
        last = len(self.amplitudes) - 1
        amplitudes = [self.amplitudes[min(i, last)] for i in range(n_integrations)]
        return np.outer(amplitudes, np.exp(-np.arange(n_groups) / self.groups))

    def apply(self, ramp, block):
        """Add the offsets."""
        offsets = self.offsets(*ramp.shape[:2]).astype(np.float32)
        sees = (~block.reference).astype(np.float32)
        for i, g in np.ndindex(*offsets.shape):
            ramp[i, g] += offsets[i, g] * sees
        return ramp


@dataclasses.dataclass(frozen=True)
class ResetDecay(Effect):
    """
    The decay after the reset between integrations, which goes with the signal before it (RSCD).

    Group g (from 0) of every integration but the first is offset by ``share exp(-g / groups)`` times
    the last signal of its pixel in the integration before: bright ramps begin too low, and faint
    ones do not. Exposures begin with more resets, so that their first integration shows none.

    Parameters
    ----------
    share : float, optional
        Of the signal at the end of the integration before; of our own. Published is that first groups
        of later integrations are low by what decays and goes with that signal.
    groups : float, optional
        Number of groups in which the offset falls by a factor e; of our own.

    Examples
    --------
    >>> from miricigale.detector import Detector, ResetDecay
    >>> detector = Detector.miri_imager(ResetDecay(share=-0.01))
    >>> detector.effects[8]
    ResetDecay(share=-0.01, groups=2.0)
    """

    share: float = -0.005
    groups: float = 2.0

    def __post_init__(self):
        check_that(-1 < self.share < 1, "share", "between -1 and 1", self.share)
        check_amounts(above_zero=True, groups=self.groups)

    def apply(self, ramp, block):
        """Offset the groups of all integrations but the first."""
        sees = ~block.reference
        decay = (self.share * np.exp(-np.arange(ramp.shape[1]) / self.groups)).astype(np.float32)
        # the last first: what an integration is offset by is of the one before as it was
        for i in range(ramp.shape[0] - 1, 0, -1):
            signal = np.where(sees, ramp[i - 1, -1], np.float32(0))
            for g, share in enumerate(decay):
                ramp[i, g] += share * signal
        return ramp


@dataclasses.dataclass(frozen=True)
class FirstFrame(Effect):
    """
    The transient of the first group of an integration, which the reductions leave out.

    Parameters
    ----------
    offset : float, optional
        In DN, of every pixel; of our own.

    Examples
    --------
    >>> from miricigale.detector import Detector, FirstFrame
    >>> detector = Detector.miri_imager(FirstFrame(offset=-20.0))
    >>> detector.effects[8]
    FirstFrame(offset=-20.0)
    """

    offset: float = -15.0

    def __post_init__(self):
        check_finite(offset=self.offset)

    def apply(self, ramp, block):
        """Offset the first groups."""
        ramp[:, 0] += np.float32(self.offset) * (~block.reference).astype(np.float32)
        return ramp


@dataclasses.dataclass(frozen=True)
class LastFrame(Effect):
    """
    The pull of the reset on the last group of an integration.

    The last group is read while the rows are reset in pairs. What the reset of the pair
    before it does to a pixel has a part of the bias and one of the collected signal:
    the group is offset by ``offset`` plus ``-coupling`` times the mean signal of the two
    pixels of the preceding row pair in the same column. The first pair has none before it.

    Parameters
    ----------
    offset : float, optional
        In DN, of every pixel but those of the first pair; of our own.
    coupling : float, optional
        Share of the neighboring pair's signal that is lost; of our own.

    Examples
    --------
    >>> from miricigale.detector import Detector, LastFrame
    >>> detector = Detector.miri_imager(LastFrame(offset=-20.0))
    >>> detector.effects[8]
    LastFrame(offset=-20.0, coupling=0.005)
    """

    offset: float = -10.0
    coupling: float = 0.005

    # an odd row, its even one, and the pair before
    halo = 3

    def __post_init__(self):
        check_finite(offset=self.offset)
        check_share("coupling", self.coupling)

    def apply(self, ramp, block):
        """Pull the last groups."""
        rows = np.arange(ramp.shape[2])
        before = rows - (block.rows.start + rows) % 2 - 2
        # rows whose preceding pair is not in the block are of its halo, or of the first pair
        has_frame = before >= 0
        last = ramp[:, -1]
        pair = last[:, before[has_frame]] + last[:, before[has_frame] + 1]
        pull = np.float32(self.offset) - np.float32(0.5 * self.coupling) * pair
        last[:, has_frame] += np.where(block.reference[has_frame], 0, pull)
        return ramp
