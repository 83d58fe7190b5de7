"""Templates: what each source of the high-resolution image looks like on another image."""

import dataclasses
import functools

import numpy as np
import scipy.fft
import scipy.ndimage

from miricigale.photometry import _core
from miricigale.photometry.flags import ForcedFlags
from miricigale.profiles import ellipse_to_pixels, sersic_stamp

__all__ = ["Cutout", "FineTemplates", "TemplateBank", "cutouts", "own_segments", "sersic_cutouts"]

#: Rim of zeros around fine stamps, for the splines and the pixel response to fade in.
_RIM = 8


@dataclasses.dataclass(frozen=True, eq=False)
class Cutout:
    """
    The light of one source on the fine grid, before convolution, of unit total.

    Attributes
    ----------
    data : `~numpy.ndarray`, shape (h, w)
        Light to be convolved.
    origin : (int, int)
        Fine pixel (y, x) of its corner.
    wings : float
        Amplitude of the point source that is added to it.
    noise : float
        Sum of the noise variances of ``data``, for the errors-in-variables correction.
    convolved : bool
        Whether ``data`` has the sharp PSF already (a cutout) or not (a profile).
    """

    data: np.ndarray
    origin: tuple
    wings: float = 0.0
    noise: float = 0.0
    convolved: bool = True


