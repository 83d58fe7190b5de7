from . import agn as agn
from . import cigale as cigale
from . import depth as depth
from . import detector as detector
from . import evaluation as evaluation
from . import filters as filters
from . import fitting as fitting
from . import injection as injection
from . import instrument as instrument
from . import photometry as photometry
from . import planning as planning
from . import plotting as plotting
from . import profiles as profiles
from . import psf as psf
from . import reduction as reduction
from . import refdata as refdata
from . import scene as scene
from . import sed as sed
from . import workflow as workflow
from .detector import Detector as Detector
from .detector import Ramp as Ramp
from .filters import Filter as Filter
from .filters import FilterSet as FilterSet
from .fitting import BayesFitter as BayesFitter
from .fitting import FitResults as FitResults
from .instrument import Exposure as Exposure
from .photometry import ErrorModel as ErrorModel
from .photometry import ForcedPhotometer as ForcedPhotometer
from .psf import MatchingKernel as MatchingKernel
from .reduction import Reducer as Reducer
from .scene import Scene as Scene
from .sed import SED as SED
from .sed import ModelGrid as ModelGrid
from .sed import SEDModel as SEDModel
from .utils.configuration import conf as conf

__citation__: str
__version__: str
