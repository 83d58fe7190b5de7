"""Active nuclei: accretion disk, dusty torus and polar dust."""

from miricigale.sed.components.agn.base import AGN, AGNTemplates, TorusSpectra
from miricigale.sed.components.agn.parametric import ParametricTorus

__all__ = ["AGN", "AGNTemplates", "ParametricTorus", "TorusSpectra"]
