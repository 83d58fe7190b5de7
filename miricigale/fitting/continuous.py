"""ContinuousFitter: posteriors of continuous parameters by nested sampling."""

import numpy as np

from miricigale.filters import FilterSet
from miricigale.fitting.continuous_results import ContinuousResults
from miricigale.fitting.engines.base import CITATIONS, Request, get_sampler
from miricigale.fitting.engines.continuous import ContinuousEngine, Target
from miricigale.fitting.engines.redshifts import fixed_redshifts, given_redshifts
from miricigale.fitting.engines.reduce import FitOne
from miricigale.fitting.engines.space import Choice, Flat, Space, Table, prior_cells
from miricigale.fitting.flags import FitFlags
from miricigale.fitting.likelihood import per_band, read_photometry, unused_bands
from miricigale.fitting.pairs import named_pairs
from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.priors import GridAxis
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.parallel import parallel_map, single_threaded
from miricigale.utils.random import check_seed
from miricigale.utils.units import MASS

__all__ = ["ContinuousFitter"]

_TRIALS = 64


class ContinuousFitter:
    """
    Fit photometry with continuous parameters, object by object, by a nested sampler.

    The likelihood is that of `BayesFitter`: Gaussian, with ``model_error`` of the flux in
    quadrature, and the error-function term for upper limits. Unless ``priors`` names ``mass``,
    each model has the mass that fits best, with its Gaussian error: what the grid sums over is
    sampled here. Models older than the universe, or impossible together, have no weight.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model.
    filters : list of str or `~miricigale.filters.FilterSet`
        Bands to fit.
    priors : dict
        Prior of every free parameter by name; others are at the defaults of the model.

        - ``(low, high)``: flat; ``(low, high, "log")``: flat in the logarithm; ``"flat"`` and
          ``"log"``: the same over the bounds of the parameter;
        - a list or array: these values only, as for parameters of libraries (metallicity, the
          torus); ``(values, weights)``: of these weights;
        - a frozen distribution of `scipy.stats`, cut to the bounds of the parameter;
        - a number: a fixed value.
    engine : {"nautilus", "dynesty"} or callable, optional
        The sampler; a callable does what `miricigale.fitting.engines.base.get_sampler` says.
    predict : list of str or `~miricigale.filters.FilterSet`, optional
        More bands, in which the fluxes of the models are predicted.
    model_error : float or dict of str to float, optional
        Part of the flux that is added to its error in quadrature, for all or by filter.
    error_floor : float or dict of str to float, optional
        Least relative error of a flux, for all or by filter.
    n_bands_min : int, optional
        Objects with fewer usable bands are flagged and not fitted.
    max_reduced_chi2 : float, optional
        Above this reduced chi2 of the best model an object is flagged.
    scale_error : bool, optional
        Whether the uncertainty of each model's own mass is part of the posterior.
    n_live : int, optional
        Live points of the sampler; more for posteriors of several narrow peaks.
    n_effective : int, optional
        Effective size that the sample shall have (nautilus; dynesty's follows from ``n_live``).
    max_calls : int, optional
        Models evaluated for one object at most (dynesty counts the steps of its walkers, some of
        which leave the prior); ``converged`` of the results tells.
    n_draws : int, optional
        Draws of equal weight that are kept for each object.
    n_cells : int, optional
        Cells of each axis, for PDFs and plots.
    options : dict, optional
        Passed on to the sampler.

    Raises
    ------
    ImportError
        If the sampler is not installed; the message holds the pip command.
    KeyError
        If there is no engine or parameter of a name.
    ValueError
        If a prior is none, or leaves values that the libraries of the model do not have.

    Examples
    --------
    >>> from miricigale.fitting import ContinuousFitter
    >>> priors = {"redshift": (0.01, 6), "tau": (0.1, 10, "log"), "age": (0.1, 13), "ebv": (0, 1)}
    >>> fitter = ContinuousFitter(model, bands, priors=priors)  # doctest: +SKIP
    >>> results = fitter.fit(photometry, seed=1)  # doctest: +SKIP
    """

    def __init__(
        self,
        model,
        filters,
        *,
        priors,
        engine="nautilus",
        predict=(),
        model_error=0.1,
        error_floor=0.0,
        n_bands_min=2,
        max_reduced_chi2=100.0,
        scale_error=True,
        n_live=500,
        n_effective=2000,
        max_calls=500_000,
        n_draws=1000,
        n_cells=100,
        options=None,
    ):
        for name in ("fluxes", "parameters", "derived_columns"):
            if not hasattr(model, name):
                raise argument_error("model", "an SEDModel", type(model).__name__)
        self.model = model
        self.filters = _names(filters, "filters")
        names = (*self.filters, *_names(predict, "predict"))
        if len(set(names)) < len(names) or not self.filters:
            raise argument_error("filters", "different names, at least one", f"{list(names)}")
        self.names = names
        self.engine = engine
        get_sampler(engine)
        counts = {
            "n_bands_min": (n_bands_min, 1),
            "n_live": (n_live, 10),
            "n_effective": (n_effective, 1),
            "max_calls": (max_calls, 1),
            "n_draws": (n_draws, 1),
            "n_cells": (n_cells, 2),
        }
        for name, (value, least) in counts.items():
            if not (isinstance(value, (int, np.integer)) and value >= least):
                raise argument_error(name, f"an integer >= {least}", repr(value))
            setattr(self, name, int(value))
        if not max_reduced_chi2 > 0:
            raise argument_error("max_reduced_chi2", "positive", f"{max_reduced_chi2}")
        self.max_reduced_chi2 = float(max_reduced_chi2)
        self.model_error = per_band(model_error, self.filters, "model_error")
        self.error_floor = per_band(error_floor, self.filters, "error_floor")
        if not isinstance(priors, dict):
            raise argument_error("priors", "a dict of parameters", type(priors).__name__)
        self.space = Space.of_model(model, priors)
        self._redshift_given = "redshift" in priors
        self._profile = "mass" not in priors
        self._check_libraries()
        bands = names
        if isinstance(model, SEDModel):
            bands = FilterSet([*filters, *predict])
        self._engine = ContinuousEngine(
            model=model,
            filters=bands,
            names=names,
            sampler=engine,
            request=Request(self.n_live, self.n_effective, self.max_calls, dict(options or {})),
            profile=self._profile,
            scale_error=bool(scale_error),
        )

    def __repr__(self):
        free = ", ".join(self.space.free)
        return f"<ContinuousFitter of {self.model!r}, {len(self.filters)} bands, free: {free}>"

    def _check_libraries(self):
        """Refuse priors of which no draw can be evaluated by some component."""
        points = np.random.default_rng(0).random((_TRIALS, self.space.n_dim))
        values = self.space.values(points)
        rows = [{name: float(v[i]) for name, v in values.items()} for i in range(_TRIALS)]
        for component in getattr(self.model, "components", ()):
            if not component.refuses:
                continue
            why = [component.invalid(row) for row in rows]
            if all(why):
                names = [name for name in component.parameters if name in self.space.free]
                wanted = f"values that {component.name!r} has, such as a list of them"
                argument = " and ".join(f"priors[{name!r}]" for name in names)
                raise argument_error(argument, wanted, f"none: {why[0]}")

    def fit(
        self,
        photometry,
        *,
        redshift=None,
        redshift_prior=None,
        pairs=None,
        seed=None,
        executor=None,
        progress_bar=False,
    ):
        """
        Fit a catalogue.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            As for `BayesFitter.fit`: ``id``, a flux column for each filter, its error
            ``<name>_err`` and, if there are upper limits, a boolean ``<name>_limit``. Objects
            with limits only are flagged, not fitted.
        redshift : str or array_like, optional
            Column of ``photometry``, or values, of known redshifts.
        redshift_prior : tuple, optional
            Redshifts, ascending, shape (n_z,), and the density of the prior there, shape (n_z,)
            or (n, n_z); linear between them. It takes the place of the prior of redshift,
            within its limits.
        pairs : list of tuple of str, optional
            Pairs of free parameters (``results.axes``), the mass not among them, of which joint
            posteriors are kept too: the weight of the sample in each cell of both axes. Draws of
            any two, and of derived quantities, are in ``results.samples``.
        seed : int or `~numpy.random.Generator`, optional
            Every object has its own stream, from the seed and its id.
        executor : `concurrent.futures.Executor`, optional
            Fits objects at the same time; the answer is the same. Processes serve better than
            threads: samplers are Python.
        progress_bar : bool, optional
            Whether to show one.

        Returns
        -------
        results : `~miricigale.fitting.ContinuousResults`
            One row for each object, in the order of the catalogue; those that could not be
            fitted are flagged.

        Raises
        ------
        KeyError
            If a name in ``pairs`` is unknown.
        ValueError
            If a column is missing, an id is masked, ``redshift`` or ``redshift_prior`` has the
            wrong shape, nothing is free, or ``pairs`` has a parameter twice, one with a single
            value, or a derived quantity.
        `~astropy.units.UnitsError`
            If a flux column has no unit of flux density.
        """
        seed = check_seed(seed)
        data = read_photometry(
            photometry,
            self.filters,
            model_error=self.model_error,
            error_floor=self.error_floor,
            n_bands_min=self.n_bands_min,
            grid_filters=self.names,
        )
        unused = unused_bands(photometry, self.filters)
        flags = data.flags.copy()
        spaces, kind = self._spaces(photometry, redshift, redshift_prior, flags)
        unfitted = (flags & int(FitFlags.UNFITTED)) != 0
        axes = self._axes(spaces)
        rows = np.flatnonzero(~unfitted)
        targets = [
            Target(str(data.ids[i]), data.flux[i], data.sigma[i], data.limit[i], spaces[i])
            for i in rows
        ]
        constant = [name for name in self.model.parameters if name not in axes and name != "mass"]
        derived = ("mass", *self._engine.columns)
        wanted = "of free parameters but mass ('samples' of the results has draws of all)"
        pairs = named_pairs(pairs, axes, constant, derived, wanted)
        task = FitOne(self._engine, axes, seed, self.n_draws, pairs)
        # here too, for threads of one process share this setting
        with single_threaded():
            parts = parallel_map(
                task, targets, executor=executor, progress_bar=progress_bar, desc="fit"
            )
        for row, part in zip(rows, parts, strict=True):
            if part is None:
                flags[row] |= int(FitFlags.NO_MODEL)
        done = {int(row): part for row, part in zip(rows, parts, strict=True) if part is not None}
        meta = provenance(
            citations=[*self.model.meta.get("citations", ()), *CITATIONS.get(self.engine, ())],
            fit=self.settings(kind) | {"unused_bands": unused, "seed": seed},
            model={k: v for k, v in self.model.meta.items() if k != "citations"},
        )
        return self._results(data, flags, axes, done, meta, pairs)

    def settings(self, redshift="free"):
        """Return what the fit was told, for the meta of results: a dict of plain values."""
        engine = self.engine if isinstance(self.engine, str) else repr(self.engine)
        fixed = {n: v for n, v in self.space.fixed.items() if n not in ("mass", "redshift")}
        request = self._engine.request
        return {
            "engine": engine,
            "filters": list(self.filters),
            "redshift": redshift,
            "priors": {name: str(prior) for name, prior in self.space.free.items()},
            "mass": "profile" if self._profile else "parameter",
            "scale_error": self._engine.scale_error,
            "model_error": dict(zip(self.filters, self.model_error.tolist(), strict=True)),
            "error_floor": dict(zip(self.filters, self.error_floor.tolist(), strict=True)),
            "n_bands_min": self.n_bands_min,
            "n_live": self.n_live,
            "n_effective": self.n_effective,
            "max_calls": self.max_calls,
            "options": {name: str(value) for name, value in request.options.items()},
            "constants": fixed,
        }

    # ------------------------------------------------------------------- redshifts

    def _spaces(self, photometry, redshift, redshift_prior, flags):
        """Parameters and priors of every object, and how the redshift is known."""
        n = len(photometry)
        if redshift is not None and redshift_prior is not None:
            msg = "'redshift' and 'redshift_prior' must not be given both"
            raise ValueError(msg)
        if redshift is None and redshift_prior is None and not self._redshift_given:
            msg = "'priors' must have 'redshift', or 'redshift' or 'redshift_prior' be given"
            raise ValueError(msg)
        if redshift is not None:
            kind = "fixed"
            spaces = fixed_redshifts(self.space, self._range, photometry, redshift, flags)
        elif redshift_prior is not None:
            if "redshift" in self.space.fixed and self._redshift_given:
                raise argument_error("redshift_prior", "None where 'priors' fix it", "densities")
            kind = "prior"
            spaces = given_redshifts(self.space, self._range, n, redshift_prior, flags)
        else:
            spaces = [self.space] * n
            kind = "free" if "redshift" in self.space.free else "fixed"
        if any(space.n_dim == 0 for space in spaces):
            raise argument_error("priors", "at least one free parameter", "none")
        return spaces, kind

    @property
    def _range(self):
        """Least and largest redshift."""
        prior = self.space.free.get("redshift")
        if prior is None:
            return self.model.parameters["redshift"].bounds
        if isinstance(prior, Choice):
            return prior.values[0], prior.values[-1]
        return prior.bounds

    # --------------------------------------------------------------------- results

    def _axes(self, spaces):
        """Cells of all parameters that are free for some object, and of redshift."""
        parameters = self.model.parameters
        agn = getattr(self.model, "component", lambda role: None)("agn")
        of_agn = () if agn is None else tuple(agn.parameters)
        axes = {"redshift": self._redshift_axis(spaces)}
        for name, prior in self.space.free.items():
            if name in ("mass", "redshift"):
                continue
            nodes, weights, bounds = prior_cells(prior, self.n_cells)
            kind = "agn" if name in of_agn else "galaxy"
            kind = "frac_agn" if name == "frac_agn" else kind
            unit = parameters[name].unit
            axes[name] = GridAxis(name, nodes, unit, kind, weights, None, bounds)
        return axes

    def _redshift_axis(self, spaces):
        free = [space.free["redshift"] for space in spaces if "redshift" in space.free]
        if not free:
            values = [space.fixed["redshift"] for space in spaces]
            low, high = (min(values), max(values)) if values else (0.0, 0.0)
            if high > low:
                nodes, weights, bounds = prior_cells(Flat(low, high), self.n_cells)
            else:
                nodes, weights, bounds = np.array([low]), np.ones(1), (low, low)
        elif all(prior is free[0] for prior in free):
            nodes, weights, bounds = prior_cells(free[0], self.n_cells)
        else:
            ends = [(p.value[0], p.value[-1]) for p in free if isinstance(p, Table)]
            low, high = (min(e[0] for e in ends), max(e[1] for e in ends)) if ends else self._range
            nodes, _, bounds = prior_cells(Flat(low, high), self.n_cells)
            edges = cell_edges(nodes, bounds)
            # the mean prior of the catalogue
            cdf = np.mean([p.cdf(edges) for p in free if isinstance(p, Table)] or [edges], axis=0)
            weights = np.diff(cdf) / (cdf[-1] - cdf[0])
        return GridAxis("redshift", nodes, 1, "redshift", weights, None, bounds)

    def _results(self, data, flags, axes, done, meta, pairs):
        n = len(data.ids)
        derived = self._engine.columns
        quantities = ("mass", *derived)
        n_z = axes["redshift"].values.size
        n_f = axes["frac_agn"].values.size if "frac_agn" in axes else 1
        levels, n_axes, n_q = len(DERIVED_LEVELS), len(axes), len(quantities)
        shapes = {
            "pdf_2d": (n_z, n_f),
            "axis_moments": (n_axes, 2),
            "axis_quantiles": (n_axes, levels),
            "moments": (n_q, 3),
            "quantiles": (n_q, levels),
            "draws": (self.n_draws, n_axes + n_q),
            "model_flux": (len(self.names),),
            "model_flux_std": (len(self.names),),
            "best_flux": (len(self.names),),
            **dict.fromkeys(("chi2", "log_evidence", "log_evidence_err"), ()),
            **dict.fromkeys(("n_calls", "n_effective", "converged"), ()),
        }
        out = {name: np.full((n, *shape), np.nan) for name, shape in shapes.items()}
        pdf = {name: np.full((n, axis.values.size), np.nan) for name, axis in axes.items()}
        size = {name: axis.values.size for name, axis in axes.items()}
        joint = {(x, y): np.full((n, size[x], size[y]), np.nan) for x, y in pairs}
        best = {name: np.full(n, np.nan) for name in (*axes, *quantities)}
        for row, part in done.items():
            for name in shapes:
                out[name][row] = part[name]
            for name in axes:
                pdf[name][row] = part["pdf"][name]
            for names in joint:
                joint[names][row] = part["pairs"][names]
            for name in best:
                best[name][row] = part["best"][name]
        n_bands = data.used.sum(axis=1)
        with np.errstate(invalid="ignore"):
            reduced = out["chi2"] / np.where(n_bands > 1, n_bands - 1, np.nan)
            flags[reduced > self.max_reduced_chi2] |= int(FitFlags.HIGH_CHI2)
            flags[best["mass"] <= 0] |= int(FitFlags.NO_SIGNAL)
            if "redshift" in self.space.free:
                edge = np.maximum(pdf["redshift"][:, 0], pdf["redshift"][:, -1])
                flags[edge > max(0.01, 2.0 / n_z)] |= int(FitFlags.REDSHIFT_EDGE)
        out["n_calls"] = np.nan_to_num(out["n_calls"]).astype(np.int64)
        out["converged"] = np.nan_to_num(out["converged"]).astype(bool)
        return ContinuousResults(
            ids=data.ids,
            flags=flags,
            n_bands=n_bands,
            filters=self.names,
            flux=data.flux,
            flux_err=data.flux_err,
            sigma=data.sigma,
            limit=data.limit,
            axes=axes,
            pdf=pdf,
            pairs=joint,
            best_index=np.full((n, 4), -1),
            best_scale=best["mass"],
            best=best,
            quantities=quantities,
            units=(MASS, *(column.unit for column in derived.values())),
            descriptions=("mass of stars formed", *(c.text for c in derived.values())),
            intensive=tuple(name for name, column in derived.items() if not column.extensive),
            meta=meta,
            model=self.model,
            **out,
        )


def _names(filters, argument):
    if isinstance(filters, str):
        raise argument_error(argument, "a list of names or a FilterSet", repr(filters))
    return tuple(getattr(filters, "names", filters))
