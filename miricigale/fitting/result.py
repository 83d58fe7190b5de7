"""What a fit returns for one object."""

import astropy.units as u
import numpy as np

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.posterior import cell_edges
from miricigale.fitting.quantities import DERIVED_LEVELS
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import FNU

__all__ = ["FitResult"]


class FitResult:
    """
    Posterior of one object: a view of a row of `~miricigale.fitting.FitResults`.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        The catalogue.
    row : int
        The row.
    """

    def __init__(self, results, row):
        self._all = results
        self._row = row

    def __repr__(self):
        key = np.asarray(self.id).item()
        return f"<FitResult of {key!r}, chi2 {self.chi2:.4g} in {self.n_bands} bands>"

    @property
    def id(self):
        """Identifier of the object."""
        return self._all.ids[self._row]

    @property
    def flags(self):
        """`FitFlags` of the object."""
        return FitFlags(int(self._all.flags[self._row]))

    @property
    def n_bands(self):
        """Number of bands used, upper limits among them."""
        return int(self._all.n_bands[self._row])

    @property
    def n_limits(self):
        """How many of them are upper limits."""
        return int(self._all.n_limits[self._row])

    @property
    def chi2(self):
        """Chi2 of the best model."""
        return float(self._all.chi2[self._row])

    @property
    def log_evidence(self):
        """Natural logarithm of the evidence, fluxes in uJy."""
        return float(self._all.log_evidence[self._row])

    @property
    def parameters(self):
        """Names of all that has a posterior."""
        return self._all.parameters

    @property
    def best(self):
        """Parameters and derived quantities of the best model: dict of name to Quantity."""
        return {n: self._all.best[n][self._row] * self._all.unit(n) for n in self.parameters}

    def mean(self, name):
        """Posterior mean."""
        return self._all.mean(name)[self._row]

    def std(self, name):
        """Posterior standard deviation."""
        return self._all.std(name)[self._row]

    def percentile(self, name, levels):
        """Posterior percentiles; see `~miricigale.fitting.FitResults.percentile`."""
        return self._all.percentile(name, levels)[self._row]

    def pdf(self, name):
        """
        Posterior of a parameter or derived quantity.

        Returns
        -------
        edges : `~astropy.units.Quantity`, shape (n + 1,)
            Edges of the cells: those around the nodes of the grid, or, for a derived quantity,
            its quantiles.
        weights : `~numpy.ndarray`, shape (n,)
            Weight of each cell.
        """
        results = self._all
        if name in results.axes:
            axis = results.axes[name]
            edges = cell_edges(axis.values, axis.bounds)
            return edges * results.unit(name), results.pdf[name][self._row]
        edges = results.quantiles[self._row, results._quantity(name)]
        return edges * results.unit(name), np.diff(DERIVED_LEVELS)

    def cdf(self, name):
        """
        Cumulative distribution of a parameter or derived quantity, linear between its points.

        Returns
        -------
        values : `~astropy.units.Quantity`, shape (n,)
            Edges of the cells of the grid, or, for a derived quantity, its quantiles.
        levels : `~numpy.ndarray`, shape (n,)
            Part of the posterior below each; from 0.001 to 0.999 for a derived quantity.
        """
        edges, weights = self.pdf(name)
        first = 0.0 if name in self._all.axes else DERIVED_LEVELS[0]
        return edges, first + np.concatenate([[0.0], np.cumsum(weights)])

    @property
    def pdf_2d(self):
        """Joint posterior of redshift and AGN fraction, shape (nz, nf)."""
        return self._all.pdf_2d[self._row]

    @property
    def pairs(self):
        """Joint posteriors of other pairs of parameters: (x, y) to array of shape (nx, ny)."""
        return {names: table[self._row] for names, table in self._all.pairs.items()}

    def joint_pdf(self, x, y):
        """Joint posterior of two parameters, shape (nx, ny); see `FitResults.joint_pdf`."""
        return self._all.joint_pdf(x, y)[self._row]

    def best_sed(self, model=None, **changes):
        """
        Spectrum of the best model.

        Parameters
        ----------
        model : `~miricigale.sed.SEDModel`, optional
            If the results do not know it (those read from a file do not).
        **changes
            Parameters to change.

        Returns
        -------
        sed : `~miricigale.sed.SED`

        Raises
        ------
        ValueError
            If no model is known or the object was not fitted.
        """
        model = self._all.model if model is None else model
        if model is None:
            raise argument_error("model", "an SEDModel (these results know none)", "None")
        if not np.isfinite(self.chi2):
            names = ", ".join(FitFlags.names(self.flags))
            raise argument_error("id", "an object that was fitted", f"{self.id!r} ({names})")
        known = dict(self._all.meta.get("fit", {}).get("constants", {}))
        best = self.best
        known |= {name: best[name] for name in self._all.axes if np.isfinite(best[name].value)}
        known = {name: value for name, value in known.items() if name in model.parameters}
        values = {
            name: u.Quantity(getattr(value, "value", value), model.parameters[name].unit)
            for name, value in known.items()
        }
        values["mass"] = best["mass"]
        return model.evaluate(**{**values, **changes})

    def plot_sed(self, ax=None, *, model=None, filters=None, **kwargs):
        """
        Draw photometry, upper limits (as arrows), best model and residuals.

        Parameters
        ----------
        ax : `~matplotlib.axes.Axes` or pair of them, optional
            Where to draw; a pair also gets the residuals.
        model : `~miricigale.sed.SEDModel`, optional
            See `best_sed`; without one only the fluxes of the best model are drawn.
        filters : `~miricigale.filters.FilterSet`, optional
            Where the wavelengths of the bands are taken from.
        **kwargs
            Passed to `miricigale.plotting.posteriors.plot_sed_fit`.

        Returns
        -------
        axes : `~matplotlib.axes.Axes` or pair of them
        """
        from miricigale.plotting.posteriors import plot_sed_fit

        results, row = self._all, self._row
        if filters is None:
            from miricigale.filters import FilterSet

            filters = FilterSet.from_names(results.filters)
        order = [filters.names.index(name) for name in results.filters]
        wave = u.Quantity(filters.pivots)[order]
        if model is not None or results.model is not None:
            sed = self.best_sed(model)
            kwargs.setdefault("spectrum", (sed.wave, sed.fnu))
        used = np.isfinite(results.sigma[row])
        text = f"{self.id}: z = {self.best['redshift'].value:.3f}"
        kwargs.setdefault("title", f"{text}, chi2 = {self.chi2:.1f} in {self.n_bands} bands")
        return plot_sed_fit(
            wave,
            results.flux[row] * FNU,
            np.where(used, results.sigma[row], results.flux_err[row]) * FNU,
            results.best_flux[row] * FNU,
            used=used,
            limit=results.limit[row],
            ax=ax,
            **kwargs,
        )

    def plot_pdf(self, name, ax=None, **kwargs):
        """Draw the posterior of a parameter or derived quantity; returns the axes."""
        from miricigale.plotting.posteriors import plot_pdf

        edges, weights = self.pdf(name)
        kwargs.setdefault("label", name)
        if name in self._all.quantities and name not in self._all.intensive:
            kwargs.setdefault("log", bool(edges.value[0] > 0))
        return plot_pdf(edges, weights, ax=ax, **kwargs)

    def plot_pdf2d(self, x="redshift", y="frac_agn", ax=None, **kwargs):
        """
        Draw the joint posterior of two parameters.

        Parameters
        ----------
        x, y : str, optional
            Parameters of which the results have it; see `FitResults.joint_pdf`.
        ax : `~matplotlib.axes.Axes`, optional
            Where to draw; the current axes by default.
        **kwargs
            Passed to `miricigale.plotting.posteriors.plot_pdf_2d`.

        Returns
        -------
        ax : `~matplotlib.axes.Axes`
        """
        from miricigale.plotting.posteriors import plot_pdf_2d

        axes = self._all.axes
        if "frac_agn" in (x, y) and "frac_agn" not in axes:
            raise argument_error("frac_agn", "an axis of the grid", "a grid without AGN")
        weights = self.joint_pdf(x, y)
        edges = [cell_edges(axes[name].values, axes[name].bounds) for name in (x, y)]
        kwargs.setdefault("labels", tuple(self._label(name) for name in (x, y)))
        return plot_pdf_2d(*edges, weights, ax=ax, **kwargs)

    def _label(self, name):
        unit = self._all.unit(name).to_string()
        return f"{name} ({unit})" if unit else name
