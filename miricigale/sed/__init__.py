"""
Spectral energy distributions: what galaxies and AGN send out, as components in a chain.

`SEDModel` holds the chain, `SED` is a spectrum, `ModelGrid` the factorised flux tables
that the grid fitter uses; the links of the chain stand in `miricigale.sed.components`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
