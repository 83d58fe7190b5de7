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
    FirstFrame,
    InterpixelCapacitance,
    LastFrame,
    Latent,
    Nonlinearity,
    Persistence,
    Photons,
    ReadNoise,
    ReferencePixels,
    ResetAnomaly,
    Residual,
    Saturation,
)
from miricigale.detector.forecast import SaturationForecast, forecast_table
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
    "FirstFrame",
    "InterpixelCapacitance",
    "LastFrame",
    "Latent",
    "Nonlinearity",
    "Persistence",
    "Photons",
    "Ramp",
    "ReadNoise",
    "ReferencePixels",
    "ResetAnomaly",
    "Residual",
    "Saturation",
    "SaturationForecast",
    "forecast_table",
]
