"""Images: stretched, in color, with segments, and with model and residual."""

import numpy as np

from miricigale.plotting.axes import TRUE, AxesArray, add_borders, resolve_axes, row_mask
from miricigale.utils.arrays import finite_values
from miricigale.utils.options import check_choice, check_that

#: Color of lines over an image.
_LINES = "#c2410c"


def filled(image):
    """Return the values of an image (`~astropy.nddata.NDData`) with NaN where it is masked."""
    data = np.array(image.data, float)
    if image.mask is not None:
        data[np.asarray(image.mask, bool)] = np.nan
    return data


def _robust(image):
    """Return the median and robust standard deviation of the finite pixels, (0, 1) without any."""
    values = finite_values(image)
    if values.size == 0:
        return 0.0, 1.0
    middle = float(np.median(values))
    # the darker half knows little of sources
    low = values[values <= middle]
    sigma = 0.0
    if low.size:
        sigma = 1.4826 * float(np.median(middle - low))
    return middle, sigma if sigma > 0 else float(values.std()) or 1.0


def _limits(image):
    """Return the values of the ends of the colors: from two sigma below the median to what is bright."""
    middle, sigma = _robust(image)
    finite = finite_values(image)
    high = 1.0
    if finite.size:
        high = np.percentile(finite, 99.7)
    return middle - 2 * sigma, max(high, middle + 8 * sigma)


def asinh_places(values, low, high, softening):
    """
    Places of values between two limits on the one stretch of all images: asinh of the value over ``softening``.

    It is linear about 0, where the noise is, and logarithmic for what is bright. The stretch of
    `astropy.visualization.AsinhStretch` is linear about the lower limit instead, which is no value of the sky.

    Parameters
    ----------
    values : array_like
        Values of pixels.
    low, high, softening : float or array_like
        Limits, and the value at which the stretch turns over; they broadcast against the values.

    Returns
    -------
    places : `~numpy.ndarray`
        0 at the lower limit, 1 at the upper one.
    """
    start = np.arcsinh(np.divide(low, softening))
    stop = np.arcsinh(np.divide(high, softening))
    return (np.arcsinh(np.divide(values, softening)) - start) / (stop - start)


def asinh_norm(low, high, softening):
    """Return the stretch of `asinh_places` for matplotlib (`~matplotlib.colors.AsinhNorm`)."""
    from matplotlib.colors import AsinhNorm

    return AsinhNorm(softening, vmin=low, vmax=high)


def _extent(shape, pixel_scale, center):
    """Return the edges in arcsec, zero in the middle of the image or at a pixel."""
    ny, nx = shape
    if center is None:
        x = (nx - 1) / 2
        y = (ny - 1) / 2
    else:
        x, y = center
    return [edge * pixel_scale for edge in (-0.5 - x, nx - 0.5 - x, -0.5 - y, ny - 0.5 - y)]


def _draw(image, ax, pixel_scale, title, center, **colors):
    """Draw pixels on axes in arcsec."""
    extent = _extent(image.shape[:2], pixel_scale, center)
    ax.set(xlabel="x (arcsec)", ylabel="y (arcsec)", title=title)
    return ax.imshow(image, origin="lower", interpolation="nearest", extent=extent, **colors)


def add_colorbar(drawn, label):
    """
    Draw a color bar next to an image, whose ticks do not overlap.

    Parameters
    ----------
    drawn : `~matplotlib.image.AxesImage`
        The image on its axes.
    label : str
        Label of the bar.

    Returns
    -------
    bar : `~matplotlib.colorbar.Colorbar`
    """
    from matplotlib.colors import AsinhNorm

    # as high as the image, whatever its shape
    place = drawn.axes.inset_axes((1.03, 0.0, 0.05, 1.0))
    bar = drawn.axes.figure.colorbar(drawn, cax=place, label=label)
    if isinstance(drawn.norm, AsinhNorm):
        # from the bright end, as many as the bar has space for
        ticks = []
        for tick in drawn.norm.vmax * np.array([1.0, 0.2, 0.03, 0.0]):
            if not ticks or drawn.norm(ticks[-1]) - drawn.norm(tick) > 0.08:
                ticks.append(tick)
        bar.set_ticks(ticks, labels=[f"{float(f'{tick:.2g}'):g}" for tick in ticks])
        bar.minorticks_off()
    return bar


