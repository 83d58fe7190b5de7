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

#: Width (pixels) of the offset of the center from the position.
_OFFSET = 0.7

#: The same as the inverse of a covariance.
_CENTER = np.diag([_OFFSET**-2] * 2)

#: Nodes that a shape's probability is summed over, and the width of their density over that of the
#: normal distribution about the best shape.
_NODES, _WIDER = 32, 1.4

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
_STEPS, _GAIN = 25, 0.1

#: Excess of chi^2 over twice the evidence of the profile that rules a point out at once.
_FAR_BELOW = 200.0

#: Radii (ln over the expected one) that the search begins with.
_STARTS = (-0.9, 0.0, 0.9)

#: Half-width (pixels) of the stamps, least and most, and in half-light radii.
_HALF, _MOST, _REACH = 16, 48, 4.0


@dataclasses.dataclass(frozen=True, eq=False)
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
        g1, g2 = self.parameters[4:]
        eta = np.hypot(g1, g2)
        return np.exp(self.parameters[2] + eta / 2), np.exp(-eta), 0.5 * np.arctan2(g2, g1)

    def moved(self, shift):
        """The same at another place (x, y)."""
        return dataclasses.replace(self, parameters=self.parameters + [*shift, 0, 0, 0, 0])

    def drawn(self, light, farthest):
        """The profile on its grid (a `Cutout`), before the PSF, up to a semi-major axis (pixels) at most."""
        radius, axis_ratio, angle = self.axes
        x, y, _, log_index = self.parameters[:4]
        stamp, origin = sersic_stamp(
            x=x, y=y, total_flux=light, r_eff=radius, n=np.exp(log_index), axis_ratio=axis_ratio,
            theta=angle, max_radius=farthest,
        )  # fmt: skip
        return Cutout(stamp, origin, convolved=False)

    def among(self, odds, point):
        """The mean of the nodes, with their probabilities and that of a point."""
        odds = odds / odds.sum() if odds.sum() > 0 else np.full(len(odds), 1.0 / len(odds))
        mean = odds @ self.nodes[:, 1:]
        off = self.nodes[:, 1:] - mean
        found = (off * odds[:, None]).T @ off
        # noise of the flux of each shape
        found[0, 0] += 1.0 / np.linalg.inv(self.covariance)[0, 0]
        covariance, keep = np.zeros((7, 7)), [0, 3, 4, 5, 6]
        covariance[1:3, 1:3] = self.covariance[1:3, 1:3]
        covariance[np.ix_(keep, keep)] = found
        return dataclasses.replace(
            self,
            flux=float(np.exp(mean[0])),
            parameters=np.concatenate([self.parameters[:2], mean[1:]]),
            covariance=covariance,
            point=float(point),
        )

    def semi_major(self, size, origin):
        """Semi-major axis (pixels) of the ellipse through each pixel of an image at an origin (y, x)."""
        _, axis_ratio, angle = self.axes
        y, x = np.indices(size)
        x, y = x + origin[1] - self.parameters[0], y + origin[0] - self.parameters[1]
        along = x * np.cos(angle) + y * np.sin(angle)
        across = y * np.cos(angle) - x * np.sin(angle)
        return np.hypot(along, across / axis_ratio)


def not_fitted(n):
    """Records (`FITTED`) of n sources of whose shape nothing is known."""
    found = np.empty(n, FITTED)
    for name in FITTED.names:
        found[name] = np.nan
    found["galaxy"], found["share"] = 0.0, 1.0
    return found


@cached
def normal_nodes():
    """Points of a normal distribution in four dimensions: of zero mean and unit covariance."""
    from scipy.stats import norm, qmc

    z = norm.ppf(qmc.Sobol(4, scramble=True, rng=np.random.default_rng(1)).random(_NODES))
    z -= z.mean(axis=0)
    return z @ np.linalg.inv(np.linalg.cholesky(z.T @ z / len(z))).T


@dataclasses.dataclass(frozen=True, eq=False)
class Beside:
    """Sources whose light was fitted together with that of another one."""

    flux: np.ndarray  # (m,)
    parameters: np.ndarray  # (m, 6)
    #: Cholesky's factor, (7 m, 7 m), of the inverse covariance of their light and parameters.
    root: np.ndarray

    def moved(self, shift):
        """The same at another place (x, y)."""
        return dataclasses.replace(self, parameters=self.parameters + [*shift, 0, 0, 0, 0])


