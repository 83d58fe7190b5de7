"""Light on the residual image that no template explains."""

import dataclasses
import itertools

import numpy as np
import scipy.ndimage
import scipy.spatial
from astropy.stats import gaussian_sigma_to_fwhm, mad_std
from scipy.special import ndtr

from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import chunks, parallel_map
from miricigale.utils.values import value_class

#: Least signal-to-noise of light that no template explains, its least share of the model below it and
#: of a neighbor's flux, and its distance to sources in full widths at half maximum: the least to any,
#: and the largest to one that is flagged.
LEFT_SNR = 5.0
_LEFT_SHARE = 0.1
_LEFT_DISTANCE = 0.7
_LEFT_REACH = 2.0

#: Largest share of false new sources where the evidence decides whether they are fitted.
_FALSE_RATE = 0.1

#: Share of a source's flux, and distance to it in full widths, within which peaks are of its wings.
_WINGS = 0.02, 10.0


@value_class
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
    inverse_sigma = fit.inverse_sigma
    # no number of numpy, with which images would be in double precision
    width = float(fit.psf_width)
    full_width = 2.0 * np.sqrt(2.0 * np.log(2.0)) * width
    placed = xy[np.isfinite(xy).all(axis=1)]
    if not inverse_sigma.any():
        return ResidualPeaks(np.empty((0, 2), int), np.empty((0, 2)), np.empty(0), full_width)
    matched = _Matched(inverse_sigma, width, residual)
    executor = fit.bank.executor
    limit = matched.limit(executor)
    return_freed_memory()

    def find(part):
        return matched.peaks(part, limit, model)

    peaks = parallel_map(find, chunks(len(residual), _ROWS), executor=executor)
    none = np.empty((0, 2), int), np.empty(0), np.empty((0, 2))
    peaks = zip(none, *itertools.chain(*peaks), strict=True)
    pixel, light, refined = map(np.concatenate, peaks)
    order = np.argsort(-light, kind="stable")
    pixel = pixel[order]
    light = light[order]
    refined = refined[order]
    distance = _distances(pixel, light, placed, matched, full_width)
    is_apart = distance >= _LEFT_DISTANCE * full_width
    pixel = pixel[is_apart]
    light = light[is_apart]
    refined = refined[is_apart]
    lone = np.ones(len(pixel), bool)
    if len(pixel):
        # brightest first: each that is kept removes the fainter ones near it
        for row, neighbor in sorted(
            scipy.spatial.KDTree(pixel).query_pairs(_LEFT_DISTANCE * full_width)
        ):
            lone[neighbor] &= ~lone[row]
    return ResidualPeaks(pixel[lone], refined[lone], light[lone], full_width)


