"""The grid engine: every model of a `~miricigale.sed.ModelGrid`, by factors."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from miricigale.fitting import _core
from miricigale.fitting.engines.layout import make_tables
from miricigale.fitting.engines.output import GridOutput
from miricigale.utils.exceptions import argument_error

__all__ = ["GridEngine"]

#: Runs of up to 64 pairs listed at once by one worker (260 bytes each).
_CAPACITY = 1 << 16
#: Part of ``rtol`` that the weight of what is left out may have.
_SAFETY = 0.1
#: How much more than its weight a model may add to second moments without being looked at twice.
_TAIL = 10.0
#: Part of ``rtol`` times its share below which a pair adds nothing to the scatter of fluxes.
_THIN = 1e-4
#: Least ``rtol`` with which pairs of little weight are evaluated in single precision.
_SINGLE = 5e-7


@dataclass(frozen=True, eq=False, repr=False)
class GridEngine:
    """
    Posterior of many objects over a factorised model grid.

    Parameters
    ----------
    galaxy : `~numpy.ndarray`, shape (nz, nG, nb)
        Galaxy fluxes in uJy for each solar mass formed.
    agn : `~numpy.ndarray`, shape (nz, nA, nb)
        AGN fluxes in uJy for each W of AGN power; nA may be 0.
    dust : `~numpy.ndarray`, shape (nG,)
        Dust luminosity in W for each solar mass formed.
    frac : `~numpy.ndarray`, shape (nf,)
        AGN fractions, ascending.
    usable : `~numpy.ndarray` of bool, shape (nz, nG)
        Models that may be used.
    prior_galaxy, prior_agn, prior_frac : `~numpy.ndarray`
        Prior weights of galaxy models, tori and fractions.
    galaxy_scale, agn_scale : `~numpy.ndarray`, shapes (n_qg, nG) and (n_qa, nA)
        Derived quantities for each solar mass formed and for each W.
    mixed_galaxy, mixed_agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        Parts of galaxy and torus in one quantity that is the sum of both.
    levels : `~numpy.ndarray`
        Ascending levels of the quantiles of derived quantities.
    share_galaxy, share_agn : `~numpy.ndarray`, shapes (nG,) and (nA,), optional
        The AGN fraction in another definition is y / (1 + y), y the product of f / (1 - f) and
        both.
    rtol : float
        Relative error that pruning may cause. The weight of what is left out is bounded to a
        tenth of it, and what it could add to the variance of any derived quantity to
        ``rtol``, so that those with a long tail hold it too. (The standard deviation of an AGN's
        quantity below a thousandth of the mean total luminosity is held to a part of the latter.)
        From 5e-7 on, pairs of little weight are evaluated in single precision, in which a weight
        is good to some 1e-7.
    scale_error : bool
        Whether the variance of each model's own scale is part of the posterior.
    """

    galaxy: np.ndarray
    agn: np.ndarray
    dust: np.ndarray
    frac: np.ndarray
    usable: np.ndarray
    prior_galaxy: np.ndarray
    prior_agn: np.ndarray
    prior_frac: np.ndarray
    galaxy_scale: np.ndarray
    agn_scale: np.ndarray
    mixed_galaxy: np.ndarray
    mixed_agn: np.ndarray
    levels: np.ndarray
    share_galaxy: np.ndarray | None = None
    share_agn: np.ndarray | None = None
    rtol: float = 1e-6
    scale_error: bool = True

    @property
    def n_models(self):
        """Number of different models that are evaluated or bounded."""
        n_row = int(np.count_nonzero(self.usable))
        n_zero = int(self.frac[0] == 0.0)
        return n_row * (n_zero + self.agn.shape[1] * (self.frac.size - n_zero))

    @property
    def n_quantities(self):
        """Number of derived quantities: the galaxy's, the torus's and the sum of both."""
        return self.galaxy_scale.shape[0] + self.agn_scale.shape[0] + 1

    @property
    def delta(self):
        """How far 2 ln(posterior) of a model may lie below the best: 2 ln(100 n_models / rtol)."""
        if self.rtol == 0:
            return 1e9
        return 2.0 * np.log(max(self.n_models, 1) * _TAIL / (_SAFETY * self.rtol))

    @cached_property
    def _tables(self):
        return make_tables(self)

    def workspace(self, n_draws=0, joint=()):
        """Make the accumulators and work space of one worker (some tens of MB)."""
        n_z, n_galaxy, n_bands = self.galaxy.shape
        size = (n_z, n_galaxy, self.agn.shape[1], self.frac.size, n_bands)
        return _core.make_sums(*size, n_draws, joint), _core.make_scratch(
            *size, self.n_quantities, int(self.frac[0] == 0.0), _CAPACITY
        )

    def fit(
        self,
        flux,
        sigma,
        log_prior,
        *,
        limit=None,
        limit_sigma=None,
        n_draws=0,
        seeds=None,
        joint=(),
        workspace=None,
    ):
        """
        Fit objects.

        Parameters
        ----------
        flux, sigma : `~numpy.ndarray`, shape (n, nb)
            Fluxes and errors in uJy; bands with infinite sigma are not used.
        log_prior : `~numpy.ndarray`, shape (n, nz)
            ln(prior) of the redshifts, -inf where it is 0; rows of -inf are not fitted.
        limit, limit_sigma : `~numpy.ndarray`, shape (n, nb), optional
            Upper limits and their errors in uJy; bands with infinite error have none. A band has
            a flux or a limit, not both.
        n_draws : int, optional
            Number of models to draw from each posterior; see `draw`.
        seeds : `~numpy.ndarray` of int, shape (n,), optional
            Seeds of the draws.
        joint : tuple of str, optional
            Joint posteriors to return as well: ``"zg"``, ``"zk"``, ``"gk"``, ``"fg"``, ``"fk"``
            with z redshift, g galaxy, k torus, f AGN fraction.
        workspace : tuple, optional
            What `workspace` returned for this ``n_draws`` and ``joint``, for use by one thread at
            a time; made if not given.

        Returns
        -------
        out : `GridOutput`

        Raises
        ------
        ValueError
            If there are limits in a band in which a model has negative flux.
        """
        n_z, n_galaxy, n_bands = self.galaxy.shape
        n_agn, n_frac = self.agn.shape[1], self.frac.size
        n = flux.shape[0]
        weight = 1.0 / np.square(sigma)
        data = np.where(weight > 0, flux, 0.0)
        inverse = np.zeros((n, n_bands)) if limit_sigma is None else 1.0 / limit_sigma
        limit = np.where(inverse > 0, 0.0 if limit is None else limit, 0.0)
        negative = np.flatnonzero((inverse > 0).any(axis=0) & self._negative)
        if negative.size:
            wanted = "in bands in which no model has negative flux"
            raise argument_error("limit", wanted, f"limits in band {int(negative[0])}")
        log_prior = np.where(np.isfinite(log_prior), 2.0 * log_prior, -1e300)
        seeds = np.zeros(n, np.uint64) if seeds is None else np.array(seeds, np.uint64)
        n_quantities, n_levels = self.n_quantities, self.levels.size
        size = {"z": n_z, "g": n_galaxy, "k": n_agn, "f": n_frac}
        out = GridOutput(
            chi2=np.full(n, np.nan),
            log_sum=np.full(n, np.nan),
            n_models=np.zeros(n),
            best_scale=np.full(n, np.nan),
            index=np.full((n, 4), -1),
            zf=np.full((n, n_z, n_frac), np.nan),
            galaxy=np.full((n, n_galaxy), np.nan),
            agn=np.full((n, n_agn), np.nan),
            band=np.full((n, 2, n_bands), np.nan),
            moments=np.full((n, n_quantities, 3), np.nan),
            quantiles=np.full((n, n_quantities, n_levels), np.nan),
            share=np.full((n, 2), np.nan),
            share_quantiles=np.full((n, n_levels), np.nan),
            draw_index=np.full((n, n_draws, 4), -1),
            draw_scale=np.full((n, n_draws, 2), np.nan),
            joint={name: np.full((n, size[name[0]], size[name[1]]), np.nan) for name in joint},
        )
        sums, scratch = self.workspace(n_draws, joint) if workspace is None else workspace
        tables, request, single = self._tables, self._request, self.rtol >= _SINGLE
        for i in np.flatnonzero(log_prior.max(axis=1, initial=-1e300) > -1e200):
            target = _target(data[i], weight[i], log_prior[i])
            limits = _limits(limit[i], inverse[i])
            sums.draws.state[0] = seeds[i]
            _core.clear(sums)
            if target.norm > 0.0 and _core.sum_up(
                tables, request, target, limits, sums, scratch, single
            ):
                self._summarise(target, limits, sums, out, i)
        return out

    def _summarise(self, target, limits, sums, out, i):
        """Fill row i of the output."""
        total, tables = sums.total[0], self._tables
        z, g, k, f = out.index[i] = sums.index
        scale = out.best_scale[i] = sums.best[1]
        model = scale * self.galaxy[z, g]
        if self.frac[f] > 0:
            power = scale * self.dust[g] * self.frac[f] / (1.0 - self.frac[f])
            model = model + power * self.agn[z, k]
        # from the residuals: |F|^2_w - R would lose digits
        chi2 = np.sum(target.weight * (target.flux - model) ** 2)
        norm = target.norm
        if limits is not None:
            faint = limits.level - model[limits.bands] * limits.inverse
            chi2 -= 2.0 * log_ndtr(faint).sum()
            norm += limits.dark
        out.chi2[i] = chi2
        out.log_sum[i] = np.log(total) + 0.5 * (sums.best[2] - norm)
        out.n_models[i] = sums.best[3]
        # sums in single precision differ by some 1e-8
        out.zf[i] = sums.zf / sums.zf.sum()
        out.galaxy[i] = sums.galaxy[:, 0] / sums.galaxy[:, 0].sum()
        # without AGN the data say nothing on the torus: its prior
        prior = tables.prior_agn
        if prior.size:
            agn = sums.agn[:, 0] + sums.alone.sum() * prior
            out.agn[i] = agn / agn.sum()
        mean, square = sums.band / total
        out.band[i] = mean, np.sqrt(np.maximum(square - mean * mean, 0.0))
        _core.summarise(
            tables,
            self._request,
            sums,
            out.moments[i],
            out.quantiles[i],
            out.share[i],
            out.share_quantiles[i],
        )
        out.draw_index[i] = sums.draws.index
        out.draw_scale[i] = sums.draws.scale
        for name, table in out.joint.items():
            table[i] = getattr(sums, name)
            if name == "zk" and tables.zero_frac:
                table[i] += sums.zf[:, :1] * prior
            elif name == "gk":
                table[i] += sums.alone[:, None] * prior
            elif name == "fk" and tables.zero_frac:
                table[i, 0] += sums.alone.sum() * prior
            table[i] /= table[i].sum()

    def draw(self, flux, sigma, log_prior, n_draws, seeds, *, limit=None, limit_sigma=None):
        """
        Draw models from the posteriors, exactly and independently.

        Parameters
        ----------
        flux, sigma, log_prior, limit, limit_sigma : `~numpy.ndarray`
            As in `fit`.
        n_draws : int
            Number of draws for each object.
        seeds : `~numpy.ndarray` of int, shape (n,)
            Each object's seed: its draws depend on nothing else but its data.

        Returns
        -------
        index : `~numpy.ndarray` of int, shape (n, n_draws, 4)
            Redshift, galaxy, torus and AGN fraction; -1 for objects that could not be fitted.
            Where the fraction is 0 the torus is one drawn from the prior.
        scale : `~numpy.ndarray`, shape (n, n_draws)
            Solar masses formed: with ``scale_error`` drawn from the Gaussian about the model's
            best scale, as far as it is positive.
        """
        out = self.fit(
            flux,
            sigma,
            log_prior,
            limit=limit,
            limit_sigma=limit_sigma,
            n_draws=n_draws,
            seeds=seeds,
        )
        index, scale = out.draw_index, out.draw_scale[:, :, 0]
        prior = self.prior_agn / self.prior_agn.sum() if self.agn.shape[1] else np.ones(1)
        for i in np.flatnonzero(np.isfinite(out.chi2)):
            rng = np.random.default_rng(int(seeds[i]))
            torus = rng.choice(prior.size, size=n_draws, p=prior)
            index[i, :, 2] = np.where(index[i, :, 2] < 0, torus, index[i, :, 2])
            if self.scale_error:
                error = np.sqrt(out.draw_scale[i, :, 1])
                low = ndtr(-scale[i] / error)
                uniform = 1.0 - rng.random(n_draws)
                scale[i] += error * ndtri(low + (1.0 - low) * uniform)
        return index, scale

    @cached_property
    def _request(self):
        return _core.Request(
            delta=float(self.delta),
            rtol=_SAFETY * self.rtol,
            tail=_TAIL,
            thin=_THIN * self.rtol,
            scale_error=float(self.scale_error),
            levels=self.levels.copy(),
        )

    @cached_property
    def _negative(self):
        """Bands in which a model has negative flux."""
        negative = np.any(self.galaxy < 0, axis=(0, 1))
        return negative | np.any(self.agn < 0, axis=(0, 1))

    def __getstate__(self):
        # the prepared tables are made again by whoever unpickles
        hidden = ("_tables", "_request", "_negative")
        return {name: value for name, value in self.__dict__.items() if name not in hidden}


def _target(flux, weight, log_prior):
    """Bundle the data of one object."""
    return _core.Target(
        flux=flux,
        weight=weight,
        log_prior=log_prior,
        bands=np.flatnonzero(weight > 0),
        norm=float(np.sum(weight * flux * flux)),
    )


def _limits(limit, inverse):
    """Bundle the upper limits of one object; None if it has none."""
    bands = np.flatnonzero(inverse > 0)
    if bands.size == 0:
        return None
    level = limit[bands] * inverse[bands]
    return _core.Limits(
        bands=bands,
        level=level,
        inverse=inverse[bands],
        dark=float(-2.0 * log_ndtr(level).sum()),
    )
