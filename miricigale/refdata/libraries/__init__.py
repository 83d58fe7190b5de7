"""Spectral libraries that users bring: read as distributed, kept as memory-mapped FITS."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
