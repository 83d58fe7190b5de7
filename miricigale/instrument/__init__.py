"""What MIRI and the sky plane are: plain values that scene, detector and reduction share."""

from miricigale.instrument.detector import (
    DetectorProperties,
    bad_pixel_mask,
    field_mask,
    flat_field,
    miri_detector,
    reference_pixel_mask,
)
from miricigale.instrument.dithers import dither_offsets, dither_patterns, read_dithers
from miricigale.instrument.etc import (
    EtcSetup,
    etc_setup,
    residual_amplitude,
    residual_presets,
)
from miricigale.instrument.exposure import (
    CEERS_FILTERS,
    Exposure,
    ceers_exposures,
    frame_time,
    readout_patterns,
)
from miricigale.instrument.figures import imager_filters
from miricigale.instrument.sensitivity import (
    background_level,
    background_spectrum,
    etc_limit,
    photmjsr,
    proposal_limit,
    psf_fwhm,
    saturation_forecast,
    saturation_time,
    scaled_limit,
)
from miricigale.instrument.siaf import (
    Aperture,
    aperture,
    attitude_matrix,
    imager_columns,
    pixel_to_v2v3,
    subarrays,
    v2v3_to_sky,
)
from miricigale.instrument.wcs import (
    imager_wcs,
    mosaic_wcs,
    north_up_wcs,
    pixel_area_map,
    pixel_to_sky,
    tangent_offset,
)

__all__ = [
    "CEERS_FILTERS",
    "Aperture",
    "DetectorProperties",
    "EtcSetup",
    "Exposure",
    "aperture",
    "attitude_matrix",
    "background_level",
    "background_spectrum",
    "bad_pixel_mask",
    "ceers_exposures",
    "dither_offsets",
    "dither_patterns",
    "etc_limit",
    "etc_setup",
    "field_mask",
    "flat_field",
    "frame_time",
    "imager_columns",
    "imager_filters",
    "imager_wcs",
    "miri_detector",
    "mosaic_wcs",
    "north_up_wcs",
    "photmjsr",
    "pixel_area_map",
    "pixel_to_sky",
    "pixel_to_v2v3",
    "proposal_limit",
    "psf_fwhm",
    "read_dithers",
    "readout_patterns",
    "reference_pixel_mask",
    "residual_amplitude",
    "residual_presets",
    "saturation_forecast",
    "saturation_time",
    "scaled_limit",
    "subarrays",
    "tangent_offset",
    "v2v3_to_sky",
]
