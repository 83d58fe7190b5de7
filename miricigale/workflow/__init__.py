"""The whole study: configuration, stages, and a runner that resumes."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
