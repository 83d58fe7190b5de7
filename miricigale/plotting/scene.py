"""Images of scenes."""

import numpy as np

from miricigale.plotting.axes import resolve_axes
from miricigale.plotting.images import add_colorbar, asinh_norm


def plot_scene(image, *, ax=None, marks=None, label="", **kwargs):
    """
    Draw an image with an asinh stretch set by its own scatter.

    Parameters
    ----------
    image : `~numpy.ndarray`, shape (ny, nx)
        The image.
    ax : `~matplotlib.axes.Axes`, optional
        Where; the current axes by default.
    marks : tuple of `~numpy.ndarray`, optional
        Pixel positions x and y to be marked.
    label : str, optional
        Label of the color bar.
    **kwargs
        Passed to `~matplotlib.axes.Axes.imshow`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    low, middle, high = np.nanpercentile(image, [2, 50, 99.9])
    width = max(middle - low, 1e-3 * (high - low), np.finfo(float).tiny)
    options = {"origin": "lower", "cmap": "gray", "interpolation": "nearest"}
    if "norm" not in kwargs and not {"vmin", "vmax"} & set(kwargs):
        # about the median: a bright background does not hide the sources
        if abs(middle) > width:
            image = image - middle
            low = low - middle
            high = high - middle
            if label:
                label = f"{label} above a background of {middle:.3g}"
        options["norm"] = asinh_norm(low, max(high, width), width)
    drawn = ax.imshow(image, **{**options, **kwargs})
    ax.set(xlabel="x (pixel)", ylabel="y (pixel)")
    add_colorbar(drawn, label)
    if marks is not None:
        ax.plot(*marks, "o", mfc="none", mec="tab:orange", ms=5, mew=0.6)
    return ax
