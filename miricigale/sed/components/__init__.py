"""The links of a model's chain, by what they do."""

from miricigale.sed.components.agn import *  # noqa: F403
from miricigale.sed.components.attenuation import *  # noqa: F403
from miricigale.sed.components.dust import *  # noqa: F403
from miricigale.sed.components.igm import *  # noqa: F403
from miricigale.sed.components.nebular import *  # noqa: F403
from miricigale.sed.components.parametric_torus import *  # noqa: F403
from miricigale.sed.components.sfh import *  # noqa: F403
from miricigale.sed.components.stellar import *  # noqa: F403
from miricigale.sed.foreground import GalacticExtinction  # noqa: F401
from miricigale.sed.xray import XRay  # noqa: F401
