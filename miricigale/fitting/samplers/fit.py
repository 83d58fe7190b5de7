"""Fits with continuous parameters by a nested sampler, and what it finds as results."""

from functools import partial

import numpy as np
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.data.settings import SamplerSettings
from miricigale.fitting.posterior.posterior import cell_edges, check_pairs
from miricigale.fitting.posterior.priors import GridAxis
from miricigale.fitting.posterior.quantities import (
    DERIVED_LEVELS,
    FORMED_TEXT,
    column_values,
    draws_summary,
)
from miricigale.fitting.results.results import FitResults
from miricigale.fitting.samplers import CITATIONS, get_sampler
from miricigale.fitting.samplers.run import Calls, FluxModel, positive_normal, systematic_draws
from miricigale.fitting.samplers.space import Space, redshift_axis
from miricigale.sed import SEDModel
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import attributes, convert_values, first_value
from miricigale.utils.options import check_that, check_type
from miricigale.utils.parallel import single_threaded
from miricigale.utils.random import stream
from miricigale.utils.units import MASS
from miricigale.utils.values import value_class

#: Draws from the prior of which every component has to be able to evaluate one.
_N_LIBRARY_TRIALS = 64
#: Draws from the prior of which at least one has to be possible for an object.
_N_TRIALS = 2048


