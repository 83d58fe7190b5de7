"""Comparison of results with the truth, from tables: matches, metrics, classes, and a study with its paper."""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
