"""Pages of forced photometry (images, flags, empty positions, sources one by one) and of errors of images."""

import collections
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import scipy.ndimage
from astropy.nddata import Cutout2D
from astropy.stats import mad_std
from astropy.table import QTable, Table

from miricigale.pages import Link, Missing, Page, SectionWriter
from miricigale.photometry import ForcedFlags
from miricigale.photometry.commands.browser import write_browser
from miricigale.photometry.fit.forced import ForcedPhotometer
from miricigale.photometry.images.arrays import pixel_scale
from miricigale.plotting.axes import new_figure, plain_text
from miricigale.plotting.images import (
    filled,
    plot_image,
    plot_model_residual,
    plot_segmentation,
)
from miricigale.plotting.posteriors import plot_pulls
from miricigale.psf.star_fit import TERMS
from miricigale.utils.arrays import finite_values, nans, thinning_step
from miricigale.utils.exceptions import PhotometryWarning
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import plain_rows, row_dicts
from miricigale.utils.units import ANGLE, ab_magnitude

#: Largest number of pixels across a drawing of a whole image, rows of a table, arcsec across a source.
_ACROSS = 1500
_ROWS = 40
_SIZE = 12.0
#: Largest number of empty positions at which errors are tested.
_EMPTY = 400
#: Number of stars that are drawn.
_STARS = 6
#: Signal-to-noise above which a poor fit points to a wrong PSF, and above which there is a magnitude.
_BRIGHT = 20.0
_DETECTED = 3.0


#: A band on the page: name, result, image, kernel, and pulls at empty positions (made by `write_page`).
Measured = collections.namedtuple("Measured", "name result image kernel pulls")

#: Chi-square over degrees of freedom above which stars are said to be unlike the PSF: 2 sigma in a usual pixel,
#: where 2 percent of the light are allowed for.
_UNLIKE = 4.0


def write_page(path, bands, highres, segments, confidence, seed):
    """
    Write the page of a measurement, and beside it the one of its sources.

    ``bands`` are what was measured (`Measured`), ``highres`` and ``segments`` (int array) the prior; upper limits
    are of the ``confidence``, and ``seed`` that of the empty positions.
    """
    # errors at empty places
    tested = []
    for band in bands:
        if band.pulls is None:
            band = band._replace(pulls=empty_pulls(band.result, band.kernel, seed))
        tested.append(band)
    bands = tested
    names = ", ".join(band.name for band in bands)
    files = ", ".join(Path(band.image.meta["source"]).name for band in bands)
    title = f"Forced photometry: {names}"
    has_prior = _has_prior(bands, highres)
    sources = "points at the positions of a catalog"
    if has_prior:
        sources = f"on the prior {Path(highres.meta['source']).name}"
    report = Page(title, subtitle=f"{files}, {sources}")
    page = SectionWriter(report, declared("miricigale.photometry"))
    page.facts = {"confidence": f"{100 * confidence:g}", "detected": f"{_DETECTED:g}"}
    # the page of single sources, to which this one links
    browser = write_browser(Path(path), title, bands, highres, confidence, _DETECTED)
    _notices(page, bands, highres)
    page.section("summary", browser=Link("one by one", browser))
    page.table("table", list(map(_summary, bands)))
    page.section("images")
    for band in bands:
        page.figure("whole", _whole_image(band.result), band=band.name)
    for band in bands:
        result = band.result
        for k, reason in _examples(result):
            facts = {"id": result.id[k], "snr": result.snr[k], "chi2": result.chi2[k]}
            figure = _zoom(result, highres, segments, k, "prior" if has_prior else "first image")
            page.figure("source", figure, what=reason, band=band.name, **facts)
    page.section("magnitudes")
    for band in bands:
        page.figure("figure", _magnitudes(band, confidence))
    tested = [band for band in bands if band.pulls is not None]
    if tested:
        page.section("pulls")
    for band in tested:
        figure, axes = new_figure(1, 1, size=(5.6, 3.4))
        plot_pulls(band.pulls, ax=axes[0, 0], limit=6.0).set_xlabel("flux / error")
        page.figure("figure", figure, n=len(band.pulls), band=band.name)
    joint = [band for band in bands if band.result.exposures is not None]
    if joint:
        page.section("exposures")
    for band in joint:
        page.table("table", _exposure_rows(band.result.exposures.table), band=band.name)
    shown = [band for band in bands if band.result.psf_stars is not None]
    if shown:
        page.section("stars")
    for band in shown:
        _stars(page, band.result.psf_stars, band.name)
    _flag_table(page, bands)
    page.section("sources", n=min(_ROWS, len(bands[0].result)), n_all=len(bands[0].result))
    for band in bands:
        page.table("table", _source_rows(band.result, confidence), band=band.name)
    _input_table(page, bands, highres)
    report.write(path, overwrite=True)


