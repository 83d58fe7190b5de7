"""The detector: a tuple of effects, applied block by block."""

import dataclasses
import itertools
import logging
import math
import re
from pathlib import Path

import numpy as np

from miricigale.depth.saturation import SKY_FRACTION, SaturationForecast, saturation_forecast
from miricigale.detector import level1b
from miricigale.detector.collected import Charge
from miricigale.detector.effects.base import Block, Effect
from miricigale.detector.effects.charge import Persistence
from miricigale.detector.effects.light import Residual
from miricigale.detector.effects.migration import BrighterFatter
from miricigale.detector.effects.order import (
    ORDER,
    check_order,
    checked_effects,
    effect_from_record,
    keyed,
    place_of,
)
from miricigale.detector.effects.readout import ReadNoise
from miricigale.detector.effects.reset import FirstFrame, LastFrame, ResetAnomaly, ResetDecay
from miricigale.detector.image import checked_light
from miricigale.detector.latent import checked_previous
from miricigale.detector.ramp import Ramp
from miricigale.detector.work import Work
from miricigale.instrument import DetectorProperties, miri_detector
from miricigale.instrument.published_tables import table
from miricigale.utils.exceptions import DetectorWarning, argument_error, unknown_name, warn
from miricigale.utils.interactive import Interactive
from miricigale.utils.meta import provenance
from miricigale.utils.named_values import field_values
from miricigale.utils.options import check_kind, check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.parallel import check_memory
from miricigale.utils.random import check_seed
from miricigale.utils.units import SURFACE_BRIGHTNESS
from miricigale.utils.values import value_class

logger = logging.getLogger(__name__)

#: What acts unless it is asked for more.
_OPTIONAL = (Residual, BrighterFatter, Persistence, ResetAnomaly, ResetDecay, FirstFrame, LastFrame)
_STANDARD = [kind for kind in ORDER if kind not in _OPTIONAL]

_EXPOSE_TO = "expose fewer groups, or write it by 'expose_to'"


def _effect_class(name):
    """Return the class of effects of a name, in any spelling: CosmicRays, cosmic_rays, "cosmic rays"."""
    classes = {kind.__name__.lower(): kind for kind in ORDER}
    plain_name = re.sub(r"[\s_-]", "", name).lower()
    if plain_name not in classes:
        raise unknown_name("effect", name, [kind.__name__ for kind in ORDER])
    return classes[plain_name]


