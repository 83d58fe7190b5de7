from .added_light import NoiseCurve as NoiseCurve
from .added_light import add_light as add_light
from .added_light import agn_light as agn_light
from .images import AGNImages as AGNImages
from .shares import ShareDraws as ShareDraws
from .shares import draw_shares as draw_shares
from .survey import AGNResult as AGNResult
from .survey import AGNSurvey as AGNSurvey
