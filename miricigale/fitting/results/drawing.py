"""Draws, spectra and figures of single objects: methods of `~miricigale.fitting.FitResults`."""

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.fitting.posterior.quantities import DERIVED_LEVELS
from miricigale.fitting.results.corner_panels import marked_values
from miricigale.fitting.results.table_columns import OUTLIER
from miricigale.sed.cosmology import distance
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import places
from miricigale.utils.options import check_names, check_that
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_table
from miricigale.utils.units import FNU, check_count, to_array

#: Parameters of a corner plot by default, in their order.
CORNER = ("redshift", "stellar_mass", "sfr", "a_v", "frac_agn")


def samples(results, key=None, *names, n_draws=None, seed=None):
    """
    Tabulate the draws of a sampler from the posterior of one object, all of the same weight.

    Parameters
    ----------
    key : object
        Id of the object; left out of a single one: ``results[0].samples()``.
    *names : str, optional
        Parameters to keep; all by default.
    n_draws : int, optional
        Number of draws, taken at random; all by default.
    seed : int, optional
        Seed of these.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each draw, a column for each parameter and derived quantity.

    Raises
    ------
    ValueError
        If the object was not fitted, or the fit was no sampler's (see `BayesFitter.sample`).
    KeyError
        If there is no such object or parameter.
    """
    if results.draws is None:
        msg = (
            "results of a grid hold no draws; fitter.sample(photometry, 1000, seed=1) makes some, "
        )
        msg += "whose values(name) are those of a parameter"
        raise ValueError(msg)
    if results.isscalar:
        result = results
        if key is not None and key != results.ids:
            names = (key, *names)
    else:
        check_that(key is not None, "key", "the id of an object", "None")
        result = results.loc[key]
    result = result._fitted_one()
    names = [results._named(name) for name in names]
    check_names(names, "parameter", results.parameters)
    values = zip(results.parameters, result.draws.T, strict=True)
    columns = {n: (u.Quantity(v, results.unit(n)), results._meaning(n)) for n, v in values}
    if names:
        columns = {name: columns[name] for name in names}
    if n_draws is not None:
        n_all = len(result.draws)
        n_draws = check_count(n_draws, "n_draws")
        check_that(
            n_draws <= n_all, "n_draws", f"at most {n_all}, the draws that there are", n_draws
        )
        rng = stream(check_seed(seed))
        rows = np.sort(rng.choice(n_all, n_draws, replace=False))
        columns = {name: (values[rows], text) for name, (values, text) in columns.items()}
    return described_table(columns, dict(results.meta) | {"id": str(result.ids)})


def best_parameters(results, model):
    """Return the parameters of ``model`` in the best fit of one object, without those of no effect: dict."""
    best = results._fitted_one().best
    names = dict.fromkeys((*results.axes, "redshift", "mass"))
    best_values = {name: best[name].value for name in names if name in best}
    if "agn_power" in best and best["agn_power"].value == 0.0:
        # the fraction refers to the dust luminosity, which this galaxy does not have
        best_values.pop("frac_agn", None)
    return {
        name: u.Quantity(value, model.parameters[name].unit)
        for name, value in (results.constants | best_values).items()
        if name in model.parameters and np.isfinite(value)
    }


def best_sed(results, model=None, **changes):
    """
    Compute the spectrum of the best model of a single object.

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
    if model is None:
        model = results.model
    check_that(model is not None, "model", "an SEDModel (these results know none)", "None")
    wanted = (
        "an SEDModel (results[0].best_sed() is that of a row, results.best_sed(id) that of an id)"
    )
    check_that(hasattr(model, "evaluate"), "model", wanted, repr(model))
    sed = model.evaluate(**best_parameters(results, model) | changes)
    if results.distance is None or not np.isfinite(results.distance) or "redshift" in changes:
        return sed
    nearer = distance(sed.redshift, model.cosmology) / (float(results.distance) * u.Mpc.to(u.m))
    return sed * float(nearer**2)


def fitted_curves(results):
    """Return the bands of results as a `~miricigale.filters.FilterSet`, with the user's curves if known."""
    from miricigale.filters import FilterSet

    user_curves = {curve.name: curve for curve in results.curves}
    return FilterSet([user_curves.get(name, name) for name in results.filters])


