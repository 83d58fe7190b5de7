"""Measure fluxes: detection, forced photometry with templates, apertures, error models."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "aperture": ("aperture_photometry", "source_extractor_photometry"),
        "bands": ("join_bands", "measure_bands"),
        "corrections": ("aperture_correction", "encircled_flux", "flux_scaling"),
        "detection": (
            "DETECTION_PRESETS",
            "DetectionFlags",
            "DetectionPreset",
            "detect_sources",
            "detection_purity",
        ),
        "error_calibration": ("ErrorCalibration",),
        "error_model": ("ErrorModel",),
        "fields": ("SmoothField",),
        "flags": ("ForcedFlags",),
        "forced": ("ForcedPhotometer",),
        "from_files": ("measure_files",),
        "injection": ("calibrate_errors",),
        "offsets": ("OffsetMap",),
        "mosaics": ("MosaicFile", "read_mosaic"),
        "priors": ("read_prior",),
        "segments": ("DILATION_RULES", "DilationRule", "dilate_segments"),
        "settings": ("ErrorSettings", "MemorySettings"),
        "sky_noise": ("weight_scale",),
        "sources": ("SourceTemplates",),
        "results": ("ForcedPhotometryResult", "crowded"),
        "stars": ("psf_photometry",),
        "surveys": ("YANG2021_DEPTHS",),
        "yang2021": ("Yang2021Photometer",),
    },
    moved={"miricigale.depth": ("sensitivity", "sensitivity_table")},
)
