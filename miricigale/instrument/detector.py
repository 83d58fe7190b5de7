"""What the detector is: figures, non-linearity, flat field, bad and reference pixels."""

import dataclasses

import astropy.units as u
import numpy as np
from numpy.polynomial import polynomial as poly

from miricigale.instrument.published_tables import filter_row, imager_filter, table
from miricigale.instrument.siaf import aperture, imager_columns
from miricigale.utils.arrays import quiet_division
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_least, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import frozen_array, to_array

#: Units of the figures of a detector, the gain first, which turns electrons into counts.
_UNITS = {
    "gain": u.electron / u.adu,
    "read_noise": u.adu,
    "dark_current": u.electron / u.s,
    "full_well": u.electron,
    "bias": u.adu,
    "pixel_pitch": u.um,
}

# Our own detector is one and the same everywhere: its pixels are drawn with this seed
_SEED = 56075


@dataclasses.dataclass(frozen=True, kw_only=True)
class DetectorProperties:
    """
    Figures of a detector.

    Parameters
    ----------
    gain : float or `~astropy.units.Quantity`
        Electrons per DN; one value for noise and photometric conversion.
    read_noise : float or `~astropy.units.Quantity`
        Of one frame, DN, or in electrons with a unit.
    dark_current : float or `~astropy.units.Quantity`
        Electrons per second.
    full_well : float or `~astropy.units.Quantity`
        Electrons.
    bias : float or `~astropy.units.Quantity`
        Level of an empty pixel, DN.
    nonlinearity : tuple of float
        Coefficients, lowest power first, of the polynomial that turns measured DN above
        the bias into linear DN. The first must be 0 and the second 1.
    ipc : tuple of float
        Share of a pixel's signal seen by each horizontal, vertical and diagonal neighbor.
    reference_columns : int
        Columns without light on each side of the full frame.
    pixel_pitch : float or `~astropy.units.Quantity`
        In um.
    cosmic_ray_flux : float
        Hits per um2 per second.
    adc_bits : int
        Bits of the converter, for the record: `~miricigale.detector.ADConversion` has 16.
    response : tuple of (str, str, float)
        Count rate of light over that of `photmjsr`, by filter and sub-array, as
        `~miricigale.reduction.imager_response` gives it for a day; 1 if there are no rows.

    Raises
    ------
    ValueError
        If gain, full well, pixel pitch or bits are not positive, another figure is negative, or the non-linearity
        polynomial does not rise up to the full well.
    `~astropy.units.UnitsError`
        If a unit is of something else.

    Examples
    --------
    >>> from miricigale.instrument import DetectorProperties
    >>> detector = DetectorProperties(gain=5.5, read_noise=8.0)
    >>> print(f"{detector.saturation_dn:.0f} DN above the bias")
    38182 DN above the bias
    """

    gain: float = 4.0
    read_noise: float = 6.0
    dark_current: float = 0.2
    full_well: float = 210e3
    bias: float = 11000.0
    nonlinearity: tuple = (0.0, 1.0)
    ipc: tuple = (0.0, 0.0, 0.0)
    reference_columns: int = 4
    pixel_pitch: float = 25.0
    cosmic_ray_flux: float = 0.0
    adc_bits: int = 16
    response: tuple = ()

    def __post_init__(self):
        for name, unit in _UNITS.items():
            value = getattr(self, name)
            if isinstance(value, u.Quantity):
                number = float(
                    to_array(value, unit, name, ndim=0, equivalencies=self._counts(unit))
                )
                object.__setattr__(self, name, number)
        for name in ("gain", "full_well", "pixel_pitch", "adc_bits"):
            check_positive(getattr(self, name), name)
        for name in ("read_noise", "dark_current", "bias", "cosmic_ray_flux", "reference_columns"):
            check_least(getattr(self, name), name, 0)
        coefficients = tuple(map(float, self.nonlinearity))
        object.__setattr__(self, "nonlinearity", coefficients)
        object.__setattr__(self, "ipc", tuple(map(float, self.ipc)))
        response = []
        for filter, array, ratio in self.response:
            response.append((str(filter), str(array), float(ratio)))
        rows = tuple(response)
        object.__setattr__(self, "response", rows)
        for *_, value in rows:
            check_positive(value, "response")
        check_that(len(self.ipc) == 3, "ipc", "three shares", self.ipc)
        wanted = "coefficients that begin with 0, 1"
        check_that(coefficients[:2] == (0.0, 1.0), "nonlinearity", wanted, self.nonlinearity)
        signal = np.linspace(0, self.full_well / self.gain, 200)
        if np.any(poly.polyval(signal, poly.polyder(coefficients)) < 0.2):
            raise argument_error("nonlinearity", "rising up to the full well", self.nonlinearity)

    replace = dataclasses.replace

    def _counts(self, unit):
        """Equivalencies of counts: DN and adu are the same, and electrons are counts times the gain."""
        if unit == _UNITS["gain"]:
            return [(u.electron / u.DN, unit)]
        gain = self.gain
        return [(u.DN, u.adu), (u.electron, u.adu, lambda n: n / gain, lambda n: n * gain)]

    @property
    def saturation_dn(self):
        """Measured (non-linear) DN above the bias of a full well."""
        return float(self.delinearize(self.full_well / self.gain))

    @property
    def ipc_kernel(self):
        """Interpixel capacitance, shape (3, 3), sum 1."""
        horizontal, vertical, diagonal = self.ipc
        center = 1 - 2 * horizontal - 2 * vertical - 4 * diagonal
        edge = [diagonal, vertical, diagonal]
        return np.array([edge, [horizontal, center, horizontal], edge])

    def relative_response(self, filter, subarray="FULL"):
        """
        Count rate of light over that of `photmjsr`.

        Parameters
        ----------
        filter, subarray : str
            Of the exposure.

        Returns
        -------
        response : float

        Raises
        ------
        ValueError
            If ``response`` has rows, and none for them.
        """
        wanted = (imager_filter(filter), subarray)
        rates = {row[:2]: row[2] for row in self.response} or {wanted: 1.0}
        condition = f"with {' and '.join(wanted)}"
        check_that(wanted in rates, "response", condition, f"{len(rates)} others")
        return rates[wanted]

    def linearize(self, dn):
        """
        Turn measured into linear signal.

        Parameters
        ----------
        dn : array_like
            Measured DN above the bias.

        Returns
        -------
        linear : `~numpy.ndarray`
            Linear DN above the bias, float64. Negative signals are left as they are.
        """
        dn = floats(dn)
        return np.where(dn > 0, poly.polyval(dn, self.nonlinearity), dn)

    def delinearize(self, dn):
        """
        Turn linear into measured signal: the inverse of `linearize` (Newton's method).

        Parameters
        ----------
        dn : array_like
            Linear DN above the bias; beyond twice the full well, where the polynomial
            means nothing, the measured signal rises in proportion.

        Returns
        -------
        measured : `~numpy.ndarray`
            Measured DN above the bias, float64; `linearize` gives ``dn`` back to 1e-6 DN
            below twice the full well.
        """
        linear = floats(dn)
        top = 2 * self.full_well / self.gain
        target = np.clip(linear, 0, top)
        measured = target.copy()
        derivative = poly.polyder(self.nonlinearity)
        for _ in range(30):
            excess = poly.polyval(measured, self.nonlinearity) - target
            step = excess / poly.polyval(measured, derivative)
            measured -= step
            if np.all(np.abs(step) < 1e-9 * (1 + target)):
                break
        with quiet_division():
            clipped = np.where(linear > top, measured * linear / top, measured)
        return np.where(linear > 0, clipped, linear)


