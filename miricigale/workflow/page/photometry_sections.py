"""Sections on the reference truth: inputs, and photometry with point sources, conditions and limits."""

import astropy.units as u
import numpy as np

from miricigale.pages import number
from miricigale.workflow.labels import band_label, end_bands
from miricigale.workflow.page import band_figures, pictures, study_figures
from miricigale.workflow.page.numbers import FEWEST
from miricigale.workflow.stages.conditions import CONDITIONS, ConditionFlags
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf

#: How sources are marked in figures: bit, marker and label.
_MARKS = ((ConditionFlags.CROWDED, "o", "crowded"), (ConditionFlags.EDGE, "s", "at the edge"))


def write_inputs(page):
    """Luminosities, star formation, counts and light of the galaxies of the reference truth."""
    galaxies, imaged = page.tables.galaxies(), page.tables.galaxies(field=True)
    page.section("inputs")
    if len(galaxies) == 0:
        page.text("no_model")
        return
    figure, left_out = band_figures.input_figure(galaxies)
    page.figure("sequence", figure, n_not_shown=left_out, n_galaxies=len(galaxies))
    if len(imaged) == 0:
        page.text("none_imaged")
        return
    figure = band_figures.counts_figure(imaged, page.bands, page.area)
    page.figure("counts", figure, n_imaged=len(imaged))
    rows = [
        row
        | {
            "band": f"{band_label(row['band'])}, {row['wavelength']:g} µm",
            "faint_limit": f"{row['least']:g} µJy" if row["least"] else "none",
            "published": f"{row['published']:.2f} -{row['down']:.2f} +{row['up']:.2f}",
        }
        for row in page.metrics["light"]
    ]
    page.table("light", rows)


def write_photometry(page):
    """Measured against true fluxes, and the point sources."""
    own_steps = page.config.photometry.method == "yang2021"
    matched, points, bands = page.tables.matched, page.tables.points, page.metrics["bands"]
    page.section("photometry", "yang2021" if own_steps else "text")
    page.figure("convolution", pictures.convolution_figure(page.kernels))
    table = matched[page.tables.inside & np.asarray(matched["matched"])]
    if len(table) == 0:
        page.text("no_match")
    else:
        limits = {name: entry["limit"] for name, entry in bands.items()}
        page.figure("magnitudes", band_figures.magnitude_figure(table, page.bands))
        page.figure("offsets", band_figures.offset_figure(table, page.bands, limits, _MARKS))
        page.figure("shapes", study_figures.shape_figure(page.study))
    page.table("recovery", page.band_rows, scaling=page.sentence("scaling") if points else "")
    if points:
        shown = {name: table[np.asarray(table["in_field"])] for name, table in points.items()}
        page.figure("points", band_figures.point_figure(shown, page.bands))
        _write_energy(page, {name: shown[name] for name in end_bands(page.bands)})
    else:
        page.text("no_points")
    _write_conditions(page, page.metrics["detections"])


def _write_energy(page, points):
    """Images of point sources in the field, by band, and their encircled energy."""
    points = {name: table for name, table in points.items() if len(table)}
    if points:
        _, scale = measured_mosaic(page.config)
        mosaics = {name: page.context.image(f"points/{name}_mosaic.fits") for name in points}
        psfs = {name: mosaic_psf(page.config, name, scale) for name in points}
        named = " and ".join(map(band_label, points))
        page.figure("energy", pictures.energy_figure(mosaics, points, psfs), named=named)


def _write_conditions(page, found):
    """Tables of the sources of the field and of the detections by condition."""
    rows = [
        {
            "band": row["band"],
            "in the field": row["conditions"]["n_field"],
            "no flux": row["conditions"]["n_not_measured"],
            **{group: _offset_cell(row["conditions"][group]) for group in CONDITIONS},
        }
        for row in page.band_rows
    ]
    page.table("conditions", rows)
    counts = {
        "detections in the field": found["n_field"],
        "of them spurious: no source of the catalog is near": found["n_spurious"],
        "of them ambiguous": found["n_ambiguous"],
    }
    for name, count in found["n_spurious_bright"].items():
        counts[f"spurious above 5 sigma in {band_label(name)}"] = count
    rows = [{"high-resolution image": what, "number": n} for what, n in counts.items()]
    page.table("counts", rows, n_detections=found["n"])


def _offset_cell(found):
    """Number of a group, and offset and scatter of its bright sources, in one cell."""
    # a scatter of fewer says nothing
    if not np.isfinite(found["median"]) or found["n_bright"] < FEWEST:
        return f"{found['n']}"
    return f"{found['n']}: {100 * found['median']:+.1f} ± {100 * found['scatter']:.1f} %"


def write_errors(page):
    """The error function and the limits."""
    errors, bands = page.tables.errors, page.metrics["bands"]
    limits = {name: errors.limiting_flux(name).to_value(u.uJy) for name in page.bands}
    page.section("errors")
    page.figure("function", band_figures.error_figure(errors, page.bands, limits))
    if len(bands) > 1:
        page.figure("limits", band_figures.limit_figure(bands))
    rows = [
        row | {"deeper": row["limit"] - row["etc_limit"], "proposal": _proposal(row)}
        for row in page.band_rows
    ]
    own = all(row["ceers"] for row in rows)
    page.table("table", rows, other_exposures="" if own else ", for other exposures")
    # where not all sources have the same exposure time
    several = [row for row in rows if len(row["coverage"]) > 1]
    if several:
        depths = [{"band": row["band"], **one} for row in several for one in row["coverage"]]
        page.table("coverage", depths)


def _proposal(entry):
    """The limit of CEERS' proposal, and the time that it is for where that is another."""
    if entry["ceers"] or not np.isfinite(entry["proposal"]):
        return number(entry["proposal"], ".1f", "no band of CEERS")
    return f"{entry['proposal']:.1f} in {entry['proposal_time']:.0f} s"
