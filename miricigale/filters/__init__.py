"""Passbands: curves, synthetic photometry, weights for fast band averages; catalogs by band."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