def plot_image(
    image,
    *,
    ax=None,
    pixel_scale=1.0,
    stretch="asinh",
    softening=None,
    limits=None,
    cmap="gray_r",
    title=None,
    colorbar=None,
    center=None,
):
    """
    Draw an image on axes in arcsec.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        NaN is left white.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    pixel_scale : float, optional
        Arcsec per pixel.
    stretch : {"asinh", "linear"}, optional
        How values become colors.
    softening : float, optional
        Value at which ``"asinh"`` turns over; twice the image's own noise by default.
    limits : (float, float), optional
        Values of the two ends of the colors; by default two sigma below the median, and
        the 99.7th percentile or eight sigma above it, whichever is higher.
    cmap : str, optional
        Colors.
    title : str, optional
        Title.
    colorbar : str, optional
        If given, a color bar with this label.
    center : (float, float), optional
        Pixel (x, y) of the origin of the axes; the middle by default.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    from matplotlib.colors import Normalize

    check_choice(stretch, "stretch", ("asinh", "linear"))
    ax = resolve_axes(ax)
    image = np.asarray(image, float)
    if limits is None:
        low, high = _limits(image)
    else:
        low, high = limits
    if stretch == "asinh":
        norm = asinh_norm(low, high, softening or 2 * _robust(image)[1])
    else:
        norm = Normalize(low, high)
    drawn = _draw(image, ax, pixel_scale, title, center, norm=norm, cmap=cmap)
    if colorbar is not None:
        add_colorbar(drawn, colorbar)
    return ax


def plot_model_residual(
    image,
    model,
    *,
    ax=None,
    limits=None,
    titles=("image", "model", "residual"),
    unit=None,
    **options,
):
    """
    Draw image, model and residual side by side with the same stretch.

    Parameters
    ----------
    image, model : array_like, shape (ny, nx)
        The residual is their difference.
    ax : sequence of three `~matplotlib.axes.Axes`, optional
        Axes to draw on; a new figure of pyplot by default.
    limits : (float, float), optional
        As in `plot_image`, those of the image by default. The residual is drawn from -5 to
        5 sigma of its own noise.
    titles : tuple of str, optional
        Titles.
    unit : str, optional
        Label of the color bars; none are drawn without it.
    **options
        ``pixel_scale`` and ``center``, as in `plot_image`.

    Returns
    -------
    ax : `~numpy.ndarray` of three `~matplotlib.axes.Axes`
    """
    if ax is None:
        import matplotlib.pyplot as plt

        _, ax = plt.subplots(1, 3, figsize=(10.0, 2.6), layout="constrained")
    ax = np.ravel(np.asarray(ax, dtype=object))
    check_that(len(ax) == 3, "ax", "three axes", len(ax))
    image = np.asarray(image, float)
    model = np.asarray(model, float)
    residual = image - model
    noise = _robust(residual)[1]
    # one turnover for both, or a noiseless model would be stretched beyond comparison
    light = {"limits": _limits(image) if limits is None else limits}
    light["softening"] = 2 * _robust(image)[1]
    dark = {"limits": (-5 * noise, 5 * noise), "stretch": "linear", "cmap": "RdBu_r"}
    planes = zip((image, model, residual), (light, light, dark), strict=True)
    for axes, title, (data, colors) in zip(ax, titles, planes, strict=True):
        plot_image(data, ax=axes, title=title, colorbar=unit, **colors, **options)
        if axes is not ax[0]:
            axes.set_ylabel("")
    return AxesArray(ax)


def plot_offsets(xy, offset, field, *, used=None, ax=None, title=None):
    """
    Draw offsets of sources over those of a smooth map, as arrows on a grid of pixels.

    Parameters
    ----------
    xy : array_like, shape (n, 2)
        Positions in pixels.
    offset : array_like, shape (n, 2)
        Measured offsets in arcsec.
    field : callable
        The map: takes x and y, returns offsets of shape (..., 2); its ``shape`` is the image's.
    used : bool array_like, shape (n,), optional
        Sources that count; others are drawn as crosses.
    ax : `~matplotlib.axes.Axes`, optional
        Axes to draw on.
    title : str, optional
        Title.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    xy = np.asarray(xy, float).reshape(-1, 2)
    offset = np.asarray(offset, float).reshape(-1, 2)
    is_used = row_mask(used, len(xy), True)
    ny, nx = field.shape
    step = max(nx, ny) / 12
    x, y = np.meshgrid(np.arange(step / 2, nx, step), np.arange(step / 2, ny, step))
    smooth = field(x, y)
    vectors = np.concatenate([offset[is_used], smooth.reshape(-1, 2)])
    sizes = np.hypot(vectors[:, 0], vectors[:, 1])
    unit = np.median(sizes) or 1.0
    # arrows of the typical offset are as long as the map's grid is wide
    options = {"angles": "xy", "scale_units": "xy", "scale": unit / step, "width": 0.004}
    ax.quiver(x, y, smooth[..., 0], smooth[..., 1], color="0.7", **options)
    x, y = xy[is_used].T
    dx, dy = offset[is_used].T
    arrows = ax.quiver(x, y, dx, dy, color=_LINES, **options)
    x, y = xy[~is_used].T
    ax.plot(x, y, "x", color=_LINES, ms=4)
    ax.quiverkey(arrows, 0.9, 1.03, unit, f"{1e3 * unit:.0f} mas", labelpos="W")
    ax.set(xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5), aspect="equal")
    ax.set(xlabel="x (pixels)", ylabel="y (pixels)", title=title)
    return ax


