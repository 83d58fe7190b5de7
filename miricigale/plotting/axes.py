"""The axes that every plot function draws on."""

__all__ = ["WIDTH", "new_figure", "panel_columns", "panels", "resolve_axes"]

#: Inches across the figures of a page, which are shown at one width, so that letters have one size.
WIDTH = 10.5


def panel_columns(n):
    """Panels in a row of a figure of ``n``: three, or two or four where that leaves fewer places empty."""
    if n == 4:
        return 2
    return 4 if n > 4 and -n % 4 < -n % 3 else min(3, max(n, 1))


def new_figure(n_rows=1, n_columns=1, *, size=(4.2, 3.4), **kwargs):
    """
    A figure that belongs to no window, with a grid of axes.

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
    A figure with a panel for each label, in rows of `panel_columns`.

    Parameters
    ----------
    labels : iterable of str
        Titles of the panels.
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
        ax.set_title(label, fontsize="medium")
    return figure, out


def resolve_axes(ax):
    """The given axes, or those of pyplot's current figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.gca()
