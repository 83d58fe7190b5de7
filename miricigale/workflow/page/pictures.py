"""Pictures of the report, from images: the field, and what the model leaves of it."""

import astropy.units as u
import numpy as np
from astropy.nddata import block_reduce
from astropy.wcs.utils import proj_plane_pixel_scales

from miricigale.evaluation import sigma_mad
from miricigale.plotting.axes import MEASURED, SECOND, TRUE, WIDTH, legend, new_figure
from miricigale.plotting.images import mark_sky, plot_color, plot_image, plot_model_residual
from miricigale.psf.wiener import energy_error
from miricigale.workflow.page.labels import band_label

#: Error of the encircled energy (%) that counts as small.
_SMALL_ERROR = 4


def filled(image):
    """Values of an image with NaN where it is masked."""
    data = np.array(image.data, float)
    if image.mask is not None:
        data[np.asarray(image.mask, bool)] = np.nan
    return data


def _scale(image):
    """Size of a pixel in arcsec."""
    return float(proj_plane_pixel_scales(image.wcs)[0] * 3600)


def _directions(image):
    """Directions (x, y) of north and east at the middle of an image."""
    ny, nx = image.shape
    middle = image.wcs.pixel_to_world((nx - 1) / 2, (ny - 1) / 2)
    found = {}
    for name, angle in (("north", 0), ("east", 90)):
        there = image.wcs.world_to_pixel(middle.directional_offset_by(angle * u.deg, 1 * u.arcsec))
        found[name] = (float(there[0]) - (nx - 1) / 2, float(there[1]) - (ny - 1) / 2)
    return found


def field_figure(images, prior, names):
    """
    The field: the high-resolution image and a color image of three bands, or each band in gray.

    ``images`` are mosaics on one grid, the shortest wavelength first (other numbers than three are drawn
    in gray); ``names`` are their bands and that of the prior.
    """
    planes = [filled(image) for image in images]
    used = np.argwhere(np.any([np.isfinite(plane) for plane in planes], axis=0))
    (y0, x0), (y1, x1) = used.min(axis=0), used.max(axis=0) + 1
    planes = [plane[y0:y1, x0:x1] for plane in planes]
    # the same part of the sky on the prior's own pixels
    corners = images[0].wcs.pixel_to_world([x0 - 0.5, x1 - 0.5], [y0 - 0.5, y1 - 0.5])
    x, y = (np.round(v + 0.5).astype(int).clip(0) for v in prior.wcs.world_to_pixel(corners))
    factor = max(1, round(_scale(images[0]) / _scale(prior)))
    field = block_reduce(filled(prior)[y[0] : y[1], x[0] : x[1]], factor, np.mean)
    labels = [band_label(name) for name in names]
    color = len(planes) == 3
    n = 2 if color else 1 + len(planes)
    width = WIDTH / n
    bar = 0 if color else 0.8
    size = (width, (width - bar) * (y1 - y0) / (x1 - x0) + 0.4)
    figure, axes = new_figure(1, n, size=size)
    axes = axes.ravel()
    gray = {"colorbar": None if color else "MJy/sr"}
    scale = factor * _scale(prior)
    plot_image(field, ax=axes[0], pixel_scale=scale, title=f"{labels[-1]} (prior)", **gray)
    if color:
        parts = zip(("blue", "green", "red"), labels, strict=False)
        title = ", ".join(f"{label} {color}" for color, label in parts)
        # binned, to reduce the noise of single pixels in the color image
        planes = [block_reduce(plane, 2, np.mean) for plane in planes]
        plot_color(*planes[::-1], ax=axes[1], pixel_scale=2 * _scale(images[0]), title=title)
    else:
        for ax, plane, image, label in zip(axes[1:], planes, images, labels, strict=False):
            plot_image(plane, ax=ax, pixel_scale=_scale(image), title=label, **gray)
    for k, ax in enumerate(axes):
        mark_sky(ax, 20, **_directions(images[0]), color="white" if color and k else "black")
    return figure


