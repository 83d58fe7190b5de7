"""Grids of wavelengths and interpolation between them."""

import numpy as np
from scipy.sparse import csr_matrix

_HC = 1.98644586e-19  # J um


def merge_nodes(parts):
    """Sorted union of wavelengths; values closer than 1e-7 of themselves are one."""
    nodes = np.unique(np.concatenate([np.asarray(p, dtype=float) for p in parts]))
    keep = np.append(True, np.diff(nodes) > 1e-7 * nodes[1:])
    return nodes[keep]


_LAST = [(None, b"")]  # the wavelengths that were asked for last, and their bytes


def wave_key(wave):
    """Bytes of wavelengths, for caches; of an array that stays as it is the same object, hashed once."""
    last, key = _LAST[0]
    if last is not wave:
        key = np.ascontiguousarray(wave, dtype=float).tobytes()
        if not np.asarray(wave).flags.writeable:
            _LAST[0] = wave, key
    return key


def trapezoid_weights(wave):
    """Weights of the trapezoid rule: ``weights @ spectrum`` is its integral."""
    weights = np.zeros(wave.size)
    weights[:-1] += 0.5 * np.diff(wave)
    weights[1:] += 0.5 * np.diff(wave)
    return weights


def cells(nodes, x):
    """Cell between ascending nodes, the outermost beyond them, and place in it from 0 to 1."""
    cell = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, nodes.size - 2)
    return cell, (x - nodes[cell]) / (nodes[cell + 1] - nodes[cell])


def hat_matrix(nodes, wave):
    """Sparse matrix that interpolates linearly from nodes to wavelengths, 0 outside."""
    cell, t = cells(nodes, wave)
    inside = (t >= 0) & (t <= 1)
    row = np.flatnonzero(inside)
    cell = cell[inside]
    t = t[inside]
    data = np.concatenate([1 - t, t])
    index = (np.concatenate([row, row]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(wave.size, nodes.size))


def photon_weights(wave, limit):
    """
    Weights that turn L_lambda (W/um) at nodes into photons per second below a wavelength.

    The integral of ``L_lambda lambda / (h c)`` is exact for spectra that are straight lines
    between the nodes and zero outside them.
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