def _has_prior(bands, highres):
    """Whether there is a prior: where sources are points their first image stands in for it."""
    return all(highres is not band.image for band in bands)


def _notices(page, bands, highres):
    images = {}
    for band in bands:
        images[f"image ({band.name})"] = band.image
        result = band.result
        rms = _pulls_rms(band.pulls)
        if band.kernel.target is None:
            page.notice("no_psfs")
        # many poor fits of bright sources point to a wrong PSF
        bright = np.nan_to_num(result.snr) > _BRIGHT
        poor = bright & (result.flags & ForcedFlags.POOR_FIT != 0)
        n = np.count_nonzero(bright)
        n_poor = np.count_nonzero(poor)
        if n >= 5 and n_poor > 0.5 * n:
            page.notice("poor", n_poor=n_poor, n=n, bright=_BRIGHT, band=band.name)
        if band.pulls is not None and len(band.pulls) >= 100 and not 0.8 < rms < 1.25:
            page.notice("pulls", rms=rms, band=band.name)
        # sources that the prior lacks, but are not fitted
        evidence = result.meta.get("second_pass", {})
        if evidence.get("peaks") and not evidence["fitted"]:
            page.notice("unfitted", **evidence, band=band.name)
        offset = np.array(result.meta.get("offset", [0.0]))
        error = np.array(result.meta.get("offset_err", [0.0]))
        threshold = 0.1 * pixel_scale(result.residual_image.wcs)
        if result.shift is None and np.any((abs(offset) > threshold) & (abs(offset) > 3 * error)):
            page.notice("offset", offset=_pairs(result.meta), band=band.name)
    if _has_prior(bands, highres):
        images["prior"] = highres
    for name, image in images.items():
        scale = image.meta.get("noise_scale")
        if image.meta.get("n_filled"):
            page.notice("filled", n=image.meta["n_filled"], what=name)
        if image.uncertainty is None:
            page.notice("no_noise", what=name)
        elif scale is not None and not 0.1 < scale < 10:
            done = "were scaled by it" if "weight_scale" in image.meta else "were kept"
            page.notice("noise", what=name, scale=scale, done=done)
    level = highres.meta.get("sky_over_noise", 0.0)
    if abs(level) > 1:
        page.notice("sky", level=level)


def _exposure_rows(table):
    """Make rows of the table of exposures that were fitted together."""
    rows = []
    for row in plain_rows(table):
        offset = f"{row['offset_east']:+.3f}, {row['offset_north']:+.3f} ± {row['offset_err']:.3f}"
        sky = f"{row['sky']:.5g} ± {row['sky_err']:.1g}"
        rows.append(row | {"source": Path(row["source"]).name, "offset": offset, "level": sky})
    return rows


def _pairs(meta):
    """Write the offset of an image along x and y with its errors as text."""
    pairs = zip(meta["offset"], meta["offset_err"], strict=True)
    return ", ".join(f"{x:+.3f} ± {error:.3f}" for x, error in pairs)


def _pulls_rms(pulls):
    if pulls is None or not np.isfinite(pulls).any():
        return np.nan
    return float(mad_std(finite_values(pulls)))


def _summary(band):
    result = band.result
    good = np.isfinite(band.result.flux.value)
    # the depth is that of sources without a flag
    errors = result.flux_err[good & (result.flags == 0)]
    values = {
        "band": band.name,
        "n": len(result),
        "n_measured": np.count_nonzero(good),
        "n_detected": np.count_nonzero(good & (result.snr > 5)),
        "depth": np.nan,
        "rms": _pulls_rms(band.pulls),
        "scatter": 100 * result.meta.get("pixel_scatter", 0.0) or np.nan,
        "background": Missing("not fitted"),
        "offset": Missing("no light"),
    }
    if len(errors):
        values["depth"] = (5 * np.median(errors)).to_value(u.ABmag)
    if "offset" in result.meta:
        values["offset"] = _pairs(result.meta)
    if result.background is not None:
        background = result.background.value
        error = result.background_err.value
        values["background"] = f"{background:.3g} ± {error:.1g}"
    return values


