"""Templates of Dale et al. 2014, a sequence in one parameter."""

import functools

import numpy as np

from miricigale.refdata.libraries.table import open_library
from miricigale.sed.component import register
from miricigale.sed.components.dust.base import DustEmission
from miricigale.sed.parameter import Parameter

__all__ = ["Dale2014"]


@functools.lru_cache(maxsize=4)
def _sequence(library, column):
    """Alphas and spectra of an open library, in memory."""
    order = np.argsort(library.axes["alpha"])
    spectra = np.array(library.spectra[column], dtype=float)[order]
    spectra.flags.writeable = False
    return library.axes["alpha"][order], spectra


@register
class Dale2014(DustEmission):
    """
    Dale et al. 2014 without AGN: dust mass goes as dM ~ U^-alpha dU in the intensity U.

    The 64 templates (alpha in steps of 1/16) are those of the distributed files, normalised to
    1 W; between them a spectrum is the linear interpolation of its neighbours. The option
    ``starlight`` says whether the starlight that CIGALE's builder takes away near 2 um is
    taken away here (``"removed"``) or not (``"kept"``). The files are the user's to bring:
    ``miricigale data add dust.dale2014 PATH``.
    """

    name = "dale2014"
    reference = "Dale et al. 2014, ApJ 784, 83"
    resource = "dust.dale2014"
    options = {"starlight": ("removed", "kept")}
    alpha = Parameter(
        default=2.0, bounds=(0.0625, 4.0), doc="Slope of dust mass in intensity, dM ~ U^-alpha dU."
    )

    def _library(self):
        return open_library(self.path, self.resource)

    def nodes(self):
        return self._library().wave

    def spectrum(self, values):
        alphas, spectra = _sequence(self._library(), self.starlight)
        low = int(np.searchsorted(alphas, values["alpha"], side="right")) - 1
        low = min(max(low, 0), alphas.size - 2)
        part = (values["alpha"] - alphas[low]) / (alphas[low + 1] - alphas[low])
        return (1.0 - part) * spectra[low] + part * spectra[low + 1]
