"""Comparison of results with the truth, from tables: matches, metrics, classes, and a study with its paper."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
