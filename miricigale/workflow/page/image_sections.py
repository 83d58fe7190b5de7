"""Sections on the images of the reference truth: headline, field, detections."""

import numpy as np
from markupsafe import Markup

from miricigale.pages import number
from miricigale.workflow.labels import band_label, browse, color_bands, three_bands
from miricigale.workflow.page import pictures, study_figures
from miricigale.workflow.stages.exposures import study_exposures, study_pointings
from miricigale.workflow.stages.grids import of_patch
from miricigale.workflow.stages.images import measured_mosaic, reducer_of
from miricigale.workflow.stages.sample import CUTS


def write_summary(page, truths, numbers, caveats):
    """Write results at each fracAGN, headline numbers, links to the sources of each truth, and ``caveats``."""
    values = dict(page.metrics)
    values["n_sample"] = browse(page.first.name, values["n_sample"], show="sample")
    for unit, fit in values["fits"].items():
        values |= {f"{key}_{unit}": value for key, value in fit.items()}
    page.section("summary")
    answer = study_figures.answer_figure(page.study, numbers)
    if answer is not None:
        page.figure("answer", answer)
    page.items(values, min_detected=page.config.fit.min_detected)
    links = Markup(", ").join(browse(name, name) for name in truths)
    page.text("sources", links=links)
    page.text("caveats")
    page.report.bullets(caveats, box=True)


def write_images(page, mosaics, patch):
    """Write the field, or a patch, in color or gray; an exposure before and after; mosaic, model and residual."""
    config = page.config
    image = page.context.image
    sky = page.first.name
    bands = tuple(mosaics)
    page.section("images", "patch" if patch else "text", patch=patch)
    colors = color_bands(bands)
    kind = {3: "color", 6: "colors"}.get(len(colors), "gray")
    prior = image(f"{of_patch('f160w', patch)}.fits")
    field = [mosaics[name] for name in colors]
    figure = pictures.field_figure(field, prior, list(colors) + [config.highres.filter])
    page.figure(kind, figure, bands=", ".join(map(band_label, colors)))
    chosen = three_bands(bands)
    unit = next(n for n, e in study_exposures(config).items() if e.filter == chosen[-1])
    rate = image(f"{sky}/exposures/{unit}_rate.fits")
    cal = image(f"{sky}/exposures/{unit}_cal.fits")
    page.figure("subtraction", pictures.subtraction_figure(rate, cal, reducer_of(config)))
    suffix, _ = measured_mosaic(config)
    pairs = []
    for name in chosen:
        mosaic = image(f"{of_patch(f'{sky}/mosaic_{name}{suffix}', patch)}.fits")
        model = image(f"{of_patch(f'{sky}/photometry/{name}', patch)}_model.fits")
        pairs.append((mosaic, model))
    page.figure("residual", pictures.residual_figure(pairs, chosen))
    middle = len(chosen) // 2
    figure = pictures.residual_figure([pairs[middle]], [chosen[middle]], size=None)
    page.figure("maps", figure, band=band_label(chosen[middle]))


def write_detections(page):
    """Write which galaxies are detected, and why the others are not in the fit."""
    metrics = page.metrics
    prior = page.facts["prior"]
    # a column without any value is left out
    has_proposal = not all(np.isnan(row["to_proposal"]) for row in metrics["detected"])
    rows = []
    for entry in metrics["detected"]:
        interval = number(entry["low"], ".1f %", "no galaxy")
        if entry["n"]:
            interval = f"{interval} to {number(entry['high'], '.1f %', 'no galaxy')}"
        row = {"sample": f"{prior} < {entry['limit']:g}", "interval": interval} | entry
        if not has_proposal:
            del row["to_proposal"]
        rows.append(row)
    page.section("detections")
    exposures = ", six bands, other exposures"
    if metrics["as_paper"]:
        exposures = ""
    sigma = ""
    if page.config.errors.statistic == "mad":
        sigma = page.sentence("paper_sigma")
    page.table("shares", rows, other_exposures=exposures, paper_sigma=sigma)
    rows = []
    for flag, n in metrics["n_left_out"].items():
        if n and flag != "outside_field":
            reason = flag.replace("_", " ")
            link = browse(page.first.name, n, flag=reason)
            rows.append({"reason": reason, "sources": link})
    cuts = []
    for key in CUTS:
        if getattr(page.config.fit, key):
            cuts.append(f"{key} {metrics['n_left_out'][key]}")
    if cuts:
        page.text("cuts", counts=", ".join(cuts))
    page.table("left_out", rows, n_outside=metrics["n_left_out"]["outside_field"])
    if page.first.field.any():
        page.figure("luminosity", study_figures.detection_figure(page.study))


def field_text(config):
    """Return where the telescope looks, in words."""
    centers = study_pointings(config)
    options = config.pointing
    field = "a MIRI field"
    if len(centers) != 1:
        field = f"{len(centers)} MIRI pointings"
    if options.centers:
        return f"{field}, the first at RA {centers[0].ra.deg:.5f}, Dec {centers[0].dec.deg:.5f}"
    return f"{field} at RA {options.ra:.5f}, Dec {options.dec:.5f}"
