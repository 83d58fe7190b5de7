"""Point sources fitted where there are none: a test of the errors of a measurement."""

import warnings

import numpy as np
import scipy.ndimage
from astropy.table import QTable

from miricigale.photometry.arrays import pixel_scale
from miricigale.photometry.forced import ForcedPhotometer
from miricigale.utils.exceptions import PhotometryWarning

#: Largest number of empty positions at which errors are tested.
_EMPTY = 400


def empty_pulls(result, kernel, seed):
    """Flux over error of points where a `ForcedPhotometryResult` has none; None without a PSF or such places."""
    empty = _empty_positions(result, seed)
    if kernel.target is None or not len(empty):
        return None
    blank = ForcedPhotometer(kernel, template="psf")
    with warnings.catch_warnings():
        # the warning about a background was given already
        warnings.simplefilter("ignore", PhotometryWarning)
        return blank.measure(result.residual_image, catalog=empty).snr


def _empty_positions(result, seed):
    """
    Random positions at which a measurement left no light: ``id`` and ``sky``.

    They are at least 0.3 arcsec from pixels with light of a model (above a third of the
    noise) or without data.
    """
    residual = result.residual_image
    sigma = residual.uncertainty.array
    level = 0.0 if result.background is None else result.background.to_value(residual.unit)
    free = ~np.asarray(residual.mask, bool)
    free &= np.abs(result.model_image.data - level) < 0.3 * np.where(free, sigma, 1.0)
    steps = max(1, round(0.3 / pixel_scale(residual.wcs)))
    # pixels beyond the image count as without data
    free = scipy.ndimage.binary_erosion(free, iterations=steps)
    y, x = np.nonzero(free)
    rng = np.random.default_rng(seed)
    chosen = rng.choice(len(x), min(_EMPTY, len(x)), replace=False) if len(x) else np.zeros(0, int)
    sky = residual.wcs.pixel_to_world(x[chosen].astype(float), y[chosen].astype(float)).icrs
    return QTable({"id": np.arange(1, len(chosen) + 1), "sky": sky})
