"""
Point spread functions as photutils models, and the kernels between them.

Every PSF says what it includes, its pixel scale, its frame and angle.
"""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