class ShapeFitter(ShapeModels):
    """Fits light profiles through the PSF of an image of ``scale`` arcsec per pixel."""

    def __init__(self, psf, scale):
        super().__init__(psf)
        self._log_scale = np.log(scale)

    def fit(self, data, weight, xy, population=None, start=None, beside=None, nodes=True):
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
        beside : `Beside`, optional
            Neighbors that were fitted with it, whose light is taken off.
        nodes : bool, optional
            Whether it is looked at what else the source may be; otherwise the best profile is returned.

        Returns
        -------
        shape : `Shape` or None
            None where no profile of positive light fits.
        """
        population = population or self.expected
        mean, precision = _known(xy, population)
        half = _HALF if start is None else _half_width(start.parameters)
        inner = self._stamp(data, weight, mean[None], half)
        if start is None:
            starts = [mean + [0, 0, step, 0, 0, 0] for step in _STARTS]
            parameters = min(starts, key=inner.misfit)
        else:
            parameters = start.parameters

        def best(parameters, precision):
            found = inner.minimum(parameters[None], mean[None], precision[None])
            return found and [one if np.ndim(one) == 0 else one[0] for one in found]

        extended = best(parameters, precision)
        if extended is not None and start is None and _half_width(extended[2]) > half:
            inner = self._stamp(data, weight, mean[None], _half_width(extended[2]))
            extended = best(extended[2], precision)
        if extended is None:
            return None
        _, flux, parameters, evidence, covariance, _ = extended
        if not nodes:
            return Shape(flux, parameters, 0.0, covariance)
        changes = inner.changes(beside)
        nodes = inner.nodes(parameters, flux, covariance[3:, 3:], mean, changes)
        start = parameters.copy()
        start[2] = POINT_SIZE
        as_point = -np.inf
        # a point that is far worse in the same place need not be moved to the best one
        near = inner.misfit(start) < -2 * evidence + _FAR_BELOW
        if near and (point := best(start, precision[:2, :2].copy())) is not None:
            as_point = point[3] - np.log(point[1])
        shape = Shape(flux, parameters, 0.0, covariance, nodes, as_point)
        return shape.among(*(one[0] for one in population.odds(nodes[None], np.array([as_point]))))

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
        beside : list of `Beside`
            To each, the others; None where nothing is found.
        """
        mean, precision = (np.array(one) for one in zip(*map(_known, xy, populations), strict=True))
        start = np.array([one.parameters for one in shapes])
        inner = self._stamp(data, weight, mean, max(_half_width(one) for one in start))
        found = inner.minimum(start, mean, precision)
        if found is None:
            return list(shapes), [None] * len(shapes)
        _, flux, parameters, _, covariance, matrix = found
        new = [
            dataclasses.replace(
                shape, flux=flux[k], parameters=parameters[k], covariance=covariance[k]
            )
            for k, shape in enumerate(shapes)
        ]
        beside = []
        for k in range(len(new)):
            others = np.arange(len(new)) != k
            rows = np.repeat(others, len(matrix) // len(new))
            root = np.linalg.cholesky(matrix[np.ix_(rows, rows)])
            beside.append(Beside(flux[others], parameters[others], root))
        return new, beside

    @functools.cached_property
    def expected(self):
        """What is known of sources beforehand."""
        return Population.expected(np.exp(self._log_scale))

    def unfitted(self, xy, population):
        """What is known beforehand of a source at a position: the typical shape, or a point."""
        covariance = np.zeros((7, 7))
        covariance[3:, 3:] = population.spread
        covariance[1, 1] = covariance[2, 2] = _OFFSET**2
        return Shape(np.nan, np.array([*xy, *population.mean]), population.point, covariance)

    def _stamp(self, data, weight, means, half):
        """The pixels within some distance of the middles, (n, 6), on the rectangle that holds all."""
        corners = np.round(means[:, :2]).astype(int) - half
        size, (left, top) = 2 * half + 1, corners.min(axis=0)
        right, bottom = corners.max(axis=0) + size
        found = np.zeros((2, bottom - top, right - left))
        for x, y in corners:
            seen = np.s_[max(y, 0) : max(y + size, 0), max(x, 0) : max(x + size, 0)]
            inverse = weight[seen]
            at = max(y, 0) - top, max(x, 0) - left
            box = np.s_[:, at[0] : at[0] + inverse.shape[0], at[1] : at[1] + inverse.shape[1]]
            found[box] = data[seen] * inverse, inverse
        return _Stamp(self, self.plan(size), *found, corners)


@dataclasses.dataclass(frozen=True, eq=False)
class _Stamp:
    models: ShapeModels
    plan: Plan
    white: np.ndarray
    inverse: np.ndarray
    corners: np.ndarray

    @property
    def pixels(self):
        """As the kernels take them."""
        return self.plan, profile_table(), self.white, self.inverse, self.corners

    @functools.cached_property
    def limits(self):
        """Least and largest parameters."""
        size, index = np.log(max(self.white.shape)), np.log(INDEX_RANGE)
        low = [-np.inf, -np.inf, np.log(0.05), index[0], -2.0, -2.0]
        return np.array([low, [np.inf, np.inf, size, index[1], 2.0, 2.0]])

    def minimum(self, start, mean, precision, steps=_STEPS):
        """As `~miricigale.photometry._core.shape_fits.minimum`; None if nothing is found."""
        found = minimum(*self.pixels, start, mean, precision, self.limits, steps, _GAIN)
        return found if np.isfinite(found[0]) else None

    def misfit(self, parameters):
        """Chi^2 of a profile with the light that fits best, infinite if that is negative."""
        found = self.minimum(parameters[None], parameters[None], np.empty((1, 0, 0)), 0)
        return np.inf if found is None else found[0]

    def changes(self, beside):
        """Whitened changes of the light of neighbors by independent unit normal deviates, (p, pixels)."""
        if beside is None:
            return np.zeros((0, self.white.size))
        size = self.white.shape
        images = np.zeros((len(beside.flux), 7, *size))
        for image, flux, one in zip(images, beside.flux, beside.parameters, strict=True):
            # each on a square of its own: its transform is periodic, and it may be far from the stamp
            corner = np.round(one[:2]).astype(int) - size[0] // 2
            drawn = self.models.profiles(size, one - [*corner, 0, 0, 0, 0], 6)
            middle = (corner - self.corners[0])[::-1] + size[0] // 2
            with contextlib.suppress(NoOverlapError):
                here, there = overlap_slices(size, size, tuple(middle))
                image[:, *here] = drawn[:, *there]
            image[1:] *= flux
        columns = (images * self.inverse).reshape(-1, self.white.size)
        # of the layout of an empty one: kernels are compiled once
        return np.ascontiguousarray(scipy.linalg.solve_triangular(beside.root, columns, lower=True))

    def nodes(self, parameters, flux, covariance, mean, beside):
        """
        Shapes about the best as `Population.odds` takes them: likelihood over density, flux, shape.

        The likelihood is that of the best light, center and neighbors: these change along ``beside``, (m, p), the
        whitened change of their light by the independent unit normal deviates of what is possible.
        """
        root = np.linalg.cholesky(covariance) * _WIDER
        z = normal_nodes()
        shapes = parameters[2:] + z @ root.T
        shapes[:, 0] = np.clip(shapes[:, 0], np.log(0.05), self.limits[1, 2])
        shapes[:, 1] = np.clip(shapes[:, 1], *np.log(INDEX_RANGE))
        best, prior = (parameters[None], np.array([flux])), (mean[None], _CENTER[None])
        found = evidence_of(*self.pixels, *best, shapes, *prior, beside)
        density = (
            -0.5 * np.sum(z * z, axis=1) - np.sum(np.log(np.diag(root))) - 2 * np.log(2 * np.pi)
        )
        found[:, 0] -= density
        return np.column_stack([found, shapes])


def _known(xy, population):
    """What is known of the parameters of a source at a position: mean, and inverse of the covariance."""
    precision = np.zeros((6, 6))
    precision[:2, :2], precision[2:, 2:] = _CENTER, population.precision
    return np.concatenate([xy, population.mean]), precision


def _half_width(parameters):
    """Half-width of the stamp that a profile is fitted on."""
    reach = np.exp(parameters[2] + 0.5 * np.hypot(*parameters[4:]))
    return int(np.clip(np.ceil(_REACH * reach), _HALF, _MOST))
