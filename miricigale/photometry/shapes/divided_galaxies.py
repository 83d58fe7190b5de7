"""Galaxies that a segmentation divides into several segments: which belong together, and each piece's light."""

import functools
import itertools

import numpy as np
import scipy.ndimage

from miricigale.photometry.detection.cutouts import Cutout

#: Pixels by which a segment is grown to find those that it touches.
_TOUCHING = 2

#: Least part of the light that a profile has on the segments of others, that is on one of the same galaxy.
_PART_OF_CLAIM = 0.2

#: Smoothed brightness on the border of two segments above which one of them is no source of its own: in units of
#: the noise, and of its peak; and standard deviations by which noise alone makes a peak higher.
_BORDER_SNR = 5.0
_PART_OF_PEAK = 0.95
_PEAK_NOISE = 2.0

#: Least chi^2 of a profile on other sources' segments: less is no more than noise.
_SEEN = 25.0

#: Part of a piece's light in a pixel that is left out beyond its last pixel above that.
_NEGLIGIBLE = 1e-7


def continued_groups(models, sources, segments, variance, is_source, smooth):
    """
    Find segments that are continued by others: the smoothed image has no peak inside of them.

    Such a segment belongs together with those on whose border the image is as bright as anywhere in it, to 5 % or
    to the noise.

    Parameters
    ----------
    models : list
        For each source its model, with ``stamp`` (slices) and ``image`` (its light there); None without.
    sources : list of tuple
        Label and position (x, y) of each.
    segments : object
        With ``labels``, shape (ny, nx), and ``totals``, the light of each label.
    variance : `~numpy.ndarray`, shape (ny, nx)
        Of the pixels, infinite where not usable.
    is_source : bool `~numpy.ndarray`
        For each label whether it is a source and no peak of the noise.
    smooth : tuple
        The smoothed image, shape (ny, nx), and its noise over that of the pixels.

    Returns
    -------
    groups : list of list of int
        Numbers of the sources of each galaxy, two at least, ascending.
    """
    smooth_image, gain = smooth

    def links(model, label):
        return _Piece(model, label, segments, variance, is_source).continued(smooth_image, gain)

    return _groups(models, sources, is_source, links)


def claimed_groups(models, sources, segments, variance, is_source, smooth):
    """
    Find sources whose profiles claim the light of others.

    The profile of a piece is constrained on its own segment only, and reaches over those of its neighbors. If it
    has more light on others' segments than on its own and on the sky together, it belongs together with those that
    it touches and that have a good part of that light.

    Parameters and results are those of `continued_groups`.
    """

    def links(model, label):
        return _Piece(model, label, segments, variance, is_source).claimed()

    return _groups(models, sources, is_source, links)


def _groups(models, sources, is_source, links):
    """Group sources that are linked by labels, which ``links(model, label)`` lists."""
    rows = {}
    for k, (label, _) in enumerate(sources):
        if models[k] is not None and is_source[label]:
            rows[int(label)] = k
    groups = {k: [k] for k in rows.values()}
    for label, k in rows.items():
        for linked in links(models[k], label):
            if linked not in rows:
                continue
            group = groups[k]
            linked_group = groups[rows[linked]]
            if group is not linked_group:
                _merge(groups, group, linked_group)
    return [sorted(group) for k, group in groups.items() if len(group) > 1 and min(group) == k]


def linked_groups(links, n, largest):
    """
    Join rows to groups by links between them, the strongest first.

    Parameters
    ----------
    links : iterable of (float, int, int)
        What they are sorted by, ascending, and the two rows.
    n : int
        Number of rows.
    largest : int
        Most rows of a group.

    Returns
    -------
    groups : list of list of int
        Those of several rows.
    """
    groups = {k: [k] for k in range(n)}
    for _, row, neighbor in sorted(links):
        group = groups[row]
        neighbor_group = groups[neighbor]
        if group is not neighbor_group and len(group) + len(neighbor_group) <= largest:
            _merge(groups, group, neighbor_group)
    return [group for k, group in groups.items() if len(group) > 1 and group[0] == k]


def _merge(groups, group, other_group):
    """Add the rows of a group to another one, and to what each row is in."""
    group.extend(other_group)
    groups.update(dict.fromkeys(other_group, group))


def reaching_over(models, sources, segments, variance, is_source):
    """
    Find the sources whose profiles have more light on others' segments than on their own and on the sky.

    Parameters are those of `continued_groups`.
    """
    reaching = set()
    for k, ((label, _), model) in enumerate(zip(sources, models, strict=True)):
        if model is not None and _Piece(model, label, segments, variance, is_source).reaches_over:
            reaching.add(k)
    return reaching


