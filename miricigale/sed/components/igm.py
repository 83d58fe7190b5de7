"""Absorption by the intergalactic medium."""

import numpy as np

from miricigale.sed import _core
from miricigale.sed.component import Component, register

__all__ = ["IGM", "Madau1995", "Meiksin2006"]


class IGM(Component):
    """Base: `transmission` at observed wavelengths."""

    role = "igm"

    def transmission(self, wave, redshift):
        """
        Mean transmission.

        Parameters
        ----------
        wave : `~numpy.ndarray`
            Observed wavelengths in um.
        redshift : float
            Redshift of the source.
        """
        raise NotImplementedError

    def nodes(self):
        """Both sides of the Lyman lines and limit, where the transmission jumps."""
        edges = np.append(_core.lyman_lines(11), _core.LYMAN_LIMIT)
        return np.sort(np.concatenate([edges * (1 - 1e-5), edges * (1 + 1e-5)]))


@register
class Meiksin2006(IGM):
    """Meiksin 2006 in CIGALE's reading (see ``miricigale.sed._core.meiksin_transmission``)."""

    name = "meiksin2006"
    reference = "Meiksin 2006, MNRAS 365, 807"

    def transmission(self, wave, redshift):
        return _core.meiksin_transmission(wave, redshift)


@register
class Madau1995(IGM):
    """Madau 1995: four Lyman lines and the continuum approximation of footnote 3."""

    name = "madau1995"
    reference = "Madau 1995, ApJ 441, 18"

    def transmission(self, wave, redshift):
        return _core.madau_transmission(wave, redshift)
