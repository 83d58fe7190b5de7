"""Showers: faint, wide clouds of charge that come with large hits of cosmic rays."""

import numpy as np
from scipy.ndimage import gaussian_filter, label, maximum_position, sum_labels

#: Tracks whose jumps add up to so many sigma are looked around.
_LARGE = 300.0

#: Pixels around a hit that are looked at, and the Gaussian width by which they are smoothed.
_REACH = 48
_WIDTH = 4.0

#: Groups before and after from which the usual charge of one group is measured.
_BESIDE = 3


def find_showers(data, jumps, usable, threshold, *, first_group, last_group):
    """
    Find the differences of groups that showers spoil, around large jumps.

    What a pixel gains in the group of the jump is compared with the median of what it gains in
    the groups before and after, smoothed over 4 pixels, with the jumps of the group left out. The noise is that
    of the same pixels, from the scatter of their neighborhood.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN.
    jumps : `~numpy.ndarray`, shape (n_jumps, 5)
        Row, column, integration, difference (from ``first_group``) and significance, sigma.
    usable : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels that are fitted.
    threshold : float
        Sigma of the smoothed excess from which a difference is cut.
    first_group, last_group : int
        Range of groups that take part.

    Returns
    -------
    y, x, integration, difference : `~numpy.ndarray` of int
        What is to be cut.
    """
    n_diff = last_group - first_group - 1
    places = jumps[:, :4].astype(np.int64)
    flagged = [np.zeros((0, 4), np.int64)]
    for k, i in np.unique(places[:, 2:], axis=0):
        neighbors = [j for j in range(i - _BESIDE, i + _BESIDE + 1) if 0 <= j < n_diff and j != i]
        if len(neighbors) < 2:
            continue
        in_group = (places[:, 2] == k) & (places[:, 3] == i)
        hit = np.zeros(usable.shape, np.float32)
        ys, xs = places[in_group, :2].T
        hit[ys, xs] = np.abs(jumps[in_group, 4])
        for y, x in _tracks(hit):
            part = tuple(slice(max(c - _REACH, 0), c + _REACH + 1) for c in (y, x))
            differences = []
            for j in (i, *neighbors):
                differences.append(
                    data[k, first_group + j + 1][part].astype(np.float32)
                    - data[k, first_group + j][part]
                )
            excess = differences[0] - np.median(differences[1:], axis=0)
            cut = _significant(excess, usable[part] & (hit[part] == 0), threshold)
            ys, xs = np.nonzero(cut & usable[part])
            place = np.full((len(ys), 4), (part[0].start, part[1].start, k, i))
            place[:, :2] += np.stack([ys, xs], axis=1)
            flagged.append(place)
    return tuple(np.unique(np.concatenate(flagged), axis=0).T)


def _tracks(hit):
    """Return the brightest pixel of each track of jumps whose significances add up to a large one."""
    labels, number = label(hit > 0, structure=np.ones((3, 3)))
    index = np.arange(1, number + 1)
    large = index[sum_labels(hit, labels, index) >= _LARGE]
    if large.size:
        return maximum_position(hit, labels, large)
    return []


def _significant(excess, good, threshold):
    """Tell where the smoothed excess is above so many sigma."""
    if np.count_nonzero(good) < 100:
        return np.zeros(good.shape, bool)
    middle = np.median(excess[good])
    spread = 1.4826 * np.median(np.abs(excess[good] - middle))
    if spread == 0:
        return np.zeros(good.shape, bool)
    # no single pixel, such as one of a star, must make a cloud
    excess = np.clip(excess, middle - 5 * spread, middle + 5 * spread)
    weight = gaussian_filter(good.astype(np.float32), _WIDTH, mode="constant")
    smooth = gaussian_filter(np.where(good, excess, 0), _WIDTH, mode="constant")
    mean = smooth / np.maximum(weight, 1e-3)
    # the lower half of the smoothed map is that of noise: level and scatter without the shower
    level = np.percentile(mean[good], 25)
    # white noise of this spread, smoothed; the level is a quartile of it
    sigma = spread / (2 * np.sqrt(np.pi) * _WIDTH)
    return (mean - level - 0.6745 * sigma > threshold * sigma) & (weight > 0.3)
