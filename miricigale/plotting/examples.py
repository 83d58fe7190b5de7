"""Figures of single sources: a fit with its posteriors with and without bands, spectra by AGN fraction."""

import numpy as np

from miricigale.plotting.axes import MEASURED, SECOND, TRUE, WIDTH, legend, new_figure
from miricigale.plotting.posteriors import plot_pdf_2d
from miricigale.plotting.spectra import plot_spectrum

__all__ = ["fit_figure", "sequence_figure"]

_COLORS = (MEASURED, SECOND)
_LABELS = ("redshift", "fracAGN")


def fit_figure(draw_fit, posteriors, joint, *, truth):
    """
    Photometry with the best model and residuals, and 1-D and 2-D posteriors of two fits.

    Parameters
    ----------
    draw_fit : callable
        Draws photometry, best model and residuals on ``ax``, a pair of axes: such as
        `miricigale.fitting.FitResults.plot_sed` of an object.
    posteriors : dict of str to tuple
        By fit (with and without MIRI): for redshift and fracAGN, edges of cells and weights.
    joint : dict of str to array-like, shape (nx, ny)
        Joint weights of the cells of both, by fit.
    truth : tuple of float
        True values of the two.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH, 7.2), layout="constrained")
    grid = figure.add_gridspec(3, 4, height_ratios=(2.6, 0.9, 2.6))
    upper = figure.add_subplot(grid[0, :])
    lower = figure.add_subplot(grid[1, :], sharex=upper)
    draw_fit(ax=(upper, lower))
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    if upper.get_legend():
        low, high = upper.get_ylim()
        upper.set_ylim(low, high * (high / low) ** 0.3)
        legend(upper, loc="upper left", ncols=3)
    for k in range(2):
        ax = figure.add_subplot(grid[2, k])
        _overlaid(ax, {name: pair[k] for name, pair in posteriors.items()})
        ax.axvline(truth[k], ymax=0.6, color="0.2", ls=":", lw=1.4, label="truth")
        ax.set_xlabel(_LABELS[k])
        if k == 0:
            ax.set_ylabel("posterior density (peak 1)")
            legend(ax, loc="upper left")
    planes = []
    for k, (name, weights) in enumerate(joint.items()):
        ax = figure.add_subplot(grid[2, 2 + k])
        edges = [_value(pair[0]) for pair in posteriors[name]]
        style = {"labels": _LABELS, "truth": truth, "cmap": ("Oranges", "Blues")[k]}
        plot_pdf_2d(*edges, weights, ax=ax, **style)
        ax.set_title(name, fontsize="medium")
        planes.append(ax)
    # both planes alike, so that the areas can be compared
    (left, right), (bottom, top) = (
        (np.min(ends), np.max(ends))
        for ends in ([ax.get_xlim() for ax in planes], [ax.get_ylim() for ax in planes])
    )
    for ax in planes:
        ax.set(xlim=(left, right), ylim=(bottom, top))
    for ax in planes[1:]:
        ax.set_ylabel("")
    return figure


def _value(edges):
    return np.asarray(getattr(edges, "value", edges), float)


def _overlaid(ax, curves):
    """One-dimensional posteriors over each other, each with its peak at 1; the axis holds 99.8 % of each."""
    ends = []
    for k, (name, (edges, weights)) in enumerate(curves.items()):
        edges, weights = _value(edges), np.asarray(weights, float)
        width = np.diff(edges)
        density = np.divide(weights, width, out=np.zeros(width.size), where=width > 0)
        density = density / max(density.max(), 1e-300)
        color = _COLORS[k % 2]
        if k == 0:
            ax.stairs(density, edges, fill=True, alpha=0.2, color=color)
        ax.stairs(density, edges, color=color, lw=1.6, ls=("-", "--")[k % 2], label=name)
        total = np.cumsum(weights) / weights.sum()
        inside = np.flatnonzero((total > 1e-3) & (np.r_[0, total[:-1]] < 1 - 1e-3))
        ends.append((edges[inside[0]], edges[inside[-1] + 1]))
    low, high = np.min(ends), np.max(ends)
    margin = 0.06 * (high - low)
    ax.set(xlim=(low - margin, high + margin), ylim=(0, 1.75))


def sequence_figure(wave, spectra, *, bands=None, features=(), redshift=None):
    """
    Spectra of one source with AGN of several fractions, with bands and features marked.

    Parameters
    ----------
    wave : array-like, shape (n,)
        Observed wavelengths in um.
    spectra : dict of float to array-like, shape (n,)
        Flux densities in uJy by AGN fraction.
    bands : dict of str to tuple of float, optional
        First and last wavelength (um) of bands, drawn as gray bars at the bottom.
    features : iterable of float, optional
        Rest wavelengths in um to be marked; they need ``redshift``.
    redshift : float, optional
        Redshift of the source.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    from matplotlib import colormaps

    figure, axes = new_figure(size=(8.5, 4.4))
    ax = axes[0, 0]
    wave = np.asarray(wave, float)
    steps = np.linspace(0.0, 0.85, max(len(spectra), 2))
    for k, (fraction, flux) in enumerate(sorted(spectra.items())):
        color = colormaps["plasma"](steps[k])
        plot_spectrum(wave, flux, ax=ax, color=color, lw=1.6, label=f"fracAGN {fraction:g}")
    light = np.concatenate(list(spectra.values()))
    light = light[light > 0]
    top = light.max()
    bottom = max(light.min(), 1e-5 * top)
    span = np.log10(top / bottom)
    ax.set_xlim(wave.min(), wave.max())
    ax.set_ylim(bottom * 10 ** (-0.12 * span), top * 10 ** (0.1 * span))
    for k, (name, (first, last)) in enumerate((bands or {}).items()):
        y = bottom * 10 ** ((-0.08 + 0.05 * (k % 2)) * span)
        ax.plot([first, last], [y, y], color="0.55", lw=5, solid_capstyle="butt", zorder=0)
        above = {"xytext": (0, 5), "textcoords": "offset points"}
        ax.annotate(name, (np.sqrt(first * last), y), ha="center", fontsize=7, **above)
    for rest in features:
        place = rest * (1 + redshift)
        if wave.min() < place < wave.max():
            ax.axvline(place, color=TRUE, lw=0.7, ls=":")
            at_top = {"transform": ax.get_xaxis_transform(), "ha": "right", "va": "top"}
            ax.text(place, 0.98, f"{rest:g}", rotation=90, fontsize=7, color=TRUE, **at_top)
    title = "" if redshift is None else f"z = {redshift:g}"
    ax.set_title(title, fontsize="medium")
    legend(ax, loc="upper left")
    return figure
