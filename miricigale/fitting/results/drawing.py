"""Draws, spectra and figures of single objects: methods of `~miricigale.fitting.FitResults`."""

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.results.table_columns import OUTLIER
from miricigale.sed.spectrum import distance
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_names, check_that
from miricigale.utils.tables import described_table
from miricigale.utils.units import FNU, to_array

#: Parameters of a corner plot by default, in their order.
CORNER = ("redshift", "stellar_mass", "sfr", "a_v", "frac_agn")


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


def fitted_curves(results):
    """The bands of results as a `~miricigale.filters.FilterSet`, with curves of one's own where they are known."""
    from miricigale.filters import FilterSet

    own = {one.name: one for one in results.curves}
    return FilterSet([own.get(name, name) for name in results.filters])


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
    from miricigale.plotting.axes import plain_text
    from miricigale.plotting.posteriors import plot_sed_fit

    results._one("plot_sed")
    filters = fitted_curves(results) if filters is None else filters
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


def plot_corner(results, key=None, names=None, *, truths=None, figure=None):
    """
    Draw the posteriors of several parameters of an object, each and in pairs.

    Parameters
    ----------
    key : object, optional
        Id of the object; not of results of a single one.
    names : list of str, optional
        Parameters whose joint posteriors there are (``pairs`` of the fit, or redshift and AGN fraction); all of
        them by default. `Samples.plot_corner` draws any, from draws.
    truths : dict of str to float, optional
        Values to mark, by name.
    figure : `~matplotlib.figure.Figure`, optional
        Where to draw; a new one by default.

    Returns
    -------
    axes : `~numpy.ndarray` of `~matplotlib.axes.Axes`, shape (n, n)

    Raises
    ------
    KeyError
        If a joint posterior is not there.
    """
    from miricigale.plotting.corner import plot_corner

    one = results if key is None else results.loc[key]
    one = one._one("plot_corner")._fitted_one()
    if names is None:
        names = _with_joint_posteriors(one)
    names = [one._named(name) for name in names]
    edges = []
    for name in names:
        check_names([name], "parameter with joint posteriors", one.axes)
        axis = one.axes[name]
        edges.append(cell_edges(axis.values, axis.bounds))
    marginals = [(cells, one.pdf[name]) for name, cells in zip(names, edges, strict=True)]
    joints = {}
    for row, later in enumerate(names):
        for column, earlier in enumerate(names[:row]):
            joints[row, column] = edges[column], edges[row], one.joint_pdf(earlier, later)
    labels = [labeled(name, one.unit(name)) for name in names]
    marked = {one._named(name): value for name, value in (truths or {}).items()}
    check_names(marked, "parameter for 'truths'", names)
    values = [marked.get(name) for name in names]
    return plot_corner(labels, marginals, joints, truths=values, figure=figure)


def _with_joint_posteriors(one):
    """Parameters all of whose pairs have a joint posterior, beginning with redshift and AGN fraction."""
    pairs = {frozenset(pair) for pair in one.pairs}
    if "frac_agn" in one.axes:
        pairs.add(frozenset(("redshift", "frac_agn")))
    names = []
    for name in dict.fromkeys(("redshift", "frac_agn", *one.axes)):
        if name in one.axes and all(frozenset((name, other)) in pairs for other in names):
            names.append(name)
    return names


def plot_redshift(results, z_spec, ax=None, **kwargs):
    """
    Draw the fitted redshifts, with their 68 % intervals, against known ones.

    Parameters
    ----------
    z_spec : array_like, shape (n,)
        Known redshifts in the order of the results; NaN and what is not positive is none.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    **kwargs
        Passed to `miricigale.plotting.comparison.plot_redshifts`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
        The title has bias, scatter (sigma_MAD) and the share of outliers, above 0.15, in
        (z - z_spec) / (1 + z_spec).

    Raises
    ------
    ValueError
        If there are not as many, or redshifts were known to the fit.
    """
    from miricigale.plotting.comparison import plot_redshifts

    some = results._several()
    check_that(not some.redshift_fixed, "redshift", "free in the fit", "fixed")
    known = to_array(z_spec, u.one, "z_spec")
    known = np.atleast_1d(known)
    wanted = f"{len(some)} redshifts, one for each object"
    check_that(known.shape == (len(some),), "z_spec", wanted, f"shape {known.shape}")
    with np.errstate(invalid="ignore"):
        good = some.fitted & (known > 0)
    check_that(np.any(good), "z_spec", "positive for one fitted object at least", "none")
    low, middle, high = some[good].percentile("redshift", [0.16, 0.5, 0.84]).value.T
    true = known[good]
    offset = (middle - true) / (1.0 + true)
    bias = np.median(offset)
    scatter = 1.4826 * np.median(np.abs(offset - bias))
    outliers = np.mean(np.abs(offset) > OUTLIER)
    text = f"{true.size} objects: bias {bias:+.4f}, $\\sigma_{{MAD}}$ {scatter:.4f}, "
    kwargs.setdefault("title", f"{text}{100 * outliers:.1f} % outliers")
    errors = np.stack([middle - low, high - middle])
    ax = plot_redshifts(true, middle, z_err=errors, ax=ax, **kwargs)
    ax.set_xlabel("known redshift")
    return ax


def labeled(name, unit):
    """Label of an axis of a plot: a name and its unit."""
    from miricigale.plotting.axes import plain_text

    text = unit.to_string()
    return plain_text(f"{name} ({text})" if text else name)
