"""Scatter of pixels that goes with the light: what the resampling of a mosaic does to bright sources."""

import numpy as np
from astropy.stats import gaussian_sigma_to_fwhm

from miricigale.photometry.fit.template_fit import row_snr
from miricigale.utils.units import ANGLE

#: Transfer of the PSF below which a spatial frequency has no light.
_DARK = 0.005
#: Half-width of the squares in FWHM of the PSF.
_HALF = 2.4
#: Least signal-to-noise of sources that are used, and how many of the brightest.
_BRIGHT = 20.0
_MOST_SOURCES = 200
#: Error with which a source alone must show the scatter, and the fewest such sources.
_LEAST = 0.02
_FEWEST = 3
#: Largest part of the light that is taken as the pixels' scatter: larger ones are wrong templates.
_LARGEST = 0.1
#: Squares of empty sky, fewest and most, and the largest light in them over the noise.
_FEWEST_SQUARES = 20
_MOST_SQUARES = 1000
_EMPTY = 1.0
#: Least part of the pixels of a square that is usable.
_USABLE = 0.9
_SIGNIFICANCE = 3.0


def pixel_scatter(fit, residual, model):
    """
    Measure by which part of the light pixels of bright sources scatter, finer than the telescope resolves.

    Parameters
    ----------
    fit : `~miricigale.photometry.fit.template_fit.TemplateFit`
        The fit.
    residual, model : `~numpy.ndarray`, shape (ny, nx)
        Its residual (zero where not usable) and its model, without background, in uJy per pixel.

    Returns
    -------
    scatter : float
        Standard deviation of a pixel over its light; 0 where it cannot be measured or is not significant.

    Notes
    -----
    A telescope passes no light above the cutoff of its PSF, and templates have no power there. The power of the
    residuals of bright sources, beyond that of empty sky, is due to the resampling and the detector. As pixels
    deviate independently of each other by the part e of their light m, the mean power of a residual over the noise
    sigma, under a window w, is larger by e^2 sum (w m / sigma)^2 at all frequencies. The median of the sources is
    taken, so that a single source with a wrong template does not matter. The scatter is not measured on
    undersampled images, which have light at all frequencies.

    A drizzled pixel is a mean of detector pixels whose centers differ from its center. Neighbors compensate the
    light that this adds to a pixel, so that errors of fluxes are unchanged (`Fruchter & Hook 2002
    <https://doi.org/10.1086/338393>`__, sec. 5).
    """
    if not len(fit.rows):
        return 0.0
    half = int(np.ceil(_HALF * gaussian_sigma_to_fwhm * fit.psf_width))
    squares = _Squares(fit, residual, model, half)
    cutoff = _cutoff(fit.settings.mean_kernel)
    if not cutoff < squares.nyquist:
        return 0.0
    is_fine = squares.frequency > cutoff
    empty = squares.empty_power(is_fine)
    if len(empty) < _FEWEST_SQUARES:
        return 0.0
    variances = []
    errors = []
    for x, y in _bright_places(fit, half):
        white, signal = squares.at(x - half, y - half)
        light = np.sum(signal**2)
        if white is None or not light > 0:
            continue
        error = np.std(empty) / light
        if error < _LEAST**2:
            variances.append((_power(white, is_fine) - np.mean(empty)) / light)
            errors.append(error)
    if len(variances) < _FEWEST:
        return 0.0
    variance = np.median(variances)
    # the median of n is less certain than their mean
    error = 1.2533 * np.sqrt(np.sum(np.square(errors))) / len(errors)
    if not _SIGNIFICANCE * error < variance < _LARGEST**2:
        return 0.0
    return float(np.sqrt(variance))


class _Squares:
    """Squares of an image under a Hann window, in units of the noise."""

    def __init__(self, fit, residual, model, half):
        self._residual = residual
        self._model = model
        self._inverse_sigma = fit.inverse_sigma
        self._size = 2 * half + 1
        window = np.hanning(self._size + 2)[1:-1]
        self._window = window[:, None] * window
        frequency = np.fft.fftfreq(self._size, fit.scale)
        #: Spatial frequencies in 1 / arcsec, and the largest along an axis.
        self.frequency = np.hypot(frequency[:, None], frequency)
        self.nyquist = 0.5 / fit.scale

    def at(self, x, y):
        """Return residual and light of the square with a corner; None where it is not on usable pixels."""
        size = self._size
        ny, nx = self._model.shape
        if min(x, y) < 0 or x + size > nx or y + size > ny:
            return None, 0.0
        part = slice(y, y + size), slice(x, x + size)
        weight = self._inverse_sigma[part]
        if np.count_nonzero(weight) < _USABLE * weight.size:
            return None, 0.0
        weight = self._window * weight
        return weight * self._residual[part], weight * self._model[part]

    def empty_power(self, is_fine):
        """Return mean powers of the residual at fine frequencies in squares without light."""
        ny, nx = self._model.shape
        corners_y = np.arange(0, ny - self._size + 1, self._size)
        corners_x = np.arange(0, nx - self._size + 1, self._size)
        corners = np.stack(np.meshgrid(corners_x, corners_y), axis=-1).reshape(-1, 2)
        step = max(1, len(corners) // _MOST_SQUARES)
        powers = []
        for x, y in corners[::step]:
            white, signal = self.at(x, y)
            if white is not None and np.max(np.abs(signal)) < _EMPTY:
                powers.append(_power(white, is_fine))
        return np.array(powers)


def _power(white, is_fine):
    """Return the mean power of a square at fine frequencies."""
    return np.mean(np.abs(np.fft.fft2(white)[is_fine]) ** 2)


def _cutoff(kernel):
    """Return the frequency (1 / arcsec) above which the wide PSF of a kernel passes no light."""
    transfer = np.abs(np.fft.fft2(kernel.target))
    ny, nx = transfer.shape
    scale = kernel.pixel_scale.to_value(ANGLE)
    frequency = np.hypot(np.fft.fftfreq(ny, scale)[:, None], np.fft.fftfreq(nx, scale))
    return np.max(frequency[transfer > _DARK * transfer[0, 0]])


def _bright_places(fit, half):
    """Return pixels (x, y) of the brightest sources, none within the square of a brighter one."""
    signal = row_snr(fit)
    brightest = np.argsort(-signal)[:_MOST_SOURCES]
    pixels = np.rint(fit.bank.xy[brightest[signal[brightest] >= _BRIGHT]]).astype(int)
    is_free = np.ones(len(pixels), bool)
    places = []
    for k, place in enumerate(pixels):
        if is_free[k]:
            places.append(place)
            distance = np.abs(pixels - place).max(axis=1)
            is_free &= distance > half
    return places
