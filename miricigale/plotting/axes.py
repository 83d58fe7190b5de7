"""Figures, axes, colors and legends that all plots share."""

import weakref

import numpy as np

#: Inches across the figures of a page, which are shown at one width, so that letters have one size.
WIDTH = 10.5
#: Colors of truth, of what is measured and of a second measurement.
TRUE = "0.35"
MEASURED = "#9a3412"
SECOND = "#1d4ed8"
#: Colors and markers of samples drawn over each other, such as those of band sets, in their order.
STYLES = ((MEASURED, "o"), (SECOND, "s"), ("0.4", "^"), ("#15803d", "D"))


#: Figures of several panels, beside which other plots are drawn.
_PANEL_FIGURES = weakref.WeakSet()


class AxesArray(np.ndarray):
    """
    Axes of a figure with several panels, which has the figure as a single axes has.

    Parameters
    ----------
    axes : array_like of `~matplotlib.axes.Axes`

    Examples
    --------
    >>> from miricigale.plotting.axes import AxesArray, new_figure
    >>> figure, axes = new_figure(1, 2)
    >>> AxesArray(axes).figure is figure
    True
    """

    def __new__(cls, axes):
        axes = np.asarray(axes, dtype=object).view(cls)
        _PANEL_FIGURES.add(axes.figure)
        return axes

    @property
    def figure(self):
        """Figure of the panels."""
        return self.ravel()[0].figure

    def savefig(self, *args, **kwargs):
        """Save the figure; see `matplotlib.figure.Figure.savefig`."""
        self.figure.savefig(*args, **kwargs)


def panel_columns(n):
    """Panels in a row of a figure of ``n``: three, or two or four where that leaves fewer places empty."""
    if n == 4:
        return 2
    if n > 4 and -n % 4 < -n % 3:
        return 4
    return min(3, max(n, 1))


