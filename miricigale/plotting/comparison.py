"""Truth against measurement."""

import numpy as np

from miricigale.plotting.axes import resolve_axes

__all__ = [
    "plot_counts",
    "plot_error_function",
    "plot_histogram",
    "plot_magnitudes",
    "plot_offsets",
    "plot_redshifts",
    "plot_relation",
]

TRUE, MEASURED, SECOND = "0.35", "#9a3412", "#1d4ed8"


def plot_magnitudes(true, measured, *, ax=None, lost=None, title=None):
    """
    Measured against true magnitude, with the line of equality.

    Parameters
    ----------
    true, measured : array-like, shape (n,)
        AB magnitudes; NaN is not drawn.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    lost : array-like, optional
        True magnitudes of sources without a measurement, drawn as ticks at the bottom.
    title : str, optional
        Title.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    true, measured = np.asarray(true), np.asarray(measured)
    good = np.isfinite(true) & np.isfinite(measured)
    ax.plot(true[good], measured[good], ".", ms=3.5, color=MEASURED, alpha=0.7)
    if np.any(good):
        low, high = np.percentile(np.concatenate([true[good], measured[good]]), [0, 99.5])
        ax.plot([low - 0.3, high + 0.3], [low - 0.3, high + 0.3], color=TRUE, lw=1)
        ax.set(xlim=(low - 0.3, high + 0.3), ylim=(high + 0.3, low - 0.3))
    if lost is not None and len(lost):
        ax.plot(
            lost,
            np.full(len(lost), 0.02),
            "|",
            color=TRUE,
            ms=6,
            transform=ax.get_xaxis_transform(),
        )
    ax.set(xlabel="true magnitude (AB)", ylabel="measured magnitude (AB)", title=title)
    return ax


def plot_offsets(true, offset, *, running=None, ax=None, title=None, limit=1.0, labels=None):
    """
    Difference against true magnitude with its running median.

    Parameters
    ----------
    true, offset : array-like, shape (n,)
        Magnitudes and measured minus true.
    running : tuple of array-like, optional
        Middle, median and scatter of bins (`~miricigale.evaluation.running_median`).
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    title : str, optional
        Title.
    limit : float, optional
        Half height of the axis; points beyond stand as triangles on the edge.
    labels : tuple of str, optional
        Labels of the axes instead of those for magnitudes.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    true, offset = np.asarray(true), np.asarray(offset)
    inside = np.abs(offset) <= limit
    ax.axhline(0, color=TRUE, lw=1)
    ax.plot(true[inside], offset[inside], ".", ms=3.5, color=MEASURED, alpha=0.55)
    for sign, marker in ((1, "^"), (-1, "v")):
        far = sign * offset > limit
        ax.plot(
            true[far],
            np.full(far.sum(), sign * 0.97 * limit),
            marker,
            ms=3.5,
            color=MEASURED,
            alpha=0.55,
        )
    if running is not None and len(running[0]):
        mid, median, sigma = running
        ax.fill_between(mid, median - sigma, median + sigma, color=SECOND, alpha=0.18, lw=0)
        # a single bin makes no line
        mark = "o" if len(mid) == 1 else None
        ax.plot(mid, median, color=SECOND, lw=1.8, marker=mark, label="running median, scatter")
        ax.legend(loc="lower left", fontsize=8, frameon=False)
    x_label, y_label = labels or ("true magnitude (AB)", "measured - true (mag)")
    ax.set(ylim=(-limit, limit), xlabel=x_label, ylabel=y_label, title=title)
    return ax


