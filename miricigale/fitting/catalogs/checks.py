"""How far a fit can be trusted: mock catalogs fitted again, and bands left out and predicted."""

from dataclasses import field

import astropy.units as u
import numpy as np
from astropy.stats import mad_std
from astropy.table import QTable

from miricigale.filters.band_names import known_filter
from miricigale.fitting.data.likelihood import FitFlags, flux_column, flux_columns
from miricigale.fitting.fitter import BayesFitter
from miricigale.fitting.posterior.posterior import randomized_ranks
from miricigale.fitting.results.pulls import without_warnings
from miricigale.fitting.survey.survey import bands_in_catalog
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_names, check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import declared
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import (
    described_rows,
    described_table,
    error_column,
    read_ids,
    require_columns,
)
from miricigale.utils.units import FNU, frozen_array
from miricigale.utils.values import value_class

_LEVELS = (0.16, 0.84)
_COLUMNS = declared("miricigale.fitting", "columns.toml")


@takes_other_keywords
def mock_analysis(fitter, results, photometry, *, seed, model_error=False, **options):
    """
    Refit a mock catalog whose true parameters are known: the best models with noise.

    The best model of every object takes the object's place; its fluxes in the bands that were
    used are perturbed by the measured errors of that object and fitted as the object was
    (Boquien et al. 2019, A&A 622, A103, section 4.3). Upper limits stay as they are, for what
    would have been measured there is not known.

    Parameters
    ----------
    fitter, results, photometry : `BayesFitter`, `FitResults` and `~astropy.table.QTable`
        What made the results, these, and the catalog that was fitted.
    seed : int, `~numpy.random.Generator` or None
        Every object has its own stream, by its id.
    model_error : bool, optional
        Whether the noise has the model error in it that the fit allows for. Without it, as in
        CIGALE, the intervals of a fit with model error are wider than the scatter.
    **options
        Passed to `BayesFitter.fit`; known redshifts have to be given again.

    Returns
    -------
    mock : `MockResult`

    Raises
    ------
    ValueError
        If photometry and results are of different objects, or the redshifts were fixed and are
        not given.

    Examples
    --------
    >>> from miricigale.fitting import mock_analysis
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> results = fitter.fit(photometry)
    >>> mock = mock_analysis(fitter, results, photometry, seed=1)
    >>> print(mock.metrics(["mass"])["parameter", "n"])
    parameter  n
    --------- ---
         mass   2
    """
    seed = check_seed(seed)
    fitter = fitter.for_photometry(photometry)
    filters = results.fitted_filters
    columns = flux_columns(filters)
    require_columns(
        photometry, ["id"] + list(columns), "photometry", units=dict.fromkeys(columns, FNU)
    )
    if not np.array_equal(read_ids(photometry), results.ids):
        raise argument_error("photometry", "of the objects of 'results', in order", "others")
    if results.redshift_fixed and options.get("redshift") is None:
        raise argument_error("redshift", "given again: it was fixed in 'results'", "None")
    n_bands = len(results.filters)
    # every object has its own stream, by its id
    noise = [stream(seed, "mock", str(key)).normal(size=n_bands) for key in results.ids]
    noise = np.reshape(noise, results.flux.shape)
    if model_error:
        error = results.sigma
    else:
        error = results.flux_err
    # bands without an error in the fit stay as they are, and so do limits
    in_fit = np.isfinite(results.sigma) & results.fitted[:, None] & np.isfinite(error)
    redrawn = in_fit & ~results.limit
    noisy_flux = results.best_flux + noise * error
    mock = quantity_table(photometry, copy=True)
    for name in filters:
        i = results.filters.index(name)
        point = fitter.zero_points.get(name, 1.0)
        # the catalog is without zero points, which the fit applies again
        measured = noisy_flux[:, i] / point
        mock[name] = np.where(redrawn[:, i], measured, flux_column(photometry, name)) * FNU
    meta = {"seed": seed, "model_error": bool(model_error)}
    return MockResult(results, fitter.fit(mock, **options), mock, seed, meta)


