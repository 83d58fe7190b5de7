"""The bundled simple stellar populations."""

from miricigale.refdata.libraries.bc03 import load_ssp
from miricigale.sed.component import register
from miricigale.sed.components.stellar.base import StellarPopulations
from miricigale.sed.parameter import Parameter

__all__ = ["BC03"]


@register
class BC03(StellarPopulations):
    """
    Bruzual & Charlot 2003 (2016 version, MILES), bundled, thinned; Kroupa IMF (inferred).

    Six metallicities; others are refused rather than interpolated, and so is the source's
    seventh, 0.1, whose populations below 300 Myr lack most of their light. The living mass
    leaves out remnants. Yang et al. 2021 use BC03 of 2003 with a Chabrier IMF: light for each
    solar mass differs by 0.03 dex, ionising photons by 0.12 dex.
    """

    name = "bc03"
    reference = "Bruzual & Charlot 2003, MNRAS 344, 1000"
    resource = "ssp.bc03"
    imf = "Kroupa (inferred)"
    metallicity = Parameter(
        default=0.02,
        bounds=(0.0001, 0.05),
        doc="Mass fraction of metals: 0.0001, 0.0004, 0.004, 0.008, 0.02 (solar) or 0.05.",
    )

    def nodes(self):
        return load_ssp(self.path)[0]

    def metallicities(self):
        highest = type(self).metallicity.bounds[1]
        return tuple(z for z in load_ssp(self.path)[2] if z <= highest)

    def table(self, metallicity):
        _, age, spectra, living = load_ssp(self.path)
        key = self.nearest(metallicity)
        return age, spectra[key], living[key]
