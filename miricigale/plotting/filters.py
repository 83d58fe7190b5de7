"""Filter curves."""

from miricigale.plotting.axes import legend, resolve_axes


def plot_filters(curves, ax=None, **kwargs):
    """
    Draw filter curves, with a legend if there are several.

    Parameters
    ----------
    curves : iterable of tuple
        Wavelength (um), throughput and name of each.
    ax : `~matplotlib.axes.Axes`, optional
        Where to; the current axes if not given.
    **kwargs
        Passed to `~matplotlib.axes.Axes.plot`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax, curves = resolve_axes(ax), list(curves)
    for wave, throughput, name in curves:
        ax.plot(wave, throughput, **{"label": name, **kwargs})
    ax.set(xlabel="wavelength (µm)", ylabel="throughput")
    if len(curves) > 1:
        legend(ax)
    return ax
