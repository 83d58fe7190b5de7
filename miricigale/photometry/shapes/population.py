"""Sizes and indices of the sources of a field: the prior of each shape, measured on all of them."""

import dataclasses
import functools

import numpy as np

#: What is known before a field is looked at, worth so many sources: mean and width of ln of the
#: circularised half-light radius (arcsec) and of ln of the Sersic index, width of the two
#: ellipticities, and the part of points; the width of the slopes with ln flux.
_WORTH, _MEAN, _WIDTH = 5.0, np.array([np.log(0.2), np.log(1.8)]), np.array([0.8, 0.8])
_ELLIPTICITY, _POINT, _SLOPE = 0.6, 0.5, 0.3

#: Steps of the search, and largest distance of ln brightness from the middle that counts.
_STEPS, _FAR = 30, 4.0


@dataclasses.dataclass(frozen=True, eq=False)
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
        """What is known beforehand, for pixels of ``scale`` arcsec."""
        return cls(np.array([_MEAN - [np.log(scale), 0.0], np.zeros(2)]), np.diag(_WIDTH**2))

    def at(self, brightness):
        """The distribution at one ln brightness."""
        mean = self.line[0] + self.off(brightness) * self.line[1]
        found = dataclasses.replace(self, line=np.array([mean, np.zeros(2)]))
        # the class is frozen; the spread about the line is the same
        found.__dict__["_inverse"] = self._inverse
        return found

    def off(self, brightness):
        """How far ln brightness is from the middle; lines do not go on for ever."""
        return 0.0 if brightness is None else np.clip(brightness - self.middle, -_FAR, _FAR)

    @property
    def mean(self):
        """Of ln radius, ln index and ellipticities, at the middle."""
        return np.append(self.line[0], [0.0, 0.0])

    @property
    def spread(self):
        """Covariance of these four."""
        found = np.diag([0.0, 0.0, self.ellipticity, self.ellipticity])
        found[:2, :2] = self.covariance
        return found

    @functools.cached_property
    def _inverse(self):
        """Inverse of the covariance of the four, and ln of the determinant of 2 pi times it."""
        return np.linalg.inv(self.spread), np.linalg.slogdet(2 * np.pi * self.spread)[1]

    @property
    def precision(self):
        """Inverse of the covariance of the four."""
        return self._inverse[0]

    def odds(self, nodes, points, brightness=None):
        """
        Probabilities of what sources may be: their nodes, (n, k), and points, (n,).

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
        galaxy = nodes[..., 0] - 0.5 * chi2 + np.log((1.0 - self.point) / nodes.shape[1])
        every = np.concatenate([galaxy, (points + np.log(self.point))[:, None]], axis=1)
        every = np.exp(every - every.max(axis=1, keepdims=True))
        every /= every.sum(axis=1, keepdims=True)
        return every[:, :-1], every[:, -1]

    def fitted(self, nodes, points, brightness):
        """
        The population that the sources are most probably from, by expectation and maximization.

        Each source counts with the whole of what it may be, so that the noise of single shapes does not widen the
        distribution; this one counts as some sources.
        """
        found = dataclasses.replace(self, middle=float(np.median(brightness)))
        x = np.stack([np.ones(len(nodes)), found.off(brightness)], axis=-1)
        shapes = nodes[..., 2:]
        for _ in range(_STEPS):
            weight, point = found.odds(nodes, points, brightness)
            total = weight.sum(axis=1)
            power = (x * total[:, None]).T @ x
            power += _WORTH * np.diag([1.0, 1.0 / _SLOPE**2])
            below = x.T @ np.einsum("nk,nkj->nj", weight, shapes[..., :2])
            below[0] += _WORTH * self.line[0]
            line = np.linalg.solve(power, below)
            z = shapes[..., :2] - (x @ line)[:, None]
            covariance = np.einsum("nk,nki,nkj->ij", weight, z, z) + _WORTH * self.covariance
            square = np.einsum("nk,nkj->", weight, shapes[..., 2:] ** 2) / 2
            n = total.sum() + _WORTH
            found = dataclasses.replace(
                found, line=line, covariance=covariance / n,
                ellipticity=float((square + _WORTH * self.ellipticity) / n),
                point=float((point.sum() + _WORTH * self.point) / (len(points) + _WORTH)),
            )  # fmt: skip
        return found
