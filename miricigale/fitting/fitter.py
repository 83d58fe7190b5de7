"""BayesFitter: posteriors of galaxy and AGN parameters from broad-band photometry."""

import logging
import warnings

import numpy as np

from miricigale.fitting.assembly import constants, fit_results
from miricigale.fitting.engines.grid import GridEngine
from miricigale.fitting.flags import FitFlags
from miricigale.fitting.fractions import OtherFraction
from miricigale.fitting.likelihood import per_band, read_photometry, unused_bands
from miricigale.fitting.pairs import check_pairs
from miricigale.fitting.pieces import DrawPiece, FitPiece, Part, cut
from miricigale.fitting.priors import grid_priors
from miricigale.fitting.quantities import DERIVED_LEVELS, Quantities
from miricigale.fitting.redshifts import density_log_prior, fixed_log_prior, known_redshifts
from miricigale.fitting.samples import Samples
from miricigale.utils.exceptions import MiricigaleWarning, argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.parallel import parallel_map
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import require_columns

__all__ = ["BayesFitter"]

logger = logging.getLogger(__name__)


class BayesFitter:
    """
    Fit photometry with every model of a grid and sum up the posterior.

    The model flux of redshift z, galaxy g, torus k and AGN fraction f is
    s (G[z, g] + c L_dust[g] A[z, k]) with c = f / (1 - f). The scale s (the stellar mass
    formed) that minimises chi2 is known in closed form, and weights are
    prior * exp(-chi2 / 2) there, as in CIGALE [1]_; the prior on s that this amounts to is flat
    in the signal-to-noise ratio of the model, which is that of a prior flat in log s to within
    the relative variance of s. Pairs (galaxy, torus) that no AGN fraction can make good enough
    are found by a bound and left out; of the rest those with most of the weight are evaluated in
    double precision, the others in single precision unless ``rtol`` is below 5e-7.

    Parameters
    ----------
    model : `~miricigale.sed.ModelGrid` or `~miricigale.sed.SEDModel`
        A grid, or a model of which a grid is made with ``axes``.
    filters : list of str or `~miricigale.filters.FilterSet`, optional
        Bands to fit. By default those of the grid that the photometry has; of a model, these
        are the bands of the grid and must be given.
    axes : dict, optional
        Parameter name to values, for a model (see `~miricigale.sed.SEDModel.grid`).
    priors : dict, optional
        Parameter name to prior: a function of the value, a frozen distribution of `scipy.stats`
        (both are taken at the nodes), an array of weights of the nodes or ``"log"``. Others are
        flat in the nodes of the grid.
    prior_f : {"grid", "uniform"}, optional
        Prior of the AGN fractions: equal for all values of the grid (so that f = 0, which is
        evaluated once for each galaxy, carries the summed weight of all tori), or by the width
        of their cells.
    engine : {"grid", "nautilus", "dynesty"}, optional
        How the posterior is found. The samplers are for continuous parameters: with one of them
        this gives a `~miricigale.fitting.ContinuousFitter`, whose arguments it then takes.
    model_error : float or dict of str to float, optional
        Part of the flux that is added to its error in quadrature, for all or by filter.
    error_floor : float or dict of str to float, optional
        Least relative error of a flux, for all or by filter.
    n_bands_min : int, optional
        Objects with fewer usable bands, upper limits among them, are flagged and not fitted. One
        band at least must be no limit.
    redshift_tolerance : float, optional
        How far, in abs(dz) / (1 + z), a fixed redshift may lie from its node of the grid; half the
        distance of the nodes by default.
    max_reduced_chi2 : float, optional
        Above this reduced chi2 of the best model an object is flagged.
    scale_error : bool, optional
        Whether the uncertainty of each model's own scale is part of the posterior of masses,
        luminosities and fluxes: so by default, but CIGALE leaves it out.
    compat : {"cigale"}, optional
        Reproduce choices of CIGALE that are not ours: no ``scale_error``, no result where the best
        chi2 is above 1417 (its weights, from which the best chi2 is not subtracted, all vanish;
        flagged ``NO_LIKELIHOOD``), and no standard deviation below 5 % of the mean.
    rtol : float, optional
        Largest relative error of posterior weights, means and standard deviations that leaving
        out hopeless models may cause; 0 evaluates every model.

    Examples
    --------
    >>> from miricigale.fitting import BayesFitter
    >>> fitter = BayesFitter(grid)  # doctest: +SKIP
    >>> results = fitter.fit(photometry)  # doctest: +SKIP
    >>> results.to_table()["id", "redshift_mean", "frac_agn_mean"]  # doctest: +SKIP

    References
    ----------
    .. [1] Boquien et al. 2019, A&A 622, A103, section 4.3
    """

    def __new__(cls, *args, engine="grid", **options):
        """Another engine than the grid samples continuous parameters: a `ContinuousFitter`."""
        if engine == "grid":
            return super().__new__(cls)
        from miricigale.fitting.continuous import ContinuousFitter
        from miricigale.fitting.engines.base import get_sampler

        get_sampler(engine)
        return ContinuousFitter(*args, engine=engine, **options)

    def __getnewargs_ex__(self):
        return (), {}

    def __init__(
        self,
        model,
        filters=None,
        *,
        axes=None,
        priors=None,
        prior_f="grid",
        engine="grid",
        model_error=0.1,
        error_floor=0.0,
        n_bands_min=2,
        redshift_tolerance=None,
        max_reduced_chi2=100.0,
        scale_error=None,
        compat=None,
        rtol=1e-6,
    ):
        names = None if filters is None else tuple(getattr(filters, "names", filters))
        if isinstance(names, tuple) and isinstance(filters, str):
            raise argument_error("filters", "a list of names or a FilterSet", repr(filters))
        self.model = None
        if hasattr(model, "grid"):
            if axes is None or names is None:
                msg = "'axes' and 'filters' must be given when 'model' is an SEDModel"
                raise ValueError(msg)
            self.model = model
            model = model.grid(axes, filters)
        elif axes is not None:
            raise argument_error("axes", "None when 'model' is a ModelGrid", "a value")
        if not hasattr(model, "galaxy_properties"):
            raise argument_error("model", "a ModelGrid or an SEDModel", type(model).__name__)
        self.grid = model
        for name in names or ():
            if name not in model.filters:
                raise unknown_name("filter of the grid", name, model.filters)
        if names is not None and not len(set(names)) == len(names) > 0:
            raise argument_error("filters", "different names, at least one", f"{list(names)}")
        self.filters = names
        if not (_is_number(n_bands_min, np.integer) and n_bands_min >= 1):
            raise argument_error("n_bands_min", "an integer >= 1", repr(n_bands_min))
        if not (_is_number(rtol) and 0 <= rtol < 0.1):
            raise argument_error("rtol", "in [0, 0.1)", repr(rtol))
        if not (_is_number(max_reduced_chi2) and max_reduced_chi2 > 0):
            raise argument_error("max_reduced_chi2", "positive", repr(max_reduced_chi2))
        if redshift_tolerance is not None and not (
            _is_number(redshift_tolerance) and redshift_tolerance >= 0
        ):
            raise argument_error("redshift_tolerance", ">= 0", repr(redshift_tolerance))
        if compat not in (None, "cigale"):
            raise argument_error("compat", "None or 'cigale'", repr(compat))
        if scale_error not in (None, True, False):
            raise argument_error("scale_error", "True, False or None", repr(scale_error))
        if compat and scale_error:
            raise argument_error("scale_error", "False with compat='cigale'", repr(scale_error))
        scale_error = compat is None if scale_error is None else scale_error
        self.compat = compat
        self.engine = engine
        self.model_error = per_band(model_error, model.filters, "model_error")
        self.error_floor = per_band(error_floor, model.filters, "error_floor")
        self.n_bands_min = int(n_bands_min)
        self.redshift_tolerance = redshift_tolerance
        self.max_reduced_chi2 = float(max_reduced_chi2)
        self.prior_f = prior_f
        self.priors = grid_priors(model, priors, prior_f=prior_f)
        self.quantities = Quantities.of_grid(model)
        self.fraction = OtherFraction.of_grid(model)
        self._engine = self._make_engine(bool(scale_error), float(rtol))

    def __repr__(self):
        bands = "bands of the photometry" if self.filters is None else f"{len(self.filters)} bands"
        return f"<BayesFitter of {self.grid!r}, {bands}>"

    def _make_engine(self, scale_error, rtol):
        grid, priors, quantities = self.grid, self.priors, self.quantities
        return GridEngine(
            galaxy=np.asarray(grid.galaxy, dtype=float),
            agn=np.asarray(grid.agn, dtype=float),
            dust=np.asarray(grid.dust_luminosity, dtype=float),
            frac=np.asarray(grid.frac_agn, dtype=float),
            usable=np.asarray(grid.allowed, dtype=bool) & (priors.galaxy > 0),
            prior_galaxy=priors.galaxy,
            prior_agn=priors.agn,
            prior_frac=priors.frac,
            galaxy_scale=quantities.galaxy_scale,
            agn_scale=quantities.agn_scale,
            mixed_galaxy=quantities.mixed_galaxy,
            mixed_agn=quantities.mixed_agn,
            levels=DERIVED_LEVELS,
            share_galaxy=None if self.fraction is None else self.fraction.galaxy,
            share_agn=None if self.fraction is None else self.fraction.agn,
            rtol=rtol,
            scale_error=scale_error,
        )

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
        chunk_size=64,
    ):
        """
        Fit a catalogue.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`
            One row for each object: ``id``, a flux column for each filter, called by the
            filter's name, and its error ``<name>_err``. NaN is a missing band. Where a boolean
            column ``<name>_limit`` is true the flux is an upper limit and the error its 1 sigma
            (without model error and floor); its term of chi2 is -2 ln of the probability that a
            measurement of the model lies below the limit [1]_ [2]_. Objects with limits only are
            flagged, not fitted.
        redshift : str or array_like, optional
            Column of ``photometry``, or values, of known redshifts; each is taken to the nearest
            redshift of the grid. Without it the redshift is free.
        redshift_prior : tuple, optional
            Redshifts, shape (n_z,), and densities in redshift, shape (n_z,) or (n, n_z), joined by
            straight lines: a p(z) for all or each object, which is integrated over the cells of
            the grid's redshifts and takes the place of their prior.
        pairs : list of tuple of str, optional
            Pairs of parameters with several values (``results.axes``), of which the joint
            posteriors are summed exactly as well: ``[("age", "tau"), ("redshift", "age")]``.
            That of redshift and AGN fraction is always there.
        seed : optional
            Not used by this engine; other engines draw from it.
        executor : `concurrent.futures.Executor`, optional
            Fits pieces of the catalogue at the same time; the answer is the same. Threads work
            well: the kernels hold no lock.
        progress_bar : bool, optional
            Whether to show one.
        chunk_size : int, optional
            Objects in a piece.

        Returns
        -------
        results : `FitResults`
            One row for each object, in the order of the catalogue; those that could not be
            fitted are flagged.

        Warns
        -----
        `~miricigale.utils.exceptions.MiricigaleWarning`
            If ``filters`` was not given and the photometry has bands (names of filters, or columns
            in a unit of flux density with an error beside them) that the grid lacks. Bands that
            are not fitted are also in ``meta["fit"]["unused_bands"]`` of the results.

        Raises
        ------
        KeyError
            If a name in ``pairs`` is unknown.
        ValueError
            If a column is missing, a flux is no number, an id is masked, one of limits is not
            boolean, there are limits in a band in which a model has negative flux, ``redshift`` or
            ``redshift_prior`` has the wrong shape, or both are given, or ``pairs`` has a parameter
            twice or one with a single value.
        `~astropy.units.UnitsError`
            If a flux column has no unit of flux density.

        References
        ----------
        .. [1] Sawicki 2012, PASP 124, 1208, appendix
        .. [2] Boquien et al. 2019, A&A 622, A103, section 4.3
        """
        del seed
        if not (_is_number(chunk_size, np.integer) and chunk_size >= 1):
            raise argument_error("chunk_size", "an integer >= 1", repr(chunk_size))
        pairs = check_pairs(pairs, self)
        data, flags, log_prior, settings = self._prepare(photometry, redshift, redshift_prior)
        task = FitPiece(self._engine, self.priors, self.quantities, pairs)
        pieces = cut(data, log_prior, int(chunk_size))
        parts = parallel_map(task, pieces, executor=executor, progress_bar=progress_bar, desc="fit")
        logger.debug("fitted %d objects", len(data.ids))
        return fit_results(self, data, flags, Part.merge(parts), settings)

    def _prepare(self, photometry, redshift, redshift_prior):
        """Fluxes, flags, ln(prior) of the redshifts of every object, and the settings."""
        require_columns(photometry, [], "photometry")
        grid = self.grid
        filters = self._bands(photometry)
        unused = unused_bands(photometry, filters)
        if unused and self.filters is None:
            # who names the bands knows that others are left out
            warnings.warn(
                f"bands of the photometry that the grid lacks are not fitted: {', '.join(unused)}",
                MiricigaleWarning,
                stacklevel=3,
            )
        columns = [grid.filters.index(name) for name in filters]
        data = read_photometry(
            photometry,
            filters,
            model_error=self.model_error[columns],
            error_floor=self.error_floor[columns],
            n_bands_min=self.n_bands_min,
            grid_filters=grid.filters,
        )
        bound = data.limit.any(axis=0)
        for i in np.flatnonzero(bound & self._engine._negative) if bound.any() else ():
            wanted = "without limits in bands in which a model has negative flux"
            raise argument_error("photometry", wanted, f"some in {grid.filters[i]}")
        flags = data.flags.copy()
        log_prior = self._redshift_prior(photometry, redshift, redshift_prior, flags)
        free = sum(axis.values.size > 1 for axis in self.priors.axes.values())
        free += 1 - (redshift is not None and self.grid.redshift.size > 1)  # and the mass
        few = (data.measured.sum(axis=1) < free) & ((flags & int(FitFlags.UNFITTED)) == 0)
        flags[few] |= int(FitFlags.FEW_FOR_PARAMETERS)
        log_prior[(flags & int(FitFlags.UNFITTED)) != 0] = -np.inf
        settings = self.settings(filters, redshift is not None) | {"unused_bands": unused}
        return data, flags, log_prior, settings

    def sample(
        self,
        photometry,
        n_draws,
        *,
        seed,
        redshift=None,
        redshift_prior=None,
        executor=None,
        progress_bar=False,
    ):
        """
        Draw models from the posterior of every object.

        Parameters
        ----------
        photometry, redshift, redshift_prior, executor, progress_bar : optional
            As for `fit`.
        n_draws : int
            Draws for each object, independent and of equal weight.
        seed : int
            Every object has its own stream, keyed by its id: neither order nor the number of
            workers changes a draw.

        Returns
        -------
        samples : `~miricigale.fitting.Samples`
            Parameters, derived quantities, fluxes and spectra of the draws; NaN for objects that
            could not be fitted, which are flagged as by `fit`.

        Raises
        ------
        ValueError
            See `fit`; or if ``n_draws`` is not positive.
        """
        if not (_is_number(n_draws, np.integer) and n_draws >= 1):
            raise argument_error("n_draws", "an integer >= 1", repr(n_draws))
        seed = check_seed(seed)
        data, flags, log_prior, settings = self._prepare(photometry, redshift, redshift_prior)
        keys = [stream(seed, "fit", "draws", str(key)).integers(2**63) for key in data.ids]
        parts = parallel_map(
            DrawPiece(self._engine, int(n_draws)),
            cut(data, log_prior, 16, seeds=np.array(keys, dtype=np.int64)),
            executor=executor,
            progress_bar=progress_bar,
            desc="draws",
        )
        index, scale = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
        unfitted = ~np.isfinite(scale).all(axis=1) & ((flags & int(FitFlags.UNFITTED)) == 0)
        flags[unfitted] |= int(FitFlags.NO_SIGNAL)
        meta = provenance(
            citations=self.grid.meta.get("citations", ()),
            fit=settings,
            seed=seed,
        )
        return Samples(
            grid=self.grid,
            ids=data.ids,
            flags=flags,
            index=index,
            scale=scale,
            model=self.model,
            meta=meta,
            axes=self.priors.axes,
        )

    def _bands(self, photometry):
        """Filters to fit: those asked for, or those of the grid that the table has."""
        if self.filters is not None:
            return self.filters
        have = getattr(photometry, "colnames", ())
        filters = tuple(name for name in self.grid.filters if name in have)
        if not filters:
            wanted = f"a table with at least one of the columns {list(self.grid.filters)}"
            raise argument_error("photometry", wanted, f"columns {list(have)}")
        return filters

    def _redshift_prior(self, photometry, redshift, redshift_prior, flags):
        """ln(prior) of the grid's redshifts for every object, shape (n, nz)."""
        if redshift is not None and redshift_prior is not None:
            msg = "'redshift' and 'redshift_prior' must not be given both"
            raise ValueError(msg)
        z, prior = self.grid.redshift, self.priors.redshift
        allowed = self._engine.usable.any(axis=1) & (prior > 0)
        if redshift_prior is not None:
            return density_log_prior(redshift_prior, z, allowed, flags)
        if redshift is not None:
            values = known_redshifts(photometry, redshift)
            return fixed_log_prior(values, z, allowed, self.redshift_tolerance, flags)
        log_prior = np.log(prior, where=allowed, out=np.full(z.size, -np.inf))
        if not allowed.any():
            flags |= int(FitFlags.NO_MODEL)
        return np.tile(log_prior, (len(photometry), 1))

    def settings(self, filters=None, fixed=False):
        """Return what the fit was told, for the meta of results: a dict of plain values."""
        names = self.grid.filters
        return {
            "engine": self.engine,
            "filters": list(filters or self.filters or names),
            "redshift": "fixed" if fixed else "free",
            "prior_f": self.prior_f,
            "model_error": dict(zip(names, self.model_error.tolist(), strict=True)),
            "error_floor": dict(zip(names, self.error_floor.tolist(), strict=True)),
            "n_bands_min": self.n_bands_min,
            "rtol": self._engine.rtol,
            "scale_error": self._engine.scale_error,
            "compat": self.compat,
            "n_models": int(self._engine.n_models),
            "constants": constants(self.grid, self.priors.axes),
        }


def _is_number(value, kind=np.number):
    """Whether a value is one number, and of a kind; True and False are none."""
    array = np.asarray(value)
    return array.ndim == 0 and np.issubdtype(array.dtype, kind)