def residual_figure(images, names, *, size=220):
    """
    Mosaic, model and residual of several bands, cut to the same crowded part of ``size`` pixels.

    ``images`` are pairs of mosaic and model, all on one grid.
    """
    panel = WIDTH / 3
    figure, axes = new_figure(len(images), 3, size=(panel, 0.8 * panel))
    # the model also covers pixels that were not exposed
    model = np.where(np.isfinite(filled(images[0][0])), filled(images[0][1]), 0.0)
    # the brightest part of the model, where deblending matters most
    rows, columns = np.arange(0, model.shape[0], 60), np.arange(0, model.shape[1], 60)
    light = np.sqrt(np.clip(model, 0, None))
    smooth = np.add.reduceat(np.add.reduceat(light, rows, axis=0), columns, axis=1)
    iy, ix = np.unravel_index(np.argmax(smooth), smooth.shape)
    y0 = int(np.clip(iy * 60 - size // 2 + 30, 0, max(0, model.shape[0] - size)))
    x0 = int(np.clip(ix * 60 - size // 2 + 30, 0, max(0, model.shape[1] - size)))
    part = (slice(y0, y0 + size), slice(x0, x0 + size))
    for row, (name, pair) in enumerate(zip(names, images, strict=True)):
        titles = ("mosaic", "model", "mosaic - model") if row == 0 else (None, None, None)
        image, model = (filled(plane)[part] for plane in pair)
        plot_model_residual(
            image,
            model,
            ax=axes[row],
            pixel_scale=_scale(pair[0]),
            titles=titles,
            unit="MJy/sr",
        )
        for ax in axes[row]:
            mark_sky(ax, 5, **_directions(pair[0]))
        axes[row, 0].set_ylabel(band_label(name))
    return figure


#: Most strips of a profile along an axis of an image.
_N_STRIPS = 24


def subtraction_figure(rate, cal, reducer):
    """
    An exposure before and after its background was subtracted, with profiles along both axes.

    ``rate`` and ``cal`` are the slopes and the calibrated image, ``reducer`` that of the run.
    """
    after = filled(cal)
    before = reducer.calibrate(rate)
    before = np.where(np.isfinite(after), filled(before), np.nan)
    # the part of the detector that sees the sky
    used = np.argwhere(np.isfinite(after))
    (y0, x0), (y1, x1) = used.min(axis=0), used.max(axis=0) + 1
    before, after = before[y0:y1, x0:x1], after[y0:y1, x0:x1]
    sources = after > 3 * sigma_mad(after[np.isfinite(after)])
    figure, axes = new_figure(1, 3, size=(3.5, 3.5), width_ratios=(1, 1, 0.85))
    last, scale = axes[0, 2], _scale(cal)
    for ax, title, image, color in (
        (axes[0, 0], "before", before, SECOND),
        (axes[0, 1], "after", after, MEASURED),
    ):
        options = {"pixel_scale": scale, "colorbar": "MJy/sr", "stretch": "linear"}
        plot_image(image, ax=ax, title=title, **options)
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
    """Medians of strips of an image across an axis (0: along x), and their middles in pixels."""
    size = image.shape[1 - axis]
    edges = np.unique(np.linspace(0, size, min(_N_STRIPS, size) + 1).astype(int))
    strips = np.split(image, edges[1:-1], axis=1 - axis)
    values = [np.nanmedian(s) if np.isfinite(s).any() else np.nan for s in strips]
    return 0.5 * (edges[1:] + edges[:-1]), np.array(values)


def convolution_figure(kernels):
    """
    Encircled energy of the prior's PSF minus that of each band, before and after convolution.

    ``kernels`` are `~miricigale.psf.MatchingKernel` with their PSFs, by band.
    """
    from matplotlib import colormaps

    reach = min(k.target.shape[0] // 2 * k.pixel_scale.to_value(u.arcsec) for k in kernels.values())
    radius = np.linspace(0.03, min(2.5, reach), 60)
    figure, axes = new_figure(1, 2, size=(5.25, 3.4), sharex=True)
    left, right = axes[0]
    most, steps = _SMALL_ERROR, np.linspace(0.0, 0.82, max(len(kernels), 2))
    for k, (name, kernel) in enumerate(kernels.items()):
        pixels = radius / kernel.pixel_scale.to_value(u.arcsec)
        before = 100 * energy_error(kernel.source, kernel.target, pixels)
        after = 100 * kernel.encircled_energy_error(radius * u.arcsec)
        style = {"color": colormaps["viridis"](steps[k]), "ls": ("-", "--")[k % 2], "lw": 1.6}
        left.plot(radius, before, label=band_label(name), **style)
        right.plot(radius, after, **style)
        most = max(most, np.nanmax(np.abs(after)))
    for ax, when in ((left, "before"), (right, "after")):
        ax.axhline(0, color=TRUE, lw=0.8)
        ax.set_title(f"{when} convolution", fontsize="medium")
        ax.set_xlabel("radius (arcsec)")
    right.axhspan(-_SMALL_ERROR, _SMALL_ERROR, color="0.92", zorder=0)
    right.set_ylim(-1.15 * most, 1.15 * most)
    left.set_ylabel("difference of encircled energy (%)")
    legend(left, ncols=2)
    return figure
