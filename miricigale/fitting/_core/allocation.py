"""What weights of an importance sampler are worth, and where more places are wanted."""

from collections import namedtuple

import numpy as np

from miricigale.fitting._core.population import NEVER
from miricigale.utils._core.functions import exponential, log10
from miricigale.utils.compilation import KERNEL, njit

#: Sets of groups that have to have an effective number of their own: ``start``, int64 (n_sets + 1,), of each in
#: ``group``, int64, flat.
GroupSets = namedtuple("GroupSets", "start group")

_LN_10 = np.log(10.0)
#: Smallest normal number.
_LEAST_DENSITY = 2.3e-308
#: Places with an effective number of 1 that are added to those of a group for its efficiency, the effective number
#: over that of places: few of its own say little.
_N_EXPECTED = 20.0
#: Smallest efficiency that is believed.
_MIN_RATE = 0.01
#: Weight above which a set of groups has to have an effective number of its own.
_MIN_COUNTED_WEIGHT = 0.02
#: Smallest part of the places in each group that has weight.
_MIN_SHARE = 0.03


def make_group_sets(sets):
    """Make `GroupSets` of arrays of groups."""
    start = np.concatenate([[0], np.cumsum([len(groups) for groups in sets])])
    return GroupSets(start.astype(np.int64), np.concatenate(sets).astype(np.int64))


@njit(**KERNEL)
def mix_peaks(share, label, of_peak, first, density):
    """
    Add the densities of the parts of peaks up with the shares that labels have in these.

    Parameters
    ----------
    share : `~numpy.ndarray`, shape (n_labels, n_peaks)
        Shares of the places.
    label : `~numpy.ndarray` of int, shape (n,)
        Labels of the places.
    of_peak : `~numpy.ndarray`, shape (n_peaks, first + n) or longer
        Densities of the parts of each peak, of these places from column ``first`` on.
    first : int
        That column.
    density : `~numpy.ndarray`, shape (n,)
        Gets the sums.
    """
    n_peaks = share.shape[1]
    for i in range(len(label)):
        total = 0.0
        for peak in range(n_peaks):
            total += share[label[i], peak] * of_peak[peak, first + i]
        density[i] = total


@njit(**KERNEL)
def weigh_places(evaluated, density, weight):
    """
    Weigh places by the posterior over the density of what proposed them.

    Parameters
    ----------
    evaluated : `~numpy.ndarray`, shape (n, 5)
        What `evaluate_places` says of them.
    density : `~numpy.ndarray`, shape (n,)
        Densities, above 0.
    weight : `~numpy.ndarray`, shape (n,)
        Gets weights, the largest of which is 1.

    Returns
    -------
    top, mean : float
        Ln of the weight that became 1, and mean of the weights.
    """
    n = len(weight)
    for i in range(n):
        weight[i] = log10(max(density[i], _LEAST_DENSITY))
    top = 2.0 * NEVER
    for i in range(n):
        weight[i] = evaluated[i, 0] - _LN_10 * weight[i]
        top = max(top, weight[i])
    total = 0.0
    for i in range(n):
        weight[i] = exponential(max(weight[i] - top, -700.0))
        total += weight[i]
    return top, total / n


@njit(**KERNEL)
def allocate_places(weight, group, sets, goal, least_each, min_weight, sums, wanted):
    """
    Compute the effective number of weights, and how many places are wanted in each group.

    Most is had of a number of places if that of each group is as its weight over the root of its efficiency
    (Neyman allocation).

    Parameters
    ----------
    weight : `~numpy.ndarray`, shape (n,)
        Weights of places, not all 0.
    group : `~numpy.ndarray` of int, shape (n,)
        Groups of the places.
    sets : `GroupSets`
        Sets of groups that have an effective number of their own where they count.
    goal, least_each : float
        Effective numbers that are wanted in all, and of each set.
    min_weight : float
        Weight of a group above which it has a share of the places in any case.
    sums : `~numpy.ndarray`, shape (3, n_groups)
        Gets weights, squares of weights, and numbers of places of the groups.
    wanted : `~numpy.ndarray`, shape (n_groups,)
        Gets the numbers of places that are wanted.

    Returns
    -------
    effective : float
        Effective number of all weights (Kish 1965).
    enough : bool
        Whether that and those of the sets that count are as wanted.
    """
    of_weight = sums[0]
    of_square = sums[1]
    count = sums[2]
    n_groups = len(wanted)
    for j in range(n_groups):
        of_weight[j] = 0.0
        of_square[j] = 0.0
        count[j] = 0.0
    for i in range(len(weight)):
        j = group[i]
        of_weight[j] += weight[i]
        of_square[j] += weight[i] * weight[i]
        count[j] += 1.0
    total = 0.0
    square = 0.0
    for j in range(n_groups):
        total += of_weight[j]
        square += of_square[j]
    effective = total * total / square
    enough = effective >= goal
    # efficiencies take the place of the numbers
    rate = count
    cost = 0.0
    for j in range(n_groups):
        group_effective = of_weight[j] * of_weight[j] / max(of_square[j], 1e-300)
        rate[j] = max((group_effective + 1.0) / (count[j] + _N_EXPECTED), _MIN_RATE)
        wanted[j] = of_weight[j] / total / np.sqrt(rate[j])
        cost += wanted[j]
    for j in range(n_groups):
        wanted[j] *= goal * cost
    for m in range(len(sets.start) - 1):
        set_weight = 0.0
        set_square = 0.0
        for k in range(sets.start[m], sets.start[m + 1]):
            set_weight += of_weight[sets.group[k]]
            set_square += of_square[sets.group[k]]
        if set_weight <= _MIN_COUNTED_WEIGHT * total:
            continue
        if set_weight * set_weight < least_each * set_square:
            enough = False
        for k in range(sets.start[m], sets.start[m + 1]):
            j = sets.group[k]
            wanted[j] = max(wanted[j], least_each * of_weight[j] / set_weight / rate[j])
    n_wanted = 0.0
    for j in range(n_groups):
        n_wanted += wanted[j]
    # those of little weight so far may have more
    for j in range(n_groups):
        if of_weight[j] > min_weight * total:
            wanted[j] = max(wanted[j], _MIN_SHARE * n_wanted)
    return effective, enough
