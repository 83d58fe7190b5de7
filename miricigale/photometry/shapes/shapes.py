"""Which shape the light of a source has: fits of a point and of a Sersic profile, and their evidence."""

import contextlib
import dataclasses
import functools

import numpy as np
import scipy.linalg
from astropy.nddata import NoOverlapError, overlap_slices

from miricigale.photometry._core.profile_images import Plan
from miricigale.photometry._core.shape_fits import minimum, parameter_limits
from miricigale.photometry._core.shapes import profile_table
from miricigale.photometry._core.source_fits import (
    GAIN,
    LEAST_HALF,
    cut_out,
    fit_source,
    half_width,
)
from miricigale.photometry.detection.cutouts import Cutout
from miricigale.photometry.shapes.population import Population
from miricigale.photometry.shapes.shape_models import ShapeModels
from miricigale.profiles import sersic_stamp
from miricigale.utils.caching import cached
from miricigale.utils.values import value_class

#: Width (pixels) of the offset of the center from the position.
_OFFSET = 0.7

#: The same as the inverse of a covariance.
_CENTER = np.diag([_OFFSET**-2] * 2)

#: Nodes that a shape's probability is summed over.
_NODES = 32

#: What is kept of the profile fitted to a source: its parameters with x and y on the whole image, the
#: covariance of ln flux and parameters, the probability of a point, and the profile's part of the
#: light of the template. Of a piece of a galaxy that is divided into several segments, a number of that galaxy
#: and the piece's share of its light (0 and 1 of all others). NaN where nothing is known.
FITTED = np.dtype(
    [
        ("parameters", float, (6,)),
        ("covariance", float, (7, 7)),
        ("point", float),
        ("light", float),
        ("galaxy", float),
        ("share", float),
    ]
)

#: Largest number of steps of a fit, and of one of several sources: each of them is fitted again alone.
_STEPS = 25
_JOINT_STEPS = 4

#: Changes of the expected parameters that the search begins with: ln radius over the expected one.
_STARTS = np.zeros((3, 6))
_STARTS[:, 2] = -0.9, 0.0, 0.9


@value_class
class Shape:
    """A profile that was fitted."""

    flux: float  # Total light.
    parameters: (
        np.ndarray
    )  # (6,): As for `~miricigale.photometry.shapes.shape_models.ShapeModels.profiles`.
    point: float  # Probability that the source is a point.
    covariance: np.ndarray  # (7, 7): Of ln flux and the parameters.
    #: Nodes, (k, 6), and ln of the likelihood of a point, as `Population.odds` takes them.
    nodes: np.ndarray | None = None
    as_point: float = -np.inf

    @property
    def axes(self):
        """Half-light radius along the major axis (pixels), axis ratio, angle from x (rad)."""
        # the ellipticity ln(major / minor) as a vector of twice the angle
        g1, g2 = self.parameters[4:]
        eta = np.hypot(g1, g2)
        return np.exp(self.parameters[2] + eta / 2), np.exp(-eta), 0.5 * np.arctan2(g2, g1)

    def moved(self, shift):
        """Return a copy whose centers are moved by (x, y) pixels."""
        return dataclasses.replace(self, parameters=self.parameters + center_change(shift))

    def drawn(self, light, farthest):
        """Draw the profile on its grid (a `Cutout`), before the PSF, up to a semi-major axis (pixels) at most."""
        radius, axis_ratio, angle = self.axes
        x, y, _, log_index = self.parameters[:4]
        stamp, origin = sersic_stamp(
            x=x, y=y, total_flux=light, r_eff=radius, n=np.exp(log_index), axis_ratio=axis_ratio,
            theta=angle, max_radius=farthest,
        )  # fmt: skip
        return Cutout(stamp, origin, convolved=False)

    def semi_major(self, size, origin):
        """Return the semi-major axis (pixels) of the ellipse through each pixel of an image at (y, x)."""
        _, axis_ratio, angle = self.axes
        y, x = np.indices(size)
        x = x + origin[1] - self.parameters[0]
        y = y + origin[0] - self.parameters[1]
        along = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        return np.hypot(along, across / axis_ratio)


def center_change(shift):
    """Return the change of a profile's six parameters by a shift (x, y) of its center."""
    return np.append(shift, np.zeros(4))


