"""HTML pages from text, tables and figures; they know nothing of astronomy."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
