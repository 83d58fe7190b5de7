"""Smooth background of an image, with the sources masked."""

import dataclasses

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, label

from miricigale.instrument import DQ
from miricigale.reduction.images import flag_pixels, plain_mask, sigma, with_data
from miricigale.utils import sep_tools
from miricigale.utils.exceptions import argument_error
from miricigale.utils.parallel import chunks

__all__ = ["Background", "estimate_background", "subtract_background"]

# detection of what is masked: standard deviations of the smoothing in pixels (cores, and
# the wings of bright sources), and the least number of connected pixels
_WIDTHS = (0.85, 2.5)
_MIN_AREA = 5


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Background:
    """
    Smooth background of an image.

    Parameters
    ----------
    level, rms : `~numpy.ndarray` of float32, shape (ny, nx)
        Background, and the noise of a pixel about it, in the unit of the image.
    source_mask : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels that were taken for sources.
    box, filter_size : int
        Size of the boxes in pixels, and of the median filter in boxes.
    """

    level: np.ndarray
    rms: np.ndarray
    source_mask: np.ndarray
    box: int
    filter_size: int

    def __repr__(self):
        return (
            f"<Background median {np.median(self.level):.4g}, rms {np.median(self.rms):.4g}, "
            f"{100 * self.source_mask.mean():.1f} % masked as sources>"
        )


def estimate_background(
    image, *, box=32, filter_size=3, plane=True, threshold=3.0, grow=3, iterations=3
):
    """
    Estimate the background of an image, masking what stands above it.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Any unit.
    box, filter_size : int, optional
        Size of the boxes in pixels, and of the median filter in boxes.
    plane : bool, optional
        Whether a plane is taken off before the mesh of boxes.
    threshold : float, optional
        Sources are at least five connected pixels that rise by this many sigma above the
        background after a Gaussian smoothing, once of 0.85 pixels and once, for the wings
        of bright sources, of 2.5; sigma is that of the smoothed image, as measured.
    grow : int, optional
        The mask is dilated by this many pixels.
    iterations : int, optional
        How often sources are detected and masked.

    Returns
    -------
    background : `Background`

    Raises
    ------
    ValueError
        If an option is out of range or every pixel is masked.

    Notes
    -----
    A plane, fitted to the medians of the boxes, is taken off first and given back. A box of which
    a mask or the edge leaves a part stands for its center all the same, and is off by what a
    gradient changes from there to the part; with ``plane=False`` (the mesh alone, as in Yang et al.
    2021) that stays.

    Boxes that sources fill are filled from their neighbors. What is fainter than the
    threshold stays in the background: its mean is the mean of the unmasked pixels,
    clipped as Source Extractor does it (mode estimate).
    """
    for name, value, least in (
        ("box", box, 4),
        ("filter_size", filter_size, 1),
        ("grow", grow, 0),
        ("iterations", iterations, 0),
    ):
        if value < least:
            raise argument_error(name, f"at least {least}", value)
    if not threshold > 0:
        raise argument_error("threshold", "positive", threshold)
    mask = plain_mask(image)
    data = sep_tools.native(image.data)
    data = np.where(mask, 0, data if data.dtype.kind == "f" else data.astype(float))
    sources = np.zeros(data.shape, bool)
    for step in range(iterations + 1):
        tilted = _plane(data, mask | sources, box) if plane else np.zeros_like(data)
        level, rms = sep_tools.background(data - tilted, mask | sources, box, filter_size)
        level += tilted
        if step == iterations:
            break
        found = _detect(data - level, rms, mask, sources, threshold)
        if grow:
            found = binary_dilation(found, iterations=grow)
        if np.array_equal(found, sources):
            break
        # never mask everything: where nothing would be left the last mask stays
        if (found | mask).all():
            break
        sources = found
    return Background(
        level.astype(np.float32, copy=False),
        rms.astype(np.float32, copy=False),
        sources,
        int(box),
        int(filter_size),
    )


