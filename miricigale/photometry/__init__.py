"""Measure fluxes: detection, forced photometry with templates, apertures, error models."""

from miricigale.photometry.aperture import aperture_photometry, source_extractor_photometry
from miricigale.photometry.corrections import aperture_correction, encircled_flux, flux_scaling
from miricigale.photometry.detection import (
    DETECTION_PRESETS,
    DetectionFlags,
    DetectionPreset,
    detect_sources,
)
from miricigale.photometry.error_model import YANG2021_DEPTHS, ErrorModel
from miricigale.photometry.flags import ForcedFlags
from miricigale.photometry.forced import ForcedPhotometer
from miricigale.photometry.limits import sensitivity, sensitivity_table
from miricigale.photometry.results import ForcedPhotometryResult, crowded

__all__ = [
    "DETECTION_PRESETS",
    "YANG2021_DEPTHS",
    "DetectionFlags",
    "DetectionPreset",
    "ErrorModel",
    "ForcedFlags",
    "ForcedPhotometer",
    "ForcedPhotometryResult",
    "aperture_correction",
    "aperture_photometry",
    "crowded",
    "detect_sources",
    "encircled_flux",
    "flux_scaling",
    "sensitivity",
    "sensitivity_table",
    "source_extractor_photometry",
]
