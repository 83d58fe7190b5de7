"""From ramps to calibrated images and mosaics: the `Reducer` and its steps."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
