"""
Photometry of which each band may be wrong: a mixture of the stated error and a broad one.

The likelihood of a flux F of a model m is (1 - p) N(F; m, sigma) + p N(F; m, Sigma), that of an upper limit
(1 - p) P + p with P the probability of the limit (Press 1997, in Unsolved Problems in Astrophysics; Hogg, Bovy &
Lang 2010, arXiv:1008.4686, section 3). Over the squared residual -2 ln of a flux's likelihood is concave, so that
its tangents are upper bounds, which are those of a Gaussian: ``chi2 <= w r^2 + constant`` with
w = (1 - q) / sigma^2 + q / Sigma^2 and q the share of the broad part where the tangent touches (Jaakkola & Jordan
2000, Stat. Comput. 10, 25). At every redshift it touches at a model that fits best with some bands wrong.
"""

import numpy as np
from scipy.special import expit, log_ndtr

from miricigale.filters import FilterSet
from miricigale.fitting import _core
from miricigale.fitting.data.likelihood import per_band
from miricigale.utils.options import check_that
from miricigale.utils.values import value_class

#: Smallest width of the broad part, in units of the stated error.
_MIN_BROAD_SIGMA = 10.0
#: Number of galaxies at each redshift among which the model at which the tangents touch is sought.
_N_GALAXIES = 64
#: Number of galaxies at the redshifts that matter.
_N_MORE_GALAXIES = 512
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)


@value_class
class BandMixture:
    """
    Prior fraction and place of each band.

    Parameters
    ----------
    part : `~numpy.ndarray`, shape (nb,)
        Prior fraction of wrong fluxes.
    order : `~numpy.ndarray` of int, shape (nb,)
        The bands by wavelength.
    """

    part: np.ndarray
    order: np.ndarray

    @classmethod
    def of_bands(cls, outliers, filters):
        """Make it of ``outliers`` of a fitter and its filters; None where there are none."""
        names = tuple(getattr(filters, "names", filters))
        part = {}
        if outliers is not None:
            part = per_band(outliers, names, "outliers")
        part = np.array(list(part.values()))
        check_that(np.all(part < 1), "outliers", "at least 0 and below 1", outliers)
        if not part.any():
            return None
        if isinstance(filters, FilterSet):
            filter_set = filters
        else:
            filter_set = FilterSet.from_names(names)
        return cls(part, np.argsort(filter_set.pivot.to_value("um"), kind="stable"))

    def broad(self, flux, sigma):
        """
        Compute the widths of the broad parts in uJy, infinite in bands without a flux: shape (n, nb).

        The larger, in quadrature, of 10 sigma and of the largest flux of the band and the measured ones next
        to it: data alone say it, and a flux of 0 between bright ones is wrong too.
        """
        out = np.full(np.shape(flux), np.inf)
        for i in range(len(flux)):
            measured = self.order[np.isfinite(sigma[i, self.order])]
            # largest flux of each band and its two neighbors by wavelength
            size = np.pad(np.abs(flux[i, measured]), 1)
            top = np.maximum(size[1:-1], np.maximum(size[:-2], size[2:]))
            out[i, measured] = np.hypot(_MIN_BROAD_SIGMA * sigma[i, measured], top)
        return out

    def log_likelihood(self, model, flux, sigma, broad, limit=None, limit_sigma=None):
        """
        Compute ln of the likelihood of models, and how likely each band is wrong for each.

        Parameters
        ----------
        model : `~numpy.ndarray`, shape (..., nb)
            Fluxes of models in uJy.
        flux, sigma, broad : `~numpy.ndarray`, shapes that broadcast with it
            Fluxes, errors (infinite where there is none) and widths of the broad parts.
        limit, limit_sigma : `~numpy.ndarray`, optional
            Upper limits and their errors, infinite where there is none.

        Returns
        -------
        log : `~numpy.ndarray`, shape (...)
            Of fluxes in units of their errors, without the factors of 2 pi: -chi2 / 2 without wrong bands.
        wrong : `~numpy.ndarray`, shape (..., nb)
            0 in bands without data.
        """
        measured = np.isfinite(sigma)
        with np.errstate(divide="ignore"):
            good, bad = self._log_parts(model, flux, sigma, broad)
            log = np.where(measured, np.logaddexp(good, bad), 0.0)
            wrong = np.where(measured, expit(bad - good), 0.0)
            if limit is not None:
                has_limit = np.isfinite(limit_sigma)
                # limits: (1 - p) P + p
                log_below = log_ndtr(np.where(has_limit, (limit - model) / limit_sigma, 0.0))
                good = np.log1p(-self.part) + log_below
                bad = np.log(self.part)
                log = np.where(has_limit, np.logaddexp(good, bad), log)
                wrong = np.where(has_limit, expit(bad - good), wrong)
        return log.sum(axis=-1), wrong

    def _log_parts(self, model, flux, sigma, broad):
        """
        Compute ln of (1 - p) N(F; m, sigma) and p N(F; m, Sigma), in units of the density with sigma.

        Arguments are those of `log_likelihood`; what stands in bands without data means nothing.
        """
        measured = np.isfinite(sigma)
        part = np.broadcast_to(self.part, measured.shape)
        narrow = np.where(measured, sigma, 1.0)
        wide = np.where(measured, broad, 1.0)
        square = np.where(measured, np.square(flux - model), 0.0)
        good = np.log1p(-part) - 0.5 * square / np.square(narrow)
        bad = np.log(part) - 0.5 * square / np.square(wide) + np.log(narrow / wide)
        return good, bad

    def shares(self, model, target, broad, limits, z, weight):
        """
        Compute how likely each band is wrong, shape (nb,), over models, (n, nb), at nodes ``z`` of redshift.

        ``weight``, shape (n,), are the weights of the models, which sum to 1.
        """
        with np.errstate(divide="ignore"):
            narrow = 1.0 / np.sqrt(target.weight[z])
            if limits is None:
                # the likelihoods, which take most of the time, are not asked for
                good, bad = self._log_parts(model, target.flux, narrow, broad)
                return weight @ np.where(np.isfinite(narrow), expit(bad - good), 0.0)
        limit = np.zeros(len(broad))
        limit_sigma = np.full(len(broad), np.inf)
        limit[limits.bands] = limits.level / limits.inverse
        limit_sigma[limits.bands] = 1.0 / limits.inverse
        _, wrong = self.log_likelihood(model, target.flux, narrow, broad, limit, limit_sigma)
        return weight @ wrong


