"""Posteriors of one object: one and two parameters, and its photometry with the best model."""

import itertools

import astropy.units as u
import numpy as np

from miricigale.plotting.axes import (
    AxesArray,
    add_borders,
    legend,
    plain_log_ticks,
    resolve_axes,
    row_mask,
)
from miricigale.utils.arrays import finite_values, quotient

#: Upper limits: a bar, and an arrow down from it.
_ARROW = {"fmt": "_", "uplims": True, "color": "tab:blue", "markersize": 10, "zorder": 4}

#: Colors and markers of groups of bands, which differ in shade too.
_GROUPS = (("tab:blue", "o"), ("#9a3412", "D"), ("0.35", "^"))
#: Colors and styles of spectra.
_SPECTRA = (
    ("0.25", "-"),
    ("#1d4ed8", ":"),
    ("C1", "--"),
    ("C2", "-."),
    ("C3", "-"),
    ("C4", "--"),
    ("C5", "-."),
    ("C6", ":"),
    ("C8", "-"),
)
#: Highest emission line that is shown, over the upper limit by the fluxes.
_MOST_ABOVE = 100.0
#: Wavelengths in um that an axis of photometry is labeled with.
_WAVELENGTHS = (0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)
#: Part of the largest density above which an axis shows a posterior, and of all its weight for a single value.
_SHOWN = 0.01


def _value(quantity, unit=None):
    quantity = u.Quantity(quantity)
    if unit is None:
        return quantity.value
    return quantity.to_value(unit)


