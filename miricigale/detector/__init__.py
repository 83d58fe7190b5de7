"""From light to counts: the detector, its effects and the ramps it makes."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "collected": ("Charge",),
        "detector": ("Detector",),
        "effects.base": ("Block", "Effect", "OtherEffect"),
        "effects.charge": (
            "BadPixels",
            "CosmicRays",
            "Dark",
            "InterpixelCapacitance",
            "Persistence",
            "ReferencePixels",
            "Saturation",
        ),
        "effects.light": ("Photons", "Residual"),
        "effects.readout": ("ADConversion", "Bias", "Nonlinearity", "ReadNoise"),
        "effects.reset": ("FirstFrame", "LastFrame", "ResetAnomaly", "ResetDecay"),
        "latent": ("Latent",),
        "ramp": ("Ramp",),
    },
)
