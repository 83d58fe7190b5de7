"""BayesFitter: posteriors of galaxy and AGN parameters from broad-band photometry."""

from dataclasses import replace

from miricigale.filters.band_names import known_filter
from miricigale.fitting.catalog_fits import CatalogFits
from miricigale.fitting.data import fitted_bands
from miricigale.fitting.data.likelihood import PhotometryReader, filter_names, per_band
from miricigale.fitting.fitter_options import (
    check_nuclei,
    check_priors,
    check_scale_error,
    chosen_settings,
    errors_of_expected_flux,
    fitted_names,
)
from miricigale.fitting.fitter_text import facts, representation
from miricigale.fitting.grid.grid_fit import GridFit
from miricigale.fitting.results.pulls import warn_of_pulls
from miricigale.fitting.results.sample_flags import (
    chi2_limit,
    chi2_step,
    warn_of_unconverged,
    with_high_chi2,
)
from miricigale.fitting.samplers import get_sampler
from miricigale.fitting.samplers.fit import SamplerFit
from miricigale.fitting.survey.defaults import (
    DEFAULT,
    axes_of,
    chosen_calibration,
    models_and_bands,
    own_curves,
    warn_of_changed_axes,
    warn_of_few_models,
)
from miricigale.sed import ModelGrid, SEDModel
from miricigale.sed.presets import grid_name
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import check_seed
from miricigale.utils.units import check_count

#: Attributes of a fitter that depend on its bands.
_OF_BANDS = ("backend", "bands", "grid", "model_errors", "priors", "zero_points")