def _plane(data, mask, box):
    """Plane through the medians of boxes, clipped."""
    ny, nx = data.shape
    points = []
    columns = np.arange(0, nx, box)
    x = 0.5 * (columns + np.minimum(columns + box, nx) - 1)
    for rows in chunks(ny, box):
        median, share = _box_medians(data[rows], mask[rows], box)
        # boxes that are mostly masked say little
        used = share >= 0.3
        y = np.full(x.size, 0.5 * (rows.start + rows.stop - 1))
        points.append(np.stack([np.ones(x.size), x / nx, y / ny, median], axis=1)[used])
    points = np.concatenate(points)
    if len(points) < 6:
        return np.zeros_like(data)
    keep = np.ones(len(points), bool)
    for _ in range(5):
        coef, *_ = np.linalg.lstsq(points[keep, :3], points[keep, 3], rcond=None)
        residual = points[:, 3] - points[:, :3] @ coef
        spread = float(_spread(residual[keep]))
        new = np.abs(residual) <= 3 * spread
        if new.sum() < 6 or np.array_equal(new, keep):
            break
        keep = new
    y, x = np.ogrid[:ny, :nx]
    return (coef[0] + coef[1] * (x / nx) + coef[2] * (y / ny)).astype(data.dtype)


def _box_medians(data, mask, box):
    """Median of the unmasked pixels of the boxes side by side in some rows, and their share."""
    height, nx = data.shape
    n = -(-nx // box)
    # infinity sorts behind the pixels that count
    values = np.full((height, n * box), np.inf, data.dtype)
    values[:, :nx] = np.where(mask, np.inf, data)
    values = np.sort(values.reshape(height, n, box).swapaxes(0, 1).reshape(n, -1), axis=1)
    count = np.isfinite(values).sum(axis=1)
    middle = np.stack([np.maximum(count - 1, 0) // 2, count // 2], axis=1)
    median = np.take_along_axis(values, np.minimum(middle, values.shape[1] - 1), axis=1)
    size = np.full(n, height * box)
    size[-1] = height * (nx - (n - 1) * box)
    return median.mean(axis=1), count / size


def _median(values):
    """Median of finite values; they are put in another order."""
    half = values.size // 2
    values.partition(half)
    if values.size % 2:
        return values[half]
    return np.mean([values[:half].max(), values[half]], dtype=values.dtype)


def _spread(values):
    """As `astropy.stats.mad_std`, in place: a fifth of the time of a background less."""
    values -= _median(values)
    return 1.4826 * _median(np.abs(values, out=values))


def _detect(residual, rms, mask, sources, threshold):
    """Pixels that rise above the noise of the image, smoothed little and much."""
    good = ~mask & (rms > 0)
    sky = good & ~sources
    if not sky.any():
        return np.zeros(mask.shape, bool)
    scaled = np.zeros(mask.shape, np.float32)
    np.divide(residual, rms, out=scaled, where=good, casting="same_kind")
    found = np.zeros(mask.shape, bool)
    for width in _WIDTHS:
        smooth = gaussian_filter(scaled, width, mode="nearest")
        # correlated noise is smoothed less: its width is measured
        noise = _spread(smooth[sky])
        high = good & (smooth > threshold * noise)
        labels, n = label(high, np.ones((3, 3), bool))
        # the sky, label 0, is most of the image: only what is high is looked at
        labels = labels[high]
        large = np.bincount(labels, minlength=n + 1) >= _MIN_AREA
        found[high] |= large[labels]
    return found


def subtract_background(image, *, negative_threshold=10.0, **options):
    """
    Subtract the background and mask what lies far below it.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        Any unit.
    negative_threshold : float or None, optional
        Pixels below the background by more than this many sigma are masked with
        `DQ.NEGATIVE`; None for none.
    **options
        Passed to `estimate_background`.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Without background; ``meta["background"]`` is the median that was taken off.
    background : `Background`
    """
    background = estimate_background(image, **options)
    out = with_data(
        image,
        np.asarray(image.data, np.float32) - background.level,
        background=float(np.median(background.level[~plain_mask(image)])),
    )
    if negative_threshold is not None:
        if not negative_threshold > 0:
            raise argument_error("negative_threshold", "positive or None", negative_threshold)
        noise = np.fmax(background.rms, sigma(image))
        low = ~plain_mask(out) & (out.data < -negative_threshold * noise)
        out = flag_pixels(out, low, DQ.NEGATIVE | DQ.DO_NOT_USE)
    return out, background
