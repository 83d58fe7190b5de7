"""HTML pages from text, tables and figures; they know nothing of astronomy."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
