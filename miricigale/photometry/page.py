"""The page of forced photometry: images, magnitudes, flags, errors at empty positions."""

from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.stats import mad_std

from miricigale.pages import Missing, Page, SectionWriter
from miricigale.photometry import ForcedFlags
from miricigale.photometry.arrays import pixel_scale
from miricigale.plotting.axes import new_figure
from miricigale.plotting.images import plot_image, plot_model_residual, plot_segmentation
from miricigale.plotting.posteriors import plot_pulls
from miricigale.utils.declared import declared
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
    sources = " on the prior ".join(Path(one.meta["source"]).name for one in (image, highres))
    page = SectionWriter(
        Page(f"Forced photometry: {filter_}", subtitle=sources), declared("miricigale.photometry")
    )
    _notices(page, result, image, highres, kernel, pulls)
    _summary(page, result, pulls)
    page.section("images")
    page.figure("whole", _whole(result))
    for k, what in _examples(result):
        facts = {"id": result.id[k], "snr": result.snr[k], "chi2": result.chi2[k]}
        page.figure("source", _zoom(result, highres, segments, k), what=what, **facts)
    page.section("magnitudes")
    page.figure("figure", _magnitudes(result, filter_))
    if pulls is not None:
        page.section("pulls")
        figure, axes = new_figure(1, 1, size=(5.6, 3.4))
        plot_pulls(pulls, ax=axes[0, 0], limit=6.0).set_xlabel("flux / error")
        page.figure("figure", figure, n=len(pulls))
    _flag_table(page, result)
    _source_table(page, result)
    _input_table(page, image, highres, kernel)
    return page.report


def _notices(page, result, image, highres, kernel, pulls):
    if kernel.target is None:
        page.notice("no_psfs")
    bright = np.nan_to_num(result.snr) > _BRIGHT
    poor = bright & (result.flags & int(ForcedFlags.POOR_FIT) != 0)
    n, n_poor = np.count_nonzero(bright), np.count_nonzero(poor)
    if n >= 5 and n_poor > 0.5 * n:
        page.notice("poor", n_poor=n_poor, n=n, bright=_BRIGHT)
    for what, one in (("image", image), ("prior", highres)):
        scale = one.meta.get("noise_scale")
        if one.meta.get("n_filled"):
            page.notice("filled", n=one.meta["n_filled"], what=what)
        if one.uncertainty is None:
            page.notice("no_noise", what=what)
        elif scale is not None and not 0.1 < scale < 10:
            done = "were scaled by it" if "weight_scale" in one.meta else "were kept"
            page.notice("noise", what=what, scale=scale, done=done)
    level, rms = highres.meta.get("sky_over_noise", 0.0), _pulls_rms(pulls)
    if abs(level) > 1:
        page.notice("sky", level=level)
    if pulls is not None and len(pulls) >= 100 and not 0.8 < rms < 1.25:
        page.notice("pulls", rms=rms)


def _pulls_rms(pulls):
    values = [] if pulls is None else pulls[np.isfinite(pulls)]
    return float(mad_std(values)) if len(values) else np.nan


def _summary(page, result, pulls):
    good = np.isfinite(result.flux.value)
    errors = result.flux_err[good & (result.flags == 0)]
    values = {
        "n": len(result),
        "n_measured": np.count_nonzero(good),
        "n_detected": np.count_nonzero(good & (result.snr > 5)),
        "depth": (5 * np.median(errors)).to_value(u.ABmag) if len(errors) else np.nan,
        "rms": _pulls_rms(pulls),
    }
    if result.background is not None:
        background, error = result.background.value, result.background_err.value
        values["background"] = f"{background:.3g} ± {error:.1g}"
    if "offset" in result.meta:
        both = zip(result.meta["offset"], result.meta["offset_err"], strict=True)
        values["offset"] = ", ".join(f"{x:+.3f} ± {error:.3f}" for x, error in both)
    if result.shift is not None:
        values["shift"] = ", ".join(f"{one:.3f}" for one in result.shift.value)
    page.section("summary")
    page.items(values)


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
    """Sources to be shown, and why: the best without flags, and the worst fit."""
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
    return [(int(k), what) for what, k in chosen.items()]


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
    page.section("flags")
    counts = [("none", "", "usable", np.count_nonzero(result.flags == 0))]
    for value, (name, meaning) in ForcedFlags.meanings().items():
        count = np.count_nonzero(result.flags & value)
        lost = value in (ForcedFlags.NO_DATA, ForcedFlags.DEGENERATE)
        counts.append((f"{value} {name}", meaning, "not measured" if lost else "usable", count))
    crowded = np.count_nonzero(result.crowded)
    counts.append(("crowded", page.sentence("crowded"), "usable", crowded))
    header = ("flag", "meaning", "flux", "sources")
    page.table("table", (dict(zip(header, row, strict=True)) for row in counts))


def _source_table(page, result):
    order = np.argsort(np.nan_to_num(-result.flux.value, nan=np.inf), kind="stable")[:_ROWS]
    page.section("sources", n=len(order), n_all=len(result))
    table = result.to_table()[order]
    table["mag"] = ab_magnitude(result.flux)[order]
    rows = []
    for one in table:
        row = {name: getattr(one[name], "value", one[name]) for name in table.colnames}
        flags = ", ".join(ForcedFlags.names(row["flags"])).replace("_", " ") or "none"
        position = {"ra": f"{one['sky'].ra.deg:.5f}", "dec": f"{one['sky'].dec.deg:.5f}"}
        rows.append(row | {"flags": flags, **position})
    page.table("table", rows)


def _input_table(page, image, highres, kernel):
    page.section("inputs")
    psfs, facts = kernel.meta.get("psfs", {}), {}
    for what, one, psf in (("image", image, "psf"), ("prior", highres, "highres_psf")):
        facts[what] = {**one.meta, **{f"psf_{key}": v for key, v in psfs.get(psf, {}).items()}}
        facts[what]["pixels"] = f"{one.data.shape[1]} x {one.data.shape[0]}"
        facts[what]["pixel_scale"] = f"{pixel_scale(one.wcs):.4f}"
    page.table(
        "table",
        [
            {"fact": label, **{what: _text(known.get(key)) for what, known in facts.items()}}
            for key, label in page.texts["inputs"]["facts"].items()
        ],
    )
    page.text(
        "kernel",
        size=kernel.array.shape[0],
        scale=kernel.pixel_scale.value,
        sum=kernel.array.sum(),
        gain=kernel.noise_gain,
        origin=kernel.meta.get("file", "made from two PSFs"),
    )


def _text(value):
    if value is None:
        return Missing("not stated or not done")
    return f"{value:.5g}" if isinstance(value, float) else value