def new_figure(n_rows=1, n_columns=1, *, size=(4.2, 3.4), **kwargs):
    """
    Return a figure that belongs to no window, with a grid of axes.

    Parameters
    ----------
    n_rows, n_columns : int, optional
        Panels.
    size : tuple of float, optional
        Inches of one panel.
    **kwargs
        Passed to `matplotlib.figure.Figure.subplots`.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    axes : `~numpy.ndarray` of `~matplotlib.axes.Axes`, shape (n_rows, n_columns)
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(size[0] * n_columns, size[1] * n_rows), layout="constrained")
    return figure, figure.subplots(n_rows, n_columns, squeeze=False, **kwargs)


def panels(labels, *, height=2.7, **share):
    """
    Return a figure with a panel for each label, in rows of `panel_columns`.

    Parameters
    ----------
    labels : iterable of str
        Titles of the panels, shown as they are (`plain_text`).
    height : float, optional
        Inches of a row.
    **share
        ``sharex`` and ``sharey``, as in `new_figure`.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    axes : dict of str to `~matplotlib.axes.Axes`
        By label.
    """
    labels = list(labels)
    columns = panel_columns(len(labels))
    rows = max(-(-len(labels) // columns), 1)
    figure, axes = new_figure(rows, columns, size=(WIDTH / max(2, columns), height), **share)
    for ax in axes.ravel()[len(labels) :]:
        ax.remove()
    out = dict(zip(labels, axes.ravel(), strict=False))
    for label, ax in out.items():
        ax.set_title(plain_text(label), fontsize="medium")
    return figure, out


def plain_text(text):
    r"""
    Escape text that users bring, such as ids and names, for titles, labels and legends.

    Matplotlib reads what stands between two ``$`` as a formula, and raises an error where it is none.

    Parameters
    ----------
    text : object
        Shown as ``str`` has it.

    Returns
    -------
    text : str
        The same with ``\$`` for each ``$``, which matplotlib draws as ``$``.

    Examples
    --------
    >>> from miricigale.plotting.axes import plain_text
    >>> print(plain_text("$a$ 5"))
    \$a\$ 5
    """
    return str(text).replace("$", r"\$")


def label_outer(axes, xlabel=None, ylabel=None):
    """
    Label the outer axes of `panels` only, and keep the legend of the first.

    Parameters
    ----------
    axes : dict of str to `~matplotlib.axes.Axes`
        Of `panels`.
    xlabel, ylabel : str, optional
        Labels; those that the axes have by default.
    """
    axes = list(axes.values())
    columns = panel_columns(len(axes))
    for k, ax in enumerate(axes):
        # labels stand below the last row and left of the first column
        if k + columns < len(axes):
            ax.set_xlabel("")
        elif xlabel is not None:
            ax.set_xlabel(xlabel)
        if k % columns:
            ax.set_ylabel("")
        elif ylabel is not None:
            ax.set_ylabel(ylabel)
        ax.tick_params(labelbottom=True)
        if k and ax.get_legend():
            ax.get_legend().remove()


def legend(ax, **options):
    """Add a legend in small letters without a frame; ``options`` as of `matplotlib.axes.Axes.legend`."""
    return ax.legend(**{"fontsize": 8, "frameon": False} | options)


def corner_note(ax, text, side="right"):
    """Write a text in an upper corner of axes, ``"left"`` or ``"right"``."""
    place = {"left": 0.04, "right": 0.96}
    ax.text(place[side], 0.95, text, transform=ax.transAxes, ha=side, va="top", fontsize=8)


def add_borders(ax, labels, x, y, **kwargs):
    """
    Draw the borders between cells of different labels; around those at the edge too, unless their label is 0.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Axes to draw on.
    labels : array-like, shape (ny, nx)
        Label of each cell.
    x, y : array-like, shapes (nx + 1,) and (ny + 1,)
        Edges of the cells.
    **kwargs
        Passed to `~matplotlib.collections.LineCollection`.
    """
    from matplotlib.collections import LineCollection

    padded = np.pad(labels, 1)
    x = np.asarray(x)
    y = np.asarray(y)
    j, i = np.nonzero(padded[1:-1, 1:] != padded[1:-1, :-1])
    lines = [np.stack([x[[i, i]], y[[j, j + 1]]], axis=-1)]
    j, i = np.nonzero(padded[1:, 1:-1] != padded[:-1, 1:-1])
    lines += [np.stack([x[[i, i + 1]], y[[j, j]]], axis=-1)]
    # to shape (n, 2 ends, 2 coordinates)
    lines = np.concatenate(lines, axis=1).swapaxes(0, 1)
    ax.add_collection(LineCollection(lines, **kwargs))


def row_mask(rows, n, default):
    """Return the truth values of ``n`` points, shape (n,): those of the caller, or ``default`` for all without."""
    if rows is None:
        return np.full(n, default)
    return np.asarray(rows, bool)


def resolve_axes(ax):
    """Return the given axes, or those of pyplot's current figure; of a new one if that has panels of ours."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    if plt.get_fignums() and plt.gcf() in _PANEL_FIGURES:
        return plt.figure().gca()
    return plt.gca()


def plain_log_ticks(*axes):
    """
    Label logarithmic axes with plain numbers from 0.001 to 1000, where matplotlib writes powers of ten.

    Parameters
    ----------
    *axes : `~matplotlib.axis.Axis`
        Such as ``ax.xaxis``; linear ones stay as they are.
    """
    from matplotlib.ticker import LogFormatterSciNotation

    class PlainNumbers(LogFormatterSciNotation):
        def __call__(self, x, pos=None):
            text = super().__call__(x, pos)
            # empty where there is no space for a label
            if text and 1e-3 <= abs(x) <= 1e3:
                return f"{x:g}"
            return text

    for axis in axes:
        if axis.get_scale() == "log":
            axis.set_major_formatter(PlainNumbers())
            axis.set_minor_formatter(PlainNumbers(minor_thresholds=(1.0, 0.4)))