def plot_sed(results, ax=None, *, model=None, filters=None, components=False, **kwargs):
    """
    Draw photometry, upper limits (as arrows), best model and residuals of a single object.

    Heavy bars are the measured errors, light ones those of the fit, with the errors of the model and the
    calibration. Bands that are wrong with a probability above a half have another symbol.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes` or pair of them, optional
        Where to draw; a pair also gets the residuals.
    model : `~miricigale.sed.SEDModel`, optional
        See `best_sed`; without one only the fluxes of the best model are drawn.
    filters : `~miricigale.filters.FilterSet`, optional
        Where the wavelengths of the bands are taken from.
    components : bool, optional
        Whether the parts of the best model (stars, dust, torus, ...) are drawn too.
    **kwargs
        Passed to `miricigale.plotting.posteriors.plot_sed_fit`.

    Returns
    -------
    axes : `~matplotlib.axes.Axes` or pair of them
    """
    from miricigale.plotting.axes import plain_text
    from miricigale.plotting.posteriors import plot_sed_fit

    if filters is None:
        filters = fitted_curves(results)
    order = places(results.filters, filters.names)
    has_model = model is not None or results.model is not None
    check_that(has_model or not components, "model", "an SEDModel where 'components'", "None")
    if has_model:
        sed = results.best_sed(model)
        kwargs.setdefault("spectrum", (sed.wave, sed.fnu))
        if components:
            parts = {}
            for name, part in sed.components.items():
                if np.any(part.fnu > 0):
                    parts[name.replace("_", " ")] = (part.wave, part.fnu)
            kwargs.setdefault("parts", parts)
    in_fit = np.isfinite(results.sigma)
    if results.outlier is not None and np.any(results.outlier > 0.5):
        kwargs.setdefault("groups", np.where(results.outlier > 0.5, "looks wrong", "measured"))
    text = f"{plain_text(results.ids)}: z = {results.best['redshift'].value:.3f}"
    kwargs.setdefault("measured_err", np.maximum(results.flux_err, 0.0) * FNU)
    kwargs.setdefault("title", f"{text}, chi2 = {results.chi2:.1f} in {results.n_bands} bands")
    return plot_sed_fit(
        u.Quantity(filters.pivots)[order],
        results.flux * FNU,
        # a band that was left out may have an error that is none
        np.where(in_fit, results.sigma, np.maximum(results.flux_err, 0.0)) * FNU,
        results.best_flux * FNU,
        used=in_fit,
        limit=results.limit,
        ax=ax,
        **kwargs,
    )


def plot_pdf(results, name, ax=None, **kwargs):
    """Draw the posterior of a parameter or derived quantity of a single object."""
    from miricigale.plotting.axes import plain_text
    from miricigale.plotting.posteriors import plot_pdf

    edges, weights = results.distribution(name)
    name = results._named(name)
    quantiles = results._stored(name, "quantiles")
    n_cells = np.count_nonzero(weights > 1e-3)
    if quantiles is not None and n_cells < len(quantiles) and np.all(np.diff(quantiles) > 0):
        # of posteriors between nodes: narrower than the few cells around these
        edges = quantiles * results.unit(name)
        weights = np.diff(DERIVED_LEVELS)
    kwargs.setdefault("label", plain_text(name))
    if results.extensive(name):
        kwargs.setdefault("log", bool(edges.value[0] > 0))
    return plot_pdf(edges, weights, ax=ax, **kwargs)


def plot_pdf2d(results, x="redshift", y="frac_agn", ax=None, **kwargs):
    """Draw `joint_pdf` of a single object; ``kwargs`` go to `plotting.posteriors.plot_pdf_2d`."""
    from miricigale.plotting.posteriors import plot_pdf_2d

    if "frac_agn" in (x, y) and "frac_agn" not in results.axes:
        raise argument_error("frac_agn", "an axis of the grid", "a grid without AGN")
    weights = results.joint_pdf(x, y)
    kwargs.setdefault("labels", (labeled(x, results.unit(x)), labeled(y, results.unit(y))))
    # edges around the nodes: there an absent component has a cell that can be seen
    x_edges = cell_edges(results.axes[x].values, results.axes[x].bounds)
    y_edges = cell_edges(results.axes[y].values, results.axes[y].bounds)
    return plot_pdf_2d(x_edges, y_edges, weights, ax=ax, **kwargs)


#: Where joint posteriors are that a fit does not keep.
DRAWN_PAIRS = "fitter.sample(photometry, seed=1) draws of all, and has plot_corner(id, names)"


