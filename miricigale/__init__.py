"""
Plan and analyse JWST/MIRI deep imaging.

The seven classes `Filter`, `SEDModel`, `Scene`, `Detector`, `Reducer`,
`ForcedPhotometer` and `BayesFitter`, and what they take and give (`SED`, `FilterSet`, `ModelGrid`,
`Exposure`, `Ramp`, `MatchingKernel`, `ErrorModel`, `FitResults`), are loaded on first use (PEP 562), as
are the subpackages, so that ``import miricigale`` opens no file and compiles nothing.
"""

from miricigale.utils.lazy_modules import attach_stub

try:
    from miricigale._version import __version__
except ImportError:  # a source tree that was never built
    __version__ = "0.0.0.dev0"

__citation__ = "See CITATION.cff; the method repeats Yang et al. 2021, ApJ 908, 144."

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
__all__ = ["__citation__", "__version__", *__all__]
