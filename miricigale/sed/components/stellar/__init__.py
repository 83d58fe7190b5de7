"""Light of stars from simple stellar populations."""

from miricigale.sed.components.stellar.base import StellarPopulations
from miricigale.sed.components.stellar.bc03 import BC03
from miricigale.sed.components.stellar.library import BC03Library

__all__ = ["BC03", "BC03Library", "StellarPopulations"]
