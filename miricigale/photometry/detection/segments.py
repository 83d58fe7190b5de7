"""Segments that are grown, so that they hold more of their sources' light."""

import dataclasses

import numpy as np
import scipy.ndimage
from photutils.segmentation import SegmentationImage

from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import is_ascending


@dataclasses.dataclass(frozen=True)
class DilationRule:
    """
    The area of a segment after dilation, by its area before.

    Attributes
    ----------
    areas : tuple of float
        Areas before dilation in arcsec2, ascending.
    factors : tuple of float
        By what the area grows there, at least 1; interpolated in the logarithms of both, and constant
        beyond the first and last.
    min_area, max_area : float, optional
        Least and largest area after dilation in arcsec2. A segment that is larger than
        ``max_area`` stays as it is.

    Raises
    ------
    ValueError
        If areas do not ascend, factors are below 1, or numbers do not fit.

    References
    ----------
    De Santis et al. 2007, New Astronomy 12, 271 (growth by a factor of the area, between a
    least and a largest area); Galametz et al. 2013, ApJS 206, 10 (growth that depends on the area).

    Examples
    --------
    >>> from miricigale.photometry import DilationRule
    >>> rule = DilationRule(areas=(0.5, 5), factors=(3, 1.5), min_area=0.8)
    >>> rule.area([0.1, 0.5, 5, 20]).round(2)
    array([ 0.8,  1.5,  7.5, 30. ])
    """

    areas: tuple = (1.0,)
    factors: tuple = (2.0,)
    min_area: float = 0.0
    max_area: float = np.inf

    def __post_init__(self):
        areas = np.atleast_1d(floats(self.areas))
        factors = np.atleast_1d(floats(self.factors))
        good = is_ascending(areas) and areas[0] > 0
        check_that(good, "areas", "positive and ascending", self.areas)
        if factors.shape != areas.shape or not np.all(factors >= 1):
            wanted = f"{len(areas)} numbers of at least 1, one for each area"
            raise argument_error("factors", wanted, self.factors)
        if not 0 <= self.min_area <= self.max_area:
            raise argument_error("min_area", "between 0 and 'max_area'", self.min_area)
        object.__setattr__(self, "areas", tuple(areas.tolist()))
        object.__setattr__(self, "factors", tuple(factors.tolist()))

    def area(self, before):
        """Return areas (arcsec2) that segments of some areas are to have, never below these."""
        before = floats(before)
        with np.errstate(divide="ignore"):
            factor = np.exp(np.interp(np.log(before), np.log(self.areas), np.log(self.factors)))
        return np.maximum(np.clip(before * factor, self.min_area, self.max_area), before)


#: ``"area"`` is the package's own choice for images like F160W: faint sources, whose segments hold only
#: their cores, grow the most.
DILATION_RULES = {
    "area": DilationRule(areas=(0.3, 1.0, 5.0, 20.0), factors=(4.0, 3.0, 1.8, 1.2), min_area=0.8)
}


@takes_other_keywords
def dilate_segments(segmentation, rule, *, pixel_scale, mask=None):
    """
    Grow segments into the sky around them.

    Parameters
    ----------
    segmentation : `~photutils.segmentation.SegmentationImage` or int array, shape (ny, nx)
        Label 0 is the sky.
    rule : `DilationRule` or str
        How far; or a name in `DILATION_RULES`.
    pixel_scale : float
        Arcsec per pixel.
    mask : bool array, shape (ny, nx), optional
        True for pixels that no segment takes.

    Returns
    -------
    dilated : `~photutils.segmentation.SegmentationImage`
        With the same labels. A segment takes the nearest pixels of the sky until it has its area, to
        within those of equal distance. It does not take those that are nearer to another
        segment, nor any farther than the radius of a circle of the area to be added: segments
        hemmed in by others stay smaller.

    Raises
    ------
    KeyError
        If there is no such rule.
    ValueError
        If shapes differ.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.photometry import dilate_segments
    >>> segments = np.zeros((50, 50), int)
    >>> segments[20:25, 20:25] = 1
    >>> grown = dilate_segments(segments, "area", pixel_scale=0.1)
    >>> int(segments.sum()), int(grown.areas[0])
    (25, 101)
    """
    rule = dilation_rule(rule)
    labels = np.asarray(getattr(segmentation, "data", segmentation))
    if labels.ndim != 2 or labels.dtype.kind not in "iu":
        got = f"{labels.dtype} of shape {labels.shape}"
        raise argument_error("segmentation", "a two-dimensional image of integers", got)
    if mask is not None and np.shape(mask) != labels.shape:
        raise argument_error("mask", f"of the segmentation's shape {labels.shape}", np.shape(mask))
    grown = labels.copy()
    names, index, counts = np.unique(labels, return_inverse=True, return_counts=True)
    index = index.reshape(labels.shape)
    is_sky = names == 0
    if not is_sky.any() or len(names) == 1:
        return SegmentationImage(grown)
    pixel = float(pixel_scale) ** 2
    wanted = np.where(is_sky, 0, np.rint(rule.area(counts * pixel) / pixel)).astype(int)
    # pixels that each segment is to gain
    missing = np.where(is_sky, 0, wanted - counts)
    distance, nearest = scipy.ndimage.distance_transform_edt(labels == 0, return_indices=True)
    owner = index[tuple(nearest)]
    # a single pixel would reach as far
    is_free = (labels == 0) & (distance <= np.sqrt(missing / np.pi)[owner] + 1e-9)
    if mask is not None:
        is_free &= ~np.asarray(mask, bool)
    y, x = np.nonzero(is_free)
    owner = owner[y, x]
    distance = distance[y, x]
    # of each segment the nearest pixels first
    order = np.lexsort((distance, owner))
    first = np.searchsorted(owner[order], np.arange(len(names)))
    last = np.searchsorted(owner[order], np.arange(len(names)), side="right")
    limit = np.full(len(names), -1.0)
    grows = (last > first) & (missing > 0)
    edge = first[grows] + np.minimum(missing, last - first)[grows] - 1
    limit[grows] = distance[order][edge]
    is_taken = distance <= limit[owner]
    grown[y[is_taken], x[is_taken]] = names[owner[is_taken]]
    return SegmentationImage(grown)


def dilation_rule(rule):
    """Return the rule of a name, or the rule itself."""
    if isinstance(rule, DilationRule):
        return rule
    check_names([rule], "dilation rule", DILATION_RULES)
    return DILATION_RULES[rule]