def _distances(pixel, light, placed, matched, full_width):
    """Return distances of peaks to the nearest source; 0 of those that are a source's own light."""
    distance = np.full(len(pixel), np.inf)
    if not len(placed) or not len(pixel):
        return distance
    distance, nearest = scipy.spatial.KDTree(placed).query(pixel)
    # a template that is too narrow leaves as much on the other side of the source
    close = np.flatnonzero(distance < _LEFT_REACH * full_width)
    for part in chunks(len(close), _CANDIDATES // 10):
        rows = close[part]
        mirror = np.rint(2 * placed[nearest[rows]] - pixel[rows]).astype(int)
        x, y = mirror.T
        is_symmetric = matched.light_at(y, x) > 0.5 * light[rows]
        is_symmetric &= np.all((mirror >= 0) & (mirror < matched.residual.shape[::-1]), axis=1)
        distance[rows[is_symmetric]] = 0.0
    return distance


#: Rows that are filtered at a time, pixels of which medians are taken, where there are more, and pixels
#: that are looked at together.
_ROWS = 256
_SOME = 4_000_000
_CANDIDATES = 100_000


def _radius(width):
    """Return the half-width (pixels) of the Gaussian's window, as `scipy.ndimage.gaussian_filter` has it."""
    return int(4.0 * width + 0.5)


@dataclasses.dataclass
class _Matched:
    """Fluxes of point sources at all pixels by least squares, as if each stood alone: signal over power."""

    inverse_sigma: np.ndarray
    width: float
    residual: np.ndarray
    min_power: float = 0.0  # Power below which too little of a source is seen.

    def limit(self, executor):
        """Return the signal-to-noise of peaks, measured on the filtered image; set the least power before."""
        # of very many pixels only those of some rows
        sampled = [
            part
            for part in chunks(len(self.residual), _ROWS // 8)
            if self.inverse_sigma[part].any()
        ]
        sampled = sampled[:: max(1, self.residual.size // _SOME)]
        strips = parallel_map(self.rows, sampled, executor=executor)
        # images as large as the residual are dropped as soon as they are used
        power = np.concatenate(
            [
                strip_power[self.inverse_sigma[part] > 0]
                for part, (_, strip_power) in zip(sampled, strips, strict=True)
            ]
        )
        self.min_power = 0.25 * np.median(power, overwrite_input=True)
        del power
        snr = np.concatenate(
            [strip_snr[strip_power > self.min_power] for strip_snr, strip_power in strips]
        )
        del strips
        return_freed_memory()
        # what is a thousandth of the stated noise is that of the arithmetic
        return LEFT_SNR * max(mad_std(snr), 1e-3)

    def peaks(self, part, limit, model):
        """Find places, light and tops of the parabolas of peaks on some rows, by groups."""
        reach = int(np.ceil(self.width))
        first = max(part.start - reach, 0)
        snr, power = self.rows(slice(first, part.stop + reach))
        inner = slice(part.start - first, part.stop - first)
        peaks = []
        y, x = np.nonzero(snr[inner] > limit)
        # few pixels are left for what follows, unless the image has a background
        for group in chunks(len(y), _CANDIDATES):
            i = y[group] + inner.start
            j = x[group]
            top = snr[i, j] >= _windows(snr, i, j, np.arange(-reach, reach + 1)).max(axis=(1, 2))
            i = i[top]
            j = j[top]
            root = np.sqrt(power[i, j])
            top = snr[i, j] * root > _LEFT_SHARE * self.at(i + first, j, self.width, model)
            place = np.stack([j, i], axis=1)[top]
            light = (snr[i, j] / root)[top]
            peaks.append([place + [0, first], light, place + [0, first] + _parabola(snr, place)])
        return peaks

    def rows(self, part):
        """Return signal-to-noise and power on some rows, both zero where too little of a source is seen."""
        # matched filter: sum of PSF times residual over the variance
        light = self._filtered(part, self.width, self.residual)
        # and of the squared PSF over the variance, a Gaussian narrower by the root of two
        power = self._filtered(part, self.width / np.sqrt(2)) / (4 * np.pi * self.width**2)
        power[power <= self.min_power] = 0.0
        return np.divide(light, np.sqrt(power), out=np.zeros_like(light), where=power > 0), power

    def _filtered(self, part, width, image=None):
        halo = _radius(width)
        rows = slice(max(part.start - halo, 0), part.stop + halo)
        light = self.inverse_sigma[rows] ** 2
        if image is not None:
            light *= image[rows]
        light = scipy.ndimage.gaussian_filter(light, width, mode="constant")
        return light[part.start - rows.start :][: part.stop - part.start]

    def at(self, y, x, width, image=None):
        """Filter the inverse variance, times an image if there is one, with a Gaussian at some pixels."""
        steps = np.arange(-_radius(width), _radius(width) + 1)
        hat = np.exp(-0.5 * (steps / width) ** 2)
        values = _windows(self.inverse_sigma, y, x, steps) ** 2
        if image is not None:
            values *= _windows(image, y, x, steps)
        return np.einsum("kij,i,j->k", values, hat, hat) / hat.sum() ** 2

    def light_at(self, y, x):
        """Return fluxes at some pixels, zero where too little of a source is seen."""
        power = self.at(y, x, self.width / np.sqrt(2)) / (4 * np.pi * self.width**2)
        light = self.at(y, x, self.width, self.residual)
        return np.divide(light, power, out=np.zeros_like(light), where=power > self.min_power)


def _windows(image, y, x, steps):
    """Cut windows about some pixels, zero beyond the image, shape (n, k, k)."""
    ny, nx = image.shape
    rows = y[:, None] + steps
    columns = x[:, None] + steps
    row_inside = (rows >= 0) & (rows < ny)
    column_inside = (columns >= 0) & (columns < nx)
    values = image[
        np.clip(rows, 0, ny - 1)[:, :, None],
        np.clip(columns, 0, nx - 1)[:, None],
    ]
    return np.where(row_inside[:, :, None] & column_inside[:, None], values, 0.0)


def _parabola(image, xy):
    """Return offsets (x, y) of maxima from their pixels, at most half a pixel."""
    windows = _windows(image, xy[:, 1], xy[:, 0], np.arange(-1, 2))
    offsets = []
    for low, high in ((windows[:, 1, 0], windows[:, 1, 2]), (windows[:, 0, 1], windows[:, 2, 1])):
        # vertex of the parabola through three pixels
        curvature = 2 * windows[:, 1, 1] - low - high
        step = 0.5 * (high - low) / np.where(curvature > 0, curvature, np.inf)
        offsets.append(np.clip(step, -0.5, 0.5))
    return np.stack(offsets, axis=1)


def _close_pairs(peaks, xy, reach=_LEFT_REACH):
    """Find pairs of a peak and a source within reach (full widths) of it, as two arrays of numbers."""
    placed = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if not len(placed) or not len(peaks.xy):
        return np.empty(0, int), np.empty(0, int)
    tree = scipy.spatial.KDTree(xy[placed])
    sources_of_peaks = tree.query_ball_point(peaks.xy, reach * peaks.full_width)
    peak = np.repeat(np.arange(len(sources_of_peaks)), list(map(len, sources_of_peaks)))
    return peak, placed[np.concatenate(sources_of_peaks).astype(int)]


def unexplained_neighbors(peaks, xy, flux):
    """
    Find sources, (n,), next to light that is not in the catalog.

    A peak is within two full widths at half maximum of these, and as a point source has more than a tenth of
    the flux (NaN where not measured).
    """
    has_light = np.zeros(len(xy), bool)
    peak, source = _close_pairs(peaks, xy)
    has_light[source[peaks.flux[peak] > _LEFT_SHARE * flux[source]]] = True
    return has_light


def new_sources(peaks, xy, flux, *, usable=None):
    """
    Find peaks that are more than what an imperfect template leaves of a bright source.

    False for peaks with less than a tenth of the flux of a source within two full widths. With pixels that are
    ``usable``, (ny, nx), also for those with less than 2 % of that of one within ten, which a PSF that is not
    exact leaves of wings and spikes, and for those less than two from others, beyond which a source may lie.
    """
    new = np.ones(len(peaks.xy), bool)
    strict = usable is not None
    limits = [(_LEFT_SHARE, _LEFT_REACH)]
    if strict:
        limits.append(_WINGS)
    for share, reach in limits:
        peak, source = _close_pairs(peaks, xy, reach)
        new[peak[peaks.flux[peak] <= share * flux[source]]] = False
    if strict:
        steps = np.arange(-round(2 * peaks.full_width), round(2 * peaks.full_width) + 1)
        new &= _windows(usable, peaks.xy[:, 1], peaks.xy[:, 0], steps).all(axis=(1, 2))
    return new


def chosen_peaks(peaks, negative, xy, flux, usable, second_pass):
    """
    Choose the peaks that are fitted as new sources, and say on what evidence.

    Parameters
    ----------
    peaks, negative : `ResidualPeaks`
        Peaks of the residual, and of its negative: these are false, and count how many of the first are.
    xy, flux : `~numpy.ndarray`, shapes (n, 2) and (n,)
        Positions of all sources, and their fluxes; NaN where not measured.
    usable : bool `~numpy.ndarray`, shape (ny, nx)
        Pixels that are searched.
    second_pass : bool or None
        Whether new sources are fitted; None where few enough of them are false.

    Returns
    -------
    chosen : bool `~numpy.ndarray`, shape (n_peaks,)
    evidence : dict of str to object
        ``"peaks"`` (their number), ``"threshold"``, ``"false_rate"`` and ``"fitted"``.
    """
    searched = usable if second_pass is None else None
    new = new_sources(peaks, xy, flux, usable=searched)
    false = new_sources(negative, xy, flux, usable=searched)
    # independent trials: usable pixels over the area of the squared PSF
    width = peaks.full_width / gaussian_sigma_to_fwhm
    n_beams = np.count_nonzero(usable) / (4 * np.pi * width**2)
    n_false = np.count_nonzero(false) + n_beams * ndtr(-LEFT_SNR)
    rate = float(n_false / max(np.count_nonzero(new), 1))
    fitted = bool(new.any() and (second_pass or rate <= _FALSE_RATE))
    evidence = {
        "peaks": int(new.sum()),
        "threshold": LEFT_SNR,
        "false_rate": float(f"{rate:.2g}"),
        "fitted": fitted,
    }
    return new & fitted, evidence
