"""Scenes: catalogues of galaxies painted through the instrument's distortion and PSF."""

from miricigale.scene.background import Background
from miricigale.scene.catalog import CATALOG_COLUMNS, CatalogFlags, check_catalog, read_catalog
from miricigale.scene.cutouts import Cutout
from miricigale.scene.highres import depth_to_rms, highres_image
from miricigale.scene.render import FieldPainter, Painter
from miricigale.scene.scene import Scene, SceneFlags

__all__ = [
    "CATALOG_COLUMNS",
    "Background",
    "CatalogFlags",
    "Cutout",
    "FieldPainter",
    "Painter",
    "Scene",
    "SceneFlags",
    "check_catalog",
    "depth_to_rms",
    "highres_image",
    "read_catalog",
]
