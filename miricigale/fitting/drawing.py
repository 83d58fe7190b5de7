"""Draws, spectra and figures of single objects: methods of `~miricigale.fitting.FitResults`."""

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior import cell_edges
from miricigale.sed.spectrum import distance
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_that
from miricigale.utils.tables import described_table
from miricigale.utils.units import FNU


def samples(results, key):
    """
    Draws of a sampler from the posterior of the object of this id, all of the same weight.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each draw, a column for each parameter and derived quantity.

    Raises
    ------
    ValueError
        If the object was not fitted, or the fit was no sampler's (see `BayesFitter.sample`).
    """
    if results.draws is None:
        msg = "results of a grid hold no draws; BayesFitter.sample makes some"
        raise ValueError(msg)
    one = results.loc[key]._fitted_one()
    values = zip(results.parameters, one.draws.T, strict=True)
    columns = {n: (u.Quantity(v, results.unit(n)), results._meaning(n)) for n, v in values}
    return described_table(columns, dict(results.meta) | {"id": str(key)})


def best_parameters(results, model):
    """Parameters of ``model`` in the best fit of one object, without those that have no effect there: dict."""
    best = results._fitted_one().best
    names = dict.fromkeys((*results.axes, "redshift", "mass"))
    known = {name: best[name].value for name in names if name in best}
    if "agn_power" in best and best["agn_power"].value == 0.0:
        # of a galaxy without dust that its fraction refers to
        known.pop("frac_agn", None)
    return {
        name: u.Quantity(value, model.parameters[name].unit)
        for name, value in (results.constants | known).items()
        if name in model.parameters and np.isfinite(value)
    }


def best_sed(results, model=None, **changes):
    """
    Spectrum of the best model of a single object.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`, optional
        If the results do not know it (those read from a file do not).
    **changes
        Parameters to change.

    Returns
    -------
    sed : `~miricigale.sed.SED`
        At the distance of the object, where the results have one (``distance``), unless ``changes`` has
        another redshift.

    Raises
    ------
    ValueError
        If no model is known or the object was not fitted.
    """
    model = results._one("best_sed").model if model is None else model
    check_that(model is not None, "model", "an SEDModel (these results know none)", "None")
    sed = model.evaluate(**best_parameters(results, model) | changes)
    if results.distance is None or not np.isfinite(results.distance) or "redshift" in changes:
        return sed
    nearer = distance(sed.redshift, model.cosmology) / (float(results.distance) * u.Mpc.to(u.m))
    return sed * float(nearer**2)


def plot_sed(results, ax=None, *, model=None, filters=None, **kwargs):
    """
    Draw photometry, upper limits (as arrows), best model and residuals of a single object.

    Bands that are wrong with a probability above a half have another symbol.

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
    from miricigale.filters import FilterSet
    from miricigale.plotting.axes import plain_text
    from miricigale.plotting.posteriors import plot_sed_fit

    results._one("plot_sed")
    filters = FilterSet.from_names(results.filters) if filters is None else filters
    order = [filters.names.index(name) for name in results.filters]
    if model is not None or results.model is not None:
        sed = results.best_sed(model)
        kwargs.setdefault("spectrum", (sed.wave, sed.fnu))
    used = np.isfinite(results.sigma)
    if results.outlier is not None and np.any(results.outlier > 0.5):
        kwargs.setdefault("groups", np.where(results.outlier > 0.5, "looks wrong", "fluxes"))
    text = f"{plain_text(results.ids)}: z = {results.best['redshift'].value:.3f}"
    kwargs.setdefault("title", f"{text}, chi2 = {results.chi2:.1f} in {results.n_bands} bands")
    return plot_sed_fit(
        u.Quantity(filters.pivots)[order],
        results.flux * FNU,
        # a band that was left out may have an error that is none
        np.where(used, results.sigma, np.maximum(results.flux_err, 0.0)) * FNU,
        results.best_flux * FNU,
        used=used,
        limit=results.limit,
        ax=ax,
        **kwargs,
    )


def plot_pdf(results, name, ax=None, **kwargs):
    """Draw the posterior of a parameter or derived quantity of a single object."""
    from miricigale.plotting.axes import plain_text
    from miricigale.plotting.posteriors import plot_pdf

    edges, weights = results._one("plot_pdf").distribution(name)
    kwargs.setdefault("label", plain_text(name))
    if results.extensive(name):
        kwargs.setdefault("log", bool(edges.value[0] > 0))
    return plot_pdf(edges, weights, ax=ax, **kwargs)


def plot_pdf2d(results, x="redshift", y="frac_agn", ax=None, **kwargs):
    """Draw `joint_pdf` of a single object; ``kwargs`` go to `plotting.posteriors.plot_pdf_2d`."""
    from miricigale.plotting.posteriors import plot_pdf_2d

    if "frac_agn" in (x, y) and "frac_agn" not in results.axes:
        raise argument_error("frac_agn", "an axis of the grid", "a grid without AGN")
    weights = results._one("plot_pdf2d").joint_pdf(x, y)
    kwargs.setdefault("labels", tuple(labeled(name, results.unit(name)) for name in (x, y)))
    axes = (results.axes[name] for name in (x, y))
    # those of the nodes, among which what is absent has a cell that can be seen
    edges = (cell_edges(axis.values, axis.bounds) for axis in axes)
    return plot_pdf_2d(*edges, weights, ax=ax, **kwargs)


def labeled(name, unit):
    """Label of an axis of a plot: a name and its unit."""
    from miricigale.plotting.axes import plain_text

    text = unit.to_string()
    return plain_text(f"{name} ({text})" if text else name)