def color_image(red, green, blue):
    """
    Make a color image whose hues do not depend on brightness.

    Each image is divided by its own noise, so that the sky is gray.

    Parameters
    ----------
    red, green, blue : array_like, shape (ny, nx)
        Images on the same pixels. A pixel with NaN in one of them is black.

    Returns
    -------
    image : `~numpy.ndarray` of uint8, shape (ny, nx, 3)

    Raises
    ------
    ValueError
        If the shapes differ.

    References
    ----------
    Lupton et al. 2004, PASP 116, 133.
    """
    from astropy.visualization import make_lupton_rgb

    planes = [np.asarray(plane, float) for plane in (red, green, blue)]
    if len({plane.shape for plane in planes}) != 1:
        msg = f"'red', 'green', 'blue' must be of one shape, got {[p.shape for p in planes]}"
        raise ValueError(msg)
    pairs = zip(planes, map(_robust, planes), strict=True)
    scaled = [np.nan_to_num((p - middle) * (1 / s), nan=0.0) for p, (middle, s) in pairs]
    # stretch is in units of the noise
    image = make_lupton_rgb(*scaled, minimum=-1.0, stretch=4.0, Q=7.0)
    # a color of two bands would be a wrong one
    image[np.any(np.isnan(planes), axis=0)] = 0
    return image


