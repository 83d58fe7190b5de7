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
    """What was found at each fracAGN, headline numbers, links to the sources of each truth, and ``caveats``."""
    m = page.metrics
    values = m | {"n_sample": browse(page.first.name, m["n_sample"], show="sample")}
    for unit, fit in m["fits"].items():
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
    """The field, or a patch, in color or gray; an exposure before and after; mosaic, model and residual."""
    config, image, sky = page.config, page.context.image, page.first.name
    bands = tuple(mosaics)
    chosen, colors = three_bands(bands), color_bands(bands)
    page.section("images", "patch" if patch else "text", patch=patch)
    field, sharp = [mosaics[name] for name in colors], image(f"{of_patch('f160w', patch)}.fits")
    figure = pictures.field_figure(field, sharp, [*colors, config.highres.filter])
    kind = {3: "color", 6: "colors"}.get(len(colors), "gray")
    page.figure(kind, figure, bands=", ".join(map(band_label, colors)))
    unit = next(n for n, e in study_exposures(config).items() if e.filter == chosen[-1])
    rate, cal = (image(f"{sky}/exposures/{unit}_{kind}.fits") for kind in ("rate", "cal"))
    page.figure("subtraction", pictures.subtraction_figure(rate, cal, reducer_of(config)))
    suffix, _ = measured_mosaic(config)
    paths = of_patch(f"{sky}/mosaic_{{}}{suffix}", patch), of_patch(f"{sky}/photometry/{{}}", patch)
    paths = f"{paths[0]}.fits", f"{paths[1]}_model.fits"
    pairs = [tuple(image(path.format(name)) for path in paths) for name in chosen]
    page.figure("residual", pictures.residual_figure(pairs, chosen))
    middle = len(chosen) // 2
    whole = pictures.residual_figure(pairs[middle:][:1], chosen[middle:][:1], size=None)
    page.figure("maps", whole, band=band_label(chosen[middle]))


def write_detections(page):
    """Which galaxies are detected, and why the others are not in the fit."""
    m, none, prior = page.metrics, "no galaxy", page.facts["prior"]
    # a column without any value is left out
    unknown = {"to_proposal"} if all(np.isnan(row["to_proposal"]) for row in m["detected"]) else ()
    rows = []
    for row in m["detected"]:
        low, high = (number(row[end], ".1f %", none) for end in ("low", "high"))
        interval = f"{low} to {high}" if row["n"] else low
        known = {key: value for key, value in row.items() if key not in unknown}
        rows.append({"sample": f"{prior} < {row['limit']:g}", "interval": interval, **known})
    page.section("detections")
    others = "" if m["as_paper"] else ", six bands, other exposures"
    sigma = page.sentence("paper_sigma") if page.config.errors.statistic == "mad" else ""
    page.table("shares", rows, other_exposures=others, paper_sigma=sigma)
    reasons = {name.replace("_", " "): n for name, n in m["n_left_out"].items() if n}
    outside = reasons.pop("outside field", 0)
    links = {name: browse(page.first.name, n, flag=name) for name, n in reasons.items()}
    rows = [{"reason": name, "sources": link} for name, link in links.items()]
    cuts = [f"{key} {m['n_left_out'][key]}" for key in CUTS if getattr(page.config.fit, key)]
    if cuts:
        page.text("cuts", counts=", ".join(cuts))
    page.table("left_out", rows, n_outside=outside)
    if page.first.field.any():
        page.figure("luminosity", study_figures.detection_figure(page.study))


def field_text(config):
    """Where the telescope looks, in words."""
    centers, options = study_pointings(config), config.pointing
    field = "a MIRI field" if len(centers) == 1 else f"{len(centers)} MIRI pointings"
    if options.centers:
        return f"{field}, the first at RA {centers[0].ra.deg:.5f}, Dec {centers[0].dec.deg:.5f}"
    return f"{field} at RA {options.ra:.5f}, Dec {options.dec:.5f}"
