"""Sums over draws with weights in the order of their values."""

import math

from miricigale.utils.compilation import KERNEL, njit


@njit(**KERNEL)
def sort_draws(value, weight, order, with_log, table, moments):
    """
    Put draws in the order of their values, with what their shares are.

    Parameters
    ----------
    value, weight : `~numpy.ndarray`, shape (n,)
        Draws, and weights that are not all 0.
    order : `~numpy.ndarray` of int, shape (n,)
        The draws by ascending value.
    with_log : bool
        Whether the mean of log10 is worked out.
    table : `~numpy.ndarray`, shape (3, n)
        Gets the values, the share below each of them and half of its own (a value stands for half of its weight
        on either side), and the squares of the shares up to it and with it.
    moments : `~numpy.ndarray`, shape (3,)
        Gets mean, standard deviation, and mean log10 of values above 0, NaN without these.
    """
    total = 0.0
    for i in range(len(weight)):
        total += weight[i]
    mean = 0.0
    upto = 0.0
    square_upto = 0.0
    log = 0.0
    lit = 0.0
    for k in range(len(order)):
        i = order[k]
        share = weight[i] / total
        table[0, k] = value[i]
        table[1, k] = upto + 0.5 * share
        upto += share
        square_upto += share * share
        table[2, k] = square_upto
        mean += share * value[i]
        if with_log and value[i] > 0.0:
            log += share * math.log10(value[i])
            lit += share
    variance = 0.0
    for i in range(len(value)):
        variance += weight[i] / total * (value[i] - mean) ** 2
    moments[0] = mean
    moments[1] = math.sqrt(variance)
    moments[2] = math.nan
    if lit > 0.0:
        moments[2] = log / lit