@cached
def miri_detector():
    """
    Return the imager's detector.

    Returns
    -------
    detector : `DetectorProperties`
        In-flight figures of the user documentation; the non-linearity has the measured
        size and a smooth form of our own.

    Examples
    --------
    >>> from miricigale.instrument import miri_detector
    >>> detector = miri_detector()
    >>> detector.gain, detector.read_noise, detector.full_well
    (4.0, 6.0, 210000.0)
    """
    return DetectorProperties(**table()["detector"])


@cached(maxsize=2)
def _flat_pixels(seed):
    return stream(seed, "flat", "pixels").standard_normal(aperture("FULL").shape, np.float32)


@cached(maxsize=18)
def _full_flat(filter, seed):
    from scipy.interpolate import RectBivariateSpline

    # pixels are the detector's own; what is smooth belongs to the filter as well
    pixels = _flat_pixels(seed)
    n = miri_detector().reference_columns
    x, y = (np.linspace(-1, 1, size) for size in pixels.shape[::-1])
    # a spline through random values 150 pixels apart
    knots = np.linspace(-1, 1, 8)
    values = stream(seed, "flat", filter).standard_normal((8, 8))
    smooth = RectBivariateSpline(knots, knots, values)(y, x)
    smooth /= smooth.std()
    flat = 1 + 0.01 * pixels + 0.004 * smooth - 0.01 * (x**2 + y[:, None] ** 2 - 2 / 3)
    flat[:, n:-n] /= flat[:, n:-n].mean()
    flat[:, :n] = flat[:, -n:] = 1
    return frozen_array(flat, np.float32)


