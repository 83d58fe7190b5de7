"""
Bayesian fits of galaxy and AGN spectra to photometry.

`BayesFitter` evaluates every model of a `~miricigale.sed.ModelGrid`, or lets a nested sampler choose
models, and returns `FitResults`, posteriors of all parameters and derived quantities. `Samples` are
models drawn from them, `mock_analysis` and `leave_out` show how far they can be trusted.
"""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