def _whole_image(result):
    model = result.model_image.data
    step = thinning_step(max(model.shape), _ACROSS)
    data = result.residual_image.data + model
    scale = pixel_scale(result.model_image.wcs) * step
    ny, nx = model.shape
    _, axes = new_figure(1, 3, size=(3.5, max(1.8, min(5.0, 3.1 * ny / nx))))
    axes = plot_model_residual(
        data[::step, ::step], model[::step, ::step], ax=axes[0], pixel_scale=scale, unit="MJy/sr"
    )
    return axes[0].figure


def _examples(result):
    """Choose sources to be shown, and say why: the best without flags, and the worst fit."""
    snr = np.nan_to_num(result.snr, nan=-np.inf)
    good = np.isfinite(result.snr)
    clean = good & (result.flags == 0)
    chosen = []
    if clean.any():
        best = np.argmax(np.where(clean, snr, -np.inf))
        chosen.append((int(best), "the brightest without a flag"))
    elif good.any():
        best = np.argmax(np.where(good, snr, -np.inf))
        chosen.append((int(best), "the brightest"))
    poor = good & (result.flags & ForcedFlags.POOR_FIT != 0)
    if poor.any():
        poorest = np.argmax(np.where(poor, result.chi2, -np.inf))
        chosen.append((int(poorest), "the poorest fit"))
    return chosen


def _zoom(result, highres, segments, k, title):
    """Draw prior (under a title), image, model and residual about a source: squares, white beyond the images."""

    def square(data, wcs, fill=np.nan):
        scale = pixel_scale(wcs)
        at = wcs.world_to_pixel(result.sky[k])
        size = 2 * round(_SIZE / 2 / scale) + 1
        cut = Cutout2D(data, at, size, mode="partial", fill_value=fill)
        return cut.data, {"pixel_scale": scale, "center": cut.input_position_cutout}

    model = result.model_image.data
    wcs = result.model_image.wcs
    _, axes = new_figure(1, 4, size=(2.9, 3.0))
    # the prior with its segments, then the image
    sharp, form = square(filled(highres), highres.wcs)
    form |= {"ax": axes[0, 0], "title": title}
    if segments is None:
        plot_image(sharp, **form)
    else:
        plot_segmentation(sharp, square(segments, highres.wcs, 0)[0], **form)
    light, form = square(model, wcs)
    data, _ = square(result.residual_image.data + model, wcs)
    plot_model_residual(data, light, ax=axes[0, 1:], **form)
    for ax in axes[0, 1:]:
        ax.set(ylabel="", yticklabels=[])
    return axes[0, 0].figure


def _magnitudes(band, confidence):
    result = band.result
    xlabel = f"{plain_text(band.name)} (AB)"
    figure, [[counts_ax, error_ax]] = new_figure(1, 2, size=(5.2, 3.6))
    detected = result.snr > _DETECTED
    mag = ab_magnitude(result.flux)
    limit = ab_magnitude(result.upper_limit(confidence))
    # 2.5 / ln 10 over the signal-to-noise
    error = 1.0857 / np.where(detected, result.snr, np.nan)
    clean = detected & (result.flags == 0)
    fainter = np.isfinite(limit) & ~detected
    # magnitudes of detections, limits of the others
    shown = np.where(detected, mag, limit)
    if np.isfinite(shown).any():
        low = np.floor(np.nanmin(shown))
        high = np.nanmax(shown)
        bins = np.arange(low, max(high, low) + 1.0, 0.5)
        counts_ax.hist(mag[detected], bins, color="0.75", label=f"above {_DETECTED:g} sigma")
        counts_ax.hist(
            mag[clean], bins, histtype="step", color="#1d4ed8", label="of these, no flag"
        )
        limit_style = {
            "color": "#c2410c",
            "ls": ":",
            "label": f"limits of others ({confidence:.0%})",
        }
        counts_ax.hist(limit[fainter], bins, histtype="step", **limit_style)
        counts_ax.legend(frameon=False)
    counts_ax.set(xlabel=xlabel, ylabel="sources")
    for rows, marker, color, label in (
        (detected & ~clean, "x", "#c2410c", "flagged"),
        (clean, ".", "#1d4ed8", "no flag"),
    ):
        error_ax.plot(mag[rows], error[rows], marker, color=color, ms=5, label=label)
    error_ax.axhline(1.0857 / 5, color="0.5", lw=0.8, ls="--", label="5 sigma")
    error_ax.set(xlabel=xlabel, ylabel="error (mag)", yscale="log")
    error_ax.legend(frameon=False)
    return figure