@value_class
class SamplerFit:
    """
    How `~miricigale.fitting.BayesFitter` fits with a nested sampler; picklable.

    ``bands`` are those that are evaluated, a set of filters or what the model takes for it, ``filters`` their
    names; ``sampler`` is a name or function (see `get_sampler`), ``redshift_given`` whether the priors say
    something of the redshift. With ``profile`` the mass of each model is the one that fits best, with its
    Gaussian error if ``scale_error``, and no parameter.
    """

    model: object
    bands: object
    filters: tuple
    sampler: object
    request: SamplerSettings
    space: Space
    redshift_given: bool
    profile: bool
    scale_error: bool

    #: Objects in a piece of the catalog.
    chunk_size = 1

    @classmethod
    def of_model(cls, model, filters, priors, settings, *, sampler, scale_error):
        """Set up the sampler with the priors of a model."""
        check_type(model, "model", FluxModel, "an SEDModel")
        check_that(isinstance(priors, dict), "priors", "a dict of parameters", repr(priors))
        predict = settings.predict
        names = tuple(getattr(filters, "names", filters)) + tuple(
            getattr(predict, "names", predict)
        )
        if isinstance(model, SEDModel):
            bands = FilterSet(list(filters) + list(predict))
        else:
            bands = names
        fit = cls(
            model=model,
            bands=bands,
            filters=names,
            sampler=sampler,
            request=settings,
            space=Space.of_model(model, priors),
            redshift_given="redshift" in priors,
            profile="mass" not in priors,
            scale_error=scale_error,
        )
        fit._check_libraries()
        return fit

    def _check_libraries(self):
        """Refuse priors of which no draw can be evaluated by some component."""
        if not isinstance(self.model, SEDModel):
            return
        points = np.random.default_rng(0).random((_N_LIBRARY_TRIALS, self.space.n_dim))
        values = self.space.values(points)
        rows = [{name: float(v[i]) for name, v in values.items()} for i in range(_N_LIBRARY_TRIALS)]
        for component in self.model.components:
            if component.refuses:
                why = [component.invalid(row) for row in rows]
            else:
                why = [None]
            names = [name for name in component.parameters if name in self.space.free]
            argument = " and ".join(f"priors[{name!r}]" for name in names)
            wanted = f"values that {component.name!r} has, such as a list of them"
            check_that(not all(why), argument, wanted, f"none: {why[0]}")

    @property
    def priors(self):
        """Prior of each free parameter by name."""
        return self.space.free

    @property
    def content(self):
        """What makes a fit another one, besides `settings`: name to anything with a checksum."""
        model = self.model
        request = self.request
        if isinstance(model, SEDModel):
            recipe = model.recipe
        else:
            recipe = type(model)
        return {"space": self.space, "model": recipe, "draws": (request.n_draws, request.n_cells)}

    @property
    def edge_weight(self):
        """Weight of the first or last cell of redshift above which an object is flagged."""
        return max(0.01, 2.0 / self.request.n_cells)

    def settings(self):
        """Return the settings of the fit as plain values."""
        request = self.request
        fixed = self.space.fixed.items()
        mass = "parameter"
        if self.profile:
            mass = "profile"
        return {
            "priors": convert_values(str, self.space.free),
            "mass": mass,
            "scale_error": self.scale_error,
            **attributes(request, ("n_live", "n_effective", "max_calls")),
            "options": convert_values(str, request.options),
            "constants": {name: v for name, v in fixed if name not in ("mass", "redshift")},
        }

    def provenance(self):
        """Return what results say of the model, and what to cite for it and the sampler."""
        meta = dict(self.model.meta)
        cited = ()
        if isinstance(self.sampler, str):
            cited = CITATIONS.get(self.sampler, ())
        citations = tuple(meta.pop("citations", ())) + tuple(cited)
        return {"citations": citations, "model": meta}

    def check_data(self, data):
        """Accept all data."""

    def redshifts(self, photometry, redshift, redshift_prior, flags):
        """
        `Space` of every object, number of free parameters, and "fixed", "prior" or "free".

        See `~miricigale.fitting.grid.grid_fit.GridFit.redshifts`.
        """
        space = self.space
        kind = "fixed"
        if "redshift" in self.space.free:
            kind = "free"
        if redshift is not None:
            kind = "fixed"
            spaces = space.at_redshifts(self._limits, photometry, redshift, flags)
        elif redshift_prior is not None:
            if kind == "fixed" and self.redshift_given:
                raise argument_error("redshift_prior", "None where 'priors' fix it", "densities")
            kind = "prior"
            spaces = space.with_densities(self._limits, redshift_prior, flags)
        elif self.redshift_given:
            spaces = [space] * len(flags)
        else:
            msg = "'priors' must have 'redshift', or 'redshift' or 'redshift_prior' be given"
            raise ValueError(msg)
        check_that(
            all(object_space.n_dim for object_space in spaces),
            "priors",
            "with a free parameter",
            "none",
        )
        n_free = max((object_space.n_dim for object_space in spaces), default=0) + self.profile
        return spaces, n_free, kind

    @property
    def _limits(self):
        """Least and largest redshift."""
        prior = self.space.free.get("redshift", self.model.parameters["redshift"])
        return prior.bounds

    # ------------------------------------------------------------------------- fit

    def task(self, pairs, seed, spaces):
        """Return a function that fits a piece of the catalog; every object has its own random stream."""
        axes = self._axes(spaces)
        parameters = self.model.parameters
        constant = [name for name in parameters if name not in axes and name != "mass"]
        wanted = "of free parameters but mass ('samples' of the results has draws of all)"
        pairs = check_pairs(pairs, axes, constant, ("mass", *self.columns), wanted)
        return partial(self._fit_piece, axes, pairs, seed)

    def _axes(self, spaces):
        """Make the cells of all parameters that are free for some object, and of redshift."""
        model = self.model
        n_cells = self.request.n_cells
        agn = None
        if isinstance(model, SEDModel):
            agn = model.component("agn")
        kinds = {}
        if agn is not None:
            kinds = dict.fromkeys(agn.parameters, "agn")
        kinds |= {"redshift": "redshift", "frac_agn": "frac_agn"}
        axes = {}
        cells = {"redshift": redshift_axis(spaces, self._limits, n_cells)}
        for name, prior in self.space.free.items():
            if name not in ("mass", "redshift"):
                cells[name] = prior.cells(n_cells)
        for name, (nodes, weights, bounds) in cells.items():
            unit = 1
            if name != "redshift":
                unit = model.parameters[name].unit
            kind = kinds.get(name, "galaxy")
            axes[name] = GridAxis(name, nodes, unit, kind, weights, None, bounds)
        return axes

    def _fit_piece(self, axes, pairs, seed, piece):
        """Fit a piece, its photometry and priors: `FitResults`."""
        data, spaces = piece
        flags = np.array(data.flags)
        n = len(data)
        columns = self.columns
        quantities = ("mass",) + tuple(columns)
        size = {name: axis.values.size for name, axis in axes.items()}
        n_axes = len(axes)
        n_derived = len(quantities)
        n_levels = len(DERIVED_LEVELS)
        shapes = {
            "pdf_2d": (size["redshift"], size.get("frac_agn", 1)),
            "axis_moments": (n_axes, 2),
            "axis_quantiles": (n_axes, n_levels),
            "moments": (n_derived, 3),
            "quantiles": (n_derived, n_levels),
            "draws": (self.request.n_draws, n_axes + n_derived),
            **dict.fromkeys(("model_flux", "model_flux_std", "best_flux"), (len(self.filters),)),
            **dict.fromkeys(("chi2", "log_evidence", "log_evidence_err", "n_effective"), ()),
        }
        out = {name: nans((n,) + shape) for name, shape in shapes.items()}
        out |= {
            "n_calls": np.zeros(n, np.int64),
            "converged": np.zeros(n, bool),
            "pdf": {name: nans((n, size[name])) for name in axes},
            "pairs": {(x, y): nans((n, size[x], size[y])) for x, y in pairs},
            "best": {name: nans(n) for name in tuple(axes) + quantities},
        }
        for row in np.flatnonzero((flags & FitFlags.UNFITTED) == 0):
            posterior = self._sample(data._take(row), spaces[row], seed, axes, pairs)
            if posterior is None:
                flags[row] |= FitFlags.NO_MODEL
            for name, value in (posterior or {}).items():
                if isinstance(value, dict):
                    for key, array in out[name].items():
                        array[row] = value[key]
                else:
                    out[name][row] = value
        units = [MASS]
        descriptions = [FORMED_TEXT]
        for column in columns.values():
            units.append(column.unit)
            descriptions.append(column.text)
        return FitResults(
            **data.columns,
            flags=flags,
            filters=self.filters,
            axes=axes,
            best_index=np.full((n, 4), -1),
            best_scale=out["best"]["mass"],
            quantities=quantities,
            units=tuple(units),
            descriptions=tuple(descriptions),
            intensive=tuple(name for name, column in columns.items() if not column.extensive),
            constants=self.settings()["constants"],
            **out,
        )

    # ------------------------------------------------------------------ one object

    @property
    def columns(self):
        """Derived quantities: `~miricigale.sed.Derived` by name."""
        columns = dict(self.model.derived_columns())
        # the parameter mass, by another name
        columns.pop("stellar_mass_formed", None)
        return columns

    def models(self, values, mass=None):
        """
        Evaluate fluxes in uJy (m, n_bands), NaN where a model is not possible, and derived quantities by name.

        ``values`` has all parameters but mass by name, each of shape (m,); ``mass`` is in solar masses
        formed, 1 by default.
        """
        n = len(first_value(values))
        if mass is None:
            mass = np.ones(n)
        table = QTable(values | {"mass": mass}, copy=False)
        fluxes = self.model.fluxes(table, self.bands)
        flux = np.column_stack([fluxes[name].value for name in self.filters])
        return flux, {name: column_values(fluxes[name]) for name in self.columns}

    def _sample(self, data, space, seed, axes, pairs):
        """Sample the posterior of one object, as results hold it by name; None if its prior leaves no model."""
        key = str(data.ids)
        with single_threaded():
            calls = Calls(self, data, space)
            rng = stream(seed, "fit", "prior", key)
            trials = (calls(rng.random((256, space.n_dim)))[0] for _ in range(_N_TRIALS // 256))
            if not any(np.isfinite(log_like).any() for log_like in trials):
                return None
            calls = Calls(self, data, space)
            rng = stream(seed, "fit", key)
            sampled = get_sampler(self.sampler)(calls, space.n_dim, rng, self.request)
            keep = sampled.weight > 0
            weight = sampled.weight[keep]
            call = np.asarray(sampled.call)[keep]
            # effective sample size of Kish 1965
            n_effective = np.sum(weight) ** 2 / np.sum(np.square(weight))
            weight = weight / weight.sum()
            # the best of all models that were evaluated, whether or not they are part of the sample
            best = [int(np.argmin(calls.of("chi2", slice(None))))]
            scale = calls.of("scale", call)
            best_scale = calls.of("scale", best)
            if self.profile and self.scale_error:
                std = np.sqrt(calls.of("variance", call))
                scale = positive_normal(scale, std, stream(seed, "scale", key))
            fixed = space.fixed.items()
            values = {name: np.full(len(call), value) for name, value in fixed if name in axes}
            values |= calls.of("parameters", call)
            of_best = {name: np.array([array[0]]) for name, array in values.items()}
            of_best |= calls.of("parameters", best)
            derived = self._scaled(calls.of("derived", call), values, scale, space.fixed)
            of_best |= self._scaled(calls.of("derived", best), of_best, best_scale, space.fixed)
        rng = stream(seed, "draws", key)
        # model fluxes are those of one solar mass
        flux = calls.of("flux", call) * scale[:, None]
        return {
            "chi2": calls.of("chi2", best)[0],
            "log_evidence": sampled.log_evidence,
            "log_evidence_err": sampled.log_evidence_err,
            "n_calls": calls.n,
            "n_effective": n_effective,
            "converged": sampled.converged,
            "best": {name: array[0] for name, array in of_best.items()},
            "best_flux": calls.of("flux", best)[0] * best_scale[0],
            **self._reduced(weight, values, derived, flux, axes, pairs, rng),
        }

    def _scaled(self, derived, parameters, scale, fixed):
        """Scale derived quantities of models from one solar mass to their masses."""
        columns = self.columns
        out = {"mass": scale}
        for name, array in derived.items():
            if columns[name].extensive:
                out[name] = array * scale
            else:
                out[name] = array
        xray_names = [name for name, column in columns.items() if column.of == "xray"]
        if xray_names:
            # these are not proportional to mass
            constants = {n: np.full(scale.size, v) for n, v in fixed.items() if n != "mass"}
            _, quantities = self.models(constants | parameters, scale)
            for name in xray_names:
                out[name] = quantities[name]
        return out

    def _reduced(self, weight, values, derived, flux, axes, pairs, rng):
        """Reduce a weighted sample to what results hold of it, by name."""
        size = {name: axis.values.size for name, axis in axes.items()}
        cells = {name: _cell(axis, values[name]) for name, axis in axes.items()}
        # one cell of the AGN fraction where it is no axis
        cells.setdefault("frac_agn", np.zeros(weight.size, dtype=np.int64))
        size.setdefault("frac_agn", 1)

        def joint(x, y):
            place = cells[x] * size[y] + cells[y]
            sums = np.bincount(place, weight, minlength=size[x] * size[y])
            return sums.reshape(size[x], size[y])

        columns = [values[name] for name in axes] + list(derived.values())
        # parameters first, then derived quantities
        summaries = [draws_summary(array, weight=weight) for array in columns]
        moments, quantiles = zip(*summaries, strict=True)
        n = len(axes)
        # posterior mean and standard deviation of the model fluxes
        mean = weight @ flux
        drawn = rng.permutation(systematic_draws(weight, self.request.n_draws, rng))
        return {
            "pdf": {n: np.bincount(cells[n], weight, minlength=size[n]) for n in axes},
            "pdf_2d": joint("redshift", "frac_agn"),
            "pairs": {(x, y): joint(x, y) for x, y in pairs},
            "axis_moments": np.array(moments[:n])[:, :2],
            "axis_quantiles": quantiles[:n],
            "moments": moments[n:],
            "quantiles": quantiles[n:],
            "draws": np.column_stack(columns)[drawn],
            "model_flux": mean,
            "model_flux_std": np.sqrt(weight @ np.square(flux - mean)),
        }


def _cell(axis, values):
    """Find the cell of an axis in which each value lies; the outermost take values beyond."""
    # inner edges alone: the outermost cells are open
    edges = cell_edges(axis.values, axis.bounds)
    return np.searchsorted(edges[1:-1], values, side="right")
