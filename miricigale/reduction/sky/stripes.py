"""Stripes of rows and columns, which the drift of the dark current leaves in single exposures."""

import numpy as np

from miricigale.reduction.images.images import plain_mask, with_data
from miricigale.reduction.mosaic.outliers import nan_median
from miricigale.reduction.sky.background import estimate_background

#: Pixels of a row or column that must be free of sources for its level to be measured.
_LEAST = 50

#: Standard deviations beyond which a pixel does not count.
_CLIP = 3.0


def remove_stripes(image):
    """
    Subtract the stripes of rows and columns from one exposure.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        One exposure in the pixels of the detector, with uncertainty, and with its background or without.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        On the same level. ``meta["stripes"]`` is the standard deviation of what was subtracted, and
        ``meta["stripes_unknown"]`` the number of rows and columns that were left as they are, since sources
        cover too much of them.

    Notes
    -----
    Sources are masked and a smooth background is taken off first; then the median of each column, and of each
    row of what is left, is its stripe, without the median of all. Sources are searched for twice, the second
    time without the first stripes. The error of a stripe is 1.25 sigma of a pixel over the root of the
    number of its pixels, 0.05 sigma in full frames.

    References
    ----------
    Issue 8517 of jwst: vertical stripes of MIRI are variations of the dark current in time, the same in all
    groups, and no 1/f noise.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale import Detector, Exposure, Reducer
    >>> from miricigale.reduction import remove_stripes
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB128", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> reducer = Reducer()
    >>> image = reducer.calibrate(
    ...     reducer.fit_ramp(Detector.miri_imager().collect(sky, exposure, seed=1))
    ... )
    >>> image.data[:, ::2] += 10.0  # MJy/sr
    >>> print(f"{remove_stripes(image).meta['stripes']:.0f} MJy/sr")
    5 MJy/sr
    """
    mask = plain_mask(image)
    pattern = np.zeros(image.shape, np.float32)
    # stripes look like sources until most of them are gone
    for method in ("sep", "masked", "masked"):
        flat = with_data(image, image.data - pattern)
        background = estimate_background(flat, method=method, warn=False)
        low = np.abs(flat.data - background.level) < _CLIP * background.rms
        sky = low & ~(mask | background.source_mask)
        residual = np.where(sky, image.data - background.level, np.nan)
        unknown = 0
        pattern[:] = 0
        for lines, part in ((residual, pattern), (residual.T, pattern.T)):
            # NaN - pattern stays NaN: what is masked never counts
            level, count = nan_median((lines - part).astype(np.float32))
            measured = (count >= _LEAST) & np.isfinite(level)
            part += np.where(
                measured, level - np.median(level[measured]) if measured.any() else 0, 0
            )
            unknown += int(
                np.count_nonzero(~measured & ~mask.all(axis=0 if part is pattern else 1))
            )
    return with_data(
        image, image.data - pattern, stripes=float(np.std(pattern[~mask])), stripes_unknown=unknown
    )
