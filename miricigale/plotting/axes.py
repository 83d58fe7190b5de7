"""The axes that every plot function draws on."""

__all__ = ["new_figure", "resolve_axes"]


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


def resolve_axes(ax):
    """The given axes, or those of pyplot's current figure."""
    if ax is not None:
        return ax
    import matplotlib.pyplot as plt

    return plt.gca()