def plot_color(red, green, blue, *, ax=None, pixel_scale=1.0, title=None):
    """
    Draw a color image on axes in arcsec.

    Parameters
    ----------
    red, green, blue
        As in `color_image`.
    ax, pixel_scale, title : optional
        As in `plot_image`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    _draw(color_image(red, green, blue), ax, pixel_scale, title, None)
    return ax


def mark_sky(ax, length, *, north=(0, 1), east=(-1, 0), color="black"):
    """
    Mark scale and directions on an image with axes in arcsec, instead of ticks.

    Parameters
    ----------
    ax : `~matplotlib.axes.Axes`
        Of `plot_image` or `plot_color`.
    length : float
        Length of the bar in arcsec.
    north, east : (float, float), optional
        Directions (x, y) of north and east on the image.
    color : str, optional
        Of bar, arrows and letters, which have a thin edge of the opposite shade.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    from matplotlib.colors import to_rgb
    from matplotlib.patheffects import withStroke

    edge = [withStroke(linewidth=2.5, foreground="black" if np.mean(to_rgb(color)) > 0.5 else "w")]
    x_min, x_max = ax.get_xlim()
    bottom, top = ax.get_ylim()
    width = x_max - x_min
    height = top - bottom
    x = x_min + 0.05 * width
    y = bottom + 0.045 * height
    style = {"color": color, "path_effects": edge}
    ax.plot([x, x + length], [y, y], lw=2, solid_capstyle="butt", **style)
    text = {"ha": "center", "va": "center", "fontsize": 8, **style}
    ax.text(x + length / 2, y + 0.03 * height, f'{length:g}"', **text)
    size = 0.09 * min(width, height)
    # space for both arrows, wherever they point
    origin = np.array([x_max - 0.05 * width - 1.2 * size, bottom + 0.045 * height + 0.3 * size])
    for direction, letter in ((north, "N"), (east, "E")):
        step = size * np.asarray(direction, float) / np.hypot(direction[0], direction[1])
        arrow = {"arrowstyle": "-|>", "color": color, "lw": 1.3, "shrinkA": 0, "shrinkB": 0}
        note = ax.annotate("", origin + step, origin, arrowprops=arrow)
        note.arrow_patch.set_path_effects(edge)
        x, y = origin + 1.35 * step
        ax.text(x, y, letter, **text)
    ax.set(xlim=(x_min, x_max), ylim=(bottom, top), xticks=[], yticks=[], xlabel="", ylabel="")
    return ax


def plot_footprint(ra, dec, *, ax=None, **kwargs):
    """
    Draw an outline on the sky, north up and east to the left.

    Parameters
    ----------
    ra, dec : `~numpy.ndarray`, shape (n,)
        Corners in deg.
    ax : `~matplotlib.axes.Axes`, optional
        Where; the current axes by default.
    **kwargs
        Passed to `matplotlib.axes.Axes.fill`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    # right ascensions on both sides of 0 h lie beside each other
    ax.fill((ra - ra[0] + 180) % 360 - 180 + ra[0], dec, **{"fc": "none", "ec": TRUE} | kwargs)
    ax.set(xlabel="right ascension [deg]", ylabel="declination [deg]")
    ax.set_aspect(1 / np.cos(np.radians(np.mean(dec))), adjustable="datalim")
    ax.xaxis.set_inverted(True)
    ax.ticklabel_format(useOffset=False)
    return ax


def plot_segmentation(image, labels, *, ax=None, pixel_scale=1.0, center=None, **kwargs):
    """
    Draw the outlines of segments over an image.

    Parameters
    ----------
    image : array_like, shape (ny, nx)
        The image.
    labels : int array_like, shape (ny, nx)
        Label of each pixel, 0 for none.
    ax, pixel_scale, center : optional
        As in `plot_image`.
    **kwargs
        Passed to `plot_image`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    image = np.asarray(image)
    labels = np.asarray(labels)
    check_that(
        image.shape == labels.shape, "labels", f"of the image's shape {image.shape}", labels.shape
    )
    ax = plot_image(image, ax=ax, pixel_scale=pixel_scale, center=center, **kwargs)
    x_min, _, bottom, _ = _extent(image.shape, pixel_scale, center)
    y, x = (np.arange(n + 1) * pixel_scale for n in image.shape)
    add_borders(ax, labels, x_min + x, bottom + y, colors=_LINES, linewidths=0.7)
    return ax
