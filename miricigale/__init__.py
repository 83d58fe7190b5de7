"""
Plan and analyse JWST/MIRI deep imaging.

The seven classes `Filter`, `SEDModel`, `Scene`, `Detector`, `Reducer`,
`ForcedPhotometer` and `BayesFitter` (and `SED`, `FilterSet`) are loaded on first use
(PEP 562), so that ``import miricigale`` opens no file and compiles nothing.
"""

import importlib

try:
    from miricigale._version import __version__
except ImportError:  # a source tree that was never built
    __version__ = "0.0.0.dev0"

_PUBLIC = {
    "BayesFitter": "miricigale.fitting",
    "Detector": "miricigale.detector",
    "Exposure": "miricigale.instrument",
    "Filter": "miricigale.filters",
    "FilterSet": "miricigale.filters",
    "ForcedPhotometer": "miricigale.photometry",
    "Reducer": "miricigale.reduction",
    "SED": "miricigale.sed",
    "SEDModel": "miricigale.sed",
    "Scene": "miricigale.scene",
}

__all__ = ["__citation__", "__version__", *_PUBLIC]

__citation__ = "See CITATION.cff; the method repeats Yang et al. 2021, ApJ 908, 144."


def __getattr__(name):
    if name in _PUBLIC:
        return getattr(importlib.import_module(_PUBLIC[name]), name)
    msg = f"module 'miricigale' has no attribute {name!r}"
    raise AttributeError(msg)


def __dir__():
    return sorted({*globals(), *_PUBLIC})
