"""Light on the residual image that no template explains."""

import dataclasses

import numpy as np
import scipy.ndimage
import scipy.spatial

__all__ = ["ResidualPeaks", "residual_peaks", "unexplained_neighbours"]

#: Least signal-to-noise of light that no template explains, its least share of the model below it and
#: of a neighbour's flux, and its distance to sources in full widths at half maximum: the least to any,
#: and the largest to one that is flagged.
_LEFT_SNR, _LEFT_SHARE, _LEFT_DISTANCE, _LEFT_REACH = 5.0, 0.1, 0.7, 2.0


@dataclasses.dataclass(frozen=True, eq=False)
class ResidualPeaks:
    """
    Peaks of a residual image, the brightest first.

    Attributes
    ----------
    xy : `~numpy.ndarray`, shape (n, 2)
        Their pixels.
    refined : `~numpy.ndarray`, shape (n, 2)
        Tops of the parabolas through each pixel and its neighbours.
    flux : `~numpy.ndarray`, shape (n,)
        As point sources that stand alone, in the residual's unit.
    full_width : float
        Full width at half maximum of the PSF, in pixels.
    """

    xy: np.ndarray
    refined: np.ndarray
    flux: np.ndarray
    full_width: float


def residual_peaks(residual, model, inverse_sigma, width, xy):
    """
    Find positive peaks of the residual that are sources of their own.

    Parameters
    ----------
    residual, model : `~numpy.ndarray`, shape (ny, nx)
        What the fit left and what it took, light per pixel.
    inverse_sigma : `~numpy.ndarray`, shape (ny, nx)
        Inverse of the noise, zero for pixels that do not count.
    width : float
        Rms width of a Gaussian like the PSF, in pixels.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of all sources; NaN for those far outside.

    Returns
    -------
    peaks : `ResidualPeaks`

    Notes
    -----
    Peaks are those of the residual filtered with a Gaussian, above 5 sigma (measured on the filtered
    image itself), above a tenth of the model filtered likewise, and farther than 0.7 full widths at
    half maximum from all sources (nearer ones show in chi2). A peak whose mirror image through the
    nearest source, if that is within two full widths, has more than half as much light is that
    source's own. Of two peaks within 0.7 full widths the brighter one counts.
    """
    full_width = 2.0 * np.sqrt(2.0 * np.log(2.0)) * width
    placed = xy[np.isfinite(xy).all(axis=1)]
    weight = inverse_sigma**2
    if not weight.any():
        return ResidualPeaks(np.empty((0, 2), int), np.empty((0, 2)), np.empty(0), full_width)

    def smooth(image, sigma):
        return scipy.ndimage.gaussian_filter(image, sigma, mode="constant")

    # fluxes of point sources by least squares, as if each stood alone
    power = smooth(weight, width / np.sqrt(2)) / (4 * np.pi * width**2)
    usable = power > 0.25 * np.median(power[weight > 0])
    safe = np.where(usable, power, np.inf)
    light = smooth(residual * weight, width) / safe
    snr = light * np.sqrt(power)
    middle = np.median(snr[usable])
    # what is a thousandth of the stated noise is that of the arithmetic
    noise = max(1.4826 * np.median(np.abs(snr[usable] - middle)), 1e-3)
    taken = smooth(model * weight, width) / safe
    size = 2 * int(np.ceil(width)) + 1
    peak = usable & (snr > _LEFT_SNR * noise) & (light > _LEFT_SHARE * taken)
    peak &= snr == scipy.ndimage.maximum_filter(snr, size, mode="constant")
    y, x = np.nonzero(peak)
    order = np.argsort(-light[y, x], kind="stable")
    pixel = np.stack([x, y], axis=1)[order]
    distance = np.full(len(pixel), np.inf)
    if len(placed) and len(pixel):
        distance, nearest = scipy.spatial.KDTree(placed).query(pixel)
        # a template that is too narrow leaves as much on the other side of the source
        mirror = np.rint(2 * placed[nearest] - pixel).astype(int)
        inside = np.all((mirror >= 0) & (mirror < light.shape[::-1]), axis=1)
        j, i = np.where(inside[:, None], mirror, 0).T
        even = inside & (light[i, j] > 0.5 * light[tuple(pixel.T[::-1])])
        distance[even & (distance < _LEFT_REACH * full_width)] = 0.0
    pixel = pixel[distance >= _LEFT_DISTANCE * full_width]
    lone = np.ones(len(pixel), bool)
    if len(pixel):
        # brightest first: whoever is left takes away those that follow
        for one, other in sorted(
            scipy.spatial.KDTree(pixel).query_pairs(_LEFT_DISTANCE * full_width)
        ):
            lone[other] &= ~lone[one]
    kept = pixel[lone]
    flux = light[kept[:, 1], kept[:, 0]]
    return ResidualPeaks(kept, kept + _parabola(snr, kept), flux, full_width)


def _parabola(image, xy):
    """Offsets (x, y) of maxima from their pixels, at most half a pixel."""
    padded = np.pad(image, 1)
    x, y = xy.T + 1
    offsets = []
    for dx, dy in ((1, 0), (0, 1)):
        low, high = padded[y - dy, x - dx], padded[y + dy, x + dx]
        curvature = 2 * padded[y, x] - low - high
        step = 0.5 * (high - low) / np.where(curvature > 0, curvature, np.inf)
        offsets.append(np.clip(step, -0.5, 0.5))
    return np.stack(offsets, axis=1)


def unexplained_neighbours(peaks, xy, flux):
    """
    Find sources next to light that is not in the catalogue.

    Parameters
    ----------
    peaks : `ResidualPeaks`
        What the fit left.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of all sources.
    flux : `~numpy.ndarray`, shape (n,)
        Their fluxes; NaN where not measured.

    Returns
    -------
    found : bool `~numpy.ndarray`, shape (n,)
        Whether a peak is within two full widths at half maximum, and as a point source has more
        than a tenth of the flux.
    """
    found = np.zeros(len(xy), bool)
    placed = np.flatnonzero(np.isfinite(xy).all(axis=1))
    if len(placed) and len(peaks.xy):
        tree = scipy.spatial.KDTree(xy[placed])
        near = tree.query_ball_point(peaks.xy, _LEFT_REACH * peaks.full_width)
        for left, rows in zip(peaks.flux, near, strict=True):
            rows = placed[rows]
            found[rows] |= left > _LEFT_SHARE * flux[rows]
    return found
