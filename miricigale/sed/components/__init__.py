"""The links of a model's chain, by what they do."""

from miricigale.sed.components.agn import AGN, AGNTemplates, Skirtor2016, TorusSpectra
from miricigale.sed.components.attenuation import (
    SMC,
    Attenuation,
    CalzettiLeitherer,
    CharlotFall,
    ModifiedStarburst,
)
from miricigale.sed.components.dust import (
    Casey2012,
    Dale2014,
    DraineLi2007,
    DraineLi2007Alpha,
    DustEmission,
)
from miricigale.sed.components.igm import IGM, Inoue2014, Madau1995, Meiksin2006
from miricigale.sed.components.nebular import Nebular
from miricigale.sed.components.parametric_torus import ParametricTorus
from miricigale.sed.components.sfh import (
    ConstantSFH,
    DelayedSFH,
    DoubleExponentialSFH,
    StarFormationHistory,
    TableSFH,
)
from miricigale.sed.components.stellar import BC03, BC03Library, StellarPopulations
from miricigale.sed.foreground import GalacticExtinction
from miricigale.sed.xray import XRay
