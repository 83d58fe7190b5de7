"""
Spectral energy distributions: what galaxies and AGN send out, as components in a chain.

`SEDModel` holds the chain, `SED` is a spectrum, `ModelGrid` the factorised flux tables
that the grid fitter uses; the links of the chain stand in `miricigale.sed.components`.
"""

from miricigale.utils.lazy_modules import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
