"""Figures of a study with several truths: a panel for each, band sets over each other."""

import numpy as np

from miricigale.plotting.axes import new_figure, panel_columns, panels
from miricigale.plotting.comparison import MEASURED, SECOND, TRUE, plot_histogram

__all__ = [
    "classes_figure",
    "colors_figure",
    "completeness_figure",
    "fractions_figure",
    "histograms_figure",
    "luminosity_figure",
    "ranks_figure",
    "recovery_figure",
]

#: Colors and markers of band sets, in their order.
_SETS = ((MEASURED, "o"), (SECOND, "s"), ("0.4", "^"), ("#15803d", "D"))


def _outer_labels(axes, xlabel, ylabel):
    """Label the outer axes of `panels`, and keep one legend."""
    axes = list(axes.values())
    columns = panel_columns(len(axes))
    for k, ax in enumerate(axes):
        last = k + columns >= len(axes)
        ax.set_xlabel(xlabel if last else "")
        ax.set_ylabel("" if k % columns else ylabel)
        ax.tick_params(labelbottom=True)
        if k and ax.get_legend():
            ax.get_legend().remove()


def histograms_figure(samples, bins, *, xlabel, truth=None):
    """
    Histograms of a quantity by truth, with a step line for each band set.

    Parameters
    ----------
    samples : dict of str to dict of str to array-like
        Values by truth and band set; those beyond the bins are counted in the outermost ones, NaN is
        left out.
    bins : array-like
        Edges.
    xlabel : str
        Label of the axes.
    truth : dict of str to float, optional
        True value by truth, as a vertical line.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    bins = np.asarray(bins, float)
    figure, axes = panels(samples, sharex=True)
    middle = 0.5 * (bins[[0, -2]] + bins[[1, -1]])
    for label, ax in axes.items():
        inside = {name: np.clip(v, *middle) for name, v in samples[label].items()}
        plot_histogram(inside, bins, ax=ax, title=label, truth=(truth or {}).get(label))
        ax.set_title(label, fontsize="medium")
        ax.set_xlim(bins[0], bins[-1])
    _outer_labels(axes, xlabel, "sources")
    return figure


def fractions_figure(values):
    """
    Fitted against injected AGN fraction by bin of redshift.

    Parameters
    ----------
    values : dict of str to dict of str to tuple of array-like, shape (n,)
        By bin and band set: injected fractions, medians of the fitted ones, and their scatter.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(values, height=3.1, sharex=True, sharey=True)
    for label, ax in axes.items():
        ax.plot([0, 1], [0, 1], color=TRUE, lw=1)
        count = len(values[label])
        for k, (name, (true, median, scatter)) in enumerate(values[label].items()):
            color, marker = _SETS[k % len(_SETS)]
            # beside each other, so that the bars can be told apart
            place = np.asarray(true, float) + 0.015 * (k - 0.5 * (count - 1))
            ax.errorbar(place, median, scatter, fmt=marker, ms=4.5, color=color, lw=1.2, label=name)
        ax.set(xlim=(-0.07, 1.07), ylim=(-0.12, 1.12))
        ax.legend(fontsize=8, frameon=False, loc="upper left")
    _outer_labels(axes, "injected fracAGN", "fitted fracAGN")
    return figure


