"""
Spectral energy distributions: what galaxies and AGN send out, as components in a chain.

`SEDModel` holds the chain, `SED` is a spectrum, `ModelGrid` the factorised flux tables
that the grid fitter uses; the links of the chain stand in `miricigale.sed.components`.
"""

from miricigale.sed import components
from miricigale.sed.component import COMPONENTS, ROLES, Component
from miricigale.sed.derived import DERIVED, Derived
from miricigale.sed.foreground import band_extinction, deredden
from miricigale.sed.grid import ModelGrid
from miricigale.sed.libraries import add_library
from miricigale.sed.model import ModelSpectra, SEDModel
from miricigale.sed.parameter import Parameter
from miricigale.sed.presets import yang2021_axes
from miricigale.sed.spectrum import COSMOLOGY, SED
from miricigale.sed.tables import ModelFlags
from miricigale.sed.xray import band_luminosity, stern2015, xray_flux

__all__ = [
    "COMPONENTS",
    "COSMOLOGY",
    "DERIVED",
    "ROLES",
    "SED",
    "Component",
    "Derived",
    "ModelFlags",
    "ModelGrid",
    "ModelSpectra",
    "Parameter",
    "SEDModel",
    "add_library",
    "band_extinction",
    "band_luminosity",
    "components",
    "deredden",
    "stern2015",
    "xray_flux",
    "yang2021_axes",
]
