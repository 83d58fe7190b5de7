"""What exposures would yield: noise, fits of mock photometry, times."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