def plot_pdf(edges, weights, *, ax=None, label=None, truth=None, log=False, **kwargs):
    """
    Draw a one-dimensional posterior as density over its cells; a cell of no width is a line with its weight.

    The axis reaches from the first to the last cell whose density is 0.01 of the largest one or more, with the
    margin of the axes; axes with several posteriors hold all of them. All cells are drawn: ``ax.set_xlim(...)``,
    before or after, shows others.

    Parameters
    ----------
    edges : array_like or `~astropy.units.Quantity`, shape (n + 1,)
        Edges of the cells.
    weights : array_like, shape (n,)
        Weight of each cell.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    label : str, optional
        Name of the parameter.
    truth : float, optional
        A value to mark.
    log : bool, optional
        Whether the axis is logarithmic and the density one in dex.
    **kwargs
        Passed to `~matplotlib.axes.Axes.stairs`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    unit = getattr(edges, "unit", u.dimensionless_unscaled)
    edges = np.asarray(_value(edges), dtype=float)
    weights = np.asarray(weights, dtype=float)
    width = np.diff(np.log10(np.maximum(edges, 1e-300)) if log else edges)
    density = quotient(weights, width)
    drawn_before = ax.dataLim.intervalx.copy()
    ax.stairs(density, edges, **{"fill": True, "alpha": 0.5, **kwargs})
    _limit_data(ax, drawn_before, _occupied(edges, weights, density))
    # the probability of a single value, such as that a component is absent
    for i in np.flatnonzero((np.diff(edges) == 0) & (weights > 0)):
        limits = ax.dataLim.intervalx.copy()
        ax.axvline(edges[i], linewidth=3, alpha=0.5)
        if weights[i] < _SHOWN * weights.sum():
            _limit_data(ax, limits, [])
        text = f"P({edges[i]:g}) = {weights[i]:.2f}"
        ax.annotate(
            text,
            (edges[i], 0.95),
            (4, 0),
            va="top",
            xycoords=("data", "axes fraction"),
            textcoords="offset points",
            annotation_clip=True,
        )
    if log:
        ax.set_xscale("log")
        plain_log_ticks(ax.xaxis)
    if truth is not None:
        ax.axvline(truth, color="black", linestyle="--", linewidth=1)
    if label is not None:
        text = ""
        if unit != u.dimensionless_unscaled:
            text = f" ({unit.to_string()})"
        ax.set_xlabel(f"{label}{text}")
    ax.set_ylabel("probability density" + (" per dex" if log else ""))
    ax.set_ylim(0, None, auto=True)
    return ax


def _occupied(edges, weights, density):
    """Return the ends of the cells that hold the posterior; all of them if no cell has a width."""
    is_dense = density >= _SHOWN * density.max(initial=0.0)
    cells = np.flatnonzero(is_dense & (density > 0))
    if not cells.size:
        return edges[[0, -1]]
    return edges[[cells[0], cells[-1] + 1]]


def _limit_data(ax, *intervals):
    """Let the x axis of axes that scale themselves hold some intervals, and nothing else that was drawn."""
    ends = np.concatenate(intervals)
    ends = ends[np.isfinite(ends)]
    ax.dataLim.intervalx = (ends.min(), ends.max())


def plot_pdf_2d(
    x_edges, y_edges, weights, *, ax=None, labels=None, truth=None, levels=(0.68, 0.95), **kwargs
):
    """
    Draw a two-dimensional posterior with the cells of highest density outlined.

    The axes reach two cells beyond those that hold more than 1e-4 of the posterior.

    Parameters
    ----------
    x_edges, y_edges : array_like, shapes (nx + 1,) and (ny + 1,)
        Edges of the cells.
    weights : array_like, shape (nx, ny)
        Weight of each cell.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    labels : pair of str, optional
        Names of the parameters.
    truth : pair of float, optional
        A point to mark.
    levels : tuple of float, optional
        Parts of the posterior to outline.
    **kwargs
        Passed to `~matplotlib.axes.Axes.pcolormesh`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    x = np.asarray(x_edges, dtype=float)
    y = np.asarray(y_edges, dtype=float)
    weights = np.asarray(weights, dtype=float)
    area = np.diff(x)[:, None] * np.diff(y)
    density = quotient(weights, area)
    ax.pcolormesh(x, y, density.T, **{"cmap": "Blues", **kwargs})
    order = np.argsort(density, axis=None)[::-1]
    inside = np.empty(weights.size)
    total = np.cumsum(weights.ravel()[order])
    # the cell that passes a level belongs to it
    inside[order] = np.concatenate([[0.0], total[:-1]]) / max(total[-1], 1e-300)
    inside = inside.reshape(weights.shape)
    for i, level in enumerate(levels):
        add_borders(ax, (inside < level).T, x, y, colors="black", linewidth=max(1.5 - 0.7 * i, 0.5))
    for edges, sums, limits in ((x, weights.sum(axis=1), "xlim"), (y, weights.sum(axis=0), "ylim")):
        occupied = np.flatnonzero(sums > 1e-4 * sums.sum())
        if occupied.size:
            low = max(occupied[0] - 2, 0)
            high = min(occupied[-1] + 3, edges.size - 1)
            ax.set(**{limits: (edges[low], edges[high])})
    if truth is not None:
        ax.plot(*truth, marker="x", color="tab:red", markersize=9, markeredgewidth=2)
    if labels is not None:
        ax.set(xlabel=labels[0], ylabel=labels[1])
    return ax


