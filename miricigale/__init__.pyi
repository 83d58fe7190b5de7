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
