"""
What happens between the sky and the counts, as small objects in one written order.

Each effect has one method, ``apply(array, block)``: array in, array out. What the array
is follows from the order: the scene's surface brightness (MJy/sr, shape (n_row, n_col))
until `Photons` turns it into a ramp of accumulated electrons, shape (n_int, n_group,
n_row, n_col); electrons until `Nonlinearity` turns them into DN; DN until `ADConversion`
makes unsigned integers of them. A ramp may be changed in place; the returned array is
the one that counts.

Effects act on blocks of full rows. What a row gets does not depend on the block it is in
(see `miricigale.detector._core`), so neither the height of the blocks nor the number of
threads changes a result, and a detector of any size needs little memory.
"""

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d

from miricigale.detector import _core
from miricigale.detector.dq import DQ
from miricigale.instrument import (
    DetectorProperties,
    Exposure,
    bad_pixel_mask,
    flat_field,
    photmjsr,
    reference_pixel_mask,
)
from miricigale.utils.exceptions import argument_error
from miricigale.utils.random import stream

__all__ = [
    "ADConversion",
    "BadPixels",
    "Bias",
    "Block",
    "CosmicRays",
    "Dark",
    "InterpixelCapacitance",
    "Nonlinearity",
    "Photons",
    "ReadNoise",
    "ReferencePixels",
    "Residual",
    "Saturation",
]


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Block:
    """
    Where and when an effect acts: some full rows of one exposure.

    Parameters
    ----------
    exposure : `~miricigale.instrument.Exposure`
        What is exposed.
    properties : `~miricigale.instrument.DetectorProperties`
        Gain, noise, full well and the rest.
    rows : slice
        Detector rows, start and stop given.
    pixel_dq : `~numpy.ndarray` of uint32, shape (n_row, n_col)
        Flags that effects may set (`DQ`).
    group_dq : `~numpy.ndarray` of uint8, shape (n_int, n_group, n_row, n_col)
        Flags that effects may set.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the random streams of this effect in this exposure.
    """

    exposure: Exposure
    properties: DetectorProperties
    rows: slice
    pixel_dq: np.ndarray
    group_dq: np.ndarray
    key: np.ndarray

    @property
    def group_time(self):
        """Time between the groups in s."""
        return self.exposure.group_time.to_value("s")

    @property
    def total_time(self):
        """Time during which charge is collected in all integrations in s."""
        return self.exposure.n_integrations * self.exposure.n_groups * self.group_time

    @property
    def ramp_shape(self):
        """Shape of a ramp of this block."""
        return self.group_dq.shape


def stream_key(seed, exposure, name):
    """Key words of the streams of the effect ``name`` in an exposure, uint64 (4,)."""
    rng = stream(seed, "detector", exposure.filter, exposure.dither, name)
    return rng.integers(0, 2**64 - 1, size=4, dtype=np.uint64, endpoint=True)


def _ramp(array, block, effect):
    """Check that an effect on ramps was given one."""
    if array.shape != block.ramp_shape:
        msg = (
            f"{type(effect).__name__} acts on a ramp of shape {block.ramp_shape} but was given "
            f"shape {array.shape}: 'effects' must hold Photons before it"
        )
        raise ValueError(msg)
    return array


