"""From what the grid engine found to `FitResults`: flags, best models, derived quantities."""

from dataclasses import replace

import astropy.units as u
import numpy as np

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.results import FitResults
from miricigale.utils.meta import provenance

__all__ = ["VANISHING_CHI2", "constants", "fit_results"]

#: Best chi2 above which exp(-chi2 / 2) is below the smallest normal number for every model.
VANISHING_CHI2 = 1417.0
#: S/N of the best model in all bands together below which an object is flagged.
LOW_SIGNAL = 3.0


def fit_results(fitter, data, flags, merged, settings):
    """
    Put the results of a catalogue together.

    Parameters
    ----------
    fitter : `~miricigale.fitting.BayesFitter`
        Grid, priors, quantities and choices of the fit.
    data : `~miricigale.fitting.likelihood.FitData`
        Photometry of n objects.
    flags : `~numpy.ndarray` of int, shape (n,)
        What is known of them before the fit; flags of the fit are added in place.
    merged : `~miricigale.fitting.pieces.Part`
        What the engine found; objects that the fit refuses are taken out.
    settings : dict
        What the fit was told, for the meta.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
    """
    grid, priors = fitter.grid, fitter.priors
    if fitter.compat == "cigale":
        vanished = merged.chi2 > VANISHING_CHI2
        flags[vanished] |= int(FitFlags.NO_LIKELIHOOD)
        merged.forget(vanished)
    n_bands = data.used.sum(axis=1)
    best_flux = _best_flux(grid, merged)
    signal = np.where(data.measured, best_flux / data.sigma, 0.0)
    signal = np.sqrt(np.sum(signal * signal, axis=1))
    _flag(fitter, flags, merged, n_bands, settings["redshift"] == "fixed", signal)
    # limits are probabilities, which have no unit
    log_sigma = np.log(np.where(data.measured, data.sigma, 1.0)).sum(axis=1)
    log_sigma += 0.5 * data.measured.sum(axis=1) * np.log(2.0 * np.pi)
    names, units, texts = _derived(fitter)
    meta = provenance(
        citations=grid.meta.get("citations", ()),
        fit=settings,
        grid={k: v for k, v in grid.meta.items() if k not in ("citations", "axes")},
    )
    return FitResults(
        ids=data.ids,
        flags=flags,
        n_bands=n_bands,
        chi2=merged.chi2,
        log_evidence=merged.log_sum - log_sigma,
        filters=grid.filters,
        flux=data.flux,
        flux_err=data.flux_err,
        sigma=data.sigma,
        limit=data.limit,
        axes={name: replace(axis, share=None) for name, axis in priors.axes.items()},
        pdf=merged.pdf,
        pdf_2d=merged.pdf_2d,
        pairs=merged.pairs,
        best_index=merged.index,
        best_scale=merged.scale,
        best=_best(fitter, merged),
        quantities=names,
        units=units,
        descriptions=texts,
        moments=merged.moments,
        quantiles=merged.quantiles,
        model_flux=merged.band[:, 0],
        model_flux_std=merged.band[:, 1],
        best_flux=best_flux,
        meta=meta,
        model=fitter.model,
        intensive=(*fitter.quantities.shape.names, *names[len(fitter.quantities.names) :]),
    )


def constants(grid, axes):
    """Parameters of the grid that have one value, which have no posterior: name to float."""
    out = {}
    for table in (grid.galaxy_parameters, grid.agn_parameters):
        for name in table.colnames:
            if name not in axes and len(table):
                out[name] = float(_plain(table[name])[0])
    return out


def _flag(fitter, flags, merged, n_bands, fixed, signal):
    """Flag, in place, what the fits of a catalogue show."""
    fitted = np.isfinite(merged.chi2)
    reduced = np.where(n_bands > 1, merged.chi2 / np.maximum(n_bands - 1, 1), np.nan)
    with np.errstate(invalid="ignore"):
        flags[fitted & (reduced > fitter.max_reduced_chi2)] |= int(FitFlags.HIGH_CHI2)
        flags[fitted & ~(merged.scale > 0)] |= int(FitFlags.NO_SIGNAL)
        flags[fitted & (signal < LOW_SIGNAL)] |= int(FitFlags.LOW_SIGNAL)
        unfitted = ~fitted & ((flags & int(FitFlags.UNFITTED)) == 0)
        flags[unfitted] |= int(FitFlags.NO_SIGNAL)
        if not fixed and fitter.grid.redshift.size > 2:
            pdf = merged.pdf["redshift"]
            edge = np.maximum(pdf[:, 0], pdf[:, -1]) > 0.01
            flags[fitted & edge] |= int(FitFlags.REDSHIFT_EDGE)


def _derived(fitter):
    """Names, units and descriptions of derived quantities, the other AGN fraction the last."""
    known, fraction = fitter.quantities, fitter.fraction
    if fraction is None:
        return known.names, known.units, known.descriptions
    return (
        (*known.names, fraction.name),
        (*known.units, u.dimensionless_unscaled),
        (*known.descriptions, fraction.description),
    )


def _best_flux(grid, merged):
    """Fluxes of the best models in uJy, shape (n, nb)."""
    ok = np.isfinite(merged.chi2)
    out = np.full((ok.size, len(grid.filters)), np.nan)
    if np.any(ok):
        z, g, k, f = merged.index[ok].T
        out[ok] = merged.scale[ok, None] * grid.flux(z, g, np.maximum(k, 0), f)
    return out


def _best(fitter, merged):
    """Parameters and derived quantities of the best models: name to array."""
    grid = fitter.grid
    ok = np.isfinite(merged.chi2)
    z, g, k, f = np.where(ok[:, None], merged.index, 0).T
    out = {}
    frac = grid.frac_agn[f]
    for name, axis in fitter.priors.axes.items():
        if name == "redshift":
            values = grid.redshift[z]
        elif name == "frac_agn":
            values = frac
        elif axis.kind == "galaxy":
            values = _plain(grid.galaxy_parameters[name])[g]
        else:
            # without AGN there is no torus to speak of
            values = np.where(frac > 0, _plain(grid.agn_parameters[name])[k], np.nan)
        out[name] = np.where(ok, values, np.nan)
    scale = np.where(ok, merged.scale, np.nan)
    derived = fitter.quantities.best(grid, g, k, frac, scale)
    for i, name in enumerate(fitter.quantities.names):
        out[name] = np.broadcast_to(derived[i], (ok.size,))
    if fitter.fraction is not None:
        values = fitter.fraction.evaluate(g, k, frac)
        out[fitter.fraction.name] = np.where(ok, values, np.nan)
    return out


def _plain(column):
    return np.asarray(getattr(column, "value", column), dtype=float)
