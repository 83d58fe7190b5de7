"""Numbers of photons in spectra that are straight lines between nodes."""

import numpy as np

__all__ = ["photon_weights"]

_HC = 1.98644586e-19  # J um


def photon_weights(wave, limit):
    """
    Weights that turn L_lambda at nodes into photons per second below a wavelength.

    The integral of ``L_lambda lambda / (h c)`` is exact for spectra that are straight lines
    between the nodes and zero outside them.

    Parameters
    ----------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Nodes in um, ascending.
    limit : float
        The wavelength in um.

    Returns
    -------
    weights : `~numpy.ndarray`, shape (n_wave,)
        Photons per second for one W/um at each node.
    """
    out = np.zeros(wave.size)
    n = int(np.searchsorted(wave, limit, side="left"))  # nodes below the limit
    if n == 0:
        return out
    low = wave[:n] if n < wave.size else wave[:-1]
    cell = np.arange(low.size)
    step = wave[cell + 1] - low
    width = np.minimum(wave[cell + 1], limit) - low
    # integrals of lambda and of lambda t over the cell, t rising from 0 to 1
    flat = low * width + 0.5 * width**2
    rise = (0.5 * low * width**2 + width**3 / 3.0) / step
    out[cell] += flat - rise
    out[cell + 1] += rise
    return out / _HC
