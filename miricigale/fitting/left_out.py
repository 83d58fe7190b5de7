"""How far a fit can be trusted: bands left out, and predicted by the others."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.likelihood import flux_column, limits
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU, frozen_array

__all__ = ["LeaveOutResult", "leave_out"]


def leave_out(fitter, photometry, bands, *, separately=False, **options):
    """
    Fit without some bands, and compare what is measured there with what the rest predicts.

    Upper limits in other bands take part in the fit; where a band left out is an upper limit there
    is a prediction, but nothing to compare it with.

    Parameters
    ----------
    fitter : `BayesFitter`
        How to fit. Its grid has the bands.
    photometry : `~astropy.table.QTable`
        The catalogue.
    bands : list of str
        Bands to leave out.
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
    """
    if not hasattr(fitter, "grid"):
        raise argument_error("fitter", "a BayesFitter", type(fitter).__name__)
    if isinstance(bands, str) or not len(bands):
        raise argument_error("bands", "a list of one or more names", repr(bands))
    bands = tuple(bands)
    if len(set(bands)) < len(bands):
        raise argument_error("bands", "different names", f"{list(bands)}")
    for name in bands:
        if name not in fitter.grid.filters:
            raise unknown_name("filter of the grid", name, fitter.grid.filters)
    columns = [c for name in bands for c in (name, error_column(name))]
    require_columns(photometry, ["id", *columns], "photometry", units=dict.fromkeys(columns, FNU))
    groups = [(name,) for name in bands] if separately else [bands]
    fitted = [f for f in fitter.filters or fitter.grid.filters if f in photometry.colnames]
    for group in groups:
        left = [name for name in fitted if name not in group]
        if len(left) < fitter.n_bands_min:
            wanted = f"such that n_bands_min = {fitter.n_bands_min} or more of {fitted} are left"
            raise argument_error("bands", wanted, f"{list(group)}")
    flux = np.array([flux_column(photometry, name) for name in bands]).T
    err = np.array([flux_column(photometry, error_column(name)) for name in bands]).T
    limit = np.array([limits(photometry, name) for name in bands]).T
    good = np.isfinite(flux) & np.isfinite(err) & (err > 0)
    empty = [name for name, any_good in zip(bands, good.any(axis=0), strict=True) if not any_good]
    if empty and len(photometry):
        raise argument_error("bands", "measured for one object at least", f"{empty}")
    good &= ~limit
    results, predicted, scatter = {}, [], []
    for group in groups:
        blank = QTable(photometry, copy=True)
        for name in group:
            blank[name] = np.full(len(blank), np.nan) * FNU
            if f"{name}_limit" in blank.colnames:
                blank[f"{name}_limit"] = np.zeros(len(blank), dtype=bool)
        found = fitter.fit(blank, **options)
        for name in group:
            i = found.filters.index(name)
            results[name] = found
            predicted.append(found.model_flux[:, i])
            scatter.append(found.model_flux_std[:, i])
    return LeaveOutResult(
        bands=bands,
        flux=np.where(good, flux, np.nan),
        flux_err=np.where(good, err, np.nan),
        predicted=np.array(predicted).T,
        predicted_std=np.array(scatter).T,
        results=results,
    )


@dataclass(frozen=True, eq=False, repr=False)
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
        Measured and predicted fluxes.

        Returns
        -------
        table : `~astropy.table.QTable`
            ``id`` and, for each band, ``<name>``, ``<name>_err``, ``<name>_predicted``,
            ``<name>_predicted_err``, ``<name>_pull`` and ``<name>_flags``, those of the fit
            without it.
        """
        some = self.results[self.bands[0]]
        out = QTable({"id": np.array(some.ids)}, meta=dict(some.meta) | {"left_out": [*self.bands]})
        out["id"].info.description = "identifier"
        pull = self.pull
        for i, name in enumerate(self.bands):
            columns = {
                name: (self.flux[:, i] * FNU, "measured flux, not fitted"),
                error_column(name): (self.flux_err[:, i] * FNU, "its error"),
                f"{name}_predicted": (self.predicted[:, i] * FNU, "flux predicted by the others"),
                f"{name}_predicted_err": (self.predicted_std[:, i] * FNU, "its error"),
                f"{name}_pull": (
                    pull[:, i] * u.dimensionless_unscaled,
                    "measured less predicted, over both errors in quadrature",
                ),
                f"{name}_flags": (np.array(self.results[name].flags), FitFlags.describe()),
            }
            for column, (values, text) in columns.items():
                out[column] = values
                out[column].info.description = text
        return out

    def metrics(self):
        """
        How well each band is predicted.

        Returns
        -------
        table : `~astropy.table.QTable`
            A row for each band: ``n`` objects; ``offset``, the median of measured over
            predicted less 1; ``pull`` and ``pull_scatter``, median and 1.48 times the median
            absolute deviation of the pulls; ``within``, the part of pulls within 1 (0.68 if
            errors and models are right).
        """
        rows = []
        for i in range(len(self.bands)):
            pull = self.pull[:, i]
            good = np.isfinite(pull)
            pull = pull[good]
            if not good.any():
                rows.append((0, np.nan, np.nan, np.nan, np.nan))
                continue
            flux, model = self.flux[good, i], self.predicted[good, i]
            ratio = np.divide(flux, model, out=np.full(flux.size, np.nan), where=model > 0)
            ratio = ratio[np.isfinite(ratio)]
            middle = float(np.median(pull))
            rows.append(
                (
                    int(pull.size),
                    float(np.median(ratio)) - 1.0 if ratio.size else np.nan,
                    middle,
                    1.4826 * float(np.median(np.abs(pull - middle))),
                    float(np.mean(np.abs(pull) <= 1.0)),
                )
            )
        texts = {
            "n": "objects measured and predicted",
            "offset": "median of measured over predicted, less 1",
            "pull": "median of the pulls",
            "pull_scatter": "1.48 times their median absolute deviation",
            "within": "part of the pulls within 1",
        }
        out = QTable({"band": np.array(self.bands, dtype=str)})
        out["band"].info.description = "band that was left out"
        for i, (name, text) in enumerate(texts.items()):
            out[name] = np.array([row[i] for row in rows])
            out[name].info.description = text
        return out

    def plot(self, band=None, ax=None, **kwargs):
        """Draw the distribution of the pulls of one band, or of all; returns the axes."""
        from miricigale.plotting.posteriors import plot_pulls

        if band is not None and band not in self.bands:
            raise unknown_name("band that was left out", band, self.bands)
        pull = self.pull if band is None else self.pull[:, self.bands.index(band)]
        kwargs.setdefault("label", band)
        return plot_pulls(pull.ravel(), ax=ax, **kwargs)
