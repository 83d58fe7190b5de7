"""Cutouts: the light of a source on the fine grid, before convolution."""

import numpy as np
import scipy.ndimage

from miricigale.photometry._core.sampling import convolve_batch
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.utils.values import value_class

#: Rim of zeros around fine stamps, for the splines and the pixel response to fade in.
RIM = 8

#: Least number of pixels of a flat top.
_FLAT = 5


@value_class
class Cutout:
    """The light of one source on the fine grid, before convolution, of unit total."""

    data: np.ndarray  # (h, w): Light to be convolved, in single precision: there can be many.
    origin: tuple  # Fine pixel (y, x) of its corner.
    #: Sum of the noise variances of the light, for the errors-in-variables correction.
    noise: float = 0.0
    #: Whether ``data`` has the sharp PSF already (a cutout) or not (a profile).
    convolved: bool = True
    #: What is added to a profile: the image less the profile, which has the sharp PSF; None
    #: without.
    correction: "Cutout | None" = None
    #: Of the largest piece of a divided galaxy the template of the whole; None without, or if that is a point.
    galaxy: "Cutout | None" = None

    def __post_init__(self):
        object.__setattr__(self, "data", np.asarray(self.data, np.float32))

    @property
    def shape(self):
        """Shape of ``data``."""
        return self.data.shape

    @property
    def kind(self):
        """``"cutout"`` if any of it is the image itself, else ``"sersic"``."""
        if self.convolved or self.correction is not None:
            return "cutout"
        return "sersic"

    @property
    def layers(self):
        """The profile and its correction, or the cutout alone."""
        if self.correction is None:
            return (self,)
        return self, self.correction


def own_segments(segmentation, labels, xy):
    """
    Give each segment to one source.

    Parameters
    ----------
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Label of each fine pixel, 0 for none.
    labels : int `~numpy.ndarray`, shape (n,)
        The label of each source.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.

    Returns
    -------
    label, flags : int `~numpy.ndarray`, shape (n,)
        The source's own label, 0 if it has none; ``NO_SEGMENT`` and ``SHARED_SEGMENT``. Of several
        sources on a segment the one nearest to its middle owns it.
    """
    label = np.array(labels, dtype=int)
    flags = np.where(label > 0, 0, int(ForcedFlags.NO_SEGMENT))
    values, counts = np.unique(label[label > 0], return_counts=True)
    shared = values[counts > 1]
    places = []
    if len(shared):
        # the rectangle of each segment, so that no other pixels are looked at
        places = scipy.ndimage.find_objects(segmentation)
    for value in shared:
        rows = np.flatnonzero(label == value)
        middle = np.zeros(2)
        if value <= len(places) and places[value - 1] is not None:
            place = places[value - 1]
            corner = [place[0].start, place[1].start]
            middle = (np.argwhere(segmentation[place] == value) + corner).mean(axis=0)
        distance = np.hypot(xy[rows, 1] - middle[0], xy[rows, 0] - middle[1])
        losers = np.delete(rows, np.nanargmin(np.nan_to_num(distance, nan=np.inf)))
        label[losers] = 0
        flags[losers] |= ForcedFlags.SHARED_SEGMENT
    return label, flags


def saturated_cores(data, usable, segmentation, label, xy, width):
    """
    Find sources whose core a detector could not measure.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        The image.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels with data.
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Label of each pixel.
    label : int `~numpy.ndarray`, shape (n,)
        Label of each source, 0 for none.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions.
    width : float
        Full width at half maximum of the PSF in pixels.

    Returns
    -------
    saturated : bool `~numpy.ndarray`, shape (n,)
        Whether pixels without data, but with data all around, are within half the width of the position, or
        five pixels or more of the segment have the value of its brightest.
    flat : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels of flat tops.
    """
    holes = scipy.ndimage.binary_fill_holes(usable) & ~usable
    flat = np.zeros(data.shape, bool)
    saturated = np.zeros(len(label), bool)
    places = scipy.ndimage.find_objects(segmentation)
    reach = max(width / 2, 1.0)
    for k, number in enumerate(label):
        if not 0 < number <= len(places) or places[number - 1] is None:
            continue
        place = places[number - 1]
        is_own = (segmentation[place] == number) & usable[place]
        light = np.where(is_own, data[place], -np.inf)
        # a solid angle may have been multiplied
        top = is_own & (light > (1 - 1e-6) * light.max())
        if np.count_nonzero(top) >= _FLAT:
            flat[place] |= top
            saturated[k] = True
        # a hole without data near the position
        low = np.maximum(np.ceil(xy[k, ::-1] - reach), 0).astype(int)
        high = np.maximum(np.floor(xy[k, ::-1] + reach), -1).astype(int) + 1
        saturated[k] |= holes[low[0] : high[0], low[1] : high[1]].any()
    return saturated, flat


def convolve_padded(array, response):
    """Convolve one array with a rim around it, by the transform that ``response(shape)`` gives."""
    padded = np.pad(array, RIM)
    return convolve_batch(padded[None], response(padded.shape), padded.shape)