def own_segments(segmentation, labels, xy):
    """
    Give each segment to one source.

    Parameters
    ----------
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Label of each fine pixel, 0 for none.
    labels : int `~numpy.ndarray`, shape (n,), or None
        The label that each source says it has; by default the one at its position.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.

    Returns
    -------
    label : int `~numpy.ndarray`, shape (n,)
        The source's own label, 0 if it has none.
    flags : int `~numpy.ndarray`, shape (n,)
        ``NO_SEGMENT`` and ``SHARED_SEGMENT``. Of several sources on a segment the one
        nearest to the segment's middle owns it.
    """
    ny, nx = segmentation.shape
    x, y = np.rint(np.where(np.isfinite(xy), xy, -1)).astype(int).T
    if labels is None:
        inside = (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        labels = np.where(
            inside, segmentation[np.clip(y, 0, ny - 1), np.clip(x, 0, nx - 1)], 0
        ).astype(int)
    label = np.array(labels, dtype=int)
    flags = np.where(label > 0, 0, int(ForcedFlags.NO_SEGMENT))
    values, counts = np.unique(label[label > 0], return_counts=True)
    for value in values[counts > 1]:
        rows = np.flatnonzero(label == value)
        member = np.argwhere(segmentation == value)
        middle = member.mean(axis=0) if len(member) else np.zeros(2)
        distance = np.hypot(xy[rows, 1] - middle[0], xy[rows, 0] - middle[1])
        losers = np.delete(rows, np.nanargmin(np.nan_to_num(distance, nan=np.inf)))
        label[losers] = 0
        flags[losers] |= int(ForcedFlags.SHARED_SEGMENT)
    return label, flags


def cutouts(data, variance, segmentation, label, xy, source_psf, *, min_snr, wings):
    """
    Cut sources from the high-resolution image and carry on where their segments end.

    Parameters
    ----------
    data, variance : `~numpy.ndarray`, shape (ny, nx)
        Light per pixel (any unit, background subtracted) and its variance, zero and
        infinite where not usable.
    segmentation : int `~numpy.ndarray`, shape (ny, nx)
        Labels.
    label : int `~numpy.ndarray`, shape (n,)
        Label of each source, 0 for none.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of the sources on the image.
    source_psf : `~numpy.ndarray`, shape (k, k)
        PSF of the image, odd and centred.
    min_snr : float
        Least signal-to-noise of a segment.
    wings : bool
        Whether light outside of the segment is added; otherwise a cutout is the
        segment as it is.

    Returns
    -------
    cutout : list of `Cutout` or None
        None where a point source is to be used.
    flags : int `~numpy.ndarray`, shape (n,)
        ``NOISY_SEGMENT``, and ``NO_SEGMENT`` where the label is not on the image.
    snr : float `~numpy.ndarray`, shape (n,)
        Signal-to-noise of each segment; NaN without one.

    Notes
    -----
    The outskirts of a segment found at a low threshold are pixels whose noise is positive:
    taken as they are they make a template too wide, and its flux too high. With ``wings`` the
    pixels of the core (smoothed signal-to-noise above 4) are taken from the image, all
    others from the mean on ellipses about it, neighbours' segments left out, as far as
    that is significant; beyond it the PSF follows, or an exponential disk through the last
    rings where that is brighter. A source whose rings are those of the PSF to the noise is
    a point source (None, without a flag).
    """
    found = []
    flags = np.zeros(len(label), int)
    snr = np.full(len(label), np.nan)
    coefficients = _psf_coefficients(source_psf)
    usable = np.isfinite(variance)
    slices = scipy.ndimage.find_objects(segmentation)
    smooth = _smooth_snr(data, variance) if wings else None
    for k, one in enumerate(label):
        place = slices[one - 1] if 0 < one <= len(slices) else None
        if place is None:
            found.append(None)
            flags[k] |= int(ForcedFlags.NO_SEGMENT) if one > 0 else 0
            continue
        member = (segmentation[place] == one) & usable[place]
        light = np.where(member, data[place], 0.0)
        noise = float(variance[place][member].sum())
        total = float(light.sum())
        snr[k] = total / np.sqrt(noise) if noise > 0 else np.inf
        if not (total > 0 and snr[k] >= min_snr):
            flags[k] |= int(ForcedFlags.NOISY_SEGMENT)
            found.append(None)
            continue
        beyond, rings = 0.0, None
        if wings:
            grown = _carry_on(data, variance, smooth, segmentation, one, place)
            if grown is not None:
                light, member, place, noise, beyond, rings = grown
                total = float(light.sum())
        origin = (place[0].start, place[1].start)
        amplitude = 0.0
        if wings:
            # where the point source is added again, or the two would leave a dipole
            psf = _psf_at(coefficients, xy[k], origin, light.shape)
            if rings is not None and _is_point(psf, *rings):
                found.append(None)
                continue
            inside = float(psf[member].sum())
            # a cutout that hardly holds the PSF says nothing of the wings
            if inside > 0.2:
                amplitude = total / inside
                light = np.where(
                    member, light - amplitude * psf, np.maximum(beyond - amplitude * psf, 0.0)
                )
        norm = amplitude + float(light.sum())
        found.append(Cutout(light / norm, origin, amplitude / norm, noise / norm**2))
    return found, flags, snr


#: Width (pixels) of the Gaussian that tells the core, its least signal-to-noise, the width of
#: rings, and how far around a segment they are looked for.
_WIDTH, _CORE_SNR, _RING, _AROUND = 1.5, 4.0, 2.0, 16


def _smooth_snr(data, variance):
    usable = np.isfinite(variance)
    noise = np.sqrt(scipy.ndimage.gaussian_filter(np.where(usable, variance, 0.0), 4 * _WIDTH))
    gain = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)
    smooth = scipy.ndimage.gaussian_filter(np.where(usable, data, 0.0), _WIDTH)
    return smooth / np.where(noise > 0, noise * gain, np.inf)


