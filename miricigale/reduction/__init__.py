"""From ramps to calibrated images and mosaics: the `Reducer` and its steps."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "align": ("Alignment", "align_images", "align_to_catalog"),
        "background": (
            "Background",
            "BackgroundFlags",
            "estimate_background",
            "remove_background",
            "subtract_background",
        ),
        "calibration": ("calibrate", "find_cosmic_rays"),
        "dither_background": ("dither_backgrounds",),
        "files": ("ImageFile", "open_exposure", "read_images", "write_image"),
        "from_files": ("reduce_files",),
        "mosaic": (
            "Mosaic",
            "drizzle_images",
            "noise_correction",
            "pixel_map",
            "reject_outliers",
            "weight_map",
        ),
        "rampfit": ("RampFit", "fit_groups"),
        "measured_noise": ("MeasuredNoise", "measure_noise"),
        "reference_cache": ("ReferenceCache",),
        "reference_pixels": ("reference_channels", "reference_drift"),
        "reducer": ("Reducer",),
        "settings": ("BACKENDS", "BackgroundSettings", "MosaicSettings", "RampSettings"),
        "references": ("DetectorMaps", "ReferenceFiles"),
        "results": ("ReductionResult",),
        "sky_match": ("match_levels", "sky_offsets"),
    },
)
