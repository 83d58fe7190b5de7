"""Scenes: catalogs of galaxies painted through the instrument's distortion and PSF."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "background": ("Background",),
        "catalog": ("CATALOG_COLUMNS", "CatalogFlags", "check_catalog"),
        "catalog_files": ("read_catalog",),
        "cutouts": ("Cutout",),
        "deconvolution": ("deconvolve",),
        "highres": ("depth_to_rms", "highres_image"),
        "render": ("FieldPainter", "Painter"),
        "scene": ("Scene", "SceneFlags"),
    },
)