def _carry_on(data, variance, smooth, segmentation, one, place):
    """
    Complete a source by its mean on ellipses.

    Returns
    -------
    light, member, place, noise, beyond, rings
        The light, the pixels on which it is known, where they are on the image, the
        noise variance of its core, what an exponential disk
        would have in all pixels, and the rings for `_is_point`; None if it has no core.
    """
    ny, nx = data.shape
    place = (
        slice(max(place[0].start - _AROUND, 0), min(place[0].stop + _AROUND, ny)),
        slice(max(place[1].start - _AROUND, 0), min(place[1].stop + _AROUND, nx)),
    )
    values, labels = data[place], segmentation[place]
    usable = np.isfinite(variance[place])
    core = (labels == one) & usable & (smooth[place] > _CORE_SNR)
    weight = np.where(core, values, 0.0)
    total = weight.sum()
    if np.count_nonzero(core) < 5 or total <= 0:
        return None
    y, x = np.indices(values.shape, dtype=float)
    yc, xc = (weight * y).sum() / total, (weight * x).sum() / total
    y, x = y - yc, x - xc
    moments = np.array(
        [[(weight * x * x).sum(), (weight * x * y).sum()], [0.0, (weight * y * y).sum()]]
    )
    size, axes = np.linalg.eigh(moments / total, UPLO="U")
    # an area-preserving ellipse of the core's shape
    ratio = np.sqrt(np.clip(size[0] / max(size[1], 1e-9), 0.09, 1.0))
    along = x * axes[0, 1] + y * axes[1, 1]
    across = x * axes[0, 0] + y * axes[1, 0]
    radius = np.sqrt(ratio * along**2 + across**2 / ratio)
    free = usable & ((labels == one) | (labels == 0))
    ring = (radius / _RING).astype(int)
    n_rings = int(ring.max()) + 1
    counts = np.bincount(ring[free], minlength=n_rings)
    all_pixels = np.bincount(ring.ravel(), minlength=n_rings)
    safe = np.maximum(counts, 1)
    mean = np.bincount(ring[free], values[free], n_rings) / safe
    error = np.sqrt(np.bincount(ring[free], variance[place][free], n_rings)) / safe
    at = np.bincount(ring[free], radius[free], n_rings) / safe
    core_share = np.bincount(ring[core], minlength=n_rings) / np.maximum(all_pixels, 1)
    # rings count while they are significant and mostly seen
    edge = min(xc, yc, values.shape[1] - 1 - xc, values.shape[0] - 1 - yc) * np.sqrt(ratio)
    good = (counts >= 6) & (counts > 0.3 * all_pixels) & (mean > 2 * error)
    good &= at + _RING / 2 < max(edge, _RING)
    good |= core_share > 0.7
    last = n_rings if good.all() else int(np.argmin(good))
    known = np.flatnonzero(counts[:last])
    if len(known) < 2:
        return None
    inside = radius < last * _RING
    filled = np.interp(radius, at[known], mean[known])
    light = np.where(core, values, np.where(inside, filled, 0.0))
    noise = float(variance[place][core].sum())
    beyond = _disk(at[known], mean[known], error[known], radius)
    rings = (np.where(free, ring, -1), known, mean[known], error[known])
    return light, core | inside, place, noise, beyond, rings


def _is_point(psf, ring, known, mean, error):
    """Whether the means on rings are those of the PSF, to the noise."""
    free = ring >= 0
    n = int(ring.max()) + 1
    counts = np.maximum(np.bincount(ring[free], minlength=n), 1)
    model = (np.bincount(ring[free], psf[free], n) / counts)[known] / error
    seen = mean / error
    amplitude = np.sum(seen * model) / np.sum(model**2)
    chi2 = np.sum((seen - amplitude * model) ** 2)
    n_free = len(known) - 1
    return chi2 < n_free + np.sqrt(2.0 * n_free)


def _disk(at, mean, error, radius):
    """Exponential through the last three rings, carried on outwards."""
    at, mean, error = at[-3:], mean[-3:], error[-3:]
    if np.any(mean <= 0):
        return np.zeros(radius.shape)
    weight = (mean / error) ** 2
    log = np.log(mean)
    middle = np.average(at, weights=weight)
    level = np.average(log, weights=weight)
    slope = np.sum(weight * (at - middle) * (log - level)) / np.sum(weight * (at - middle) ** 2)
    # steeper by a quarter than the last rings: the PSF flattens them, and the last is one that
    # noise let pass; found on Sersic profiles of index 1 to 2.5
    slope = np.clip(1.25 * slope, -1.5, -0.25)
    return np.exp(level + slope * (radius - middle))


