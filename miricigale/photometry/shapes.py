"""Which shape the light of a source has: fits of a point and of a Sersic profile, and their evidence."""

import dataclasses
import functools

import numpy as np
import scipy.fft

from miricigale.photometry._core.sampling import box_response
from miricigale.photometry._core.shapes import INDEX_RANGE, shape_curves, shape_models
from miricigale.photometry.cutouts import Cutout
from miricigale.photometry.population import Population
from miricigale.profiles import sersic_stamp

#: Width (pixels) of the offset of the center from the position.
_OFFSET = 0.7

#: Nodes that a shape's probability is summed over, and the width of their density over that of the
#: normal distribution about the best shape.
_NODES, _WIDER = 32, 1.15

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

#: Half-width (pixels) of the stamps, least and most, and in half-light radii; size of the transform
#: over that of the stamp.
_HALF, _MOST, _REACH, _PERIOD = 16, 48, 4.0, 1.8

#: Part of a PSF's light below which frequencies are left out.
_PASSED = 1e-5


@dataclasses.dataclass(frozen=True, eq=False)
class Shape:
    """A profile that was fitted."""

    flux: float  # Total light.
    parameters: np.ndarray  # (6,): As for `~miricigale.photometry._core.shapes.shape_models`.
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
        values = self.nodes[:, 1:]
        mean = odds @ values
        off = values - mean
        found = (off * odds[:, None]).T @ off
        # noise of the flux of each shape
        found[0, 0] += 1.0 / np.linalg.inv(self.covariance)[0, 0]
        covariance, keep = np.zeros((7, 7)), [0, 3, 4, 5, 6]
        covariance[1:3, 1:3] = self.covariance[1:3, 1:3]
        covariance[np.ix_(keep, keep)] = found
        parameters = np.concatenate([self.parameters[:2], mean[1:]])
        return dataclasses.replace(
            self,
            flux=float(np.exp(mean[0])),
            parameters=parameters,
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


class ShapeModels:
    """Draws light through a PSF, odd and centered."""

    def __init__(self, psf):
        self._psf = np.asarray(psf, float)
        #: Half-width of the PSF (pixels).
        self.reach = self._psf.shape[0] / 2
        self._transforms, self._waves = {}, {}

    def _transform(self, size):
        if size not in self._transforms:
            padded = np.zeros((size, size))
            middle = self._psf.shape[0] // 2
            half = min(middle, size // 2 - 1)
            cut = self._psf[middle - half : middle + half + 1, middle - half : middle + half + 1]
            padded[: 2 * half + 1, : 2 * half + 1] = cut
            shifted = np.roll(padded, (-half, -half), axis=(0, 1))
            self._transforms[size] = scipy.fft.rfft2(shifted)
        return self._transforms[size]

    def profiles(self, shape, parameters, derivatives=0):
        """
        A Sersic profile of unit light and its derivatives on a stamp, (1 + derivatives, *shape).

        Parameters are those of `~miricigale.photometry._core.shapes.shape_models`.
        """
        size = _period(shape)
        psf = self._transform(size)
        return shape_models(psf, size, shape, parameters, derivatives=derivatives)

    def waves(self, shape):
        """The `Waves` of a stamp."""
        period = _period(shape)
        if period not in self._waves:
            self._waves[period] = Waves(self._transform(period), period)
        return self._waves[period]

    def convolve(self, images, origin, shape):
        """
        Bring light, (n, h, w), that is integrated over pixels to the resolution of the image, (n, *shape).

        ``origin`` is the row and column of its corner on the stamp; what is far from the stamp does not count.
        """
        size = _period(shape)
        rims = [(size - n) // 2 for n in shape]
        padded = np.zeros((len(images), size, size), np.float32)
        to, of = [slice(None)], [slice(None)]
        for rim, begin, n in zip(rims, origin, images.shape[1:], strict=True):
            low, high = max(begin + rim, 0), min(begin + rim + n, size)
            to.append(slice(low, high))
            of.append(slice(low - begin - rim, high - begin - rim))
        padded[tuple(to)] = images[tuple(of)]
        # the samples of the PSF are integrated over pixels too
        response = self._transform(size) / box_response((size, size), np.eye(2))
        spectra = scipy.fft.rfft2(padded) * response.astype(np.complex64)
        found = scipy.fft.irfft2(spectra, s=(size, size), overwrite_x=True)
        return found[:, rims[0] : rims[0] + shape[0], rims[1] : rims[1] + shape[1]]


class Waves:
    """The frequencies that a PSF lets pass, on a square of ``period`` pixels."""

    def __init__(self, psf, period):
        self._period = period
        self._use = np.abs(psf) > _PASSED * np.abs(psf[0, 0])
        ky, kx = np.nonzero(self._use)
        self._psf = psf[self._use]
        #: Frequencies, rad per pixel, shape (m,), and what their squares count in the sum over all pixels.
        self.kx = 2 * np.pi * np.fft.rfftfreq(period)[kx]
        self.ky = 2 * np.pi * np.fft.fftfreq(period)[ky]
        twice = np.where((kx == 0) | (2 * kx == period), 1.0, 2.0)
        self.weight = twice * np.abs(self._psf) ** 2 / period**2

    def power(self, curve):
        """Sum of squares of the pixels of a transform."""
        return np.sum(self.weight * curve**2)

    def images(self, curves, xy, shape):
        """Pixels of transforms, (n, m), about a place of a stamp: (n, *shape), in their precision."""
        moved = self._psf * np.exp(-1j * (self.kx * xy[0] + self.ky * xy[1]))
        single = curves.dtype == np.float32
        spectra = np.zeros((len(curves), *self._use.shape), np.complex64 if single else complex)
        spectra[:, self._use] = curves * moved.astype(spectra.dtype)
        images = scipy.fft.irfft2(spectra, s=(self._period,) * 2, overwrite_x=True)
        return images[:, : shape[0], : shape[1]]


class ShapeFitter(ShapeModels):
    """Fits light profiles through the PSF of an image of ``scale`` arcsec per pixel."""

    def __init__(self, psf, scale):
        super().__init__(psf)
        self._log_scale = np.log(scale)

    def fit(self, data, weight, xy, population=None, start=None):
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

        Returns
        -------
        shape : `Shape` or None
            None where no profile of positive light fits.
        """
        population = population or self.expected
        mean = np.concatenate([xy, population.mean])
        precision = np.diag([_OFFSET**-2] * 2 + [0.0] * 4)
        precision[2:, 2:] = np.linalg.inv(population.spread)
        half = _HALF if start is None else _half_width(start.parameters)
        inner = self._stamp(data, weight, mean, half)
        if start is None:
            starts = [mean + [0, 0, step, 0, 0, 0] for step in _STARTS]
            parameters = min(starts, key=lambda one: _misfit(one, inner))
        else:
            parameters = start.parameters
        extended = _minimum(inner, parameters, mean, precision)
        if extended is not None and start is None and _half_width(extended[1]) > half:
            inner = self._stamp(data, weight, mean, _half_width(extended[1]))
            extended = _minimum(inner, extended[1], mean, precision)
        if extended is None:
            return None
        flux, parameters, evidence, covariance = extended
        nodes = inner.nodes(parameters, covariance[3:, 3:], mean)
        start = parameters.copy()
        start[2] = -30.0
        as_point = -np.inf
        # a point that is far worse in the same place need not be moved to the best one
        if _misfit(start, inner) < -2 * evidence + _FAR_BELOW:
            point = _minimum(inner, start, mean, precision[:2, :2])
            if point is not None:
                as_point = point[2] - np.log(point[0])
        shape = Shape(flux, parameters, 0.0, covariance, nodes, as_point)
        return shape.among(*(one[0] for one in population.odds(nodes[None], np.array([as_point]))))

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

    def _stamp(self, data, weight, mean, half):
        """The pixels within ``half`` of the middle."""
        x, y = (round(float(c)) for c in mean[:2])
        y0, x0 = max(y - half, 0), max(x - half, 0)
        cut = np.s_[y0 : y + half + 1, x0 : x + half + 1]
        shape = weight[cut].shape
        use = np.flatnonzero(weight[cut])

        def models(parameters, derivatives):
            shifted = np.array(parameters)
            shifted[:2] -= [x0, y0]
            return self.profiles(shape, shifted, derivatives)

        inverse = weight[cut].ravel()[use]

        def curves(xy, shapes):
            waves = self.waves(shape)
            found = shape_curves(waves.kx, waves.ky, shapes).astype(np.float32)
            return waves.images(found, np.asarray(xy) - [x0, y0], shape)

        return _Stamp(models, curves, use, inverse, data[cut].ravel()[use] * inverse, max(shape))


@dataclasses.dataclass(frozen=True, eq=False)
class _Stamp:
    models: object
    curves: object
    use: np.ndarray
    inverse: np.ndarray
    white: np.ndarray
    size: int

    def whitened(self, images):
        return images.reshape(len(images), -1)[:, self.use] * self.inverse

    def nodes(self, parameters, covariance, mean):
        """Shapes about the best as `Population.odds` takes them: likelihood over density, flux, shape."""
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
        power, below = (
            np.einsum("kp,kp->k", columns[:, 0], columns[:, 0]),
            columns[:, 0] @ self.white,
        )
        seen = below > 0
        flux = np.where(seen, below, 1.0) / power
        # flux and center that are best for each, and the volume of what is possible
        columns[:, 1:] *= flux[:, None, None]
        matrix = columns @ columns.transpose(0, 2, 1)
        matrix[:, [1, 2], [1, 2]] += _OFFSET**-2
        residual = self.white - flux[:, None] * columns[:, 0]
        off = np.append(0.0, parameters[:2] - mean[:2])
        slope = np.einsum("kcp,kp->kc", columns, residual) - off * _OFFSET**-2
        step = np.linalg.solve(matrix, slope[..., None])[..., 0]
        chi2 = np.einsum("kp,kp->k", residual, residual) + off @ off * _OFFSET**-2
        chi2 -= np.einsum("kc,kc->k", slope, step)
        volume = np.linalg.slogdet(matrix)[1] + 4 * np.log(_OFFSET)
        density = (
            -0.5 * np.sum(z * z, axis=1) - np.sum(np.log(np.diag(root))) - 2 * np.log(2 * np.pi)
        )
        # of a distribution that is flat in ln flux
        log_flux = np.log(np.maximum(flux + step[:, 0], 0.1 * flux))
        like = -0.5 * (chi2 + volume) - log_flux - density
        return np.column_stack([np.where(seen, like, -1e9), np.where(seen, log_flux, 0.0), shapes])


def _half_width(parameters):
    """Half-width of the stamp that a profile is fitted on."""
    reach = np.exp(parameters[2] + 0.5 * np.hypot(*parameters[4:]))
    return int(np.clip(np.ceil(_REACH * reach), _HALF, _MOST))


def _period(shape):
    """Size of the transform: light that leaves the period on one side comes in on the other."""
    return scipy.fft.next_fast_len(int(_PERIOD * max(shape)), True)


def _misfit(parameters, stamp):
    """Chi^2 of a profile with the light that fits best."""
    (scaled,) = stamp.whitened(stamp.models(parameters, 0))
    power = scaled @ scaled
    flux = (scaled @ stamp.white) / power if power > 0 else 0.0
    return float(np.sum((stamp.white - flux * scaled) ** 2))


def _minimum(stamp, start, mean, precision):
    """
    Levenberg-Marquardt for the light and the first parameters, with Gaussian priors.

    Flux, parameters, evidence (Laplace's, without the light's prior) and covariance of ln flux and the free
    parameters; None if nothing is found.
    """
    n_free = len(precision)
    free = slice(0, n_free)
    low = np.array([-np.inf, -np.inf, np.log(0.05), np.log(INDEX_RANGE[0]), -2.0, -2.0])
    high = np.array([np.inf, np.inf, np.log(stamp.size), np.log(INDEX_RANGE[1]), 2.0, 2.0])

    def at(parameters):
        columns = stamp.whitened(stamp.models(parameters, n_free))
        power = columns[0] @ columns[0]
        flux = (columns[0] @ stamp.white) / power if power > 0 else 0.0
        z = stamp.white - flux * columns[0]
        off = (parameters - mean)[free]
        chi2 = z @ z + off @ precision @ off
        columns[1:] *= flux
        return parameters, columns, flux, z, chi2

    def curvature(columns):
        matrix = columns @ columns.T
        matrix[1:, 1:] += precision
        return matrix

    best = at(start.copy())
    damping = 1e-2
    for _ in range(_STEPS):
        parameters, columns, _, z, chi2 = best
        matrix = curvature(columns)
        slope = columns @ z
        slope[1:] -= precision @ (parameters - mean)[free]
        gained = 0.0
        while damping < 1e6:
            damped = matrix + np.diag(damping * np.diag(matrix))
            try:
                step = np.linalg.solve(damped, slope)
            except np.linalg.LinAlgError:
                return None
            trial = parameters.copy()
            trial[free] += np.clip(step[1:], -1.0, 1.0)
            trial[free] = np.clip(trial[free], low[free], high[free])
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
    if not (sign > 0 and np.isfinite(chi2) and flux > 0):
        return None
    evidence = -0.5 * (chi2 + log_det - np.linalg.slogdet(precision)[1])
    covariance = np.linalg.inv(matrix)
    covariance[0] /= flux
    covariance[:, 0] /= flux
    return flux, parameters, evidence, covariance
