"""Sums over the nodes around places between the nodes of a grid."""

from miricigale.fitting._core.structs import KERNEL
from miricigale.utils.compilation import njit

#: Least weight that counts.
_LEAST = 1e-3


@njit(**KERNEL)
def sum_nodes(table, z, other, part, model, first, choice, offset, weight, out):
    """
    Interpolate a table, shape (nz, n_models, n_columns), at n places: ``out``, shape (n, n_columns).

    Along redshift linear, ``part`` of the way from node ``z`` to ``other``. ``model`` are the models of all
    combinations of values of the other axes, flat. A place has the combinations from ``first`` on that are
    ``offset``, shape (n_combinations,), away from it: of each axis the one of three nodes that ``choice``, shape
    (n_combinations, n_axes), says, with the product of the ``weight``, shape (n, n_axes, 3), of these.
    Combinations without a model (-1) or with little weight are left out, and the others take theirs.
    """
    n_columns = table.shape[2]
    n_axes = choice.shape[1]
    for i in range(len(z)):
        total = 0.0
        for j in range(n_columns):
            out[i, j] = 0.0
        for c in range(len(offset)):
            w = 1.0
            for a in range(n_axes):
                w *= weight[i, a, choice[c, a]]
            m = model[first[i] + offset[c]]
            if m < 0 or abs(w) < _LEAST:
                continue
            total += w
            far = w * part[i]
            near = w - far
            for j in range(n_columns):
                out[i, j] += near * table[z[i], m, j] + far * table[other[i], m, j]
        if total > 0.0:
            for j in range(n_columns):
                out[i, j] /= total
