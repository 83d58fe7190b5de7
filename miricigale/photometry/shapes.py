"""Which shape the light of a source has: fits of a point and of a Sersic profile, and their evidence."""

import dataclasses
import functools

import numpy as np
import scipy.linalg

from miricigale.photometry._core.shapes import INDEX_RANGE, shape_curves
from miricigale.photometry.cutouts import Cutout
from miricigale.photometry.population import Population
from miricigale.photometry.shape_models import ShapeModels
from miricigale.profiles import sersic_stamp

#: Width (pixels) of the offset of the center from the position.
_OFFSET = 0.7

#: Nodes that a shape's probability is summed over, and the width of their density over that of the
#: normal distribution about the best shape.
_NODES, _WIDER = 32, 1.4

#: What is kept of the profile fitted to a source: its parameters with x and y on the whole image, the
#: covariance of ln flux and parameters, the probability of a point, and the profile's part of the
#: light of the template. NaN where nothing is known.
FITTED = np.dtype(
    [("parameters", float, (6,)), ("covariance", float, (7, 7)), ("point", float), ("light", float)]
)

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
    parameters: np.ndarray  # (6,): As for `~miricigale.photometry.shape_models.Waves.profiles`.
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
    return found


@functools.cache
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
        inner = self._stamp(data, weight, mean[None], [half])
        if start is None:
            starts = [mean + [0, 0, step, 0, 0, 0] for step in _STARTS]
            parameters = min(starts, key=lambda one: _misfit(one, inner))
        else:
            parameters = start.parameters

        def best(parameters, precision):
            found = _minimum(inner, parameters[None], mean[None], precision[None])
            return found and [one if np.ndim(one) == 0 else one[0] for one in found]

        extended = best(parameters, precision)
        if extended is not None and start is None and _half_width(extended[1]) > half:
            inner = self._stamp(data, weight, mean[None], [_half_width(extended[1])])
            extended = best(extended[1], precision)
        if extended is None:
            return None
        flux, parameters, evidence, covariance, _ = extended
        if not nodes:
            return Shape(flux, parameters, 0.0, covariance)
        changes = inner.changes(beside)
        nodes = inner.nodes(parameters, flux, covariance[3:, 3:], mean, changes)
        start = parameters.copy()
        start[2] = -30.0
        as_point = -np.inf
        # a point that is far worse in the same place need not be moved to the best one
        near = _misfit(start, inner) < -2 * evidence + _FAR_BELOW
        if near and (point := best(start, precision[:2, :2])) is not None:
            as_point = point[2] - np.log(point[0])
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
        inner = self._stamp(data, weight, mean, [_half_width(one) for one in start])
        found = _minimum(inner, start, mean, precision)
        if found is None:
            return list(shapes), [None] * len(shapes)
        flux, parameters, _, covariance, matrix = found
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

    def _stamp(self, data, weight, means, halves):
        """The pixels within some distance of the middles, (n, 6), on the rectangle that holds all."""
        middles = np.round(means[:, 1::-1]).astype(int)
        lows = np.maximum(middles - np.reshape(halves, (-1, 1)), 0)
        highs = np.minimum(middles + np.reshape(halves, (-1, 1)) + 1, weight.shape)
        corner = lows.min(axis=0)
        shape = tuple(highs.max(axis=0) - corner)
        boxes = [tuple(map(slice, *one)) for one in zip(lows - corner, highs - corner, strict=True)]
        cut = tuple(map(slice, corner, corner + shape))
        inside = np.zeros(shape, bool)
        for box in boxes:
            inside[box] = True
        use = np.flatnonzero(inside & (weight[cut] > 0))
        moved = [np.array([*low[::-1], 0, 0, 0, 0]) for low in lows]

        def models(parameters, derivatives):
            images = np.zeros((len(parameters), 1 + derivatives, *shape), np.float32)
            for image, box, one, off in zip(images, boxes, parameters, moved, strict=True):
                size = tuple(s.stop - s.start for s in box)
                image[:, *box] = self.profiles(size, one - off, derivatives)
            return images.reshape(-1, *shape)

        def changes(beside):
            if beside is None:
                return np.zeros((0, len(use)))
            at = beside.parameters - [*corner[::-1], 0, 0, 0, 0]
            images = np.array([self.profiles(shape, one, 6) for one in at], float)
            images[:, 1:] *= beside.flux[:, None, None, None]
            columns = images.reshape(-1, images[0, 0].size)[:, use] * inverse
            return scipy.linalg.solve_triangular(beside.root, columns, lower=True)

        inverse = weight[cut].ravel()[use]

        def curves(xy, shapes):
            waves = self.waves(shape)
            found = shape_curves(waves.kx, waves.ky, shapes).astype(np.float32)
            return waves.images(found, np.asarray(xy) - corner[::-1], shape)

        return _Stamp(
            models, curves, changes, use, inverse, data[cut].ravel()[use] * inverse, max(shape)
        )


