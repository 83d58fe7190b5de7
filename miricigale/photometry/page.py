"""The page of forced photometry: images, magnitudes, flags, errors at empty positions."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std

from miricigale.pages import Page, number
from miricigale.photometry import ForcedFlags
from miricigale.photometry.arrays import pixel_scale
from miricigale.plotting.axes import new_figure
from miricigale.plotting.images import plot_image, plot_model_residual, plot_segmentation
from miricigale.plotting.posteriors import plot_pulls
from miricigale.utils.units import ab_magnitude

#: Largest number of pixels across a drawing of a whole image, and rows of the table.
_ACROSS, _ROWS = 1500, 40
#: Signal-to-noise above which a poor fit points to a wrong PSF.
_BRIGHT = 20.0


def photometry_page(result, filter_, image, highres, kernel, pulls=None, segments=None):
    """
    Make the page (`~miricigale.pages.Page`) of one measurement in a filter.

    ``image`` and ``highres`` are what was measured and the prior, of
    `~miricigale.photometry.read_mosaic`, ``kernel`` is between them; ``pulls`` are flux over error at
    empty positions, and ``segments`` (int array) those of the prior, whose outlines are drawn.
    """
    good = np.isfinite(result.flux.value)
    snr = result.snr
    page = Page(
        f"Forced photometry: {filter_}",
        subtitle=" on the prior ".join(Path(one.meta["source"]).name for one in (image, highres)),
        notices=_notices(result, image, highres, kernel, pulls),
    )
    page.section("Summary")
    errors = result.flux_err[good & (result.flags == 0)]
    depth = np.nan if not len(errors) else (5 * np.median(errors)).to_value(u.ABmag)
    none, rms = "no source was measured without a flag", _pulls_rms(pulls)
    page.items(
        [
            ("sources of the prior", len(result)),
            ("measured", int(np.count_nonzero(good))),
            ("above 5 sigma", int(np.count_nonzero(good & (snr > 5)))),
            ("5 sigma of the median source without flags, AB", number(depth, ".2f", none)),
            ("pulls at empty positions, robust rms", number(rms, ".2f", "no empty positions")),
            *_fitted(result),
        ]
    )
    page.section(
        "Image, model and residual",
        "The residual is drawn from -5 to 5 times its own noise; pixels without data are white.",
    )
    page.figure(_whole(result), "The whole image.")
    for k, what in _examples(result):
        page.figure(_zoom(result, highres, segments, k), what)
    page.section("Magnitudes")
    page.figure(_magnitudes(result, filter_), "Measured sources by magnitude, and their errors.")
    if pulls is not None:
        page.section(
            "Errors at empty positions",
            "Point sources were fitted to the residual image where no source is: flux over error "
            "should scatter by 1 around 0.",
        )
        figure, axes = new_figure(1, 1, size=(5.6, 3.4))
        plot_pulls(pulls, ax=axes[0, 0], limit=6.0).set_xlabel("flux / error")
        page.figure(figure, f"{len(pulls)} positions and a Gaussian of width 1.")
    _flag_table(page, result)
    _source_table(page, result)
    _input_table(page, image, highres, kernel)
    return page


def _notices(result, image, highres, kernel, pulls):
    lines = []
    if kernel.target is None:
        lines.append(
            "The kernel has no PSFs: sources are their segments as they are, without wings, and those "
            "without a segment are not measured."
        )
    bright = np.nan_to_num(result.snr) > _BRIGHT
    poor = bright & (result.flags & int(ForcedFlags.POOR_FIT) != 0)
    n, n_poor = np.count_nonzero(bright), np.count_nonzero(poor)
    if n >= 5 and n_poor > 0.5 * n:
        lines.append(
            f"{n_poor} of the {n} sources above {_BRIGHT:g} sigma leave residuals above the noise: "
            "the PSFs or the shapes on the prior are not theirs to that precision."
        )
    for what, one in (("image", image), ("prior", highres)):
        scale = one.meta.get("noise_scale")
        if one.meta.get("n_filled"):
            lines.append(
                f"{one.meta['n_filled']} pixels of the {what} are in areas that are exactly 0: they "
                "were taken as without data."
            )
        if one.uncertainty is None:
            lines.append(f"The {what} has no map of the noise; it was measured on the image.")
        elif scale is not None and not 0.1 < scale < 10:
            done = "were scaled by it" if "weight_scale" in one.meta else "were kept"
            lines.append(
                f"The noise of the {what} is {scale:.4g} times what its map says; the errors {done}."
            )
    if abs(highres.meta.get("sky_over_noise", 0.0)) > 1:
        level = highres.meta["sky_over_noise"]
        lines.append(f"The prior has a sky of {level:.3g} times its noise, in the templates too.")
    rms = _pulls_rms(pulls)
    if pulls is not None and len(pulls) >= 100 and not 0.8 < rms < 1.25:
        lines.append(f"Pulls at empty positions scatter by {rms:.2f} instead of 1.")
    return lines


def _pulls_rms(pulls):
    values = [] if pulls is None else pulls[np.isfinite(pulls)]
    return float(mad_std(values)) if len(values) else np.nan


def _fitted(result):
    items = []
    if result.background is not None:
        value = f"{result.background.value:.3g} ± {result.background_err.value:.1g}"
        items.append(("background that was fitted, MJy/sr", value))
    if result.shift is not None:
        value = ", ".join(f"{one:.3f}" for one in result.shift.value)
        items.append(("shift of the image along x, y, arcsec", value))
    return items


def _whole(result):
    model = result.model_image.data
    step = max(1, -(-max(model.shape) // _ACROSS))
    data = result.residual_image.data + model
    scale = pixel_scale(result.model_image.wcs) * step
    ny, nx = model.shape
    _, axes = new_figure(1, 3, size=(3.5, max(1.8, min(5.0, 3.1 * ny / nx))))
    axes = plot_model_residual(
        data[::step, ::step], model[::step, ::step], ax=axes[0], pixel_scale=scale, unit="MJy/sr"
    )
    return axes[0].figure


def _examples(result):
    """Sources to be shown, with captions: the best without flags, and the worst fit."""
    snr = np.nan_to_num(result.snr, nan=-np.inf)
    good = np.isfinite(result.snr)
    clean = good & (result.flags == 0)
    chosen = {}
    if good.any():
        what = "the brightest without a flag" if clean.any() else "the brightest"
        chosen[what] = np.argmax(np.where(clean if clean.any() else good, snr, -np.inf))
    poor = good & (result.flags & int(ForcedFlags.POOR_FIT) != 0)
    if poor.any():
        chosen["the poorest fit"] = np.argmax(np.where(poor, result.chi2, -np.inf))
    for what, k in chosen.items():
        numbers = f"signal-to-noise {snr[k]:.0f}, chi2 {result.chi2[k]:.1f}"
        yield int(k), f"Around source {result.id[k]}, {what}: {numbers}."


def _zoom(result, highres, segments, k, size=12.0):
    """Prior, image, model and residual about a source."""
    model = result.model_image
    data = result.residual_image.data + model.data
    x, y = (float(one) for one in highres.wcs.world_to_pixel(result.sky[k]))
    fine, coarse = (pixel_scale(one.wcs) for one in (highres, model))
    cut, middle = _cutout(highres.data.shape, x, y, size / fine)
    _, axes = new_figure(1, 4, size=(2.9, 3.0))
    sharp = np.asarray(highres.data[cut], float)
    if highres.mask is not None:
        sharp = np.where(highres.mask[cut], np.nan, sharp)
    form = {"ax": axes[0, 0], "pixel_scale": fine, "title": "prior", "center": middle}
    if sharp.size and segments is not None:
        plot_segmentation(sharp, segments[cut], **form)
    elif sharp.size:
        plot_image(sharp, **form)
    cut, middle = _cutout(data.shape, float(result.x[k]), float(result.y[k]), size / coarse)
    plot_model_residual(
        data[cut], model.data[cut], ax=axes[0, 1:], pixel_scale=coarse, center=middle
    )
    axes[0, 1].set_ylabel("")
    return axes[0, 0].figure


def _cutout(shape, x, y, size):
    """Slices of a square of ``size`` pixels about a position, and the position in it."""
    half = max(8, round(size / 2))
    low = [min(max(0, round(p) - half), n) for p, n in zip((y, x), shape, strict=True)]
    high = [min(max(0, round(p) + half + 1), n) for p, n in zip((y, x), shape, strict=True)]
    return tuple(slice(*pair) for pair in zip(low, high, strict=True)), (x - low[1], y - low[0])


def _magnitudes(result, filter_):
    figure, axes = new_figure(1, 2, size=(5.2, 3.6))
    detected = result.snr > 3
    mag = ab_magnitude(result.flux)
    error = 1.0857 / np.where(detected, result.snr, np.nan)
    clean = detected & (result.flags == 0)
    ax = axes[0, 0]
    if detected.any():
        bins = np.arange(np.floor(np.nanmin(mag[detected])), np.nanmax(mag[detected]) + 0.5, 0.5)
        bins = bins if len(bins) > 1 else np.array([bins[0], bins[0] + 0.5])
        ax.hist(mag[detected], bins, color="0.75", label="above 3 sigma")
        ax.hist(mag[clean], bins, histtype="step", color="#1d4ed8", label="of these, no flag")
        ax.legend(frameon=False)
    ax.set(xlabel=f"{filter_} (AB)", ylabel="sources")
    ax = axes[0, 1]
    for rows, marker, color, label in (
        (detected & ~clean, "x", "#c2410c", "flagged"),
        (clean, ".", "#1d4ed8", "no flag"),
    ):
        ax.plot(mag[rows], error[rows], marker, color=color, ms=5, label=label)
    ax.axhline(1.0857 / 5, color="0.5", lw=0.8, ls="--", label="5 sigma")
    ax.set(xlabel=f"{filter_} (AB)", ylabel="error (mag)", yscale="log")
    ax.legend(frameon=False)
    return figure


def _flag_table(page, result):
    page.section("Flags", "Nothing is dropped: a source may have several flags, or none.")
    rows = [("none", "", "usable", int(np.count_nonzero(result.flags == 0)))]
    for value, (name, meaning) in ForcedFlags.meanings().items():
        count = int(np.count_nonzero(result.flags & value))
        lost = value in (ForcedFlags.NO_DATA, ForcedFlags.DEGENERATE)
        rows.append((f"{value} {name}", meaning, "not measured" if lost else "usable", count))
    crowded = "a neighbor within 2 arcsec brighter than the magnitude + 1 (a column of its own)"
    rows.append(("crowded", crowded, "usable", int(np.count_nonzero(result.crowded))))
    page.table(rows, header=("flag", "meaning", "flux", "sources"), text=3)


def _source_table(page, result):
    order = np.argsort(np.nan_to_num(-result.flux.value, nan=np.inf), kind="stable")[:_ROWS]
    text = f"The {len(order)} brightest of {len(result)}; all are in the table that was written. "
    text += "Residual is what the fit left in the core over what it took there."
    page.section("Brightest sources", text)
    shown = result.to_table()[order]
    shown["AB"] = ab_magnitude(result.flux)[order]
    page.entries(shown, _SOURCE_COLUMNS, text=3, empty="The catalog has no source.")


#: Columns of the table of sources.
_LOST = "not measured"
_SOURCE_COLUMNS = {
    "id": lambda row: str(row["id"]),
    "flags": lambda row: ", ".join(ForcedFlags.names(row["flags"])).replace("_", " ") or "none",
    "template": lambda row: str(row["template"]),
    "RA": lambda row: f"{row['sky'].ra.deg:.5f}",
    "Dec": lambda row: f"{row['sky'].dec.deg:.5f}",
    "flux (uJy)": lambda row: number(row["flux"].value, ".4g", _LOST),
    "error": lambda row: number(row["flux_err"].value, ".2g", _LOST),
    "AB": ("AB", ".2f", "no positive flux"),
    "S/N": ("snr", ".1f", _LOST),
    "chi2": ("chi2", ".2f", _LOST),
    "residual": ("residual_fraction", "+.2f", _LOST),
}


def _input_table(page, image, highres, kernel):
    page.section("What was read")
    none, psfs = "not stated or not done", kernel.meta.get("psfs", {})
    cells = []
    for one, psf in ((image, "psf"), (highres, "highres_psf")):
        facts = {**one.meta, **{f"psf_{key}": text for key, text in psfs.get(psf, {}).items()}}
        facts["pixels"] = f"{one.data.shape[1]} x {one.data.shape[0]}"
        facts["pixel_scale"] = f"{pixel_scale(one.wcs):.4f}"
        cells.append([_text(facts.get(key), none) for key in _FACTS])
    page.table(zip(_FACTS.values(), *cells, strict=True), header=("", "image", "prior"), text=3)
    origin = kernel.meta.get("file", "made from two PSFs")
    page.text(
        f"Kernel: {kernel.array.shape[0]} x {kernel.array.shape[0]} pixels of "
        f"{kernel.pixel_scale.value:.4g} arcsec, sum {kernel.array.sum():.4f}, noise gain "
        f"{kernel.noise_gain:.3f}, {origin}."
    )


def _text(value, reason):
    if value is None:
        return number(None, "", reason)
    return f"{value:.5g}" if isinstance(value, float) else value


#: What is shown of the files that were read.
_FACTS = {
    "source": "file",
    "filter": "filter",
    "source_unit": "unit of the pixels",
    "calibration": "calibration",
    "noise": "noise",
    "noise_scale": "noise on the sky over that of the map",
    "weight_scale": "factor on the errors of the weights",
    "sky_over_noise": "median sky over noise",
    "background_box": "box of the background that was subtracted (pixels)",
    "pa_aper": "PA_APER (deg)",
    "n_masked": "pixels without data",
    "pixels": "pixels",
    "pixel_scale": "pixel (arcsec)",
    "psf_from": "PSF",
    "psf_fwhm": "FWHM of the PSF (arcsec)",
    "psf_enclosed": "light on the grid of the PSF",
}
