"""Sizes and indices of the sources of a field: the prior of each shape, measured on all of them."""

import dataclasses
import functools

import numpy as np

from miricigale.utils.values import value_class

#: What is known before a field is looked at, worth so many sources: mean and width of ln of the
#: circularised half-light radius (arcsec) and of ln of the Sersic index, width of the two
#: ellipticities, and the part of points; the width of the slopes with ln flux.
_WORTH = 5.0
_MEAN = np.array([np.log(0.2), np.log(1.8)])
_WIDTH = np.array([0.8, 0.8])
_ELLIPTICITY = 0.6
_POINT = 0.5
_SLOPE = 0.3

#: Steps of the search, and largest distance of ln brightness from the middle that counts.
_STEPS = 30
_FAR = 4.0


@value_class
class Population:
    """
    Distribution of the shapes of the sources of a field.

    Ln radius (pixels) and ln index are normal about a line in ln brightness, ellipticities about zero.
    """

    line: np.ndarray  # (2, 2): Means of the two at the middle brightness, and their slopes.
    covariance: np.ndarray  # (2, 2): About the line.
    ellipticity: float = _ELLIPTICITY**2  # Variance of each of the two ellipticities.
    point: float = _POINT  # Part of the sources that are points.
    middle: float = 0.0  # The middle of ln brightness.

    @classmethod
    def expected(cls, scale):
        """Make the distribution that is expected beforehand, for pixels of ``scale`` arcsec."""
        return cls(np.array([_MEAN - [np.log(scale), 0.0], np.zeros(2)]), np.diag(_WIDTH**2))

    def at(self, brightness):
        """Return the distribution at one ln brightness."""
        mean = self.line[0] + self.off(brightness) * self.line[1]
        population = dataclasses.replace(self, line=np.array([mean, np.zeros(2)]))
        # the class is frozen; the spread about the line is the same
        population.__dict__["_inverse"] = self._inverse
        return population

    def off(self, brightness):
        """Return the distance of ln brightness from the middle, which is limited: lines do not go on for ever."""
        if brightness is None:
            return 0.0
        return np.clip(brightness - self.middle, -_FAR, _FAR)

    @property
    def mean(self):
        """Of ln radius, ln index and ellipticities, at the middle."""
        return np.append(self.line[0], [0.0, 0.0])

    @property
    def spread(self):
        """Covariance of these four."""
        covariance = np.diag([0.0, 0.0, self.ellipticity, self.ellipticity])
        covariance[:2, :2] = self.covariance
        return covariance

    @functools.cached_property
    def _inverse(self):
        """Inverse of the covariance of the four, and ln of the determinant of 2 pi times it."""
        return np.linalg.inv(self.spread), np.linalg.slogdet(2 * np.pi * self.spread)[1]

    @property
    def precision(self):
        """Inverse of the covariance of the four."""
        return self._inverse[0]

    @property
    def log_det(self):
        """Ln of the determinant of 2 pi times the covariance of the four."""
        return self._inverse[1]

    def odds(self, nodes, points, brightness=None):
        """
        Calculate probabilities of the shapes of sources: of their nodes, (n, k), and of points, (n,).

        Parameters
        ----------
        nodes : `~numpy.ndarray`, shape (n, k, 6)
            Ln of the likelihood over the density of the nodes, ln flux, and shape.
        points : `~numpy.ndarray`, shape (n,)
            Ln of the likelihood of a point.
        brightness : `~numpy.ndarray`, shape (n,), optional
            Ln brightness of the sources; all are at the middle without.
        """
        off = np.broadcast_to(self.off(brightness), len(nodes))
        z = nodes[..., 2:] - self.mean
        z[..., :2] -= off[:, None, None] * self.line[1]
        inverse, log_det = self._inverse
        chi2 = np.sum((z @ inverse) * z, axis=-1) + log_det
        # likelihood times prior over the density of the nodes
        galaxy = nodes[..., 0] - 0.5 * chi2 + np.log((1.0 - self.point) / nodes.shape[1])
        probability = np.concatenate([galaxy, (points + np.log(self.point))[:, None]], axis=1)
        probability = np.exp(probability - probability.max(axis=1, keepdims=True))
        probability /= probability.sum(axis=1, keepdims=True)
        return probability[:, :-1], probability[:, -1]

    def fitted(self, nodes, points, brightness):
        """
        Find the population that the sources are most probably from, by expectation and maximization.

        Each source counts with the whole of what it may be, so that the noise of single shapes does not widen the
        distribution; this one counts as some sources.
        """
        population = dataclasses.replace(self, middle=float(np.median(brightness)))
        x = np.stack([np.ones(len(nodes)), population.off(brightness)], axis=-1)
        shapes = nodes[..., 2:]
        for _ in range(_STEPS):
            # expectation: the probability of each node and of a point
            weight, point = population.odds(nodes, points, brightness)
            total = weight.sum(axis=1)
            # maximization: weighted least squares for the line, with a prior for it
            power = (x * total[:, None]).T @ x
            power += _WORTH * np.diag([1.0, 1.0 / _SLOPE**2])
            moments = x.T @ np.einsum("nk,nkj->nj", weight, shapes[..., :2])
            moments[0] += _WORTH * self.line[0]
            line = np.linalg.solve(power, moments)
            z = shapes[..., :2] - (x @ line)[:, None]
            # scatter about the line, with the prior worth some sources
            covariance = np.einsum("nk,nki,nkj->ij", weight, z, z) + _WORTH * self.covariance
            square = np.einsum("nk,nkj->", weight, shapes[..., 2:] ** 2) / 2
            n = total.sum() + _WORTH
            population = dataclasses.replace(
                population, line=line, covariance=covariance / n,
                ellipticity=float((square + _WORTH * self.ellipticity) / n),
                point=float((point.sum() + _WORTH * self.point) / (len(points) + _WORTH)),
            )  # fmt: skip
        return population
