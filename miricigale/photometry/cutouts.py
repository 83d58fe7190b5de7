"""Cutouts: the light of each source of the high-resolution image, before convolution."""

import dataclasses

import numpy as np
import scipy.ndimage

from miricigale.photometry import _core
from miricigale.photometry.flags import ForcedFlags
from miricigale.profiles import ellipse_to_pixels, sersic_stamp
from miricigale.utils.parallel import parallel_map

__all__ = ["RIM", "Cutout", "convolve_padded", "cutouts", "own_segments", "sersic_cutouts"]

#: Rim of zeros around fine stamps, for the splines and the pixel response to fade in.
RIM = 8


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


def cutouts(data, variance, segmentation, label, xy, source_psf, *, min_snr, wings, executor=None):
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
    executor : `concurrent.futures.Executor`, optional
        Threads to work with.

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
    coefficients = convolve_padded(source_psf, lambda shape: 1.0 / _core.spline_response(shape))
    usable = np.isfinite(variance)
    slices = scipy.ndimage.find_objects(segmentation)
    smooth = _smooth_snr(data, variance, executor) if wings else None
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


def _smooth_snr(data, variance, executor):
    usable = np.isfinite(variance)

    def smooth(what):
        image, width = what
        return scipy.ndimage.gaussian_filter(np.where(usable, image, 0.0), width)

    images = [(variance, 4 * _WIDTH), (data, _WIDTH)]
    noise, light = parallel_map(smooth, images, executor=executor)
    noise = np.sqrt(noise)
    gain = 1.0 / (2.0 * np.sqrt(np.pi) * _WIDTH)
    return light / np.where(noise > 0, noise * gain, np.inf)


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


def convolve_padded(array, response):
    """Convolve one array with a rim around it, by the transform that ``response(shape)`` gives."""
    shape = tuple(n + 2 * RIM for n in array.shape)
    return _core.convolve_batch(np.pad(array, RIM)[None], response(shape), shape)


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
