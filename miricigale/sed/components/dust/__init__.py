"""Emission of dust in galaxies; the energy is what attenuation took."""

from miricigale.sed.components.dust.base import DustEmission
from miricigale.sed.components.dust.dl07 import DraineLi2007, DraineLi2007Alpha

__all__ = ["DraineLi2007", "DraineLi2007Alpha", "DustEmission"]