@value_class
class Tangents:
    """
    Finds, for each object, the models at which the tangents touch.

    Parameters
    ----------
    bands : `BandMixture`
        The bands.
    tables : `~miricigale.fitting._core.Tables`
        The grid.
    galaxies : tuple of `~numpy.ndarray`
        Galaxies that are looked at: the first fields of ``Few``.
    """

    bands: BandMixture
    tables: tuple
    galaxies: tuple

    @classmethod
    def of_tables(cls, bands, tables):
        """Choose galaxies of every redshift, spread over all axes."""
        n_z, n_galaxy, n_bands = tables.galaxy.shape
        n_wide = -(-n_galaxy // _core.BLOCK) * _core.BLOCK
        # golden-ratio steps: any first few galaxies are spread over all axes
        order = np.argsort(np.arange(n_galaxy) * _GOLDEN % 1.0, kind="stable")
        index = np.zeros((n_z, n_wide), np.int64)
        flux = _core.aligned(n_z, n_bands, n_wide, dtype=np.float32)
        ratio = _core.aligned(n_z, tables.agn.shape[1], n_wide, dtype=np.float32)
        for z in range(n_z):
            usable = order[tables.log_usable[z, order] > -1e200]
            index[z, : usable.size] = usable
            flux[z, :, : usable.size] = tables.galaxy32[z][:, usable]
            size = tables.of_galaxy[0, usable] / tables.galaxy_unit[z, usable]
            ratio[z, :, : usable.size] = np.clip(size * tables.agn_unit[z, :, None], 0.0, 1e15)
        return cls(bands, tables, (index, flux, ratio))

    def touch(self, target, log_prior, sigma, broad, limit=None, limit_sigma=None):
        """
        Compute the weights of the tangents of one object.

        Parameters
        ----------
        target : `~miricigale.fitting._core.structs.Target`
            Its data with the stated errors.
        log_prior : `~numpy.ndarray`, shape (nz,)
            2 ln(prior) of the redshifts.
        sigma, broad : `~numpy.ndarray`, shape (nb,)
            Errors of fluxes, and widths of the broad parts.
        limit, limit_sigma : `~numpy.ndarray`, shape (nb,), optional
            Upper limits and their errors.

        Returns
        -------
        target : `~miricigale.fitting._core.structs.Target`
            The data with the tangents' errors.
        wrong : `~numpy.ndarray`, shape (nz, nb)
            How likely each band is wrong for the models at which they touch.
        """
        tables = self.tables
        bands = target.bands
        part = self.bands.part
        narrow_sigma = 1.0 / np.sqrt(np.take(target.weight, bands, axis=1))
        narrow = narrow_sigma / broad[bands]
        # odds of the broad part without a residual: p sigma / ((1 - p) Sigma)
        odds = part[bands] / (1.0 - part[bands]) * narrow
        n_z = len(log_prior)
        ratio = tables.of_frac[0]
        lowest = ratio.min(initial=1e9)
        if tables.zero_frac:
            lowest = 0.0
        ends = np.array([lowest, min(ratio.max(initial=0.0), 1e9)])
        index = np.full((n_z, 2), -1)
        scale = np.zeros((n_z, 2))
        # likelihoods are of fluxes in units of the errors without that of the templates
        rise = 2.0 * np.log(narrow_sigma / sigma[bands]).sum(axis=1)
        best_models = np.ones(odds.shape), np.zeros(n_z), index, scale
        n = self.galaxies[0].shape[1]
        sizes = np.array([min(_N_GALAXIES, n), min(_N_MORE_GALAXIES, n), n])
        galaxies = _core.make_few(*self.galaxies)
        _core.find_models(
            tables, target, galaxies, odds, narrow**2, rise - log_prior, ends, sizes, *best_models
        )
        model = scale[:, :1] * tables.galaxy[np.arange(n_z), np.maximum(index[:, 0], 0)]
        with_agn = np.flatnonzero(index[:, 1] >= 0)
        model[with_agn] += scale[with_agn, 1:] * tables.agn[with_agn, index[with_agn, 1]]
        square = np.square(target.flux - model)[:, bands]
        full = np.full((n_z, len(sigma)), np.inf)
        full[:, bands] = narrow_sigma
        log, wrong = self.bands.log_likelihood(model, target.flux, full, broad)
        if limit_sigma is not None:
            no_flux = np.full(sigma.shape, np.inf)
            _, wrong_limits = self.bands.log_likelihood(
                model, target.flux, no_flux, broad, limit, limit_sigma
            )
            wrong = wrong + wrong_limits
        weight = target.weight.copy()
        # w = (1 - q) / sigma^2 + q / Sigma^2 with q the share of the broad part
        weight[:, bands] *= 1.0 - wrong[:, bands] * (1.0 - narrow**2)
        # constant of the tangent, so that it touches at the model
        level = 2.0 * log - rise
        level += np.sum(weight[:, bands] * square, axis=1)
        return _core.weighed(target.flux, weight, level, log_prior, bands), wrong
