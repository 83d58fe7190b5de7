"""From ramps to calibrated images and mosaics: the `Reducer` and its steps."""

from miricigale.reduction.background import Background, estimate_background, subtract_background
from miricigale.reduction.calibration import calibrate, find_cosmic_rays
from miricigale.reduction.flags import PixelFlags
from miricigale.reduction.mosaic import (
    Mosaic,
    drizzle_images,
    noise_correction,
    pixel_map,
    reject_outliers,
    weight_map,
)
from miricigale.reduction.rampfit import RampFit, fit_groups, reference_drift
from miricigale.reduction.reducer import BACKENDS, Reducer
from miricigale.reduction.results import ReductionResult

__all__ = [
    "BACKENDS",
    "Background",
    "Mosaic",
    "PixelFlags",
    "RampFit",
    "Reducer",
    "ReductionResult",
    "calibrate",
    "drizzle_images",
    "estimate_background",
    "find_cosmic_rays",
    "fit_groups",
    "noise_correction",
    "pixel_map",
    "reference_drift",
    "reject_outliers",
    "subtract_background",
    "weight_map",
]
