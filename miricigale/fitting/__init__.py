"""
Bayesian fits of galaxy and AGN spectra to photometry.

`BayesFitter` evaluates every model of a `~miricigale.sed.ModelGrid`, or lets a nested sampler choose
models, and returns `FitResults`, posteriors of all parameters and derived quantities. `Samples` are
models drawn from them, `mock_analysis` and `leave_out` show how far they can be trusted.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
