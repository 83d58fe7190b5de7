"""Truth against measurement."""

import numpy as np

from miricigale.plotting.axes import (
    MEASURED,
    SECOND,
    TRUE,
    legend,
    plain_log_ticks,
    plain_text,
    resolve_axes,
)

#: dz / (1 + z) beyond which a redshift is an outlier.
_OUTLIER = 0.15


def plot_offsets(true, offset, *, running=None, ax=None, title=None, limit=1.0):
    """
    Draw the difference against true magnitude with its running median.

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

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    true = np.asarray(true)
    offset = np.asarray(offset)
    ax.axhline(0, color=TRUE, lw=1)
    inside = np.abs(offset) <= limit
    shown = np.where(inside, offset, 0.97 * limit * np.sign(offset))
    for marker, rows in ((".", inside), ("^", offset > limit), ("v", offset < -limit)):
        ax.plot(true[rows], shown[rows], marker, ms=3.5, color=MEASURED, alpha=0.55)
    if running is not None and len(running[0]):
        mid, median, sigma = running
        ax.fill_between(mid, median - sigma, median + sigma, color=SECOND, alpha=0.18, lw=0)
        # a single bin makes no line
        mark = None
        if len(mid) == 1:
            mark = "o"
        ax.plot(mid, median, color=SECOND, lw=1.8, marker=mark, label="running median, scatter")
        legend(ax, loc="lower left")
    ax.set(ylim=(-limit, limit), title=title)
    ax.set(xlabel="true magnitude (AB)", ylabel="measured - true (mag)")
    return ax


def plot_error_function(flux, sigma, *, limits=None, ax=None, colors=None):
    """
    Draw the error against flux for several bands.

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
        (line,) = ax.loglog(
            flux[name],
            sigma[name],
            lw=1.6,
            label=plain_text(name),
            color=(colors or {}).get(name),
            ls=("-", "--")[k % 2],
        )
        limit = (limits or {}).get(name, np.nan)
        if np.isfinite(limit):
            ax.plot(limit, limit / 5, "o", color=line.get_color(), ms=5)
    ax.set(xlabel="flux (µJy)", ylabel=r"1$\sigma$ error (µJy)")
    legend(ax)
    return ax


def plot_redshifts(z_true, z_fit, *, z_err=None, ax=None, title=None):
    """
    Draw the fitted against true redshift on a scale of log(1 + z), with the outlier limits.

    Parameters
    ----------
    z_true, z_fit : array-like, shape (n,)
        Redshifts.
    z_err : array-like, optional
        Errors of ``z_fit``.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    title : str, optional
        Title.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    z_true = np.asarray(z_true)
    z_fit = np.asarray(z_fit)
    top = max(4.0, np.nanmax(z_true, initial=0), np.nanmax(z_fit, initial=0)) + 0.3
    z = np.linspace(0, top, 200)
    ax.plot(z, z, color=TRUE, lw=1)
    for sign in (1, -1):
        ax.plot(z, z + sign * _OUTLIER * (1 + z), color=TRUE, lw=0.8, ls="--")
    bad = np.abs(z_fit - z_true) > _OUTLIER * (1 + z_true)
    if z_err is not None:
        ax.errorbar(z_true, z_fit, yerr=z_err, fmt="none", ecolor="0.8", elinewidth=0.6, zorder=0)
    ax.plot(z_true[~bad], z_fit[~bad], ".", ms=4, color=SECOND, alpha=0.7)
    ax.plot(z_true[bad], z_fit[bad], "x", ms=4, color=MEASURED, label="outliers")
    functions = (lambda v: np.log1p(np.maximum(v, -0.9)), np.expm1)
    ax.set_xscale("function", functions=functions)
    ax.set_yscale("function", functions=functions)
    ticks = [tick for tick in (0, 0.5, 1, 2, 3, 4, 6) if tick < top]
    ax.set(xlim=(0, top), xticks=ticks, xlabel="true redshift", title=title)
    ax.set(ylim=(0, top), yticks=ticks, ylabel="fitted redshift")
    if np.any(bad):
        legend(ax, loc="upper left")
    return ax


def plot_relation(x, y, *, lines=(), ax=None, labels=("", "")):
    """
    Draw a cloud of points with published relations over it, on logarithmic axes.

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

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    ax.loglog(x, y, ".", ms=4, color=MEASURED, alpha=0.6)
    plain_log_ticks(ax.xaxis, ax.yaxis)
    for k, (line_x, line_y, label) in enumerate(lines):
        ax.plot(line_x, line_y, color=TRUE, lw=1.4, ls=("-", "--", ":", "-.")[k % 4], label=label)
    ax.set(xlabel=labels[0], ylabel=labels[1])
    if lines:
        legend(ax)
    return ax
