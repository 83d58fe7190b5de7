"""
Bayesian fits of galaxy and AGN spectra to photometry.

`BayesFitter` evaluates every model of a `~miricigale.sed.ModelGrid` and returns `FitResults`,
posteriors of all parameters and derived quantities.
"""

from miricigale.fitting.fitter import BayesFitter
from miricigale.fitting.flags import FitFlags
from miricigale.fitting.result import FitResult
from miricigale.fitting.results import FitResults

__all__ = ["BayesFitter", "FitFlags", "FitResult", "FitResults"]
