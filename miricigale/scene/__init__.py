"""Scenes: catalogs of galaxies painted through the instrument's distortion and PSF."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
