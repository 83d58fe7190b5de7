"""Sections on the images of the reference truth: headline, field, detections."""

import numpy as np
from markupsafe import Markup

from miricigale.pages import number
from miricigale.workflow.page import pictures, study_figures
from miricigale.workflow.page.labels import browse, three_bands
from miricigale.workflow.stages.exposures import study_exposures, study_pointings
from miricigale.workflow.stages.images import measured_mosaic, reducer_of


def write_summary(page, truths):
    """Headline numbers, and links to the sources of each truth."""
    m = page.metrics
    values = m | {"n_sample": browse(page.first.name, m["n_sample"], show="sample")}
    for unit, fit in m["fits"].items():
        values |= {f"{key}_{unit}": value for key, value in fit.items()}
    page.section("summary")
    page.items(values, min_detected=page.config.fit.min_detected)
    links = Markup(", ").join(browse(name, name) for name in truths)
    page.text("sources", links=links)


def write_images(page, mosaics):
    """The field in color or gray; an exposure before and after; mosaic, model and residual."""
    config, image, sky = page.config, page.context.image, page.first.name
    chosen = three_bands(page.bands)
    page.section("images")
    page.figure(
        "color" if len(chosen) == 3 else "gray",
        pictures.field_figure(
            [mosaics[name] for name in chosen],
            image("f160w.fits"),
            [*chosen, config.highres.filter],
        ),
    )
    unit = next(n for n, e in study_exposures(config).items() if e.filter == chosen[-1])
    rate, cal = (image(f"{sky}/exposures/{unit}_{kind}.fits") for kind in ("rate", "cal"))
    page.figure("subtraction", pictures.subtraction_figure(rate, cal, reducer_of(config)))
    suffix, _ = measured_mosaic(config)
    pairs = [
        (image(f"{sky}/mosaic_{n}{suffix}.fits"), image(f"{sky}/photometry/{n}_model.fits"))
        for n in chosen
    ]
    page.figure("residual", pictures.residual_figure(pairs, chosen))


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
    page.table(
        "shares",
        rows,
        other_exposures="" if m["as_paper"] else ", six bands, other exposures",
        paper_sigma=page.sentence("paper_sigma") if page.config.errors.statistic == "mad" else "",
    )
    reasons = {name.replace("_", " "): n for name, n in m["n_left_out"].items()}
    page.table(
        "left_out",
        [
            {"reason": name, "sources": browse(page.first.name, n, show="all", flag=name)}
            for name, n in reasons.items()
        ],
    )
    if page.first.field.any():
        page.figure("luminosity", study_figures.detection_figure(page.study))


def field_text(config):
    """Where the telescope looks, in words."""
    centers, options = study_pointings(config), config.pointing
    field = "a MIRI field" if len(centers) == 1 else f"{len(centers)} MIRI pointings"
    if options.centers:
        return f"{field}, the first at RA {centers[0].ra.deg:.5f}, Dec {centers[0].dec.deg:.5f}"
    return f"{field} at RA {options.ra:.5f}, Dec {options.dec:.5f}"
