"""The outskirts of sources: a fitted profile brought to the light that is there, ring by ring."""

import numpy as np
import scipy.optimize

#: Ratio of the radii of neighboring nodes, and how much the scale may change between two nodes
#: (standard deviation) where the image does not constrain it.
_RATIO, _CHANGE = 1.35, 0.3


def adjust_wings(stamp, radius, core, *, convolve, data, weight):
    """
    Scale a profile with radius until it is the light outside of the core.

    One Sersic profile does not describe a bulge and a disk; what it owes to the bright inner part
    must not decide how much light is far outside.

    Parameters
    ----------
    stamp, radius : `~numpy.ndarray`, shape (h, w)
        The profile before convolution, and the semi-major axis (pixels) of the ellipse through each pixel.
    core : float
        Semi-major axis up to which the profile stays as it is.
    convolve : callable
        Takes images of the stamp's shape, shape (n, h, w), to the pixels of ``data``.
    data, weight : `~numpy.ndarray`, shape (ny, nx)
        Light and the inverse of its error, zero for pixels that do not count.

    Returns
    -------
    scale, outer : `~numpy.ndarray`, shape (h, w), and float
        What the profile is to be multiplied with, never negative; the same beyond the stamp.

    Notes
    -----
    The scale is linear in ln(radius) between nodes and found by least squares, with a random walk as
    prior: it starts from 1 in the core and stays constant where the noise hides the light.
    """
    last = radius.max()
    n_nodes = max(int(np.ceil(np.log(max(last / core, 1.0)) / np.log(_RATIO))), 1)
    place = np.log(np.maximum(radius, 1e-3) / core) / np.log(_RATIO)
    # node 0 is the core's edge, where the scale is 1
    hats = [np.clip(1.0 - np.abs(place - k), 0.0, 1.0) for k in range(1, n_nodes + 1)]
    hats[-1] = np.clip(place - (n_nodes - 1), 0.0, 1.0)
    inner = np.clip(1.0 - place, 0.0, 1.0)
    use = weight > 0
    fixed, *free = (one[use] * weight[use] for one in convolve(stamp * np.array([inner, *hats])))
    walk = (np.eye(n_nodes) - np.eye(n_nodes, k=-1)) / _CHANGE
    begin = np.zeros(n_nodes)
    begin[0] = 1.0 / _CHANGE
    scale, _ = scipy.optimize.nnls(
        np.vstack([np.stack(free, axis=1), walk]),
        np.concatenate([data[use] * weight[use] - fixed, begin]),
    )
    return inner + np.tensordot(scale, hats, axes=1), float(scale[-1])
