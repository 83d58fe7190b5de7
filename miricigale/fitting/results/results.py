"""What a fit returns: posteriors of the objects of a catalog."""

import re
from dataclasses import field

import astropy.units as u
import numpy as np

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.posterior.posterior import (
    FitRows,
    cell_edges,
    cell_percentiles,
    cell_shares,
    check_levels,
    limits_of,
    moments,
    shares_between,
)
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS, kept_percentiles
from miricigale.fitting.results import drawing, histories, inference_data
from miricigale.fitting.results.posterior_weights import PosteriorWeights
from miricigale.fitting.results.result_tables import flux_table, reduced_chi2, result_table
from miricigale.fitting.results.results_text import html_representation, representation
from miricigale.fitting.results.sample_flags import worst_bands
from miricigale.fitting.results.table_columns import OUTLIER, TEXTS
from miricigale.utils.arrays import nans
from miricigale.utils.file_formats import read_write
from miricigale.utils.flag_arrays import FlagField
from miricigale.utils.object_rows import PerObject, PerObjectDict, of_id
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.values import value_class

#: Part of the mean below which CIGALE gives no standard deviation.
CIGALE_LEAST_STD = 0.05
#: Methods by the ending of a name, which are no columns of the table.
_STATISTICS = {"err": "std", "median": "median"}


