"""What every dust component gives: a template for one watt."""

import numpy as np

from miricigale.sed.component import Component

__all__ = ["DustEmission"]


class DustEmission(Component):
    """Base: `template` gives a spectrum that integrates to 1."""

    role = "dust"

    def spectrum(self, values):
        """
        Spectrum at `nodes`.

        Parameters
        ----------
        values : dict of str to float
            Values of all parameters.

        Returns
        -------
        spectrum : `~numpy.ndarray`
            L_lambda, not negative, arbitrary scale.
        """
        raise NotImplementedError

    def template(self, wave, **values):
        """
        Spectrum for one watt.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Rest wavelengths in um.
        **values
            Values of the parameters; defaults where not given.

        Returns
        -------
        spectrum : `~numpy.ndarray`
            L_lambda in W/um; the integral over `nodes`, by trapezoids, is 1 W.
        """
        full = {name: par.default for name, par in self.parameters.items()} | values
        nodes, spectrum = self.nodes(), self.spectrum(full)
        return np.interp(wave, nodes, spectrum / np.trapezoid(spectrum, nodes), left=0, right=0)
