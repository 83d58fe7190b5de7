"""Effects on light: what the flat field leaves behind, and the photons it turns into."""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d

from miricigale.depth import residual_amplitude, residual_presets
from miricigale.detector._core.charge import add_poisson
from miricigale.detector._core.random import standard_normals
from miricigale.detector.effects.base import Effect, check_share, key_words
from miricigale.instrument import electrons_per_brightness, flat_field
from miricigale.utils.options import check_names


@dataclasses.dataclass(frozen=True)
class Residual(Effect):
    """
    What flat field and sky subtraction leave behind, fixed on the detector.

    Multiplies the light by 1 plus a random pattern that is the same in every exposure
    through one filter: sub-arrays see their part of the full frame's.

    Parameters
    ----------
    amplitude : float or str
        Standard deviation of the pattern, as a fraction of the light; or ``"etc"`` for one per
        filter, which holds at the default correlation
        (`~miricigale.depth.residual_amplitude`).
    correlation : float, optional
        Gaussian width of the pattern's correlation in pixels; 0 for white.
    pattern : int, optional
        Which random pattern: a property of the detector, apart from the exposure's seed.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import Residual
    >>> detector = Detector.miri_imager(Residual(0.01, correlation=0))
    >>> plain = Detector.miri_imager().collect(sky, exposure, seed=1)
    >>> uneven = detector.collect(sky, exposure, seed=1)
    >>> print(f"{np.nanstd(uneven.mean / plain.mean):.2f}")
    0.01
    """

    amplitude: float | str
    correlation: float = 1.0
    pattern: int = 0

    def __post_init__(self):
        if isinstance(self.amplitude, str):
            check_names([self.amplitude], "residual preset", residual_presets())
        else:
            check_share("amplitude", self.amplitude, 0.2)
        check_share("correlation", self.correlation, 30)

    def apply(self, array, block):
        """Multiply surface brightness by the pattern."""
        reach = int(np.ceil(4 * self.correlation))
        n_row, n_col = array.shape
        x0, y0 = block.exposure.aperture.origin
        key = key_words(self.pattern, "detector", "residual", block.exposure.filter)
        # a row is drawn from the first column of the detector on, whatever part is read
        white = np.empty((n_row + 2 * reach, x0 + n_col + 2 * reach))
        # rows beyond the detector have streams of their own
        standard_normals(key, y0 + block.rows.start - reach + 10_000, white)
        white = white[:, x0:]
        if reach:
            delta = np.zeros(2 * reach + 1)
            delta[reach] = 1.0
            shape = gaussian_filter1d(delta, self.correlation, truncate=4.0)
            for axis in (0, 1):
                white = gaussian_filter1d(white, self.correlation, axis=axis, truncate=4.0)
            # unit variance: each axis has multiplied it by the sum of the squared weights
            white = white[reach:-reach, reach:-reach] / np.sum(shape**2)
        amplitude = self.amplitude
        if isinstance(amplitude, str):
            amplitude = residual_amplitude(block.exposure.filter, amplitude)
        return array * (1.0 + amplitude * white)

    expected = apply


@dataclasses.dataclass(frozen=True)
class Photons(Effect):
    """
    Surface brightness to electrons: calibration, flat field, Poisson noise.

    Parameters
    ----------
    flat : bool, optional
        Whether the flat field of the instrument multiplies the light.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> exposure = Exposure("F770W", n_groups=10, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> from miricigale.detector import ADConversion, Photons
    >>> ramp = Detector((Photons(flat=False), ADConversion())).expose(
    ...     sky, exposure, seed=1
    ... )
    >>> print(f"{ramp.data[0, -1].mean():.0f} electrons in the last group")
    48 electrons in the last group
    """

    flat: bool = True

    def apply(self, array, block):
        """Turn surface brightness (MJy/sr) into a ramp (electrons)."""
        mean = self.expected(array, block) * block.group_time
        ramp = np.zeros(block.ramp_shape, np.float32)
        add_poisson(ramp, np.ascontiguousarray(mean, float), block.key, block.rows.start)
        return ramp

    def expected(self, array, block):
        """Return the electrons per second of the brightness (MJy/sr)."""
        exposure = block.exposure
        part = {"subarray": exposure.subarray}
        rate = array * electrons_per_brightness(exposure.filter, block.properties, **part)
        if self.flat:
            rate = rate * flat_field(exposure.filter, **part)[block.rows]
        return rate