def _stars(page, stars, band):
    """Show the stars that the PSFs were compared with, before and after."""
    for name, fit in stars.fits.items():
        terms = zip(TERMS, 100 * fit.terms, 100 * fit.terms_err, strict=True)
        changes = ", ".join(
            f"{key.replace('_', ' ')} {x:+.1f} ± {err:.1f} %" for key, x, err in terms
        )
        label = name
        if name == "image":
            label = f"{band} image"
        facts = {"what": label, "n": len(fit.after), "error": 100 * fit.error, "changes": changes}
        for text in star_texts(fit):
            page.text(text, **facts, **_star_numbers(fit))
        pairs = list(zip(fit.before, fit.after, strict=True))[:_STARS]
        figure, axes = new_figure(len(pairs), 3, size=(3.0, 2.8))
        # arcsec per pixel of the star's image
        scale = stars.kernel.pixel_scale.to_value(ANGLE) * np.sqrt(fit.after[0].star.area)
        form = {"pixel_scale": scale}
        pulls = {"limits": (-5, 5), "stretch": "linear", "cmap": "RdBu_r", **form}
        for row, (before, after) in zip(axes, pairs, strict=True):
            star = before.star
            has_data = np.isfinite(before.star.sigma)
            plot_image(np.where(has_data, star.data, np.nan), ax=row[0], title="star", **form)
            for ax, star_fit, title in ((row[1], before, "model"), (row[2], after, "corrected")):
                pull = nans(star.data.shape)
                pull[has_data] = star_fit.residual * star_fit.weight
                plot_image(pull, ax=ax, title=f"{title}, chi2 {star_fit.chi2:.2f}", **pulls)
        page.figure("figure", figure, **facts)
    rows = row_dicts(stars.table)
    for row in rows:
        row["note"] = "not like the PSF" if row["chi2"] > _UNLIKE else ""
    page.table("table", rows)


def star_texts(fit):
    """Return names of texts of a `~miricigale.psf.star_fit.StarPSF`: its correction, and how it fits."""
    texts = ["untried"]
    if len(fit.chi2) > 1:
        texts = [fit.kind]
    if fit.chi2[fit.kind] > _UNLIKE * fit.dof:
        texts.append("unlike")
    return texts


def _star_numbers(fit):
    """Return chi-square of stars with the model and with the chosen correction."""
    after = fit.chi2[fit.kind]
    ratio = after / max(fit.dof, 1)
    return {"before": fit.chi2["model"], "after": after, "dof": fit.dof, "ratio": ratio}


def _flag_table(page, bands):
    page.section("flags")

    def row(name, meaning, flux, of):
        counts = {band.name: np.count_nonzero(of(band.result)) for band in bands}
        return {"flag": name, "meaning": meaning, "flux": flux, **counts}

    rows = [row("none", "", "usable", lambda result: result.flags == 0)]
    for value, (name, meaning) in ForcedFlags.meanings().items():
        flux = "usable"
        if value in (ForcedFlags.NO_DATA, ForcedFlags.DEGENERATE):
            flux = "not measured"
        rows.append(row(f"{value} {name}", meaning, flux, lambda result, v=value: result.flags & v))
    rows.append(row("crowded", page.sentence("crowded"), "usable", lambda result: result.crowded))
    page.table("table", rows)


def _source_rows(result, confidence):
    order = np.argsort(np.nan_to_num(-result.flux.value, nan=np.inf), kind="stable")[:_ROWS]
    table = result.to_table(confidence=confidence)[order]
    rows = []
    for source, row in zip(table, plain_rows(table), strict=True):
        flags = ", ".join(ForcedFlags.names(row["flags"])).replace("_", " ") or "none"
        position = {"ra": f"{source['sky'].ra.deg:.5f}", "dec": f"{source['sky'].dec.deg:.5f}"}
        limit = float(ab_magnitude(source["upper"]))
        if not np.isfinite(limit):
            mag = Missing("not measured")
        elif row["snr"] > _DETECTED:
            mag = f"{float(ab_magnitude(source['flux'])):.2f}"
        else:
            mag = f"> {limit:.2f}"
        rows.append(row | {"flags": flags, "mag": mag, **position})
    return rows


