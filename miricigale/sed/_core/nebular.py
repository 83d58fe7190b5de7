"""Emission of ionised gas: shares of ionising photons, profiles of lines."""

import numpy as np
from scipy.sparse import csr_matrix, hstack

from miricigale.sed._core.nodes import cells, hat_matrix, merge_nodes

__all__ = ["absorbed_share", "line_nodes", "line_operator", "photons_by_age"]

ALPHA_B = 2.58e-19  # m3/s, recombination to all but the ground state at 10^4 K: Ferland 1980
ALPHA_1 = 1.54e-19  # m3/s, to the ground state

#: Nodes of a line in units of its full width at half maximum; it ends at the outermost.
OFFSETS = np.array([-1.4, -0.75, -0.35, 0.0, 0.35, 0.75, 1.4])
HEIGHTS = np.where(np.abs(OFFSETS) < 1.4, np.exp(-4.0 * np.log(2.0) * OFFSETS**2), 0.0)


def absorbed_share(f_esc, f_dust):
    """
    Line emission relative to gas that absorbs every ionising photon.

    Photons that leave or that dust takes are lost to the gas, and those of recombinations to
    the ground state are lost with them (Inoue 2011, MNRAS 415, 2920, eq. 2 with dust).

    Parameters
    ----------
    f_esc, f_dust : float
        Shares of ionising photons that escape and that dust absorbs.
    """
    lost = f_esc + f_dust
    return max(1.0 - lost, 0.0) / (1.0 + ALPHA_1 / ALPHA_B * lost)


def photons_by_age(age, photons, nodes):
    """
    Share ionising photons out among the ages of a table.

    Linear between ages; what is younger than the first or older than the last counts for it.

    Parameters
    ----------
    age, photons : `~numpy.ndarray`, shape (n,)
        Ages and photons per second.
    nodes : `~numpy.ndarray`, shape (n_node,)
        Ages of the table, ascending.

    Returns
    -------
    photons : `~numpy.ndarray`, shape (n_node,)
        The sum is that of ``photons``.
    """
    inside = np.clip(age, nodes[0], nodes[-1])
    cell, t = cells(nodes, inside)
    out = np.bincount(cell, photons * (1.0 - t), nodes.size)
    return out + np.bincount(cell + 1, photons * t, nodes.size)


def line_nodes(line_wave, width):
    """
    Wavelengths at which lines are drawn.

    Parameters
    ----------
    line_wave : `~numpy.ndarray`, shape (n_line,)
        Centres.
    width : float
        Full width at half maximum over the wavelength.

    Returns
    -------
    nodes : `~numpy.ndarray`, shape (n_line, 7)
    """
    return line_wave[:, None] * (1.0 + width * OFFSETS)


def line_operator(wave, line_wave, width):
    """
    Turn continuum and lines into one spectrum, straight between its nodes.

    Lines are Gaussians drawn with seven nodes; each column of a line integrates to 1 by
    trapezoids, whatever nodes of others lie in it.

    Parameters
    ----------
    wave : `~numpy.ndarray`, shape (n_wave,)
        Nodes of the continuum.
    line_wave, width
        As for `line_nodes`.

    Returns
    -------
    nodes : `~numpy.ndarray`, shape (n_node,)
        All nodes.
    operator : `~scipy.sparse.csr_matrix`, shape (n_node, n_wave + n_line)
        Multiplies the continuum at ``wave`` followed by the power of lines.
    """
    places = line_nodes(line_wave, width)
    nodes = merge_nodes([wave, *places])
    rows, columns, data = [], [], []
    for k, place in enumerate(places):
        low, high = np.searchsorted(nodes, [place[0], place[-1]])
        low, high = max(low - 1, 0), min(high + 2, nodes.size)
        profile = np.interp(nodes[low:high], place, HEIGHTS, left=0.0, right=0.0)
        rows.append(np.arange(low, high))
        columns.append(np.full(high - low, k))
        data.append(profile / np.trapezoid(profile, nodes[low:high]))
    index = (np.concatenate(rows), np.concatenate(columns))
    lines = csr_matrix((np.concatenate(data), index), shape=(nodes.size, line_wave.size))
    lines.eliminate_zeros()
    return nodes, hstack([hat_matrix(wave, nodes), lines], format="csr")
