"""Grids of wavelengths and interpolation between them."""

import numpy as np
from scipy.sparse import csr_matrix

__all__ = ["hat_matrix", "merge_nodes"]


def merge_nodes(parts):
    """Sorted union of wavelengths; values closer than 1e-7 of themselves are one."""
    nodes = np.unique(np.concatenate([np.asarray(p, dtype=float) for p in parts]))
    keep = np.append(True, np.diff(nodes) > 1e-7 * nodes[1:])
    return nodes[keep]


def hat_matrix(nodes, wave):
    """Sparse matrix that interpolates linearly from nodes to wavelengths, 0 outside."""
    cell = np.clip(np.searchsorted(nodes, wave, side="right") - 1, 0, nodes.size - 2)
    t = (wave - nodes[cell]) / (nodes[cell + 1] - nodes[cell])
    inside = (t >= 0) & (t <= 1)
    row = np.flatnonzero(inside)
    cell, t = cell[inside], t[inside]
    data = np.concatenate([1 - t, t])
    index = (np.concatenate([row, row]), np.concatenate([cell, cell + 1]))
    return csr_matrix((data, index), shape=(wave.size, nodes.size))
