"""Files of CIGALE (Boquien et al. 2019): catalogs, configurations and results."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
