"""The sources of a catalog on one image: where they are, and their templates there."""

import numpy as np

from miricigale.photometry.images.arrays import (
    fine_wcs,
    local_maps,
    pixel_scale,
    pixels_to_sky,
    sky_pixels,
    sky_to_pixels,
)
from miricigale.photometry.templates.templates import BankSources, FineTemplates, TemplateBank
from miricigale.psf import KernelField
from miricigale.utils.units import ANGLE
from miricigale.utils.values import value_class


@value_class
class Placement:
    """Where sources are on an image."""

    settings: object  # The kernel, and how templates are made.
    arrays: object  # The image.
    #: Arcsec per pixel, and pixels beyond the image from which sources reach in.
    scale: float
    margin: float
    xy: np.ndarray  # (n, 2): Positions in pixels; NaN for those far off.
    near_rows: np.ndarray  # (k,): Sources on or near the image.

    @classmethod
    def of(cls, settings, arrays, sky):
        """Place sources by their coordinates."""
        scale = pixel_scale(arrays.wcs)
        kernel = settings.mean_kernel
        margin = (kernel.target.shape[0] // 2 + 1) * kernel.pixel_scale.to_value(ANGLE) / scale
        xy = sky_pixels(sky, arrays.wcs, arrays.flux.shape, margin)
        return cls(settings, arrays, scale, margin, xy, np.flatnonzero(np.isfinite(xy[:, 0])))

    def grid(self, templates):
        """Return the grid (a WCS) on which templates are made."""
        if templates.wcs is not None:
            return templates.wcs
        scale = self.settings.mean_kernel.pixel_scale.to_value(ANGLE)
        return fine_wcs(self.arrays.wcs, self.arrays.flux.shape, scale)

    def bank(self, rows, templates, executor):
        """Make the `TemplateBank` of some of the sources, whose templates are given."""
        settings = self.settings
        wcs = self.arrays.wcs
        xy = self.xy[rows]
        shape = self.arrays.flux.shape
        grid = self.grid(templates)
        fine_xy = sky_to_pixels(templates.sky, grid)
        # points are where the high-resolution image shows them
        point = np.isfinite(templates.fitted["parameters"][:, 0]) & (templates.kind == "point")
        fine_xy[point] = templates.fitted["parameters"][point, :2]
        # maps from image to fine pixels about each source
        poly = local_maps(xy, np.full(len(xy), self.margin / 2), wcs, grid)
        sides = None
        if settings.integrate:
            middle = np.array([[(shape[1] - 1) / 2, (shape[0] - 1) / 2]])
            sides = local_maps(middle, [self.margin / 2], wcs, grid)[0, :, 1:3].T
        kernels = [settings.mean_kernel]
        weigh = None
        if isinstance(settings.kernel, KernelField):
            kernels = settings.kernel.kernels

            def weigh(xy):
                return settings.kernel.weights(pixels_to_sky(xy, wcs).icrs)

        arrays = np.stack([kernel.array for kernel in kernels])
        targets = np.stack([kernel.target for kernel in kernels])
        fine = FineTemplates(arrays, targets, sides)
        sources = BankSources(templates.drawn(grid, fine_xy), fine_xy, xy, poly)
        return TemplateBank(fine, sources, shape, settings.memory.max_bytes, weigh, executor)
