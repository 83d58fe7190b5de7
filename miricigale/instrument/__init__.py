"""What MIRI and the sky plane are: plain values that scene, detector and reduction share."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
