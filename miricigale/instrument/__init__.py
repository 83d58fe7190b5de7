"""What MIRI and the sky plane are: plain values that scene, detector and reduction share."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "detector": (
            "DetectorProperties",
            "bad_pixel_mask",
            "field_mask",
            "flat_field",
            "miri_detector",
            "reference_pixel_mask",
        ),
        "dithers": ("dither_offsets", "dither_patterns", "read_dithers", "tile_offsets"),
        "dq": ("DQ", "dq_legend", "dq_planes", "read_dq", "with_own_bits"),
        "exposure": (
            "CEERS_FILTERS",
            "Exposure",
            "ceers_exposures",
            "frame_time",
            "readout_patterns",
        ),
        "image_files": ("read_image", "write_image"),
        "figures": ("imager_filters",),
        "keywords": ("READOUT_NAMES", "STEPS", "exposure_keywords", "joined_header", "steps_done"),
        "photometric": (
            "background_level",
            "background_spectrum",
            "electron_rate",
            "electrons_per_brightness",
            "photmjsr",
            "psf_fwhm",
        ),
        "image_facts": ("ImageFacts",),
        "siaf": (
            "Aperture",
            "aperture",
            "attitude_matrix",
            "imager_columns",
            "pixel_to_v2v3",
            "subarrays",
            "v2v3_to_sky",
        ),
        "wcs": (
            "imager_wcs",
            "mosaic_wcs",
            "north_up_wcs",
            "pixel_area_map",
            "pixel_to_sky",
            "tangent_offset",
        ),
    },
)
