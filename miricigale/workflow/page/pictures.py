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
from miricigale.workflow.labels import band_title

#: Error of the encircled energy (%) that counts as small.
_SMALL_ERROR = 4


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


def _used(planes):
    """Rows and columns of the pixels with data in any of some planes, as a pair of slices."""
    used = np.argwhere(np.any([np.isfinite(plane) for plane in planes], axis=0))
    return tuple(slice(a, b) for a, b in zip(used.min(axis=0), used.max(axis=0) + 1, strict=True))


def _binned(plane, scale):
    """A plane averaged to pixels of about 0.2 arcsec, which have less noise, and their size in arcsec."""
    factor = max(1, round(0.2 / scale))
    return block_reduce(plane, factor, np.mean), factor * scale


#: Side of the squares that are shown larger, in arcsec, and S/N of a pixel beyond which it counts no more.
_ZOOM, _BRIGHT = 10.0, 5.0


def _zooms(planes, scale):
    """Middles, in arcsec from that of the planes, of the exposed squares in which most is seen, four at most."""
    size = round(_ZOOM / scale)
    planes = [plane / sigma_mad(plane[np.isfinite(plane)]) for plane in planes]
    light = sum(np.nan_to_num(np.clip(p, 0, _BRIGHT), nan=-_BRIGHT) for p in planes)
    seen = uniform_filter(light, size, mode="constant", cval=-_BRIGHT * len(planes))
    found = []
    while seen.max() > 0 and len(found) < 4:
        y, x = np.unravel_index(np.argmax(seen), seen.shape)
        found.append((scale * (x - 0.5 * seen.shape[1]), scale * (y - 0.5 * seen.shape[0])))
        # the next one does not overlap
        seen[max(y - size, 0) : y + size, max(x - size, 0) : x + size] = 0
    return found if len(found) == 4 else []


