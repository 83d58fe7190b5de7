"""Passbands: curves, synthetic photometry, weights for fast band averages; catalogs by band."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "band_names": ("cigale_band", "filter_of_band"),
        "catalog_files": ("read_catalog_photometry",),
        "catalog_map": ("CatalogMap",),
        "surveys": ("SURVEYS",),
        "filter": ("Filter",),
        "filter_set": ("FilterSet", "filter_table"),
    },
)
