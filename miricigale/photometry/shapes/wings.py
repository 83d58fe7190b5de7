"""Wings of profiles: how their light beyond the core follows what the image shows."""

import numpy as np
import scipy.optimize

#: Ratio of the radii of neighboring nodes.
_NODE_RATIO = 1.35

#: Standard deviation of the change of the scale between two nodes where the image does not constrain it.
_SCALE_CHANGE = 0.3


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
    image : `~numpy.ndarray`, shape (ny, nx)
        The scaled profile on the pixels of ``data``.

    Notes
    -----
    The scale is linear in ln(radius) between nodes and found by least squares, with a random walk as
    prior: it starts from 1 in the core and stays constant where the noise hides the light.
    """
    last = radius.max()
    n_nodes = max(int(np.ceil(np.log(max(last / core, 1.0)) / np.log(_NODE_RATIO))), 1)
    # nodes at equal steps in ln radius
    place = np.log(np.maximum(radius, 1e-3) / core) / np.log(_NODE_RATIO)
    # node 0 is the core's edge, where the scale is 1
    hats = [np.clip(1.0 - np.abs(place - k), 0.0, 1.0) for k in range(1, n_nodes + 1)]
    hats[-1] = np.clip(place - (n_nodes - 1), 0.0, 1.0)
    inner = np.clip(1.0 - place, 0.0, 1.0)
    use = weight > 0
    parts = np.concatenate([inner[None], hats])
    convolved = convolve(stamp * parts)
    columns = convolved[:, use] * weight[use]
    # prior: differences of neighboring nodes, the first from 1, have the width of the walk's steps
    walk = (np.eye(n_nodes) - np.eye(n_nodes, k=-1)) / _SCALE_CHANGE
    begin = np.zeros(n_nodes)
    begin[0] = 1.0 / _SCALE_CHANGE
    scale, _ = scipy.optimize.nnls(
        np.vstack([columns[1:].T, walk]),
        np.concatenate([data[use] * weight[use] - columns[0], begin]),
    )
    # convolution is linear: that of the whole is the sum of those of its parts
    image = convolved[0] + np.tensordot(scale, convolved[1:], axes=1)
    return inner + np.tensordot(scale, hats, axes=1), float(scale[-1]), image