def sersic_cutouts(rows, xy, jacobian):
    """
    Draw Sersic profiles on the fine grid.

    Parameters
    ----------
    rows : `~numpy.ndarray`, shape (n, 4)
        Half-light radius (arcsec), Sersic index, axis ratio and position angle (rad);
        NaN for a point source.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.
    jacobian : `~numpy.ndarray`, shape (2, 2)
        Fine pixels per arcsec, ``[dx, dy] = jacobian @ [east, north]``.

    Returns
    -------
    cutout : list of `Cutout` or None
        None for point sources. The profile is cut at the isophote of 99.5 % of the light.
    """
    found = []
    for (radius, index, ratio, angle), (x, y) in zip(rows, xy, strict=True):
        if not np.isfinite(radius):
            found.append(None)
            continue
        r_eff, q, theta = ellipse_to_pixels(
            jacobian, radius=radius, axis_ratio=ratio, position_angle=angle
        )
        stamp, origin = sersic_stamp(
            x=x, y=y, r_eff=float(r_eff), n=index, axis_ratio=float(q), theta=float(theta)
        )
        found.append(Cutout(stamp, origin, convolved=False))
    return found


def _psf_coefficients(psf):
    shape = tuple(n + 2 * _RIM for n in psf.shape)
    padded = np.pad(psf, _RIM)
    return _core.convolve_batch(padded[None], 1.0 / _core.spline_response(shape), shape)


def _psf_at(coefficients, xy, origin, shape):
    """Evaluate a PSF with its centre at ``xy`` on the pixels of a cutout."""
    middle = (coefficients.shape[1] - 1) / 2
    poly = np.zeros((1, 2, 6))
    poly[0, :, 0] = middle
    poly[0, 0, 1] = poly[0, 1, 2] = 1.0
    out = np.zeros(shape[0] * shape[1])
    box = np.array([[0, 0, *shape]])
    center = np.array([[xy[0] - origin[1], xy[1] - origin[0]]])
    start = np.array([0, out.size])
    _core.sample_stamps(coefficients, np.zeros(1, int), np.ones(1), center, poly, box, start, out)
    return out.reshape(shape)