def field_figure(images, prior, names):
    """
    The field: the high-resolution image and color images of three bands each, or each band in gray.

    With squares in which much is seen enlarged. ``images`` are mosaics on one grid, the shortest wavelength first
    (one or two are drawn in gray); ``names`` are their bands and that of the prior.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Rectangle

    planes, labels = [filled(image) for image in images], [band_title(name) for name in names]
    rows, columns = _used(planes)
    planes = [plane[rows, columns] for plane in planes]
    (height, width), scale = planes[0].shape, _scale(images[0])
    # the same part of the sky on the prior's own pixels
    ends = [[part.start - 0.5, part.stop - 0.5] for part in (columns, rows)]
    x, y = prior.wcs.world_to_pixel(images[0].wcs.pixel_to_world(*ends))
    x, y = (np.round(v + 0.5).astype(int).clip(0) for v in (x, y))
    factor = max(1, round(scale / _scale(prior)))
    field = block_reduce(filled(prior)[y[0] : y[1], x[0] : x[1]], factor, np.mean)
    color = len(planes) % 3 == 0
    n = 1 + (len(planes) // 3 if color else len(planes))
    zooms = _zooms(planes, scale) if color else []
    across, panel = (4 if n == 2 else 2), WIDTH / n
    sizes = [(panel - (0 if color else 0.8)) * height / width + 0.4]
    sizes += [panel * len(zooms) / across**2] if zooms else []
    figure = Figure(figsize=(WIDTH, sum(sizes)), layout="constrained")
    grid = figure.add_gridspec(len(sizes), n, height_ratios=sizes)
    axes = [figure.add_subplot(grid[0, k]) for k in range(n)]
    gray = {"colorbar": None if color else "MJy/sr"}
    options = {"pixel_scale": factor * _scale(prior), "title": f"{labels[-1]} (prior)"}
    plot_image(field, ax=axes[0], **options, **gray)
    for k, ax in enumerate(axes[1:]):
        if color:
            three = zip(("blue", "green", "red"), labels[3 * k : 3 * k + 3], strict=True)
            title = ", ".join(f"{label} {color}" for color, label in three)
            binned = [_binned(plane, scale) for plane in planes[3 * k : 3 * k + 3]]
            colors = (plane for plane, _ in reversed(binned))
            plot_color(*colors, ax=ax, pixel_scale=binned[0][1], title=title)
        else:
            plot_image(planes[k], ax=ax, pixel_scale=scale, title=labels[k], **gray)
    for k, ax in enumerate(axes):
        shade = "white" if color and k else "black"
        mark_sky(ax, 20, **_directions(images[0]), color=shade)
        ax.title.set_fontsize("medium")
        places = grid[1, k].subgridspec(len(zooms) // across, across) if zooms else ()
        for number, (place, (x, y)) in enumerate(zip(places, zooms, strict=True), start=1):
            left, bottom = x - _ZOOM / 2, y - _ZOOM / 2
            ax.add_patch(Rectangle((left, bottom), _ZOOM, _ZOOM, fc="none", ec=shade, lw=1))
            ax.text(left + 1, bottom + _ZOOM - 1, number, color=shade, fontsize=7, va="top")
            small, drawn = figure.add_subplot(place), ax.images[0]
            style = {"norm": drawn.norm, "cmap": drawn.cmap, "extent": drawn.get_extent()}
            small.imshow(drawn.get_array(), origin="lower", interpolation="nearest", **style)
            ends = {"xlim": (left, left + _ZOOM), "ylim": (bottom, bottom + _ZOOM)}
            small.set(**ends, xticks=[], yticks=[])
            small.text(left + 0.5, bottom + _ZOOM - 0.5, number, color=shade, fontsize=8, va="top")
    return figure


def residual_figure(images, names, *, size=220):
    """
    Mosaic, model and residual of several bands, cut to the same crowded part of ``size`` pixels.

    ``images`` are pairs of mosaic and model, all on one grid; without a ``size`` the whole field is shown.
    """
    # the model also covers pixels that were not exposed
    first = filled(images[0][0])
    model = np.where(np.isfinite(first), filled(images[0][1]), 0.0)
    # the brightest part of the model, where deblending matters most
    light = uniform_filter(np.sqrt(np.clip(model, 0, None)), size or 1)
    middle = np.array(np.unravel_index(np.argmax(light), light.shape))
    if size is None:
        part = _used([first])
    else:
        start = np.clip(middle - size // 2, 0, np.maximum(np.array(model.shape) - size, 0))
        part = tuple(slice(a, a + size) for a in start)
    height, width = first[part].shape
    panel = WIDTH / 3
    figure, axes = new_figure(len(images), 3, size=(panel, 0.8 * panel * height / width))
    for row, (name, pair) in enumerate(zip(names, images, strict=True)):
        titles = ("mosaic", "model", "mosaic - model") if row == 0 else (None, None, None)
        (image, model), scale = (filled(plane)[part] for plane in pair), _scale(pair[0])
        model = np.where(np.isfinite(image), model, np.nan)
        if size is None:
            (image, _), (model, scale) = _binned(image, scale), _binned(model, scale)
        options = {"titles": titles, "unit": "MJy/sr", "pixel_scale": scale}
        plot_model_residual(image, model, ax=axes[row], **options)
        for ax in axes[row]:
            mark_sky(ax, 5 if size else 20, **_directions(pair[0]))
        axes[row, 0].set_ylabel(band_title(name))
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
    part = _used([after])
    before, after = before[part], after[part]
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
    figure, [[left, right]] = new_figure(1, 2, size=(5.25, 3.4), sharex=True)
    most, steps = _SMALL_ERROR, np.linspace(0.0, 0.82, max(len(kernels), 2))
    for k, (name, kernel) in enumerate(kernels.items()):
        pixels = radius / kernel.pixel_scale.to_value(u.arcsec)
        before = 100 * energy_error(kernel.source, kernel.target, pixels)
        after = 100 * kernel.encircled_energy_error(radius * u.arcsec)
        style = {"color": colormaps["viridis"](steps[k]), "ls": ("-", "--")[k % 2], "lw": 1.6}
        left.plot(radius, before, label=band_title(name), **style)
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


def energy_figure(mosaics, points, psfs):
    """
    Bright point sources of some bands, and their encircled energy before and after scaling against the PSF's.

    By band: ``mosaics``, ``points`` (tables of the sources in the field, with ``f_scaling`` in their meta) and
    ``psfs`` of the mosaics.
    """
    radius = np.linspace(0.1, 2.5, 49) * u.arcsec
    figure, axes = new_figure(len(mosaics), 3, size=(WIDTH / 3, 4.2), width_ratios=(0.8, 1, 1))
    for row, (name, image) in zip(axes, mosaics.items(), strict=True):
        table, scale = points[name], _scale(image)
        found = encircled_flux(image, table["sky"], table["flux_true"], radius)
        own = encircled_energy(psfs[name], radius, pixel_scale=scale * u.arcsec)
        data = filled(image)
        data, size = _binned(data[_used([data])], scale)
        plot_image(data, ax=row[0], pixel_scale=size, title=band_title(name))
        mark_sky(row[0], 20, **_directions(image))
        factor, x = table.meta["f_scaling"], radius.value
        for label, values, color in (
            ("as it is", found["median"], "black"),
            (f"times f_scaling ({factor:.4f})", factor * found["median"], SECOND),
        ):
            row[1].plot(x, values, color=color, lw=1.4, label=label)
            row[2].plot(x, 100 * (values - own), color=color, lw=1.4)
        row[1].plot(x, own, color=MEASURED, lw=1.4, ls="--", label="PSF")
        ends = [100 * (found["median"] + k * found["scatter"] - own) for k in (-1, 1)]
        row[2].fill_between(x, *ends, color="0.85", lw=0)
        row[2].axhline(0, color=MEASURED, lw=1.4, ls="--")
        for ax in row[1:]:
            ax.axvline(radius_of_encircled_energy(psfs[name], 0.8).value, color=MEASURED, ls="--")
            ax.set_xlabel("radius (arcsec)")
        row[1].set(ylim=(0, 1.03), ylabel="encircled energy")
        row[2].set_ylabel("minus that of the PSF (%)")
        legend(row[1], loc="lower right")
    return figure
