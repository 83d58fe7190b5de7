"""Scenes: catalogs of galaxies painted through the instrument's distortion and PSF."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
