"""Inject sources into real images and ramps: completeness, purity, bias and calibration of errors."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