def major_radius(parameters):
    """Return the half-light radius (pixels) along the major axis of a profile's six parameters."""
    return np.exp(parameters[2] + 0.5 * np.hypot(parameters[4], parameters[5]))


def not_fitted(n):
    """Make records (`FITTED`) of n sources of whose shape nothing is known."""
    records = np.empty(n, FITTED)
    for name in FITTED.names:
        records[name] = np.nan
    records["galaxy"] = 0.0
    records["share"] = 1.0
    return records


@cached
def normal_nodes():
    """Return points of a normal distribution in four dimensions, of zero mean and unit covariance."""
    from scipy.stats import norm, qmc

    z = norm.ppf(qmc.Sobol(4, scramble=True, rng=np.random.default_rng(1)).random(_NODES))
    z -= z.mean(axis=0)
    return z @ np.linalg.inv(np.linalg.cholesky(z.T @ z / len(z))).T


@value_class
class Neighbors:
    """Sources whose light was fitted together with that of another one."""

    flux: np.ndarray  # (m,)
    parameters: np.ndarray  # (m, 6)
    #: Cholesky's factor, (7 m, 7 m), of the inverse covariance of their light and parameters.
    root: np.ndarray

    def moved(self, shift):
        """Return a copy whose centers are moved by (x, y) pixels."""
        return dataclasses.replace(self, parameters=self.parameters + center_change(shift))


