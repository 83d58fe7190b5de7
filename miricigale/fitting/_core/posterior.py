"""The posterior of one object: the search for pairs that matter and their sums, in one kernel."""

import math

import numpy as np

from miricigale.fitting._core.evaluate import evaluate_runs
from miricigale.fitting._core.floors import first_floor, raise_bounds, second_floor
from miricigale.fitting._core.options import ENTRY
from miricigale.fitting._core.search import begin, list_runs
from miricigale.fitting._core.singles import evaluate_singles
from miricigale.fitting._core.summary import variances
from miricigale.fitting._core.workspace import rescale
from miricigale.utils.compilation import njit

__all__ = ["sum_up"]

#: Largest chi2 of a good model, and square of a limit over its error, for single precision with
#: limits.
_MODEST = 1000.0


@njit(**ENTRY)
def sum_up(tables, request, target, limits, sums, scratch, single):
    """
    Sum up the posterior of one object.

    Parameters
    ----------
    tables, request, target, limits, sums, scratch
        See `miricigale.fitting._core.structs`; ``limits`` is None where there are none, and
        ``sums`` are empty.
    single : bool
        Whether single precision will do for pairs of little weight.

    Returns
    -------
    found : bool
        Whether there is any model with weight.
    """
    if not begin(tables, target, limits, scratch, sums.hist.origin):
        return False
    best, total = sums.best, sums.total
    best[2] = scratch.reference[0]
    evaluate_singles(tables, request, target, limits, sums, scratch)
    n_agn = tables.agn.shape[1]
    end = tables.tiles.shape[0] * tables.tiles.shape[1] if n_agn > 0 else 0
    # a bound holds the largest prior of the fractions above 0, a weight those of all
    prior_sum = 0.0
    prior_top = 0.0
    for j in range(tables.zero_frac, tables.prior_frac.size):
        prior_sum += tables.prior_frac[j]
        prior_top = max(prior_top, tables.prior_frac[j])
    position = np.int64(0) if prior_top > 0.0 else end
    share = 1.0
    while position < end:
        n, position = list_runs(tables, request, target, limits, scratch, position)
        share *= 0.5
        # the best model met so far gets weight 1
        reference = scratch.reference[0]
        if reference > best[2]:
            if total[0] > 0.0:
                factor = math.exp(0.5 * (best[2] - reference))
                rescale(
                    sums.flat, sums.hist.flat, sums.draws.next, scratch.galaxy_z, scratch.agn_z,
                    factor,
                )  # fmt: skip
            best[2] = reference
        # bounds are raised for second moments only after a first look
        scratch.tail_galaxy[:] = 0.0
        scratch.tail_agn[:] = 0.0
        if limits is not None:
            # a probability many sigma out is not one for single precision
            worst = target.norm + limits.dark - reference
            for m in range(limits.level.size):
                worst = max(worst, limits.level[m] * limits.level[m])
            single = single and worst < _MODEST
        floor, few = first_floor(scratch.bound, scratch.count, reference, n)
        evaluate_runs(
            tables, request, target, limits, sums, scratch, n, floor, floor, single and not few
        )
        room = share * request.rtol * total[0]
        if room > 0.0:
            variances(
                tables, sums, scratch.mean, scratch.variance, scratch.widest_galaxy,
                scratch.widest_agn,
            )  # fmt: skip
            raise_bounds(
                tables.agn, tables.galaxy_unit, target.weight, (target.norm + 1.0) / request.tail,
                scratch.widest_galaxy, scratch.widest_agn, scratch.inverse_norm, scratch.run_key,
                scratch.bound, n, scratch.tail_galaxy, scratch.tail_agn,
            )  # fmt: skip
        unit = (
            math.exp(min(0.5 * (reference - best[2]), 600.0)) * prior_sum / max(prior_top, 1e-300)
        )
        floor, sure = second_floor(
            scratch.bound, scratch.count, reference, n, room, unit, request.delta
        )
        evaluate_runs(tables, request, target, limits, sums, scratch, n, floor, sure, single)
    return total[0] > 0.0
