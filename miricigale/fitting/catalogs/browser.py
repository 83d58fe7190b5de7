"""The fits of a catalog one by one: fluxes with the best model, posteriors, parameters and flags."""

from pathlib import Path

import numpy as np

from miricigale.filters.band_names import band_label
from miricigale.fitting.data.likelihood import FitFlags
from miricigale.pages.browser import (
    band_entries,
    cell_weights,
    list_column,
    moments_of,
    pages_beside,
    parameter_entries,
    rounded,
    shown_unit,
    spectrum_edges,
    thousandths_of_log,
)
from miricigale.plotting.axes import MEASURED
from miricigale.sed.cells import cell_means
from miricigale.utils.arrays import quiet_division, thinning_step
from miricigale.utils.named_values import places
from miricigale.utils.units import FNU, WAVE

#: Largest number of objects of the page, and of those whose best model is drawn.
MAX_OBJECTS = 5000
MAX_MODELS = 1000
#: Parameters whose posteriors are drawn.
_DRAWN = ("redshift", "frac_agn")
#: Reduced chi2 of a poor fit.
_POOR_CHI2 = 10.0


def write_browser(path, title, results, numbers, curves, *, step=1):
    """
    Write the page of single objects of a fitted catalog.

    Parameters
    ----------
    path : path-like
        Page of the catalog; this one is ``sources.html`` beside it, with a folder ``sources``.
    title : str
        Of the page.
    results : `~miricigale.fitting.FitResultsFiles`
        The fits.
    numbers : `~astropy.table.Table`
        Of `~miricigale.fitting.catalogs.page_numbers.fit_numbers`: of every ``step``-th object.
    curves : `~miricigale.filters.FilterSet`
        Bands of the results.
    step : int, optional
        Objects of the catalog for each of ``numbers``.

    Returns
    -------
    name : str
        Of the file.
    """
    chosen = np.arange(0, len(numbers), browser_step(len(numbers)))
    objects = _Objects(results[step * chosen], numbers[chosen], curves)
    order = np.arange(len(chosen))
    no_pictures = np.zeros(len(chosen), bool)
    facts = objects.describe()
    return pages_beside(Path(path), "sources", title, facts, order, no_pictures, objects.entry)


def browser_step(n):
    """Return the step between objects of the page, of ``n``."""
    return thinning_step(n, MAX_OBJECTS)


class _Objects:
    """What the page has of fitted objects."""

    def __init__(self, fits, numbers, curves):
        self.fits = fits
        self.numbers = numbers
        pivots = {curve.name: float(curve.pivot.value) for curve in curves}
        self.names = sorted(fits.fitted_filters, key=pivots.get)
        self.bands = places(self.names, fits.filters)
        self.waves = [pivots[name] for name in self.names]
        self.edges = spectrum_edges(self.waves)
        self.units = {name: shown_unit(fits.unit(name)) for name in fits.parameters}
        self.drawn = [name for name in _DRAWN if name in fits.pdf]

    def _list(self):
        """Return the table of all objects, its columns, and what the line in posteriors of redshifts is."""
        numbers = self.numbers
        table = {
            "id": np.asarray(self.fits.ids),
            "chi2": numbers["chi2"],
            "n_bands": numbers["n_bands"],
            "fit": numbers["flags"],
        }
        table["fitted"] = numbers["good"]
        table["poor"] = numbers["chi2"] > _POOR_CHI2
        columns = [list_column("id", "id", "id of the catalog")]
        groups = (
            ("z", "redshift", "redshift", 3),
            ("frac", "fracAGN", "AGN fraction", 2),
            ("mass", "log M", "log of the stellar mass in solar masses", 2),
        )
        for key, label, meaning, digits in groups:
            percentiles = np.asarray(numbers[key], float)
            if not np.isfinite(percentiles).any():
                continue
            if key == "mass":
                with quiet_division():
                    percentiles = np.log10(percentiles)
            for k, level in enumerate(("16 %", "50 %", "84 %")):
                table[f"{key}_{k}"] = percentiles[:, k]
                title = f"{meaning}, percentile of the posterior"
                columns.append(list_column(f"{key}_{k}", level, title, group=label, digits=digits))
        line = None
        if np.isfinite(numbers["z_known"]).any():
            # the posterior of the redshift has a line there
            table["redshift"] = np.asarray(numbers["z_known"])
            line = "known redshift"
            title = f"column {numbers.meta['known']} of the catalog"
            columns.append(list_column("redshift", "known z", title, digits=3))
        title = "reduced chi2 of the best model"
        columns.append(list_column("chi2", "χ²", title, digits=2))
        columns.append(list_column("n_bands", "bands", "bands that were fitted"))
        columns.append(list_column("flags", "flags", "flags of the fit", text=True))
        return {key: rounded(values) for key, values in table.items()}, columns, line

    def describe(self):
        """Return what all objects have in common, and the list of them."""
        fits = self.fits
        table, columns, line = self._list()
        edges = {name: rounded(fits.distribution(name)[0].value) for name in self.drawn}
        miri = [name for name in self.names if name.startswith("miri.")]
        labels = map(band_label, self.names)
        spectrum = (
            "Arrows: upper limits, and three times the error where the flux is below its error."
        )
        if fits.model is not None and len(fits) > MAX_MODELS:
            spectrum += f" The best model is drawn of the first {MAX_MODELS} objects."
        return {
            "table": table,
            "columns": columns,
            "shows": {
                "all": ["all objects", None],
                "fitted": ["fitted", "fitted"],
                "poor": [f"reduced χ² above {_POOR_CHI2:g}", "poor"],
            },
            "heading": [["chi2", "reduced χ²", 2], ["n_bands", "bands", 0]],
            "flags": {"fit": FitFlags.meanings()},
            "flag_columns": [["fit", "fit", ""]],
            "bands": band_entries(self.names, labels, self.waves, miri=miri),
            "sets": [{"name": "fit", "label": "fit", "color": MEASURED}],
            "wave": rounded(np.sqrt(self.edges[1:] * self.edges[:-1])),
            "pdf_edges": {"fit": edges},
            "parameters": parameter_entries(self.units),
            "line": line,
            "notes": {"spectrum": spectrum},
        }

    def entry(self, row):
        """Return the details of an object."""
        result = self.fits[row]
        flux = np.asarray(result.flux)[self.bands]
        error = np.asarray(result.flux_err)[self.bands]
        limit = np.asarray(result.limit)[self.bands]
        entry = {"flux": rounded(np.where(limit, np.nan, flux)), "error": rounded(error, 3)}
        if limit.any():
            entry["upper"] = rounded(np.where(limit, flux, 3.0 * error))
        if result.fitted:
            entry["fits"] = {"fit": self._fit(result, row)}
        return entry

    def _fit(self, result, row):
        """Return moments, posteriors and the spectrum of the best model of an object."""
        pdf = {name: cell_weights(result.pdf[name]) for name in self.drawn}
        fit = {"moments": moments_of(result, self.units), "pdf": pdf}
        if result.model is not None and row < MAX_MODELS:
            best = result.best_sed()
            wave = best.wave.to_value(WAVE)
            means = cell_means(wave, best.fnu.to_value(FNU), np.clip(self.edges, wave[0], wave[-1]))
            fit["spectrum"] = thousandths_of_log(means)
        return fit
