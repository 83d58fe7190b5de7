"""Exposures brought to one plane, for pictures and the search of sources that a catalog lacks."""

import numpy as np
import scipy.ndimage
from astropy.wcs.utils import pixel_to_pixel

from miricigale.utils.arrays import quotient
from miricigale.utils.values import value_class

#: Pixels between the nodes at which coordinates are calculated; bilinear between them, the distortion of the
#: imager leaves 1e-3 pixels.
_STEP = 16


@value_class
class Plane:
    """
    A grid of pixels on the sky that all exposures have in common, and where its pixels are on each of them.

    Each pixel takes the nearest one of each exposure: noise stays that of single pixels, and nearly
    independent; sources are blurred by less than a pixel. Nothing is measured on it.
    """

    wcs: object
    shape: tuple
    #: For each exposure the flat number of the nearest pixel, (ny, nx) each; -1 beyond the exposure.
    pixels: tuple

    @classmethod
    def over(cls, wcs, images):
        """
        Make a plane with coordinates (and ``pixel_shape``) over exposures.

        ``images`` are pairs of coordinates and shape, one for each exposure.
        """
        shape = wcs.pixel_shape[::-1]
        pixels = tuple(_nearest(wcs, shape, image_wcs, size) for image_wcs, size in images)
        return cls(wcs, shape, pixels)

    def mean(self, images, weights):
        """
        Average images of the exposures with weights.

        Parameters
        ----------
        images, weights : list of `~numpy.ndarray`
            One of each exposure, of its shape.

        Returns
        -------
        mean, weight : `~numpy.ndarray`, shape (ny, nx)
            The mean, zero where no exposure has weight, and the sum of the weights.
        """
        total = np.zeros(self.shape)
        weight = np.zeros(self.shape)
        for image, image_weight, pixels in zip(images, weights, self.pixels, strict=True):
            shown = pixels >= 0
            values = np.asarray(image_weight, float).ravel()[pixels[shown]]
            total[shown] += values * np.asarray(image, float).ravel()[pixels[shown]]
            weight[shown] += values
        return quotient(total, weight), weight


def _nearest(wcs, shape, image_wcs, size):
    """Return flat numbers of the pixels of an image that are nearest to those of a plane; -1 beyond the image."""
    ny, nx = shape
    y, x = np.meshgrid(
        np.arange(0, ny + _STEP, _STEP), np.arange(0, nx + _STEP, _STEP), indexing="ij"
    )
    positions = pixel_to_pixel(wcs, image_wcs, x.ravel(), y.ravel())
    rows, columns = np.indices(shape, np.float32)
    # bilinear between the nodes
    at = np.stack([rows, columns]) / _STEP
    pixel = []
    for values in positions:
        values = np.asarray(values, float).reshape(x.shape)
        pixel.append(scipy.ndimage.map_coordinates(values, at, order=1))
    column, row = np.nan_to_num(np.rint(pixel), nan=-1.0).astype(int)
    inside = (column >= 0) & (column < size[1]) & (row >= 0) & (row < size[0])
    return np.where(inside, row * size[1] + column, -1).astype(np.int32)
