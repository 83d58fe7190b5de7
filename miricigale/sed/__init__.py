"""
Spectral energy distributions: what galaxies and AGN send out, as components in a chain.

`SEDModel` holds the chain, `SED` is a spectrum, `ModelGrid` the factorised flux tables
that the grid fitter uses; the links of the chain stand in `miricigale.sed.components`.
"""

from miricigale.sed import components
from miricigale.sed.component import COMPONENTS, Component
from miricigale.sed.grid import ModelGrid
from miricigale.sed.model import ModelSpectra, SEDModel
from miricigale.sed.parameter import Parameter
from miricigale.sed.presets import yang2021_axes
from miricigale.sed.spectrum import COSMOLOGY, SED
from miricigale.sed.tables import ModelFlags

__all__ = [
    "COMPONENTS",
    "COSMOLOGY",
    "SED",
    "Component",
    "ModelFlags",
    "ModelGrid",
    "ModelSpectra",
    "Parameter",
    "SEDModel",
    "components",
    "yang2021_axes",
]
