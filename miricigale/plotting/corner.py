"""Posteriors of several parameters of one object, each and in pairs."""

from miricigale.plotting.axes import AxesArray
from miricigale.plotting.posteriors import plot_pdf, plot_pdf_2d


def plot_corner(labels, marginals, joints, *, truths=None, figure=None):
    """
    Draw the posterior of each parameter on the diagonal, and of each pair below it.

    Parameters
    ----------
    labels : list of str, length n
        Names of the parameters.
    marginals : list of pair of array_like, length n
        Edges, shape (k + 1,), and weights, shape (k,), of the cells of each parameter.
    joints : dict of pair of int to tuple of array_like
        For row and column (a later and an earlier parameter) the edges of the cells of the earlier one, of the
        later one, and their weights, shape (n_earlier, n_later).
    truths : list of float or None, optional
        Values to mark; None for none.
    figure : `~matplotlib.figure.Figure`, optional
        Where to draw; a new figure by default.

    Returns
    -------
    axes : `~miricigale.plotting.axes.AxesArray` of `~matplotlib.axes.Axes`, shape (n, n)
        Those above the diagonal are not shown.
    """
    import matplotlib.pyplot as plt

    n = len(labels)
    if figure is None:
        side = 1.2 + 1.9 * n
        figure = plt.figure(figsize=(side, side), layout="constrained")
    axes = figure.subplots(n, n, squeeze=False, sharex="col")
    if truths is None:
        truths = [None] * n
    limits = []
    for row in range(n):
        for column in range(n):
            ax = axes[row, column]
            if column > row:
                ax.set_visible(False)
            elif column == row:
                plot_pdf(*marginals[row], ax=ax, truth=truths[row])
                ax.set(ylabel="", yticks=[])
                # without margins, as in the joint panels
                limits.append(tuple(ax.dataLim.intervalx))
            else:
                _joint(ax, joints[row, column], (truths[column], truths[row]))
            if row == n - 1:
                ax.set_xlabel(labels[column])
                ax.tick_params(axis="x", rotation=45)
            else:
                ax.tick_params(axis="x", labelbottom=False)
            if column == 0 and row > 0:
                ax.set_ylabel(labels[row])
            elif column < row:
                ax.tick_params(axis="y", labelleft=False)
    _set_limits(axes, limits)
    return AxesArray(axes)


def _joint(ax, cells, truth):
    """Draw the cells of a pair, and where the truth is."""
    plot_pdf_2d(*cells, ax=ax)
    x, y = truth
    if x is not None:
        ax.axvline(x, color="black", linestyle="--", linewidth=1)
    if y is not None:
        ax.axhline(y, color="black", linestyle="--", linewidth=1)


def _set_limits(axes, limits):
    """Give all panels of a parameter the limits of its own, in which its posterior is shown."""
    for k, span in enumerate(limits):
        axes[k, k].set_xlim(span)
        for column in range(k):
            axes[k, column].set_ylim(span)
