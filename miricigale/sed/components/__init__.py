"""The links of a model's chain, by what they do."""

from miricigale.sed.components.agn import AGN, AGNTemplates, ParametricTorus, TorusSpectra
from miricigale.sed.components.attenuation import Attenuation, CalzettiLeitherer
from miricigale.sed.components.dust import DraineLi2007, DraineLi2007Alpha, DustEmission
from miricigale.sed.components.igm import IGM, Madau1995, Meiksin2006
from miricigale.sed.components.sfh import DelayedSFH, StarFormationHistory
from miricigale.sed.components.stellar import BC03, StellarPopulations

__all__ = [
    "AGN",
    "BC03",
    "IGM",
    "AGNTemplates",
    "Attenuation",
    "CalzettiLeitherer",
    "DelayedSFH",
    "DraineLi2007",
    "DraineLi2007Alpha",
    "DustEmission",
    "Madau1995",
    "Meiksin2006",
    "ParametricTorus",
    "StarFormationHistory",
    "StellarPopulations",
    "TorusSpectra",
]
