"""Grids with what lies between their nodes, and the posteriors of objects there."""

from dataclasses import replace
from functools import cached_property

import numpy as np
from scipy.special import log_ndtr

from miricigale.fitting import _core
from miricigale.fitting.grid.adaptive import AdaptiveSampler
from miricigale.fitting.grid.grid import GridEngine
from miricigale.fitting.grid.interpolation import InterpolatedModels, grid_models
from miricigale.fitting.grid.labels import LabelTable, log_weights
from miricigale.fitting.grid.node_scan import NodeScan
from miricigale.fitting.grid.peaks import redshift_peaks
from miricigale.fitting.grid.placed_models import places_to_values
from miricigale.fitting.posterior.priors import GridAxis
from miricigale.fitting.posterior.quantities import percentile_error
from miricigale.utils.units import Frozen
from miricigale.utils.values import value_class

#: Draws of the posterior on nodes that sampling begins with.
N_START = 256
#: Error of a percentile, in units of half of the 68 % interval, above which more models are taken.
_GOOD_ERROR = 0.1
#: Error above which it is not converged.
_MAX_ERROR = 0.2
#: Quantities whose percentiles they are.
_MAIN_QUANTITIES = ("redshift", "frac_agn", "stellar_mass", "sfr", "dust_luminosity")
#: Largest ratio of these errors whose square is the factor on the effective number of models.
_MAX_RATIO = 2.0
#: Number of times that models are added for them.
_MAX_EXTENSIONS = 2
#: Fluxes of galaxies that differ by less than this part, along an axis, are the same.
_SAME_FLUX = 1e-6