@dataclasses.dataclass(frozen=True)
class Effect:
    """
    Base of the effects.

    ``halo`` is how many rows beside a row an effect reads; ``included_as`` is the name
    under which an image's ``psf_includes`` may say that the effect is in it already.
    """

    halo = 0
    included_as = None

    def apply(self, array, block):
        """
        Return the array as it is after the effect.

        Parameters
        ----------
        array : `~numpy.ndarray`
            Surface brightness (n_row, n_col) or ramp (n_int, n_group, n_row, n_col); may
            be changed in place.
        block : `Block`
            Where and when.

        Returns
        -------
        array : `~numpy.ndarray`
        """
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Residual(Effect):
    """
    What flat field and sky subtraction leave behind, fixed on the detector.

    Multiplies the light by 1 plus a random pattern that is the same in every exposure
    through one filter.

    Parameters
    ----------
    amplitude : float
        Standard deviation of the pattern, as a fraction of the light.
    correlation : float, optional
        Gaussian width of the pattern's correlation in pixels; 0 for white.
    pattern : int, optional
        Which random pattern: a property of the detector, apart from the exposure's seed.
    """

    amplitude: float
    correlation: float = 1.0
    pattern: int = 0

    def __post_init__(self):
        if not 0 <= self.amplitude < 0.2:
            raise argument_error("amplitude", "a fraction from 0 to 0.2", self.amplitude)
        if not 0 <= self.correlation <= 30:
            raise argument_error("correlation", "from 0 to 30 pixels", self.correlation)

    def apply(self, array, block):
        """Multiply surface brightness by the pattern."""
        reach = int(np.ceil(4 * self.correlation))
        n_row, n_col = array.shape
        rng = stream(self.pattern, "detector", "residual", block.exposure.filter)
        key = rng.integers(0, 2**64 - 1, size=4, dtype=np.uint64, endpoint=True)
        white = np.empty((n_row + 2 * reach, n_col + 2 * reach))
        # rows beyond the detector have streams of their own
        _core.standard_normals(key, block.rows.start - reach + 10_000, white)
        if reach:
            delta = np.zeros(2 * reach + 1)
            delta[reach] = 1.0
            shape = gaussian_filter1d(delta, self.correlation, truncate=4.0)
            for axis in (0, 1):
                white = gaussian_filter1d(white, self.correlation, axis=axis, truncate=4.0)
            # unit variance: each axis has multiplied it by the sum of the squared weights
            white = white[reach:-reach, reach:-reach] / np.sum(shape**2)
        return array * (1.0 + self.amplitude * white)


@dataclasses.dataclass(frozen=True)
class Photons(Effect):
    """
    Surface brightness to electrons: calibration, flat field, Poisson noise.

    Parameters
    ----------
    flat : bool, optional
        Whether the flat field of the instrument multiplies the light.
    """

    flat: bool = True

    def apply(self, array, block):
        """Turn surface brightness (MJy/sr) into a ramp (electrons)."""
        if array.ndim != 2:
            raise argument_error("effects", "a tuple with one Photons in it", "two")
        exposure = block.exposure
        gain = block.properties.gain
        mean = array * (gain / photmjsr(exposure.filter, gain=gain) * block.group_time)
        if self.flat:
            mean = mean * flat_field(exposure.filter, subarray=exposure.subarray)[block.rows]
        ramp = np.zeros(block.ramp_shape, np.float32)
        _core.add_poisson(ramp, np.ascontiguousarray(mean, float), block.key, block.rows.start)
        return ramp


@dataclasses.dataclass(frozen=True)
class Dark(Effect):
    """
    Dark current, with its Poisson noise.

    Parameters
    ----------
    current : float, optional
        Electrons per second; that of the detector's properties if not given.
    """

    current: float | None = None

    def apply(self, array, block):
        """Add the dark charge."""
        ramp = _ramp(array, block, self)
        current = block.properties.dark_current if self.current is None else self.current
        mean = np.full(ramp.shape[2:], current * block.group_time)
        _core.add_poisson(ramp, mean, block.key, block.rows.start)
        return ramp


@dataclasses.dataclass(frozen=True)
class InterpixelCapacitance(Effect):
    """
    Coupling of a pixel's voltage to its eight neighbours.

    Left out where the image's ``psf_includes`` holds ``"ipc"``.
    """

    halo = 1
    included_as = "ipc"

    def apply(self, array, block):
        """Couple the accumulated charge of neighbours."""
        ramp = _ramp(array, block, self)
        kernel = np.asarray(block.properties.ipc_kernel, np.float32)
        _core.couple_neighbours(ramp, kernel)
        return ramp


