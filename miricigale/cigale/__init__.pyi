from .best_models import best_model_table as best_model_table
from .best_models import write_best_models as write_best_models
from .catalog import read_cigale_catalog as read_cigale_catalog
from .results import read_cigale_results as read_cigale_results
from .results import write_cigale_results as write_cigale_results
from .run import fit_cigale as fit_cigale
from .run import read_pcigale_ini as read_pcigale_ini
from .setup import CigaleSetup as CigaleSetup