@value_class
class MockResult:
    """
    A mock catalog, fitted.

    Parameters
    ----------
    truth, recovered : `FitResults`
        Results whose best models are the truth, and the fit of the mock catalog.
    photometry : `~astropy.table.QTable`
        The mock catalog.
    seed : int, optional
        Of the ranks of truths within their cells.
    meta : dict, optional
        Settings.

    Examples
    --------
    >>> from miricigale.fitting import mock_analysis
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> mock = mock_analysis(fitter, fitter.fit(photometry), photometry, seed=1)
    >>> mock
    <MockResult of 2 objects, 2 fitted>
    >>> mock.true("redshift").round(1)
    <Quantity [0.5, 1. ]>
    """

    truth: object
    recovered: object
    photometry: QTable
    seed: int = 0
    meta: dict = field(default_factory=dict)

    def __len__(self):
        return len(self.truth)

    def __repr__(self):
        good = int(np.count_nonzero(self.recovered.fitted & self.truth.fitted))
        return f"<MockResult of {len(self)} objects, {good} fitted>"

    @property
    def parameters(self):
        """Names of parameters and derived quantities."""
        return self.truth.parameters

    def true(self, name):
        """Return true values: Quantity, shape (n,); NaN where there is none."""
        return self.truth.best[name]

    def to_table(self):
        """
        Tabulate true and recovered values.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id``, ``flags`` of the fit of the mock catalog and, for every parameter and
            derived quantity, ``<name>_true``, ``_mean``, ``_std``, ``_p16``, ``_p50`` and
            ``_p84``.
        """
        table = self.recovered.to_table()
        names = ["id", "flags"]
        for name in self.parameters:
            table[f"{name}_true"] = self.true(name)
            table[f"{name}_true"].info.description = f"true value of {name}: the best model's"
            names += [f"{name}_{part}" for part in ("true", "mean", "std", "p16", "p50", "p84")]
        table = table[names]
        table.meta["mock"] = dict(self.meta)
        return table

    def metrics(self, parameters=None):
        """
        Measure how well parameters are recovered.

        Parameters
        ----------
        parameters : list of str, optional
            Names; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each parameter. ``n`` objects with a true value; ``offset`` and
            ``scatter``, median and 1.48 times the median absolute deviation of posterior mean
            less truth, in ``unit`` (dex for what scales with mass, over the objects where both
            are above 0); ``coverage``, the part of truths within the 16-84 % interval. Of
            parameters of the grid, whose truth lies on a node, the coverage counts randomized
            ranks.
        """
        if parameters is None:
            names = self.parameters
        else:
            names = parameters
        rows = [self._metric(name) for name in names]
        table = described_rows(rows, _COLUMNS["mock"])
        table.meta["mock"] = dict(self.meta)
        return table

    def _metric(self, name):
        true = self.true(name).value
        mean = self.recovered.mean(name).value
        good = np.isfinite(true) & np.isfinite(mean)
        unit = self.truth.unit(name).to_string()
        difference = (mean - true)[good]
        if self.truth.extensive(name):
            positive = good & (true > 0) & (mean > 0)
            unit = "dex"
            difference = np.log10(mean[positive] / true[positive])
        return {
            "parameter": name,
            "unit": unit,
            "n": int(np.count_nonzero(good)),
            "offset": _statistic(np.median, difference),
            "scatter": _statistic(mad_std, difference),
            "coverage": _statistic(np.mean, self._inside(name, good)),
        }

    def _inside(self, name, good):
        """Whether the truth of good objects lies in the 16-84 % interval."""
        low, high = _LEVELS
        true = self.true(name).value[good]
        if name in self.recovered.axes:
            values = self.recovered.axes[name].values
            # the truth lies on a node, where the distribution steps: its rank is drawn within the step
            node = np.argmin(np.abs(true[:, None] - values), axis=1)
            draw = [stream(self.seed, "rank", name, str(i)).random() for i in self.truth.ids[good]]
            rank = randomized_ranks(self.recovered.pdf[name][good], node, draw)
            return (rank > low) & (rank < high)
        ends = self.recovered.percentile(name, _LEVELS).value[good]
        return (true >= ends[:, 0]) & (true <= ends[:, 1])

    def plot(self, name="redshift", ax=None, **kwargs):
        """Draw recovered against true values of a parameter; returns the axes."""
        from miricigale.plotting.posteriors import plot_recovery

        recovered = self.recovered
        unit = self.truth.unit(name).to_string()
        kwargs = {"name": name, "unit": unit, "log": self.truth.extensive(name), "ax": ax} | kwargs
        true = self.true(name).value
        return plot_recovery(true, recovered.mean(name).value, recovered.std(name).value, **kwargs)