@dataclasses.dataclass(frozen=True)
class CosmicRays(Effect):
    """
    Hits by cosmic rays: straight tracks through a layer, leakage, showers if asked for.

    Particles arrive isotropically, so that the cosine of the angle of incidence is
    distributed as 2 cos; a track crosses thickness x tan(angle) of the detector plane and
    sets charge free in proportion to its length in the layer. The charge per length is
    log-normal. With the defaults half of the hits leave more than 5000 electrons, 1 % more
    than 10^5. Of each pixel's charge the share ``leakage`` goes to each of its four
    neighbours (this stands in for `InterpixelCapacitance`, which acts before).

    Parameters
    ----------
    flux : float, optional
        Hits per um^2 and s; that of the detector's properties if not given (4.9e-8 at
        solar minimum times 1.7).
    thickness : float, optional
        Thickness of the sensitive layer in um.
    yield_median : float, optional
        Median electrons per um of path.
    yield_dex : float, optional
        Scatter of that yield in dex.
    track_max : float, optional
        Longest track in pixels; longer ones are cut there.
    leakage : float, optional
        Share of the charge that goes to each of the four neighbours.
    shower_fraction : float, optional
        Share of hits that come with a shower, a faint Gaussian cloud; 0 for none.
    shower_charge : float, optional
        Median charge of a shower in electrons.
    shower_sigma : float, optional
        Its Gaussian width in pixels; painted to three times that.
    """

    flux: float | None = None
    thickness: float = 35.0
    yield_median: float = 100.0
    yield_dex: float = 0.5
    track_max: float = 16.0
    leakage: float = 0.03
    shower_fraction: float = 0.0
    shower_charge: float = 3e5
    shower_sigma: float = 15.0

    def __post_init__(self):
        if not 0 <= self.leakage <= 0.2:
            raise argument_error("leakage", "from 0 to 0.2", self.leakage)
        if not 0 <= self.shower_fraction <= 1:
            raise argument_error("shower_fraction", "from 0 to 1", self.shower_fraction)
        if not 0 <= self.track_max <= 200:
            raise argument_error("track_max", "from 0 to 200 pixels", self.track_max)

    def apply(self, array, block):
        """Add the charge of the hits."""
        ramp = _ramp(array, block, self)
        properties = block.properties
        flux = properties.cosmic_ray_flux if self.flux is None else self.flux
        pitch = properties.pixel_pitch
        hits_per_row = flux * pitch**2 * ramp.shape[3] * block.total_time
        _core.add_cosmic_rays(
            ramp,
            block.key,
            block.rows.start,
            block.exposure.shape[0],
            float(hits_per_row),
            float(self.thickness / pitch),
            float(self.yield_median * pitch),
            float(self.yield_dex * np.log(10.0)),
            float(self.track_max),
            float(self.leakage),
            float(self.shower_fraction),
            float(self.shower_charge),
            float(self.shower_sigma),
        )
        return ramp


@dataclasses.dataclass(frozen=True)
class BadPixels(Effect):
    """
    Pixels that do not work, as the instrument's mask has them.

    Every second bad pixel (by row plus column) is dead: it collects nothing. The others are hot:
    they collect more dark current. Both are flagged DO_NOT_USE.

    Parameters
    ----------
    hot_current : float, optional
        Additional dark current of hot pixels in electrons per second.
    """

    hot_current: float = 300.0

    def apply(self, array, block):
        """Empty the dead pixels and heat the hot ones."""
        ramp = _ramp(array, block, self)
        bad = bad_pixel_mask(subarray=block.exposure.subarray)[block.rows]
        y, x = np.indices(bad.shape)
        dead = bad & ((y + block.rows.start + x) % 2 == 0)
        hot = bad & ~dead
        ramp[:, :, dead] = 0.0
        mean = np.where(hot, self.hot_current * block.group_time, 0.0)
        _core.add_poisson(ramp, mean, block.key, block.rows.start)
        block.pixel_dq[dead] |= np.uint32(DQ.DEAD | DQ.DO_NOT_USE)
        block.pixel_dq[hot] |= np.uint32(DQ.HOT | DQ.DO_NOT_USE)
        return ramp


