"""Passbands: curves, synthetic photometry, weights for fast band averages; catalogs by band."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