class BayesFitter(CatalogFits):
    """
    Fit photometry and sum up the posterior: with every model of a grid, or by a nested sampler.

    The model flux of redshift z, galaxy g, AGN template k and AGN fraction f is
    s (G[z, g] + c L_dust[g] A[z, k]) with c = f / (1 - f). The scale s (the stellar mass
    formed) that minimizes chi2 is known in closed form, and weights are
    prior * exp(-chi2 / 2) there, as in CIGALE [1]_; the prior on s that this amounts to is flat
    in the signal-to-noise ratio of the model, which is that of a prior flat in log s to within
    the relative variance of s. Fluxes are Gaussian, with ``model_error`` of the flux added to the
    error in quadrature; upper limits have an error-function term.

    On a grid, pairs (galaxy, AGN template) that no AGN fraction can make good enough are found by a
    bound and left out; of the rest those with most of the weight are evaluated in double precision,
    the others in single precision unless ``rtol`` of the settings is below 5e-7. A sampler takes parameters as
    they are, continuous, object by object; models older than the universe, or impossible together,
    have no weight.

    Parameters
    ----------
    model : `~miricigale.sed.ModelGrid`, `~miricigale.sed.SEDModel` or list of str, optional
        A grid; a model of which a grid is made with ``axes``; or, for a sampler, a model. By default
        `SEDModel.survey <miricigale.sed.SEDModel.survey>`, for real galaxies, also where the bands stand here:
        ``BayesFitter(bands)``.
    filters : list of str or `~miricigale.filters.FilterSet`, optional
        Bands to fit. By default those of the grid that the photometry has; of a model, all in a known filter that
        the photometry has with an error, for which the grid is then made.
    priors : dict, optional
        Parameter name to prior. On a grid: a density, as a function of the value or a frozen distribution of
        `scipy.stats`, which is integrated over the cells of the nodes; ``(low, high)``, flat between two values,
        or ``(low, high, "log")``; an array of weights of the nodes; or ``"log"``, flat in the logarithm. Others
        are flat in the nodes: each has the same weight, so nodes of equal ratios are flat in the logarithm. For a
        sampler, of every free parameter (others are at the defaults of the model):

        - ``(low, high)``: flat; ``(low, high, "log")``: flat in the logarithm; ``"flat"`` and
          ``"log"``: the same over the bounds of the parameter;
        - a list or array: these values only, as for parameters of libraries (metallicity, the
          torus); ``(values, weights)``: of these weights;
        - a frozen distribution of `scipy.stats`, cut to the bounds of the parameter;
        - a number: a fixed value.

        Unless ``mass`` is among them, each model has the mass that fits best, with its error.
    engine : {"grid", "nautilus", "dynesty"} or callable, optional
        How the posterior is found: on a grid, or by a sampler. A callable is a sampler of the
        user's; see `miricigale.fitting.samplers.get_sampler`.
    axes : dict or str, optional
        Parameter name to values, for a grid of a model (see `~miricigale.sed.SEDModel.grid`), whose other
        parameters have one value, their default; without ``model``, in place of those of the grid ``"survey"``,
        whose other axes stay. Or the name of a grid: ``"survey"``, ``"far-infrared"``, ``"yang2021"`` (of
        simulations) or ``"yang2021-quick"``. By default the model's own (`~miricigale.sed.SEDModel.named_axes`).
    model_error, error_floor : float or dict of str to float, optional
        Part of the measured flux that is added to its error in quadrature, 0.1 where there is no calibration, and
        least relative error of a flux, for all or by filter.
    template_error : `~miricigale.fitting.TemplateError`, optional
        Of a grid: error of the models by rest wavelength, added in quadrature too; what it does to the
        normalization of the likelihood counts. ``sigma`` of the results has that of the best model.
    outliers : float or dict of str to float, optional
        Of a grid: prior fraction of wrong fluxes and limits, for all bands or by filter, at least 0 and below 1.
        Each is then a mixture of the stated error and a broad one (`miricigale.fitting.grid.mixture`);
        ``outlier`` of the results, ``<band>_outlier`` in tables, is how likely a band is wrong. Not with
        ``compat``. ``rtol`` is then at least 1e-3, unless it is 0.
    calibration : `~miricigale.fitting.SurveyCalibration` or None, optional
        Of a grid: zero points and errors of the bands, by which fluxes and errors are multiplied (so are those in
        the results), and in place of what is not given here, priors, ``template_error``, ``model_error``,
        ``outliers`` and ``mass_function`` of the settings. None: no calibration. By default, for the axes
        ``"survey"`` (at any redshifts) unless ``model_error``, ``template_error`` or ``compat`` is given,
        `SurveyCalibration.survey` with the errors of bands of which nothing was measured: in MIRI 3.3 times those
        of the catalog and 15 % of the flux, in others 2 % of the flux (`calibrate_bands` measures them); and none
        for other axes.
    scale_error : bool, optional
        Whether the uncertainty of each model's own scale is part of the posterior of masses,
        luminosities and fluxes: so by default, but CIGALE leaves it out.
    n_bands_min : int, optional
        Objects with fewer usable bands, upper limits among them, are flagged and not fitted. One
        band at least must be no limit.
    compat : {"cigale"}, optional
        Reproduce choices of CIGALE that are not ours: no ``scale_error``, nodes alone, no result where the best
        chi2 is above 1417 (its weights, from which the best chi2 is not subtracted, all vanish;
        flagged ``NO_LIKELIHOOD``), and no standard deviation below 5 % of the mean.
    nuclei : bool or "whole", optional
        Of a grid: whether fluxes of the point in the center of galaxies are fitted as those of the AGN, beside the
        total fluxes and with their covariance (`miricigale.fitting.grid.nuclei`). They are columns
        ``<name>_flux_point`` (or ``<name>_nucleus``) with ``..._err``, ``..._corr`` (correlation with the total; 0
        without it) and ``..._limit``, as `~miricigale.photometry.ForcedPhotometryResult.to_table` writes them.
        With ``"whole"`` the models are nothing but a point, as stars and little red dots, and points have all of
        their light (`miricigale.fitting.data.whole_points`).
    settings : `GridSettings` or `SamplerSettings`, optional
        More settings of the engine.

    Attributes
    ----------
    bands : tuple of str
        Bands of the models, in the order of the results. This and what depends on it is not there yet where the
        bands are those of the photometry (`for_bands`).
    grid_name : str or None
        Name of the grid, if it is one of ours.
    calibration : `~miricigale.fitting.SurveyCalibration` or None
        The calibration.
    grid : `~miricigale.sed.ModelGrid`
        The grid; None for a sampler.
    priors : `~miricigale.fitting.posterior.priors.GridPriors` or dict
        Priors of a grid, or that of each free parameter by name.
    n_bands_min : int
        Objects with fewer usable bands are not fitted.
    backend : `~miricigale.fitting.grid.grid_fit.GridFit` or `~miricigale.fitting.samplers.fit.SamplerFit`
        What fits, with the priors and the derived quantities.

    Raises
    ------
    ImportError
        If the sampler is not installed; the message holds the pip command.
    KeyError
        If there is no engine, filter or parameter of a name.
    ValueError
        If an option is of the wrong kind or of another engine, a prior is none, or leaves values that
        the libraries of the model do not have; or if ``finer`` of the settings did not make the grid.

    Warns
    -----
    `~miricigale.utils.exceptions.FitWarning`
        If ``axes`` that change those of the grid ``"survey"`` leave it without calibration, and none was asked
        for; or if ``axes`` of `SEDModel.survey <miricigale.sed.SEDModel.survey>` lack ``age``, ``tau`` or ``ebv``,
        so that all galaxies have one value.

    References
    ----------
    .. [1] Boquien et al. 2019, A&A 622, A103, section 4.3

    Examples
    --------
    Real galaxies, in the bands of the catalog:

    >>> from miricigale import BayesFitter
    >>> BayesFitter().fit("catalog.fits")  # doctest: +SKIP

    A model and axes of one's own:

    >>> from miricigale import ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.02)
    >>> fitter.fit(photometry).mean("redshift").round(1)
    <Quantity [0.5, 1. ]>

    A sampler takes continuous parameters:

    >>> priors = {"redshift": (0.01, 6), "tau": (0.1, 10, "log"), "age": (0.1, 13), "ebv": (0, 1)}
    >>> fitter = BayesFitter(model, bands, priors=priors, engine="nautilus")  # doctest: +SKIP
    >>> results = fitter.fit(photometry, seed=1)  # doctest: +SKIP
    """

    @takes_other_keywords
    def __init__(
        self,
        model=None,
        filters=None,
        *,
        priors=None,
        engine="grid",
        axes=None,
        model_error=None,
        error_floor=0.0,
        template_error=None,
        outliers=None,
        calibration=DEFAULT,
        scale_error=None,
        n_bands_min=2,
        compat=None,
        nuclei=False,
        settings=None,
    ):
        on_grid = engine == "grid"
        if isinstance(axes, str):
            axes = grid_name(axes)
        model, filters, default_axes = models_and_bands(model, filters, axes)
        changed_axes = None
        if on_grid and default_axes is not axes:
            changed_axes = axes
            axes = default_axes
        check_priors(priors)
        self.curves = own_curves(filters)
        self._options = {
            "model": model,
            "filters": filters,
            "priors": priors,
            "engine": engine,
            "axes": axes,
            "model_error": model_error,
            "error_floor": error_floor,
            "template_error": template_error,
            "outliers": outliers,
            "calibration": calibration,
            "scale_error": scale_error,
            "n_bands_min": n_bands_min,
            "compat": compat,
            "nuclei": nuclei,
            "settings": settings,
        }
        settings = chosen_settings(engine, settings)
        self.grid_name = None
        self._calibrated_as = None
        if on_grid:
            axes, self.grid_name, self._calibrated_as = axes_of(model, axes)
        if on_grid and compat is None:
            catalog_bands = filters
            if filters is None and isinstance(model, ModelGrid):
                catalog_bands = model.filters
            is_default = isinstance(calibration, str) and model_error is None
            calibration = chosen_calibration(
                calibration, self._calibrated_as, model_error, template_error, bands=catalog_bands
            )
            if changed_axes and is_default and calibration is None and template_error is None:
                warn_of_changed_axes(changed_axes)
        elif isinstance(calibration, str):
            calibration = None
        of_grid = {"axes": axes, "compat": compat, "calibration": calibration}
        of_grid |= {"template_error": template_error, "outliers": outliers}
        if not on_grid:
            for name, value in of_grid.items():
                check_that(value is None, name, "left out with a sampler", repr(value))
            get_sampler(engine)
        names = fitted_names(engine, filters, settings)
        check_scale_error(scale_error, compat)
        if calibration is not None:
            if template_error is None:
                of_grid["template_error"] = calibration.template_error
            if settings.mass_function is None:
                settings = replace(settings, mass_function=calibration.mass_function)
        self.engine = engine
        self.calibration = calibration
        check_nuclei(nuclei, engine)
        self.nuclei = nuclei
        self.template_error = of_grid["template_error"]
        self.model = None
        if not isinstance(model, ModelGrid):
            self.model = model
        self.filters = names
        self.n_bands_min = check_count(n_bands_min, "n_bands_min")
        self._fitters = {}
        if on_grid and names is None and isinstance(model, SEDModel):
            # the grid is made for the bands of the photometry
            return
        self._make_backend(model, filters, settings, of_grid)
        self._make_reader()

    def _make_backend(self, model, filters, settings, of_grid):
        """Make what fits, of a grid or of the models for a sampler."""
        options = self._options
        scale_error = options["scale_error"]
        if scale_error is None:
            scale_error = options["compat"] is None
        arguments = (model, filters, options["priors"], settings)
        self.grid = None
        if self.engine == "grid":
            self.backend = GridFit.of_model(*arguments, scale_error=bool(scale_error), **of_grid)
            self.grid = self.backend.grid
            warn_of_few_models(model, of_grid["axes"], self.grid)
        else:
            self.backend = SamplerFit.of_model(
                *arguments, scale_error=bool(scale_error), sampler=self.engine
            )
        self.bands = self.backend.filters
        self.priors = self.backend.priors

    def _make_reader(self):
        """Make the reader of photometry, with the errors and zero points of the bands."""
        names = self.filters
        if names is not None:
            names = tuple(known_filter(name, self.bands, "filter of the grid") for name in names)
        self.filters = names
        error_bands = names
        if self.engine == "grid":
            error_bands = self.bands
        model_error = self._options["model_error"]
        corrections = {}
        if self.calibration is not None:
            for name in ("zero_point", "error_factor"):
                corrections[name] = self.calibration.of_bands(name, error_bands, 1.0)
            if model_error is None:
                model_error = self.calibration.of_bands("error_part", error_bands, 0.0)
                part = errors_of_expected_flux(self.bands, model_error)
                self.backend = self.backend.with_relative_errors(part)
                corrections["added_later"] = tuple(part)
        if model_error is None:
            model_error = 0.1
        self._reader = PhotometryReader(
            self.bands,
            names,
            model_error=per_band(model_error, error_bands, "model_error"),
            error_floor=per_band(self._options["error_floor"], error_bands, "error_floor"),
            n_bands_min=self.n_bands_min,
            **corrections,
        )
        self.zero_points = self._reader.zero_point
        self.model_errors = self._reader.model_error

    def __getattr__(self, name):
        if name in _OF_BANDS and "_fitters" in self.__dict__:
            wanted = "the bands are those of the photometry: name them, BayesFitter(model, bands), or take"
            msg = f"BayesFitter has no {name!r} yet; {wanted} fitter.for_bands(bands)"
            raise AttributeError(msg, name=name, obj=self)
        return super().__getattr__(name)

    @property
    def waits(self):
        """Whether the bands of the models are those of a catalog that is yet to come."""
        return "backend" not in self.__dict__

    def for_bands(self, bands):
        """
        Return a fitter of the same models and options for these bands.

        Parameters
        ----------
        bands : list of str or `~miricigale.filters.FilterSet`
            Bands to fit.

        Returns
        -------
        fitter : `BayesFitter`
            With a grid of these bands, which a later call for the same bands returns again.

        Raises
        ------
        ValueError
            If the fitter has bands already.
        """
        check_that(self.waits, "bands", "left to the fitter, which has some", bands)
        names = filter_names("bands", bands)
        if names not in self._fitters:
            self._fitters[names] = type(self)(**self._options | {"filters": bands})
        return self._fitters[names]

    def for_photometry(self, photometry):
        """
        Return a fitter for a catalog: this one, or `for_bands` of its bands if the fitter has none.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`, dict, `pandas.DataFrame` or path-like
            As for `fit`.

        Raises
        ------
        ValueError
            If the fitter has no bands, and the catalog has no flux in a known filter that has an error.
        """
        if not self.waits:
            return self
        bands, unused = fitted_bands.bands_of(photometry)
        fitted_bands.warn_of_unfitted(unused)
        return self.for_bands(bands)

    def replace(self, **options):
        """Return a fitter of the same models with other options, named as for `BayesFitter`."""
        arguments = self._options | options
        if self.waits or options.get("axes") is not None:
            return type(self)(**arguments)
        if self.grid is not None:
            arguments |= {"model": self.grid, "axes": None}
            if arguments["compat"] is None:
                arguments["calibration"] = chosen_calibration(
                    arguments["calibration"],
                    self._calibrated_as,
                    arguments["model_error"],
                    arguments["template_error"],
                    bands=arguments["filters"] or self.bands,
                )
        new = type(self)(**arguments)
        new.grid_name = self.grid_name
        new._calibrated_as = self._calibrated_as
        new.model = self.model
        # errors that are given later take the place of a calibration by default
        new._options["calibration"] = (self._options | options)["calibration"]
        between = getattr(self.backend, "between", None)
        if between and new.backend.between:
            # the finer grid is that of the same models
            between = replace(between, engine=new.backend.engine)
            new.backend = replace(new.backend, between=between)
        return new

    def _facts(self):
        return facts(self)

    def __repr__(self):
        return representation(self)

    @takes_other_keywords
    def fit(
        self,
        photometry,
        *,
        unit=None,
        redshift=None,
        redshift_prior=None,
        pairs=None,
        seed=None,
        executor=None,
        progress_bar=None,
        chunk_size=None,
    ):
        """
        Fit a catalog.

        Parameters
        ----------
        photometry : `~astropy.table.QTable`, dict, `pandas.DataFrame` or path-like
            One row for each object: ``id`` (else rows are counted from 1), a column of fluxes or AB magnitudes
            for each filter, called by any usual name of it, and its error ``<name>_err`` or ``e_<name>``
            (`~miricigale.filters.as_photometry`). NaN is a missing band. Where a boolean
            column ``<name>_limit`` is true the flux is an upper limit and the error its 1 sigma
            (without model error and floor); its term of chi2 is -2 ln of the probability that a
            measurement of the model lies below the limit (Sawicki 2012, PASP 124, 1208, appendix).
            Objects with limits only are flagged, not fitted.
        unit : unit-like or dict of str to unit-like, optional
            Unit of fluxes and errors whose columns have none, as of a DataFrame: ``"uJy"``, ``"ABmag"``; for all
            or by band.
        redshift : str or array_like, optional
            Column of ``photometry``, or values, of known redshifts; on a grid each is taken to the
            nearest redshift, unless the fitter is to ``interpolate``. Without it the redshift is free.
        redshift_prior : tuple, optional
            Redshifts, shape (n_z,), and densities in redshift, shape (n_z,) or (n, n_z), joined by
            straight lines: a p(z) for all or each object, which takes the place of the prior of
            redshift (within its limits) and is integrated over the cells of a grid's redshifts.
        pairs : list of tuple of str, optional
            Pairs of parameters with several values (``results.axes``), of which the joint
            posteriors are kept as well: ``[("age", "tau"), ("redshift", "age")]``.
            That of redshift and AGN fraction is always there.
        seed : int or `~numpy.random.Generator`, optional
            Of samplers: every object has its own stream, from the seed and its id. The sums over a
            grid have nothing random.
        executor : `concurrent.futures.Executor`, optional
            Fits pieces of the catalog at the same time; the answer is the same. Threads serve well
            on a grid, whose kernels hold no lock, processes for samplers, which are Python.
        progress_bar : bool, optional
            Whether to show one; by default in interactive sessions, after some seconds.
        chunk_size : int, optional
            Objects in a piece: by default 64 on a grid, more (up to 1024) on one of few models, 1 for a sampler.

        Returns
        -------
        results : `FitResults`
            A row for each object of the catalog; those that could not be fitted are flagged.

        Warns
        -----
        `~miricigale.utils.exceptions.FitWarning`
            If ``filters`` was not given and the photometry has bands (names of filters, or columns in a unit of
            flux density that have an error) that the grid lacks, or that no filter here belongs to. Bands that are
            not fitted are also in ``meta["fit"]["unused_bands"]`` of the results. A further warning counts, by
            band, numbers that stand for no value, such as -99, or 99 with an error of 99: they are missing bands,
            whatever the unit and wherever it is given, and another the negative errors that may mark upper limits
            (such fluxes are left out; ``read_catalog_photometry(path, limits=True)`` reads limits). Another one
            names bands whose fluxes of S/N above 5, 30 at
            least, scatter about what the other bands predict by more than 1.5 times their errors
            (`miricigale.fitting.results.pulls`). The last one counts fits that are not converged
            (``NOT_CONVERGED``).

        Raises
        ------
        KeyError
            If a name in ``pairs`` is unknown.
        ValueError
            If a column is missing or holds something else, an id is masked, there are limits in a
            band in which a model of the grid has negative flux, ``redshift`` or ``redshift_prior``
            has the wrong shape, or both are given, nothing is free, or ``pairs`` has a parameter
            twice, one with a single value or a derived quantity.
        `~astropy.units.UnitsError`
            If a flux column has no unit of flux density, and ``unit`` does not say it.
        """
        fitter = self.for_photometry(photometry)
        results = fitter._fit_part(
            fitter._table_of(photometry, unit),
            redshift=redshift,
            redshift_prior=redshift_prior,
            pairs=pairs,
            seed=seed,
            chunk_size=chunk_size,
            parallel={"executor": executor, "progress_bar": progress_bar},
        )
        warn_of_pulls(results)
        n_asked = results.meta["fit"].get("interpolate")
        warn_of_unconverged(results.flags, results.fitted, n_asked)
        sample = results.reduced_chi2[:: chi2_step(len(results))]
        return with_high_chi2(results, chi2_limit(sample))

    __call__ = fit

    @takes_other_keywords
    def sample(
        self,
        photometry,
        n_draws=1000,
        *,
        seed,
        unit=None,
        redshift=None,
        redshift_prior=None,
        executor=None,
        progress_bar=None,
    ):
        """
        Draw models from the posterior of every object.

        They are some of the models between the nodes that the results of `fit` rest on, in proportion to their
        weights; where these are of nodes alone, models of the grid.

        Parameters
        ----------
        photometry, unit, redshift, redshift_prior, executor, progress_bar : optional
            As for `fit`.
        n_draws : int, optional
            Draws for each object, independent and of equal weight.
        seed : int
            Every object has its own stream, by its photometry (on nodes alone by its id): neither order nor
            workers change a draw.

        Returns
        -------
        samples : `~miricigale.fitting.Samples`
            The draws; objects that could not be fitted are flagged as by `fit`.

        Raises
        ------
        ValueError
            See `fit`; or if the fitter has no grid: the results of a sampler hold draws.
        """
        if self.engine != "grid":
            msg = "draws of a sampler are in its results: fitter.fit(photometry).samples(id)"
            raise ValueError(msg)
        if self.nuclei:
            msg = "draws are without nuclei: fitter.replace(nuclei=False).sample(...)"
            raise ValueError(msg)
        n_draws = check_count(n_draws, "n_draws")
        seed = check_seed(seed)
        fitter = self.for_photometry(photometry)
        table = fitter._table_of(photometry, unit)
        data, priors, settings = fitter._prepare(table, redshift, redshift_prior)
        samples = fitter.backend.sample(
            data, priors, n_draws, seed, executor=executor, progress_bar=progress_bar
        )
        cited = fitter.backend.provenance()["citations"]
        meta = provenance(citations=cited, fit=settings, seed=seed)
        return samples._changed(model=fitter.model, meta=meta)

    def settings(self):
        """Return the settings of the fit, for the meta of results: a dict of plain values."""
        return self._settings()
