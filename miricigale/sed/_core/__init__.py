"""Arithmetic of spectra: arrays in, arrays out (um, W/um, Myr unless said)."""

from miricigale.sed._core.attenuation import *  # noqa: F403
from miricigale.sed._core.bands import *  # noqa: F403
from miricigale.sed._core.disk import *  # noqa: F403
from miricigale.sed._core.histories import *  # noqa: F403
from miricigale.sed._core.igm import *  # noqa: F403
from miricigale.sed._core.nebular import *  # noqa: F403
from miricigale.sed._core.nodes import *  # noqa: F403
from miricigale.sed._core.polar import *  # noqa: F403
from miricigale.sed._core.rows import *  # noqa: F403
from miricigale.sed._core.thermal import *  # noqa: F403
from miricigale.sed._core.xray import *  # noqa: F403

LIGHT = 2.99792458e14  # um / s
