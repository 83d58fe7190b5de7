"""Emission of ionized gas: shares of ionizing photons, profiles of lines."""

import numpy as np
from scipy.sparse import csr_matrix, hstack

from miricigale.sed._core.nodes import cells, hat_matrix, merge_nodes

ALPHA_B = 2.58e-19  # m3/s, recombination to all but the ground state at 10^4 K: Ferland 1980
ALPHA_1 = 1.54e-19  # m3/s, to the ground state

#: Nodes of a line in units of its full width at half maximum; it ends at the outermost.
OFFSETS = np.array([-1.4, -0.75, -0.35, 0.0, 0.35, 0.75, 1.4])
HEIGHTS = np.where(np.abs(OFFSETS) < 1.4, np.exp(-4.0 * np.log(2.0) * OFFSETS**2), 0.0)


def absorbed_share(f_esc, f_dust):
    """
    Line emission relative to gas that absorbs every ionizing photon.

    Photons that leave or that dust takes are lost to the gas, and those of recombinations to
    the ground state are lost with them (Inoue 2011, MNRAS 415, 2920, eq. 2 with dust).
    """
    lost = f_esc + f_dust
    return max(1.0 - lost, 0.0) / (1.0 + ALPHA_1 / ALPHA_B * lost)


def photons_by_age(age, photons, nodes):
    """
    Share ionizing photons of some ages out among the ages of a table; their sum is kept.

    Linear between ages; what is younger than the first or older than the last counts for it.
    """
    inside = np.clip(age, nodes[0], nodes[-1])
    cell, t = cells(nodes, inside)
    out = np.bincount(cell, photons * (1.0 - t), nodes.size)
    return out + np.bincount(cell + 1, photons * t, nodes.size)


def line_operator(wave, line_wave, width):
    """
    Turn continuum and lines into one spectrum, straight between its nodes.

    Lines are Gaussians drawn with seven nodes, of a full width at half maximum in units of the
    wavelength; each column of a line integrates to 1 by trapezoids, whatever nodes of others lie
    in it. Returned are all nodes, and the sparse matrix, shape (n_node, n_wave + n_line), that
    multiplies the continuum at ``wave`` followed by the power of lines.
    """
    places = line_wave[:, None] * (1.0 + width * OFFSETS)
    nodes = merge_nodes([wave] + list(places))
    rows = []
    columns = []
    data = []
    for k, place in enumerate(places):
        low, high = np.searchsorted(nodes, [place[0], place[-1]])
        low = max(low - 1, 0)
        high = min(high + 2, nodes.size)
        profile = np.interp(nodes[low:high], place, HEIGHTS, left=0.0, right=0.0)
        rows.append(np.arange(low, high))
        columns.append(np.full(high - low, k))
        data.append(profile / np.trapezoid(profile, nodes[low:high]))
    index = (np.concatenate(rows), np.concatenate(columns))
    lines = csr_matrix((np.concatenate(data), index), shape=(nodes.size, line_wave.size))
    lines.eliminate_zeros()
    return nodes, hstack([hat_matrix(wave, nodes), lines], format="csr")