def _statistic(function, values):
    """Evaluate a statistic of values; NaN of none."""
    if len(values):
        return float(function(values))
    return np.nan


@without_warnings()
def leave_out(fitter, photometry, bands, *, separately=False, **options):
    """
    Fit without some bands, and compare what is measured there with what the rest predicts.

    Upper limits in other bands take part in the fit; where a band left out is an upper limit there
    is a prediction, but nothing to compare it with.

    Parameters
    ----------
    fitter : `BayesFitter`
        How to fit, on a grid that has the bands, or a sampler that predicts them (``predict``).
    photometry : `~astropy.table.QTable`
        The catalog.
    bands : list of str or `~miricigale.filters.Filter`
        Bands to leave out, by any usual name.
    separately : bool, optional
        Whether one at a time (a fit for each), rather than all at once.
    **options
        Passed to `BayesFitter.fit`.

    Returns
    -------
    result : `LeaveOutResult`

    Raises
    ------
    KeyError
        If a band is not one of the grid.
    ValueError
        If the photometry does not have it, no object is measured in it, or too few bands are left
        to fit (``n_bands_min`` of the fitter).

    Examples
    --------
    >>> from miricigale.fitting import leave_out
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> leave_out(fitter, photometry, ["irac.ch1"]).pull.round(1)
    array([[-1. ],
           [ 1.4]])
    """
    check_type(fitter, "fitter", BayesFitter, "a BayesFitter")
    if isinstance(bands, str) or not len(bands):
        raise argument_error("bands", "a list of one or more names", repr(bands))
    fitter = fitter.for_photometry(photometry)
    bands = tuple(known_filter(name, fitter.bands, "filter of the models") for name in bands)
    check_that(len(set(bands)) == len(bands), "bands", "different names", list(bands))
    data = fitter._read_bands(photometry, bands)
    if separately:
        groups = [(name,) for name in bands]
    else:
        groups = [bands]
    fitted = bands_in_catalog(fitter, photometry.colnames)
    for group in groups:
        if len(set(fitted) - set(group)) < fitter.n_bands_min:
            wanted = f"such that n_bands_min = {fitter.n_bands_min} or more of {fitted} are left"
            raise argument_error("bands", wanted, f"{list(group)}")
    has_flux = data.used.any(axis=0)
    empty = [name for i, name in enumerate(bands) if not has_flux[i]]
    check_that(not (empty and len(photometry)), "bands", "measured for one object at least", empty)
    results = {}
    for group in groups:
        blank = quantity_table(photometry, copy=True)
        for name in group:
            # a band without flux and limit takes no part in the fit
            blank[name] = nans(len(blank)) * FNU
            blank[f"{name}_limit"] = np.zeros(len(blank), dtype=bool)
        results |= dict.fromkeys(group, fitter.fit(blank, **options))
    predicted = np.empty((len(photometry), len(bands)))
    predicted_std = np.empty_like(predicted)
    for i, name in enumerate(bands):
        column = results[name].filters.index(name)
        predicted[:, i] = results[name].model_flux[:, column]
        predicted_std[:, i] = results[name].model_flux_std[:, column]
    return LeaveOutResult(
        bands=bands,
        flux=np.where(data.measured, data.flux, np.nan),
        flux_err=np.where(data.measured, data.flux_err, np.nan),
        predicted=predicted,
        predicted_std=predicted_std,
        results=results,
    )


