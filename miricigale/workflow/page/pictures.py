"""Pictures of the report, from images: the field, and what the model leaves of it."""

import astropy.units as u
import numpy as np
from astropy.nddata import block_reduce
from astropy.wcs.utils import proj_plane_pixel_scales
from scipy.ndimage import uniform_filter

from miricigale.evaluation import sigma_mad
from miricigale.photometry import encircled_flux
from miricigale.plotting.axes import MEASURED, SECOND, TRUE, WIDTH, legend, new_figure
from miricigale.plotting.images import filled, mark_sky, plot_color, plot_image, plot_model_residual
from miricigale.psf import encircled_energy, radius_of_encircled_energy
from miricigale.psf.wiener import energy_error
from miricigale.utils.arrays import finite_values, middles, peak_index
from miricigale.utils.positions import middle_pixel
from miricigale.workflow.labels import band_title

#: Error of the encircled energy (%) that counts as small.
_SMALL_ERROR = 4


def _scale(image):
    """Return the size of a pixel in arcsec."""
    return float(proj_plane_pixel_scales(image.wcs)[0] * 3600)


def _directions(image):
    """Return directions (x, y) of north and east at the middle of an image."""
    middle_x, middle_y = middle_pixel(image.shape)
    middle = image.wcs.pixel_to_world(middle_x, middle_y)
    directions = {}
    for name, angle in (("north", 0), ("east", 90)):
        position = middle.directional_offset_by(angle * u.deg, 1 * u.arcsec)
        x, y = image.wcs.world_to_pixel(position)
        directions[name] = (float(x) - middle_x, float(y) - middle_y)
    return directions


def _exposed(planes):
    """Return rows and columns of the pixels with data in any of some planes, as a pair of slices."""
    pixels = np.argwhere(np.any([np.isfinite(plane) for plane in planes], axis=0))
    ends = zip(pixels.min(axis=0), pixels.max(axis=0) + 1, strict=True)
    return tuple(slice(*pair) for pair in ends)


def _binned(plane, scale):
    """Average a plane to pixels of about 0.2 arcsec, which have less noise; return it and their size in arcsec."""
    factor = max(1, round(0.2 / scale))
    return block_reduce(plane, factor, np.mean), factor * scale


#: Side of the squares that are shown larger, in arcsec.
_ZOOM = 10.0
#: S/N of a pixel beyond which it counts no more.
_BRIGHT = 5.0


def _zooms(planes, scale):
    """Return middles (arcsec from that of the planes) of the exposed squares with most light: four or none."""
    size = round(_ZOOM / scale)
    light = 0
    for plane in planes:
        snr = plane / sigma_mad(finite_values(plane))
        light = light + np.nan_to_num(np.clip(snr, 0, _BRIGHT), nan=-_BRIGHT)
    total = uniform_filter(light, size, mode="constant", cval=-_BRIGHT * len(planes))
    middles = []
    while total.max() > 0 and len(middles) < 4:
        y, x = peak_index(total)
        middles.append((scale * (x - 0.5 * total.shape[1]), scale * (y - 0.5 * total.shape[0])))
        # the next one does not overlap
        total[max(y - size, 0) : y + size, max(x - size, 0) : x + size] = 0
    return middles if len(middles) == 4 else []


