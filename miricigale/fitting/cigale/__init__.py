"""Files of CIGALE: catalogues, configurations and results."""

from miricigale.fitting.cigale.bands import cigale_band, filter_of_band
from miricigale.fitting.cigale.catalog import read_cigale_catalog
from miricigale.fitting.cigale.reader import fit_cigale, read_pcigale_ini
from miricigale.fitting.cigale.results import read_cigale_results, write_cigale_results
from miricigale.fitting.cigale.setup import CigaleSetup

__all__ = [
    "CigaleSetup",
    "cigale_band",
    "filter_of_band",
    "fit_cigale",
    "read_cigale_catalog",
    "read_cigale_results",
    "read_pcigale_ini",
    "write_cigale_results",
]
