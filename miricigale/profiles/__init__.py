"""Sersic and point-source light on a pixel grid."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "ellipse": ("ellipse_through", "ellipse_to_pixels"),
        "sersic": (
            "SERSIC_INDEX_RANGE",
            "sersic_bn",
            "sersic_enclosed_fraction",
            "sersic_image",
            "sersic_radius",
            "sersic_stamp",
        ),
    },
)
