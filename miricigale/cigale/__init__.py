"""Files of CIGALE (Boquien et al. 2019): catalogs, configurations and results."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "best_models": ("best_model_table", "write_best_models"),
        "catalog": ("cigale_columns", "read_cigale_catalog"),
        "results": ("read_cigale_results", "write_cigale_results"),
        "run": ("fit_cigale", "read_pcigale_ini"),
        "setup": ("CigaleSetup",),
    },
)