@dataclasses.dataclass(frozen=True)
class ReferencePixels(Effect):
    """
    Columns at both sides of the full frame that see no light and collect no charge.

    They share bias, drift and read noise with the others, and are flagged
    REFERENCE_PIXEL and NON_SCIENCE.
    """

    def apply(self, array, block):
        """Empty the reference columns."""
        ramp = _ramp(array, block, self)
        mask = reference_pixel_mask(subarray=block.exposure.subarray)[block.rows]
        ramp[:, :, mask] = 0.0
        block.pixel_dq[mask] |= np.uint32(DQ.REFERENCE_PIXEL | DQ.NON_SCIENCE)
        return ramp


@dataclasses.dataclass(frozen=True)
class Saturation(Effect):
    """
    Charge stops at the full well; the groups from there on are flagged SATURATED.

    Parameters
    ----------
    full_well : float, optional
        In electrons; that of the detector's properties if not given.
    """

    full_well: float | None = None

    def apply(self, array, block):
        """Clip the charge and flag it."""
        ramp = _ramp(array, block, self)
        well = block.properties.full_well if self.full_well is None else self.full_well
        _core.clip_well(ramp, float(well), block.group_dq, np.uint8(DQ.SATURATED))
        return ramp


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
    """

    linear: bool = False

    def apply(self, array, block):
        """Turn electrons into DN above the bias."""
        ramp = _ramp(array, block, self)
        properties = block.properties
        step = 8.0
        nodes = step * np.arange(
            int(np.ceil(1.05 * properties.full_well / properties.gain / step)) + 2
        )
        response = nodes if self.linear else properties.delinearize(nodes)
        response = np.ascontiguousarray(response, np.float32)
        _core.interpolate_response(ramp, float(properties.gain), response, step)
        return ramp


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
    """

    level: float | None = None
    reset_noise: float = 0.0

    def apply(self, array, block):
        """Add the level."""
        ramp = _ramp(array, block, self)
        level = block.properties.bias if self.level is None else self.level
        ramp += np.float32(level)
        if self.reset_noise:
            offset = np.empty(ramp.shape[2:])
            for i in range(ramp.shape[0]):
                # integrations are told apart by the row that the stream is for
                first = block.rows.start + (i + 1) * 2**20
                _core.standard_normals(block.key, first, offset)
                ramp[i] += np.asarray(self.reset_noise * offset, np.float32)
        return ramp


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
    """

    sigma: float | None = None
    pink: float = 0.0
    octaves: int = 16

    def apply(self, array, block):
        """Add the noise."""
        ramp = _ramp(array, block, self)
        sigma = block.properties.read_noise if self.sigma is None else self.sigma
        first = block.rows.start
        _core.add_noise(ramp, float(sigma), block.key, first)
        if self.pink:
            # streams apart from those of the white noise
            key = block.key[::-1].copy()
            n_rows = block.exposure.shape[0]
            _core.add_pink_noise(ramp, float(self.pink), int(self.octaves), 4, key, first, n_rows)
        return ramp


@dataclasses.dataclass(frozen=True)
class ADConversion(Effect):
    """Rounding to unsigned 16-bit numbers; out of range flagged AD_FLOOR or SATURATED."""

    def apply(self, array, block):
        """Turn DN into counts."""
        ramp = _ramp(array, block, self)
        counts = np.empty(ramp.shape, np.uint16)
        _core.digitize(ramp, counts, block.group_dq, np.uint8(DQ.AD_FLOOR), np.uint8(DQ.SATURATED))
        return counts
