"""Light on the residual image that no template explains."""

import dataclasses
import itertools

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
    fit : `~miricigale.photometry.fit.template_fit.TemplateFit`
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
    matched, executor = _Matched(inverse_sigma, width, residual), fit.bank.executor
    # of very many pixels only those of some rows
    some = [part for part in chunks(len(residual), _ROWS // 8) if inverse_sigma[part].any()]
    some = some[:: max(1, residual.size // _SOME)]
    found = parallel_map(matched.rows, some, executor=executor)
    snr, power = map(np.concatenate, zip(*found, strict=True))
    seen = np.concatenate([inverse_sigma[part] for part in some]) > 0
    matched.least = 0.25 * np.median(power[seen])
    # what is a thousandth of the stated noise is that of the arithmetic
    limit = LEFT_SNR * max(mad_std(snr[power > matched.least]), 1e-3)
    reach = int(np.ceil(width))

    def find(part):
        """Places, lights and tops of the parabolas of peaks on some rows."""
        first = max(part.start - reach, 0)
        snr, power = matched.rows(slice(first, part.stop + reach))
        own, found = slice(part.start - first, part.stop - first), []
        y, x = np.nonzero(snr[own] > limit)
        # few pixels are left for what follows, unless the image has a background
        for some in chunks(len(y), _CANDIDATES):
            i, j = y[some] + own.start, x[some]
            top = snr[i, j] >= _windows(snr, i, j, np.arange(-reach, reach + 1)).max(axis=(1, 2))
            i, j = i[top], j[top]
            root = np.sqrt(power[i, j])
            top = snr[i, j] * root > _LEFT_SHARE * matched.at(i + first, j, width, model)
            place, light = np.stack([j, i], axis=1)[top], (snr[i, j] / root)[top]
            found.append([place + [0, first], light, place + [0, first] + _parabola(snr, place)])
        return found

    found = parallel_map(find, chunks(len(residual), _ROWS), executor=executor)
    none = np.empty((0, 2), int), np.empty(0), np.empty((0, 2))
    found = zip(none, *itertools.chain(*found), strict=True)
    pixel, light, refined = map(np.concatenate, found)
    order = np.argsort(-light, kind="stable")
    pixel, light, refined = pixel[order], light[order], refined[order]
    distance = np.full(len(pixel), np.inf)
    if len(placed) and len(pixel):
        distance, nearest = scipy.spatial.KDTree(placed).query(pixel)
        # a template that is too narrow leaves as much on the other side of the source
        near = np.flatnonzero(distance < _LEFT_REACH * full_width)
        for rows in (near[part] for part in chunks(len(near), _CANDIDATES // 10)):
            mirror = np.rint(2 * placed[nearest[rows]] - pixel[rows]).astype(int)
            even = matched.light_at(*mirror.T[::-1]) > 0.5 * light[rows]
            even &= np.all((mirror >= 0) & (mirror < residual.shape[::-1]), axis=1)
            distance[rows[even]] = 0.0
    apart = distance >= _LEFT_DISTANCE * full_width
    pixel, light, refined = pixel[apart], light[apart], refined[apart]
    lone = np.ones(len(pixel), bool)
    if len(pixel):
        # brightest first: each that is kept removes the fainter ones near it
        for one, other in sorted(
            scipy.spatial.KDTree(pixel).query_pairs(_LEFT_DISTANCE * full_width)
        ):
            lone[other] &= ~lone[one]
    return ResidualPeaks(pixel[lone], refined[lone], light[lone], full_width)


#: Rows that are filtered at a time, pixels of which medians are taken, where there are more, and pixels
#: that are looked at together.
_ROWS, _SOME, _CANDIDATES = 256, 4_000_000, 100_000


def _radius(width):
    """Half-width of the Gaussian's window, as `scipy.ndimage.gaussian_filter` has it."""
    return int(4.0 * width + 0.5)


@dataclasses.dataclass
class _Matched:
    """Fluxes of point sources at all pixels by least squares, as if each stood alone: signal over power."""

    inverse_sigma: np.ndarray
    width: float
    residual: np.ndarray
    least: float = 0.0  # Power below which too little of a source is seen.

    def rows(self, part):
        """Signal-to-noise and power on some rows, both zero where too little of a source is seen."""
        light = self._filtered(part, self.width, self.residual)
        power = self._filtered(part, self.width / np.sqrt(2)) / (4 * np.pi * self.width**2)
        power[power <= self.least] = 0.0
        return np.divide(light, np.sqrt(power), out=np.zeros_like(light), where=power > 0), power

    def _filtered(self, part, width, image=None):
        halo = _radius(width)
        rows = slice(max(part.start - halo, 0), part.stop + halo)
        light = self.inverse_sigma[rows] ** 2
        light *= 1 if image is None else image[rows]
        light = scipy.ndimage.gaussian_filter(light, width, mode="constant")
        return light[part.start - rows.start :][: part.stop - part.start]

    def at(self, y, x, width, image=None):
        """The inverse variance, times an image if there is one, filtered with a Gaussian at some pixels."""
        around = np.arange(-_radius(width), _radius(width) + 1)
        hat = np.exp(-0.5 * (around / width) ** 2)
        values = _windows(self.inverse_sigma, y, x, around) ** 2
        values *= 1 if image is None else _windows(image, y, x, around)
        return np.einsum("kij,i,j->k", values, hat, hat) / hat.sum() ** 2

    def light_at(self, y, x):
        """Fluxes at some pixels, zero where too little of a source is seen."""
        power = self.at(y, x, self.width / np.sqrt(2)) / (4 * np.pi * self.width**2)
        light = self.at(y, x, self.width, self.residual)
        return np.divide(light, power, out=np.zeros_like(light), where=power > self.least)


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