class _Piece:
    """A source that may be a piece of a galaxy, on its stamp."""

    def __init__(self, model, label, segments, variance, is_source):
        self._model = model
        self._n_labels = len(segments.totals)
        self._labels = segments.labels[model.stamp]
        self._variance = variance[model.stamp]
        self._own = self._labels == label
        self._foreign = is_source[self._labels] & ~self._own

    @functools.cached_property
    def _touching(self):
        """Labels of the segments of others that it touches, ascending."""
        if not self._foreign.any():
            return np.zeros(0, self._labels.dtype)
        grown = scipy.ndimage.binary_dilation(self._own, iterations=_TOUCHING)
        return np.unique(self._labels[grown & self._foreign])

    @property
    def reaches_over(self):
        """Whether more light of the model is on the segments of others than elsewhere, and is seen there."""
        image = self._model.image
        foreign = self._foreign
        if image[foreign].sum() <= image[~foreign].sum():
            return False
        return np.sum((image**2 / self._variance)[foreign]) >= _SEEN

    def claimed(self):
        """Return labels of the segments that belong to the same galaxy by the light of the model."""
        if not self.reaches_over:
            return []
        labels = self._labels[self._foreign]
        image = self._model.image[self._foreign]
        claims = np.bincount(labels, image, self._n_labels)
        touching = self._touching
        return touching[claims[touching] > _PART_OF_CLAIM * claims.sum()].tolist()

    def continued(self, smooth, gain):
        """Return labels of the segments on whose border the smoothed image is as bright as anywhere here."""
        light = smooth[self._model.stamp]
        usable = self._own & np.isfinite(self._variance)
        if not usable.any():
            return []
        peak = np.argmax(np.where(usable, light, -np.inf))
        noise = gain * np.sqrt(self._variance.flat[peak])
        highest = light.flat[peak]
        # noise of noiseless images is that of the numbers
        enough = max(_PART_OF_PEAK * highest, _BORDER_SNR * noise)
        enough = min(enough, max(highest - _PEAK_NOISE * noise, _BORDER_SNR * noise))
        brighter = []
        for neighbor in self._touching.tolist():
            border = usable & scipy.ndimage.binary_dilation(self._labels == neighbor)
            if border.any() and light[border].max() > enough:
                brighter.append(neighbor)
        return brighter


def divided(image, origin, labels, members, core, variance):
    """
    Divide the light of a galaxy among its segments.

    Each pixel belongs to the segment that it is in, or else to the nearest of the galaxy's: the light within a
    segment is its own, and the wings of the galaxy continue it.

    Parameters
    ----------
    image : `~numpy.ndarray`, shape (h, w)
        The light of the galaxy, of unit total, at the resolution of the high-resolution image.
    origin : tuple of int
        Pixel (y, x) of its corner.
    labels : int `~numpy.ndarray`, shape (h, w)
        Labels of its pixels; 0 beyond the edge of the image.
    members : sequence of int
        Labels of the pieces.
    core : bool `~numpy.ndarray`, shape (h, w)
        Pixels that are those of the image itself, not of a profile.
    variance : `~numpy.ndarray`, shape (h, w)
        Of the pixels of the core.

    Returns
    -------
    pieces : list of `~miricigale.photometry.detection.cutouts.Cutout` or None
        Light of each over its share; None for those without positive light.
    shares : `~numpy.ndarray`, shape (n,)
        Parts of the light of all pieces; zero for those without.
    """
    # the cell of each piece: pixels nearest to its segment
    inside = np.isin(labels, members)
    nearest = scipy.ndimage.distance_transform_edt(
        ~inside, return_distances=False, return_indices=True
    )
    cells = labels[tuple(nearest)]
    lights = np.zeros(len(members))
    for k, label in enumerate(members):
        lights[k] = max(image[cells == label].sum(), 0.0)
    # what the galaxy has beyond the rectangle counts for all pieces alike
    shares = lights / lights.sum()
    pieces = []
    for label, share in zip(members, shares, strict=True):
        if not share > 0:
            pieces.append(None)
            continue
        cell = cells == label
        is_visible = cell & (np.abs(image) > _NEGLIGIBLE * share)
        box = scipy.ndimage.find_objects(is_visible.astype(int))[0]
        rows, columns = box
        first = int(origin[0] + rows.start), int(origin[1] + columns.start)
        noise = float(variance[cell & core].sum()) / share**2
        pieces.append(Cutout(np.where(cell, image, 0.0)[box] / share, first, noise=noise))
    return pieces, shares


def padded(array, place, corner, shape, fill):
    """
    Copy an array that lies at a place of an image to a rectangle of that image.

    Parameters
    ----------
    array : `~numpy.ndarray`
        Its values.
    place : tuple of int
        Pixel (y, x) of the image at its corner.
    corner, shape : tuple of int
        Of the rectangle, which may reach beyond the array.
    fill : scalar
        Value of pixels beyond it.
    """
    copy = np.full(shape, fill, array.dtype)
    source = []
    target = []
    for begin, n, first, size in zip(place, array.shape, corner, shape, strict=True):
        low = max(begin, first)
        high = max(min(begin + n, first + size), low)
        target.append(slice(low - first, high - first))
        source.append(slice(low - begin, high - begin))
    copy[tuple(target)] = array[tuple(source)]
    return copy


def joined_groups(groups, leader_groups):
    """Join groups of row numbers whose leaders (their first rows) belong together, as further groups say."""
    of_leader = {group[0]: group for group in groups}
    joined = []
    for leaders in leader_groups:
        parts = [of_leader.pop(leader, [leader]) for leader in leaders]
        joined.append(sorted(itertools.chain.from_iterable(parts)))
    return list(of_leader.values()) + joined
