"""What MIRI and the sky plane are: plain values that scene, detector and reduction share."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
