"""Sections on the reference truth: inputs, and photometry with point sources, conditions and limits."""

import astropy.units as u
import numpy as np

from miricigale.pages import number
from miricigale.utils.named_values import subset
from miricigale.workflow.labels import band_label, end_bands
from miricigale.workflow.page import band_figures, pictures, study_figures
from miricigale.workflow.page.numbers import FEWEST
from miricigale.workflow.stages.conditions import CONDITIONS, ConditionFlags
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf

#: How sources are marked in figures: bit, marker and label.
_MARKS = ((ConditionFlags.CROWDED, "o", "crowded"), (ConditionFlags.EDGE, "s", "at the edge"))


def write_inputs(page):
    """Write the section on luminosities, star formation, counts and light of the reference truth's galaxies."""
    galaxies = page.tables.galaxies()
    imaged = page.tables.galaxies(field=True)
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
    rows = []
    for light in page.metrics["light"]:
        row = dict(light)
        row["band"] = f"{band_label(light['band'])}, {light['wavelength']:g} µm"
        if light["least"]:
            row["faint_limit"] = f"{light['least']:g} µJy"
        else:
            row["faint_limit"] = "none"
        row["published"] = f"{light['published']:.2f} -{light['down']:.2f} +{light['up']:.2f}"
        rows.append(row)
    page.table("light", rows)


def write_photometry(page):
    """Write the section on measured against true fluxes, and the point sources."""
    matched = page.tables.matched
    points = page.tables.points
    is_paper_method = page.config.photometry.method == "yang2021"
    page.section("photometry", "yang2021" if is_paper_method else "text")
    page.figure("convolution", pictures.convolution_figure(page.kernels))
    table = matched[page.tables.inside & np.asarray(matched["matched"])]
    if len(table) == 0:
        page.text("no_match")
    else:
        limits = {name: entry["limit"] for name, entry in page.metrics["bands"].items()}
        page.figure("magnitudes", band_figures.magnitude_figure(table, page.bands))
        page.figure("offsets", band_figures.offset_figure(table, page.bands, limits, _MARKS))
        page.figure("shapes", study_figures.shape_figure(page.study))
    page.table("recovery", page.band_rows, scaling=page.sentence("scaling") if points else "")
    if points:
        inside = {name: table[np.asarray(table["in_field"])] for name, table in points.items()}
        page.figure("points", band_figures.point_figure(inside, page.bands))
        _write_energy(page, subset(inside, end_bands(page.bands)))
    else:
        page.text("no_points")
    _write_conditions(page, page.metrics["detections"])


def _write_energy(page, points):
    """Write images of point sources in the field, by band, and their encircled energy."""
    points = {name: table for name, table in points.items() if len(table)}
    if not points:
        return
    _, scale = measured_mosaic(page.config)
    mosaics = {}
    psfs = {}
    for name in points:
        mosaics[name] = page.context.image(f"points/{name}_mosaic.fits")
        psfs[name] = mosaic_psf(page.config, name, scale)
    named = " and ".join(map(band_label, points))
    page.figure("energy", pictures.energy_figure(mosaics, points, psfs), named=named)


def _write_conditions(page, counts):
    """Write tables of the sources of the field and of the detections by condition."""
    rows = []
    for band in page.band_rows:
        conditions = band["conditions"]
        row = {
            "band": band["band"],
            "in the field": conditions["n_field"],
            "no flux": conditions["n_not_measured"],
        }
        for group in CONDITIONS:
            row[group] = _offset_cell(conditions[group])
        rows.append(row)
    page.table("conditions", rows)
    numbers = {
        "detections in the field": counts["n_field"],
        "of them spurious: no source of the catalog is near": counts["n_spurious"],
        "of them ambiguous": counts["n_ambiguous"],
    }
    for name, n in counts["n_spurious_bright"].items():
        numbers[f"spurious above 5 sigma in {band_label(name)}"] = n
    rows = [{"high-resolution image": text, "number": n} for text, n in numbers.items()]
    page.table("counts", rows, n_detections=counts["n"])


def _offset_cell(group):
    """Return the number of a group, and offset and scatter of its bright sources, as text."""
    # a scatter of fewer says nothing
    if not np.isfinite(group["median"]) or group["n_bright"] < FEWEST:
        return f"{group['n']}"
    return f"{group['n']}: {100 * group['median']:+.1f} ± {100 * group['scatter']:.1f} %"


def write_errors(page):
    """Write the section on the error function and the limits."""
    errors = page.tables.errors
    bands = page.metrics["bands"]
    limits = {name: errors.limiting_flux(name).to_value(u.uJy) for name in page.bands}
    page.section("errors")
    page.figure("function", band_figures.error_figure(errors, page.bands, limits))
    if len(bands) > 1:
        page.figure("limits", band_figures.limit_figure(bands))
    rows = []
    depths = []
    for row in page.band_rows:
        row["deeper"] = row["limit"] - row["etc_limit"]
        row["proposal"] = _proposal(row)
        rows.append(row)
        # where not all sources have the same exposure time
        if len(row["coverage"]) > 1:
            depths += [{"band": row["band"]} | entry for entry in row["coverage"]]
    as_ceers = all(row["ceers"] for row in rows)
    page.table("table", rows, other_exposures="" if as_ceers else ", for other exposures")
    if depths:
        page.table("coverage", depths)


def _proposal(entry):
    """Return the limit of CEERS' proposal, and the time that it is for where that is another."""
    if entry["ceers"] or not np.isfinite(entry["proposal"]):
        return number(entry["proposal"], ".1f", "no band of CEERS")
    return f"{entry['proposal']:.1f} in {entry['proposal_time']:.0f} s"
