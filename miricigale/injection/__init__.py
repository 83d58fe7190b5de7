"""Inject sources into real images and ramps: completeness, purity, bias and calibration of errors."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
