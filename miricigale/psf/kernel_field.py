"""Matching kernels that change over the field."""

import functools
from operator import attrgetter
from typing import ClassVar

import numpy as np
from astropy.coordinates import SkyCoord, SkyOffsetFrame
from scipy.spatial import Delaunay, KDTree, QhullError

from miricigale.psf.field import psf_at
from miricigale.psf.kernels import MatchingKernel
from miricigale.psf.model import PSFGrid
from miricigale.utils.exceptions import argument_error
from miricigale.utils.file_formats import read_write
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.positions import plain_positions
from miricigale.utils.values import value_class


@value_class
class KernelField:
    """
    Matching kernels of several places of a field.

    `~miricigale.photometry.ForcedPhotometer` takes it for its kernel: each source then has
    the kernel of its own place.

    Parameters
    ----------
    kernels : sequence of `MatchingKernel`
        Alike in pixel and shape, each with its PSFs.
    sky : `~astropy.coordinates.SkyCoord`, shape (k,)
        Where they hold: for kernels of regions the middle of each.
    method : {"linear", "nearest"}, optional
        Between these places, ``"linear"`` blends the three kernels about a position (Delaunay
        triangles; beyond all triangles, the two of the nearest side), ``"nearest"`` takes the kernel
        of the nearest place.

    Raises
    ------
    ValueError, TypeError
        If there is no kernel, they differ in form or lack their PSFs, numbers differ, or two hold at
        one place.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from miricigale.psf import KernelField, MatchingKernel, gaussian_psf
    >>> kind = {"pixel_scale": 0.06 * u.arcsec, "fov": 4 * u.arcsec}
    >>> sharp = gaussian_psf(0.2 * u.arcsec, **kind)
    >>> kernels = [
    ...     MatchingKernel.from_psfs(sharp, gaussian_psf(w * u.arcsec, **kind), pixel_scale=0.06 * u.arcsec)
    ...     for w in (0.5, 0.6)
    ... ]
    >>> field = KernelField(kernels, SkyCoord([53.10, 53.14], [-27.8, -27.8], unit="deg"))
    >>> field.weights(SkyCoord([53.11, 53.15], [-27.8, -27.8], unit="deg")).round(3)
    array([[0.75, 0.25],
           [0.  , 1.  ]])
    """

    io_module: ClassVar[str] = "miricigale.psf.kernel_io"
    read, write = read_write("kernels and their places")

    kernels: tuple
    sky: SkyCoord
    method: str = "linear"

    def __post_init__(self):
        kernels = self.__dict__["kernels"] = tuple(self.kernels)
        if not kernels or not all(isinstance(kernel, MatchingKernel) for kernel in kernels):
            raise argument_error("kernels", "MatchingKernels, at least one", self.kernels)
        if any(kernel.source is None or kernel.target is None for kernel in kernels):
            raise argument_error("kernels", "with their source and target", "one without")
        if not isinstance(self.sky, SkyCoord) or self.sky.shape != (len(kernels),):
            raise argument_error(
                "sky", f"a SkyCoord of shape ({len(kernels)},), a place for each kernel", self.sky
            )
        place = plain_positions(self.sky).spherical
        bad = int(np.count_nonzero(~(np.isfinite(place.lon) & np.isfinite(place.lat))))
        check_that(not bad, "sky", "finite", f"{bad} positions that are masked or NaN")
        check_choice(self.method, "method", ("linear", "nearest"))
        # which refuses what is not alike
        object.__setattr__(self, "_mean", MatchingKernel.blend(kernels))
        distance = self._tree.query(self._unit(self.sky), k=min(2, len(kernels)))[0]
        if len(kernels) > 1 and distance[:, 1].min() < 1e-9:
            raise argument_error("sky", "different places", "two that are the same")

    @classmethod
    def from_psfs(cls, hi, lo, *, wcs, method="linear", **options):
        """
        Make kernels to a PSF that changes over the field.

        Parameters
        ----------
        hi : `~photutils.psf.ImagePSF` or `~numpy.ndarray`
            The sharp PSF.
        lo : `~miricigale.psf.PSFGrid`
            The wide PSF on a grid of places, as `psf_grid` and `miri_psf_grid` make it.
        wcs : `~astropy.wcs.WCS`
            Coordinates of the image in whose pixels the places of ``lo`` are.
        method : {"linear", "nearest"}, optional
            As for the class.
        **options
            Those of `MatchingKernel.from_psfs`, ``pixel_scale`` among them.

        Returns
        -------
        field : `KernelField`
            A kernel for each place of the grid.

        Raises
        ------
        TypeError
            If ``lo`` is no gridded model.
        ValueError
            As `MatchingKernel.from_psfs` and `psf_at`.
        """
        if not isinstance(lo, PSFGrid):
            msg = f"'lo' must be a PSFGrid (see miricigale.psf.psf_grid), got {type(lo).__name__}"
            raise TypeError(msg)
        places = np.asarray(lo.grid_xypos, float)
        kernels = [MatchingKernel.from_psfs(hi, psf_at(lo, x, y), **options) for x, y in places]
        return cls(kernels, wcs.pixel_to_world(*places.T).icrs, method)

    def __len__(self):
        return len(self.kernels)

    def __repr__(self):
        return f"<KernelField {len(self)} kernels, {self.method}, {self.mean!r}>"

    mean = property(attrgetter("_mean"), doc="The mean `MatchingKernel`.")

    @property
    def pixel_scale(self):
        """Pixel of the images that the kernels are for."""
        return self.kernels[0].pixel_scale

    def weights(self, sky):
        """
        Return what each kernel counts at positions.

        Parameters
        ----------
        sky : `~astropy.coordinates.SkyCoord`, shape (n,)
            The positions.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n, k)
            Not negative; each row has the sum 1, or is NaN where the position is masked or NaN.
        """
        sky = plain_positions(sky)
        weights = np.zeros((len(sky), len(self)))
        rows = np.arange(len(sky))
        if self.method == "nearest" or len(self) == 1:
            unit = self._unit(sky)
            placed = np.isfinite(unit).all(axis=1)
            weights[~placed] = np.nan
            if placed.any():
                weights[rows[placed], self._tree.query(unit[placed])[1]] = 1.0
            return weights
        at = self._plane(sky)
        inside = np.zeros(len(sky), bool)
        if self._triangles is not None and len(sky):
            triangle = self._triangles.find_simplex(at)
            inside = triangle >= 0
            transform = self._triangles.transform[triangle[inside]]
            two = np.einsum("nij,nj->ni", transform[:, :2], at[inside] - transform[:, 2])
            three = np.concatenate([two, 1 - two.sum(axis=1, keepdims=True)], axis=1)
            weights[rows[inside, None], self._triangles.simplices[triangle[inside]]] = three
        if not inside.all():
            # the nearest point of the rim
            first, last = (self._plane(self.sky)[ends] for ends in self._sides.T)
            step = last - first
            far = at[~inside, None]
            part = np.sum((far - first) * step, axis=2) / np.sum(step**2, axis=1)
            part = np.clip(part, 0.0, 1.0)
            distance = np.linalg.norm(far - first - part[..., None] * step, axis=2)
            side = np.argmin(distance, axis=1)
            part = part[np.arange(len(side)), side]
            weights[rows[~inside], self._sides[side, 0]] = 1 - part
            weights[rows[~inside], self._sides[side, 1]] = part
        # barycentric coordinates on a rim are negative by rounding
        weights = np.maximum(weights, 0.0)
        return weights / weights.sum(axis=1, keepdims=True)

    def at(self, sky):
        """Return the `MatchingKernel` at one position."""
        weights = self.weights(sky.reshape(1))[0]
        nodes = np.flatnonzero(weights)
        return MatchingKernel.blend([self.kernels[k] for k in nodes], weights[nodes])

    def _plane(self, sky):
        """Return the positions in the tangent plane about the first place, shape (n, 2)."""
        local = sky.transform_to(SkyOffsetFrame(origin=self.sky[0].icrs))
        x, y, z = local.cartesian.xyz.value
        # nothing of a field is on the other side of the sky; what is goes to its rim
        return np.stack([y, z], axis=-1) / np.maximum(x, 1e-3)[:, None]

    @staticmethod
    def _unit(sky):
        return sky.icrs.cartesian.xyz.value.T

    @functools.cached_property
    def _tree(self):
        return KDTree(self._unit(self.sky))

    @functools.cached_property
    def _triangles(self):
        """Triangles of the places, None for places on a line."""
        at = self._plane(self.sky)
        spread = np.linalg.svd(at - at.mean(axis=0), compute_uv=False)
        if len(at) < 3 or spread[-1] < 1e-3 * spread[0]:
            return None
        try:
            return Delaunay(at)
        except QhullError:
            return None

    @functools.cached_property
    def _sides(self):
        """Pairs of places that are sides of the rim, or neighbors on a line."""
        if self._triangles is not None:
            return self._triangles.convex_hull
        at = self._plane(self.sky)
        along = np.linalg.svd(at - at.mean(axis=0))[2][0]
        order = np.argsort(at @ along)
        return np.stack([order[:-1], order[1:]], axis=1)
