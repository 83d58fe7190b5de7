"""Priors of galaxies at the stellar masses that they have in one object."""

import numpy as np

from miricigale.fitting._core.batched_pairs import galaxy_products
from miricigale.fitting._core.structs import BLOCK
from miricigale.utils._core.functions import exponential, log10
from miricigale.utils.compilation import KERNEL, njit

# Below this ln of a prior there is none.
_NONE = -1e200


@njit(**KERNEL)
def weigh_masses(tables, target, pq, log_stars, table, per_dex, log_usable, change):
    """
    Put a prior of stellar mass in the priors of galaxies.

    Parameters
    ----------
    tables, target : `Tables`, `Target`
        The models and the object.
    pq : `~numpy.ndarray`, shape (2, n_padded)
        Work space.
    log_stars : `~numpy.ndarray`, shape (n_padded,)
        log10 of the stellar mass for each solar mass formed.
    table : `~numpy.ndarray`, shape (nz, n)
        ln of the prior at log10 of masses 0, 1 / per_dex, 2 / per_dex, ...; straight lines join them.
    per_dex : float
        Values for a factor of ten.
    log_usable : `~numpy.ndarray`, shape (nz, n_padded)
        Gets ``Tables.log_usable`` times the prior, at each redshift with the sum that it had.
    change : `~numpy.ndarray`, shape (nz,)
        Gets ln of what that sum would have become over what it was.
    """
    n_last = table.shape[1] - 2
    for z in range(target.log_prior.size):
        change[z] = 0.0
        if target.log_prior[z] < _NONE:
            continue
        row = log_usable[z]
        prior_row = tables.log_usable[z]
        values = table[z]
        for block in range(tables.tiles.shape[1]):
            galaxy_products(tables, target, z, block, pq)
            for i in range(block * BLOCK, (block + 1) * BLOCK):
                # a scale that is not positive, or of a model without light here, is taken for 1 Msun
                formed = max(pq[0, i], 0.0) / max(pq[1, i], 1e-290)
                row[i] = log10(max(formed, 1.0)) + log_stars[i]
        for i in range(row.size):
            place = min(max(row[i] * per_dex, 0.0), np.float64(n_last + 1))
            k = min(np.int64(place), n_last)
            part = place - k
            row[i] = prior_row[i] + 2.0 * ((1.0 - part) * values[k] + part * values[k + 1])
        top = -1e300
        for i in range(row.size):
            top = max(top, row[i])
        if top < _NONE:
            continue
        before = 0.0
        after = 0.0
        for i in range(row.size):
            before += exponential(min(max(0.5 * prior_row[i], -700.0), 0.0))
            after += exponential(max(0.5 * (row[i] - top), -700.0))
        change[z] = 0.5 * top + np.log(after / before)
        for i in range(row.size):
            row[i] = row[i] - 2.0 * change[z] if prior_row[i] > _NONE else -1e300