@dataclasses.dataclass(frozen=True, eq=False)
class FineTemplates:
    """
    Convolve cutouts on the fine grid, as spline coefficients.

    Attributes
    ----------
    kernel, target : `~numpy.ndarray`, odd and square
        The matching kernel, and the PSF of the image on the fine grid.
    sides : `~numpy.ndarray`, shape (2, 2), or None
        Sides of the image's pixel in fine pixels, if templates are to be averaged over it.
    """

    kernel: np.ndarray
    target: np.ndarray
    sides: np.ndarray | None = None

    def _response(self, shape):
        response = 1.0 / _core.spline_response(shape)
        if self.sides is not None:
            response = response * _core.box_response(shape, self.sides)
        return response

    @functools.cached_property
    def point(self):
        """Coefficients of the point source, shape (1, h, w), its centre in the middle."""
        shape = tuple(n + 2 * _RIM for n in self.target.shape)
        return _core.convolve_batch(np.pad(self.target, _RIM)[None], self._response(shape), shape)

    @functools.cached_property
    def kernel_power(self):
        """Sum of squares of the kernel with the pixel's response."""
        if self.sides is None:
            return float(np.sum(self.kernel**2))
        shape = tuple(n + 2 * _RIM for n in self.kernel.shape)
        padded = np.pad(self.kernel, _RIM)[None]
        return float(np.sum(_core.convolve_batch(padded, self._sides_only(shape), shape) ** 2))

    def _sides_only(self, shape):
        return _core.box_response(shape, self.sides)

    @functools.lru_cache(maxsize=64)  # noqa: B019 - lives as long as one measurement
    def _transfer(self, shape, convolved):
        if convolved:
            return scipy.fft.rfft2(self.kernel, s=shape) * self._response(shape)
        # a profile is integrated over fine pixels already, which the PSF's samples are not
        transfer = scipy.fft.rfft2(self.target, s=shape) * self._response(shape)
        return transfer / _core.box_response(shape, np.eye(2))

    def shape(self, cutout):
        """Shape of the transform for a cutout, rounded up so that many share it."""
        array = self.kernel if cutout.convolved else self.target
        return tuple(
            scipy.fft.next_fast_len(-(-(n + m - 1 + 2 * _RIM) // 16) * 16, True)
            for n, m in zip(cutout.data.shape, array.shape, strict=True)
        )

    def corner(self, cutout):
        """Fine pixel (y, x) of the first coefficient of a convolved cutout."""
        half = (self.kernel if cutout.convolved else self.target).shape[0] // 2
        return cutout.origin[0] - half - _RIM, cutout.origin[1] - half - _RIM

    def coefficients(self, group, shape):
        """Convolve cutouts of one shape, returning an array of shape (n, *shape)."""
        stamps = np.zeros((len(group), *shape))
        for stamp, cutout in zip(stamps, group, strict=True):
            h, w = cutout.data.shape
            stamp[_RIM : _RIM + h, _RIM : _RIM + w] = cutout.data
        return _core.convolve_batch(stamps, self._transfer(shape, group[0].convolved), shape)


@dataclasses.dataclass(frozen=True, eq=False)
class Block:
    """Some templates as flat stamps: rows ``first ... first + len(box)`` of the bank."""

    first: int
    box: np.ndarray
    start: np.ndarray
    values: np.ndarray

    @property
    def last(self):
        """Row after the last."""
        return self.first + len(self.box)


class TemplateBank:
    """
    All templates of an image, made block by block and kept only if there is room.

    Rows are in the order of the stamps' first image rows, ``order`` gives the source of
    each.

    Parameters
    ----------
    fine : `FineTemplates`
        What convolves.
    cutout : list of `Cutout` or None
        One for each source; None is a point source.
    fine_xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the fine grid.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions on the image.
    poly : `~numpy.ndarray`, shape (n, 2, 6)
        Maps from image to fine pixels (see `~miricigale.photometry.arrays.local_maps`).
    shape : (int, int)
        Shape of the image.
    radius : float, optional
        Largest half-width of a stamp in image pixels.
    max_bytes : float, optional
        Memory for stamps; if they need more they are made anew whenever needed.
    """

    def __init__(self, fine, cutout, fine_xy, xy, poly, shape, *, radius=np.inf, max_bytes=1.5e9):
        self._fine, self._cutout = fine, cutout
        self._fine_xy, self._xy, self._poly = fine_xy, xy, poly
        self._max_bytes = max_bytes
        box = self._boxes(shape, radius)
        self.order = np.argsort(box[:, 0], kind="stable")
        self.box = np.ascontiguousarray(box[self.order])
        self.start = np.concatenate([[0], np.cumsum(self.box[:, 2] * self.box[:, 3])])
        self._kept = None

    def _boxes(self, shape, radius):
        """Boxes on the image that hold the fine stamps, cut to the image."""
        fine, n = self._fine, len(self._cutout)
        low, high = np.empty((n, 2)), np.empty((n, 2))
        half = fine.target.shape[0] // 2 + 1
        for k, cutout in enumerate(self._cutout):
            if cutout is None or cutout.wings:
                low[k] = self._fine_xy[k] - half
                high[k] = self._fine_xy[k] + half
            if cutout is not None:
                y, x = fine.corner(cutout)
                array = fine.kernel if cutout.convolved else fine.target
                h, w = cutout.data.shape
                first = np.array([x, y]) + _RIM - 1.0
                last = first + [w + array.shape[1], h + array.shape[0]]
                low[k] = np.minimum(low[k], first) if cutout.wings else first
                high[k] = np.maximum(high[k], last) if cutout.wings else last
        # corners of the fine rectangle through the inverse of the linear map
        matrix = np.linalg.inv(self._poly[:, :, 1:3])
        corners = np.stack(
            [
                np.stack([a[:, 0], b[:, 1]], axis=-1) - self._poly[:, :, 0]
                for a in (low, high)
                for b in (low, high)
            ]
        )
        offset = np.einsum("kij,ckj->cki", matrix, corners)
        first = np.maximum(offset.min(axis=0), -radius) + self._xy
        last = np.minimum(offset.max(axis=0), radius) + self._xy
        limit = np.array(shape)[::-1]
        first = np.clip(np.floor(first), 0, limit).astype(int)
        last = np.clip(np.ceil(last) + 1, 0, limit).astype(int)
        size = np.maximum(last - first, 0)
        return np.stack([first[:, 1], first[:, 0], size[:, 1], size[:, 0]], axis=1)

    def shifted(self, shift, shape, radius):
        """Make the bank of the same sources moved by (dx, dy) image pixels."""
        return TemplateBank(
            self._fine,
            self._cutout,
            self._fine_xy,
            self._xy + shift,
            self._poly,
            shape,
            radius=radius,
            max_bytes=self._max_bytes,
        )

    @property
    def xy(self):
        """Positions of the sources on the image, in the order of the rows."""
        return self._xy[self.order]

    @property
    def n_values(self):
        """Number of pixels of all stamps."""
        return int(self.start[-1])

    def noise_terms(self):
        """Sum over unit-weight pixels of the templates' variance, by row."""
        terms = np.zeros(len(self.order))
        for row, k in enumerate(self.order):
            cutout = self._cutout[k]
            if cutout is not None and cutout.noise > 0:
                area = abs(np.linalg.det(self._poly[k, :, 1:3]))
                terms[row] = cutout.noise * area * self._fine.kernel_power
        return terms

    def blocks(self):
        """Yield all templates in order, as `Block` of some tens of MB each."""
        if self._kept is not None:
            yield from self._kept
            return
        keep = 4.0 * self.n_values <= self._max_bytes
        kept = []
        limit = max(4_000_000, int(self._max_bytes / 4 / 16))
        first, n = 0, len(self.order)
        while first < n:
            last = int(np.searchsorted(self.start, self.start[first] + limit, side="right")) - 1
            last = min(max(last, first + 1), n)
            block = self._make(first, last)
            if keep:
                kept.append(block)
            yield block
            first = last
        if keep:
            self._kept = kept

    def _make(self, first, last):
        fine = self._fine
        box = self.box[first:last]
        start = self.start[first : last + 1] - self.start[first]
        values = np.zeros(int(start[-1]), np.float32)
        rows = self.order[first:last]
        groups = {}
        amplitude = np.zeros(last - first)
        for local, k in enumerate(rows):
            cutout = self._cutout[k]
            amplitude[local] = 1.0 if cutout is None else cutout.wings
            if cutout is not None and box[local, 2] and box[local, 3]:
                key = (fine.shape(cutout), cutout.convolved)
                groups.setdefault(key, []).append(local)
        middle = (np.array(fine.point.shape[2:0:-1]) - 1) / 2
        poly = self._poly[rows].copy()
        poly[:, :, 0] += middle - self._fine_xy[rows]
        which = np.zeros(last - first, int)
        center = self._xy[rows]
        _core.sample_stamps(fine.point, which, amplitude, center, poly, box, start, values)
        for (shape, _), members in groups.items():
            size = max(1, int(64e6 / 8 / (shape[0] * shape[1])))
            for part in (members[i : i + size] for i in range(0, len(members), size)):
                group = [self._cutout[rows[local]] for local in part]
                coefficients = fine.coefficients(group, shape)
                which = np.zeros(last - first, int)
                amplitude = np.zeros(last - first)
                poly = self._poly[rows].copy()
                for index, (local, cutout) in enumerate(zip(part, group, strict=True)):
                    which[local], amplitude[local] = index, 1.0
                    corner = fine.corner(cutout)
                    poly[local, :, 0] -= corner[::-1]
                _core.sample_stamps(
                    coefficients, which, amplitude, center, poly, box, start, values
                )
        return Block(first, box, start, values)
