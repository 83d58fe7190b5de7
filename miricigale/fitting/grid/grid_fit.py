"""Fits on a model grid: priors of redshift, joint posteriors, and what the engine finds as results."""

from dataclasses import replace
from functools import partial

import numpy as np

from miricigale.filters import FilterSet
from miricigale.fitting.data.likelihood import FitFlags, filter_names
from miricigale.fitting.data.settings import GridSettings
from miricigale.fitting.data.template_error import TemplateError, grid_errors
from miricigale.fitting.grid.between_results import between_results, with_axis_summaries
from miricigale.fitting.grid.continuation import N_START, Continuation
from miricigale.fitting.grid.drawn_models import draw_samples
from miricigale.fitting.grid.grid import GridEngine
from miricigale.fitting.grid.interpolation import InterpolatedModels
from miricigale.fitting.grid.mixture import BandMixture
from miricigale.fitting.grid.nuclei import NuclearGrid, fit_with_nuclei
from miricigale.fitting.grid.relative_errors import RelativeErrors
from miricigale.fitting.posterior.populations import MassPrior, expected_sfr, sfr_log_prior
from miricigale.fitting.posterior.posterior import check_pairs, joint_names, joint_tables
from miricigale.fitting.posterior.priors import (
    density_log_prior,
    fixed_log_prior,
    grid_priors,
    known_redshifts,
)
from miricigale.fitting.posterior.quantities import Quantities, column_values
from miricigale.fitting.results.results import CIGALE_LEAST_STD, FitResults
from miricigale.sed import ModelGrid, SEDModel
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_choice, check_that
from miricigale.utils.parallel import chunks
from miricigale.utils.units import MASS
from miricigale.utils.values import value_class

#: Best chi2 above which exp(-chi2 / 2) is below the smallest normal number for every model.
VANISHING_CHI2 = 1417.0
#: Numbers of joint sums that a piece may have at once (32 MB).
_JOINT_SIZE = 1 << 22
#: Weight of one galaxy model, and of one redshift, above which an object is flagged.
_ONE_NODE_WEIGHT = 0.95