def recovery_figure(values, *, label, notes=None):
    """
    Fitted against true values on logarithmic axes by truth, with a factor of two marked.

    Parameters
    ----------
    values : dict of str to tuple of array-like, shape (n,)
        True and fitted values by truth, in one unit; those not positive are left out.
    label : str
        Name and unit of the quantity.
    notes : dict of str to str, optional
        A line in the panel of each truth, such as median and scatter of the ratio.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(values, height=3.3, sharex=True, sharey=True)
    both = []
    for name, ax in axes.items():
        true, fitted = (np.asarray(v, float) for v in values[name])
        good = (true > 0) & (fitted > 0) & np.isfinite(true * fitted)
        true, fitted = true[good], fitted[good]
        both += [true, fitted]
        ax.loglog(true, fitted, ".", ms=4, color=MEASURED, alpha=0.6)
        note = (notes or {}).get(name, "")
        ax.text(0.04, 0.95, note, transform=ax.transAxes, fontsize=8, va="top")
    both = np.concatenate([np.ones(0), *both])
    if both.size:
        ends = np.percentile(both, [0.5, 99.5]) * [0.5, 2]
        for ax in axes.values():
            ax.plot(ends, ends, color=TRUE, lw=1)
            ax.fill_between(ends, ends / 2, ends * 2, color=TRUE, alpha=0.12, lw=0)
            ax.set(xlim=ends, ylim=ends)
    _outer_labels(axes, f"true {label}", f"fitted {label}")
    return figure


def completeness_figure(table, *, xlabel, limits=(), half=None):
    """
    Histograms of all sources and of those found, and the share found beneath.

    Parameters
    ----------
    table : `~astropy.table.Table`
        Bins that follow each other: ``low``, ``high``, ``n``, ``n_found``, ``share``, ``share_low`` and
        ``share_high`` (`~miricigale.evaluation.completeness`).
    xlabel : str
        Label of the axis.
    limits : iterable of tuple, optional
        Value, label, and whether it is well known (a full line, otherwise dotted) of the limits of other
        surveys.
    half : tuple of float, optional
        Value of 50 % completeness and the ends of its interval.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = new_figure(2, 1, size=(7.0, 2.6), sharex=True, height_ratios=(1.5, 1))
    upper, lower = axes[:, 0]
    bins = np.append(np.asarray(table["low"]), table["high"][-1])
    upper.stairs(table["n"], bins, color=TRUE, lw=1.6, label="all")
    upper.stairs(table["n_found"], bins, color=MEASURED, fill=True, alpha=0.35, label="found")
    upper.stairs(table["n_found"], bins, color=MEASURED, lw=1.6)
    some = table[np.asarray(table["n"]) > 0]
    place = 0.5 * (np.asarray(some["low"]) + np.asarray(some["high"]))
    lower.vlines(place, some["share_low"], some["share_high"], color=MEASURED, lw=1.2)
    lower.plot(place, some["share"], "o", ms=4, color=MEASURED)
    lower.axhline(0.5, color=TRUE, lw=0.8, ls="--")
    if half is not None and np.isfinite(half[0]):
        for ax in (upper, lower):
            ax.axvspan(half[1], half[2], color=MEASURED, alpha=0.15, lw=0)
            label = "50 % of these" if ax is upper else None
            ax.axvline(half[0], color=MEASURED, lw=1.2, label=label)
    shades = (SECOND, "0.2", "#15803d", "#7c3aed")
    for k, (value, name, known) in enumerate(limits):
        for ax in (upper, lower):
            label = name if ax is upper else None
            style = {"color": shades[k % len(shades)], "ls": "-" if known else ":"}
            ax.axvline(value, lw=1.6, label=label, **style)
    # above the axes, which are full of lines
    upper.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    upper.set(ylabel="sources", xlim=(bins[0], bins[-1]))
    lower.set(ylabel="share found", xlabel=xlabel, ylim=(-0.05, 1.08))
    return figure


def luminosity_figure(redshift, luminosity, groups, *, sfr=None, curves=None):
    """
    Infrared luminosity against redshift with an axis of star-formation rates, and detections.

    Parameters
    ----------
    redshift, luminosity : array-like, shape (n,)
        Redshifts and luminosities in Lsun; those not positive are left out.
    groups : dict of str to array-like of bool, shape (n,)
        Detected sources by label, drawn over each other in this order; all others are gray.
    sfr : tuple, optional
        Star-formation rate (Msun / yr) of one Lsun, and the label of the axis on the right.
    curves : dict of str to tuple of array-like, optional
        Redshifts and luminosities of limits, by label.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = new_figure(size=(7.0, 4.4))
    ax = axes[0, 0]
    z, power = np.asarray(redshift, float), np.asarray(luminosity, float)
    good = (power > 0) & np.isfinite(z)
    seen = np.zeros(z.size, bool)
    for rows in groups.values():
        seen |= np.asarray(rows, bool)
    rest = good & ~seen
    ax.semilogy(z[rest], power[rest], ".", ms=4, color="0.75", label="not detected", zorder=1)
    for k, (name, rows) in enumerate(groups.items()):
        color, marker = _SETS[k % len(_SETS)]
        rows = good & np.asarray(rows, bool)
        size = 3 + 2.5 * k
        face = color if k == 0 else "none"
        ax.plot(
            z[rows], power[rows], marker, ms=size, color=color, mfc=face, alpha=0.75, label=name
        )
    for k, (name, (x, y)) in enumerate((curves or {}).items()):
        ax.plot(x, y, color=TRUE, lw=1.4, ls=("--", ":", "-.")[k % 3], label=name)
    if good.any():
        low, high = np.percentile(power[good], [1, 100])
        ax.set(xlim=(0, 1.03 * z[good].max()), ylim=(0.5 * low, 2 * high))
    ax.set(xlabel="redshift", ylabel=r"L$_\mathrm{IR}$ (L$_\odot$)")
    if sfr is not None:
        factor, label = sfr
        right = ax.secondary_yaxis("right", functions=(lambda v: v * factor, lambda v: v / factor))
        right.set_ylabel(label)
    # above the axes, which are full of points
    ax.legend(fontsize=8, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
    return figure


def classes_figure(counts, names, *, found=None):
    """
    Shares of the sources of each true class that are found in each class.

    Parameters
    ----------
    counts : array-like of int, shape (n, m)
        Sources by true class and class found.
    names : sequence of str
        Names of the n true classes.
    found : sequence of str, optional
        Names of the m classes found; the same by default.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    counts = np.asarray(counts, float)
    found = list(names if found is None else found)
    total = counts.sum(axis=1, keepdims=True)
    share = np.divide(counts, total, out=np.zeros(counts.shape), where=total > 0)
    figure, axes = new_figure(size=(1.3 + 1.1 * len(found), 1.0 + 0.8 * len(names)))
    ax = axes[0, 0]
    ax.imshow(share, cmap="Oranges", vmin=0, vmax=1.2, aspect="auto")
    for (i, j), value in np.ndenumerate(share):
        text = f"{100 * value:.0f} %\n{counts[i, j]:.0f}"
        ax.text(j, i, text, ha="center", va="center", fontsize=9)
    ax.set(
        xticks=range(len(found)),
        xticklabels=found,
        yticks=range(len(names)),
        yticklabels=list(names),
        xlabel="found as",
        ylabel="true class",
    )
    ax.tick_params(length=0)
    for side in ax.spines.values():
        side.set_visible(False)
    return figure


