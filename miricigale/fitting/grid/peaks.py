"""Peaks of redshift of posteriors on the nodes of a grid."""

import numpy as np

#: Weight of a node's redshift, over the largest, below which there is a gap between peaks.
_GAP = 2e-3


def redshift_peaks(redshift, posterior):
    """
    Find the peaks of a posterior on nodes of redshift, which nodes of hardly any weight separate.

    Parameters
    ----------
    redshift, posterior : `~numpy.ndarray`, shape (nz,)
        Nodes and their weights, which sum to 1.

    Returns
    -------
    borders : `~numpy.ndarray`, shape (n_peaks - 1,)
        Redshifts between them.
    weights : `~numpy.ndarray`, shape (n_peaks,)
        Their weights.
    """
    high = posterior > _GAP * posterior.max()
    # a peak reaches to the next nodes
    high = np.convolve(high, [1, 1, 1], "same") > 0
    change = np.diff(high.astype(int), prepend=0, append=0)
    first = np.flatnonzero(change == 1)
    last = np.flatnonzero(change == -1) - 1
    borders = 0.5 * (redshift[last[:-1]] + redshift[first[1:]])
    weights = np.bincount(np.searchsorted(borders, redshift), posterior, minlength=first.size)
    return borders, weights
