"""Simple stellar populations that the user brings."""

import functools

import numpy as np

from miricigale.refdata.libraries.table import open_library
from miricigale.sed.component import register
from miricigale.sed.components.stellar.base import StellarPopulations
from miricigale.sed.parameter import Parameter

__all__ = ["BC03Library"]


@functools.lru_cache(maxsize=16)
def _metallicities(library):
    return tuple(float(z) for z in library.values_of("metallicity"))


@functools.lru_cache(maxsize=8)
def _table(library, metallicity):
    """Ages, spectra in memory and living masses of one metallicity of an open library."""
    rows = np.flatnonzero(library.axes["metallicity"] == metallicity)
    rows = rows[np.argsort(library.axes["age"][rows])]
    age = np.ascontiguousarray(library.axes["age"][rows], dtype=float)
    spectra = np.array(library.spectra["luminosity"][rows], dtype=float)
    living = np.array(library.values["living"][rows], dtype=float)
    for array in (age, spectra, living):
        array.flags.writeable = False
    return age, spectra, living


@register
class BC03Library(StellarPopulations):
    """
    Bruzual & Charlot 2003 or 2016 as distributed, any IMF; the files are the user's to bring.

    ``miricigale data add ssp.bc03_user PATH`` reads them. Metallicities that the files do not
    have are refused rather than interpolated. The living mass leaves out remnants.
    """

    name = "bc03_library"
    reference = "Bruzual & Charlot 2003, MNRAS 344, 1000"
    resource = "ssp.bc03_user"
    metallicity = Parameter(
        default=0.02,
        bounds=(0.0001, 0.1),
        doc="Mass fraction of metals, one of those that the files have.",
    )

    def _library(self):
        return open_library(self.path, self.resource)

    @property
    def imf(self):
        """Initial mass function of the files."""
        return self._library().meta["imf"]

    @property
    def settings(self):
        meta = self._library().meta
        return {"imf": meta["imf"], "models": meta["models"], "version": meta["version"]}

    @property
    def library(self):
        meta = self._library().meta
        return f"{self.resource}: {meta['models']}, {meta['imf']} IMF"

    def nodes(self):
        return self._library().wave

    def metallicities(self):
        return _metallicities(self._library())

    def table(self, metallicity):
        return _table(self._library(), self.nearest(metallicity))

    def __repr__(self):
        # the files need not be there
        values = [f"{n}={p.default:g}" for n, p in self.parameters.items()]
        return f"{type(self).__name__}({', '.join(values)})"
