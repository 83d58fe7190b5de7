"""What a fit of a catalogue returns."""

from dataclasses import dataclass, field, fields

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.keyed import find_row, rows_by_id
from miricigale.fitting.posterior import cell_percentiles, check_levels, moments
from miricigale.fitting.quantities import kept_percentiles
from miricigale.fitting.result import FitResult
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, frozen_array

__all__ = ["FitResults"]

_LEVELS = (0.16, 0.5, 0.84)
#: Part of the mean below which CIGALE gives no standard deviation.
CIGALE_LEAST_ERROR = 0.05
_SUFFIXES = ("p16", "p50", "p84")


@dataclass(frozen=True, eq=False, repr=False)
class FitResults:
    """
    Posteriors of the objects of a catalogue, in its order.

    Made by `BayesFitter.fit`; every array is read-only, and NaN for objects that could not be
    fitted.

    Parameters
    ----------
    ids : `~numpy.ndarray`, shape (n,)
        Ids of the objects.
    flags : `~numpy.ndarray` of int, shape (n,)
        `FitFlags`.
    n_bands : `~numpy.ndarray` of int, shape (n,)
        Number of bands used, upper limits among them.
    chi2 : `~numpy.ndarray`, shape (n,)
        Chi2 of the best model, model error and the terms of upper limits included.
    log_evidence : `~numpy.ndarray`, shape (n,)
        ln of the sum of prior * likelihood (fluxes in uJy), each model at its best scale.
    filters : tuple of str
        Bands of the grid, nb of them.
    flux, flux_err, sigma : `~numpy.ndarray`, shape (n, nb)
        Measured fluxes or upper limits, their errors, and the errors used (of fluxes with model
        error; infinite in bands that were not used), in uJy.
    axes : dict of str to `~miricigale.fitting.priors.GridAxis`
        Parameters that have several values.
    pdf : dict of str to `~numpy.ndarray`, shape (n, n_values)
        Posterior weights of their values.
    pdf_2d : `~numpy.ndarray`, shape (n, nz, nf)
        Joint posterior of redshift and AGN fraction.
    best_index : `~numpy.ndarray` of int, shape (n, 4)
        Redshift, galaxy, torus and fraction of the best model in the grid.
    best_scale : `~numpy.ndarray`, shape (n,)
        Its scale, in solar masses formed.
    best : dict of str to `~numpy.ndarray`, shape (n,)
        Parameters and derived quantities of the best model.
    quantities, units, descriptions : tuple
        Names, units and meanings of the n_q derived quantities.
    moments : `~numpy.ndarray`, shape (n, n_q, 3)
        Mean, standard deviation and mean of log10 (over models where it is not zero).
    quantiles : `~numpy.ndarray`, shape (n, n_q, n_levels)
        Quantiles at `miricigale.fitting.quantities.DERIVED_LEVELS`.
    model_flux, model_flux_std, best_flux : `~numpy.ndarray`, shape (n, nb)
        Mean and standard deviation of the model fluxes over the posterior, and the fluxes of
        the best model, in uJy, in all bands of the grid.
    meta : dict
        Provenance and the settings of the fit.
    model : `~miricigale.sed.SEDModel`, optional
        The model the grid was made from; not written to files.
    intensive : tuple of str, optional
        Those of ``quantities`` that do not scale with mass: attenuation, ages, colours, the AGN
        fraction in its other definition. They have no mean of log10.
    limit : `~numpy.ndarray` of bool, shape (n, nb), optional
        Which of the bands used are upper limits; none by default.
    pairs : dict of tuple of str to `~numpy.ndarray`, shape (n, nx, ny), optional
        Joint posteriors of other pairs of parameters, those that the fit was asked for; see
        `joint_pdf`.
    """

    ids: np.ndarray
    flags: np.ndarray
    n_bands: np.ndarray
    chi2: np.ndarray
    log_evidence: np.ndarray
    filters: tuple
    flux: np.ndarray
    flux_err: np.ndarray
    sigma: np.ndarray
    axes: dict
    pdf: dict
    pdf_2d: np.ndarray
    best_index: np.ndarray
    best_scale: np.ndarray
    best: dict
    quantities: tuple
    units: tuple
    descriptions: tuple
    moments: np.ndarray
    quantiles: np.ndarray
    model_flux: np.ndarray
    model_flux_std: np.ndarray
    best_flux: np.ndarray
    meta: dict = field(default_factory=dict)
    model: object = None
    intensive: tuple = ()
    limit: np.ndarray | None = None
    pairs: dict = field(default_factory=dict)

    def __post_init__(self):
        if self.limit is None:
            object.__setattr__(self, "limit", np.zeros(np.shape(self.sigma), dtype=bool))
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, item.name, frozen_array(value, value.dtype))
        for name in ("pdf", "best", "pairs"):
            frozen = {k: frozen_array(v) for k, v in getattr(self, name).items()}
            object.__setattr__(self, name, frozen)
        object.__setattr__(self, "_rows", rows_by_id(self.ids))

    def __len__(self):
        return len(self.ids)

    def __iter__(self):
        return (FitResult(self, row) for row in range(len(self)))

    def __getitem__(self, key):
        """Return the result of the object with this id."""
        return FitResult(self, self.row(key))

    def __repr__(self):
        good = int(np.count_nonzero(self.fitted))
        return f"<FitResults of {len(self)} objects, {good} fitted, {len(self.filters)} bands>"

    def row(self, key):
        """
        Row of an id (the first, if it occurs twice).

        Raises
        ------
        KeyError
            If there is none.
        """
        return find_row(self._rows, key, len(self))

    @property
    def fitted(self):
        """Which objects have a result."""
        return np.isfinite(self.chi2)

    @property
    def n_limits(self):
        """How many of the bands used are upper limits: array of int, shape (n,)."""
        return np.count_nonzero(self.limit, axis=1)

    @property
    def reduced_chi2(self):
        """Chi2 over the number of bands (limits among them) less one; NaN with a single band."""
        free = np.maximum(self.n_bands - 1, 0)
        return np.divide(self.chi2, free, out=np.full(len(self), np.nan), where=free > 0)

    @property
    def parameters(self):
        """Names of all that has a posterior: parameters, then derived quantities."""
        return (*self.axes, *self.quantities)

    def unit(self, name):
        """Unit of a parameter or derived quantity."""
        if name in self.axes:
            return u.Unit(self.axes[name].unit)
        return self.units[self._quantity(name)]

    def _quantity(self, name):
        if name not in self.quantities:
            raise unknown_name("parameter", name, self.parameters)
        return self.quantities.index(name)

    def mean(self, name):
        """Posterior means of a parameter or derived quantity: Quantity, shape (n,)."""
        return self._moments(name)[0] * self.unit(name)

    def std(self, name):
        """Posterior standard deviations: Quantity, shape (n,)."""
        return self._moments(name)[1] * self.unit(name)

    def _moments(self, name):
        if name in self.axes:
            mean, std = moments(self.axes[name].values, self.pdf[name])
        else:
            i = self._quantity(name)
            mean, std = self.moments[:, i, 0], self.moments[:, i, 1]
        if self.meta.get("fit", {}).get("compat") == "cigale":
            std = np.maximum(std, CIGALE_LEAST_ERROR * np.abs(mean))
        return mean, std

    def percentile(self, name, levels):
        """
        Posterior percentiles.

        Parameters
        ----------
        name : str
            A parameter or derived quantity.
        levels : array_like
            Levels in (0, 1); of derived quantities from 0.001 to 0.999, between which their
            distribution is kept.

        Returns
        -------
        percentiles : `~astropy.units.Quantity`, shape (n, n_levels)
            For parameters of the grid from the distribution that is linear within each cell.

        Raises
        ------
        KeyError
            If there is no such parameter.
        ValueError
            If a level is outside.
        """
        levels = check_levels(levels)
        if name in self.axes:
            axis = self.axes[name]
            out = cell_percentiles(axis.values, self.pdf[name], levels, axis.bounds)
        else:
            out = kept_percentiles(name, levels, self.quantiles[:, self._quantity(name)])
        return out * self.unit(name)

    def joint_pdf(self, x, y):
        """
        Joint posteriors of two parameters, summed over all models.

        Parameters
        ----------
        x, y : str
            Redshift and AGN fraction, or two that were a pair of ``pairs`` in `BayesFitter.fit`,
            in any order. `Samples.pdf_2d` has those of any two, from draws.

        Returns
        -------
        weights : `~numpy.ndarray`, shape (n, nx, ny)
            Weights of the values ``axes[x].values`` and ``axes[y].values``; they sum to 1.

        Raises
        ------
        KeyError
            If the results do not have it.
        """
        known = dict(self.pairs)
        if "frac_agn" in self.axes:
            known["redshift", "frac_agn"] = self.pdf_2d
        if (x, y) in known:
            return known[x, y]
        if (y, x) in known:
            return known[y, x].swapaxes(1, 2)
        for name in (x, y):
            if name not in self.parameters:
                raise unknown_name("parameter", name, self.parameters)
        have = ", ".join(f"{a} and {b}" for a, b in known) or "none"
        msg = f"no joint posterior of {x} and {y}; known: {have} ('pairs' of BayesFitter.fit)"
        raise KeyError(msg)

    def to_table(self):
        """
        Results as a table.

        Returns
        -------
        table : `~astropy.table.QTable`
            One row for each object: ``id``, ``flags``, ``n_bands``, ``n_limits``,
            ``chi2_best``, ``reduced_chi2``, ``log_evidence``, and for each parameter and derived
            quantity ``<name>_mean``, ``_std``, ``_p16``, ``_p50``, ``_p84`` and ``_best``;
            derived quantities that scale with mass also have ``_logmean``, the mean of log10
            (dex, in their unit).
        """
        out = QTable(meta=dict(self.meta))
        columns = {
            "id": (np.array(self.ids), "identifier"),
            "flags": (np.array(self.flags), FitFlags.describe()),
            "n_bands": (np.array(self.n_bands), "bands used, upper limits among them"),
            "n_limits": (self.n_limits, "bands used that are upper limits"),
            "chi2_best": (np.array(self.chi2), "chi2 of the best model"),
            "reduced_chi2": (self.reduced_chi2, "chi2_best over the number of bands less one"),
            "log_evidence": (np.array(self.log_evidence), "ln of the evidence, fluxes in uJy"),
        }
        for name, (values, text) in columns.items():
            out[name] = values
            out[name].info.description = text
        for name in self.parameters:
            unit = self.unit(name)
            meaning = self._meaning(name)
            percentiles = self.percentile(name, _LEVELS)
            parts = {"mean": self.mean(name), "std": self.std(name)}
            parts |= {s: percentiles[:, i] for i, s in enumerate(_SUFFIXES)}
            parts["best"] = u.Quantity(self.best[name], unit)
            for suffix, value in parts.items():
                column = f"{name}_{suffix}"
                out[column] = value
                out[column].info.description = f"{_PARTS[suffix]} of {meaning}"
            if name in self.quantities and name not in self.intensive:
                column = f"{name}_logmean"
                out[column] = self.moments[:, self._quantity(name), 2] * u.dex
                out[
                    column
                ].info.description = f"posterior mean of log10 of {meaning}, in {unit.to_string()}"
        return out

    def _meaning(self, name):
        if name in self.quantities:
            return self.descriptions[self._quantity(name)]
        return name

    def predict(self, filters=None):
        """
        Fluxes of the models over the posterior, summed over all models.

        In bands that the grid does not have, `Samples.predict` has them from draws.

        Parameters
        ----------
        filters : list of str, optional
            Bands of the grid, fitted or not; all by default.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id`` and, for each filter, posterior mean (by its name), standard deviation
            (``<name>_err``) and flux of the best model (``<name>_best``) in uJy.
        """
        if isinstance(filters, str):
            raise argument_error("filters", "a list of names or a FilterSet", repr(filters))
        names = self.filters if filters is None else tuple(getattr(filters, "names", filters))
        out = QTable({"id": np.array(self.ids)}, meta=dict(self.meta))
        for name in names:
            i = self._band(name)
            out[name] = self.model_flux[:, i] * FNU
            out[name].info.description = "posterior mean of the model flux"
            out[error_column(name)] = self.model_flux_std[:, i] * FNU
            out[error_column(name)].info.description = "its posterior standard deviation"
            out[f"{name}_best"] = self.best_flux[:, i] * FNU
            out[f"{name}_best"].info.description = "flux of the best model"
        return out

    def _band(self, name):
        if name not in self.filters:
            raise unknown_name("filter of the grid", name, self.filters)
        return self.filters.index(name)

    def with_model(self, model):
        """Return a copy that knows the `~miricigale.sed.SEDModel`, for spectra of the best fits."""
        values = {item.name: getattr(self, item.name) for item in fields(self)}
        return type(self)(**{**values, "model": model})

    def plot_sed(self, key, ax=None, **kwargs):
        """Draw photometry and best model of an object; see `FitResult.plot_sed`."""
        return self[key].plot_sed(ax=ax, **kwargs)

    def plot_pdf(self, key, name, ax=None, **kwargs):
        """Draw the posterior of a parameter of an object; see `FitResult.plot_pdf`."""
        return self[key].plot_pdf(name, ax=ax, **kwargs)

    def plot_pdf2d(self, key, x="redshift", y="frac_agn", ax=None, **kwargs):
        """Draw the joint posterior of two parameters of an object; see `FitResult.plot_pdf2d`."""
        return self[key].plot_pdf2d(x, y, ax=ax, **kwargs)

    def write(self, path, *, overwrite=False):
        """
        Write everything but the model to a FITS file.

        Parameters
        ----------
        path : path-like
            The file.
        overwrite : bool, optional
            Whether a file that is there is replaced.
        """
        from miricigale.fitting.files import write_results

        write_results(self, path, overwrite=overwrite)

    @classmethod
    def read(cls, path):
        """
        Read results that `write` made.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is something else or incomplete.
        """
        from miricigale.fitting.files import read_results

        return read_results(cls, path)


_PARTS = {
    "mean": "posterior mean",
    "std": "posterior standard deviation",
    "p16": "16th percentile",
    "p50": "median",
    "p84": "84th percentile",
    "best": "best model's value",
}