def plot_masses(results, ax=None):
    """Draw stellar masses of several objects over redshift, medians with their central 68 %."""
    from miricigale.plotting.axes import MEASURED, resolve_axes

    ax = resolve_axes(ax)
    low, redshift, high = results.percentile("redshift").value.T
    redshift_err = redshift - low, high - redshift
    low, mass, high = np.log10(results.percentile("mass").value.T)
    mass_err = mass - low, high - mass
    ax.errorbar(
        redshift,
        mass,
        mass_err,
        redshift_err,
        fmt=".",
        color=MEASURED,
        ecolor="0.8",
        elinewidth=0.8,
    )
    ax.set(xlabel="redshift", ylabel=r"log$_{10}$ stellar mass / M$_\odot$")
    return ax


def plot_corner(results, names=None, *, truths=None, figure=None):
    """
    Draw the posteriors of several parameters of an object, each and in pairs.

    Parameters
    ----------
    names : list of str, optional
        Parameters whose joint posteriors there are (``pairs`` of the fit, or redshift and AGN fraction); all of
        them by default. `Samples.plot_corner` draws any, from draws.
    truths : dict of str to float, optional
        Values to mark, by name.
    figure : `~matplotlib.figure.Figure`, optional
        Where to draw; a new one by default.

    Returns
    -------
    axes : `~miricigale.plotting.axes.AxesArray` of `~matplotlib.axes.Axes`, shape (n, n)

    Raises
    ------
    KeyError
        If a joint posterior is not there.
    """
    from miricigale.plotting.corner import plot_corner

    result = results._fitted_one()
    if names is None:
        names = _with_joint_posteriors(result)
    names = [result._named(name) for name in names]
    edges = []
    for name in names:
        if name not in result.axes:
            check_names([name], "parameter", result.parameters)
            msg = f"a grid keeps no joint posterior with {name}; {DRAWN_PAIRS}"
            raise KeyError(msg)
        axis = result.axes[name]
        edges.append(cell_edges(axis.values, axis.bounds))
    marginals = [(cells, result.pdf[name]) for name, cells in zip(names, edges, strict=True)]
    joints = {}
    for row, later in enumerate(names):
        for column, earlier in enumerate(names[:row]):
            joints[row, column] = edges[column], edges[row], result.joint_pdf(earlier, later)
    labels = [labeled(name, result.unit(name)) for name in names]
    values = marked_values(result, names, truths)
    return plot_corner(labels, marginals, joints, truths=values, figure=figure)


def _with_joint_posteriors(result):
    """List parameters all of whose pairs have a joint posterior, beginning with redshift and AGN fraction."""
    pairs = set(map(frozenset, result.pairs))
    if "frac_agn" in result.axes:
        pairs.add(frozenset(("redshift", "frac_agn")))
    names = []
    for name in dict.fromkeys(("redshift", "frac_agn", *result.axes)):
        if name in result.axes and all(frozenset((name, partner)) in pairs for partner in names):
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

    results_list = results._several()
    check_that(not results_list.redshift_fixed, "redshift", "free in the fit", "fixed")
    z_known = to_array(z_spec, u.one, "z_spec")
    z_known = np.atleast_1d(z_known)
    wanted = f"{len(results_list)} redshifts, one for each object"
    check_that(z_known.shape == (len(results_list),), "z_spec", wanted, f"shape {z_known.shape}")
    good = results_list.fitted & (z_known > 0)
    check_that(np.any(good), "z_spec", "positive for one fitted object at least", "none")
    low, middle, high = results_list[good].percentile("redshift", [0.16, 0.5, 0.84]).value.T
    true = z_known[good]
    offset = (middle - true) / (1.0 + true)
    bias = np.median(offset)
    scatter = 1.4826 * np.median(np.abs(offset - bias))
    outliers = np.mean(np.abs(offset) > OUTLIER)
    n = true.size
    text = f"{n} object{'s' * (n != 1)}: bias {bias:+.4f}, $\\sigma_{{MAD}}$ {scatter:.4f}, "
    kwargs.setdefault("title", f"{text}{100 * outliers:.1f} % outliers")
    errors = np.stack([middle - low, high - middle])
    ax = plot_redshifts(true, middle, z_err=errors, ax=ax, **kwargs)
    ax.set_xlabel("known redshift")
    return ax


def labeled(name, unit):
    """Format the label of an axis of a plot: a name and its unit."""
    from miricigale.plotting.axes import plain_text

    text = name
    if unit.to_string():
        text = f"{name} ({unit.to_string()})"
    return plain_text(text)
