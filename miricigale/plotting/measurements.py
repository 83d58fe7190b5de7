"""Figures of images and photometry: background, light within radii, offsets by kind of source."""

import numpy as np

from miricigale.plotting.axes import (
    MEASURED,
    SECOND,
    TRUE,
    label_outer,
    legend,
    new_figure,
    panels,
    resolve_axes,
)
from miricigale.plotting.comparison import plot_offsets
from miricigale.plotting.images import plot_image

__all__ = [
    "background_figure",
    "encircled_energy_figure",
    "features_figure",
    "offsets_figure",
    "plot_energies",
    "plot_ramp",
]


#: Most strips of a profile along an axis of an image.
_N_STRIPS = 24


def background_figure(before, after, *, pixel_scale=1.0, unit="MJy/sr", mask=None):
    """
    An image before and after its background was subtracted, with profiles along both axes.

    Parameters
    ----------
    before, after : array-like, shape (ny, nx)
        The images; NaN is left white.
    pixel_scale : float, optional
        Arcsec per pixel.
    unit : str, optional
        Unit of the values.
    mask : array-like of bool, shape (ny, nx), optional
        Pixels of sources, which the profiles leave out.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = new_figure(1, 3, size=(3.5, 3.5), width_ratios=(1, 1, 0.85))
    last = axes[0, 2]
    options = {"pixel_scale": pixel_scale, "colorbar": unit, "stretch": "linear"}
    styles = {"before": (before, SECOND), "after": (after, MEASURED)}
    for ax, (title, (image, color)) in zip(axes[0], styles.items(), strict=False):
        image = np.asarray(image, float)
        plot_image(image, ax=ax, title=title, **options)
        sky = image if mask is None else np.where(np.asarray(mask, bool), np.nan, image)
        level = np.nanmedian(sky)
        number = f"{level:.0f}" if abs(level) >= 10 else f"{level:.2g}"
        for axis, style in ((0, "-"), (1, "--")):
            x, y = _profile(sky, axis)
            place = (x - 0.5 * image.shape[1 - axis]) * pixel_scale
            label = f"{title} ({number}), along {'xy'[axis]}"
            last.plot(place, y - level, style, color=color, lw=1.3, label=label)
    axes[0, 1].set_ylabel("")
    last.axhline(0, color=TRUE, lw=0.8)
    last.set(xlabel="position (arcsec)", ylabel=f"median of strips - that of all ({unit})")
    low, high = last.get_ylim()
    # space for the legend
    last.set_ylim(low, high + 0.45 * (high - low))
    legend(last, fontsize=7, loc="upper left")
    return figure


def _profile(image, axis):
    """Medians of strips of an image across an axis (0: along x), and their middles in pixels."""
    size = image.shape[1 - axis]
    edges = np.unique(np.linspace(0, size, min(_N_STRIPS, size) + 1).astype(int))
    strips = np.split(image, edges[1:-1], axis=1 - axis)
    values = [np.nanmedian(s) if np.isfinite(s).any() else np.nan for s in strips]
    return 0.5 * (edges[1:] + edges[:-1]), np.array(values)


def encircled_energy_figure(radius, before, after, *, limit=0.04):
    """
    Difference of encircled energy between the PSFs of two bands, before and after convolution.

    Parameters
    ----------
    radius : array-like, shape (n,)
        Radii in arcsec.
    before, after : dict of str to array-like, shape (n,)
        Encircled energy of the sharp PSF minus that of the wide one, as it is and convolved with the
        kernel, by band.
    limit : float, optional
        Half height of the gray area of the right panel.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    from matplotlib import colormaps

    figure, axes = new_figure(1, 2, size=(5.25, 3.4), sharex=True)
    steps = np.linspace(0.0, 0.82, max(len(before), 2))
    for ax, curves, when in zip(axes[0], (before, after), ("before", "after"), strict=True):
        for k, (name, values) in enumerate(curves.items()):
            style = {"color": colormaps["viridis"](steps[k]), "ls": ("-", "--")[k % 2]}
            ax.plot(radius, 100 * np.asarray(values, float), lw=1.6, label=name, **style)
        ax.axhline(0, color=TRUE, lw=0.8)
        ax.set_title(f"{when} convolution", fontsize="medium")
        ax.set_xlabel("radius (arcsec)")
    axes[0, 1].axhspan(-100 * limit, 100 * limit, color="0.92", zorder=0)
    axes[0, 0].set_ylabel("difference of encircled energy (%)")
    legend(axes[0, 0], ncols=2)
    reach = max([100 * limit, *(100 * np.nanmax(np.abs(v)) for v in after.values())])
    axes[0, 1].set_ylim(-1.15 * reach, 1.15 * reach)
    return figure


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
        ax.plot(
            radius, values, **{"label": name, "ls": ("-", "-", "--")[k % 3], "lw": 1.4} | kwargs
        )
    ax.set(xlabel="radius [arcsec]", ylabel="encircled energy", ylim=(0, None))
    ax.legend(frameon=False)
    return ax