@value_class
class GridFit:
    """
    How `~miricigale.fitting.BayesFitter` fits with every model of a grid; picklable.

    ``given`` are the settings of the fitter, without the model of a finer grid, which ``between`` has made.
    """

    engine: GridEngine
    given: GridSettings
    compat: str | None
    template_error: TemplateError | None = None
    between: Continuation | None = None
    nuclei: NuclearGrid | None = None
    relative_errors: RelativeErrors | None = None

    #: Weight of the first or last redshift above which an object is flagged.
    edge_weight = 0.01

    @classmethod
    def of_model(
        cls,
        model,
        filters,
        priors,
        settings,
        *,
        axes,
        scale_error,
        compat,
        template_error,
        outliers,
        calibration,
    ):
        """Set up the engine with a grid, which is made of a model, its priors and derived quantities."""
        check_choice(compat, "compat", (None, "cigale"))
        finer = settings.finer
        interpolate = settings.interpolate
        if compat == "cigale":
            interpolate = 0
        grid = model
        if isinstance(model, SEDModel):
            if finer not in (None, model):
                raise argument_error("finer", "left out when 'model' is an SEDModel", "another one")
            grid = model.grid(axes, filters)
            finer = None
            if interpolate:
                finer = model
        elif axes is not None:
            raise argument_error("axes", "None when 'model' is a ModelGrid", "a value")
        elif not isinstance(model, ModelGrid):
            wanted = "a ModelGrid, an SEDModel or a list of bands (fit(catalog) takes the catalog)"
            raise argument_error("model", wanted, type(model).__name__)
        if settings.agn_error and compat:
            raise argument_error("agn_error", "0 with 'compat'", f"{settings.agn_error}")
        check_that(outliers is None or not compat, "outliers", "None with 'compat'", outliers)
        if calibration is not None:
            axis_values = {name: axis.values for name, axis in grid_priors(grid).axes.items()}
            priors = calibration.grid_priors(axis_values) | (priors or {})
        priors = grid_priors(grid, priors, prior_f=settings.prior_f)
        bands = filters
        if model is grid:
            bands = grid.filters
        if calibration is not None and outliers is None and not compat:
            outliers = calibration.of_bands("outlier", filter_names("filters", bands), 0.0)
        engine = GridEngine(
            grid=grid,
            priors=priors,
            quantities=Quantities.of_grid(grid),
            galaxy=grid.galaxy,
            agn=grid.agn,
            usable=grid.allowed & (priors.galaxy > 0),
            template_error=grid_errors(template_error, bands, grid.redshift),
            mass_prior=sfr_log_prior(settings.sfr_prior, grid),
            density=MassPrior.of_grid(settings.mass_function, grid),
            rtol=float(settings.rtol),
            scale_error=scale_error,
            mixture=BandMixture.of_bands(outliers, bands),
        )
        out = cls(engine, replace(settings, finer=None), compat, template_error)
        # there is nothing between a single model or templates
        free_axes = {name for name, axis in priors.axes.items() if axis.values.size > 1}
        if not interpolate or not free_axes or "template" in free_axes:
            return out
        if finer is None:
            models = InterpolatedModels.of_grid(grid, priors.axes)
        else:
            bands = grid.filters
            if isinstance(filters, FilterSet) and tuple(filters.names) == grid.filters:
                # the curves of the user
                bands = filters
            models = InterpolatedModels.of_model(finer, grid, bands, out.constants, priors.axes)
        return replace(out, between=Continuation(engine, models, float(settings.agn_error)))

    def with_nuclei(self, bands):
        """
        Return the fit for data with nuclei.

        Parameters
        ----------
        bands : list of str
            Bands that have them.

        Raises
        ------
        ValueError
            If the models have no AGN.
        """
        has_agn = self.grid.n_agn > 0 and np.any(self.grid.frac_agn > 0)
        wanted = "False for models without AGN, whose fluxes those of nuclei are"
        check_that(has_agn, "nuclei", wanted, "True")
        index = tuple(self.filters.index(band) for band in bands)
        error = 0.0
        if self.between is not None:
            error = self.between.agn_error
        stars = float(self.given.nuclear_stars)
        return replace(self, nuclei=NuclearGrid(self.engine, index, stars, error))

    @property
    def wrong_part(self):
        """Prior fraction of wrong fluxes of each band: shape (nb,)."""
        if self.engine.mixture is None:
            return np.zeros(len(self.filters))
        return self.engine.mixture.part

    def with_relative_errors(self, part):
        """
        Return the fit for data to whose errors parts of the expected flux are to be added.

        Parameters
        ----------
        part : dict of str to float
            Parts of the flux by band; nothing changes without bands.
        """
        if not part:
            return self
        parts = np.array([part.get(band, 0.0) for band in self.filters])
        return replace(self, relative_errors=RelativeErrors(self.engine, parts))

    def with_all_errors(self, data, log_prior):
        """Add the errors that are parts of the expected flux to photometry, with ln of the prior of redshifts."""
        if self.relative_errors is None:
            return data
        return self.relative_errors.add_to(data, log_prior)

    @property
    def chunk_size(self):
        """Objects in a piece of the catalog."""
        return int(min(max(1e6 // max(self.engine.n_models, 1), 64), 1024))

    @property
    def grid(self):
        """The `~miricigale.sed.ModelGrid`."""
        return self.engine.grid

    @property
    def priors(self):
        """`~miricigale.fitting.posterior.priors.GridPriors`."""
        return self.engine.priors

    @property
    def filters(self):
        """Bands of the models."""
        return self.grid.filters

    @property
    def content(self):
        """What makes a fit another one, besides `settings`: name to anything with a checksum."""
        return {"grid": self.grid, "priors": self.priors}

    @property
    def constants(self):
        """Parameters of the grid that have one value, which have no posterior: name to float."""
        constants = {}
        for table in (self.grid.galaxy_parameters, self.grid.agn_parameters):
            for name in table.colnames:
                if name not in self.priors.axes and len(table):
                    constants[name] = float(column_values(table[name])[0])
        return constants

    def settings(self):
        """Return the settings of the fit as plain values."""
        error = self.template_error
        prior = self.engine.mass_prior
        interpolate = 0
        agn_error = 0.0
        if self.between is not None:
            interpolate = int(self.given.interpolate)
            agn_error = self.between.agn_error
        out = {
            "prior_f": self.given.prior_f,
            "rtol": self.engine.rtol,
            "scale_error": self.engine.scale_error,
            "compat": self.compat,
            "n_models": int(self.engine.n_models),
            "interpolate": interpolate,
            "agn_error": agn_error,
            "constants": self.constants,
        }
        if self.relative_errors is not None:
            out["errors_of_expected_flux"] = self._relative_bands
        if self.nuclei is not None:
            out["nuclei"] = [self.filters[i] for i in self.nuclei.bands]
            out["nuclear_stars"] = self.nuclei.stars
        if error is not None:
            wave = error.wave.value.tolist()
            out["template_error"] = {"wave": wave, "error": error.error.tolist()}
        if self.engine.mixture is not None:
            part = self.engine.mixture.part.tolist()
            out["outliers"] = dict(zip(self.filters, part, strict=True))
        if self.engine.density is not None:
            out["mass_function"] = repr(self.engine.density.mass_function)
        if prior is not None:
            relation, scatter, z = prior.args[:3]
            # a function is known by its values at some masses
            mass = [1e8, 1e10, 1e12] * MASS
            rates = [expected_sfr(relation, mass, end).tolist() for end in z[[0, -1]]]
            out["sfr_prior"] = {"scatter": scatter, "sfr": rates}
        if self.between is not None:
            out["tables"] = self.between.models.sizes
        if self.given.agn_bins is not None:
            out["agn_bins"] = repr(self.given.agn_bins)
        return out

    @property
    def _relative_bands(self):
        """Bands whose errors have a part of the expected flux: list of str."""
        part = self.relative_errors.part
        return [band for band, value in zip(self.filters, part, strict=True) if value > 0]

    def provenance(self):
        """Return what results say of the grid, and what to cite for it."""
        meta = {key: value for key, value in self.grid.meta.items() if key != "axes"}
        return {"citations": meta.pop("citations", ()), "grid": meta}

    def check_data(self, data):
        """Refuse limits in bands in which a model has negative flux."""
        for i in np.flatnonzero(data.limit.any(axis=0) & self.engine.negative):
            wanted = "without limits in bands in which a model has negative flux"
            raise argument_error("photometry", wanted, f"some in {self.filters[i]}")

    def redshifts(self, photometry, redshift, redshift_prior, flags):
        """
        Compute ln(prior) of the grid's redshifts for every object.

        ``flags``, of the n objects, are added to in place. Returned are the priors, shape (n, nz), the
        number of free parameters (the mass among them) and "fixed" or "free".
        """
        z = self.grid.redshift
        prior = self.priors.redshift
        allowed = self.engine.usable.any(axis=1) & (prior > 0)
        if redshift_prior is not None:
            log_prior = density_log_prior(redshift_prior, z, allowed, flags)
        elif redshift is not None:
            # on nodes alone a redshift of 0 is a node like others
            zero = bool(z[0] == 0) and self.between is None
            values = known_redshifts(photometry, redshift, zero=zero)
            log_prior = fixed_log_prior(values, z, allowed, self.given.redshift_tolerance, flags)
        else:
            if not allowed.any():
                flags |= FitFlags.NO_MODEL
            of_grid = np.log(prior, where=allowed, out=np.full(z.size, -np.inf))
            log_prior = np.tile(of_grid, (len(flags), 1))
        log_prior[(flags & FitFlags.UNFITTED) != 0] = -np.inf
        n_free = 1 + sum(axis.values.size > 1 for axis in self.priors.axes.values())
        if redshift is None:
            return log_prior, n_free, "free"
        return log_prior, n_free - (z.size > 1), "fixed"

    # ------------------------------------------------------------------------- fit

    def check_pairs(self, pairs):
        """Check pairs of parameters; see `~miricigale.fitting.posterior.posterior.check_pairs`."""
        derived = self.engine.quantities.names
        wanted = "of parameters of the grid ('sample' draws derived quantities jointly)"
        return check_pairs(pairs, self.priors.axes, self.constants, derived, wanted)

    def task(self, pairs, _seed, _log_prior):
        """Return a function that fits a piece of the catalog; nothing is drawn, and the prior comes with it."""
        return partial(self.fit_piece, self.check_pairs(pairs))

    def fit_piece(self, pairs, piece):
        """Fit a piece, its photometry and priors of redshift: `FitResults`."""
        data, log_prior = piece
        data = self.with_all_errors(data, log_prior)
        if data.nuclei is not None:
            return fit_with_nuclei(self, data, log_prior, pairs)
        if self.between is not None:
            return self._between_nodes(data, log_prior, pairs)
        return self._on_nodes(data, log_prior, pairs)

    def _on_nodes(self, data, log_prior, pairs):
        """Fit on nodes alone."""
        joint = joint_names(pairs, self.priors.axes)
        options = {}
        if joint:
            workspace = self.engine.workspace(joint=joint)
            options = {"joint": joint, "workspace": workspace}
        # joint sums are large: those of a few objects are reduced before the next are made
        size = self.engine.size
        # numbers in the joint sums of one object
        joint_size = sum(size[x] * size[y] for x, y in joint)
        step = max(1, min(_JOINT_SIZE // max(joint_size, 1), len(data)))
        parts = []
        for rows in list(chunks(len(data), step)) or [slice(0, 0)]:
            photometry = data[rows]
            out = self.engine.fit(**photometry.of_engine(log_prior[rows]), **options)
            parts.append(self.results_on_nodes(photometry, out, pairs))
        return FitResults.concatenate(parts)

    def _between_nodes(self, data, log_prior, pairs):
        """Return the results between nodes, and on nodes of objects that no model between them is possible for."""
        posteriors = self.between_posteriors(data, log_prior)
        parts = []
        rows = np.array(sorted(posteriors), int)
        if rows.size:
            found = [posteriors[i] for i in rows]
            parts.append(between_results(self, data[rows], found, pairs))
        others = np.setdiff1d(np.arange(len(data)), rows)
        if others.size or not parts:
            on_nodes = self._on_nodes
            if self.at_own_redshift(data):
                on_nodes = self._at_redshifts
            results = on_nodes(data[others], log_prior[others], pairs)
            parts.append(with_axis_summaries(results))
        order = np.argsort(np.concatenate([rows, others]), kind="stable")
        return FitResults.concatenate(parts)[order]

    def between_posteriors(self, data, log_prior):
        """Return the `BetweenPosterior` of the objects that a model between nodes is possible for: dict by row."""
        posteriors = {}
        fitted = np.isfinite(log_prior).any(axis=1)
        scanned = fitted & ~data.limit.any(axis=1)
        if self.between.scan is None:
            scanned[:] = False
        if scanned.any():
            self._scan(posteriors, data, log_prior, np.flatnonzero(scanned))
        others = np.flatnonzero(fitted & ~scanned)
        if others.size:
            self._sum_up(posteriors, data, log_prior, others)
        return {i: posterior for i, posterior in posteriors.items() if posterior is not None}

    def at_own_redshift(self, data):
        """Tell whether objects are fitted at redshifts of their own, which are not those of nodes."""
        return data.redshift is not None and self.grid.redshift.size > 1

    def _scan(self, posteriors, data, log_prior, rows):
        """Put `BetweenPosterior` of some objects, without limits, into a dict by row; None if there is none."""
        nodes = None
        at_redshift = self.at_own_redshift(data)
        if at_redshift:
            nodes = np.argmax(log_prior[rows], axis=1)

        def place(known):
            i = rows[known.row]
            node = None
            z = 0.0
            if at_redshift:
                node = int(nodes[known.row])
                z = float(data.redshift[i])
            posteriors[i] = self.between.place(self.given.interpolate, known, node, z)

        some = data[rows]
        photometry = some.of_engine(log_prior[rows])
        self.between.scan.fit(**photometry, each=place, nodes=nodes)

    def _sum_up(self, posteriors, data, log_prior, rows):
        """Do what `_scan` does, by way of the sums over all nodes, for objects with limits and priors of rates."""
        if not self.at_own_redshift(data):

            def place(known):
                posterior = self.between.place(self.given.interpolate, known, None, 0.0)
                posteriors[rows[known.row]] = posterior

            photometry = data[rows].of_engine(log_prior[rows])
            self.engine.fit(**photometry, n_draws=N_START, each=place)
            return
        for i in rows:
            row = slice(i, i + 1)
            posteriors[i] = self._posterior_at_redshift(data[row], log_prior[row])

    def _posterior_at_redshift(self, data, log_prior):
        """Return the `BetweenPosterior` of an object at its own redshift; None if no model is possible."""
        z = float(data.redshift[0])
        node = int(np.argmax(log_prior[0]))
        engine = self.between.at_redshift(z, node)
        posteriors = []

        def place(known):
            posteriors.append(self.between.place(self.given.interpolate, known, node, z))

        photometry = data.of_engine(log_prior[:, node : node + 1])
        engine.fit(**photometry, n_draws=N_START, each=place)
        return posteriors[0] if posteriors else None

    def _at_redshifts(self, data, log_prior, pairs):
        """Fit objects on nodes at their own redshifts."""
        if len(data) == 0:
            return self._on_nodes(data, log_prior, pairs)
        parts = []
        for rows in chunks(len(data), 1):
            parts.append(self._at_redshift(data[rows], log_prior[rows], pairs))
        return FitResults.concatenate(parts)

    def _at_redshift(self, data, log_prior, pairs):
        """Fit an object on nodes at its own redshift; results stand at the nearest node."""
        z = float(data.redshift[0])
        fitted = np.isfinite(log_prior).any()
        node = int(np.argmax(log_prior[0]))
        if not fitted:
            z = self.grid.redshift[0]
        engine = self.between.at_redshift(z, node)
        joint = joint_names(pairs, self.priors.axes)
        workspace = engine.workspace(joint=joint)
        photometry = data.of_engine(log_prior[:, node : node + 1])
        out = engine.fit(**photometry, joint=joint, workspace=workspace)
        return self.results_at_redshift(data, out, log_prior, pairs)

    def results_at_redshift(self, data, out, log_prior, pairs):
        """Convert models at the redshift of one object to results, which stand at the nearest node."""
        z = float(data.redshift[0])
        n_z = log_prior.shape[1]
        node = int(np.argmax(log_prior[0]))
        if np.isfinite(log_prior).any():
            out.index[:, 0] = node
        is_node = (np.arange(n_z) == node)[:, None]

        def all_redshifts(table):
            # objects that were not fitted stay NaN
            return np.where(is_node | np.isnan(table), table, 0.0)

        joint = dict(out.joint)
        for name, table in out.joint.items():
            if name[0] == "z":
                joint[name] = all_redshifts(table)
        out = out._replace(zf=all_redshifts(out.zf), joint=joint)
        results = self.results_on_nodes(data, out, pairs)
        best = results.best | {"redshift": 0.0 * results.best["redshift"] + z}
        return results._changed(best=best)

    def results_on_nodes(self, data, out, pairs):
        """Convert models to parameters and derived quantities."""
        flags = np.array(data.flags)
        if self.compat == "cigale":
            vanished = out.chi2 > VANISHING_CHI2
            flags[vanished] |= FitFlags.NO_LIKELIHOOD
            for array in (*out[:-1], *out.joint.values()):
                missing = np.nan
                if array.dtype.kind == "i":
                    missing = -1
                array[vanished] = missing
        axes = self.priors.axes
        pdf = {"redshift": out.zf.sum(axis=2)}
        if self.between is None:
            largest = np.minimum(out.galaxy.max(axis=1), pdf["redshift"].max(axis=1))
            one_node = (largest > _ONE_NODE_WEIGHT) & (out.galaxy.shape[1] > 1)
            flags[one_node] |= FitFlags.ONE_NODE
        if "frac_agn" in axes:
            pdf["frac_agn"] = out.zf.sum(axis=1)
        for name, axis in axes.items():
            if axis.share is not None:
                models = {"galaxy": out.galaxy, "agn": out.agn}[axis.kind]
                # not a matrix product, whose last digits depend on how many rows there are
                pdf[name] = np.einsum("ng,vg->nv", models, axis.share)
        moments, quantiles = self.engine.quantities.summarize(out)
        outlier = None
        if self.engine.mixture is not None:
            outlier = out.outlier
        log_sigma = self.log_errors(data)
        data = self.with_template_error(data, np.where(np.isnan(out.chi2), -1, out.index[:, 0]))
        return FitResults(
            **data.columns,
            **self.result_settings(),
            flags=flags,
            chi2=out.chi2,
            log_evidence=out.log_sum - log_sigma,
            pdf=pdf,
            pdf_2d=out.zf,
            pairs=joint_tables(out, pairs, axes),
            best_index=out.index,
            best_scale=out.best_scale,
            best=self._best(out),
            moments=moments,
            quantiles=quantiles,
            model_flux=out.band[:, 0],
            model_flux_std=out.band[:, 1],
            best_flux=out.best_flux,
            outlier=outlier,
            agn_weights=self._no_agn_weights(len(data)),
        )

    def _no_agn_weights(self, n):
        """Return NaN weights in bins for objects without models between nodes; None if none are asked for."""
        bins = self.given.agn_bins
        if bins is None:
            return None
        return np.full((n, *bins.shape), np.nan, np.float32)

    def log_errors(self, data):
        """Compute ln of the product of the errors that likelihoods are divided by, shape (n,)."""
        # limits are probabilities, which have no unit
        log_sigma = np.log(np.where(data.measured, data.sigma, 1.0)).sum(axis=1)
        # factors sqrt(2 pi) sigma of the normal densities
        return log_sigma + 0.5 * data.measured.sum(axis=1) * np.log(2.0 * np.pi)

    def with_template_error(self, data, node):
        """Add the errors of the templates at nodes of redshift, (n,), to those of photometry; -1 is none."""
        if self.template_error is None:
            return data
        error = self.engine.template_error[np.maximum(node, 0)] * data.flux
        error[~data.measured | (node < 0)[:, None]] = 0.0
        return data._changed(sigma=np.hypot(data.sigma, error))

    def result_settings(self):
        """Return the keywords of `FitResults` that are the same for all objects."""
        quantities = self.engine.quantities
        axes = {name: replace(axis, share=None) for name, axis in self.priors.axes.items()}
        least_std = 0.0
        if self.compat == "cigale":
            least_std = CIGALE_LEAST_STD
        return {
            "filters": self.filters,
            "axes": axes,
            "quantities": quantities.names,
            "units": quantities.units,
            "descriptions": quantities.descriptions,
            "intensive": quantities.intensive,
            "constants": self.constants,
            "least_std": least_std,
        }

    def _best(self, out):
        """Collect parameters and derived quantities of the best models: name to array."""
        grid = self.grid
        quantities = self.engine.quantities
        ok = np.isfinite(out.chi2)
        z, g, k, f = np.where(ok[:, None], out.index, 0).T
        frac = grid.frac_agn[f]
        values = {"redshift": grid.redshift[z], "frac_agn": frac}
        for name, column in grid.galaxy_parameters.items():
            values[name] = column_values(column)[g]
        if grid.n_agn:
            for name, column in grid.agn_parameters.items():
                # without AGN light there is no template
                values[name] = np.where(frac > 0, column_values(column)[k], np.nan)
        best = {name: np.where(ok, values[name], np.nan) for name in self.priors.axes}
        scale = np.where(ok, out.best_scale, np.nan)
        for name in quantities.names:
            best[name] = quantities.evaluate(name, grid, g, k, frac, scale)
        return best

    def sample(self, data, log_prior, n_draws, seed, **parallel):
        """Draw `~miricigale.fitting.Samples` of objects; ``parallel`` is for `parallel_map`."""
        return draw_samples(self, data, log_prior, n_draws, seed, **parallel)