def plot_sed_fit(
    wave,
    flux,
    flux_err,
    model_flux,
    *,
    used=None,
    limit=None,
    spectrum=None,
    parts=None,
    groups=None,
    measured_err=None,
    ax=None,
    title=None,
):
    """
    Draw photometry with the best model, and the residuals in units of the errors.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Wavelengths of the bands.
    flux, flux_err : `~astropy.units.Quantity`, shape (n,)
        Measured fluxes and errors; NaN where there is none. A flux that is not positive is drawn
        as a triangle at two errors.
    model_flux : `~astropy.units.Quantity`, shape (n,)
        Fluxes of the best model.
    used : array_like of bool, shape (n,), optional
        Bands that were fitted; others are drawn open.
    limit : array_like of bool, shape (n,), optional
        Bands whose flux is an upper limit: a bar with an arrow down.
    spectrum : pair of `~astropy.units.Quantity`, optional
        Wavelength and flux density of the best model.
    parts : dict of str to pair of `~astropy.units.Quantity`, optional
        Further spectra by label, such as the components of the best model.
    groups : array_like of str, shape (n,), optional
        Label of each measured band; labels differ in color and marker. With ``parts`` or
        ``groups`` there is a legend.
    measured_err : `~astropy.units.Quantity`, shape (n,), optional
        Errors as they were measured, drawn as heavy bars over those of ``flux_err``, which are larger by the
        errors of the model and the calibration.
    ax : `~matplotlib.axes.Axes` or pair of them, optional
        Where to draw. One gets no residuals; without, a new figure is made.
    title : str, optional
        Title.

    Returns
    -------
    axes : `AxesArray` of two `~matplotlib.axes.Axes`, or one if one was given
    """
    residual_ax = None
    if ax is None:
        import matplotlib.pyplot as plt

        _, (ax, residual_ax) = plt.subplots(
            2, 1, figsize=(7, 5), sharex=True, height_ratios=(3, 1), layout="constrained"
        )
    elif isinstance(ax, (tuple, list, np.ndarray)):
        ax, residual_ax = ax
    wave = _value(wave, u.um)
    flux = _value(flux, u.uJy)
    err = _value(flux_err, u.uJy)
    model = _value(model_flux, u.uJy)
    measured = None
    if measured_err is not None:
        measured = _value(measured_err, u.uJy)
    is_used = row_mask(used, wave.size, True)
    limit = row_mask(limit, wave.size, False)
    have = np.isfinite(flux) & np.isfinite(err)
    low, high = _flux_range(flux[have], model)
    if spectrum is not None:
        parts = {"best model": spectrum, **(parts or {})}
    if parts:
        _draw_spectra(ax, parts, wave)
    ax.plot(
        wave,
        model,
        "s",
        zorder=3,
        label="best model in the bands",
        color="tab:orange",
        markersize=7,
        fillstyle="none",
    )
    points = _points(groups, is_used, limit)
    for rows, label, style in points:
        rows = rows & have & (flux > 0)
        ax.errorbar(wave[rows], flux[rows], err[rows], zorder=4, label=label, **style)
        if measured is not None:
            heavy = {"fmt": "none", "ecolor": style["color"], "elinewidth": 3.0, "zorder": 4}
            ax.errorbar(wave[rows], flux[rows], measured[rows], **heavy)
    negative = have & ~(flux > 0) & ~limit
    bound = have & limit
    _draw_undetected(ax, wave, flux, err, low, negative, bound)
    ax.set(xscale="log", xlim=(0.7 * wave.min(), 1.4 * wave.max()))
    _label_wavelengths(ax)
    if spectrum is not None:
        high = _with_lines(high, spectrum, ax.get_xlim())
    ax.set(yscale="log", ylim=(low, high), ylabel="flux density (µJy)")
    plain_log_ticks(ax.yaxis)
    if parts or groups is not None:
        legend(ax)
    if title is not None:
        ax.set_title(title, fontsize="medium")
    if residual_ax is None:
        ax.set_xlabel("observed wavelength (µm)")
        return ax
    # a band that was left out may have an error that is none
    with_error = have & (err > 0)
    pull = np.where(with_error, (flux - model) / np.where(with_error, err, 1.0), np.nan)
    _draw_residuals(residual_ax, wave, pull, points, bound)
    return AxesArray([ax, residual_ax])


def _label_wavelengths(ax):
    """Label a logarithmic axis of wavelengths in um with plain numbers."""
    low, high = ax.get_xlim()
    shown = [wave for wave in _WAVELENGTHS if low <= wave <= high]
    ax.set_xticks(shown, [f"{wave:g}" for wave in shown])
    ax.tick_params(axis="x", which="minor", labelbottom=False)


def _flux_range(flux, model):
    """Return the limits of the axis of fluxes: a factor 4 beyond those that are positive."""
    flux = flux[flux > 0]
    model = model[np.isfinite(model) & (model > 0)]
    shown = np.concatenate([flux, model])
    if not shown.size:
        return 0.1, 10.0
    return shown.min() / 4, shown.max() * 4


def _with_lines(high, spectrum, limits):
    """Return the upper limit of fluxes with the emission lines of a spectrum, up to a hundred times above."""
    wave = _value(spectrum[0], u.um)
    flux = _value(spectrum[1], u.uJy)
    shown = flux[(wave >= limits[0]) & (wave <= limits[1]) & np.isfinite(flux)]
    return max(high, min(1.3 * shown.max(initial=0.0), _MOST_ABOVE * high))


