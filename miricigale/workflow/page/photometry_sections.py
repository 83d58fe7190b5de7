"""Sections on the photometry of the reference truth: fluxes, point sources, conditions, limits."""

import astropy.units as u
import numpy as np

from miricigale.pages import number, percent
from miricigale.psf import MatchingKernel
from miricigale.workflow.page import band_figures, pictures, study_figures
from miricigale.workflow.page.labels import band_label
from miricigale.workflow.page.numbers import FEWEST
from miricigale.workflow.stages.conditions import CONDITIONS, ConditionFlags
from miricigale.workflow.stages.sample import SampleFlags

__all__ = ["write_errors", "write_photometry"]

#: How sources are marked in figures: bit, marker and label.
_MARKS = (
    (int(ConditionFlags.CROWDED), "o", "crowded"),
    (int(ConditionFlags.EDGE), "s", "at the edge"),
)


def write_photometry(page):
    """Measured against true fluxes, and the point sources."""
    own_steps = page.config.photometry.method == "yang2021"
    matched, points, bands = page.tables.matched, page.tables.points, page.metrics["bands"]
    page.section("photometry", text="yang2021" if own_steps else "text")
    kernels = {n: MatchingKernel.read(page.context.path(f"kernel_{n}.fits")) for n in page.bands}
    page.figure("convolution", pictures.convolution_figure(kernels))
    inside = (np.asarray(matched["selection"]) & SampleFlags.OUTSIDE_FIELD) == 0
    table = matched[inside & np.asarray(matched["matched"])]
    if len(table) == 0:
        page.text("no_match")
    else:
        limits = {name: entry["limit"] for name, entry in bands.items()}
        page.figure("magnitudes", band_figures.magnitude_figure(table, page.bands))
        page.figure("offsets", band_figures.offset_figure(table, page.bands, limits, _MARKS))
        page.figure("shapes", study_figures.shape_figure(page.study))
    reason, lost = "no isolated source above 20 sigma", "no point source measured"
    columns = {
        "band": lambda x: band_label(x[0]),
        "isolated > 20 sigma": lambda x: x[1]["bright_n"],
        "median offset": lambda x: percent(x[1]["bright_median"], reason, "+.2f"),
        "its error": lambda x: percent(x[1]["bright_median_err"], reason),
    }
    if points:
        whole = "no whole point source in the field"
        columns |= {
            "point sources": lambda x: x[1]["points_n"],
            "their median offset": lambda x: percent(x[1]["points_median"], lost, "+.2f"),
            "scatter": lambda x: percent(x[1]["points_scatter"], lost),
            "f_scaling": lambda x: number(x[1]["f_scaling"], ".4f", whole),
        }
    page.table("scaling" if points else "recovery", bands.items(), columns)
    if points:
        shown = {name: table[np.asarray(table["in_field"])] for name, table in points.items()}
        page.figure("points", band_figures.point_figure(shown, page.bands))
    else:
        page.text("no_points")
    _write_conditions(page, bands, page.metrics["detections"])


def _write_conditions(page, bands, found):
    """Tables of the sources of the field and of the detections by condition."""
    columns = {
        "band": lambda x: band_label(x[0]),
        "in the field": lambda x: x[1]["conditions"]["n_field"],
        "no flux": lambda x: x[1]["conditions"]["n_not_measured"],
    }
    for group in CONDITIONS:
        columns[group] = lambda x, group=group: _offset_cell(x[1]["conditions"][group])
    page.table("conditions", bands.items(), columns)
    counts = {
        "detections in the field": found["n_field"],
        "of them spurious: no source of the catalog is near": found["n_spurious"],
        "of them ambiguous": found["n_ambiguous"],
    }
    for name, count in found["n_spurious_bright"].items():
        counts[f"spurious above 5 sigma in {band_label(name)}"] = count
    columns = {"high-resolution image": lambda x: x[0], "number": lambda x: x[1]}
    page.table("counts", counts.items(), columns, n_detections=found["n"])


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
    none, few = "the error function reaches 5 sigma nowhere", "no source below 20 sigma"
    own = all(entry["ceers"] for entry in bands.values())
    columns = {
        "band": lambda x: band_label(x[0]),
        "5 sigma, error function": lambda x: number(x[1]["limit"], ".2f", none),
        "formal": lambda x: number(x[1]["formal_limit"], ".2f", "no source measured"),
        "calculator, scaled": lambda x: f"{x[1]['etc_limit']:.2f}",
        "fainter than calculator": lambda x: number(
            x[1]["limit"] - x[1]["etc_limit"], "+.2f", none
        ),
        f"CEERS proposal{'' if own else ', for other exposures'}": lambda x: _proposal(x[1]),
        "pull median": lambda x: number(x[1]["pull_median"], "+.2f", few),
        "pull scatter": lambda x: number(x[1]["pull_scatter"], ".2f", few),
    }
    page.table("table", bands.items(), columns)
    # where not all sources have the same exposure time
    depths = [
        (name, one)
        for name, entry in bands.items()
        for one in entry["coverage"]
        if len(entry["coverage"]) > 1
    ]
    columns = {
        "band": lambda x: band_label(x[0]),
        "exposure time": lambda x: f"{x[1]['share']:.2f}",
        "galaxies": lambda x: x[1]["n"],
        "5 sigma": lambda x: number(x[1]["limit"], ".2f", none),
    }
    if depths:
        page.table("coverage", depths, columns)


def _proposal(entry):
    """The limit of CEERS' proposal, and the time that it is for where that is another."""
    if entry["ceers"] or not np.isfinite(entry["proposal"]):
        return number(entry["proposal"], ".1f", "no band of CEERS")
    return f"{entry['proposal']:.1f} in {entry['proposal_time']:.0f} s"
