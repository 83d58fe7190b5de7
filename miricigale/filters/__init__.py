"""Passbands: curves, synthetic photometry, and weights for fast band averages."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "filter": ("Filter",),
        "filter_set": ("FilterSet",),
    },
)