def colors_figure(planes, *, labels):
    """
    Planes of two colors with sources of each class and the circles that tell them apart.

    Parameters
    ----------
    planes : dict of str to tuple
        By title: colors, shape (n, 2), classes, shape (n,), center (x, y), and radii of the circles.
    labels : dict of str to tuple of str
        Labels of the axes by title.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    from matplotlib.patches import Circle

    figure, axes = panels(planes, height=3.4)
    for k, (title, ax) in enumerate(axes.items()):
        colors, classes, center, radii = planes[title]
        colors, classes = np.asarray(colors, float), np.asarray(classes, str)
        for i, name in enumerate(dict.fromkeys(sorted(classes.tolist()))):
            shade, marker = _SETS[i % len(_SETS)]
            rows = classes == name
            ax.plot(*colors[rows].T, marker, ms=3.5, color=shade, alpha=0.55, label=name)
        for radius, style in zip(radii, ("-", "--"), strict=False):
            circle = {"fill": False, "color": "black", "lw": 1.3, "ls": style, "zorder": 5}
            ax.add_patch(Circle(center, radius, **circle))
        ax.set(
            xlabel=labels[title][0], ylabel=labels[title][1], aspect="equal", adjustable="datalim"
        )
        if k == 0:
            ax.legend(fontsize=8, frameon=False, loc="upper left")
    return figure


def ranks_figure(ranks, *, bins=10):
    """
    Histograms of the ranks of true values in their posteriors, with what chance allows.

    Parameters
    ----------
    ranks : dict of str to dict of str to array-like
        Ranks between 0 and 1 (`~miricigale.evaluation.posterior_ranks`) by parameter and fit; NaN is
        left out.
    bins : int, optional
        Bins.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(ranks, height=2.6, sharex=True)
    edges = np.linspace(0, 1, bins + 1)
    for label, ax in axes.items():
        least = 0
        for k, (name, values) in enumerate(ranks[label].items()):
            values = np.asarray(values, float)
            values = values[np.isfinite(values)]
            n, _ = np.histogram(values, edges)
            least = max(least, values.size)
            density = n * bins / max(values.size, 1)
            color = _SETS[k % len(_SETS)][0]
            ax.stairs(
                density, edges, color=color, lw=1.6, ls=("-", "--", ":", "-.")[k % 4], label=name
            )
        if least:
            # binomial, of a uniform distribution
            error = np.sqrt((bins - 1) / least)
            ax.axhspan(1 - error, 1 + error, color="0.88", zorder=0)
        ax.axhline(1, color=TRUE, lw=0.8)
        ax.set(xlim=(0, 1), ylim=(0, max(2.0, 1.05 * ax.get_ylim()[1])))
        ax.legend(fontsize=8, frameon=False, loc="upper center")
    _outer_labels(axes, "rank of the truth", "density")
    return figure
