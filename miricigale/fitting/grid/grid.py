"""The grid engine: every model of a `~miricigale.sed.ModelGrid`, by factors."""

from collections import namedtuple
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr, logsumexp, ndtr, ndtri

from miricigale.fitting import _core
from miricigale.fitting.grid.mixture import BandMixture, Tangents
from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.priors import GridPriors
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS, Quantities
from miricigale.sed import ModelGrid
from miricigale.utils.package_tables import declared
from miricigale.utils.units import Frozen
from miricigale.utils.values import value_class

#: Runs of up to 64 pairs listed at once by one worker (260 bytes each).
_CAPACITY = 1 << 16
#: Part of ``rtol`` that the weight of what is left out may have.
_SAFETY = 0.1
#: How much more than its weight a model may add to second moments without being looked at twice.
_TAIL = 10.0
#: Part of ``rtol`` times its share below which a pair adds nothing to the scatter of fluxes.
_THIN = 1e-4
#: Smallest ``rtol``, unless it is 0, of fits with wrong bands.
_MIN_MIXTURE_RTOL = 1e-3
#: Best chi2 over the number of bands above which nodes are too coarse for the errors of the data.
_MAX_EXCESS = 2.0
#: Smallest ``rtol`` with which pairs of little weight are evaluated in single precision.
_SINGLE = 5e-7
#: Smallest variance of a scale.
_MIN_VARIANCE = 1e-290


#: What a fit of n objects returns, by the axes of each array after that of the objects.
_AXES = declared("miricigale.fitting", "columns.toml")["arrays"]
#: These arrays, not a number or -1 in rows that were not fitted; ``joint`` are joint posteriors that were
#: asked for, by two of the letters z, g, k and f.
GridOutput = namedtuple("GridOutput", list(_AXES) + ["joint"])
#: What the posterior between nodes begins with: draws on the nodes, redshift, galaxy, AGN model and fraction,
#: shape (n_draws, 4); the posterior of redshift and AGN fraction, (nz, nf); whether both are of larger errors; and
#: ln of the weights that draws of another density need, (n_draws,), else None.
Start = namedtuple("Start", "index zf larger_errors log_weight", defaults=(None,))
#: What a fit says of an object: its row; `Target` and `Limits` (or None); 2 ln(prior) of galaxies, (nz, nG), or
#: None where it is that of all objects; if bands may be wrong its data with stated errors, these errors and the
#: broad ones, (nb,), else None; its `Start`; ln of the factor that keeps the sum of the priors with those of mass;
#: and the constant of the sum of prior exp(-chi2 / 2).
ObjectOnNodes = namedtuple(
    "ObjectOnNodes", "row target limits log_usable wrong start log_norm zero"
)


