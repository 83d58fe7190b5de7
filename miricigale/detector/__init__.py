"""From light to counts: the detector, its effects and the ramps it makes."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "collected": ("Charge",),
        "detector": ("Detector",),
        "effects": (
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
            "ResetDecay",
            "Residual",
            "Saturation",
        ),
        "latent": ("Latent",),
        "ramp": ("Ramp",),
    },
)