def offsets_figure(groups, *, limit=1.0, marked=None):
    """
    Magnitude differences by kind of source, such as those of two photometries by Sersic index.

    Parameters
    ----------
    groups : dict of str to tuple of array-like, shape (n,)
        Magnitudes and differences by kind.
    limit : float, optional
        Half height of the axes.
    marked : dict of str to array-like of bool, shape (n,), optional
        Sources that get a circle, such as crowded ones, by kind.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(groups, height=3.1, sharex=True, sharey=True)
    for label, ax in axes.items():
        mag, offset = (np.asarray(v, float) for v in groups[label])
        good = np.isfinite(mag) & np.isfinite(offset)
        plot_offsets(mag[good], offset[good], ax=ax, limit=limit)
        ax.set_title(f"{label} ({np.count_nonzero(good)})", fontsize="medium")
        if marked is not None:
            rows = good & np.asarray(marked[label], bool)
            place = np.clip(offset[rows], -0.97 * limit, 0.97 * limit)
            ax.plot(mag[rows], place, "o", ms=6, mfc="none", mec="0.35", mew=0.7)
        if good.any():
            text = f"median {np.median(offset[good]):+.3f}"
            ax.text(0.96, 0.95, text, transform=ax.transAxes, ha="right", va="top", fontsize=8)
    label_outer(axes)
    return figure


def features_figure(values, ranges, *, limit=0.6):
    """
    Residuals of fits in each band against redshift, and where features are within the band.

    Parameters
    ----------
    values : dict of str to tuple of array-like, shape (n,)
        Redshifts and measured minus model magnitudes by band; NaN is left out.
    ranges : dict of str to dict of str to tuple of float
        By band and feature: redshifts between which it is within the band.
    limit : float, optional
        Half height of the axes; points beyond stand as triangles on the edge.

    Returns
    -------
    figure : `~matplotlib.figure.Figure`
    """
    figure, axes = panels(values, height=2.9, sharex=True, sharey=True)
    for k, (label, ax) in enumerate(axes.items()):
        z, residual = (np.asarray(v, float) for v in values[label])
        good = np.isfinite(z) & np.isfinite(residual)
        plot_offsets(z[good], residual[good], ax=ax, limit=limit)
        ax.set_title(label, fontsize="medium")
        for i, (name, (low, high)) in enumerate(ranges[label].items()):
            if high > low:
                color = (SECOND, "#15803d")[i % 2]
                ax.axvspan(low, high, color=color, alpha=0.12, lw=0, label=name)
                inside = good & (z >= low) & (z < high)
                if np.count_nonzero(inside) > 2:
                    ax.plot([low, high], [np.median(residual[inside])] * 2, color=color, lw=2)
        if k == 0:
            legend(ax, loc="upper right", ncols=2)
    label_outer(axes, "redshift", "measured - model (mag)")
    return figure


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
