"""Encircled energies, and ramps of a pixel."""

import numpy as np

from miricigale.plotting.axes import MEASURED, plain_text, resolve_axes


def plot_energies(radius, curves, *, ax=None, **kwargs):
    """
    Draw encircled energies.

    Parameters
    ----------
    radius : array-like, shape (n,)
        Radii in arcsec.
    curves : dict of str to array-like, shape (n,)
        Fraction of all light within the radius, by name.
    ax : `~matplotlib.axes.Axes`, optional
        Where; the current axes by default.
    **kwargs
        Passed to `matplotlib.axes.Axes.plot`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    for k, (name, values) in enumerate(curves.items()):
        # every third one is dashed: it may lie on the one before
        style = {"label": plain_text(name), "ls": ("-", "-", "--")[k % 3], "lw": 1.4}
        ax.plot(radius, values, **style | kwargs)
    ax.set(xlabel="radius [arcsec]", ylabel="encircled energy", ylim=(0, None))
    ax.legend(frameon=False)
    return ax


def plot_ramp(time, counts, flagged=None, *, ax=None, title=None, **kwargs):
    """
    Draw the counts of a pixel over time.

    Parameters
    ----------
    time : `~numpy.ndarray`, shape (n_group,)
        Seconds since the reset.
    counts : `~numpy.ndarray`, shape (n_int, n_group)
        Counts in DN; a line for each integration.
    flagged : `~numpy.ndarray` of bool, shape (n_int, n_group), optional
        Groups that are crossed.
    ax : `~matplotlib.axes.Axes`, optional
        Where; the current axes by default.
    title : str, optional
        Over the picture.
    **kwargs
        Passed to `matplotlib.axes.Axes.plot`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    ax.plot(time, counts.T, **{"marker": ".", "ms": 4, "lw": 0.8} | kwargs)
    if flagged is not None and np.any(flagged):
        at = np.broadcast_to(time, counts.shape)
        ax.plot(at[flagged], counts[flagged], "x", color=MEASURED, label="flagged")
        ax.legend(frameon=False)
    ax.set(xlabel="time since the reset [s]", ylabel="counts [DN]", title=title)
    return ax