@takes_other_keywords
@value_class
class Detector(Interactive):
    """
    A detector: effects in the order in which they act.

    Parameters
    ----------
    effects : iterable of `~miricigale.detector.Effect` or str, optional
        The effects of `miri_imager` by default, or a set of them by name (``"flight"``). They must be in the
        order of ``miricigale.detector.effects.order.ORDER``: the first ones act on light, `Photons` makes a ramp
        of it, and `ADConversion` is the last. Effects of other kinds stay where they are put.
    properties : `~miricigale.instrument.DetectorProperties`, optional
        Gain, noise and the rest; `~miricigale.instrument.miri_detector` if not given.

    Raises
    ------
    ValueError
        If ``effects`` holds something that is no effect, the order is wrong, there is not exactly one `Photons`,
        or `ADConversion` is not the last.

    Examples
    --------
    >>> from miricigale.detector import ADConversion, Detector, Photons, ReadNoise
    >>> Detector((Photons(), ReadNoise(), ADConversion())).effects
    (Photons(flat=True), ReadNoise(sigma=None, pink=0.0, octaves=16), ADConversion())
    """

    _parts = ("properties",)

    effects: tuple | None = None
    _: dataclasses.KW_ONLY
    properties: DetectorProperties | None = None

    def __post_init__(self):
        if self.effects is None:
            effects = [kind() for kind in _STANDARD]
        elif isinstance(self.effects, str):
            effects = type(self).miri_imager(self.effects).effects
        else:
            effects = self.effects
        object.__setattr__(self, "effects", checked_effects(effects))
        check_order(self.effects)
        check_kind(self.properties, "properties", DetectorProperties)
        if self.properties is None:
            object.__setattr__(self, "properties", miri_detector())

    @classmethod
    def miri_imager(cls, *effects, properties=None):
        """
        Return the MIRI imager's detector.

        Parameters
        ----------
        *effects : `~miricigale.detector.Effect` or str
            Effects with settings of their own, or beyond the standard ones; see `replace`. ``"flight"``
            stands for all optional ones but `Residual` at the amplitudes of flight, as far as these are
            published; what follows replaces them.
        properties : `~miricigale.instrument.DetectorProperties`, optional
            `~miricigale.instrument.miri_detector` if not given.

        Returns
        -------
        detector : `Detector`
            With photons, dark current, interpixel capacitance, cosmic rays, bad and reference
            pixels, saturation, non-linearity, bias, read noise and conversion.

        Raises
        ------
        KeyError
            If no set of effects has that name.

        Examples
        --------
        >>> from miricigale.detector import CosmicRays, Detector, ReadNoise, Residual
        >>> detector = Detector.miri_imager(Residual("etc"), ReadNoise(pink=2.0))
        >>> [type(effect).__name__ for effect in detector.without(CosmicRays).effects][:3]
        ['Residual', 'Photons', 'Dark']
        >>> [type(effect).__name__ for effect in Detector.miri_imager("flight").effects][2:4]
        ['BrighterFatter', 'InterpixelCapacitance']
        """
        sets = table("effects")
        check_names([e for e in effects if isinstance(e, str)], "set of effects", sets)
        parts = (map(effect_from_record, sets[e]) if isinstance(e, str) else [e] for e in effects)
        return cls(properties=properties).replace(*itertools.chain.from_iterable(parts))

    def replace(self, *effects, **properties):
        """
        Return a detector with other effects: each takes the place of those of its kind.

        Parameters
        ----------
        *effects : `~miricigale.detector.Effect`
            Where there is none of the kind, it is put where the order wants it.
        **properties
            Other values of ``properties``, such as ``read_noise=12`` (see
            `~miricigale.instrument.DetectorProperties`).

        Returns
        -------
        detector : `Detector`

        Raises
        ------
        ValueError
            If it is no effect, or one of a kind that has no place in the order.
        """
        chain = list(self.effects)
        for effect in effects:
            place = place_of(effect)
            wanted = "of the package's kinds (make a Detector of a tuple with any other)"
            check_that(place is not None, "effects", wanted, repr(effect))
            chain = [e for e in chain if place_of(e) != place]
            after = [i for i, e in enumerate(chain) if (place_of(e) or 0) > place]
            chain.insert(after[0] if after else len(chain), effect)
        check_names(properties, "property", field_values(self.properties))
        numbers = self.properties
        if properties:
            numbers = numbers.replace(**properties)
        return type(self)(chain, properties=numbers)

    def without(self, *kinds):
        """
        Return the detector without some effects.

        Parameters
        ----------
        *kinds : type or str
            Classes of effects, such as `CosmicRays`, or their names (``"cosmic_rays"``). Photons and the
            conversion must stay.

        Returns
        -------
        detector : `Detector`

        Raises
        ------
        KeyError
            If no effect of the package has the name.
        ValueError
            If a kind is no class of effects, or the others are no detector.

        Examples
        --------
        >>> from miricigale.detector import Detector
        >>> detector = Detector().without("cosmic_rays")
        >>> "CosmicRays" in repr(detector)
        False
        """
        classes = []
        for kind in kinds:
            if isinstance(kind, str):
                kind = _effect_class(kind)
            good = isinstance(kind, type) and issubclass(kind, Effect)
            check_that(good, "kinds", "classes of effects", repr(kind))
            classes.append(kind)
        chain = [effect for effect in self.effects if not isinstance(effect, tuple(classes))]
        return type(self)(chain, properties=self.properties)

    def __repr__(self):
        names = " -> ".join(type(effect).__name__ for effect in self.effects)
        return f"<Detector {names}>"

    def _facts(self):
        return {type(effect).__name__: effect for effect in self.effects}

    @takes_other_keywords
    def expose(
        self, image, exposure=None, *, seed=None, previous=None, n_threads=None, progress_bar=False
    ):
        """
        Expose the detector to a scene.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData` or `~miricigale.scene.Scene`
            Noiseless surface brightness (MJy/sr), shape ``exposure.shape``, sky included; of a scene what it
            renders.
            What its ``meta["psf_includes"]`` names (a list such as ``["pixel", "ipc"]``, or
            its text) is not applied again. A list of scenes of exposures gives a list of ramps.
        exposure : `~miricigale.instrument.Exposure`, optional
            How it is exposed; a scene of an exposure knows.
        seed : int, `~numpy.random.Generator` or None, optional
            Seed of the run. Every effect has its own stream in each exposure (distinguished
            by filter and dither) and detector row.
        previous : `Latent` or iterable of `Latent`, optional
            Exposures before, for a detector with `Persistence`.
        n_threads : int, optional
            Number of threads; as many as there are processors if not given. It changes nothing
            in the result.
        progress_bar : bool, optional
            Whether a progress bar is shown.

        Returns
        -------
        ramp : `Ramp` or list of `Ramp`
            Counts (uint16) with flags of pixels and groups.

        Raises
        ------
        `~astropy.units.UnitsError`
            If the image has no unit of surface brightness.
        ValueError
            If the image has another shape, another filter or place on the sky (where its
            ``meta["filter"]`` and WCS state it), masked pixels, values that are not finite or that
            are negative, or ``previous`` belongs to another sub-array or is of no use to this
            detector.

        Warns
        -----
        `~miricigale.utils.exceptions.DetectorWarning`
            If the sky alone fills the well before the last group.
        """
        if isinstance(image, (list, tuple)):
            wanted = "left out for a list of scenes"
            check_that(exposure is None, "exposure", wanted + ", which have theirs", exposure)
            check_that(previous is None, "previous", wanted + ": expose them one by one", previous)
            options = {"seed": seed, "n_threads": n_threads, "progress_bar": progress_bar}
            return [self.expose(scene, **options) for scene in image]
        task = self._task(image, exposure, seed, previous)
        shape = task.shape
        # counts, and flags of groups where all have some
        check_memory(3 * math.prod(shape), f"a ramp of shape {shape}", advice=_EXPOSE_TO)
        data = np.empty(shape, np.uint16)
        pixel_dq = np.zeros(shape[2:], np.uint32)
        # only flagged rows are ever written, so that the rest takes no memory
        group_dq = np.zeros(shape, np.uint8)

        def store(rows, counts, pixel_flags, group_flags):
            data[:, :, rows] = counts
            pixel_dq[rows] = pixel_flags
            for i, g, r in np.argwhere(group_flags.any(axis=3)):
                group_dq[i, g, rows.start + r] = group_flags[i, g, r]

        task.run(store, n_threads, progress_bar)
        return Ramp(
            data,
            task.exposure,
            pixel_dq=pixel_dq,
            group_dq=group_dq,
            effects=task.effects,
            properties=self.properties,
            meta=task.meta,
        )

    __call__ = expose

    def expose_to(
        self,
        path,
        image,
        exposure=None,
        *,
        seed=None,
        previous=None,
        start=None,
        overwrite=False,
        n_threads=None,
        progress_bar=False,
    ):
        """
        Expose the detector to a scene and write the level-1b file block by block.

        The file is the one that ``expose(...).write(path)`` makes, byte for byte but for the
        dates, and no more than the blocks in hand are ever in memory.

        Parameters
        ----------
        path : path-like
            The file; it appears under its name only when it is complete.
        image, exposure, seed, previous, n_threads, progress_bar : optional
            As for `expose`.
        start, overwrite : optional
            As for `Ramp.write`.

        Returns
        -------
        path : `pathlib.Path`

        Raises
        ------
        OSError
            If the file exists and ``overwrite`` is False.
        ValueError
            As `expose`.
        """
        path = Path(path)
        task = self._task(image, exposure, seed, previous)
        pixel_dq = np.zeros(task.shape[2:], np.uint32)
        writer = level1b.row_writer(path, task.exposure, start=start, overwrite=overwrite)
        with writer as (write_rows, finish):

            def store(rows, counts, pixel_flags, group_flags):
                # level 1b holds no flags of groups
                write_rows(rows, counts)
                pixel_dq[rows] = pixel_flags

            task.run(store, n_threads, progress_bar)
            finish(pixel_dq, task.effects, task.meta, self.properties)
        return path

    def collect(
        self, image, exposure=None, *, seed=None, previous=None, n_threads=None, progress_bar=False
    ):
        """
        Expose the detector to a scene without following the groups.

        What is collected stands for the ramp of `expose` in
        `~miricigale.reduction.Reducer.fit_ramp`, which draws from it the slopes that it would
        fit: for planning, at a small part of the cost. Flat field, residual pattern, bad pixels
        and hits of cosmic rays are those of the ramp with the same seed; photon and read noise
        are other draws.

        Parameters
        ----------
        image, exposure, seed, previous, n_threads, progress_bar : optional
            As for `expose`.

        Returns
        -------
        charge : `Charge`

        Raises
        ------
        `~astropy.units.UnitsError`
            As `expose`.
        ValueError
            As `expose`; or if the detector has 1/f noise, the brighter-fatter effect, a decay after resets,
            or effects of other kinds than the package's; or if groups are means of several frames.

        Warns
        -----
        `~miricigale.utils.exceptions.DetectorWarning`
            As `expose`.

        Notes
        -----
        Charge comes at a constant rate within the exposure, that of latent images too, and
        noise of the level after a reset is left out.
        """
        for effect in self.effects:
            pink = isinstance(effect, ReadNoise) and effect.pink > 0
            if pink or isinstance(effect, (BrighterFatter, ResetDecay)) or place_of(effect) is None:
                raise argument_error(
                    "effects",
                    "the package's own, without 1/f noise, brighter-fatter effect and decay after resets, "
                    "to be collected without groups",
                    repr(effect),
                )
        seed = check_seed(seed)
        task = self._task(image, exposure, seed, previous)
        wanted = "one of groups that are single frames, to be collected without them"
        one_frame = task.exposure.n_frames == 1
        check_that(one_frame, "exposure", wanted, task.exposure.readout)
        *planes, pixel_dq = task.collect(n_threads, progress_bar)
        return Charge(
            task.exposure, *planes, pixel_dq, task.effects, self.properties, seed, task.meta
        )

    def forecast(self, image, exposure=None, *, sources=None):
        """
        Say what an exposure will saturate, without simulating it.

        The mean rate of charge of every pixel is what the effects make of the light (flat field,
        dark current, interpixel capacitance where it acts); noise, cosmic rays and latent images
        are left out. It is constant, so that a pixel is full in group ceil(well / (rate x group
        time)). The well is that of `Saturation`, or the charge at which the converter ends.

        Parameters
        ----------
        image, exposure
            As for `expose`.
        sources : `~astropy.table.Table`, optional
            Sources with ``id`` and pixel positions ``x``, ``y``, such as the ``truth`` of a
            scene; those off the image are passed over. The brightest of the 3 x 3 pixels
            around a source counts as its peak.

        Returns
        -------
        forecast : `~miricigale.depth.SaturationForecast`

        Raises
        ------
        `~astropy.units.UnitsError`, ValueError
            As `expose`; or if a column is missing.

        Warns
        -----
        `~miricigale.utils.exceptions.DetectorWarning`
            If the sky fills more than 60 % of the well by the last group.
        """
        light, exposure, included = checked_light(image, exposure)
        effects = self._acting(included)
        block = Block(exposure, self.properties, slice(0, light.shape[0]), None, None, None)
        for effect in effects:
            light = effect.expected(light, block)
        limit = min(effect.limit(self.properties) for effect in effects)
        forecast = SaturationForecast.from_rate(light, exposure, limit, sources)
        if forecast.sky_too_bright:
            message = _sky_message(exposure, forecast.sky_fraction)
            warn(message, DetectorWarning)
        return forecast

    def _acting(self, included):
        """Return the effects that an image does not hold already."""
        return tuple(e for e in self.effects if e.included_as not in included)

    def _task(self, image, exposure, seed, previous):
        """Check what is exposed and gather what all its blocks share."""
        light, exposure, included = checked_light(image, exposure)
        seed = check_seed(seed)
        effects = self._acting(included)
        previous = checked_previous(previous, exposure)
        if previous and not any(isinstance(e, Persistence) for e in self.effects):
            raise argument_error(
                "previous", "given to a detector whose effects hold Persistence", "one without it"
            )
        fraction = self._check_sky(light, exposure)
        meta = provenance(
            seed=seed,
            psf_includes=sorted(included),
            sky_well_fraction=round(fraction, 4),
            previous=[repr(latent) for latent in previous] or None,
        )
        return Work(
            light, exposure, self.properties, keyed(effects, seed, exposure), previous, meta
        )

    def _check_sky(self, light, exposure):
        """Share of the full well that the median pixel fills in one integration."""
        fraction = saturation_forecast(
            exposure, background=np.median(light) * SURFACE_BRIGHTNESS, detector=self.properties
        )
        message = _sky_message(exposure, fraction)
        if fraction >= 1:
            warn(message, DetectorWarning)
        elif fraction > SKY_FRACTION:
            logger.warning(message)
        return fraction


def _sky_message(exposure, fraction):
    return (
        f"the sky in {exposure.filter} fills {100 * fraction:.0f} % of the full well by the "
        f"last of {exposure.n_groups} groups: take fewer groups and more integrations"
    )