def field_figure(images, prior, names):
    """
    Draw the field: the high-resolution image and color images of three bands each, or each band in gray.

    With squares in which much is seen enlarged. ``images`` are mosaics on one grid, the shortest wavelength first
    (one or two are drawn in gray); ``names`` are their bands and that of the prior.
    """
    from matplotlib.figure import Figure

    planes = [filled(image) for image in images]
    rows, columns = _exposed(planes)
    planes = [plane[rows, columns] for plane in planes]
    labels = [band_title(name) for name in names]
    height, width = planes[0].shape
    scale = _scale(images[0])
    is_color = len(planes) % 3 == 0
    zooms = []
    n = 1 + len(planes)
    # of the color bar
    margin = 0.8
    if is_color:
        zooms = _zooms(planes, scale)
        n = 1 + len(planes) // 3
        margin = 0.0
    panel = WIDTH / n
    sizes = [(panel - margin) * height / width + 0.4]
    across = 4 if n == 2 else 2
    if zooms:
        sizes.append(panel * len(zooms) / across**2)
    figure = Figure(figsize=(WIDTH, sum(sizes)), layout="constrained")
    grid = figure.add_gridspec(len(sizes), n, height_ratios=sizes)
    axes = [figure.add_subplot(grid[0, k]) for k in range(n)]
    colorbar = None if is_color else "MJy/sr"
    field, prior_scale = _same_part(prior, images[0], rows, columns)
    plot_image(
        field,
        ax=axes[0],
        pixel_scale=prior_scale,
        title=f"{labels[-1]} (prior)",
        colorbar=colorbar,
    )
    for k, ax in enumerate(axes[1:]):
        if is_color:
            three = slice(3 * k, 3 * k + 3)
            _draw_colors(ax, planes[three], labels[three], scale)
        else:
            plot_image(planes[k], ax=ax, pixel_scale=scale, title=labels[k], colorbar=colorbar)
    for k, ax in enumerate(axes):
        shade = "white" if is_color and k else "black"
        mark_sky(ax, 20, **_directions(images[0]), color=shade)
        ax.title.set_fontsize("medium")
        if zooms:
            # two rows of two, or one row of four below a wide panel
            places = grid[1, k].subgridspec(len(zooms) // across, across)
            for number, (place, middle) in enumerate(zip(places, zooms, strict=True), start=1):
                _draw_zoom(ax, figure.add_subplot(place), middle, number, shade)
    return figure


def _draw_colors(ax, planes, labels, scale):
    """Draw three bands as a color image, the shortest wavelength blue."""
    blue, size = _binned(planes[0], scale)
    green, _ = _binned(planes[1], scale)
    red, _ = _binned(planes[2], scale)
    title = f"{labels[0]} blue, {labels[1]} green, {labels[2]} red"
    plot_color(red, green, blue, ax=ax, pixel_scale=size, title=title)


def _same_part(prior, image, rows, columns):
    """Return the part of the prior that pixels of an image cover, averaged to these, and their size (arcsec)."""
    ends = [[part.start - 0.5, part.stop - 0.5] for part in (columns, rows)]
    x, y = prior.wcs.world_to_pixel(image.wcs.pixel_to_world(*ends))
    x = np.round(x + 0.5).astype(int).clip(0)
    y = np.round(y + 0.5).astype(int).clip(0)
    factor = max(1, round(_scale(image) / _scale(prior)))
    part = filled(prior)[y[0] : y[1], x[0] : x[1]]
    return block_reduce(part, factor, np.mean), factor * _scale(prior)


def _draw_zoom(ax, small, middle, number, shade):
    """Mark a square of a picture, and show it larger on other axes (``small``)."""
    from matplotlib.patches import Rectangle

    left_edge = middle[0] - _ZOOM / 2
    bottom = middle[1] - _ZOOM / 2
    top = bottom + _ZOOM
    ax.add_patch(Rectangle((left_edge, bottom), _ZOOM, _ZOOM, fc="none", ec=shade, lw=1))
    ax.text(left_edge + 1, top - 1, number, color=shade, fontsize=7, va="top")
    picture = ax.images[0]
    small.imshow(
        picture.get_array(),
        origin="lower",
        interpolation="nearest",
        norm=picture.norm,
        cmap=picture.cmap,
        extent=picture.get_extent(),
    )
    small.set(xlim=(left_edge, left_edge + _ZOOM), ylim=(bottom, top), xticks=[], yticks=[])
    small.text(left_edge + 0.5, top - 0.5, number, color=shade, fontsize=8, va="top")


def residual_figure(images, names, *, size=220):
    """
    Draw mosaic, model and residual of several bands, cut to the same crowded part of ``size`` pixels.

    ``images`` are pairs of mosaic and model, all on one grid; without a ``size`` the whole field is shown.
    """
    # the model also covers pixels that were not exposed
    first = filled(images[0][0])
    model = np.where(np.isfinite(first), filled(images[0][1]), 0.0)
    # the brightest part of the model, where deblending matters most
    light = uniform_filter(np.sqrt(np.clip(model, 0, None)), size or 1)
    middle = np.array(peak_index(light))
    if size is None:
        part = _exposed([first])
    else:
        start = np.clip(middle - size // 2, 0, np.maximum(np.array(model.shape) - size, 0))
        part = tuple(slice(a, a + size) for a in start)
    height, width = first[part].shape
    panel = WIDTH / 3
    figure, axes = new_figure(len(images), 3, size=(panel, 0.8 * panel * height / width))
    for row, (name, pair) in enumerate(zip(names, images, strict=True)):
        scale = _scale(pair[0])
        image = filled(pair[0])[part]
        model = np.where(np.isfinite(image), filled(pair[1])[part], np.nan)
        if size is None:
            model, _ = _binned(model, scale)
            image, scale = _binned(image, scale)
        titles = ("mosaic", "model", "mosaic - model") if row == 0 else (None, None, None)
        plot_model_residual(
            image, model, ax=axes[row], titles=titles, unit="MJy/sr", pixel_scale=scale
        )
        for ax in axes[row]:
            mark_sky(ax, 5 if size else 20, **_directions(pair[0]))
        axes[row, 0].set_ylabel(band_title(name))
    return figure


#: Most strips of a profile along an axis of an image.
_N_STRIPS = 24


def subtraction_figure(rate, cal, reducer):
    """
    Draw an exposure before and after its background was subtracted, with profiles along both axes.

    ``rate`` and ``cal`` are the slopes and the calibrated image, ``reducer`` that of the run.
    """
    after = filled(cal)
    before = reducer.calibrate(rate)
    before = np.where(np.isfinite(after), filled(before), np.nan)
    # the part of the detector that sees the sky
    part = _exposed([after])
    before = before[part]
    after = after[part]
    sources = after > 3 * sigma_mad(finite_values(after))
    figure, axes = new_figure(1, 3, size=(3.5, 3.5), width_ratios=(1, 1, 0.85))
    last = axes[0, 2]
    scale = _scale(cal)
    for ax, title, image, color in (
        (axes[0, 0], "before", before, SECOND),
        (axes[0, 1], "after", after, MEASURED),
    ):
        plot_image(
            image, ax=ax, title=title, pixel_scale=scale, colorbar="MJy/sr", stretch="linear"
        )
        sky = np.where(sources, np.nan, image)
        level = np.nanmedian(sky)
        number = f"{level:.0f}" if abs(level) >= 10 else f"{level:.2g}"
        for axis, style in ((0, "-"), (1, "--")):
            x, y = _profile(sky, axis)
            place = (x - 0.5 * image.shape[1 - axis]) * scale
            label = f"{title} ({number}), along {'xy'[axis]}"
            last.plot(place, y - level, style, color=color, lw=1.3, label=label)
    axes[0, 1].set_ylabel("")
    last.axhline(0, color=TRUE, lw=0.8)
    last.set(xlabel="position (arcsec)", ylabel="median of strips - that of all (MJy/sr)")
    low, high = last.get_ylim()
    # space for the legend
    last.set_ylim(low, high + 0.45 * (high - low))
    legend(last, fontsize=7, loc="upper left")
    return figure


def _profile(image, axis):
    """Return medians of strips of an image across an axis (0: along x), and their middles in pixels."""
    size = image.shape[1 - axis]
    edges = np.unique(np.linspace(0, size, min(_N_STRIPS, size) + 1).astype(int))
    medians = []
    for strip in np.split(image, edges[1:-1], axis=1 - axis):
        medians.append(np.nanmedian(strip) if np.isfinite(strip).any() else np.nan)
    return middles(edges), np.array(medians)


def convolution_figure(kernels):
    """
    Draw encircled energy of the prior's PSF minus that of each band, before and after convolution.

    ``kernels`` are `~miricigale.psf.MatchingKernel` with their PSFs, by band.
    """
    from matplotlib import colormaps

    reach = min(k.target.shape[0] // 2 * k.pixel_scale.to_value(u.arcsec) for k in kernels.values())
    radius = np.linspace(0.03, min(2.5, reach), 60)
    figure, [[left_ax, right_ax]] = new_figure(1, 2, size=(5.25, 3.4), sharex=True)
    largest = _SMALL_ERROR
    steps = np.linspace(0.0, 0.82, max(len(kernels), 2))
    for k, (name, kernel) in enumerate(kernels.items()):
        pixels = radius / kernel.pixel_scale.to_value(u.arcsec)
        before = 100 * energy_error(kernel.source, kernel.target, pixels)
        after = 100 * kernel.encircled_energy_error(radius * u.arcsec)
        style = {"color": colormaps["viridis"](steps[k]), "ls": ("-", "--")[k % 2], "lw": 1.6}
        left_ax.plot(radius, before, label=band_title(name), **style)
        right_ax.plot(radius, after, **style)
        largest = max(largest, np.nanmax(np.abs(after)))
    for ax, when in ((left_ax, "before"), (right_ax, "after")):
        ax.axhline(0, color=TRUE, lw=0.8)
        ax.set_title(f"{when} convolution", fontsize="medium")
        ax.set_xlabel("radius (arcsec)")
    right_ax.axhspan(-_SMALL_ERROR, _SMALL_ERROR, color="0.92", zorder=0)
    right_ax.set_ylim(-1.15 * largest, 1.15 * largest)
    left_ax.set_ylabel("difference of encircled energy (%)")
    legend(left_ax, ncols=2)
    return figure


def energy_figure(mosaics, points, psfs):
    """
    Draw bright point sources of some bands, and their encircled energy before and after scaling against the PSF's.

    By band: ``mosaics``, ``points`` (tables of the sources in the field, with ``f_scaling`` in their meta) and
    ``psfs`` of the mosaics.
    """
    radius = np.linspace(0.1, 2.5, 49) * u.arcsec
    figure, axes = new_figure(len(mosaics), 3, size=(WIDTH / 3, 4.2), width_ratios=(0.8, 1, 1))
    for row, (name, image) in zip(axes, mosaics.items(), strict=True):
        table = points[name]
        scale = _scale(image)
        data = filled(image)
        data, size = _binned(data[_exposed([data])], scale)
        plot_image(data, ax=row[0], pixel_scale=size, title=band_title(name))
        mark_sky(row[0], 20, **_directions(image))
        energy = encircled_energy(psfs[name], radius, pixel_scale=scale * u.arcsec)
        measured = encircled_flux(image, table["sky"], table["flux_true"], radius)
        median = measured["median"]
        x = radius.value
        factor = table.meta["f_scaling"]
        for label, values, color in (
            ("as it is", median, "black"),
            (f"times f_scaling ({factor:.4f})", factor * median, SECOND),
        ):
            row[1].plot(x, values, color=color, lw=1.4, label=label)
            row[2].plot(x, 100 * (values - energy), color=color, lw=1.4)
        row[1].plot(x, energy, color=MEASURED, lw=1.4, ls="--", label="PSF")
        low = 100 * (median - measured["scatter"] - energy)
        high = 100 * (median + measured["scatter"] - energy)
        row[2].fill_between(x, low, high, color="0.85", lw=0)
        row[2].axhline(0, color=MEASURED, lw=1.4, ls="--")
        for ax in row[1:]:
            ax.axvline(radius_of_encircled_energy(psfs[name], 0.8).value, color=MEASURED, ls="--")
            ax.set_xlabel("radius (arcsec)")
        row[1].set(ylim=(0, 1.03), ylabel="encircled energy")
        row[2].set_ylabel("minus that of the PSF (%)")
        legend(row[1], loc="lower right")
    return figure
