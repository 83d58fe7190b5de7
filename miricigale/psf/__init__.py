"""
Point spread functions as photutils models, and the kernels between them.

Every PSF says what it includes, its pixel scale, its frame and angle.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