def _draw_spectra(ax, spectra, wave):
    """Draw spectra by label, within a factor 2 of the wavelengths of the bands."""
    styles = itertools.cycle(_SPECTRA)
    for (label, (x, y)), (color, line) in zip(spectra.items(), styles, strict=False):
        x = _value(x, u.um)
        y = _value(y, u.uJy)
        in_range = (x > 0.5 * wave.min()) & (x < 2.0 * wave.max())
        ax.plot(x[in_range], y[in_range], color=color, ls=line, lw=1.0, zorder=1, label=label)


def _draw_undetected(ax, wave, flux, err, low, negative, bound):
    """Draw fluxes that are not positive as triangles at two errors, and upper limits as arrows."""
    if np.any(negative):
        top = np.maximum(np.maximum(flux, 0.0) + 2.0 * err, low)[negative]
        ax.plot(wave[negative], top, "v", color="tab:blue", zorder=4)
    if np.any(bound):
        top = np.maximum(flux[bound], 3.0 * low)
        ax.errorbar(wave[bound], top, yerr=0.5 * top, **_ARROW)


def _draw_residuals(ax, wave, pull, points, limit):
    """Draw residuals in units of the errors, NaN without one; those of upper limits as arrows."""
    ax.axhline(0.0, color="0.6", linewidth=0.8)
    for rows, _, style in points:
        ax.plot(wave[rows], pull[rows], **style)
    # of limits only those that the model passes have to be seen
    visible = np.isfinite(pull) & ~(limit & (pull > 0))
    size = np.nanmax(np.abs(pull[visible]), initial=2.5) * 1.15
    if np.any(limit):
        ax.errorbar(wave[limit], pull[limit], yerr=0.25 * size, **_ARROW)
    ax.set(ylim=(-size, size), ylabel="residual (sigma)", xlabel="observed wavelength (µm)")


def _points(groups, is_used, limit):
    """Return the rows, label and style of the measured bands of each group, fitted (full) and not (open)."""
    if groups is None:
        names = np.full(is_used.size, "measured")
    else:
        names = np.asarray(groups, str)
    points = []
    for name, (color, marker) in zip(dict.fromkeys(names.tolist()), itertools.cycle(_GROUPS)):
        for rows, fill in ((is_used, "full"), (~is_used, "none")):
            style = {"color": color, "marker": marker, "fillstyle": fill, "markersize": 5, "ls": ""}
            label = None
            if name and fill == "full":
                label = name
            points.append((rows & ~limit & (names == name), label, style))
    return points


def plot_sed_band(wave, bands, *, ax=None, rest=True, color="tab:blue", label=None, **kwargs):
    """
    Draw percentiles of a spectrum: pairs of levels as bands, a middle one as a line.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Wavelengths.
    bands : list of `~astropy.units.Quantity`, shape (n,)
        Percentiles in ascending order: L_nu, or F_nu as observed.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    rest : bool, optional
        Whether these are rest-frame luminosities, drawn as nu L_nu.
    color : str, optional
        Color.
    label : str, optional
        Label of the line or the outermost band.
    **kwargs
        Passed to `~matplotlib.axes.Axes.fill_between`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    x = _value(wave, u.um)
    if rest:
        nu = u.Quantity(wave).to(u.Hz, u.spectral())
        rows = [(nu * band).to_value(u.W) for band in bands]
    else:
        rows = [_value(band, u.uJy) for band in bands]
    _draw_levels(ax, x, rows, color, label, kwargs)
    top = max(float(np.max(row)) for row in rows)
    if rest:
        labels = {"xlabel": "rest wavelength (µm)", "ylabel": r"$\nu L_\nu$ (W)"}
    else:
        labels = {"xlabel": "observed wavelength (µm)", "ylabel": "flux density (µJy)"}
    ax.set(xscale="log", yscale="log", **labels)
    plain_log_ticks(ax.xaxis, ax.yaxis)
    if top > 0:
        ax.set_ylim(1e-5 * top, 3.0 * top)
    return ax


def _draw_levels(ax, x, rows, color, label, options):
    """Draw pairs of percentiles as bands and a middle one as a line; it or the widest band has the label."""
    style = {"color": color, "linewidth": 0, "alpha": 0.3, **options}
    n = len(rows)
    has_line = n % 2 == 1
    for i in range(n // 2):
        band_label = label if i == 0 and not has_line else None
        ax.fill_between(x, rows[i], rows[n - 1 - i], label=band_label, **style)
    if has_line:
        ax.plot(x, rows[n // 2], color=color, linewidth=1, label=label)


def plot_history(lookback, bands, *, ax=None, color="tab:blue", label=None, **kwargs):
    """
    Draw percentiles of a star-formation history: pairs of levels as bands, a middle one as a line.

    Parameters
    ----------
    lookback : `~astropy.units.Quantity`, shape (n,)
        Times before the light left the galaxy.
    bands : list of `~astropy.units.Quantity`, shape (n,)
        Percentiles of the rate in ascending order.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    color : str, optional
        Color.
    label : str, optional
        Label of the line.
    **kwargs
        Passed to `~matplotlib.axes.Axes.fill_between`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    x = _value(lookback, u.Gyr)
    rows = [_value(band, u.Msun / u.yr) for band in bands]
    _draw_levels(ax, x, rows, color, label, kwargs)
    ax.set(xlabel="lookback time (Gyr)", ylabel="star-formation rate (Msun / yr)")
    ax.set(xlim=(0, None), ylim=(0, None))
    return ax