@dataclasses.dataclass(frozen=True, eq=False)
class _Stamp:
    models: object
    curves: object
    changes: object
    use: np.ndarray
    inverse: np.ndarray
    white: np.ndarray
    size: int

    def whitened(self, images):
        return images.reshape(len(images), -1)[:, self.use] * self.inverse

    def nodes(self, parameters, flux, covariance, mean, beside):
        """
        Shapes about the best as `Population.odds` takes them: likelihood over density, flux, shape.

        The likelihood is that of the best light, center and neighbors: these change along ``beside``, (m, p), the
        whitened change of their light by the independent unit normal deviates of what is possible.
        """
        root = np.linalg.cholesky(covariance) * _WIDER
        z = normal_nodes()
        shapes = parameters[2:] + z @ root.T
        shapes[:, 0] = np.clip(shapes[:, 0], np.log(0.05), np.log(self.size))
        shapes[:, 1] = np.clip(shapes[:, 1], *np.log(INDEX_RANGE))
        images = self.curves(parameters[:2], shapes)
        columns = np.stack(
            [images, -np.gradient(images, axis=2), -np.gradient(images, axis=1)], axis=1
        )
        columns = columns.reshape(len(images), 3, -1)[:, :, self.use] * self.inverse
        shared = columns @ beside.T
        best = flux * (beside @ self.whitened(self.models(parameters[None], 0))[0])
        matrix = columns @ columns.transpose(0, 2, 1) - shared @ shared.transpose(0, 2, 1)
        slope = columns @ self.white - shared @ best
        seen = (slope[:, 0] > 0) & (matrix[:, 0, 0] > 0)
        # of the center: changes of the pixels are in proportion to the light
        scale = np.where(seen, slope[:, 0], 1.0) / np.where(seen, matrix[:, 0, 0], 1.0)
        factor = np.stack([np.ones_like(scale), scale, scale], axis=1)
        matrix *= factor[:, :, None] * factor[:, None]
        matrix[:, [1, 2], [1, 2]] += _OFFSET**-2
        off = np.append(0.0, parameters[:2] - mean[:2])
        slope = slope * factor - off * _OFFSET**-2
        step = np.linalg.solve(matrix, slope[..., None])[..., 0]
        chi2 = self.white @ self.white - best @ best + off @ off * _OFFSET**-2
        chi2 = chi2 - np.einsum("kc,kc->k", slope, step)
        volume = np.linalg.slogdet(matrix)[1] + 4 * np.log(_OFFSET)
        density = (
            -0.5 * np.sum(z * z, axis=1) - np.sum(np.log(np.diag(root))) - 2 * np.log(2 * np.pi)
        )
        # of a distribution that is flat in ln flux
        log_flux = np.log(np.maximum(step[:, 0], 0.1 * scale))
        like = -0.5 * (chi2 + volume) - log_flux - density
        return np.column_stack([np.where(seen, like, -1e9), np.where(seen, log_flux, 0.0), shapes])


def _known(xy, population):
    """What is known of the parameters of a source at a position: mean, and inverse of the covariance."""
    precision = np.diag([_OFFSET**-2] * 2 + [0.0] * 4)
    precision[2:, 2:] = np.linalg.inv(population.spread)
    return np.concatenate([xy, population.mean]), precision