class ShapeFitter(ShapeModels):
    """Fits light profiles through the PSF of an image of ``scale`` arcsec per pixel."""

    def __init__(self, psf, scale):
        super().__init__(psf)
        self._log_scale = np.log(scale)

    def fit(self, data, weight, xy, population=None, start=None, neighbors=None, nodes=True):
        """
        Fit a point and a Sersic profile.

        Parameters
        ----------
        data, weight : `~numpy.ndarray`, shape (ny, nx)
            Light of a stamp, and the inverse of its noise, zero for pixels that do not count.
        xy : (float, float)
            Where the source is on the stamp.
        population : `Population`, optional
            What is known of its shape, at its brightness; `expected` if not given.
        start : `Shape`, optional
            A profile to begin with; several sizes are tried without.
        neighbors : `Neighbors`, optional
            Sources that were fitted with it, whose light is taken off.
        nodes : bool, optional
            Whether it is looked at what else the source may be; otherwise the best profile is returned.

        Returns
        -------
        shape : `Shape` or None
            None where no profile of positive light fits.
        """
        population = population or self.expected
        mean, precision = _prior(xy, population)
        # none of them for the best profile alone
        deviates = normal_nodes()[: None if nodes else 0]
        if start is None:
            # the best of some sizes to begin with
            half = LEAST_HALF
            starts = mean + _STARTS
        else:
            half = half_width(start.parameters)
            starts = start.parameters[None]
        stamp = self._stamp(data, weight, mean[None], half)
        solution = stamp.fit(starts, mean, precision, population, neighbors, deviates)
        found, is_wider, flux, parameters, *_ = solution
        if is_wider:
            stamp = self._stamp(data, weight, mean[None], half_width(parameters))
            starts = parameters[None]
            solution = stamp.fit(starts, mean, precision, population, neighbors, deviates)
            found, _, flux, parameters, *_ = solution
        if not found:
            return None
        covariance, node_values, as_point, point = solution[4:]
        if not nodes:
            return Shape(flux, parameters, 0.0, covariance)
        return Shape(flux, parameters, point, covariance, node_values, as_point)

    def fit_together(self, data, weight, xy, populations, shapes):
        """
        Fit the profiles of sources that overlap, all at once.

        Parameters
        ----------
        data, weight : `~numpy.ndarray`, shape (ny, nx)
            As for `fit`.
        xy : `~numpy.ndarray`, shape (n, 2)
            Where the sources are on the stamp.
        populations : sequence of `Population`
            What is known of each, at its brightness.
        shapes : sequence of `Shape`
            The profiles to begin with.

        Returns
        -------
        shapes : list of `Shape`
            With other fluxes, parameters and covariances; the given ones where nothing is found.
        beside : list of `Neighbors`
            To each, the others; None where nothing is found.
        """
        mean = np.empty((len(shapes), 6))
        precision = np.empty((len(shapes), 6, 6))
        for k, population in enumerate(populations):
            mean[k], precision[k] = _prior(xy[k], population)
        start = np.array([shape.parameters for shape in shapes])
        half_widths = [half_width(parameters) for parameters in start]
        inner = self._stamp(data, weight, mean, half_widths)
        solution = inner.minimum(start, mean, precision, _JOINT_STEPS)
        if solution is None:
            return list(shapes), [None] * len(shapes)
        _, flux, parameters, _, covariance, matrix = solution
        new = []
        neighbors = []
        for k, shape in enumerate(shapes):
            values = {"flux": flux[k], "parameters": parameters[k], "covariance": covariance[k]}
            new.append(dataclasses.replace(shape, **values))
            is_other = np.arange(len(shapes)) != k
            rows = np.repeat(is_other, len(matrix) // len(shapes))
            root = np.linalg.cholesky(matrix[np.ix_(rows, rows)])
            neighbors.append(Neighbors(flux[is_other], parameters[is_other], root))
        return new, neighbors

    @functools.cached_property
    def expected(self):
        """What is known of sources beforehand."""
        return Population.expected(np.exp(self._log_scale))

    def unfitted(self, xy, population):
        """Return the shape that is expected of a source at a position: the typical one, or a point."""
        covariance = np.zeros((7, 7))
        covariance[3:, 3:] = population.spread
        covariance[1, 1] = covariance[2, 2] = _OFFSET**2
        parameters = np.concatenate([xy, population.mean])
        return Shape(np.nan, parameters, population.point, covariance)

    def _stamp(self, data, weight, means, half):
        """Cut out the pixels within distances, (n,) or one, of the middles, (n, 6), in a rectangle."""
        half_widths = np.broadcast_to(half, len(means)).astype(int)
        data = np.ascontiguousarray(data, float)
        weight = np.ascontiguousarray(weight, float)
        squares, white, inverse = cut_out(data, weight, means, half_widths)
        plan = self.plan(2 * int(half_widths.max()) + 1)
        return _Stamp(self, plan, white, inverse, squares)


@value_class
class _Stamp:
    models: ShapeModels
    plan: Plan
    white: np.ndarray
    inverse: np.ndarray
    squares: np.ndarray

    @property
    def pixels(self):
        """As the kernels take them."""
        return self.plan, profile_table(), self.white, self.inverse, self.squares

    def minimum(self, start, mean, precision, steps=_STEPS):
        """Fit as `~miricigale.photometry._core.shape_fits.minimum`; None if nothing is found."""
        limits = parameter_limits(self.white)
        solution = minimum(*self.pixels, start, mean, precision, limits, steps, GAIN)
        if not np.isfinite(solution[0]):
            return None
        return solution

    def fit(self, starts, mean, precision, population, neighbors, deviates):
        """Fit as `~miricigale.photometry._core.source_fits.fit_source`."""
        return fit_source(
            *self.pixels, starts, mean[None], precision[None], population.log_det, population.point,
            self.changes(neighbors), deviates, _STEPS,
        )  # fmt: skip

    def changes(self, neighbors):
        """Return whitened changes of the light of neighbors by independent unit normal deviates, (p, pixels)."""
        if neighbors is None:
            return np.zeros((0, self.white.size))
        size = self.white.shape
        half = size[0] // 2
        images = np.zeros((len(neighbors.flux), 7, size[0], size[1]))
        for k, image in enumerate(images):
            # each on a square of its own: its transform is periodic, and it may be far from the stamp
            parameters = neighbors.parameters[k]
            corner = np.round(parameters[:2]).astype(int) - half
            drawn = self.models.profiles(size, parameters - center_change(corner), 6)
            middle = (corner - self.squares[0, :2])[::-1] + half
            with contextlib.suppress(NoOverlapError):
                (y, x), (drawn_y, drawn_x) = overlap_slices(size, size, tuple(middle))
                image[:, y, x] = drawn[:, drawn_y, drawn_x]
            image[1:] *= neighbors.flux[k]
        columns = (images * self.inverse).reshape(-1, self.white.size)
        # of the layout of an empty one: kernels are compiled once
        return np.ascontiguousarray(
            scipy.linalg.solve_triangular(neighbors.root, columns, lower=True)
        )


def _prior(xy, population):
    """Return the prior of the parameters of a source at a position: mean, and inverse of the covariance."""
    precision = np.zeros((6, 6))
    precision[:2, :2] = _CENTER
    precision[2:, 2:] = population.precision
    return np.concatenate([xy, population.mean]), precision