@value_class(repr=False)
class GridEngine(Frozen):
    """
    Posterior of many objects over a factorized model grid.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    priors : `~miricigale.fitting.posterior.priors.GridPriors`
        Prior weights of its models.
    quantities : `~miricigale.fitting.posterior.quantities.Quantities`
        What is derived from them.
    galaxy, agn : `~numpy.ndarray`, shapes (nz, nG, nb) and (nz, nA, nb)
        Their fluxes, in uJy for each solar mass formed and for each W of AGN power: those of the grid, or
        at another redshift than its own.
    usable : `~numpy.ndarray` of bool, shape (nz, nG)
        Galaxies that may be used.
    template_error : `~numpy.ndarray`, shape (nz, nb)
        Part of a flux that is added to its error in quadrature at each redshift; what this does to the
        normalization of the likelihood is part of the weights.
    mass_prior : callable, optional
        Of solar masses formed, shape (n, nG), and the n redshifts they are at, as indices: ln of a factor of
        the priors of galaxies. Taken at the mass that each galaxy has without AGN, for each object.
    density : `~miricigale.fitting.posterior.populations.MassPrior`, optional
        Prior of mass and redshift, at the same masses.
    rtol : float
        Relative error that pruning may cause. The weight of what is left out is bounded to a
        tenth of it, and what it could add to the variance of any derived quantity to
        ``rtol``, so that those with a long tail hold it too. (The standard deviation of an AGN's
        quantity below a thousandth of the mean total luminosity is accurate to a part of the latter.)
        From 5e-7 on, pairs of little weight are evaluated in single precision, in which a weight
        is good to some 1e-7.
    scale_error : bool
        Whether the variance of each model's own scale is part of the posterior.
    mixture : `~miricigale.fitting.grid.mixture.BandMixture`, optional
        Prior fractions of wrong fluxes.
    """

    grid: ModelGrid
    priors: GridPriors
    quantities: Quantities
    galaxy: np.ndarray
    agn: np.ndarray
    usable: np.ndarray
    template_error: np.ndarray
    mass_prior: object = None
    density: object = None
    rtol: float = 1e-6
    scale_error: bool = True
    mixture: BandMixture | None = None

    @property
    def n_models(self):
        """Number of different models that are evaluated or bounded."""
        n_zero = int(self._zero_frac)
        # f = 0 is one model of each galaxy, whatever the AGN template
        n_each = n_zero + self.grid.n_agn * (self.grid.frac_agn.size - n_zero)
        return int(np.count_nonzero(self.usable)) * n_each

    @property
    def size(self):
        """Numbers of redshifts, galaxies, AGN models and fractions, by the letters of joint sums."""
        n_z, n_galaxy, _ = self.galaxy.shape
        return {"z": n_z, "g": n_galaxy, "k": self.agn.shape[1], "f": self.grid.frac_agn.size}

    @property
    def delta(self):
        """How far 2 ln(posterior) of a model may lie below the best: 2 ln(100 n_models / rtol)."""
        if self.rtol == 0:
            return 1e9
        return 2.0 * np.log(max(self.n_models, 1) * _TAIL / (_SAFETY * self._rtol))

    @property
    def _rtol(self):
        if self.mixture is None or self.rtol == 0:
            return self.rtol
        # with wrong bands more redshifts matter, and tangents are not as good as that
        return max(self.rtol, _MIN_MIXTURE_RTOL)

    @cached_property
    def tables(self):
        """
        The model grid and its priors, as the kernels take them.

        All arrays can be written to, for the kernels are compiled once more for those that cannot.
        """
        n_z, n_galaxy, n_bands = self.galaxy.shape
        block = _core.BLOCK
        n_padded = -(-n_galaxy // block) * block
        # galaxies in blocks that the kernels handle side by side, padded with ones
        padded = np.ones((n_z, n_padded, n_bands))
        padded[:, :n_galaxy] = self.galaxy
        tiles = _core.aligned(n_z, n_padded // block, n_bands, block)
        tiles[:] = padded.reshape(n_z, -1, block, n_bands).transpose(0, 1, 3, 2)
        unit = _unit(self.galaxy)
        agn_unit = _unit(self.agn)
        padded[:, :n_galaxy] /= unit
        galaxy32 = _core.aligned(n_z, n_bands, n_padded, dtype=np.float32)
        galaxy32[:] = padded.transpose(0, 2, 1)
        priors = self.priors
        quantities = self.quantities
        dust = self.grid.dust_luminosity
        frac = self.grid.frac_agn
        log_galaxy = _two_log(priors.galaxy / priors.galaxy.sum())
        log_usable = np.full((n_z, n_padded), -1e300)
        log_usable[:, :n_galaxy] = np.where(self.usable, log_galaxy, -1e300)
        n_agn = self.agn.shape[1]
        galaxy_share = np.zeros(n_galaxy)
        agn_share = np.zeros(n_agn)
        if quantities.fraction is not None:
            galaxy_share = quantities.fraction.galaxy
            agn_share = quantities.fraction.agn
        log_dust = np.log10(dust, where=dust > 0, out=np.full(n_galaxy, -400.0))
        of_galaxy = np.zeros((4, n_padded))
        of_galaxy[:, :n_galaxy] = (dust, log_dust, galaxy_share, quantities.mixed_galaxy)
        of_agn = np.zeros((3, max(n_agn, 1)))
        of_agn[:, :n_agn] = (_two_log(self._agn_prior), agn_share, quantities.mixed_agn)
        prior_frac = priors.frac / priors.frac.sum()
        log_frac = _two_log(prior_frac)
        ratio = _ratio(frac)
        edge = _ratio(cell_edges(frac, (0.0, 1.0)))
        prior_zero = 0.0
        log_zero = -1e300
        if self._zero_frac:
            prior_zero = float(prior_frac[0])
            log_zero = float(log_frac[0])
        above = frac > 0
        log_ratio = np.log10(ratio, where=above, out=np.zeros(ratio.size)) * _core.PER_DEX
        of_frac = np.array([ratio, log_ratio, prior_frac, log_frac, edge[:-1], edge[1:]])
        return _core.Tables(
            galaxy=np.array(self.galaxy, order="C"),
            agn=np.array(self.agn, order="C"),
            tiles=tiles,
            galaxy32=galaxy32,
            agn32=(self.agn / agn_unit).astype(np.float32, order="C"),
            galaxy_unit=np.array(unit[:, :, 0], order="C"),
            agn_unit=np.array(agn_unit[:, :, 0], order="C"),
            log_usable=log_usable,
            of_galaxy=of_galaxy,
            of_agn=of_agn,
            of_frac=np.array(of_frac[:, above], order="C"),
            zero_frac=int(self._zero_frac),
            prior_zero=prior_zero,
            log_zero=log_zero,
            edge_zero=float(edge[1]),
            log_top_pair=float(of_agn[0].max() + log_frac[above].max(initial=-1e300)),
            share_mean=float(self._agn_prior @ agn_share),
        )

    @property
    def _zero_frac(self):
        return bool(self.grid.frac_agn[0] == 0.0)

    @cached_property
    def _agn_prior(self):
        return self.priors.agn / max(self.priors.agn.sum(), 1e-300)

    @cached_property
    def _scales(self):
        quantities = self.quantities
        n_agn = self.agn.shape[1]
        galaxy = np.vstack([quantities.galaxy_scale, quantities.mixed_galaxy])
        # the kernels take one AGN model at least
        agn = np.zeros((len(quantities.agn_scale) + 1, max(n_agn, 1)))
        agn[:, :n_agn] = np.vstack([quantities.agn_scale, quantities.mixed_agn])
        return _core.make_scales(galaxy, agn)

    @cached_property
    def tangents(self):
        """`~miricigale.fitting.grid.mixture.Tangents` of its models, where bands may be wrong."""
        return Tangents.of_tables(self.mixture, self.tables)

    def workspace(self, n_draws=0, joint=()):
        """Make the accumulators and work space of one worker (some tens of MB)."""
        size = (*self.size.values(), self.galaxy.shape[2])
        space = _core.make_workspace(*size, int(self._zero_frac), _CAPACITY)
        return _core.make_sums(*size, n_draws, joint), *space

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
        each=None,
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
            a flux or a limit, not both, and no limit if some model has negative flux there.
        n_draws : int, optional
            Number of models to draw from each posterior; see `draw`.
        seeds : `~numpy.ndarray` of int, shape (n,), optional
            Seeds of the draws.
        joint : tuple of str, optional
            Joint posteriors to return as well: ``"zg"``, ``"zk"``, ``"gk"``, ``"fg"``, ``"fk"``
            with z redshift, g galaxy, k AGN model, f AGN fraction.
        workspace : tuple, optional
            What `workspace` returned for this ``n_draws`` and ``joint``, for use by one thread at
            a time; made if not given.
        each : callable, optional
            Called with an `ObjectOnNodes` of each object that was fitted.

        Returns
        -------
        out : `GridOutput`
        """
        n, n_bands = flux.shape
        data = np.where(np.isfinite(sigma), flux, 0.0)
        if limit is None:
            inverse = np.zeros((n, n_bands))
            limit = np.zeros((n, n_bands))
        else:
            inverse = 1.0 / limit_sigma
            limit = np.where(inverse > 0, limit, 0.0)
        log_prior = np.where(np.isfinite(log_prior), 2.0 * log_prior, -1e300)
        if seeds is None:
            seeds = np.zeros(n)
        seeds = np.array(seeds, np.uint64)
        out = self.empty_output(n, n_draws, joint)
        if workspace is None:
            workspace = self.workspace(n_draws, joint)
        sums = workspace[0]
        single = self._rtol >= _SINGLE
        broad = None
        if self.mixture is not None:
            broad = self.mixture.broad(data, sigma)
        for i in np.flatnonzero(log_prior.max(axis=1, initial=-1e300) > -1e200):
            target = stated = _core.make_target(
                data[i], sigma[i], log_prior[i], self.template_error
            )
            limits = _core.make_limits(limit[i], inverse[i], getattr(self.mixture, "part", None))
            if broad is not None:
                target, wrong = self.tangents.touch(
                    stated,
                    log_prior[i],
                    sigma[i],
                    broad[i],
                    limit[i],
                    limit_sigma[i] if limits is not None else None,
                )
            of_all = target
            tables, target, log_norm = self._of_masses(target, workspace[2])
            arguments = tables, self._scales, self._request, target, limits
            sums.draws.state[0] = seeds[i]
            _core.clear(sums)
            if target.norm[0] > 0.0 and _core.sum_up(*arguments, *workspace, single=single):
                self._summarize(stated, target, limits, sums, out, i)
                if broad is not None:
                    in_fit = np.isfinite(sigma[i]) | (inverse[i] > 0)
                    out.outlier[i] = np.where(in_fit, out.zf[i].sum(axis=1) @ wrong, np.nan)
                if each is not None:
                    wrong = None
                    if broad is not None:
                        wrong = (stated, sigma[i], broad[i])
                    start = Start(out.draw_index[i], out.zf[i], False)
                    excess = out.chi2[i] / np.isfinite(sigma[i]).sum()
                    if excess > _MAX_EXCESS:
                        # errors at which the best model on nodes fits
                        larger = np.sqrt(excess)
                        loose = _core.make_target(
                            data[i], larger * sigma[i], log_prior[i], larger * self.template_error
                        )
                        start = self._spread(loose, limits, workspace, single, seeds[i]) or start
                    # likelihoods of mixtures have no constant
                    zero = 0.0
                    if broad is None:
                        zero = -0.5 * target.top
                        if limits is not None:
                            zero -= 0.5 * limits.dark
                    on_nodes = ObjectOnNodes(i, of_all, limits, None, wrong, start, log_norm, zero)
                    if self.mass_prior is not None:
                        on_nodes = on_nodes._replace(target=target, log_usable=tables.log_usable)
                    each(on_nodes)
        return out

    def empty_output(self, n, n_draws, joint):
        """Make the `GridOutput` of n objects that were not fitted; arguments as of `fit`."""
        # the galaxy's, the AGN model's and the sum of both
        n_quantities = len(self._scales.galaxy) + len(self._scales.agn) - 1
        n_bands = self.galaxy.shape[2]
        size = self.size | {"b": n_bands, "q": n_quantities, "l": DERIVED_LEVELS.size, "d": n_draws}
        size |= {"2": 2, "3": 3, "4": 4}

        def empty(axes, value):
            return np.full((n, *map(size.get, axes)), value)

        arrays = {name: empty(axes, np.nan) for name, axes in _AXES.items()}
        for name in arrays:
            if "index" in name:
                arrays[name] = empty(_AXES[name], -1)
        return GridOutput(**arrays, joint={name: empty(name, np.nan) for name in joint})

    def _spread(self, target, limits, workspace, single, seed):
        """
        Make a `Start` of the posterior of data with larger errors; None if no model is possible.

        Where errors are small against the differences of nodes, the posterior on nodes is that of a node that
        happens to be near, and misses models in the cells of other nodes.
        """
        sums = workspace[0]
        tables, target, _ = self._of_masses(target, workspace[2])
        sums.draws.state[0] = seed
        _core.clear(sums)
        arguments = (tables, self._scales, self._request, target, limits)
        if not (target.norm[0] > 0.0 and _core.sum_up(*arguments, *workspace, single=single)):
            return None
        return Start(np.array(sums.draws.index), sums.zf / sums.zf.sum(), True)

    def _of_masses(self, target, space):
        """
        Put the priors of mass into tables and data: priors of galaxies and redshifts at the masses of an object.

        The third is ln of the factor that keeps the sum of a mass function's priors.
        """
        tables = self.tables
        log_norm = 0.0
        if self.density is not None:
            change = np.empty(target.log_prior.size)
            out = np.empty(tables.log_usable.shape)
            table = self.density.table
            stars = np.zeros(out.shape[1])
            stars[: self.size["g"]] = self.density.log_stars
            per_dex = self.density.per_dex
            _core.weigh_masses(tables, target, space.pq, stars, table, per_dex, out, change)
            tables = tables._replace(log_usable=out)
            # the evidence is that of a prior of redshift with the sum that it had
            prior = 0.5 * (target.log_prior - target.level)
            log_norm = float(logsumexp(prior) - logsumexp(prior + change))
            change += log_norm
            log_prior = np.where(target.log_prior > -1e200, target.log_prior + 2 * change, -1e300)
            target = target._replace(log_prior=log_prior)
        if self.mass_prior is None:
            return tables, target, log_norm
        log = tables.log_usable.copy()
        n_galaxy = self.size["g"]
        rows = np.flatnonzero(target.log_prior > -1e200)
        galaxy = self.galaxy[rows]
        weight = target.weight[rows]
        # best scale without AGN: <G, wF> / <G, wG>
        data = np.einsum("zgb,zb->zg", galaxy, weight * target.flux)
        norm = np.einsum("zgb,zgb,zb->zg", galaxy, galaxy, weight)
        with np.errstate(divide="ignore", invalid="ignore"):
            log_prior = np.where(self.usable[rows], 0.5 * log[rows, :n_galaxy], -np.inf)
            # a scale that is not positive, or of a model without light here, is taken for 1 Msun
            log_weighted = log_prior + self.mass_prior(np.fmax(data / norm, 1.0), rows)
            # each redshift keeps its sum: this factor is a prior of galaxies given the redshift
            log_ratio = logsumexp(log_prior, axis=1) - logsumexp(log_weighted, axis=1)
            log_weighted += log_ratio[:, None]
        log[rows, :n_galaxy] = np.where(log_weighted > -1e200, 2.0 * log_weighted, -1e300)
        return tables._replace(log_usable=log), target, log_norm

    def _summarize(self, stated, target, limits, sums, out, i):
        """Fill row i of the output."""
        total = sums.total[0]
        out.index[i] = sums.index
        out.best_scale[i] = sums.best[1]
        z, g, k, f = sums.index
        scale = sums.best[1]
        model = scale * self.galaxy[z, g]
        frac = self.grid.frac_agn[f]
        if frac > 0:
            power = scale * self.grid.dust_luminosity[g] * frac / (1.0 - frac)
            model = model + power * self.agn[z, k]
        out.best_flux[i] = model
        # chi2 from the residuals: |F|^2_w - R would lose digits
        chi2 = np.sum(stated.weight[z] * (target.flux - model) ** 2)
        norm = target.top
        if limits is not None:
            faint = limits.level - model[limits.bands] * limits.inverse
            chi2 -= 2.0 * log_ndtr(faint).sum()
            norm += limits.dark
        out.chi2[i] = chi2
        out.log_sum[i] = np.log(total) + 0.5 * (sums.best[2] - norm)
        # sums in single precision differ by some 1e-8
        out.zf[i] = sums.zf / sums.zf.sum()
        out.galaxy[i] = sums.galaxy[:, 0] / sums.galaxy[:, 0].sum()
        # without AGN light the data do not constrain the AGN model: its prior
        prior = self._agn_prior
        if prior.size:
            agn = sums.agn[:, 0] + sums.alone.sum() * prior
            out.agn[i] = agn / agn.sum()
        mean, square = sums.band / total
        out.band[i, 0] = mean
        out.band[i, 1] = np.sqrt(np.maximum(square - mean * mean, 0.0))
        scale_error = float(self.scale_error)
        moments = out.moments[i]
        quantiles = out.quantiles[i]
        _core.summarize(self._scales, sums, scale_error, DERIVED_LEVELS, moments, quantiles)
        if self.quantities.fraction is not None:
            mean, square = sums.total[4:6] / total
            out.share[i, 0] = mean
            out.share[i, 1] = np.sqrt(max(square - mean * mean, 0.0))
            # the density in each bin, from changes of slope
            density = np.cumsum(sums.hist.share[: _core.N_SHARE])[None]
            _core.percentile_places(density, DERIVED_LEVELS, out.share_quantiles[i : i + 1])
            out.share_quantiles[i] /= _core.N_SHARE
        out.draw_index[i] = sums.draws.index
        out.draw_scale[i] = sums.draws.scale
        for name, table in out.joint.items():
            table[i] = getattr(sums.joint, name)
            if name == "zk" and self._zero_frac:
                table[i] += sums.zf[:, :1] * prior
            elif name == "gk":
                table[i] += sums.alone[:, None] * prior
            elif name == "fk" and self._zero_frac:
                table[i, 0] += sums.alone.sum() * prior
            table[i] /= table[i].sum()

    def draw(self, flux, sigma, log_prior, n_draws, seeds, **limits):
        """
        Draw models from the posteriors, exactly and independently; other arguments are those of `fit`.

        Returns
        -------
        index : `~numpy.ndarray` of int, shape (n, n_draws, 4)
            Redshift, galaxy, AGN model and AGN fraction; -1 for objects that could not be fitted.
            Where the fraction is 0 the AGN model is one drawn from the prior.
        scale : `~numpy.ndarray`, shape (n, n_draws)
            Solar masses formed: with ``scale_error`` drawn from the Gaussian about the model's
            best scale, as far as it is positive.
        """
        out = self.fit(flux, sigma, log_prior, n_draws=n_draws, seeds=seeds, **limits)
        index = out.draw_index
        scale = out.draw_scale[:, :, 0]
        prior = np.ones(1)
        if self.agn.shape[1]:
            prior = self._agn_prior
        for i in np.flatnonzero(np.isfinite(out.chi2)):
            rng = np.random.default_rng(int(seeds[i]))
            drawn = rng.choice(prior.size, size=n_draws, p=prior)
            index[i, :, 2] = np.where(index[i, :, 2] < 0, drawn, index[i, :, 2])
            uniform = 1.0 - rng.random(n_draws)
            scale[i] = self.drawn_scale(scale[i], out.draw_scale[i, :, 1], uniform)
        return index, scale

    def drawn_scale(self, scale, variance, uniform):
        """
        Draw scales from the Gaussians about best ones, as far as they are positive; or return these themselves.

        ``uniform``, shape (n,), are numbers above 0 and below, or equal to, 1.
        """
        if not self.scale_error:
            return scale
        error = np.sqrt(np.maximum(variance, _MIN_VARIANCE))
        # inverse of the cumulative normal distribution, cut at a scale of 0
        low = ndtr(-scale / error)
        return scale + error * ndtri(low + (1.0 - low) * uniform)

    @cached_property
    def _request(self):
        return _core.Request(
            delta=float(self.delta),
            rtol=_SAFETY * self._rtol,
            tail=_TAIL,
            thin=_THIN * self._rtol,
            scale_error=float(self.scale_error),
        )

    @cached_property
    def negative(self):
        """Bands in which a model has negative flux."""
        negative = np.any(self.galaxy < 0, axis=(0, 1))
        return negative | np.any(self.agn < 0, axis=(0, 1))


def _unit(table):
    """Return the largest flux of every model, shape (nz, n, 1); 1 where there is none."""
    top = table.max(axis=-1, keepdims=True, initial=0.0)
    return np.where(top > 0, top, 1.0)


def _ratio(frac):
    """Compute the odds f / (1 - f), of 1 a large number."""
    return frac / np.maximum(1.0 - frac, 1e-12)


def _two_log(prior):
    """Return 2 ln(prior), -1e300 where it is zero."""
    return 2.0 * np.log(prior, where=prior > 0, out=np.full(prior.shape, -5e299))
