"""Sersic and point-source light on a pixel grid."""

from miricigale.profiles.ellipse import ellipse_through, ellipse_to_pixels
from miricigale.profiles.sersic import (
    SERSIC_INDEX_RANGE,
    sersic_bn,
    sersic_enclosed_fraction,
    sersic_image,
    sersic_radius,
    sersic_stamp,
)

__all__ = [
    "SERSIC_INDEX_RANGE",
    "ellipse_through",
    "ellipse_to_pixels",
    "sersic_bn",
    "sersic_enclosed_fraction",
    "sersic_image",
    "sersic_radius",
    "sersic_stamp",
]