def plot_recovery(true, mean, std, *, ax=None, name=None, unit="", log=False, **kwargs):
    """
    Draw recovered against true values with their errors and the line of equality.

    Parameters
    ----------
    true, mean, std : array_like, shape (n,)
        True values, posterior means and standard deviations; NaN is not drawn.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    name, unit : str, optional
        For the labels.
    log : bool, optional
        Whether the axes are logarithmic; values that are not positive are not drawn.
    **kwargs
        Passed to `~matplotlib.axes.Axes.errorbar`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    true = np.asarray(true, dtype=float)
    mean = np.asarray(mean, dtype=float)
    std = np.asarray(std, dtype=float)
    good = np.isfinite(true) & np.isfinite(mean)
    if log:
        good &= (true > 0) & (mean > 0)
    options = {"fmt": ".", "color": "tab:blue", "alpha": 0.6, "elinewidth": 0.6} | kwargs
    ax.errorbar(true[good], mean[good], yerr=std[good], **options)
    if np.any(good):
        ends = np.array([true[good].min(), true[good].max()])
        ax.plot(ends, ends, color="0.4", linewidth=1)
    if log:
        ax.set(xscale="log", yscale="log")
        plain_log_ticks(ax.xaxis, ax.yaxis)
    text = name or ""
    if unit:
        text += f" ({unit})"
    ax.set(xlabel=f"true {text}", ylabel=f"recovered {text}")
    return ax


def plot_pulls(pull, *, ax=None, label=None, limit=5.0, **kwargs):
    """
    Draw the distribution of pulls with the Gaussian that it should be.

    Parameters
    ----------
    pull : array_like, shape (n,)
        Differences in units of their errors; NaN is not drawn.
    ax : `~matplotlib.axes.Axes`, optional
        Where to draw; the current axes by default.
    label : str, optional
        Label of the histogram.
    limit : float, optional
        Half width of the axis; pulls beyond are counted in the last bins.
    **kwargs
        Passed to `~matplotlib.axes.Axes.hist`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    pull = np.asarray(pull, dtype=float)
    pull = np.clip(finite_values(pull), -limit, limit)
    x = np.linspace(-limit, limit, 201)
    ax.plot(x, np.exp(-0.5 * x * x) / np.sqrt(2.0 * np.pi), color="0.4", linewidth=1)
    if pull.size:
        edges = np.linspace(-limit, limit, 21)
        options = {"histtype": "step", "density": True} | kwargs
        ax.hist(pull, bins=edges, label=label, **options)
    ax.set(xlim=(-limit, limit), xlabel="(measured - predicted) / error")
    ax.set_ylabel("probability density")
    return ax
