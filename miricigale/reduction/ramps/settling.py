"""First groups of real ramps that still settle after the reset, found on the ramps themselves."""

import numpy as np
from numpy.polynomial.polynomial import polyval
from scipy.stats import trim_mean

from miricigale.instrument import DQ
from miricigale.utils.exceptions import ReductionWarning, warn

#: Pixels whose mean is looked at, at most about.
_SAMPLE = 20_000

#: Groups of which something can be said.
_FEWEST = 8

#: Sigma and DN by which a group must be off.
_SIGMA = 5.0
_LEAST = 1.0


def settling_groups(data, maps, usable):
    """
    Number of groups at the start of each integration that have not settled yet.

    The mean of the array is compared with the parabola through its later groups, which follows light and what
    is left of the non-linearity.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN as read.
    maps : `~miricigale.reduction.DetectorMaps`
        Bias, linearity, reset anomaly and dark of the detector, which are taken off.
    usable : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels that take part.

    Returns
    -------
    number : `~numpy.ndarray` of int, shape (n_int,)
        Groups from the first to the last of the first quarter that is off by more than 5 of its errors, and by
        1 DN at least; 0 with fewer than 8 groups.
    off : `~numpy.ndarray`, shape (n_int, n_group)
        By how many DN each group is off.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.reduction import DetectorMaps, settling_groups
    >>> groups = 11000 + 10 * np.arange(40.0) - 30 * np.exp(-np.arange(40) / 2)
    >>> noise = np.random.default_rng(1).normal(0, 6, (1, 40, 32, 32))
    >>> maps = DetectorMaps(gain=4.0, read_noise=6.0, bias=11000.0)
    >>> data = groups[:, None, None] + noise
    >>> int(settling_groups(data, maps, np.ones((32, 32), bool))[0][0])
    7
    """
    n_int, n_group = data.shape[:2]
    if n_group < _FEWEST or not usable.any():
        return np.zeros(n_int, int), np.zeros((n_int, n_group))
    pixels = np.flatnonzero(usable)
    pixels = pixels[:: 1 + pixels.size // _SAMPLE]

    def sampled(values):
        return np.broadcast_to(values, data.shape[2:]).ravel()[pixels]

    raw = data.reshape(n_int, n_group, -1)[:, :, pixels]
    levels = polyval(raw - sampled(maps.bias), [sampled(c) for c in maps.linearity], tensor=False)
    for reference in (maps.reset, maps.dark):
        for k in range(n_int) if reference is not None else ():
            part = reference[min(k, len(reference) - 1), :n_group]
            levels[k, : len(part)] -= np.nan_to_num(part.reshape(len(part), -1)[:, pixels])
    mean = trim_mean(levels, 0.2, axis=2)
    group = np.arange(n_group)
    # the last group is pulled by the reset
    late = slice(n_group // 4, n_group - 1)
    design = np.vander(group / n_group, 3)
    solution = design @ np.linalg.pinv(design[late])
    off = mean - mean[:, late] @ solution.T
    noise = off[:, late].std(axis=1, ddof=3)[:, None]
    error = noise * np.sqrt(1 + np.square(solution).sum(axis=1))
    unsettled = (np.abs(off) > np.maximum(_SIGMA * error, _LEAST)) & (group < late.start)
    return (unsettled * (group + 1)).max(axis=1), off


def note_settling(ramp, maps, skipped, flags):
    """
    Say if first groups that take part in a fit have not settled yet.

    Parameters
    ----------
    ramp : `~miricigale.detector.Ramp`
        What is fitted.
    maps : `~miricigale.reduction.DetectorMaps`
        What the detector is taken for.
    skipped : int
        Groups that are left out at the start of integrations, beside those with flags.
    flags : `~numpy.ndarray` of int64, shape (ny, nx)
        Of the pixels; FLUX_ESTIMATED is set if more than a tenth of the groups have not settled.

    Returns
    -------
    number : int
        Of groups that have not settled, the most of an integration.

    Warns
    -----
    `~miricigale.utils.exceptions.ReductionWarning`
        If some of them take part.
    """
    usable = (flags & int(DQ.DO_NOT_USE)) == 0
    number, off = settling_groups(ramp.data, maps, usable)
    if ramp.group_dq is not None and usable.any():
        first = (ramp.group_dq[0] & np.uint8(DQ.DO_NOT_USE))[:, usable] != 0
        skipped = max(skipped, int(np.argmin(np.append(first.mean(axis=1) > 0.5, False))))
    worst = int(np.argmax(number))
    n_skipped = int(number.max())
    if n_skipped > skipped:
        text = (
            f"by {off[worst, skipped]:+.1f} DN in the first that is used "
            f"(skip_first={n_skipped} leaves them out)"
        )
        warn(f"the first {n_skipped} groups still settle after the reset, {text}", ReductionWarning)
        if n_skipped > 0.1 * len(off[worst]):
            flags[usable] |= int(DQ.FLUX_ESTIMATED)
    return n_skipped