@value_class
class LeaveOutResult:
    """
    Bands that were not fitted, measured and predicted.

    Parameters
    ----------
    bands : tuple of str
        The bands.
    flux, flux_err : `~numpy.ndarray`, shape (n, n_bands)
        Measured fluxes and errors in uJy; NaN where there is none or an upper limit.
    predicted, predicted_std : `~numpy.ndarray`, shape (n, n_bands)
        Posterior means and standard deviations of the model fluxes in uJy, from the other
        bands.
    results : dict of str to `FitResults`
        By band, the fit without it.

    Examples
    --------
    >>> from miricigale.fitting import leave_out
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> result = leave_out(fitter, photometry, ["irac.ch1"])
    >>> result
    <LeaveOutResult of 2 objects, without irac.ch1>
    >>> result.to_table().colnames[:3]
    ['id', 'irac.ch1', 'irac.ch1_err']
    """

    bands: tuple
    flux: np.ndarray
    flux_err: np.ndarray
    predicted: np.ndarray
    predicted_std: np.ndarray
    results: dict

    def __post_init__(self):
        for name in ("flux", "flux_err", "predicted", "predicted_std"):
            object.__setattr__(self, name, frozen_array(getattr(self, name)))

    def __len__(self):
        return len(self.flux)

    def __repr__(self):
        return f"<LeaveOutResult of {len(self)} objects, without {', '.join(self.bands)}>"

    @property
    def pull(self):
        """Measured less predicted, over both errors in quadrature: shape (n, n_bands)."""
        return (self.flux - self.predicted) / np.hypot(self.flux_err, self.predicted_std)

    def to_table(self):
        """
        Tabulate measured and predicted fluxes.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id`` and, for each band, ``<name>``, ``<name>_err``, ``<name>_predicted``,
            ``<name>_predicted_err``, ``<name>_pull`` and ``<name>_flags``, those of the fit
            without it.
        """
        first_fit = self.results[self.bands[0]]
        columns = {"id": (np.array(first_fit.ids), "identifier")}
        pull = self.pull * u.dimensionless_unscaled
        text = "measured less predicted, over both errors in quadrature"
        for i, name in enumerate(self.bands):
            columns |= {
                name: (self.flux[:, i] * FNU, "measured flux, not fitted"),
                error_column(name): (self.flux_err[:, i] * FNU, "its error"),
                f"{name}_predicted": (self.predicted[:, i] * FNU, "flux predicted by the others"),
                f"{name}_predicted_err": (self.predicted_std[:, i] * FNU, "its error"),
                f"{name}_pull": (pull[:, i], text),
                f"{name}_flags": (np.array(self.results[name].flags), FitFlags.describe()),
            }
        return described_table(columns, dict(first_fit.meta) | {"left_out": list(self.bands)})

    def metrics(self):
        """
        Measure how well each band is predicted.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each band: ``n`` objects; ``offset``, the median of measured over
            predicted less 1; ``pull`` and ``pull_scatter``, median and 1.48 times the median
            absolute deviation of the pulls; ``within``, the part of pulls within 1 (0.68 if
            errors and models are right).
        """
        rows = [self._metric(i) for i in range(len(self.bands))]
        return described_rows(rows, _COLUMNS["left_out"])

    def _metric(self, i):
        good = np.isfinite(self.pull[:, i])
        pull = self.pull[good, i]
        flux = self.flux[good, i]
        model = self.predicted[good, i]
        # ratios need predictions above 0
        offset = _statistic(np.median, flux[model > 0] / model[model > 0]) - 1.0
        return {
            "band": self.bands[i],
            "n": int(pull.size),
            "offset": offset,
            "pull": _statistic(np.median, pull),
            "pull_scatter": _statistic(mad_std, pull),
            "within": _statistic(np.mean, np.abs(pull) <= 1.0),
        }

    def plot(self, band=None, ax=None, **kwargs):
        """Draw the distribution of the pulls of one band, or of all; returns the axes."""
        from miricigale.plotting.axes import plain_text
        from miricigale.plotting.posteriors import plot_pulls

        pull = self.pull
        label = None
        if band is not None:
            check_names([band], "band that was left out", self.bands)
            pull = self.pull[:, self.bands.index(band)]
            label = plain_text(band)
        return plot_pulls(pull.ravel(), ax=ax, **{"label": label, **kwargs})
