"""
Bayesian fits of galaxy and AGN spectra to photometry.

`BayesFitter` evaluates every model of a `~miricigale.sed.ModelGrid`, or lets a nested sampler choose
models, and returns `FitResults`, posteriors of all parameters and derived quantities. `Samples` are
models drawn from them, `mock_analysis` and `leave_out` show how far they can be trusted.
"""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "calibration": (
            "TemplateError",
            "apply_zero_points",
            "calibrate_zero_points",
            "measure_band_errors",
            "measure_priors",
            "measure_template_error",
        ),
        "checks": ("LeaveOutResult", "MockResult", "leave_out", "mock_analysis"),
        "classification": ("compare_classes",),
        "fitter": ("BayesFitter",),
        "from_files": ("fit_catalog",),
        "io": ("FitResultsFiles", "open_results"),
        "likelihood": ("FitFlags",),
        "priors": ("magnitude_prior",),
        "results": ("FitResults",),
        "samples": ("Samples",),
        "settings": ("GridSettings", "SamplerSettings"),
        "streaming": ("fit_file",),
    },
)
