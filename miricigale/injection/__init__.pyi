from .completeness import CompletenessCurve as CompletenessCurve
from .results import InjectionResult as InjectionResult
from .sessions import Injection as Injection
