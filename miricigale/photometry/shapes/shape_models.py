"""Profiles as an image of some PSF shows them."""

import functools

import numpy as np
import scipy.fft

from miricigale.photometry._core.profile_images import draw_curves, make_plan
from miricigale.photometry._core.sampling import box_response
from miricigale.photometry._core.shapes import fill_curves, profile_of, profile_table
from miricigale.utils.missing_values import floats

#: Size of the transform over that of the stamp.
_PERIOD = 1.6

#: Number of transforms of the PSF that are kept.
_MAX_TRANSFORMS = 16

#: Part of a PSF's light below which frequencies are left out.
_PASSED = 1e-3


class ShapeModels:
    """Draws light through a PSF, odd and centered."""

    def __init__(self, psf):
        self._psf = floats(psf)
        #: Half-width of the PSF (pixels).
        self.reach = self._psf.shape[0] / 2
        # a few are kept: those of all sizes of stamps are larger than the plans
        self._transform = functools.lru_cache(maxsize=_MAX_TRANSFORMS)(
            functools.partial(_transform, self._psf)
        )
        self._plans = {}
        self._responses = {}

    def _response(self, size):
        """Return the transform for light integrated over pixels; samples of the PSF are integrated already."""
        if size not in self._responses:
            response = self._transform(size) / box_response((size, size), np.eye(2))
            self._responses[size] = response.astype(np.complex64)
        return self._responses[size]

    def plan(self, size):
        """Return the `~miricigale.photometry._core.profile_images.Plan` of squares of an odd size (pixels)."""
        if size not in self._plans:
            self._plans[size] = make_plan(size, self._transform(_period((size,))), _PASSED)
        return self._plans[size]

    def profiles(self, shape, parameters, derivatives=0):
        """
        Draw a Sersic profile of unit light, and its derivatives.

        Parameters
        ----------
        shape : (int, int)
            Shape of the images.
        parameters : `~numpy.ndarray`, shape (6,)
            Center x and y, and the shape as for `~miricigale.photometry._core.shapes.shape_curves`.
        derivatives : {0, 6}, optional
            How many of the derivatives are wanted.

        Returns
        -------
        images : `~numpy.ndarray`, shape (1 + derivatives, *shape)
            The model and its derivatives to the first parameters, in single precision.
        """
        # squares have a middle pixel
        plan = self.plan(max(shape) | 1)
        parameters = np.asarray(parameters, float)
        x, y = parameters[:2]
        # derivatives to the four parameters of the shape are curves, those to the place are not
        n_curves = 5 if derivatives else 1
        n_moved = 2 if derivatives else 0
        curves = np.empty((n_curves, len(plan.kx)), np.float32)
        profile = profile_of(profile_table(), parameters[3])
        fill_curves(plan.kx, plan.ky, parameters[2:], profile, curves)
        images = draw_curves(plan, curves, x, y, n_moved)
        return np.ascontiguousarray(images[:, : shape[0], : shape[1]])

    def convolve(self, images, origin, shape):
        """
        Bring light, (n, h, w), that is integrated over pixels to the resolution of the image, (n, *shape).

        ``origin`` is the row and column of its corner on the stamp; what is far from the stamp does not count.
        """
        size = _period(shape)
        rims = [(size - n) // 2 for n in shape]
        padded = np.zeros((len(images), size, size), np.float32)
        to = [slice(None)]
        of = [slice(None)]
        for rim, begin, n in zip(rims, origin, images.shape[1:], strict=True):
            low = max(begin + rim, 0)
            high = min(begin + rim + n, size)
            to.append(slice(low, high))
            of.append(slice(low - begin - rim, high - begin - rim))
        padded[tuple(to)] = images[tuple(of)]
        spectra = scipy.fft.rfft2(padded) * self._response(size)
        convolved = scipy.fft.irfft2(spectra, s=(size, size), overwrite_x=True)
        return convolved[:, rims[0] : rims[0] + shape[0], rims[1] : rims[1] + shape[1]]


def _transform(psf, size):
    """Return the transform, `scipy.fft.rfft2`, of a PSF about the first pixel of a square."""
    padded = np.zeros((size, size))
    middle = psf.shape[0] // 2
    half = min(middle, size // 2 - 1)
    cut = psf[middle - half : middle + half + 1, middle - half : middle + half + 1]
    padded[: 2 * half + 1, : 2 * half + 1] = cut
    # the center on the first pixel
    shifted = np.roll(padded, (-half, -half), axis=(0, 1))
    return scipy.fft.rfft2(shifted)


def _period(shape):
    """Return the size of the transform: light that leaves the period on one side comes in on the other."""
    return scipy.fft.next_fast_len(int(_PERIOD * max(shape)), True)
