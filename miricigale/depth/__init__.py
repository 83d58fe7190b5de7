"""How deep an exposure goes: what saturates, how faint a source is measured, published limits."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
