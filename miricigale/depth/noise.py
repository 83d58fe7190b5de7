"""Noise of a pixel's rate: photons, dark current and read noise of optimally fitted ramps."""

import dataclasses

import astropy.units as u
import numpy as np
from scipy.linalg import solveh_banded
from scipy.ndimage import gaussian_filter1d

from miricigale.depth import _core
from miricigale.depth.published import residual_amplitude
from miricigale.instrument import (
    DetectorProperties,
    electrons_per_brightness,
    miri_detector,
)
from miricigale.instrument.photometric import chosen_level
from miricigale.psf import MIRI_PIXEL_SCALE
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import attributes
from miricigale.utils.options import check_kind, check_that
from miricigale.utils.units import SURFACE_BRIGHTNESS, scalar


@dataclasses.dataclass(frozen=True, kw_only=True)
class ExposureNoise:
    """
    Noise of one pixel of an exposure, and how it grows with a source.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    background : `~astropy.units.Quantity`, str or None
        Surface brightness of sky and telescope, or a level of `~miricigale.instrument.background_level`; the low
        one if None.
    n_groups : int
        Groups of an integration.
    group_time : float
        In s.
    n_ramps : float
        Integrations of all exposures together.
    detector : `~miricigale.instrument.DetectorProperties` or None
        `~miricigale.instrument.miri_detector` if None.
    subarray : str
        Whose response counts.
    n_frames : int
        Frames whose mean a group is.

    Raises
    ------
    ValueError
        If the background is negative or the detector is none.

    Examples
    --------
    >>> from miricigale.depth import ExposureNoise
    >>> noise = ExposureNoise(
    ...     filter="miri.f770w", background=None, n_groups=100, group_time=2.775, n_ramps=4
    ... )
    >>> print(f"{noise.rate:.1f} electrons / s, error {noise.variance() ** 0.5:.2f}")
    56.4 electrons / s, error 0.23
    """

    filter: str
    background: u.Quantity | str | None
    n_groups: int
    group_time: float
    n_ramps: float
    detector: DetectorProperties | None = None
    subarray: str = "FULL"
    n_frames: int = 1

    def __post_init__(self):
        check_kind(self.detector, "detector", DetectorProperties)
        if self.detector is None:
            detector = miri_detector()
        else:
            detector = self.detector
        value = scalar(chosen_level(self.filter, self.background), SURFACE_BRIGHTNESS, "background")
        check_that(value >= 0, "background", "at least 0", self.background)
        self.__dict__.update(detector=detector, background=value * SURFACE_BRIGHTNESS)

    @property
    def rate(self):
        """Electrons per second of sky and dark current."""
        return float(self.sky + self.detector.dark_current)

    @property
    def sky(self):
        """Electrons per second of the sky alone."""
        return self.background.value * self._electrons

    @property
    def electrons(self):
        """Electrons per second of 1 uJy in a pixel."""
        area = MIRI_PIXEL_SCALE.to_value(u.rad) ** 2 * 1e12
        return self._electrons / area

    @property
    def _electrons(self):
        """Electrons per second of 1 MJy/sr."""
        return electrons_per_brightness(self.filter, self.detector, subarray=self.subarray)

    def variance(self, further=0.0):
        """
        Return the variance of the mean slope.

        Parameters
        ----------
        further : float, optional
            Electrons per second beyond sky and dark current.

        Returns
        -------
        variance : float
            (Electrons per second) squared.
        """
        names = ("n_groups", "group_time", "n_frames")
        ramp = attributes(self, names)
        noise = self.detector.read_noise * self.detector.gain
        return ramp_variance(self.rate + further, **ramp, read_noise=noise) / self.n_ramps

    @property
    def growth(self):
        """By how much the variance grows with the rate of a faint source, electrons per second."""
        step = 0.01 * self.rate + 1e-3
        return (self.variance(step) - self.variance()) / step


def ramp_variance(rate, *, n_groups, group_time, read_noise, n_frames=1):
    """
    Return the variance of the optimally weighted slope of one ramp, (electrons per second) squared.

    The differences of groups have Poisson variance on the diagonal (``rate`` in electrons per
    second times ``group_time`` in s) and share the ``read_noise`` (electrons) with their
    neighbors; the best slope has the variance 1 / (1^T C^-1 1). Means of ``n_frames`` frames have less
    read noise, and share photons with their neighbors, too.
    """
    if rate == 0 and read_noise == 0:
        return 0.0
    photons = float(rate * group_time)
    read = float(read_noise) ** 2
    if n_frames == 1:
        total, _ = _core.weight_sums(n_groups - 1, photons, read)
    else:
        total = _averaged_sum(n_groups - 1, photons, read, n_frames)
    return 1.0 / (total * group_time**2)


def _averaged_sum(n_differences, photons, read, n_frames):
    """Sum of the weights of differences of averaged groups: their matrix has three diagonals."""
    shared = read / n_frames - _core.shared_photons(n_frames) * photons
    matrix = np.empty((2, n_differences))
    matrix[0] = -shared
    matrix[1] = photons + 2 * shared
    return float(solveh_banded(matrix, np.ones(n_differences)).sum())


def noise_power(weights, correlation=None):
    """
    Return the variance of a weighted sum of pixels of unit variance: the sum of w_i w_j rho_ij.

    ``correlation`` is the Gaussian width in pixels with which white noise was smoothed (and brought
    back to unit variance); None or 0 for white noise.
    """
    if not correlation:
        return float(np.sum(weights**2))
    reach = int(np.ceil(4 * correlation))
    smooth = np.pad(weights, reach)
    delta = np.zeros(2 * reach + 1)
    delta[reach] = 1.0
    shape = gaussian_filter1d(delta, correlation, truncate=4.0)
    for axis in (0, 1):
        smooth = gaussian_filter1d(smooth, correlation, axis=axis, truncate=4.0, mode="constant")
    return float(np.sum(smooth**2) / np.sum(shape**2) ** 2)


def pattern_amplitude(residual, filter):
    """Return the fraction of the light that stays as a pattern: none, a number, or by its name."""
    if residual is None or residual is False:
        return 0.0
    if isinstance(residual, str):
        return residual_amplitude(filter, residual)
    value = scalar(residual, u.dimensionless_unscaled, "residual")
    if residual is True or not 0 <= value < 0.2:
        raise argument_error("residual", "None, a name or a fraction from 0 to 0.2", residual)
    return value
