"""Which shape the light of a source has: fits of a point and of a Sersic profile, and their evidence."""

import contextlib
import dataclasses
import functools

import numpy as np
import scipy.linalg
from astropy.nddata import NoOverlapError, overlap_slices

from miricigale.photometry._core.shape_fits import Plan, evidence_of, minimum
from miricigale.photometry._core.shapes import INDEX_RANGE, profile_table
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

#: Nodes that a shape's probability is summed over, and the width of their density over that of the
#: normal distribution about the best shape.
_NODES = 32
_WIDER = 1.4

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

#: Ln radius (pixels) of what is drawn as a point.
POINT_SIZE = -30.0

#: Largest number of steps, and the gain in chi^2 below which the fit ends.
_STEPS = 25
_GAIN = 0.1

#: Excess of chi^2 over twice the evidence of the profile that rules a point out at once.
_FAR_BELOW = 200.0

#: Radii (ln over the expected one) that the search begins with.
_STARTS = (-0.9, 0.0, 0.9)

#: Half-width (pixels) of the stamps, least and most, and in half-light radii.
_HALF = 16
_MOST = 48
_REACH = 4.0


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

    def mean_shape(self, odds, point):
        """Return the mean shape of the nodes, given their probabilities and that of a point."""
        if odds.sum() > 0:
            odds = odds / odds.sum()
        else:
            odds = np.full(len(odds), 1.0 / len(odds))
        # mean and covariance of flux and shape over the nodes
        mean = odds @ self.nodes[:, 1:]
        off = self.nodes[:, 1:] - mean
        shape_covariance = (off * odds[:, None]).T @ off
        # noise of the flux of each shape
        shape_covariance[0, 0] += 1.0 / np.linalg.inv(self.covariance)[0, 0]
        covariance = np.zeros((7, 7))
        keep = [0, 3, 4, 5, 6]
        covariance[1:3, 1:3] = self.covariance[1:3, 1:3]
        covariance[np.ix_(keep, keep)] = shape_covariance
        return dataclasses.replace(
            self,
            flux=float(np.exp(mean[0])),
            parameters=np.concatenate([self.parameters[:2], mean[1:]]),
            covariance=covariance,
            point=float(point),
        )

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
        beside : `Neighbors`, optional
            Neighbors that were fitted with it, whose light is taken off.
        nodes : bool, optional
            Whether it is looked at what else the source may be; otherwise the best profile is returned.

        Returns
        -------
        shape : `Shape` or None
            None where no profile of positive light fits.
        """
        population = population or self.expected
        mean, precision = _prior(xy, population)
        half = _HALF if start is None else _half_width(start.parameters)
        # the best of some sizes to begin with
        inner = self._stamp(data, weight, mean[None], half)
        if start is None:
            starts = [mean + [0, 0, step, 0, 0, 0] for step in _STARTS]
            parameters = min(starts, key=inner.misfit)
        else:
            parameters = start.parameters

        def best(parameters, precision):
            solution = inner.minimum(parameters[None], mean[None], precision[None])
            if solution is None:
                return None
            _, flux, parameters, evidence, covariance, _ = solution
            return flux[0], parameters[0], evidence, covariance[0]

        extended = best(parameters, precision)
        if extended is not None and start is None:
            first_fit = extended[1]
            if _half_width(first_fit) > half:
                inner = self._stamp(data, weight, mean[None], _half_width(first_fit))
                extended = best(first_fit, precision)
        if extended is None:
            return None
        flux, parameters, evidence, covariance = extended
        if not nodes:
            return Shape(flux, parameters, 0.0, covariance)
        # what else the source may be: shapes about the best, and a point
        changes = inner.changes(neighbors)
        nodes = inner.nodes(parameters, flux, covariance[1:, 1:], mean, changes)
        start = parameters.copy()
        start[2] = POINT_SIZE
        as_point = -np.inf
        # a point that is far worse in the same place need not be moved to the best one
        if inner.misfit(start) < -2 * evidence + _FAR_BELOW:
            point = best(start, precision[:2, :2].copy())
            if point is not None:
                point_flux, _, point_evidence, _ = point
                as_point = point_evidence - np.log(point_flux)
        shape = Shape(flux, parameters, 0.0, covariance, nodes, as_point)
        odds, point_odds = population.odds(nodes[None], np.array([as_point]))
        return shape.mean_shape(odds[0], point_odds[0])

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
        half_widths = np.array([_half_width(parameters) for parameters in start])
        inner = self._stamp(data, weight, mean, half_widths)
        solution = inner.minimum(start, mean, precision)
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
        squares = np.empty((len(means), 3), int)
        squares[:, 2] = 2 * half + 1
        squares[:, :2] = np.round(means[:, :2]) - np.reshape(half, (-1, 1))
        x0, y0, _ = squares.min(axis=0)
        x1, y1 = (squares[:, :2] + squares[:, 2:]).max(axis=0)
        white_inverse = np.zeros((2, y1 - y0, x1 - x0))
        for x, y, size in squares.tolist():
            part = np.s_[max(y, 0) : max(y + size, 0), max(x, 0) : max(x + size, 0)]
            inverse = weight[part]
            at = max(y, 0) - y0, max(x, 0) - x0
            box = np.s_[:, at[0] : at[0] + inverse.shape[0], at[1] : at[1] + inverse.shape[1]]
            white_inverse[box] = data[part] * inverse, inverse
        return _Stamp(self, self.plan(int(squares[:, 2].max())), *white_inverse, squares)


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

    @functools.cached_property
    def limits(self):
        """Least and largest parameters."""
        size = np.log(max(self.white.shape))
        index = np.log(INDEX_RANGE)
        low = [-np.inf, -np.inf, np.log(0.05), index[0], -2.0, -2.0]
        return np.array([low, [np.inf, np.inf, size, index[1], 2.0, 2.0]])

    def minimum(self, start, mean, precision, steps=_STEPS):
        """Fit as `~miricigale.photometry._core.shape_fits.minimum`; None if nothing is found."""
        solution = minimum(*self.pixels, start, mean, precision, self.limits, steps, _GAIN)
        if not np.isfinite(solution[0]):
            return None
        return solution

    def misfit(self, parameters):
        """Return chi^2 of a profile with the light that fits best, infinite if that is negative."""
        solution = self.minimum(parameters[None], parameters[None], np.empty((1, 0, 0)), 0)
        if solution is None:
            return np.inf
        return solution[0]

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

    def nodes(self, parameters, flux, covariance, mean, changes):
        """
        Calculate shapes about the best as `Population.odds` takes them: likelihood over density, flux, shape.

        The likelihood is that of the best light, center and neighbors: these change along ``changes``, (m, p), the
        whitened change of their light by the independent unit normal deviates of what is possible. ``covariance``,
        (6, 6), is that of center and shape.
        """
        # nodes are drawn from a normal distribution wider than that of the fit
        root = np.linalg.cholesky(covariance[2:, 2:]) * _WIDER
        z = normal_nodes()
        shapes = parameters[2:] + z @ root.T
        shapes[:, 0] = np.clip(shapes[:, 0], np.log(0.05), self.limits[1, 2])
        low, high = np.log(INDEX_RANGE)
        shapes[:, 1] = np.clip(shapes[:, 1], low, high)
        # the center moves with the shape as their covariance says
        drift = (shapes - parameters[2:]) @ np.linalg.solve(covariance[2:, 2:], covariance[2:, :2])
        likelihoods = evidence_of(
            *self.pixels,
            parameters[None],
            np.array([flux]),
            shapes,
            drift,
            mean[None],
            _CENTER[None],
            changes,
        )
        # ln of the normal density from which the nodes are drawn
        density = (
            -0.5 * np.sum(z * z, axis=1) - np.sum(np.log(np.diag(root))) - 2 * np.log(2 * np.pi)
        )
        likelihoods[:, 0] -= density
        return np.column_stack([likelihoods, shapes])


def _prior(xy, population):
    """Return the prior of the parameters of a source at a position: mean, and inverse of the covariance."""
    precision = np.zeros((6, 6))
    precision[:2, :2] = _CENTER
    precision[2:, 2:] = population.precision
    return np.concatenate([xy, population.mean]), precision


def _half_width(parameters):
    """Return the half-width (pixels) of the stamp that a profile is fitted on."""
    return int(np.clip(np.ceil(_REACH * major_radius(parameters)), _HALF, _MOST))
