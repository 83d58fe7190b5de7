"""Drift of the read-out, as the pixels without light show it."""

import numpy as np
from astropy.stats import sigma_clip

from miricigale.utils.options import check_that

#: Channels of the read-out, to which columns belong in turn.
_CHANNELS = 4

#: Standard deviations at which the means are clipped.
_CLIP = 3.0


def reference_drift(data, reference, offsets=()):
    """
    Return the mean level of the reference pixels in each group.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN.
    reference : `~numpy.ndarray` of bool, shape (ny, nx)
        Which pixels see no light.
    offsets : sequence of `~numpy.ndarray`, shape (n, n_group or more, ny, nx), optional
        Maps of groups that are subtracted first, such as a dark; the last integration of each stands for all
        further ones.

    Returns
    -------
    drift : `~numpy.ndarray`, shape (n_int, n_group)
        Mean of each group's reference pixels minus the mean over all groups, DN; zeros if
        there is no reference pixel, and in groups that were lost, whose counts are 0.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.reduction import reference_drift
    >>> reference = np.zeros((6, 16), bool)
    >>> reference[:, :4] = True
    >>> data = np.full((1, 3, 6, 16), 100.0)
    >>> data[:, 2] += 6.0  # a drift in the last group
    >>> reference_drift(data, reference)
    array([[-2., -2.,  4.]])
    """
    columns = np.flatnonzero(reference.any(axis=0))
    if columns.size == 0:
        return np.zeros(data.shape[:2])
    pixels = _without(data, columns, offsets)
    drift = pixels[:, :, reference[:, columns]].mean(axis=-1, dtype=float)
    was_read = ~_is_lost(data, reference)
    if not was_read.any():
        return np.zeros(data.shape[:2])
    return np.where(was_read, drift - drift[was_read].mean(), 0.0)


def _is_lost(data, reference):
    """Groups all of whose reference pixels have 0 counts, shape (n_int, n_group): the bias is thousands."""
    if data.dtype.kind not in "iu":
        return np.zeros(data.shape[:2], dtype=bool)
    columns = np.flatnonzero(reference.any(axis=0))
    pixels = data[..., columns][:, :, reference[:, columns]]
    return np.all(pixels == 0, axis=-1)


def _without(data, columns, offsets):
    """Return the columns of the data, a small part of it, without maps of groups."""
    pixels = data[..., columns]
    n_int, n_group = pixels.shape[:2]
    for offset in offsets:
        shared = min(n_group, offset.shape[1])
        integration = np.minimum(np.arange(n_int), len(offset) - 1)
        integration_offsets = np.nan_to_num(offset[:, :shared, :, columns], posinf=0.0, neginf=0.0)
        pixels = pixels.astype(float)
        pixels[:, :shared] -= integration_offsets[integration]
    return pixels


def reference_channels(data, reference, *, origin=(0, 0), offsets=()):
    """
    Return the drift of each channel of the read-out, of odd and even rows apart.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN.
    reference : `~numpy.ndarray` of bool, shape (ny, nx)
        Which pixels see no light.
    origin : tuple of int, optional
        Column and row of the first pixel in the full frame, which determine its channel and parity.
    offsets : sequence of `~numpy.ndarray`, optional
        As of `reference_drift`.

    Returns
    -------
    drift : `~numpy.ndarray`, shape (n_int, n_group, ny, 4)
        DN of the channels, the first that of column 0; zero in the first group of each
        integration that was not lost, as those of 0 counts are.

    Raises
    ------
    ValueError
        If there is no reference pixel of a channel.

    Notes
    -----
    It is what the official pipeline does to full frames (step ``refpix``): the first group of an
    integration is taken off all; of what is left, the clipped means of the reference pixels on
    the left and on the right are averaged and subtracted from the pixels of the same channel. A
    sub-array with reference pixels on one side, which that step leaves alone, has theirs.

    References
    ----------
    JWST pipeline documentation, reference pixel correction (MIRI).

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.reduction import reference_channels
    >>> reference = np.zeros((6, 16), bool)
    >>> reference[:, :4] = reference[:, -4:] = True
    >>> data = np.full((1, 3, 6, 16), 100.0)
    >>> data[:, 2] += 5.0  # a drift in the last group
    >>> reference_channels(data, reference)[0, :, 0].tolist()
    [[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0], [5.0, 5.0, 5.0, 5.0]]
    """
    n_int, n_group, ny, nx = data.shape
    columns = np.flatnonzero(reference.any(axis=0))
    pixels = _without(data, columns, offsets)
    valid = reference[:, columns]
    # left and right of the middle
    sides = [np.flatnonzero(columns < nx / 2), np.flatnonzero(columns >= nx / 2)]
    parity = (np.arange(ny) + origin[1]) % 2
    values = np.zeros((n_int, n_group, 2, _CHANNELS))
    lost = _is_lost(data, reference)
    first = np.argmin(lost, axis=1)
    for channel in range(_CHANNELS):
        mine = [side[columns[side] % _CHANNELS == channel] for side in sides]
        mine = [side for side in mine if side.size]
        wanted = "reference pixels of every channel"
        check_that(mine, "reference", wanted, f"none in columns {channel} + 4 n")
        for odd in np.unique(parity):
            rows = np.flatnonzero(parity == odd)
            for side in mine:
                good = valid[np.ix_(rows, side)].ravel()
                part = pixels[:, :, rows][..., side].reshape(n_int, n_group, -1)[..., good]
                change = part.astype(float) - part[np.arange(n_int), first][:, None]
                clipped = sigma_clip(change, _CLIP, maxiters=None, cenfunc="mean", axis=-1)
                values[:, :, odd, channel] += clipped.mean(axis=-1) / len(mine)
    values[lost] = 0.0
    return values[:, :, parity]
