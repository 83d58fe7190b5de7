"""Curves against wavelength: filters and spectra."""

import numpy as np

from miricigale.plotting.axes import legend, plain_log_ticks, plain_text, resolve_axes


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
    ax = resolve_axes(ax)
    curves = list(curves)
    for wave, throughput, name in curves:
        ax.plot(wave, throughput, **{"label": plain_text(name), **kwargs})
    ax.set(xlabel="wavelength (µm)", ylabel="throughput")
    if len(curves) > 1:
        # above the curves, which leave no place between them
        legend(ax, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=min(5, len(curves)))
    return ax


def plot_spectrum(wave, fnu, ax=None, *, rest_frame=False, label_y=r"$F_\nu$ (µJy)", **kwargs):
    """
    Draw a spectrum on logarithmic axes.

    Parameters
    ----------
    wave : `~numpy.ndarray`, shape (n,)
        Wavelengths in um.
    fnu : `~numpy.ndarray`, shape (n,)
        Flux densities; values that are not positive are left out.
    ax : `~matplotlib.axes.Axes`, optional
        Where to; the current axes if not given.
    rest_frame : bool, optional
        Whether the wavelengths are those at the source, not as observed: for the label.
    label_y : str, optional
        Label of the flux densities, those in uJy by default.
    **kwargs
        Passed to `~matplotlib.axes.Axes.plot`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    frame = "observed"
    if rest_frame:
        frame = "rest"
    fnu = np.where(np.asarray(fnu) > 0.0, fnu, np.nan)
    ax.loglog(wave, fnu, **kwargs)
    plain_log_ticks(ax.xaxis, ax.yaxis)
    ax.set(xlabel=f"{frame} wavelength (µm)", ylabel=label_y)
    return ax
