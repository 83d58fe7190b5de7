"""
Fluxes of points beside the totals of sources that are nothing but a point, as stars and little red dots.

The point has all of the light: in a band the total T and the point P measure the same flux, and D = P - T is 0
but for their errors. T and P of variances V_T and V_P and covariance c are the same data as D, of variance
V_D = V_P + V_T - 2 c, and T - k D with k = (c - V_T) / V_D, whose errors do not depend on those of D: the weighted
mean of T and P. (T, P) -> (T - k D, D) has the determinant 1, so that the likelihood of a model is that of the
mean times N(D; 0, V_D), which is the same for all models. V_P has the part of the flux that is added to the errors
of all nuclei, which PSFs are not better than; that of the total is added to the error of the mean.
"""

import numpy as np
from scipy.special import log_ndtr

from miricigale.fitting.data.likelihood import FitData
from miricigale.fitting.data.nuclei import COVARIANCE, FLUX, LIMIT, SIGMA
from miricigale.utils.values import value_class

#: Width of the broad part of a difference of which a flux may be wrong, in units of its error.
_WIDE = 10.0


@value_class
class WholePoints:
    """
    Photometry of n objects, their points being all of their light.

    Parameters
    ----------
    data : `~miricigale.fitting.data.likelihood.FitData`
        As it was measured.
    combined : `~miricigale.fitting.data.likelihood.FitData`
        With the means of totals and points in place of the totals.
    log_density, chi2 : `~numpy.ndarray`, shape (n,)
        Ln of the densities of what totals and points differ by, fluxes in uJy, and sum of its squares over the
        variances.
    n_points : `~numpy.ndarray` of int, shape (n,)
        Number of points.
    """

    data: FitData
    combined: FitData
    log_density: np.ndarray
    chi2: np.ndarray
    n_points: np.ndarray

    @classmethod
    def of_values(cls, data, values, bands, part):
        """
        Combine totals and points.

        Parameters
        ----------
        data : `~miricigale.fitting.data.likelihood.FitData`
            Photometry of n objects.
        values : `~numpy.ndarray`, shape (n, n_points, 4)
            As of `~miricigale.fitting.data.nuclei.read_nuclei`.
        bands : list of int
            Bands of the points.
        part : `~numpy.ndarray`, shape (nb,)
            Prior fraction of wrong fluxes of each band.
        """
        n = len(data)
        flux = np.array(data.flux)
        sigma = np.array(data.sigma)
        limit = np.array(data.limit)
        log_density = np.zeros(n)
        chi2 = np.zeros(n)
        for j, band in enumerate(bands):
            point = values[:, j]
            usable = np.isfinite(point[:, SIGMA])
            limited = usable & (point[:, LIMIT] > 0)
            measured = usable & ~limited
            total_limited = data.limit[:, band]
            is_paired = measured & ~total_limited
            mean, mean_sigma, difference, error = _mean(point[is_paired], data, is_paired, band)
            flux[is_paired, band] = mean
            sigma[is_paired, band] = mean_sigma
            wide = np.hypot(_WIDE * error, point[is_paired, FLUX])
            log_density[is_paired] += np.logaddexp(
                _log(1.0 - part[band]) + _log_normal(difference, error),
                _log(part[band]) + _log_normal(difference, wide),
            )
            chi2[is_paired] += np.square(difference / error)
            # a flux takes the place of a limit, which it keeps or not
            below = measured & total_limited
            apart = data.flux[below, band] - point[below, FLUX]
            width = np.hypot(data.sigma[below, band], point[below, SIGMA])
            log_density[below] += _log_limit(apart / width, part[band])
            flux[below, band] = point[below, FLUX]
            sigma[below, band] = point[below, SIGMA]
            limit[below, band] = False
            above = limited & ~total_limited
            apart = point[above, FLUX] - data.flux[above, band]
            width = np.hypot(point[above, SIGMA], data.flux_err[above, band])
            log_density[above] += _log_limit(apart / width, part[band])
            # of two limits the lower one
            lower = limited & total_limited & (point[:, FLUX] < data.flux[:, band])
            flux[lower, band] = point[lower, FLUX]
            sigma[lower, band] = point[lower, SIGMA]
        combined = data._changed(flux=flux, sigma=sigma, limit=limit)
        n_points = np.isfinite(values[:, :, SIGMA]).sum(axis=1)
        return cls(data, combined, log_density, chi2, n_points)

    def put_into(self, results):
        """
        Put the totals as they were measured, and the likelihood of the points, into results.

        Parameters
        ----------
        results : `~miricigale.fitting.FitResults`
            Of a fit of ``combined``.

        Returns
        -------
        results : `~miricigale.fitting.FitResults`
        """
        # errors of models that the fit added are kept
        added = np.zeros(self.data.flux.shape)
        fitted = np.isfinite(results.sigma) & np.isfinite(self.combined.sigma)
        added[fitted] = np.square(results.sigma[fitted]) - np.square(self.combined.sigma[fitted])
        added = np.where(self.data.measured, np.maximum(added, 0.0), 0.0)
        return results._changed(
            flux=self.data.flux,
            sigma=np.sqrt(np.square(self.data.sigma) + added),
            limit=self.data.limit,
            n_bands=results.n_bands + self.n_points,
            chi2=results.chi2 + self.chi2,
            log_evidence=results.log_evidence + self.log_density,
        )


def _mean(point, data, rows, band):
    """Calculate the mean of totals and points and its error, and their difference and its error: four (n,)."""
    total = data.flux[rows, band]
    total_variance = np.square(data.flux_err[rows, band])
    covariance = point[:, COVARIANCE]
    difference = point[:, FLUX] - total
    variance = np.square(point[:, SIGMA]) + total_variance - 2.0 * covariance
    share = (covariance - total_variance) / variance
    mean = total - share * difference
    mean_variance = total_variance - share * (covariance - total_variance)
    # the errors of models and the error floors are those of the total
    added = np.square(data.sigma[rows, band]) - total_variance
    mean_sigma = np.sqrt(mean_variance + np.maximum(added, 0.0))
    return mean, mean_sigma, difference, np.sqrt(variance)


def _log(part):
    """Calculate ln of a part, -inf of 0."""
    with np.errstate(divide="ignore"):
        return np.log(part)


def _log_normal(value, sigma):
    """Calculate ln of the normal density of mean 0."""
    return -0.5 * np.square(value / sigma) - np.log(sigma) - 0.5 * np.log(2.0 * np.pi)


def _log_limit(apart, part):
    """Calculate ln of the probability of a limit that lies so many errors above; a ``part`` of limits is wrong."""
    return np.logaddexp(_log(1.0 - part) + log_ndtr(apart), _log(part))
