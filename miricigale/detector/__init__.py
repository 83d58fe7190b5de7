"""From light to counts: the detector, its effects and the ramps it makes."""

from miricigale.detector.detector import Detector
from miricigale.detector.dq import DQ
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
)
from miricigale.detector.ramp import Ramp

__all__ = [
    "DQ",
    "ADConversion",
    "BadPixels",
    "Bias",
    "Block",
    "CosmicRays",
    "Dark",
    "Detector",
    "Effect",
    "InterpixelCapacitance",
    "Nonlinearity",
    "Photons",
    "Ramp",
    "ReadNoise",
    "ReferencePixels",
    "Residual",
    "Saturation",
]
