"""
Bayesian fits of galaxy and AGN spectra to photometry.

`BayesFitter` evaluates every model of a `~miricigale.sed.ModelGrid` and returns `FitResults`,
posteriors of all parameters and derived quantities. `Samples` are models drawn from them,
`mock_analysis` and `leave_out` tell how far they can be trusted.
"""

from miricigale.fitting.cigale import (
    CigaleSetup,
    fit_cigale,
    read_cigale_catalog,
    read_cigale_results,
    read_pcigale_ini,
    write_cigale_results,
)
from miricigale.fitting.continuous import ContinuousFitter
from miricigale.fitting.continuous_results import ContinuousResults
from miricigale.fitting.fitter import BayesFitter
from miricigale.fitting.flags import FitFlags
from miricigale.fitting.left_out import LeaveOutResult, leave_out
from miricigale.fitting.mocks import MockResult, mock_analysis
from miricigale.fitting.part_files import FitResultsFiles, open_results
from miricigale.fitting.result import FitResult
from miricigale.fitting.results import FitResults
from miricigale.fitting.samples import Samples
from miricigale.fitting.streaming import OtherFitError, fit_file

__all__ = [
    "BayesFitter",
    "CigaleSetup",
    "ContinuousFitter",
    "ContinuousResults",
    "FitFlags",
    "FitResult",
    "FitResults",
    "FitResultsFiles",
    "LeaveOutResult",
    "MockResult",
    "OtherFitError",
    "Samples",
    "fit_cigale",
    "fit_file",
    "leave_out",
    "mock_analysis",
    "open_results",
    "read_cigale_catalog",
    "read_cigale_results",
    "read_pcigale_ini",
    "write_cigale_results",
]