@value_class
class Continuation(Frozen):
    """
    A grid with what lies between its nodes; picklable.

    Parameters
    ----------
    engine : `~miricigale.fitting.grid.grid.GridEngine`
        Its models and priors.
    models : `~miricigale.fitting.grid.interpolation.InterpolatedModels`
        Models between its nodes.
    agn_error : float
        Error of the AGN's light as a part of it.
    scramble : int, optional
        Seed of the quasi-random points, which are those of all objects.
    """

    engine: GridEngine
    models: InterpolatedModels
    agn_error: float = 0.0
    scramble: int = 1

    @cached_property
    def axes(self):
        """`GridAxis` of redshift, AGN fraction, galaxies and AGN, in this order: dict by name."""
        prior_axes = self.engine.priors.axes
        grid = self.engine.grid
        axes = {}
        for name, values in (("redshift", grid.redshift), ("frac_agn", grid.frac_agn)):
            equal = np.full(values.size, 1.0 / values.size)
            axes[name] = prior_axes.get(name) or GridAxis(name, values, 1, name, equal)
        for kind in ("galaxy", "agn"):
            axes |= {name: axis for name, axis in prior_axes.items() if axis.kind == kind}
        return axes

    @cached_property
    def _models(self):
        """Model of each combination of values of the axes, (n_1, n_2, ...), -1 where there is none: by kind."""
        grid = self.engine.grid
        axes = self.engine.priors.axes
        return {
            "galaxy": grid_models(axes, "galaxy", grid.n_galaxies),
            "agn": grid_models(axes, "agn", grid.n_agn),
        }

    @cached_property
    def space(self):
        """`_core.Space` of the cells."""
        axes = list(self.axes.values())
        size = np.array([axis.values.size for axis in axes], np.int64)
        low, high, log_prior = np.zeros((3, len(size), max(size)))
        for i, axis in enumerate(axes):
            n = size[i]
            # no cell reaches beyond the outermost nodes
            cells = np.clip(axis.cells(), axis.values[0], axis.values[-1])
            low[i, :n] = cells[0]
            high[i, :n] = cells[1]
            if axis.kind in ("frac_agn", "agn"):
                log_prior[i, :n] = log_weights(axis.weights)
        galaxy = self._models["galaxy"]
        light = self.models.light
        return _core.Space(size, low, high, log_prior, galaxy.ravel(), galaxy.ndim, light)

    @cached_property
    def labels(self):
        """`LabelTable` of objects whose redshift is free."""
        return LabelTable.of_axes(list(self.axes.values()), self._without_effect)

    @cached_property
    def labels_at_redshift(self):
        """`LabelTable` of objects whose redshift is known: redshift is then no axis."""
        return self.labels.without_first_axis()

    @cached_property
    def _without_effect(self):
        """Find axes (columns) without effect where the component of others (rows) is absent: (n_axes, n_axes)."""
        axes = list(self.axes.values())
        out = np.zeros((len(axes), len(axes)), bool)
        for kind in ("galaxy", "agn"):
            of_kind = [i for i, axis in enumerate(axes) if axis.kind == kind]
            model = self._models[kind]
            for k, i in enumerate(of_kind):
                if not axes[i].absent_at_zero:
                    continue
                absent = model.take([0], axis=k)
                for m, j in enumerate(of_kind):
                    first = absent.take([0], axis=m)
                    out[i, j] = j != i and self._have_same_flux(kind, absent, first)
        out[1, [axis.kind == "agn" for axis in axes]] = True
        return out

    def _have_same_flux(self, kind, models, first):
        """Whether models have the fluxes of others, which broadcast, where both exist."""
        exist = (models >= 0) & (first >= 0)
        a, b = np.broadcast_arrays(models, first)
        a = a[exist]
        b = b[exist]
        if kind == "galaxy":
            dust = self.engine.grid.dust_luminosity
            if not np.allclose(dust[a], dust[b], rtol=_SAME_FLUX, atol=0):
                return False
        table = getattr(self.engine, kind)
        for z in {0, len(table) // 2, len(table) - 1}:
            top = np.abs(table[z, b]).max(axis=-1, keepdims=True, initial=0.0)
            if np.any(np.abs(table[z, a] - table[z, b]) > _SAME_FLUX * top):
                return False
        return True

    def _work(self):
        return self.models.make_work()

    @cached_property
    def _values(self):
        """Values of the models of the grid by kind: dicts by name; of those with several values the first."""
        values = {"galaxy": {}, "agn": {}}
        for name, axis in self.engine.priors.axes.items():
            if axis.kind in values:
                # of models that stand for several values the first
                values[axis.kind][name] = axis.values[axis.share.argmax(axis=0)]
        return values

    def at_redshift(self, redshift, node):
        """Return a `GridEngine` of all models at one redshift; priors and template errors are those of a node."""
        engine = self.engine
        new = {"usable": engine.usable[node : node + 1]}
        for kind, values in self._values.items():
            z = np.full(getattr(engine, kind).shape[1], redshift)
            if not z.size:
                new[kind] = engine.agn[:1]
            elif kind == "galaxy":
                flux = self.models.galaxy_fluxes(values, z)
                # galaxies older than the universe there, if not at the node
                exists = np.isfinite(flux).all(axis=1)
                new["usable"] = new["usable"] & exists
                new[kind] = np.where(exists[:, None], flux, 0.0)[None]
            else:
                new[kind] = self.models.agn_fluxes(values, z)[None]
        density = engine.density
        prior = engine.mass_prior
        new["template_error"] = engine.template_error[node : node + 1]
        if density is not None:
            new["density"] = replace(density, table=density.table[node : node + 1])
        new["mass_prior"] = prior and (lambda formed, _: prior(formed, [node]))
        return replace(engine, **new)

    @cached_property
    def scan(self):
        """`NodeScan` of the grid; None with a prior of rates, which takes sums over the nodes."""
        if self.engine.mass_prior is not None:
            return None
        return NodeScan(self.engine, N_START)

    @cached_property
    def _log_usable(self):
        """2 ln(prior) of the galaxies, shape (nz, nG)."""
        prior = self.engine.priors.galaxy
        return np.where(self.engine.usable, 2.0 * log_weights(prior / prior.sum()), _core.NEVER)

    @cached_property
    def _masses(self):
        """`_core.Masses` of the grid."""
        density = self.engine.density
        if density is None:
            n_z, n_galaxies = self.engine.usable.shape
            return _core.Masses(np.zeros((n_z, 2)), np.zeros(n_galaxies), 0.0)
        return _core.Masses(density.table, density.log_stars, density.per_dex)

    def place(self, n_effective, known, node, redshift, nuclei=None):
        """
        Put models between the nodes, with the weights of the posterior of an object.

        Parameters
        ----------
        n_effective : int
            Effective number of models.
        known : `~miricigale.fitting.grid.grid.ObjectOnNodes`
            What is known of the object.
        node : int or None
            Node that stands for the redshift; None if that is free.
        redshift : float
            Redshift of the object; 0 if it is free.
        nuclei : `~miricigale.fitting.grid.nuclei.ObjectNuclei`, optional
            Its nuclei, with which the data in ``known`` are extended.

        Returns
        -------
        posterior : `BetweenPosterior` or None
            None if no model is possible.
        """
        start = known.start
        bands = self.engine.mixture
        if nuclei is not None:
            bands = nuclei.mixture(bands)
        mixture = known.wrong and self._mixture(bands, *known.wrong)
        log_usable = known.log_usable
        masses = self._masses
        if log_usable is None:
            log_usable = self._log_usable
        else:
            # these have the prior of mass
            masses = masses._replace(table=np.zeros((len(masses.table), 2)), per_dex=0.0)
        if node is not None:
            masses = masses._replace(table=masses.table[node : node + 1])
            if known.log_usable is None:
                log_usable = log_usable[node : node + 1]
        one = _core.Object(
            known.target,
            known.limits,
            mixture,
            log_usable,
            masses,
            redshift,
            self.agn_error,
            nuclei and nuclei.kernel(),
        )
        if redshift:
            labels, borders, weights = self.labels_at_redshift, np.zeros(0), np.ones(1)
        else:
            labels = self.labels
            borders, weights = redshift_peaks(self.engine.grid.redshift, start.zf.sum(axis=1))
        given = self.space, labels.kernel, self._work(), one, borders, weights
        sampler = AdaptiveSampler(
            *given, wanted=n_effective, scramble=self.scramble, is_narrow=start.larger_errors
        )
        label, score = labels.of_nodes(self._cells_of(start.index))
        peak = np.searchsorted(borders, self.engine.grid.redshift[start.index[:, 0]])
        models = sampler.run(label, score, peak)
        if models is None:
            return None
        quantities = self._quantities(models, one)
        error = quantities.percentile_error()
        for _ in range(_MAX_EXTENSIONS):
            if error <= _GOOD_ERROR:
                break
            # errors fall as the root of the number
            factor = min(error / _GOOD_ERROR, _MAX_RATIO) ** 2
            more_models = sampler.extend(factor)
            if more_models is None:
                break
            models = more_models
            quantities = self._quantities(models, one)
            error = quantities.percentile_error()
        if error > _MAX_ERROR:
            models = replace(models, converged=False)
        return self._describe(models, quantities, one, known, nuclei)

    def _cells_of(self, drawn):
        """Find the nodes of the axes of draws from the posterior on nodes: (n, n_axes)."""
        z, g, k, f = drawn.T
        columns = []
        for axis in self.axes.values():
            if axis.kind == "redshift":
                columns.append(z)
            elif axis.kind == "frac_agn":
                columns.append(f)
            elif axis.kind == "galaxy":
                columns.append(axis.share.argmax(axis=0)[g])
            else:
                # without AGN light the draw has no AGN model
                columns.append(axis.share.argmax(axis=0)[np.maximum(k, 0)])
        return np.stack(columns, axis=1)

    def _mixture(self, bands, stated, sigma, broad):
        """`_core.Mixture` of an object, of bands that may be wrong (`BandMixture`)."""
        used, part = stated.bands, bands.part[stated.bands]
        narrow, wide = np.take(stated.weight, used, axis=1), broad[used]
        # odds of the broad part without a residual: p sigma / ((1 - p) Sigma)
        odds = part / (1.0 - part) / np.sqrt(narrow) / wide
        # of fluxes in units of the errors without that of templates
        level = 0.5 * np.log(narrow * np.square(sigma[used])).sum(axis=1)
        return _core.Mixture(narrow, wide**-2.0, odds, level, np.zeros((4, len(used))))

    def index_of_nodes(self, node):
        """Find redshift, galaxy, AGN model and fraction of nodes of the axes, (n, n_axes): (n, 4), -1 for none."""
        index = np.full((len(node), 4), -1)
        index[:, 0] = node[:, 0]
        index[:, 3] = node[:, 1]
        kinds = np.array([axis.kind for axis in self.axes.values()])
        for column, kind in ((1, "galaxy"), (2, "agn")):
            models = self._models[kind]
            kind_node = node[:, kinds == kind]
            if kind_node.shape[1]:
                index[:, column] = models[tuple(kind_node.T)]
            else:
                index[:, column] = models.ravel()[0]
        without_agn = self.engine.grid.frac_agn[node[:, 1]] == 0.0
        index[without_agn, 2] = -1
        return index

    def _quantities(self, models, one):
        """Work out `_Quantities` of models."""
        values = {}
        node = {}
        for j, name in enumerate(self.axes):
            node[name], values[name] = places_to_values(self.space, j, models.place[:, j])
        if one.redshift:
            values["redshift"] = np.full(len(models.weight), one.redshift)
        scale = self.engine.drawn_scale(models.scale, models.variance, models.uniform)
        derived = self.models.describe(values, values["redshift"], models.power, scale)
        return _Quantities(values, node, derived, scale, models.weight, models.lineage)

    def _describe(self, models, quantities, one, known, nuclei):
        """Make the `BetweenPosterior` of models and their `_Quantities`."""
        values = quantities.values
        node = quantities.node
        scale = quantities.scale
        weight = models.weight
        z = node["redshift"]
        if one.redshift:
            z = np.zeros(len(weight), int)
        flux = models.flux
        drawn_flux = flux * scale[:, None]
        data_flux = flux
        bands = self.engine.mixture
        if nuclei is not None:
            data_flux = self._with_nuclei(nuclei, flux, values, models.power)
            bands = nuclei.mixture(bands)
        share = None
        if known.wrong:
            stated, _, broad = known.wrong
            given = data_flux * scale[:, None], stated, broad, one.limits, z, weight
            share = bands.shares(*given)
            if nuclei is not None:
                share = nuclei.of_bands(share)
        mean = weight @ drawn_flux
        # about the mean, so that narrow posteriors keep their digits
        variance = weight @ np.square(drawn_flux - mean)
        # the best model is that of the highest likelihood, at its own scale
        best = int(np.argmax(models.log_likelihood))
        best_flux = flux[best] * models.scale[best]
        stated = known.wrong[0] if known.wrong else one.target
        return BetweenPosterior(
            values=values,
            node=node,
            derived=quantities.derived,
            weight=weight,
            wrong=share,
            flux=np.array([mean, np.sqrt(variance)]),
            best=self._best(values, models, best),
            best_node=np.array([node[name][best] for name in self.axes]),
            best_scale=models.scale[best],
            best_flux=best_flux,
            chi2=_chi2(stated, one.limits, z[best], data_flux[best] * models.scale[best]),
            log_sum=models.log_evidence + known.zero + known.log_norm,
            converged=models.converged,
        )

    def _with_nuclei(self, nuclei, flux, values, power):
        """Extend fluxes of models, (n, nb), by those of nuclei; ``power``, (n,), is that of their AGN."""
        agn = np.zeros(flux.shape)
        present = power > 0.0
        if present.any():
            rows = {name: value[present] for name, value in values.items()}
            light = self.models.agn_fluxes(rows, rows["redshift"])
            agn[present] = power[present, None] * light
        return nuclei.extended(flux, agn)

    def draws(self, posterior, rows):
        """
        Parameters, derived quantities and fluxes of some models of a posterior.

        Parameters
        ----------
        posterior : `BetweenPosterior`
            The posterior.
        rows : `~numpy.ndarray` of int, shape (n,)
            Which of its models.

        Returns
        -------
        index : `~numpy.ndarray` of int, shape (n, 4)
            Models of the grid in whose cells they lie; see `index_of_nodes`.
        values : dict of str to `~numpy.ndarray`, shape (n,)
            Parameters and derived quantities.
        flux : `~numpy.ndarray`, shape (n, nb)
            Fluxes in uJy.
        """
        node = np.stack([posterior.node[name][rows] for name in self.axes], axis=1)
        parameters = {name: value[rows] for name, value in posterior.values.items()}
        derived = {name: value[rows] for name, value in posterior.derived.items()}
        flux, _ = self.models.fluxes(parameters, parameters["redshift"], parameters["frac_agn"])
        return self.index_of_nodes(node), derived | parameters, flux * derived["mass"][:, None]

    def _best(self, values, models, best):
        """Collect parameters and derived quantities of the best model: dict of str to float."""
        row = slice(best, best + 1)
        parameters = {name: value[row] for name, value in values.items()}
        z = parameters["redshift"]
        derived = self.models.describe(parameters, z, models.power[row], models.scale[row])
        out = {name: float(value[0]) for name, value in (parameters | derived).items()}
        if not out["frac_agn"] > 0:
            # without AGN light there is no template
            for name, axis in self.axes.items():
                if axis.kind == "agn":
                    out[name] = np.nan
        return out


@value_class
class _Quantities:
    """
    Parameters and derived quantities of weighted models; attributes as of `BetweenPosterior`.

    Parameters
    ----------
    values, node, derived : dict of str to `~numpy.ndarray`, shape (n,)
        Parameters, nodes and derived quantities.
    scale, weight : `~numpy.ndarray`, shape (n,)
        Scales, drawn from those that are possible, and weights.
    lineage : `~numpy.ndarray` of int or None, shape (n,)
        See `~miricigale.fitting.grid.placed_models.PlacedModels`.
    """

    values: dict
    node: dict
    derived: dict
    scale: np.ndarray
    weight: np.ndarray
    lineage: np.ndarray | None

    def percentile_error(self):
        """
        Estimate the largest error of the 16th, 50th and 84th percentiles of the main quantities.

        Returns
        -------
        error : float
            As by `~miricigale.fitting.posterior.quantities.percentile_error`.
        """
        largest = 0.0
        for name in _MAIN_QUANTITIES:
            numbers = self.values.get(name)
            if numbers is None:
                numbers = self.derived.get(name)
            if numbers is not None:
                error = percentile_error(numbers, self.weight, self.lineage)
                largest = max(largest, error)
        return largest


@value_class
class BetweenPosterior:
    """
    Posterior of an object between nodes.

    Parameters
    ----------
    values, node, derived : dict of str to `~numpy.ndarray`, shape (n,)
        Values of parameters, nodes in whose cells these are, and derived quantities, of n models.
    weight : `~numpy.ndarray`, shape (n,)
        Weights of the models; they sum to 1.
    wrong : `~numpy.ndarray` or None, shape (nb,)
        How likely each band is wrong.
    flux : `~numpy.ndarray`, shape (2, nb)
        Mean and standard deviation of the fluxes of the models.
    best : dict of str to float
        Parameters and derived quantities of the model of the highest likelihood.
    best_node : `~numpy.ndarray` of int, shape (n_axes,)
        Nodes in whose cells that is.
    best_scale : float
        Its scale.
    best_flux : `~numpy.ndarray`, shape (nb,)
        Its fluxes.
    chi2 : float
        Its chi2.
    log_sum : float
        Ln of the sum of prior exp(-chi2 / 2).
    converged : bool
        Whether the effective number of models is what was asked for.
    """

    values: dict
    node: dict
    derived: dict
    weight: np.ndarray
    wrong: np.ndarray | None
    flux: np.ndarray
    best: dict
    best_node: np.ndarray
    best_scale: float
    best_flux: np.ndarray
    chi2: float
    log_sum: float
    converged: bool


def _chi2(target, limits, z, flux):
    """Compute chi2 of the fluxes of a model, with errors at a node of redshift."""
    chi2 = np.sum(target.weight[z] * np.square(target.flux - flux))
    if limits is not None:
        faint = limits.level - flux[limits.bands] * limits.inverse
        chi2 -= 2.0 * log_ndtr(faint).sum()
    return chi2
