"""The detector: a tuple of effects, applied block by block."""

import concurrent.futures
import functools
import logging
import warnings

import numba
import numpy as np

from miricigale.detector.effects import (
    ADConversion,
    BadPixels,
    Bias,
    Block,
    CosmicRays,
    Dark,
    Effect,
    InterpixelCapacitance,
    Nonlinearity,
    Photons,
    ReadNoise,
    ReferencePixels,
    Residual,
    Saturation,
    stream_key,
)
from miricigale.detector.ramp import Ramp
from miricigale.instrument import DetectorProperties, Exposure, miri_detector, saturation_forecast
from miricigale.utils.exceptions import MiricigaleWarning, argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.parallel import parallel_map
from miricigale.utils.random import check_seed
from miricigale.utils.units import SURFACE_BRIGHTNESS, to_array

__all__ = ["Detector"]

logger = logging.getLogger(__name__)

# samples (float32) that one thread has in hand: a few MB, so that they stay in the cache
_BLOCK_SAMPLES = 2**21

# share of the full well from which the sky is spoken of
_SKY_FRACTION = 0.6


class Detector:
    """
    A detector: effects in the order in which they act.

    Parameters
    ----------
    effects : iterable of `~miricigale.detector.Effect`
        The first act on light; `Photons` makes a ramp of it; `ADConversion` ends.
    properties : `~miricigale.instrument.DetectorProperties`, optional
        Gain, noise and the rest; `~miricigale.instrument.miri_detector` if not given.

    Examples
    --------
    >>> from miricigale.detector import ADConversion, Detector, Photons, ReadNoise
    >>> Detector((Photons(), ReadNoise(), ADConversion())).effects
    (Photons(flat=True), ReadNoise(sigma=None, pink=0.0, octaves=16), ADConversion())
    """

    def __init__(self, effects, *, properties=None):
        effects = tuple(effects)
        for effect in effects:
            if not isinstance(effect, Effect):
                raise argument_error("effects", "made of detector effects", repr(effect))
        properties = miri_detector() if properties is None else properties
        if not isinstance(properties, DetectorProperties):
            raise argument_error("properties", "a DetectorProperties", repr(properties))
        self._effects = effects
        self._properties = properties

    @classmethod
    def miri_imager(
        cls,
        *,
        residual=False,
        showers=False,
        cosmic_rays=True,
        bad_pixels=True,
        pink_noise=0.0,
        properties=None,
    ):
        """
        The MIRI imager's detector.

        Parameters
        ----------
        residual : float or False, optional
            Fraction of the light that stays as a fixed pattern (`Residual`); False for
            none.
        showers : bool or float, optional
            Share of the cosmic rays that make showers; True for 0.001.
        cosmic_rays, bad_pixels : bool, optional
            Whether there are any.
        pink_noise : float, optional
            Standard deviation of the 1/f noise in DN.
        properties : `~miricigale.instrument.DetectorProperties`, optional
            `~miricigale.instrument.miri_detector` if not given.

        Returns
        -------
        detector : `Detector`
        """
        if residual is True:
            raise argument_error("residual", "False or a fraction of the light", residual)
        effects = []
        if residual:
            effects.append(Residual(float(residual)))
        effects += [Photons(), Dark(), InterpixelCapacitance()]
        if cosmic_rays:
            fraction = 0.001 if showers is True else float(showers)
            effects.append(CosmicRays(shower_fraction=fraction))
        if bad_pixels:
            effects.append(BadPixels())
        effects += [
            ReferencePixels(),
            Saturation(),
            Nonlinearity(),
            Bias(),
            ReadNoise(pink=float(pink_noise)),
            ADConversion(),
        ]
        return cls(effects, properties=properties)

    @property
    def effects(self):
        """The effects in their order, a tuple."""
        return self._effects

    @property
    def properties(self):
        """The `~miricigale.instrument.DetectorProperties`."""
        return self._properties

    def __repr__(self):
        lines = ",\n    ".join(map(repr, self._effects))
        return f"Detector((\n    {lines},\n))"

    def expose(self, image, exposure, *, seed=None, n_threads=None, progress_bar=False):
        """
        Expose the detector to a scene.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            Noiseless surface brightness (MJy/sr), shape ``exposure.shape``, sky included.
            What its ``meta["psf_includes"]`` names (such as ``"ipc"``) is not applied
            again.
        exposure : `~miricigale.instrument.Exposure`
            How it is exposed.
        seed : int, `~numpy.random.Generator` or None, optional
            Seed of the run. Every effect has its own stream in each exposure (told apart
            by filter and dither) and detector row.
        n_threads : int, optional
            Number of threads; as many as there are processors if not given
            (``NUMBA_NUM_THREADS``). It changes nothing in the result.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        ramp : `Ramp`
            Counts (uint16) with flags of pixels and groups.

        Raises
        ------
        `~astropy.units.UnitsError`
            If the image has no unit of surface brightness.
        ValueError
            If the image has another shape, values that are not finite or that are negative.

        Warns
        -----
        `~miricigale.utils.exceptions.MiricigaleWarning`
            If the sky alone fills the well before the last group.
        """
        light = self._light(image, exposure)
        seed = check_seed(seed)
        if n_threads is None:
            n_threads = numba.config.NUMBA_NUM_THREADS
        if n_threads < 1:
            raise argument_error("n_threads", "at least 1", n_threads)
        included = set(getattr(image, "meta", {}).get("psf_includes", ()))
        effects = tuple(e for e in self._effects if e.included_as not in included)
        fraction = self._check_sky(light, exposure)

        ny, nx = exposure.shape
        shape = (exposure.n_integrations, exposure.n_groups, ny, nx)
        data = np.empty(shape, np.uint16)
        pixel_dq = np.zeros((ny, nx), np.uint32)
        # only flagged rows are ever written, so that the rest takes no memory
        group_dq = np.zeros(shape, np.uint8)
        height = max(1, _BLOCK_SAMPLES // (shape[0] * shape[1] * nx))
        work = functools.partial(
            self._expose_rows,
            _keyed(effects, seed, exposure),
            light,
            exposure,
            (data, pixel_dq, group_dq),
        )
        starts = range(0, ny, height)
        blocks = [slice(start, min(start + height, ny)) for start in starts]
        desc = f"ramp {exposure.filter}"
        if n_threads == 1:
            parallel_map(work, blocks, progress_bar=progress_bar, desc=desc)
        else:
            with concurrent.futures.ThreadPoolExecutor(n_threads) as pool:
                parallel_map(work, blocks, executor=pool, progress_bar=progress_bar, desc=desc)
        meta = provenance(
            seed=seed,
            effects=[repr(effect) for effect in effects],
            psf_includes=sorted(included),
            sky_well_fraction=round(fraction, 4),
        )
        return Ramp(data, exposure, pixel_dq=pixel_dq, group_dq=group_dq, meta=meta)

    def _expose_rows(self, keyed, light, exposure, out, rows):
        """Apply the effects to some rows and put the counts where they belong."""
        data, pixel_dq, group_dq = out
        halo = sum(effect.halo for effect, _ in keyed)
        wide = slice(max(rows.start - halo, 0), min(rows.stop + halo, light.shape[0]))
        shape = (*data.shape[:2], wide.stop - wide.start, data.shape[3])
        block_pixel_dq = np.zeros(shape[2:], np.uint32)
        block_group_dq = np.zeros(shape, np.uint8)
        array = light[wide]
        for effect, key in keyed:
            block = Block(exposure, self._properties, wide, block_pixel_dq, block_group_dq, key)
            array = effect.apply(array, block)
        if array.shape != shape or array.dtype != np.uint16:
            msg = (
                "'effects' must turn light into counts, beginning with Photons and ending with "
                f"ADConversion, got {[type(effect).__name__ for effect, _ in keyed]}"
            )
            raise ValueError(msg)
        inner = slice(rows.start - wide.start, rows.stop - wide.start)
        data[:, :, rows] = array[:, :, inner]
        pixel_dq[rows] = block_pixel_dq[inner]
        flags = block_group_dq[:, :, inner]
        for i, g, r in np.argwhere(flags.any(axis=3)):
            group_dq[i, g, rows.start + r] = flags[i, g, r]

    def _light(self, image, exposure):
        """Surface brightness as an array, checked."""
        if not isinstance(exposure, Exposure):
            raise argument_error("exposure", "an Exposure", type(exposure).__name__)
        if getattr(image, "unit", None) is None:
            msg = f"'image' must be a CCDData in {SURFACE_BRIGHTNESS}, got {type(image).__name__}"
            raise TypeError(msg)
        data = getattr(image, "data", None) if not hasattr(image, "to_value") else image.value
        if np.shape(data) != tuple(exposure.shape):
            raise argument_error(
                "image", f"of the exposure's shape {tuple(exposure.shape)}", np.shape(data)
            )
        light = to_array(data * image.unit, SURFACE_BRIGHTNESS, "image", ndim=2, finite=True)
        lowest = light.min()
        # an FFT leaves noise of this size around bright sources
        if lowest < -1e-6 * np.abs(light).max():
            raise argument_error("image", "surface brightness that is nowhere negative", lowest)
        return np.maximum(light, 0.0)

    def _check_sky(self, light, exposure):
        """Share of the full well that the median pixel fills in one integration."""
        fraction = saturation_forecast(
            exposure, background=np.median(light) * SURFACE_BRIGHTNESS, detector=self._properties
        )
        message = (
            f"the sky in {exposure.filter} fills {100 * fraction:.0f} % of the full well by the "
            f"last of {exposure.n_groups} groups: take fewer groups and more integrations"
        )
        if fraction >= 1:
            warnings.warn(message, MiricigaleWarning, stacklevel=3)
        elif fraction > _SKY_FRACTION:
            logger.warning(message)
        return fraction


def _keyed(effects, seed, exposure):
    """Pair each effect with the key of its streams; a second one of a kind has its own."""
    seen = {}
    keyed = []
    for effect in effects:
        kind = type(effect).__name__
        seen[kind] = seen.get(kind, 0) + 1
        name = kind if seen[kind] == 1 else f"{kind} {seen[kind]}"
        keyed.append((effect, stream_key(seed, exposure, name)))
    return tuple(keyed)
