"""Fluxes of models in a band, and of their AGN, as a point in the center of a galaxy shows them."""

from collections import namedtuple

from miricigale.utils.compilation import PART, njit

#: Nuclei of an object: their bands, int64 (n,); what is subtracted of AGN fluxes from the totals, (n, n), so that
#: the rest has errors of its own; what makes AGN fluxes those of errors of 1 that are not correlated, (n, n); and
#: memory for fluxes of a model and of its AGN, and for weights, (3, nb + 2 n + 1). The n_bands fluxes are followed
#: by the rest of the totals, the nuclei and the AGN's power.
Nuclei = namedtuple("Nuclei", "bands mix root flux")


@njit(**PART)
def with_nuclei(nuclei, flux):
    """
    Put the fluxes of a model and of its AGN into ``nuclei.flux``, with those of the nucleus.

    ``flux``, (3, n_columns), has them without; the last one is the AGN's power.
    """
    out = nuclei.flux
    n = len(nuclei.bands)
    n_bands = out.shape[1] - 2 * n - 1
    power = flux[0, flux.shape[1] - 1]
    for b in range(n_bands):
        out[0, b] = flux[0, b]
        out[1, b] = flux[1, b]
    for j in range(n):
        b = nuclei.bands[j]
        remainder = flux[0, b]
        nucleus = 0.0
        if power > 0.0:
            for k in range(n):
                light = flux[1, nuclei.bands[k]]
                remainder -= nuclei.mix[j, k] * light
                nucleus += nuclei.root[j, k] * light
        out[0, n_bands + j] = remainder
        # of the error of AGN light the rest has the AGN's share of the total
        out[1, n_bands + j] = remainder * flux[1, b] / flux[0, b] if power > 0.0 else 0.0
        out[0, n_bands + n + j] = nucleus
        # and the nuclei have theirs in their errors
        out[1, n_bands + n + j] = 0.0
    out[0, n_bands + 2 * n] = power
