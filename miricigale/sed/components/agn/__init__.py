"""Active nuclei: accretion disk, dusty torus and polar dust."""

from miricigale.sed.components.agn.base import AGN, AGNTemplates, TorusSpectra
from miricigale.sed.components.agn.parametric import ParametricTorus
from miricigale.sed.components.agn.skirtor import Skirtor2016

__all__ = ["AGN", "AGNTemplates", "ParametricTorus", "Skirtor2016", "TorusSpectra"]
