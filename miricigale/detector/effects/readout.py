"""Effects of the read-out: response, bias, noise and rounding, in DN."""

import dataclasses

import numpy as np

from miricigale.detector._core.random import standard_normals
from miricigale.detector._core.readout import (
    add_noise,
    add_pink_noise,
    digitize,
    interpolate_response,
)
from miricigale.detector.effects.base import Effect, check_amounts, check_finite
from miricigale.instrument import DQ
from miricigale.utils.exceptions import argument_error


@dataclasses.dataclass(frozen=True)
class Nonlinearity(Effect):
    """
    Electrons to DN: gain, and the response that falls as the pixel fills.

    The response is the detector's ``delinearize``, tabulated every 8 DN up to the full well
    and interpolated (to better than 1e-3 DN for curvatures up to 1e-4 per DN).

    Parameters
    ----------
    linear : bool, optional
        Whether the response is taken as linear: the gain alone.

    Examples
    --------
    >>> from miricigale.detector import Nonlinearity
    >>> from miricigale.instrument import miri_detector
    >>> response = Nonlinearity().response(50000.0, miri_detector())
    >>> print(f"50000 linear DN read {response:.0f} DN")
    50000 linear DN read 47967 DN
    """

    linear: bool = False

    def apply(self, ramp, block):
        """Turn electrons into DN above the bias."""
        properties = block.properties
        step = 8.0
        nodes = step * np.arange(
            int(np.ceil(1.05 * properties.full_well / properties.gain / step)) + 2
        )
        response = self.response(nodes, properties)
        response = np.ascontiguousarray(response, np.float32)
        interpolate_response(ramp, float(properties.gain), response, step)
        return ramp

    def response(self, dn, properties):
        """Return the measured DN of linear ones."""
        if self.linear:
            return dn
        return properties.delinearize(dn)

    def linear_dn(self, dn, properties):
        """Return the linear DN of measured ones."""
        if self.linear:
            return dn
        return properties.linearize(dn)


@dataclasses.dataclass(frozen=True)
class Bias(Effect):
    """
    The level from which a pixel starts after its reset.

    Parameters
    ----------
    level : float, optional
        In DN; that of the detector's properties if not given.
    reset_noise : float, optional
        Standard deviation of the level from reset to reset (kTC noise), in DN. It is the
        same for all groups of an integration.

    Examples
    --------
    >>> from miricigale.detector import Bias, Detector
    >>> Detector.miri_imager(Bias(level=10000.0, reset_noise=8.0)).effects[8]
    Bias(level=10000.0, reset_noise=8.0)
    """

    level: float | None = None
    reset_noise: float = 0.0

    def __post_init__(self):
        check_amounts(reset_noise=self.reset_noise)
        if self.level is not None:
            check_finite(level=self.level)

    def apply(self, ramp, block):
        """Add the level."""
        level = self.mean(block.properties)
        ramp += np.float32(level)
        if self.reset_noise:
            offset = np.empty(ramp.shape[2:])
            for i in range(ramp.shape[0]):
                # integrations are distinguished by the row that the stream is for
                first = block.rows.start + (i + 1) * 2**20
                standard_normals(block.key, first, offset)
                ramp[i] += np.asarray(self.reset_noise * offset, np.float32)
        return ramp

    def mean(self, properties):
        """Return the mean level in DN."""
        if self.level is None:
            return properties.bias
        return self.level


@dataclasses.dataclass(frozen=True)
class ReadNoise(Effect):
    """
    Gaussian noise of every read, and 1/f noise if asked for.

    Parameters
    ----------
    sigma : float, optional
        Standard deviation of one read in DN; that of the detector's properties if not
        given.
    pink : float, optional
        Standard deviation of the 1/f part in DN, common to the pixels of one row and
        output (four outputs, to which columns belong in turn).
    octaves : int, optional
        Over how many octaves of time, from one row upwards, the 1/f part reaches.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import ADConversion, Bias, Nonlinearity, Photons
    >>> from miricigale.detector import ReadNoise
    >>> effects = (
    ...     Photons(),
    ...     Nonlinearity(),
    ...     Bias(),
    ...     ReadNoise(sigma=10.0),
    ...     ADConversion(),
    ... )
    >>> dark = Detector(effects).expose(0 * sky, exposure, seed=1)
    >>> print(f"{dark.data.std():.1f} DN")
    10.0 DN
    """

    sigma: float | None = None
    pink: float = 0.0
    octaves: int = 16

    def __post_init__(self):
        check_amounts(sigma=self.sigma, pink=self.pink)
        if not 1 <= self.octaves <= 40 or int(self.octaves) != self.octaves:
            raise argument_error("octaves", "an integer from 1 to 40", self.octaves)

    def apply(self, ramp, block):
        """Add the noise."""
        sigma = self.deviation(block.properties)
        first = block.rows.start
        add_noise(ramp, float(sigma), block.key, first)
        if self.pink:
            # streams apart from those of the white noise
            key = block.key[::-1].copy()
            n_rows = block.exposure.shape[0]
            add_pink_noise(ramp, float(self.pink), int(self.octaves), 4, key, first, n_rows)
        return ramp

    def deviation(self, properties):
        """Return the standard deviation of one read in DN, without the 1/f part."""
        if self.sigma is None:
            return properties.read_noise
        return self.sigma


@dataclasses.dataclass(frozen=True)
class ADConversion(Effect):
    """
    Rounding to unsigned 16-bit numbers; out of range flagged AD_FLOOR or SATURATED.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> Detector.miri_imager().expose(sky, exposure, seed=1).data.dtype
    dtype('uint16')
    """

    def limit(self, properties):
        """Return the charge that reads the highest number; infinite where the full well reads less."""
        highest = 65535.5 - properties.bias
        if highest >= properties.saturation_dn:
            return np.inf
        return float(properties.gain * properties.linearize(highest))

    def apply(self, ramp, block):
        """Turn DN into counts."""
        counts = np.empty(ramp.shape, np.uint16)
        digitize(ramp, counts, block.group_dq, np.uint8(DQ.AD_FLOOR), np.uint8(DQ.SATURATED))
        return counts
