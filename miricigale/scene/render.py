"""Painting points, Sersic profiles and images through a PSF: one grid, one convolution."""

import dataclasses
import math
import os

import numpy as np
from photutils.psf import GriddedPSFModel, ImagePSF
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import spline_filter

from miricigale.profiles import sersic_enclosed_fraction, sersic_radius
from miricigale.profiles.sersic import light_table, parameter_rows
from miricigale.psf import grid_weights
from miricigale.scene import _core
from miricigale.utils.exceptions import argument_error

__all__ = ["FieldPainter", "Painter"]

#: Sersic sources with a half-light radius below this many nodes are points.
_UNRESOLVED = 0.05


@dataclasses.dataclass(frozen=True, eq=False)
class Painter:
    """
    Paints sources on a pixel grid through a PSF.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the image.
    psf : `~photutils.psf.ImagePSF`
        PSF with the pixel response in it, oversampled alike in x and y, centred on one of
        its nodes. Its ``flux``, ``x_0`` and ``y_0`` are not looked at; light beyond its
        edge is lost.
    enclosed : float, optional
        A Sersic profile is painted to the isophote that holds this fraction.
    max_radius : float, optional
        Largest semi-major axis of that isophote in pixels.
    workers : int, optional
        Threads of the Fourier transforms; all processors if not given. The image does
        not depend on it.
    """

    shape: tuple
    psf: ImagePSF
    enclosed: float = 0.995
    max_radius: float = math.inf
    workers: int | None = None

    def __post_init__(self):
        if not isinstance(self.psf, ImagePSF):
            raise argument_error("psf", "a photutils ImagePSF", type(self.psf).__name__)
        oversampling = np.broadcast_to(self.psf.oversampling, 2)
        if oversampling[0] != oversampling[1]:
            raise argument_error("psf", "oversampled alike in x and y", oversampling.tolist())
        origin = np.asarray(self.psf.origin, dtype=float)
        if np.any(np.abs(origin - np.round(origin)) > 1e-6):
            raise argument_error(
                "psf", "centred on a node (odd shape)", f"origin {origin.tolist()}"
            )
        if not 0 < self.enclosed < 1:
            raise argument_error("enclosed", "between 0 and 1", self.enclosed)
        if not self.max_radius > 0:
            raise argument_error("max_radius", "positive", self.max_radius)
        object.__setattr__(self, "_oversampling", int(oversampling[0]))
        object.__setattr__(self, "_phases", self._make_phases())

    def _make_phases(self):
        """Spline coefficients by sub-pixel phase, shape (os, os, 2 L + 1, 2 L + 1)."""
        os_ = self._oversampling
        data = np.asarray(self.psf.data, dtype=float)
        cx, cy = (round(float(v)) for v in self.psf.origin)
        # room for the splines to die out
        reach = max(cx, cy, data.shape[1] - 1 - cx, data.shape[0] - 1 - cy) + 8
        half = math.ceil((reach + os_) / os_)
        size = half * os_ + os_ - 1
        padded = np.zeros((2 * size + 1, 2 * size + 1))
        padded[size - cy : size - cy + data.shape[0], size - cx : size - cx + data.shape[1]] = data
        coefficients = spline_filter(padded, order=3, mode="mirror")
        phases = np.empty((os_, os_, 2 * half + 1, 2 * half + 1))
        steps = size + os_ * np.arange(-half, half + 1)
        for a in range(os_):
            for b in range(os_):
                phases[a, b] = coefficients[np.ix_(steps - a, steps - b)]
        return phases

    @property
    def margin(self):
        """Pixels beyond each edge that are painted, so that wings reach into the image."""
        return (self._phases.shape[-1] - 1) // 2

    @property
    def enclosed_by_psf(self):
        """Fraction of a point's light within the PSF's array."""
        return float(np.sum(self.psf.data)) / self._oversampling**2

    def _landing(self):
        """Cumulative sums of the coefficients, with a leading zero."""
        phases = self._phases
        sums = np.zeros((*phases.shape[:2], phases.shape[2] + 1, phases.shape[3] + 1))
        sums[:, :, 1:, 1:] = phases.cumsum(axis=2).cumsum(axis=3)
        return sums

    def _ranges(self, n):
        """For each node along an axis the range of the phase tables that lies on the image."""
        margin = half = self.margin
        k = np.arange((n + 2 * margin) * self._oversampling) // self._oversampling
        low = np.clip(margin - k, -half, half + 1) + half
        high = np.clip(margin + n - 1 - k, -half - 1, half) + half + 1
        return low, high

    def paint(self, *, x, y, flux, is_sersic, r_eff, n, axis_ratio, theta, images=None):
        """
        Paint the sources.

        Parameters
        ----------
        x, y : `~numpy.ndarray`, shape (N,)
            Positions in pixels.
        flux : `~numpy.ndarray`, shape (N,)
            Total light, finite.
        is_sersic : `~numpy.ndarray` of bool, shape (N,)
            Whether the row is a Sersic profile; a point otherwise.
        r_eff, n, axis_ratio, theta : `~numpy.ndarray`, shape (N,)
            As in `~miricigale.profiles.sersic_image`; not looked at for others.
        images : dict, optional
            For rows that are images: offsets ``dx``, ``dy`` in pixels and the share of the
            light of many small pieces, which add up to 1.

        Returns
        -------
        image : `~numpy.ndarray`, shape ``shape``
            Light in each pixel.
        in_image : `~numpy.ndarray`, shape (N,)
            Light of each source in the image; they add up to the image's sum.
        kept : `~numpy.ndarray`, shape (N,)
            Fraction of the profile within the isophote at which it was cut.
        """
        os_, margin = self._oversampling, self.margin
        ny, nx = self.shape
        grid = np.zeros(((ny + 2 * margin) * os_, (nx + 2 * margin) * os_), dtype=np.float32)
        low_y, high_y = self._ranges(ny)
        low_x, high_x = self._ranges(nx)
        ranges = (self._landing(), low_y, high_y, low_x, high_x, os_)
        node_x, node_y = (np.asarray(x) + margin) * os_, (np.asarray(y) + margin) * os_
        in_image, kept = np.zeros(len(node_x)), np.ones(len(node_x))
        extended = np.asarray(is_sersic) & (np.asarray(r_eff) * os_ >= _UNRESOLVED)
        if np.any(extended):
            radius, index, ratio = r_eff[extended] * os_, n[extended], axis_ratio[extended]
            rows = parameter_rows(
                x=node_x[extended],
                y=node_y[extended],
                total_flux=flux[extended],
                r_eff=radius,
                n=index,
                axis_ratio=ratio,
                theta=theta[extended],
            )
            tables = light_table(index)
            # the cusp, and profiles thinner than the nodes as a whole, in small cells
            zone = np.where(ratio * radius < 4, np.maximum(4 / ratio, 3 * radius), 4 / ratio)
            cut = np.minimum(radius * sersic_radius(self.enclosed, index), self.max_radius * os_)
            cut = np.maximum(cut, zone)
            w_zone, w_cut = (zone / radius) ** 2, (cut / radius) ** 2
            landed = _core.deposit_outskirts(grid, rows, tables, w_zone, w_cut, *ranges)
            landed += _core.deposit_cusps(grid, rows, tables, w_zone, *ranges)
            in_image[extended] = landed
            kept[extended] = sersic_enclosed_fraction(cut / radius, index)
        points = ~extended
        for row, (dx, dy, share) in (images or {}).items():
            points[row] = False
            in_image[row] = self._add_image(
                grid, node_x[row] + dx * os_, node_y[row] + dy * os_, flux[row] * share, ranges
            )
        in_image[points] = _core.deposit_points(
            grid, node_x[points], node_y[points], np.asarray(flux, float)[points], *ranges
        )
        return self._convolve(grid), in_image, kept

    @staticmethod
    def _add_image(grid, x, y, light, ranges):
        """Put many pieces of one source on the grid; return how much lands on the image."""
        (x0, x1), (y0, y1) = (
            (max(0, math.floor(v.min()) - 2), min(n, math.floor(v.max()) + 4))
            for v, n in ((x, grid.shape[1]), (y, grid.shape[0]))
        )
        if x1 <= x0 or y1 <= y0:
            return 0.0
        sums, low_y, high_y, low_x, high_x, os_ = ranges
        # the tables go by the node's phase: begin on a whole pixel
        x0, y0 = x0 - x0 % os_, y0 - y0 % os_
        # in double precision: single would lose the light of many pieces on a node
        part = np.zeros((y1 - y0, x1 - x0))
        cuts = (low_y[y0:y1], high_y[y0:y1], low_x[x0:x1], high_x[x0:x1])
        _core.deposit_pieces(part, x - x0, y - y0, light)
        grid[y0:y1, x0:x1] += part
        return _core.landed_light(part, sums, *cuts, os_)

    def _convolve(self, grid):
        """Convolve with the coefficients and keep one node for each pixel of the image."""
        os_, margin = self._oversampling, self.margin
        ny, nx = self.shape
        size = tuple(next_fast_len(n + 2 * margin, real=True) for n in (ny, nx))
        workers = self.workers or os.cpu_count() or 1
        taps = np.arange(-margin, margin + 1)
        total = 0.0
        for a in range(os_):
            for b in range(os_):
                part = grid[a::os_, b::os_].astype(float)
                if not part.any():
                    continue
                kernel = np.zeros(size)
                kernel[np.ix_(taps % size[0], taps % size[1])] = self._phases[a, b]
                total = total + rfft2(part, size, workers=workers) * rfft2(kernel, workers=workers)
        if np.isscalar(total):
            return np.zeros(self.shape)
        image = irfft2(total, size, workers=workers)
        return image[margin : margin + ny, margin : margin + nx].copy()


