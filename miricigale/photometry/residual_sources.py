"""Light on the residual image that no template explains."""

import dataclasses

import numpy as np
import scipy.ndimage
import scipy.spatial
from astropy.stats import mad_std

from miricigale.utils.parallel import chunks, parallel_map

#: Least signal-to-noise of light that no template explains, its least share of the model below it and
#: of a neighbor's flux, and its distance to sources in full widths at half maximum: the least to any,
#: and the largest to one that is flagged.
LEFT_SNR, _LEFT_SHARE, _LEFT_DISTANCE, _LEFT_REACH = 5.0, 0.1, 0.7, 2.0

#: Share of a source's flux, and distance to it in full widths, within which peaks are of its wings.
_WINGS = 0.02, 10.0


@dataclasses.dataclass(frozen=True, eq=False)
class ResidualPeaks:
    """Peaks of a residual image, the brightest first."""

    xy: np.ndarray  # (n, 2): Their pixels.
    refined: np.ndarray  # (n, 2): Tops of the parabolas through each pixel and its neighbors.
    flux: np.ndarray  # (n,): As isolated point sources, in the residual's unit.
    full_width: float  # Full width at half maximum of the PSF, in pixels.


def residual_peaks(fit, residual, model, xy):
    """
    Find positive peaks of the residual that are sources of their own (`ResidualPeaks`).

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
        The fit.
    residual, model : `~numpy.ndarray`, shape (ny, nx)
        What it left and what it took, light per pixel.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of all sources; NaN for those far outside.

    Notes
    -----
    Peaks are those of the residual filtered with a Gaussian, above 5 sigma (measured on the filtered
    image itself), above a tenth of the model filtered likewise, and farther than 0.7 full widths at
    half maximum from all sources (nearer ones show in chi2). A peak whose mirror image through the
    nearest source, if that is within two full widths, has more than half as much light is that
    source's own. Of two peaks within 0.7 full widths the brighter one counts.
    """
    inverse_sigma, width = fit.inverse_sigma, fit.psf_width
    full_width = 2.0 * np.sqrt(2.0 * np.log(2.0)) * width
    placed = xy[np.isfinite(xy).all(axis=1)]
    if not inverse_sigma.any():
        return ResidualPeaks(np.empty((0, 2), int), np.empty((0, 2)), np.empty(0), full_width)
    # fluxes of point sources by least squares, as if each stood alone: signal over power
    snr, power = _matched(fit, residual)
    usable = power > 0
    # what is a thousandth of the stated noise is that of the arithmetic
    noise = max(mad_std(_some(snr, usable)), 1e-3)
    # few pixels are left for what follows, unless the image has a background
    near = np.arange(-int(np.ceil(width)), int(np.ceil(width)) + 1)
    found = []
    y, x = np.nonzero(snr > LEFT_SNR * noise)
    for part in chunks(len(y), _CANDIDATES):
        i, j = y[part], x[part]
        top = snr[i, j] >= _windows(snr, i, j, near).max(axis=(1, 2))
        i, j = i[top], j[top]
        taken = _filtered(model, inverse_sigma, i, j, width)
        top = snr[i, j] * np.sqrt(power[i, j]) > _LEFT_SHARE * taken
        found.append((i[top], j[top]))
    y, x = (np.concatenate([one[k] for one in found] or [y]) for k in (0, 1))

    def light_at(y, x):
        return snr[y, x] / np.sqrt(np.where(usable[y, x], power[y, x], 1.0))

    light = light_at(y, x)
    order = np.argsort(-light, kind="stable")
    pixel, light = np.stack([x, y], axis=1)[order], light[order]
    distance = np.full(len(pixel), np.inf)
    if len(placed) and len(pixel):
        distance, nearest = scipy.spatial.KDTree(placed).query(pixel)
        # a template that is too narrow leaves as much on the other side of the source
        mirror = np.rint(2 * placed[nearest] - pixel).astype(int)
        inside = np.all((mirror >= 0) & (mirror < snr.shape[::-1]), axis=1)
        j, i = np.where(inside[:, None], mirror, 0).T
        even = inside & (light_at(i, j) > 0.5 * light)
        distance[even & (distance < _LEFT_REACH * full_width)] = 0.0
    apart = distance >= _LEFT_DISTANCE * full_width
    pixel, light = pixel[apart], light[apart]
    lone = np.ones(len(pixel), bool)
    if len(pixel):
        # brightest first: each that is kept removes the fainter ones near it
        for one, other in sorted(
            scipy.spatial.KDTree(pixel).query_pairs(_LEFT_DISTANCE * full_width)
        ):
            lone[other] &= ~lone[one]
    kept = pixel[lone]
    return ResidualPeaks(kept, kept + _parabola(snr, kept), light[lone], full_width)


#: Rows that are filtered at a time, pixels of which medians are taken, where there are more, and pixels
#: that are looked at together.
_ROWS, _SOME, _CANDIDATES = 256, 4_000_000, 100_000


def _radius(width):
    """Half-width of the Gaussian's window, as `scipy.ndimage.gaussian_filter` has it."""
    return int(4.0 * width + 0.5)