def plot_error_function(flux, sigma, *, limits=None, ax=None, colors=None):
    """
    Error against flux for several bands.

    Parameters
    ----------
    flux, sigma : dict of str to array-like
        Flux and 1-sigma error in uJy by band.
    limits : dict of str to float, optional
        5-sigma limits in uJy of some or all bands, marked on their curves.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    colors : dict, optional
        Color of each band.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    for k, name in enumerate(flux):
        # neighbors differ in more than a shade
        style = {"color": (colors or {}).get(name), "ls": ("-", "--")[k % 2]}
        (line,) = ax.loglog(flux[name], sigma[name], lw=1.6, label=name, **style)
        limit = (limits or {}).get(name, np.nan)
        if np.isfinite(limit):
            ax.plot(limit, limit / 5, "o", color=line.get_color(), ms=5)
    ax.set(xlabel="flux (µJy)", ylabel=r"1$\sigma$ error (µJy)")
    ax.legend(fontsize=8, frameon=False)
    return ax


def plot_redshifts(z_true, z_fit, *, z_err=None, ax=None, outlier=0.15, title=None):
    """
    Fitted against true redshift on a scale of log(1 + z), with the outlier limits.

    Parameters
    ----------
    z_true, z_fit : array-like, shape (n,)
        Redshifts.
    z_err : array-like, optional
        Errors of ``z_fit``.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    outlier : float, optional
        Limit in dz / (1 + z).
    title : str, optional
        Title.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    z_true, z_fit = np.asarray(z_true), np.asarray(z_fit)
    top = max(4.0, np.nanmax(z_true, initial=0), np.nanmax(z_fit, initial=0)) + 0.3
    z = np.linspace(0, top, 200)
    ax.plot(z, z, color=TRUE, lw=1)
    for sign in (1, -1):
        ax.plot(z, z + sign * outlier * (1 + z), color=TRUE, lw=0.8, ls="--")
    bad = np.abs(z_fit - z_true) > outlier * (1 + z_true)
    if z_err is not None:
        ax.errorbar(z_true, z_fit, yerr=z_err, fmt="none", ecolor="0.8", elinewidth=0.6, zorder=0)
    ax.plot(z_true[~bad], z_fit[~bad], ".", ms=4, color=SECOND, alpha=0.7)
    ax.plot(z_true[bad], z_fit[bad], "x", ms=4, color=MEASURED, label="outliers")
    functions = (lambda v: np.log1p(np.maximum(v, -0.9)), np.expm1)
    ax.set_xscale("function", functions=functions)
    ax.set_yscale("function", functions=functions)
    ticks = [0, 0.5, 1, 2, 3, 4, 6]
    ax.set_xticks([t for t in ticks if t < top])
    ax.set_yticks([t for t in ticks if t < top])
    ax.set(
        xlim=(0, top), ylim=(0, top), xlabel="true redshift", ylabel="fitted redshift", title=title
    )
    if np.any(bad):
        ax.legend(fontsize=8, frameon=False, loc="upper left")
    return ax


def plot_histogram(samples, bins, *, ax=None, xlabel=None, title=None, truth=None):
    """
    Histograms of several samples as steps.

    Parameters
    ----------
    samples : dict of str to array-like
        Values by label; NaN is not counted.
    bins : array-like
        Edges.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    xlabel, title : str, optional
        Texts.
    truth : float, optional
        True value, as a vertical line.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    colors = (MEASURED, SECOND, "0.4", "#15803d")
    for k, (label, values) in enumerate(samples.items()):
        values = np.asarray(values, float)
        # the fifth has the first color, dashed
        style = {"color": colors[k % 4], "ls": ("-", "--", ":")[k // 4 % 3], "lw": 1.6}
        ax.hist(values[np.isfinite(values)], bins, histtype="step", label=label, **style)
    if truth is not None:
        ax.axvline(truth, color=TRUE, lw=1, ls="--", label="truth")
    ax.set(xlabel=xlabel, ylabel="sources", title=title)
    ax.legend(fontsize=8, frameon=False)
    return ax


def plot_relation(x, y, *, lines=(), ax=None, labels=("", ""), color=None, log=(False, True)):
    """
    A cloud of points with published relations over it.

    Parameters
    ----------
    x, y : array-like, shape (n,)
        Points.
    lines : iterable of tuple
        (x, y, label) of each relation.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    labels : tuple of str, optional
        Labels of the axes.
    color : array-like, optional
        Redshifts, by which the points are colored.
    log : tuple of bool, optional
        Whether each axis is logarithmic.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    if color is None:
        ax.plot(x, y, ".", ms=4, color=MEASURED, alpha=0.6)
    else:
        points = ax.scatter(x, y, c=color, s=9, cmap="viridis", alpha=0.8)
        ax.figure.colorbar(points, ax=ax, label="redshift")
    for k, (line_x, line_y, label) in enumerate(lines):
        ax.plot(line_x, line_y, color=TRUE, lw=1.4, ls=("-", "--", ":", "-.")[k % 4], label=label)
    if log[0]:
        ax.set_xscale("log")
    if log[1]:
        ax.set_yscale("log")
    ax.set(xlabel=labels[0], ylabel=labels[1])
    if lines:
        ax.legend(fontsize=8, frameon=False)
    return ax


def plot_counts(edges, counts, counts_err, *, ax=None, title=None):
    """
    Differential number counts with their Poisson errors.

    Parameters
    ----------
    edges : array-like, shape (m + 1,)
        Magnitudes.
    counts, counts_err : array-like, shape (m,)
        Per square degree and magnitude.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    title : str, optional
        Title.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    edges, counts = np.asarray(edges), np.asarray(counts)
    good = counts > 0
    mid = 0.5 * (edges[1:] + edges[:-1])
    ax.errorbar(
        mid[good], counts[good], np.asarray(counts_err)[good], fmt="o", ms=4, color=MEASURED, lw=1
    )
    ax.set_yscale("log")
    ax.set(xlabel="magnitude (AB)", ylabel=r"N (deg$^{-2}$ mag$^{-1}$)", title=title)
    return ax