def _input_table(page, bands, highres):
    page.section("inputs")
    files = [(band.name, band.image, band.kernel, "psf") for band in bands]
    if _has_prior(bands, highres):
        files.append(("prior", highres, bands[0].kernel, "highres_psf"))
    facts = {}
    for name, image, kernel, psf in files:
        psf_facts = kernel.meta.get("psfs", {}).get(psf, {})
        facts[name] = dict(image.meta)
        for key, value in psf_facts.items():
            facts[name][f"psf_{key}"] = value
        facts[name]["pixels"] = f"{image.data.shape[1]} x {image.data.shape[0]}"
        facts[name]["pixel_scale"] = f"{pixel_scale(image.wcs):.4f}"
    rows = []
    for key, label in page.texts["inputs"]["facts"].items():
        row = {"": label}
        for name, facts_of_image in facts.items():
            row[name] = _text(facts_of_image.get(key))
        rows.append(row)
    page.table("table", rows)
    for band in bands:
        values = band.kernel.array
        scale = band.kernel.pixel_scale.value
        facts = {"size": values.shape[0], "scale": scale, "sum": values.sum()}
        made = "made from two PSFs"
        if not _has_prior(bands, highres):
            made = "for points with the PSF of the image"
        facts["origin"] = band.kernel.meta.get("file", made)
        page.text("kernel", band=band.name, gain=band.kernel.noise_gain, **facts)


def _text(value):
    if value is None:
        return Missing("not stated or not done")
    if isinstance(value, float):
        return f"{value:.5g}"
    return value


def empty_pulls(result, kernel, seed):
    """Measure flux over error of points where a result has no source; None without a PSF or such places."""
    empty = empty_positions(result, seed)
    if kernel.target is None or not len(empty):
        return None
    return pulls_at(empty, kernel, result.residual_image)


def pulls_at(positions, kernel, residual):
    """Measure flux over error of points on what a measurement left of an image or of exposures."""
    photometer = ForcedPhotometer(kernel, template="psf")
    with warnings.catch_warnings():
        # the warnings about background and noise were given already
        warnings.simplefilter("ignore", PhotometryWarning)
        return photometer.measure(residual, catalog=positions).snr


def empty_positions(result, seed):
    """
    Draw random positions at which a measurement left no light: ``id`` and ``sky``.

    They are at least 0.3 arcsec from pixels with light of a model (above a third of the
    noise) or without data.
    """
    residual = result.residual_image
    sigma = residual.uncertainty.array
    level = 0.0
    if result.background is not None:
        level = result.background.to_value(residual.unit)
    is_free = ~np.asarray(residual.mask, bool)
    is_free &= np.abs(result.model_image.data - level) < 0.3 * np.where(is_free, sigma, 1.0)
    steps = max(1, round(0.3 / pixel_scale(residual.wcs)))
    # pixels beyond the image count as without data
    is_free = scipy.ndimage.binary_erosion(is_free, iterations=steps)
    y, x = np.nonzero(is_free)
    rng = np.random.default_rng(seed)
    chosen = np.zeros(0, int)
    if len(x):
        chosen = rng.choice(len(x), min(_EMPTY, len(x)), replace=False)
    sky = residual.wcs.pixel_to_world(x[chosen].astype(float), y[chosen].astype(float)).icrs
    return QTable({"id": np.arange(1, len(chosen) + 1), "sky": sky})


def write_errors_page(path, errors, *, overwrite):
    """Write the page of the errors of an image (`~miricigale.photometry.ImageErrors`)."""
    table = errors.table
    meta = errors.table.meta
    report = Page(f"Errors of {Path(meta['source']).name}", subtitle=meta.get("filter", ""))
    page = SectionWriter(report, declared("miricigale.photometry"))
    facts = {"over": meta["noise_over_stated"], "factor": errors.factor}
    page.section("errors", n_free=errors.n_free, **facts)
    page.table("table", row_dicts(Table(table)))
    # the map of the first aperture
    aperture, limit = next(iter(errors.limits.items()))
    limit = limit.value
    step = thinning_step(max(limit.shape), _ACROSS)
    scale = step * pixel_scale(errors.noise.wcs)
    figure, [[limit_ax, correlation_ax]] = new_figure(1, 2, size=(5.2, 4.2))
    form = {"limits": np.nanpercentile(limit, [1, 99]), "colorbar": "limit (uJy)"}
    plot_image(limit[::step, ::step], ax=limit_ax, pixel_scale=scale, stretch="linear", **form)
    form = {"limits": (0, 1), "colorbar": "correlation"}
    shown = errors.correlation / errors.correlation.max()
    plot_image(shown, ax=correlation_ax, stretch="linear", **form).set(
        xlabel="x (pixels)", ylabel="y (pixels)"
    )
    shape = f"a circle of {aperture} arcsec"
    if aperture == "psf":
        shape = "a point fitted"
    page.figure("map", figure, aperture=shape, n_sigma=meta["n_sigma"])
    report.write(path, overwrite=overwrite)