def _matched(fit, residual):
    """Signal-to-noise and power of point sources at all pixels, both zero where too little of them is seen."""
    snr, power, executor = fit.arrays.new(), fit.arrays.new(), fit.bank.executor
    inverse_sigma, width = fit.inverse_sigma, fit.psf_width
    halo, even = _radius(width), np.broadcast_to(np.float32(1), residual.shape)

    def filtered(part, width, image):
        rows = slice(max(part.start - halo, 0), part.stop + halo)
        light = inverse_sigma[rows] ** 2 * image[rows]
        light = scipy.ndimage.gaussian_filter(light, width, mode="constant")
        return light[part.start - rows.start :][: part.stop - part.start]

    def fill_power(part):
        power[part] = filtered(part, width / np.sqrt(2), even) / (4 * np.pi * width**2)

    def fill_snr(part):
        power[part][power[part] <= limit] = 0.0
        light, root = filtered(part, width, residual), np.sqrt(power[part])
        np.divide(light, root, out=snr[part], where=root > 0)

    parts = list(chunks(len(residual), _ROWS))
    parallel_map(fill_power, parts, executor=executor)
    limit = 0.25 * np.median(_some(power, inverse_sigma > 0))
    parallel_map(fill_snr, parts, executor=executor)
    return snr, power


def _filtered(image, inverse_sigma, y, x, width):
    """An image times inverse variance, filtered with a Gaussian at some pixels."""
    around = np.arange(-_radius(width), _radius(width) + 1)
    hat = np.exp(-0.5 * (around / width) ** 2)
    values = _windows(inverse_sigma, y, x, around) ** 2 * _windows(image, y, x, around)
    return np.einsum("kij,i,j->k", values, hat, hat) / hat.sum() ** 2


def _some(image, which):
    """Values of an image at some pixels; of very many, only a part."""
    step = max(1, image.size // _SOME)
    return image.reshape(-1)[::step][which.reshape(-1)[::step]]


def _windows(image, y, x, around):
    """Windows about some pixels, zero beyond the image, shape (n, k, k)."""
    rows, columns = (place[:, None] + around for place in (y, x))
    inside = [(c >= 0) & (c < n) for c, n in zip((rows, columns), image.shape, strict=True)]
    found = image[
        np.clip(rows, 0, image.shape[0] - 1)[:, :, None],
        np.clip(columns, 0, image.shape[1] - 1)[:, None],
    ]
    return np.where(inside[0][:, :, None] & inside[1][:, None], found, 0.0)


def _parabola(image, xy):
    """Offsets (x, y) of maxima from their pixels, at most half a pixel."""
    near = _windows(image, xy[:, 1], xy[:, 0], np.arange(-1, 2))
    offsets = []
    for low, high in ((near[:, 1, 0], near[:, 1, 2]), (near[:, 0, 1], near[:, 2, 1])):
        curvature = 2 * near[:, 1, 1] - low - high
        step = 0.5 * (high - low) / np.where(curvature > 0, curvature, np.inf)
        offsets.append(np.clip(step, -0.5, 0.5))
    return np.stack(offsets, axis=1)


def _near(peaks, xy, reach=_LEFT_REACH):
    """Pairs of a peak and a source within reach (full widths) of it, as two arrays of numbers."""
    placed = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if not len(placed) or not len(peaks.xy):
        return np.empty(0, int), np.empty(0, int)
    tree = scipy.spatial.KDTree(xy[placed])
    found = tree.query_ball_point(peaks.xy, reach * peaks.full_width)
    peak = np.repeat(np.arange(len(found)), [len(rows) for rows in found])
    return peak, placed[np.concatenate(found).astype(int)]


def unexplained_neighbors(peaks, xy, flux):
    """
    Find sources, (n,), next to light that is not in the catalog.

    A peak is within two full widths at half maximum of these, and as a point source has more than a tenth of
    the flux (NaN where not measured).
    """
    found = np.zeros(len(xy), bool)
    peak, source = _near(peaks, xy)
    found[source[peaks.flux[peak] > _LEFT_SHARE * flux[source]]] = True
    return found


def new_sources(peaks, xy, flux, *, usable=None):
    """
    Find peaks that are more than what an imperfect template leaves of a bright source.

    False for peaks with less than a tenth of the flux of a source within two full widths. With pixels that are
    ``usable``, (ny, nx), also for those with less than 2 % of that of one within ten, which a PSF that is not
    exact leaves of wings and spikes, and for those less than two from others, beyond which a source may lie.
    """
    new, strict = np.ones(len(peaks.xy), bool), usable is not None
    for share, reach in ((_LEFT_SHARE, _LEFT_REACH), *[_WINGS] * strict):
        peak, source = _near(peaks, xy, reach)
        new[peak[peaks.flux[peak] <= share * flux[source]]] = False
    if strict:
        around = np.arange(-round(2 * peaks.full_width), round(2 * peaks.full_width) + 1)
        new &= _windows(usable, peaks.xy[:, 1], peaks.xy[:, 0], around).all(axis=(1, 2))
    return new
