"""How deep an exposure goes: what saturates, how faint a source is measured, published limits."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
