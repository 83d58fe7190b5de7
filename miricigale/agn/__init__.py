"""
Numbers of AGN in a survey, with a selection function.

`AGNSurvey` fits a catalog of photometry and the same with light of AGN added to it. `draw_shares` is the
hierarchical sum over posteriors from which the numbers are.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
