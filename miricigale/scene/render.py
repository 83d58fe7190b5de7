"""Painting points, Sersic profiles and images through a PSF: one grid, one convolution."""

import math

import numpy as np
from photutils.psf import GriddedPSFModel, ImagePSF

from miricigale.profiles import sersic_enclosed_fraction, sersic_radius
from miricigale.profiles.sersic import light_table, parameter_rows
from miricigale.scene import _core
from miricigale.scene.convolve import Places, add_nodes, convolve, phases
from miricigale.scene.deposit import deposit_profiles, smooth_from
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.parallel import thread_count
from miricigale.utils.values import value_class

#: Sersic sources with a half-light radius below this many nodes are points.
_UNRESOLVED = 0.05

#: Points alone are added one by one where that takes fewer sums than so many for each node of
#: the grid; the Fourier transforms take about twice as long for a node.
_DIRECT = 8


@value_class
class Painter:
    """
    Paints sources on a pixel grid through a PSF.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the image.
    psf : `~photutils.psf.ImagePSF` or `~photutils.psf.GriddedPSFModel`
        PSF with the pixel response in it, oversampled alike in x and y, centered on one of
        its nodes. Its ``flux``, ``x_0`` and ``y_0`` are not looked at; light beyond its
        edge is lost. Of a grid of PSFs light has that of its own place, bilinear between those
        of the grid as in photutils and constant beyond it; an extended source is blurred by
        another PSF on its one side than on the other. All sources are painted and convolved
        once, whatever the number of PSFs.
    enclosed : float, optional
        A Sersic profile is painted to the isophote that holds this fraction.
    max_radius : float, optional
        Largest semi-major axis of that isophote in pixels.
    n_threads : int, optional
        Threads; as many as there are processors if not given. The image does not depend on it.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.psf import miri_psf
    >>> from miricigale.scene import Painter
    >>> painter = Painter((64, 64), miri_psf("F770W", fov=4 * u.arcsec))
    >>> places = {
    ...     "x": np.array([31.0]),
    ...     "y": np.array([31.0]),
    ...     "flux": np.array([100.0]),
    ... }
    >>> shapes = {
    ...     name: np.array([1.0]) for name in ("r_eff", "n", "axis_ratio", "theta")
    ... }
    >>> image, in_image, kept = painter.paint(
    ...     **places, is_sersic=np.array([False]), **shapes
    ... )
    >>> print(f"{image.sum():.1f} of 100")
    90.5 of 100
    """

    shape: tuple
    psf: "ImagePSF | GriddedPSFModel"
    enclosed: float = 0.995
    max_radius: float = math.inf
    n_threads: int | None = None

    def __post_init__(self):
        data = np.asarray(self.psf.data, dtype=float)
        positions = [(0.0, 0.0)]
        if isinstance(self.psf, GriddedPSFModel):
            origin = np.subtract(data.shape[:0:-1], 1) / 2
            positions = np.asarray(self.psf.grid_xypos, dtype=float)
        elif isinstance(self.psf, ImagePSF):
            data = data[np.newaxis]
            origin = self.psf.origin
        else:
            raise argument_error(
                "psf", "a photutils ImagePSF or GriddedPSFModel", type(self.psf).__name__
            )
        oversampling = np.broadcast_to(self.psf.oversampling, 2)
        if oversampling[0] != oversampling[1]:
            raise argument_error("psf", "oversampled alike in x and y", oversampling.tolist())
        origin = np.asarray(origin, dtype=float)
        if np.any(np.abs(origin - np.round(origin)) > 1e-6):
            raise argument_error(
                "psf", "centered on a node (odd shape)", f"origin {origin.tolist()}"
            )
        check_that(0 < self.enclosed < 1, "enclosed", "between 0 and 1", self.enclosed)
        check_that(self.max_radius > 0, "max_radius", "positive", self.max_radius)
        thread_count(self.n_threads)
        oversampling = int(oversampling[0])
        origin = tuple(round(float(v)) for v in origin)
        (x, k_x), (y, k_y) = (np.unique(v, return_inverse=True) for v in np.transpose(positions))
        order = np.zeros((y.size, x.size), dtype=np.int64)
        order[k_y, k_x] = np.arange(len(positions))
        tables = np.stack([phases(image, origin, oversampling) for image in data])
        self.__dict__.update(_oversampling=oversampling, _origin=origin, _data=data)
        self.__dict__.update(_phases=tables, _order=order, _places=(y, x))

    @property
    def margin(self):
        """Pixels beyond each edge that are painted, so that wings reach into the image."""
        return (self._phases.shape[-1] - 1) // 2

    @property
    def enclosed_by_psf(self):
        """Fraction of a point's light within the array of the PSF, the least of a grid."""
        return float(self._data.sum(axis=(1, 2)).min()) / self._oversampling**2

    def _axes(self):
        """Return the places of the PSFs along y and along x."""
        options = {"margin": self.margin, "oversampling": self._oversampling}
        pairs = zip(self._places, self.shape, strict=True)
        return tuple(Places(at, n_pixels=n, **options) for at, n in pairs)

    def _landing(self):
        """Tell which part of the light on each node lands on the image."""
        shape = self._phases.shape
        sums = np.zeros(shape[:3] + (shape[3] + 1, shape[4] + 1))
        sums[..., 1:, 1:] = self._phases.cumsum(axis=3).cumsum(axis=4)
        n_y, n_x = self.shape
        axis_y, axis_x = self._axes()
        y = self._ranges(n_y) + axis_y.weights()
        x = self._ranges(n_x) + axis_x.weights()
        return _core.Landing(sums, self._oversampling, self._order, *y, *x)

    def _ranges(self, n):
        """Return for each node along an axis the range of the phase tables that lies on the image."""
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
        drawn_share : `~numpy.ndarray`, shape (N,)
            Fraction of the profile within the isophote at which it was cut.
        """
        os_ = self._oversampling
        margin = self.margin
        land = self._landing()
        node_x = (np.asarray(x) + margin) * os_
        node_y = (np.asarray(y) + margin) * os_
        in_image = np.zeros(len(node_x))
        drawn_share = np.ones(len(node_x))
        extended = np.asarray(is_sersic) & (np.asarray(r_eff) * os_ >= _UNRESOLVED)
        points = ~extended
        points[list(images or {})] = False
        i, j, light, in_image[points] = _core.point_nodes(
            node_x[points], node_y[points], np.asarray(flux, float)[points], land
        )
        n_nodes = land.low_y.size * land.low_x.size
        n_taps = self._phases[0, 0, 0].size
        if points.all() and len(self._data) == 1 and i.size * n_taps < _DIRECT * n_nodes:
            image = np.zeros(self.shape)
            # in the grid's precision: the same sum
            add_nodes(image, i, j, light.astype(np.float32), self._phases[0], margin=margin)
            return image, in_image, drawn_share
        grid = np.zeros((land.low_y.size, land.low_x.size), dtype=np.float32)
        if np.any(extended):
            radius = r_eff[extended] * os_
            index = n[extended]
            ratio = axis_ratio[extended]
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
            w_zone = (zone / radius) ** 2
            w_cut = (cut / radius) ** 2
            w_smooth = smooth_from(rows, w_zone, w_cut)
            in_image[extended] = deposit_profiles(
                grid, rows, tables, w_zone, w_smooth, w_cut, land, n_threads=self.n_threads
            )
            drawn_share[extended] = sersic_enclosed_fraction(cut / radius, index)
        for row, (dx, dy, share) in (images or {}).items():
            place_x = node_x[row] + dx * os_
            place_y = node_y[row] + dy * os_
            in_image[row] = self._add_image(grid, place_x, place_y, flux[row] * share, land)
        _core.deposit_nodes(grid, i, j, light)
        options = {"margin": margin, "oversampling": os_, "n_threads": self.n_threads}
        axis_y, axis_x = self._axes()
        image = convolve(
            grid, self._data, self._order, axis_y, axis_x, origin=self._origin, **options
        )
        return image, in_image, drawn_share

    @staticmethod
    def _add_image(grid, x, y, light, land):
        """Put many pieces of one source on the grid; return how much lands on the image."""
        (x0, x1), (y0, y1) = (
            (max(0, math.floor(v.min()) - 2), min(n, math.floor(v.max()) + 4))
            for v, n in ((x, grid.shape[1]), (y, grid.shape[0]))
        )
        if x1 <= x0 or y1 <= y0:
            return 0.0
        # in double precision: single would lose the light of many pieces on a node
        part = np.zeros((y1 - y0, x1 - x0))
        _core.deposit_pieces(part, x - x0, y - y0, light)
        return _core.add_part(grid, part, y0, x0, land)