def _half_width(parameters):
    """Half-width of the stamp that a profile is fitted on."""
    reach = np.exp(parameters[2] + 0.5 * np.hypot(*parameters[4:]))
    return int(np.clip(np.ceil(_REACH * reach), _HALF, _MOST))


def _misfit(parameters, stamp):
    """Chi^2 of a profile with the light that fits best."""
    (scaled,) = stamp.whitened(stamp.models(parameters[None], 0))
    power = scaled @ scaled
    flux = (scaled @ stamp.white) / power if power > 0 else 0.0
    return float(np.sum((stamp.white - flux * scaled) ** 2))


def _minimum(stamp, start, mean, precision):
    """
    Levenberg-Marquardt for the light and the first parameters of sources, with Gaussian priors.

    ``start`` and ``mean`` are of shape (n, 6), ``precision`` (n, m, m) for m free parameters. Fluxes, parameters,
    evidence (Laplace's, without the light's prior) and covariance of ln flux and the free parameters of each, (n,
    1 + m, 1 + m), and inverse of the covariance of flux and parameters of all; None if nothing is found.
    """
    n, n_free = precision.shape[:2]
    free = np.s_[:, :n_free]
    low = np.array([-np.inf, -np.inf, np.log(0.05), np.log(INDEX_RANGE[0]), -2.0, -2.0])
    high = np.array([np.inf, np.inf, np.log(stamp.size), np.log(INDEX_RANGE[1]), 2.0, 2.0])

    def at(parameters):
        # sources, light and derivatives, pixels
        columns = stamp.whitened(stamp.models(parameters, n_free)).reshape(n, 1 + n_free, -1)
        light = columns[:, 0]
        flux = np.linalg.lstsq(light @ light.T, light @ stamp.white, rcond=1e-12)[0]
        z = stamp.white - flux @ light
        off = (parameters - mean)[free]
        chi2 = z @ z + np.einsum("ni,nij,nj", off, precision, off)
        columns[:, 1:] *= flux[:, None, None]
        return parameters, columns.reshape(-1, z.size), flux, z, chi2

    def curvature(columns):
        matrix = columns @ columns.T
        blocks = matrix.reshape(n, 1 + n_free, n, 1 + n_free)
        for k in range(n):
            blocks[k, 1:, k, 1:] += precision[k]
        return matrix

    best = at(start.copy())
    damping = 1e-2
    for _ in range(_STEPS):
        parameters, columns, _, z, chi2 = best
        matrix = curvature(columns)
        slope = (columns @ z).reshape(n, -1)
        slope[:, 1:] -= np.einsum("nij,nj->ni", precision, (parameters - mean)[free])
        gained = 0.0
        while damping < 1e6:
            damped = matrix + np.diag(damping * np.diag(matrix))
            try:
                step = np.linalg.solve(damped, slope.ravel()).reshape(n, -1)
            except np.linalg.LinAlgError:
                return None
            trial = parameters.copy()
            trial[free] += np.clip(step[:, 1:], -1.0, 1.0)
            trial[free] = np.clip(trial[free], low[:n_free], high[:n_free])
            new = at(trial)
            if new[-1] <= chi2:
                gained = chi2 - new[-1]
                best = new
                damping = max(damping * 0.1, 1e-6)
                break
            damping *= 10.0
        if gained < _GAIN:
            break
    parameters, columns, flux, _, chi2 = best
    matrix = curvature(columns)
    sign, log_det = np.linalg.slogdet(matrix)
    if not (sign > 0 and np.isfinite(chi2) and np.all(flux > 0)):
        return None
    evidence = -0.5 * (chi2 + log_det - np.linalg.slogdet(precision)[1].sum())
    whole = np.linalg.inv(matrix).reshape(n, 1 + n_free, n, 1 + n_free)
    covariance = np.array([whole[k, :, k] for k in range(n)])
    covariance[:, 0] /= flux[:, None]
    covariance[:, :, 0] /= flux[:, None]
    return flux, parameters, evidence, covariance, matrix