@dataclasses.dataclass(frozen=True, eq=False)
class FieldPainter:
    """
    Paints sources through a PSF that varies over the field.

    The PSF of a source is bilinear between those of the grid, as in photutils: each PSF of
    the grid paints the sources near to it with their weights. An extended source has the PSF
    of its centre.

    Parameters
    ----------
    shape, enclosed, max_radius, workers
        As of `Painter`.
    psf : `~photutils.psf.GriddedPSFModel`
        PSFs with the pixel response in them, at positions on the image.
    """

    shape: tuple
    psf: GriddedPSFModel
    enclosed: float = 0.995
    max_radius: float = math.inf
    workers: int | None = None

    def __post_init__(self):
        if not isinstance(self.psf, GriddedPSFModel):
            raise argument_error("psf", "a photutils GriddedPSFModel", type(self.psf).__name__)

    def _painter(self, k):
        psf = ImagePSF(self.psf.data[k], oversampling=self.psf.oversampling)
        return Painter(
            self.shape,
            psf,
            enclosed=self.enclosed,
            max_radius=self.max_radius,
            workers=self.workers,
        )

    @property
    def enclosed_by_psf(self):
        """Least fraction of a point's light within the array of a PSF."""
        sums = np.asarray(self.psf.data).sum(axis=(1, 2))
        return float(sums.min() / np.prod(self.psf.oversampling))

    def paint(self, *, x, y, flux, images=None, **profile):
        """
        Paint the sources; see `Painter.paint`.

        Returns
        -------
        image, in_image, kept : `~numpy.ndarray`
        """
        weights = grid_weights(self.psf, x, y)
        total, in_image, kept = np.zeros(self.shape), np.zeros(len(x)), np.ones(len(x))
        for k in range(weights.shape[1]):
            use = weights[:, k] > 0
            if not np.any(use):
                continue
            row = np.cumsum(use) - 1
            mine = {row[i]: value for i, value in (images or {}).items() if use[i]}
            part, landed, kept[use] = self._painter(k).paint(
                x=x[use],
                y=y[use],
                flux=(flux * weights[:, k])[use],
                images=mine,
                **{name: value[use] for name, value in profile.items()},
            )
            total += part
            in_image[use] += landed
        return total, in_image, kept
