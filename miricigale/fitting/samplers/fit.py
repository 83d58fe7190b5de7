"""Fits with continuous parameters by a nested sampler, and what it finds as results."""

from dataclasses import dataclass
from functools import partial

import numpy as np

from miricigale.filters import FilterSet
from miricigale.fitting.likelihood import FitFlags
from miricigale.fitting.posterior import cell_edges, check_pairs
from miricigale.fitting.priors import GridAxis
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.fitting.results import FitResults
from miricigale.fitting.samplers import CITATIONS
from miricigale.fitting.samplers.run import ContinuousEngine, FluxModel, systematic_draws
from miricigale.fitting.samplers.space import Space, redshift_axis
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.random import stream
from miricigale.utils.units import MASS

_TRIALS = 64
#: Numbers that each object has, whatever the model.
_SINGLE = ("chi2", "log_evidence", "log_evidence_err", "n_calls", "n_effective", "converged")


@dataclass(frozen=True, eq=False)
class SamplerFit:
    """
    How `~miricigale.fitting.BayesFitter` fits with a nested sampler; picklable.

    ``redshift_given`` is whether the priors say something of the redshift.
    """

    engine: ContinuousEngine
    space: Space
    redshift_given: bool

    #: Objects in a piece of the catalog.
    chunk_size = 1

    @classmethod
    def of_model(cls, model, filters, priors, settings, *, sampler, scale_error):
        """Work out the priors of a model, and set the sampler up."""
        if not isinstance(model, FluxModel):
            raise argument_error("model", "an SEDModel", type(model).__name__)
        if not isinstance(priors, dict):
            raise argument_error("priors", "a dict of parameters", type(priors).__name__)
        predict = settings.predict
        names = tuple(n for some in (filters, predict) for n in getattr(some, "names", some))
        bands = FilterSet([*filters, *predict]) if isinstance(model, SEDModel) else names
        engine = ContinuousEngine(
            model=model,
            filters=bands,
            names=names,
            sampler=sampler,
            request=settings,
            profile="mass" not in priors,
            scale_error=scale_error,
        )
        fit = cls(engine, Space.of_model(model, priors), "redshift" in priors)
        fit._check_libraries()
        return fit

    def _check_libraries(self):
        """Refuse priors of which no draw can be evaluated by some component."""
        if not isinstance(self.engine.model, SEDModel):
            return
        points = np.random.default_rng(0).random((_TRIALS, self.space.n_dim))
        values = self.space.values(points)
        rows = [{name: float(v[i]) for name, v in values.items()} for i in range(_TRIALS)]
        for component in self.engine.model.components:
            if not component.refuses:
                continue
            why = [component.invalid(row) for row in rows]
            if all(why):
                names = [name for name in component.parameters if name in self.space.free]
                wanted = f"values that {component.name!r} has, such as a list of them"
                argument = " and ".join(f"priors[{name!r}]" for name in names)
                raise argument_error(argument, wanted, f"none: {why[0]}")

    @property
    def filters(self):
        """Bands of the models."""
        return self.engine.names

    @property
    def priors(self):
        """Prior of each free parameter by name."""
        return self.space.free

    @property
    def citations(self):
        """What to cite for model and sampler."""
        engine, known = self.engine.sampler, self.engine.model.meta.get("citations", ())
        return (*known, *(CITATIONS.get(engine, ()) if isinstance(engine, str) else ()))

    @property
    def content(self):
        """What makes a fit another one, besides `settings`: name to anything with a checksum."""
        model, request = self.engine.model, self.engine.request
        recipe = model.recipe if isinstance(model, SEDModel) else type(model)
        return {"space": self.space, "model": recipe, "draws": (request.n_draws, request.n_cells)}

    @property
    def edge_weight(self):
        """Weight of the first or last cell of redshift above which an object is flagged."""
        return max(0.01, 2.0 / self.engine.request.n_cells)

    def settings(self):
        """Return the settings of the fit as plain values."""
        request = self.engine.request
        fixed = self.space.fixed.items()
        return {
            "priors": {name: str(prior) for name, prior in self.space.free.items()},
            "mass": "profile" if self.engine.profile else "parameter",
            "scale_error": self.engine.scale_error,
            "n_live": request.n_live,
            "n_effective": request.n_effective,
            "max_calls": request.max_calls,
            "options": {name: str(value) for name, value in request.options.items()},
            "constants": {name: v for name, v in fixed if name not in ("mass", "redshift")},
        }

    def provenance(self):
        """Return what results say of the model."""
        known = self.engine.model.meta.items()
        return {"model": {k: v for k, v in known if k != "citations"}}

    def check_data(self, data):
        """All data will do."""

    def redshifts(self, photometry, redshift, redshift_prior, flags):
        """
        `Space` of every object, number of free parameters, and "fixed", "prior" or "free".

        See `~miricigale.fitting.grid_fit.GridFit.redshifts`.
        """
        space = self.space
        if redshift is not None:
            kind = "fixed"
            spaces = space.at_redshifts(self._limits, photometry, redshift, flags)
        elif redshift_prior is not None:
            if "redshift" in space.fixed and self.redshift_given:
                raise argument_error("redshift_prior", "None where 'priors' fix it", "densities")
            kind = "prior"
            spaces = space.with_densities(self._limits, redshift_prior, flags)
        elif not self.redshift_given:
            msg = "'priors' must have 'redshift', or 'redshift' or 'redshift_prior' be given"
            raise ValueError(msg)
        else:
            kind = "free" if "redshift" in space.free else "fixed"
            spaces = [space] * len(flags)
        if any(one.n_dim == 0 for one in spaces):
            raise argument_error("priors", "at least one free parameter", "none")
        n_free = max((one.n_dim for one in spaces), default=0) + self.engine.profile
        return spaces, n_free, kind

    @property
    def _limits(self):
        """Least and largest redshift."""
        prior = self.space.free.get("redshift", self.engine.model.parameters["redshift"])
        return prior.bounds

    # ------------------------------------------------------------------------- fit

    def task(self, pairs, seed, spaces):
        """Function that fits a piece of the catalog; every object has its own random stream."""
        axes = self._axes(spaces)
        parameters = self.engine.model.parameters
        constant = [name for name in parameters if name not in axes and name != "mass"]
        wanted = "of free parameters but mass ('samples' of the results has draws of all)"
        pairs = check_pairs(pairs, axes, constant, ("mass", *self.engine.columns), wanted)
        return partial(self._fit_piece, axes, pairs, seed)

    def _axes(self, spaces):
        """Cells of all parameters that are free for some object, and of redshift."""
        model = self.engine.model
        agn = model.component("agn") if isinstance(model, SEDModel) else None
        of_agn = () if agn is None else tuple(agn.parameters)
        axes, n_cells = {}, self.engine.request.n_cells
        for name in ("redshift", *self.space.free):
            if name == "mass" or name in axes:
                continue
            if name == "redshift":
                nodes, weights, bounds = redshift_axis(spaces, self._limits, n_cells)
            else:
                nodes, weights, bounds = self.space.free[name].cells(n_cells)
            kind = "agn" if name in of_agn else "galaxy"
            kind = name if name in ("redshift", "frac_agn") else kind
            unit = 1 if name == "redshift" else model.parameters[name].unit
            axes[name] = GridAxis(name, nodes, unit, kind, weights, None, bounds)
        return axes

    def _fit_piece(self, axes, pairs, seed, piece):
        """`FitResults` of a piece: its photometry, parameters and priors."""
        data, spaces = piece
        flags, n = np.array(data.flags), len(data)
        columns = self.engine.columns
        quantities = ("mass", *columns)
        size = {name: axis.values.size for name, axis in axes.items()}
        n_levels, n_bands = len(DERIVED_LEVELS), len(self.filters)
        shapes = {
            "pdf_2d": (size["redshift"], size.get("frac_agn", 1)),
            "axis_moments": (len(axes), 2),
            "axis_quantiles": (len(axes), n_levels),
            "moments": (len(quantities), 3),
            "quantiles": (len(quantities), n_levels),
            "draws": (self.engine.request.n_draws, len(axes) + len(quantities)),
            **dict.fromkeys(("model_flux", "model_flux_std", "best_flux"), (n_bands,)),
            **dict.fromkeys(_SINGLE, ()),
        }
        out = {name: np.full((n, *shape), np.nan) for name, shape in shapes.items()}
        out |= {
            "pdf": {name: np.full((n, size[name]), np.nan) for name in axes},
            "pairs": {(x, y): np.full((n, size[x], size[y]), np.nan) for x, y in pairs},
            "best": {name: np.full(n, np.nan) for name in (*axes, *quantities)},
        }
        for row in np.flatnonzero((flags & int(FitFlags.UNFITTED)) == 0):
            found = self.engine.fit(data._take(row), spaces[row], seed)
            if found is None:
                flags[row] |= int(FitFlags.NO_MODEL)
                continue
            draw = stream(seed, "draws", str(data.ids[row]))
            for name, value in self._reduce(found, spaces[row].fixed, axes, pairs, draw).items():
                if isinstance(value, dict):
                    for key, array in out[name].items():
                        array[row] = value[key]
                else:
                    out[name][row] = value
        out["n_calls"] = np.nan_to_num(out["n_calls"]).astype(np.int64)
        out["converged"] = np.nan_to_num(out["converged"]).astype(bool)
        return FitResults(
            **data.columns,
            flags=flags,
            filters=self.filters,
            axes=axes,
            best_index=np.full((n, 4), -1),
            best_scale=out["best"]["mass"],
            quantities=quantities,
            units=(MASS, *(column.unit for column in columns.values())),
            descriptions=("mass of stars formed", *(c.text for c in columns.values())),
            intensive=tuple(name for name, column in columns.items() if not column.extensive),
            constants=self.settings()["constants"],
            **out,
        )

    def _reduce(self, found, fixed, axes, pairs, rng):
        """What results hold of a weighted sample, by their names."""
        weight, values, best = found.weight, dict(found.parameters), dict(found.best)
        for name in axes:
            if name not in values:
                values[name] = np.full(weight.size, fixed[name])
                best[name] = fixed[name]
        size = {name: axis.values.size for name, axis in axes.items()}
        cells = {name: _cell(axis, values[name]) for name, axis in axes.items()}
        # one cell of the AGN fraction where it is no axis
        cells.setdefault("frac_agn", np.zeros(weight.size, dtype=np.int64))
        n_f = size.setdefault("frac_agn", 1)

        def joint(x, y):
            place = cells[x] * size[y] + cells[y]
            sums = np.bincount(place, weight, minlength=size[x] * size[y])
            return sums.reshape(size[x], size[y])

        axis_parts = [_summary(values[name], weight) for name in axes]
        parts = [_summary(array, weight) for array in found.derived.values()]
        columns = [values[name] for name in axes] + list(found.derived.values())
        mean, n_draws = weight @ found.flux, self.engine.request.n_draws
        return {
            "pdf": {n: np.bincount(cells[n], weight, minlength=size[n]) for n in axes},
            "pdf_2d": joint("redshift", "frac_agn").reshape(-1, n_f),
            "pairs": {(x, y): joint(x, y) for x, y in pairs},
            "axis_moments": [part[0][:2] for part in axis_parts],
            "axis_quantiles": [part[1] for part in axis_parts],
            "moments": [part[0] for part in parts],
            "quantiles": [part[1] for part in parts],
            "draws": np.column_stack(columns)[
                rng.permutation(systematic_draws(weight, n_draws, rng))
            ],
            "model_flux": mean,
            "model_flux_std": np.sqrt(weight @ np.square(found.flux - mean)),
            "best": best,
            "best_flux": found.best_flux,
            **{name: getattr(found, name) for name in _SINGLE},
        }


def _cell(axis, values):
    """Cell of an axis in which each value lies; the outermost take what is beyond."""
    if axis.values.size == 1:
        return np.zeros(values.size, dtype=np.int64)
    edges = cell_edges(axis.values, axis.bounds)
    return np.searchsorted(edges[1:-1], values, side="right")


def _summary(values, weight):
    """Mean, standard deviation and mean of log10, and quantiles, of a weighted sample."""
    good = np.isfinite(values)
    levels = np.asarray(DERIVED_LEVELS)
    if not good.any():
        return np.full(3, np.nan), np.full(levels.size, np.nan)
    values, weight = values[good], weight[good] / weight[good].sum()
    mean = weight @ values
    std = np.sqrt(weight @ np.square(values - mean))
    positive = values > 0
    log_mean = np.nan
    if positive.any():
        log_mean = weight[positive] @ np.log10(values[positive]) / weight[positive].sum()
    order = np.argsort(values, kind="stable")
    middle = np.cumsum(weight[order]) - 0.5 * weight[order]
    return np.array([mean, std, log_mean]), np.interp(levels, middle, values[order])
