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

import ast

from miricigale.detector.effects.base import Block, Effect, OtherEffect, stream_key
from miricigale.detector.effects.charge import (
    BadPixels,
    CosmicRays,
    Dark,
    InterpixelCapacitance,
    Persistence,
    ReferencePixels,
    Saturation,
)
from miricigale.detector.effects.light import Photons, Residual
from miricigale.detector.effects.readout import ADConversion, Bias, Nonlinearity, ReadNoise
from miricigale.detector.effects.reset import FirstFrame, LastFrame, ResetAnomaly

__all__ = [
    "ORDER",
    "ADConversion",
    "BadPixels",
    "Bias",
    "Block",
    "CosmicRays",
    "Dark",
    "Effect",
    "FirstFrame",
    "InterpixelCapacitance",
    "LastFrame",
    "Nonlinearity",
    "OtherEffect",
    "Persistence",
    "Photons",
    "ReadNoise",
    "ReferencePixels",
    "ResetAnomaly",
    "Residual",
    "Saturation",
    "effect_from_record",
    "stream_key",
]

#: The order in which the effects act. Others may stand anywhere after `Photons`.
ORDER = (
    Residual,
    Photons,
    Dark,
    InterpixelCapacitance,
    CosmicRays,
    Persistence,
    BadPixels,
    ReferencePixels,
    Saturation,
    Nonlinearity,
    ResetAnomaly,
    FirstFrame,
    LastFrame,
    Bias,
    ReadNoise,
    ADConversion,
)


def effect_from_record(record):
    """
    Effect that `Effect.record` described.

    Parameters
    ----------
    record : dict or str
        A record; or, in files of earlier versions, the effect's repr.

    Returns
    -------
    effect : `Effect`
        `OtherEffect` where it is none of `ORDER`.
    """
    if isinstance(record, str):
        call = ast.parse(record, mode="eval").body
        record = {word.arg: ast.literal_eval(word.value) for word in call.keywords}
        record["effect"] = call.func.id
    settings = dict(record)
    name = settings.pop("effect")
    for kind in ORDER:
        if kind.__name__ == name:
            return kind(**settings)
    return OtherEffect(name, tuple(settings.items()))
