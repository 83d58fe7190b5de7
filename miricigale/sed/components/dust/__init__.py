"""Emission of dust in galaxies; the energy is what attenuation took."""

from miricigale.sed.components.dust.base import DustEmission
from miricigale.sed.components.dust.casey2012 import Casey2012
from miricigale.sed.components.dust.dale2014 import Dale2014
from miricigale.sed.components.dust.dl07 import DraineLi2007, DraineLi2007Alpha

__all__ = [
    "Casey2012",
    "Dale2014",
    "DraineLi2007",
    "DraineLi2007Alpha",
    "DustEmission",
]
