"""The order in which the effects act, and what it says of a tuple of them."""

import itertools

from miricigale.detector.effects.base import Effect, OtherEffect, stream_key
from miricigale.detector.effects.charge import (
    BadPixels,
    Dark,
    InterpixelCapacitance,
    Persistence,
    ReferencePixels,
    Saturation,
)
from miricigale.detector.effects.cosmic_rays import CosmicRays
from miricigale.detector.effects.light import Photons, Residual
from miricigale.detector.effects.migration import BrighterFatter
from miricigale.detector.effects.readout import ADConversion, Bias, Nonlinearity, ReadNoise
from miricigale.detector.effects.reset import FirstFrame, LastFrame, ResetAnomaly, ResetDecay
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that

#: The order in which the effects act. Others may stand anywhere after `Photons`.
ORDER = (
    Residual,
    Photons,
    Dark,
    BrighterFatter,
    InterpixelCapacitance,
    CosmicRays,
    Persistence,
    BadPixels,
    ReferencePixels,
    Saturation,
    Nonlinearity,
    ResetAnomaly,
    ResetDecay,
    FirstFrame,
    LastFrame,
    Bias,
    ReadNoise,
    ADConversion,
)


def effect_from_record(record):
    """
    Return the effect that `Effect.record` described.

    Parameters
    ----------
    record : dict
        A record.

    Returns
    -------
    effect : `Effect`
        `OtherEffect` where it is none of `ORDER`.
    """
    settings = dict(record)
    name = settings.pop("effect")
    kind = next((kind for kind in ORDER if kind.__name__ == name), None)
    if kind is None:
        return OtherEffect(name, tuple(settings.items()))
    return kind(**settings)


def checked_effects(effects):
    """Return the effects as a tuple; anything that is not an effect is refused."""
    if isinstance(effects, str):
        wanted = "a tuple of effects (Detector() and Detector.miri_imager('flight') have theirs)"
        raise argument_error("effects", wanted, repr(effects))
    effects = tuple(effects)
    for effect in effects:
        check_that(isinstance(effect, Effect), "effects", "made of detector effects", repr(effect))
    return effects


def place_of(effect):
    """Place of an effect in the order; None for one of another kind."""
    return next((i for i, kind in enumerate(ORDER) if isinstance(effect, kind)), None)


def check_order(effects):
    """Refuse effects that cannot turn light into counts, or that do not act in their order."""
    names = ", ".join(type(effect).__name__ for effect in effects)
    good = sum(isinstance(effect, Photons) for effect in effects) == 1
    check_that(good, "effects", "a tuple with one Photons in it", names or "none")
    wanted = "a tuple that ends with ADConversion"
    check_that(isinstance(effects[-1], ADConversion), "effects", wanted, names)
    placed = [(place, effect) for effect in effects if (place := place_of(effect)) is not None]
    for (place, effect), (following, successor) in itertools.pairwise(placed):
        wanted = f"in their order, {type(successor).__name__} before {type(effect).__name__}"
        check_that(place <= following, "effects", wanted, names)


def keyed(effects, seed, exposure):
    """Pair each effect with the key of its streams; a second one of a kind has its own."""
    counts = {}
    keyed = []
    for effect in effects:
        kind = type(effect).__name__
        counts[kind] = counts.get(kind, 0) + 1
        name = kind
        if counts[kind] != 1:
            name = f"{kind} {counts[kind]}"
        keyed.append((effect, stream_key(seed, exposure, name)))
    return tuple(keyed)
