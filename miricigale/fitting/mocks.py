"""How far a fit can be trusted: its best models with noise, fitted again."""

from dataclasses import dataclass, field

import numpy as np
from astropy.table import QTable

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.likelihood import flux_column, read_ids
from miricigale.fitting.posterior import randomised_ranks
from miricigale.utils.exceptions import argument_error
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU

__all__ = ["MockResult", "mock_analysis"]

_LEVELS = (0.16, 0.84)


def mock_analysis(fitter, results, photometry, *, seed, model_error=False, **options):
    """
    Refit a mock catalogue whose true parameters are known: the best models with noise.

    The best model of every object takes the object's place; its fluxes in the bands that were
    used are perturbed by the measured errors of that object and fitted as the object was
    (Boquien et al. 2019, A&A 622, A103, section 4.3). Upper limits stay as they are, for what
    would have been measured there is not known.

    Parameters
    ----------
    fitter : `BayesFitter`
        What made the results.
    results : `FitResults`
        Results of the catalogue.
    photometry : `~astropy.table.QTable`
        The catalogue that was fitted.
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
    """
    seed = check_seed(seed)
    filters = results.meta.get("fit", {}).get("filters", results.filters)
    columns = [c for name in filters for c in (name, error_column(name))]
    require_columns(photometry, ["id", *columns], "photometry", units=dict.fromkeys(columns, FNU))
    if not np.array_equal(read_ids(photometry), results.ids):
        raise argument_error("photometry", "of the objects of 'results', in order", "others")
    if results.meta.get("fit", {}).get("redshift") == "fixed" and options.get("redshift") is None:
        raise argument_error("redshift", "given again: it was fixed in 'results'", "None")
    noise = np.array(
        [stream(seed, "mock", str(key)).normal(size=len(results.filters)) for key in results.ids]
    ).reshape(results.flux.shape)
    error = results.sigma if model_error else results.flux_err
    used = np.isfinite(results.sigma) & results.fitted[:, None] & np.isfinite(error)
    mock = QTable(photometry, copy=True)
    for name in filters:
        i = results.filters.index(name)
        change = used[:, i] & ~results.limit[:, i]
        flux = flux_column(photometry, name)
        flux[change] = (results.best_flux[:, i] + noise[:, i] * error[:, i])[change]
        mock[name] = flux * FNU
    recovered = fitter.fit(mock, **options)
    return MockResult(results, recovered, mock, {"seed": seed, "model_error": bool(model_error)})


@dataclass(frozen=True, eq=False, repr=False)
class MockResult:
    """
    A mock catalogue, fitted.

    Parameters
    ----------
    truth : `FitResults`
        Results whose best models are the truth.
    recovered : `FitResults`
        Fit of the mock catalogue.
    photometry : `~astropy.table.QTable`
        The mock catalogue.
    meta : dict
        Seed and settings.
    """

    truth: object
    recovered: object
    photometry: QTable
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
        """True values: Quantity, shape (n,); NaN where there is none."""
        unit = self.truth.unit(name)
        return self.truth.best[name] * unit

    def to_table(self):
        """
        True and recovered values.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id``, ``flags`` of the fit of the mock catalogue and, for every parameter and
            derived quantity, ``<name>_true``, ``_mean``, ``_std``, ``_p16``, ``_p50`` and
            ``_p84``.
        """
        out = QTable(meta=dict(self.recovered.meta) | {"mock": dict(self.meta)})
        out["id"] = np.array(self.recovered.ids)
        out["id"].info.description = "identifier"
        out["flags"] = np.array(self.recovered.flags)
        out["flags"].info.description = FitFlags.describe()
        table = self.recovered.to_table()
        for name in self.parameters:
            out[f"{name}_true"] = self.true(name)
            out[f"{name}_true"].info.description = f"true value of {name}: the best model's"
            for suffix in ("mean", "std", "p16", "p50", "p84"):
                column = f"{name}_{suffix}"
                out[column] = table[column]
        return out

    def metrics(self, parameters=None):
        """
        How well parameters are recovered.

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
            parameters of the grid, whose truth lies on a node, the coverage counts randomised
            ranks.
        """
        names = self.parameters if parameters is None else tuple(parameters)
        rows = [self._metric(name) for name in names]
        out = QTable(meta={"mock": dict(self.meta)})
        out["parameter"] = np.array(names, dtype=str)
        texts = {
            "unit": "unit of offset and scatter",
            "n": "objects with a true value that were fitted",
            "offset": "median of posterior mean less truth",
            "scatter": "1.48 times the median absolute deviation of the same",
            "coverage": "part of truths within the 16-84 % interval; 0.68 is right",
        }
        out["parameter"].info.description = "parameter or derived quantity"
        for i, (name, text) in enumerate(texts.items()):
            out[name] = np.array([row[i] for row in rows])
            out[name].info.description = text
        return out

    def _metric(self, name):
        true, mean = self.true(name).value, self.recovered.mean(name).value
        good = np.isfinite(true) & np.isfinite(mean)
        extensive = name in self.truth.quantities and name not in self.truth.intensive
        if extensive:
            both = good & (true > 0) & (mean > 0)
            difference = np.log10(mean[both] / true[both])
            unit = "dex"
        else:
            difference = (mean - true)[good]
            unit = self.truth.unit(name).to_string()
        offset, scatter = np.nan, np.nan
        if difference.size:
            offset = float(np.median(difference))
            scatter = 1.4826 * float(np.median(np.abs(difference - offset)))
        coverage = float(np.mean(self._inside(name, good))) if good.any() else np.nan
        return unit, int(np.count_nonzero(good)), offset, scatter, coverage

    def _inside(self, name, good):
        """Whether the truth of good objects lies in the 16-84 % interval."""
        low, high = _LEVELS
        true = self.true(name).value[good]
        if name in self.recovered.axes:
            values = self.recovered.axes[name].values
            node = np.argmin(np.abs(true[:, None] - values), axis=1)
            seed = int(self.meta.get("seed", 0))
            draw = [stream(seed, "rank", name, str(i)).random() for i in self.truth.ids[good]]
            rank = randomised_ranks(self.recovered.pdf[name][good], node, draw)
            return (rank > low) & (rank < high)
        ends = self.recovered.percentile(name, _LEVELS).value[good]
        return (true >= ends[:, 0]) & (true <= ends[:, 1])

    def plot(self, name, ax=None, **kwargs):
        """Draw recovered against true values of a parameter; returns the axes."""
        from miricigale.plotting.posteriors import plot_recovery

        extensive = name in self.truth.quantities and name not in self.truth.intensive
        unit = self.truth.unit(name)
        kwargs = {"name": name, "unit": unit.to_string(), "log": extensive} | kwargs
        return plot_recovery(
            self.true(name).value,
            self.recovered.mean(name).value,
            self.recovered.std(name).value,
            ax=ax,
            **kwargs,
        )
