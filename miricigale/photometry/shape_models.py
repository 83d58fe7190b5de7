"""Profiles as an image of some PSF shows them."""

import numpy as np
import scipy.fft

from miricigale.photometry._core.sampling import box_response
from miricigale.photometry._core.shapes import shape_curves

#: Size of the transform over that of the stamp.
_PERIOD = 1.6

#: Part of a PSF's light below which frequencies are left out.
_PASSED = 1e-5


class ShapeModels:
    """Draws light through a PSF, odd and centered."""

    def __init__(self, psf):
        self._psf = np.asarray(psf, float)
        #: Half-width of the PSF (pixels).
        self.reach = self._psf.shape[0] / 2
        self._transforms, self._waves = {}, {}

    def _transform(self, size):
        if size not in self._transforms:
            padded = np.zeros((size, size))
            middle = self._psf.shape[0] // 2
            half = min(middle, size // 2 - 1)
            cut = self._psf[middle - half : middle + half + 1, middle - half : middle + half + 1]
            padded[: 2 * half + 1, : 2 * half + 1] = cut
            shifted = np.roll(padded, (-half, -half), axis=(0, 1))
            self._transforms[size] = scipy.fft.rfft2(shifted)
        return self._transforms[size]

    def profiles(self, shape, parameters, derivatives=0):
        """As `Waves.profiles` on a stamp."""
        return self.waves(shape).profiles(shape, parameters, derivatives)

    def waves(self, shape):
        """The `Waves` of a stamp."""
        period = _period(shape)
        if period not in self._waves:
            self._waves[period] = Waves(self._transform(period), period)
        return self._waves[period]

    def convolve(self, images, origin, shape):
        """
        Bring light, (n, h, w), that is integrated over pixels to the resolution of the image, (n, *shape).

        ``origin`` is the row and column of its corner on the stamp; what is far from the stamp does not count.
        """
        size = _period(shape)
        rims = [(size - n) // 2 for n in shape]
        padded = np.zeros((len(images), size, size), np.float32)
        to, of = [slice(None)], [slice(None)]
        for rim, begin, n in zip(rims, origin, images.shape[1:], strict=True):
            low, high = max(begin + rim, 0), min(begin + rim + n, size)
            to.append(slice(low, high))
            of.append(slice(low - begin - rim, high - begin - rim))
        padded[tuple(to)] = images[tuple(of)]
        # the samples of the PSF are integrated over pixels too
        response = self._transform(size) / box_response((size, size), np.eye(2))
        spectra = scipy.fft.rfft2(padded) * response.astype(np.complex64)
        found = scipy.fft.irfft2(spectra, s=(size, size), overwrite_x=True)
        return found[:, rims[0] : rims[0] + shape[0], rims[1] : rims[1] + shape[1]]


class Waves:
    """The frequencies that a PSF lets pass, on a square of ``period`` pixels."""

    def __init__(self, psf, period):
        self._period = period
        self._use = np.abs(psf) > _PASSED * np.abs(psf[0, 0])
        ky, kx = np.nonzero(self._use)
        self._psf = psf[self._use]
        #: Frequencies, rad per pixel, shape (m,), and what their squares count in the sum over all pixels.
        self.kx = 2 * np.pi * np.fft.rfftfreq(period)[kx]
        self.ky = 2 * np.pi * np.fft.fftfreq(period)[ky]
        twice = np.where((kx == 0) | (2 * kx == period), 1.0, 2.0)
        self.weight = twice * np.abs(self._psf) ** 2 / period**2

    def power(self, curve):
        """Sum of squares of the pixels of a transform."""
        return np.sum(self.weight * curve**2)

    def images(self, curves, xy, shape):
        """Pixels of transforms, (n, m), about a place of a stamp: (n, *shape), in their precision."""
        moved = self._psf * np.exp(-1j * (self.kx * xy[0] + self.ky * xy[1]))
        spectra = np.zeros((len(curves), *self._use.shape), np.result_type(curves, np.complex64))
        spectra[:, self._use] = curves * moved.astype(spectra.dtype)
        images = scipy.fft.irfft2(spectra, s=(self._period,) * 2, overwrite_x=True)
        return images[:, : shape[0], : shape[1]]

    def profiles(self, shape, parameters, derivatives=0):
        """
        A Sersic profile of unit light, and its derivatives.

        Parameters
        ----------
        shape : (int, int)
            Shape of the images, a corner of the square.
        parameters : `~numpy.ndarray`, shape (6,)
            Center x and y, and the shape as for `~miricigale.photometry._core.shapes.shape_curves`.
        derivatives : {0, 2, 6}, optional
            How many of the derivatives are wanted.

        Returns
        -------
        images : `~numpy.ndarray`, shape (1 + derivatives, *shape)
            The model and its derivatives to the first parameters, in single precision.
        """
        shapes = np.asarray(parameters, float)[None, 2:]
        curves = shape_curves(self.kx, self.ky, shapes, derivatives=derivatives == 6)
        light, *others = curves.reshape(-1, len(self.kx))
        if derivatives:
            curves = np.array([light, -1j * self.kx * light, -1j * self.ky * light, *others])
            return self.images(curves.astype(np.complex64), parameters, shape)
        return self.images(curves.astype(np.float32), parameters, shape)


def _period(shape):
    """Size of the transform: light that leaves the period on one side comes in on the other."""
    return scipy.fft.next_fast_len(int(_PERIOD * max(shape)), True)
