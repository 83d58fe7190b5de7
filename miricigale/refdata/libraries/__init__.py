"""Spectral libraries that users bring: read as distributed, kept as memory-mapped FITS."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
