"""
Numbers of AGN in a survey, with a selection function.

`AGNSurvey` fits a catalog of photometry and the same with light of AGN added to it. `draw_shares` is the
hierarchical sum over posteriors from which the numbers are.
"""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
