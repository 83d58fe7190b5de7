"""Figures of a study with several truths: a panel for each, band sets over each other."""

import numpy as np

from miricigale.plotting.axes import (
    MEASURED,
    SECOND,
    STYLES,
    TRUE,
    label_outer,
    legend,
    new_figure,
    panels,
)

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

_RANK_BINS = 10


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
        for k, (name, values) in enumerate(samples[label].items()):
            inside = np.clip(np.asarray(values, float), *middle)
            # the fifth has the first color, dashed
            style = {"color": STYLES[k % 4][0], "ls": ("-", "--", ":")[k // 4 % 3], "lw": 1.6}
            ax.hist(inside[np.isfinite(inside)], bins, histtype="step", label=name, **style)
        if (truth or {}).get(label) is not None:
            ax.axvline(truth[label], color=TRUE, lw=1, ls="--", label="truth")
        ax.set_xlim(bins[0], bins[-1])
        legend(ax)
    label_outer(axes, xlabel, "sources")
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
            color, marker = STYLES[k % len(STYLES)]
            # side by side, so that the bars do not cover each other
            place = np.asarray(true, float) + 0.015 * (k - 0.5 * (count - 1))
            ax.errorbar(place, median, scatter, fmt=marker, ms=4.5, color=color, lw=1.2, label=name)
        ax.set(xlim=(-0.07, 1.07), ylim=(-0.12, 1.12))
        legend(ax, loc="upper left")
    label_outer(axes, "injected fracAGN", "fitted fracAGN")
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
    label_outer(axes, f"true {label}", f"fitted {label}")
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
    shades = (SECOND, "0.2", "#15803d", "#7c3aed")
    for ax in (upper, lower):
        if half is not None and np.isfinite(half[0]):
            ax.axvspan(half[1], half[2], color=MEASURED, alpha=0.15, lw=0)
            ax.axvline(half[0], color=MEASURED, lw=1.2, label="50 % of these")
        for k, (value, name, known) in enumerate(limits):
            style = {"color": shades[k % len(shades)], "ls": "-" if known else ":"}
            ax.axvline(value, lw=1.6, label=name, **style)
    # above the axes, which are full of lines
    legend(upper, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    upper.set(ylabel="sources", xlim=(bins[0], bins[-1]))
    lower.set(ylabel="share found", xlabel=xlabel, ylim=(-0.05, 1.08))
    return figure


def luminosity_figure(redshift, luminosity, groups, *, sfr=None):
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

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = new_figure(size=(7.0, 4.4))
    ax = axes[0, 0]
    z, power = np.asarray(redshift, float), np.asarray(luminosity, float)
    good = (power > 0) & np.isfinite(z)
    rest = good & ~np.any([np.zeros(z.size, bool), *groups.values()], axis=0)
    ax.semilogy(z[rest], power[rest], ".", ms=4, color="0.75", label="not detected", zorder=1)
    for k, (name, rows) in enumerate(groups.items()):
        color, marker = STYLES[k % len(STYLES)]
        rows = good & np.asarray(rows, bool)
        style = {"ms": 3 + 2.5 * k, "color": color, "mfc": "none" if k else color, "alpha": 0.75}
        ax.plot(z[rows], power[rows], marker, label=name, **style)
    if good.any():
        low, high = np.percentile(power[good], [1, 100])
        ax.set(xlim=(0, 1.03 * z[good].max()), ylim=(0.5 * low, 2 * high))
    ax.set(xlabel="redshift", ylabel=r"L$_\mathrm{IR}$ (L$_\odot$)")
    if sfr is not None:
        factor, label = sfr
        right = ax.secondary_yaxis("right", functions=(lambda v: v * factor, lambda v: v / factor))
        right.set_ylabel(label)
    # above the axes, which are full of points
    legend(ax, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
    return figure


def classes_figure(counts, names, *, found):
    """
    Shares of the sources of each true class that are found in each class.

    Parameters
    ----------
    counts : array-like of int, shape (n, m)
        Sources by true class and class found.
    names : sequence of str
        Names of the n true classes.
    found : sequence of str
        Names of the m classes found.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    counts = np.asarray(counts, float)
    total = counts.sum(axis=1, keepdims=True)
    share = np.divide(counts, total, out=np.zeros(counts.shape), where=total > 0)
    figure, axes = new_figure(size=(1.3 + 1.1 * len(found), 1.0 + 0.8 * len(names)))
    ax = axes[0, 0]
    ax.imshow(share, cmap="Oranges", vmin=0, vmax=1.2, aspect="auto")
    for (i, j), value in np.ndenumerate(share):
        text = f"{100 * value:.0f} %\n{counts[i, j]:.0f}"
        ax.text(j, i, text, ha="center", va="center", fontsize=9)
    ax.set(xticks=range(len(found)), xticklabels=found, xlabel="found as")
    ax.set(yticks=range(len(names)), yticklabels=names, ylabel="true class")
    ax.tick_params(length=0)
    ax.spines[:].set_visible(False)
    return figure


def colors_figure(planes, *, labels):
    """
    Planes of two colors with sources of each class and the circles that separate them.

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
            shade, marker = STYLES[i % len(STYLES)]
            rows = classes == name
            ax.plot(*colors[rows].T, marker, ms=3.5, color=shade, alpha=0.55, label=name)
        for radius, style in zip(radii, ("-", "--"), strict=False):
            circle = {"fill": False, "color": "black", "lw": 1.3, "ls": style, "zorder": 5}
            ax.add_patch(Circle(center, radius, **circle))
        ax.set(xlabel=labels[title][0], ylabel=labels[title][1])
        ax.set_aspect("equal", adjustable="datalim")
        if k == 0:
            legend(ax, loc="upper left")
    return figure


def ranks_figure(ranks):
    """
    Histograms of the ranks of true values in their posteriors, with what chance allows.

    Parameters
    ----------
    ranks : dict of str to dict of str to array-like
        Ranks between 0 and 1 (`~miricigale.evaluation.posterior_ranks`) by parameter and fit; NaN is
        left out.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(ranks, height=2.6, sharex=True)
    for label, ax in axes.items():
        most = 0
        for k, (name, values) in enumerate(ranks[label].items()):
            values = np.asarray(values, float)
            n, edges = np.histogram(values[np.isfinite(values)], _RANK_BINS, (0, 1))
            most = max(most, n.sum())
            style = {"color": STYLES[k % 4][0], "lw": 1.6, "ls": ("-", "--", ":", "-.")[k % 4]}
            ax.stairs(n * _RANK_BINS / max(n.sum(), 1), edges, label=name, **style)
        if most:
            # binomial, of a uniform distribution
            error = np.sqrt((_RANK_BINS - 1) / most)
            ax.axhspan(1 - error, 1 + error, color="0.88", zorder=0)
        ax.axhline(1, color=TRUE, lw=0.8)
        ax.set(xlim=(0, 1), ylim=(0, max(2.0, 1.05 * ax.get_ylim()[1])))
        legend(ax, loc="upper center")
    label_outer(axes, "rank of the truth", "density")
    return figure
