"""From light to counts: the detector, its effects and the ramps it makes."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