@value_class
class FitResults(FitRows):
    """
    Posteriors of the objects of a catalog, in its order.

    Made by `BayesFitter.fit`; every array is read-only, and NaN for objects that could not be
    fitted. ``results[0]``, ``results[rows]`` and ``results.loc[id]`` are of this class too: of a single object
    the arrays have no axis of objects (shapes below without ``n``), and only a single object has spectra and
    plots. With several, the id comes first: ``results.plot_sed(id)``, ``results.plot_pdf(id, "redshift")``.

    Parameters
    ----------
    ids : `~numpy.ndarray`, shape (n,)
        Ids of the objects.
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags`.
    n_bands : `~numpy.ndarray` of int, shape (n,)
        Number of bands used, upper limits among them.
    chi2 : `~numpy.ndarray`, shape (n,)
        Chi2 of the best model, model error and the terms of upper limits included; with the stated errors of
        all bands, wrong ones too.
    log_evidence : `~numpy.ndarray`, shape (n,)
        Of the grid ln of the sum of prior * likelihood (fluxes in uJy), each model at its best scale;
        otherwise the sampler's ln(evidence).
    filters : tuple of str
        Bands of the models, nb of them.
    flux, flux_err, sigma : `~numpy.ndarray`, shape (n, nb)
        Measured fluxes or upper limits, their errors, and the errors used (of fluxes with model
        error; infinite in bands that were not used), in uJy.
    axes : dict of str to `~miricigale.fitting.posterior.priors.GridAxis`
        Parameters that have several values; of a sampler, cells of their priors.
    pdf : dict of str to `~numpy.ndarray`, shape (n, n_values)
        Posterior weights of their values. A call has the values too: ``z, weights = results.pdf("redshift")``.
    pdf_2d : `~numpy.ndarray`, shape (n, nz, nf)
        Joint posterior of redshift and AGN fraction.
    best_index : `~numpy.ndarray` of int, shape (n, 4)
        Redshift, galaxy, AGN template and fraction of the best model in the grid; -1 of a sampler.
    best_scale : `~numpy.ndarray`, shape (n,)
        Its scale, in solar masses formed.
    best : dict of str to array_like, shape (n,)
        Parameters and derived quantities of the best model; attribute: `~astropy.units.Quantity`.
    quantities, units, descriptions : tuple
        Names, units and meanings of the n_q derived quantities.
    moments : `~numpy.ndarray`, shape (n, n_q, 3)
        Mean, standard deviation and mean of log10 (over models where it is not zero).
    quantiles : `~numpy.ndarray`, shape (n, n_q, n_levels)
        Quantiles at `miricigale.fitting.posterior.quantities.DERIVED_LEVELS`.
    model_flux, model_flux_std, best_flux : `~numpy.ndarray`, shape (n, nb)
        Mean and standard deviation of the model fluxes over the posterior, and the fluxes of
        the best model, in uJy, in all bands of the models.
    limit : `~numpy.ndarray` of bool, shape (n, nb), optional
        Which of the bands used are upper limits; none by default.
    pairs : dict of tuple of str to `~numpy.ndarray`, shape (n, nx, ny), optional
        Joint posteriors of other pairs of parameters, those that the fit was asked for; see
        `joint_pdf`.
    log_evidence_err, n_calls, n_effective, converged : `~numpy.ndarray`, shape (n,), optional
        Of a sampler: error of ``log_evidence``, models evaluated, effective size of the sample, and
        whether it finished before ``max_calls``.
    axis_moments, axis_quantiles : `~numpy.ndarray`, shapes (n, n_axes, 2) and (n, n_axes, n_levels), optional
        Of a sampler: moments and quantiles of the parameters of ``axes``, from the sample itself.
    draws : `~numpy.ndarray`, shape (n, n_draws, n_parameters), optional
        Of a sampler: draws of equal weight of all `parameters`; see `samples`.
    intensive : tuple of str, optional
        Those of ``quantities`` that do not scale with mass: attenuation, ages, colors, the AGN
        fraction in its other definition. They have no mean of log10.
    fitted_filters : tuple of str, optional
        The bands that were fitted; all of ``filters`` by default.
    redshift_fixed : bool, optional
        Whether the fit was at given redshifts.
    constants : dict of str to float, optional
        Parameters with one value, which have no posterior.
    distance : `~numpy.ndarray`, shape (n,), optional
        Distances in Mpc that masses and luminosities are for, where they are not those of the redshifts; NaN
        where they are.
    outlier : `~numpy.ndarray`, shape (n, nb), optional
        How likely each band is wrong, of a fit with ``outliers``; NaN in bands not used.
    agn_weights : `~numpy.ndarray`, shape (n, n_z, n_fractions, n_luminosities), optional
        Joint posterior of redshift, AGN fraction and luminosity in ``agn_bins`` of `GridSettings`.
    least_std : float, optional
        Part of the mean below which no standard deviation is given (CIGALE: 0.05).
    model : `~miricigale.sed.SEDModel`, optional
        The model that was fitted; not written to files.
    curves : tuple of `~miricigale.filters.Filter`, optional
        Curves of the bands that are not of the library; not written to files.
    meta : dict, optional
        Provenance and the settings of the fit, for people.

    Examples
    --------
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.02)
    >>> results = fitter.fit(photometry)
    >>> results
    <FitResults of 2 objects, 2 fitted, 4 bands>
    >>> results["b"].mean("redshift").round(2)
    <Quantity 1.02>
    >>> edges, weights = results["b"].distribution("redshift")
    """

    ids: PerObject
    flags: PerObject
    n_bands: PerObject
    chi2: PerObject
    log_evidence: PerObject
    filters: tuple
    flux: PerObject
    flux_err: PerObject
    sigma: PerObject
    axes: dict
    pdf: PerObjectDict
    pdf_2d: PerObject
    best_index: PerObject
    best_scale: PerObject
    best: PerObjectDict
    quantities: tuple
    units: tuple
    descriptions: tuple
    moments: PerObject
    quantiles: PerObject
    model_flux: PerObject
    model_flux_std: PerObject
    best_flux: PerObject
    limit: PerObject = None
    pairs: PerObjectDict = field(default_factory=dict)
    log_evidence_err: PerObject = None
    n_calls: PerObject = None
    n_effective: PerObject = None
    converged: PerObject = None
    axis_moments: PerObject = None
    axis_quantiles: PerObject = None
    draws: PerObject = None
    intensive: tuple = ()
    fitted_filters: tuple | None = None
    redshift_fixed: bool = False
    distance: PerObject = None
    outlier: PerObject = None
    agn_weights: PerObject = None
    constants: dict = field(default_factory=dict)
    least_std: float = 0.0
    model: object = None
    curves: tuple = ()
    meta: dict = field(default_factory=dict)

    read, write = read_write("results (FITS: all but the model; ECSV: their table, not read back)")

    def __post_init__(self):
        if self.limit is None:
            object.__setattr__(self, "limit", np.zeros(np.shape(self.sigma), dtype=bool))
        if self.fitted_filters is None:
            object.__setattr__(self, "fitted_filters", tuple(self.filters))
        best = self.best.items()
        self.__dict__["best"] = {name: u.Quantity(v, self.unit(name)) for name, v in best}
        super().__post_init__()

    def __repr__(self):
        return representation(self)

    def _repr_html_(self):
        return html_representation(self)

    @property
    def fitted(self):
        """Which objects have a result."""
        return np.isfinite(self.chi2)

    @property
    def n_limits(self):
        """How many of the bands used are upper limits: array of int, shape (n,)."""
        return np.count_nonzero(self.limit, axis=-1)

    @property
    def reduced_chi2(self):
        """Chi2 over the number of bands (limits among them) less one; NaN with a single band."""
        return reduced_chi2(self.chi2, self.n_bands)[()]

    @property
    def residuals(self):
        """Fluxes less those of the best model, over ``sigma``, shape (n, n_bands); NaN without a flux."""
        return (self.flux - self.best_flux) / self.sigma

    @property
    def band_off(self):
        """The band that is off (`FitFlags` ``BAND_OFF``), empty without: array of str, shape (n,)."""
        names = np.array(list(self.filters) + [""])
        worst = names[worst_bands(self._several())]
        if self.isscalar:
            return worst[0]
        return worst

    @property
    def parameters(self):
        """Names of all that has a posterior: parameters, then derived quantities."""
        return tuple(self.axes) + tuple(self.quantities)

    def _by_name(self, field, arrays):
        if field == "pdf":
            return PosteriorWeights(arrays, self._other_name, self.axes, self.quantities)
        return super()._by_name(field, arrays)

    def unit(self, name):
        """Return the unit of a parameter or derived quantity."""
        name = self._named(name)
        if name in self.axes:
            return u.Unit(self.axes[name].unit)
        if name == "redshift":
            # a fixed redshift has no axis
            return u.dimensionless_unscaled
        return self.units[self._quantity(name)]

    def extensive(self, name):
        """Whether it is a derived quantity that scales with mass."""
        return name in self.quantities and name not in self.intensive

    def _quantity(self, name):
        check_names([name], "parameter", self.parameters)
        return self.quantities.index(name)

    def _meaning(self, name):
        if name in self.quantities:
            return self.descriptions[self._quantity(name)]
        return name

    # ------------------------------------------------------------------ posteriors

    def mean(self, name):
        """Return the posterior means of a parameter or derived quantity: Quantity, shape (n,)."""
        mean, _ = self._moments(name)
        return mean * self.unit(name)

    def std(self, name):
        """Return the posterior standard deviations: Quantity, shape (n,)."""
        _, std = self._moments(name)
        return std * self.unit(name)

    def _moments(self, name):
        name = self._named(name)
        stored = self._stored(name, "moments")
        if stored is None:
            mean, std = moments(self.axes[name].values, self.pdf[name])
        else:
            mean = stored[..., 0]
            std = stored[..., 1]
        return mean, np.maximum(std, self.least_std * np.abs(mean))

    def _stored(self, name, statistic):
        """Return stored moments or quantiles; None of a parameter whose cells are stored instead."""
        if name not in self.axes:
            return getattr(self, statistic)[..., self._quantity(name), :]
        stored = getattr(self, f"axis_{statistic}")
        if stored is None:
            return None
        return stored[..., list(self.axes).index(name), :]

    def median(self, name):
        """Return the posterior medians of a parameter: `~astropy.units.Quantity`, shape (n,)."""
        return self.percentile(name, [0.5])[..., 0]

    def summary(self):
        """Tabulate id, names of flags, chi2, and the 16th, 50th and 84th percentiles."""
        table = self.to_table()
        columns = [name for name in table.colnames if re.search(r"^(id|chi2_best)$|_p\d\d$", name)]
        table = table[columns]
        table.add_column([", ".join(names) for names in self.flag_names()], 1, "flags")
        return table

    def _column(self, name):
        """Return the posterior medians, or errors (``redshift_err``), of a parameter, or a column of the table."""
        if self._named(name) in self.parameters:
            return self.median(name)
        if isinstance(name, str):
            parameter, _, suffix = name.rpartition("_")
            statistic = self._statistic(self._named(parameter), suffix)
            if statistic is not None:
                return statistic
        return super()._column(name)

    def _statistic(self, parameter, suffix):
        """Return the errors or medians of a parameter, by the ending of a name; None if it is another."""
        if parameter in self.parameters and suffix in _STATISTICS:
            return getattr(self, _STATISTICS[suffix])(parameter)
        return None

    def _value(self, name):
        # copies that are not complete have no axes yet
        if "axes" not in self.__dict__:
            return None
        if name in self.parameters:
            return self.median(name)
        parameter, _, suffix = name.rpartition("_")
        statistic = self._statistic(parameter, suffix)
        if statistic is not None:
            return statistic
        if parameter in self.parameters and suffix in TEXTS["parameter"]:
            # a column of the table, such as redshift_p16
            column = self.to_table()[name]
            return column[0] if self.isscalar else column
        return None

    def _value_names(self):
        return self.parameters

    def plot(self, ax=None, **kwargs):
        """Draw a single object (`plot_sed`), or the masses of several over redshift; returns the axes."""
        if self.isscalar:
            return self.plot_sed(ax, **kwargs)
        return drawing.plot_masses(self, ax)

    def percentile(self, name, levels=(16, 50, 84)):
        """
        Posterior percentiles.

        Parameters
        ----------
        name : str
            A parameter or derived quantity, by our name or CIGALE's (``"stellar.m_star"``).
        levels : array_like, optional
            Levels in (0, 1), or all in percent; of derived quantities, and of all of a sampler, from
            0.001 to 0.999.

        Returns
        -------
        percentiles : `~astropy.units.Quantity`, shape (n, n_levels); (n,) for a single level
            For parameters of the grid from the distribution that is linear within each cell.

        Raises
        ------
        KeyError
            If there is no such parameter.
        ValueError
            If a level is outside.
        """
        if isinstance(levels, str) and not isinstance(name, str):
            # in the order of numpy.percentile
            name, levels = levels, name
        single = np.ndim(levels) == 0
        levels = check_levels(levels)
        name = self._named(name)
        rows = self._several()
        stored = rows._stored(name, "quantiles")
        if stored is None:
            axis = self.axes[name]
            out = cell_percentiles(axis.values, rows.pdf[name], levels, axis.bounds)
        else:
            out = kept_percentiles(name, levels, stored)
        if single:
            out = out[:, 0]
        if self.isscalar:
            out = out[0]
        return out * self.unit(name)

    def distribution(self, name):
        """
        Posterior of a parameter or derived quantity.

        Returns
        -------
        edges : `~astropy.units.Quantity`, shape (n_cells + 1,) or (n, n_cells + 1)
            Edges of the cells: those around the values of a parameter, or, for each object, the
            quantiles of a derived quantity. Between nodes a component that may be absent has a first cell of
            no width at 0, whose weight is the probability that it is.
        weights : `~numpy.ndarray`, shape (n, n_cells) or (n_cells,)
            Weight of each cell; of the cells between quantiles the same for all.
        """
        name = self._named(name)
        if name in self.axes:
            axis = self.axes[name]
            edges = cell_edges(axis.values, axis.bounds)
            if self.axis_quantiles is not None and axis.absent_at_zero:
                # an absent component has a cell of no width; the next cell begins at 0
                edges[:2] = 0.0
            return edges * self.unit(name), self.pdf[name]
        return self._stored(name, "quantiles") * self.unit(name), np.diff(DERIVED_LEVELS)

    def cdf(self, name):
        """
        Return the cumulative distribution of a parameter or derived quantity, linear between its points.

        Returns
        -------
        values : `~astropy.units.Quantity`
            Edges of the cells of a parameter, or quantiles; see `distribution`.
        levels : `~numpy.ndarray`
            Part of the posterior below each; from 0.001 to 0.999 for a derived quantity.
        """
        name = self._named(name)
        edges, weights = self.distribution(name)
        first = np.zeros(weights.shape[:-1] + (1,))
        if name not in self.axes:
            first[:] = DERIVED_LEVELS[0]
        # rounding may lift a sum above 1
        levels = np.minimum(first + np.cumsum(weights, axis=-1), 1.0)
        return edges, np.concatenate([first, levels], axis=-1)

    @takes_other_keywords
    def probability(self, name, low=None, high=None):
        """
        Return the posterior probability that a parameter or derived quantity is within limits.

        Parameters
        ----------
        name : str
            As for `percentile`, or a name with a limit, such as ``"frac_agn > 0.1"``, in place of the others.
        low, high : float or `~astropy.units.Quantity`, optional
            The limits; none on a side that is left out. A number is in the unit of the parameter.

        Returns
        -------
        probability : `~numpy.ndarray`, shape (n,), or float
            From `cdf`: to 0.001 for a derived quantity. What has its weight at 0, such as an AGN that is absent,
            is above a ``low`` of 0 and not above any other.

        Raises
        ------
        ValueError
            If no limit is given, or they are not in order.
        """
        if not isinstance(name, str):
            msg = f"probability('redshift', 2) is that of redshifts above 2; got {type(name).__name__} as the name"
            raise TypeError(msg)
        if low is None and high is None:
            name, low, high = limits_of(name)
        unit = self.unit(name)
        wanted = f"given, or 'high', such as probability({name!r}, low=1)"
        check_that(low is not None or high is not None, "low", wanted, "None")
        wanted = f"at least 'low', {low}"
        got = f"{high}"
        if low is not None:
            low = u.Quantity(low, unit).value
        if high is not None:
            high = u.Quantity(high, unit).value
        check_that(low is None or high is None or low <= high, "high", wanted, got)
        values, levels = self.cdf(name)
        values, levels = np.broadcast_arrays(np.atleast_2d(values.value), levels)
        out = shares_between(values, levels, low, high)
        if self.isscalar:
            return float(out[0])
        return out

    @property
    def redshift_odds(self):
        r"""
        Probability that the median redshift is no outlier: array, shape (n,).

        The odds of Benitez 2000 (ApJ 536, 571, section 4.2), the posterior in a window about the redshift given,
        with the window of outliers: the probability that :math:`|z_{50} - z| / (1 + z) < 0.15` for the redshift
        z, from the distribution that is linear within each cell of the redshifts. NaN at known redshifts.
        """
        rows = self._several()
        out = nans(len(rows))
        if "redshift" in self.axes and not self.redshift_fixed:
            z = rows.median("redshift").value
            axis = self.axes["redshift"]
            # abs(z50 - z) / (1 + z) < 0.15, solved for z
            low = (z - OUTLIER) / (1.0 + OUTLIER)
            high = (z + OUTLIER) / (1.0 - OUTLIER)
            out = cell_shares(axis.values, rows.pdf["redshift"], low, high, axis.bounds)
        if self.isscalar:
            return out[0]
        return out

    def joint_pdf(self, x, y):
        """
        Return the joint posterior of two parameters, summed over all models.

        Parameters
        ----------
        x, y : str
            Redshift and AGN fraction, or a pair of ``pairs`` in `BayesFitter.fit`, in any order.
            `Samples.pdf_2d` has those of any two, from draws.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n, nx, ny)
            Weights of the values ``axes[x].values`` and ``axes[y].values``; they sum to 1.

        Raises
        ------
        KeyError
            If the results do not have it.
        """
        x = self._named(x)
        y = self._named(y)
        tables = dict(self.pairs)
        if "frac_agn" in self.axes:
            tables["redshift", "frac_agn"] = self.pdf_2d
        if (x, y) in tables:
            return tables[x, y]
        if (y, x) in tables:
            return np.swapaxes(tables[y, x], -1, -2)
        check_names((x, y), "parameter", self.parameters)
        have = ", ".join(f"{a} and {b}" for a, b in tables) or "none"
        msg = f"no joint posterior of {x} and {y}; known: {have} ('pairs' of BayesFitter.fit); "
        msg += drawing.DRAWN_PAIRS
        raise KeyError(msg)

    # -------------------------------------------------------------- tables and drawings

    def to_table(self, columns=None):
        """
        Tabulate the results.

        Parameters
        ----------
        columns : list of str, optional
            Columns to keep, or parameters for all columns of these; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            One row for each object: ``id``, ``flags``, ``n_bands``, ``n_limits``,
            ``chi2_best``, ``reduced_chi2``, ``band_off``, ``log_evidence`` (of a sampler also
            ``log_evidence_err``, ``n_calls``, ``n_effective``, ``converged``), and for each
            parameter and derived quantity ``<name>_mean``, ``_std``, ``_p16``, ``_p50``, ``_p84``
            and ``_best``; derived quantities that scale with mass also have ``_logmean``, the mean
            of log10 (dex, in their unit). Of a fit with ``outliers``, for each band
            ``<band>_outlier``, how likely it is wrong. With free redshifts `redshift_odds`.
        """
        return result_table(self._several(), columns)

    def predict(self, filters=None):
        """
        Tabulate model fluxes over the posterior in uJy; `Samples.predict` has those in other bands.

        Parameters
        ----------
        filters : list of str or `~miricigale.filters.FilterSet`, optional
            Bands of the models, fitted or not; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id`` and, for each filter, mean (by its name), standard deviation (``<name>_err``)
            and flux of the best model (``<name>_best``) in uJy.
        """
        return flux_table(self._several(), filters)

    samples = drawing.samples
    to_arviz = inference_data.of_results
    best_sed = of_id(drawing.best_sed)
    plot_sed = of_id(drawing.plot_sed)
    plot_pdf = of_id(drawing.plot_pdf)
    plot_pdf2d = of_id(drawing.plot_pdf2d)
    plot_corner = of_id(drawing.plot_corner)
    plot_redshift = drawing.plot_redshift
    plot_sfh = of_id(histories.plot_sfh)


FlagField.add_to(FitResults, "flags", FitFlags)
