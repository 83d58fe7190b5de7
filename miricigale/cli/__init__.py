"""The command line: a thin layer over the workflow and the classes."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, {"program": ("command", "main")})