@takes_other_keywords
def flat_field(filter, *, subarray="FULL", seed=_SEED):
    """
    Return the relative response of the pixels: the same for the simulated detector and the reduction.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.
    seed : int, optional
        Seed of another realization, of another detector of the kind.

    Returns
    -------
    flat : `~numpy.ndarray` of float32, shape (ny, nx)
        Mean 1 over the full frame; 1 % from pixel to pixel, as much across the field;
        1 in the reference columns. Read-only, and always the same: it is our own,
        drawn once, and no measurement.

    Examples
    --------
    >>> from miricigale.instrument import flat_field
    >>> flat = flat_field("miri.f770w")
    >>> print(f"{flat.mean():.3f} +- {flat.std():.3f}")
    1.000 +- 0.012
    """
    filter_row(filter)
    return _full_flat(str(filter), check_seed(seed))[aperture(subarray).slices]


@cached
def _full_bad_pixels():
    shape = aperture("FULL").shape
    rng = stream(_SEED, "bad pixels")
    mask = rng.random(shape) < 7e-4
    # and some clusters of a few neighbors
    rows, columns = (rng.integers(1, n - 2, size=60) for n in shape)
    for row, column in zip(rows, columns, strict=True):
        mask[row : row + 2, column : column + 3] |= rng.random((2, 3)) < 0.8
    n = miri_detector().reference_columns
    mask[:, :n] = mask[:, -n:] = False
    return frozen_array(mask, bool)


def bad_pixel_mask(*, subarray="FULL"):
    """
    Return the pixels that never work, about 0.1 %.

    ``subarray`` is as for `flat_field`.

    Returns
    -------
    mask : `~numpy.ndarray` of bool, shape (ny, nx)
        True where bad. Read-only, and always the same; reference pixels are not bad.

    Examples
    --------
    >>> from miricigale.instrument import bad_pixel_mask
    >>> print(f"{100 * bad_pixel_mask().mean():.2f} % of the pixels")
    0.10 % of the pixels
    """
    return _full_bad_pixels()[aperture(subarray).slices]


def reference_pixel_mask(*, subarray="FULL"):
    """
    Return the pixels that see no light: four columns on each side of the full frame.

    ``subarray`` is as for `flat_field`.

    Returns
    -------
    mask : `~numpy.ndarray` of bool, shape (ny, nx)

    Examples
    --------
    >>> from miricigale.instrument import reference_pixel_mask
    >>> print(reference_pixel_mask()[0].sum(), "columns")
    8 columns
    """
    n = miri_detector().reference_columns
    n_columns = aperture("FULL").shape[1]
    return ~_columns_mask(n, n_columns - n, subarray)


def _columns_mask(first, last, subarray):
    """Return the columns of the full frame from the first to before the last, in a sub-array."""
    mask = np.zeros(aperture("FULL").shape, dtype=bool)
    mask[:, first:last] = True
    return mask[aperture(subarray).slices]


def field_mask(*, subarray="FULL"):
    """
    Return the pixels that see the sky through the imaging filters.

    The others lie behind the masks of the coronagraphs (or are reference pixels). This
    is the rectangle of the aperture MIRIM_ILLUM.

    ``subarray`` is as for `flat_field`.

    Returns
    -------
    mask : `~numpy.ndarray` of bool, shape (ny, nx)
        True where the sky is seen.

    Examples
    --------
    >>> from miricigale.instrument import field_mask
    >>> print(f"{100 * field_mask().mean():.0f} % of the array")
    65 % of the array
    """
    return _columns_mask(*imager_columns(), subarray)
