"""
Make the tables of docs/accuracy/paper.rst: every number of Yang et al. 2021 beside those of finished studies.

    python tools/make_paper.py RUN --like alpha=RUN2 libraries=RUN3 ... --all RUN4 [--reasons]

RUN is one of ``miricigale run yang2021``. In each run after ``--like`` one thing is done as in the paper (names:
`THINGS`), and all of them in that after ``--all``; they are made from a copy of RUN. What needs no further run is
taken from the tables of RUN. Of numbers that differ the table names the one thing that takes them nearest to the
paper's, and the share of the difference that is gone with it. Tables are printed as reStructuredText;
``--reasons`` prints the reasons instead, as in miricigale/evaluation/yang2021.toml.
"""

import argparse
import dataclasses
import json
from pathlib import Path

import astropy.units as u
import numpy as np
from make_sanity import rst_table

from miricigale.depth import proposal_limit, sensitivity
from miricigale.evaluation import Estimate, compare_with_paper
from miricigale.photometry import aperture_correction
from miricigale.psf import MatchingKernel, miri_psf
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU
from miricigale.workflow import Context, load_config
from miricigale.workflow.page.numbers import StudyTables
from miricigale.workflow.page.paper import extra_numbers, study_results
from miricigale.workflow.stages.exposures import band_exposures
from miricigale.workflow.stages.points import STAMP_RADIUS
from miricigale.workflow.stages.rivals import read_rivals, source_extractor_numbers
from miricigale.workflow.stages.sample import SampleFlags, detected_bands
from miricigale.workflow.truths import study_truths

#: What is done as in the paper, in short and in full: in other runs, and by tables and closed forms.
THINGS = {
    "method": ("its photometry", "photometry by its steps"),
    "statistic": ("median errors", "errors that are medians"),
    "libraries": ("its libraries", "Dale et al. 2014 and SKIRTOR"),
    "alpha": ("alpha = 1", "dust of alpha = 1"),
    "background": ("mesh of sep", "sky by the mesh of sep"),
    "residual": ("residual noise", "the calculator's residual noise"),
    "redshift": ("z >= 0.2", "no sources at z < 0.2"),
    "limits": ("proposal's limits", "the proposal's limits"),
    "shallower": ("shallower limits", "limits 0.5 mag shallower than the proposal's"),
    "calculator": ("these exposures", "noise of the exposures themselves"),
    "psf": ("PSF before flight", "a PSF as known before flight"),
}
#: Shares of a difference below which nothing explains it.
OPEN = 0.2
#: Words of the quantities that are cut.
SHORT = {
    "without over with MIRI": "without / with MIRI",
    "measured - true magnitude": "mag - true",
    "5-sigma limit minus another (mag)": "5-sigma limit",
    "5-sigma limit of the calculator (AB)": "limit of the calculator",
    ", six MIRI bands": "",
    " MIRI bands": " bands",
    "accretion power": "power",
    "share of the sources above 5 sigma": "share above 5 sigma",
    "a neighbor within 2 arcsec brighter than m + 1": "crowded",
    "magnitudes that a feature adds to a band": "feature (mag)",
    "share of the catalog matched within 1 arcsec (388 of 463)": "share of the catalog matched",
}


def load(run):
    """The configuration of a run, and its tables as `~miricigale.evaluation.StudyResults`."""
    config = load_config(run / "config.toml")
    context = Context(config, run)
    truths = {name: one for name, one in study_truths(config).items() if not one.perturbations}
    every = {name: StudyTables(context, name) for name in truths}
    metrics = json.loads((run / "report" / "metrics.json").read_text())
    for band in metrics["bands"].values():
        band.update({key: np.nan for key, value in band.items() if value is None})
    study = study_results(config, truths, every, metrics)
    bands = config.exposures.filters
    kernels = {band: MatchingKernel.read(run / f"kernel_{band}.fits") for band in bands}
    extra = extra_numbers(study, metrics, kernels)
    extra |= source_extractor_numbers(read_rivals(context), config.run.seed)
    return config, dataclasses.replace(study, extra=extra)


def cut(one, keep, matched=None):
    """A truth with those sources alone, in the field and in the sample."""
    matched = one.matched.copy() if matched is None else matched
    selection = np.asarray(matched["selection"]).copy()
    selection[~keep] |= SampleFlags.OUTSIDE_FIELD
    matched["selection"] = selection
    rows = (selection == 0)[one.sample]
    fits = {name: table[rows] for name, table in one.fits.items()}
    return dataclasses.replace(one, matched=matched, fits=fits, field=one.field & keep)


def without_nearby(study):
    """The study without sources at true redshifts below 0.2, most of which are doubtful."""
    truths = [cut(one, ~(np.asarray(one.truth["redshift"], float) < 0.2)) for one in study.truths]
    return dataclasses.replace(study, truths=tuple(truths), extra={})


def with_proposal(study, shallower=0.0):
    """The study with the proposal's limits (or shallower, mag) and the sample they leave; fits as they are."""
    truths = []
    for one in study.truths:
        matched = one.matched.copy()
        for band in study.bands:
            matched[error_column(band)] = proposal_limit(band).to(FNU) / 5 * 10 ** (0.4 * shallower)
        few = detected_bands(matched, study.bands) < 2
        matched["n_detected"] = detected_bands(matched, study.bands)
        found = cut(one, ~few, matched)
        truths.append(dataclasses.replace(found, field=one.field))
    return dataclasses.replace(study, truths=tuple(truths), limits={}, extra={})


def of_exposures(config, band):
    """Limit (AB) in the calculator's aperture of the exposures as they are, not scaled from 10 ks."""
    exposures = band_exposures(config, band)
    time = sum((one.exposure_time for one in exposures), 0 * u.s)
    options = {"n_groups": exposures[0].n_groups, "n_dithers": len(exposures)}
    found = sensitivity(band, time, method="aperture", residual="etc", **options)
    return float(found.to_value(u.ABmag))


def without_runs(config, study):
    """The study with each thing that needs no run of its own, and the only numbers that it is for."""
    limits = {band: of_exposures(config, band) for band in study.bands}
    nothing = dataclasses.replace(study, extra={})
    extra = {}
    for band in study.bands:
        # the detector's scattered light was not known yet
        psf = miri_psf(band, includes=("jitter", "pixel"))
        value = aperture_correction(psf, STAMP_RADIUS)
        extra[f"f_aper.{band.removeprefix('miri.')}"] = Estimate(value)
    return {
        "redshift": (without_nearby(study), None),
        "limits": (with_proposal(study), None),
        # as similar to the proposal's as the paper says its own are (within 1 mag)
        "shallower": (with_proposal(study, 0.5), None),
        "calculator": (dataclasses.replace(nothing, etc_limits=limits), ("etc.", "limit_now.")),
        "psf": (dataclasses.replace(nothing, extra=extra), ("f_aper.",)),
    }


def compared(study, seed, only=None):
    """Rows of the comparison by key; of some keys alone if their beginnings are given."""
    table = compare_with_paper(study, seed=seed)
    return {row["key"]: row for row in table if only is None or row["key"].startswith(only)}


def beside(study, here, other, seed):
    """Rows of another run, and those of the study with the same AGN fractions, if it has fewer."""
    names = [one.name for one in other.truths]
    truths = tuple(one for one in study.truths if one.name in names)
    same = all(one.name in names for one in study.with_agn)
    own = here if same else compared(dataclasses.replace(study, truths=truths), seed)
    return compared(other, seed), own


def shown(row):
    """A number with half the width of its interval."""
    value, error = row["ours"], 0.5 * (row["high"] - row["low"])
    if not np.isfinite(value):
        return ""
    if not (np.isfinite(error) and error > 0):
        return f"{value:.4g}"
    digits = max(0, 1 - int(np.floor(np.log10(error))))
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def differs(row):
    return row["verdict"].startswith("differs")


def apart(row):
    """How far a number is from the paper's, in errors if it has any."""
    if not differs(row):
        return ""
    return f"{row['sigma']:+.1f} σ" if np.isfinite(row["sigma"]) else row["verdict"].split()[2][:-1]


def distance(row):
    """Distance to the paper's number, or to its bound."""
    value = abs(row["ours"]) if row["relation"] == "<" else row["ours"]
    delta = value - row["paper"]
    if (row["relation"] == "<" and delta <= 0) or (row["relation"] == ">" and delta >= 0):
        return 0.0
    return abs(delta)


def best_thing(key, things):
    """The thing that takes a number nearest to the paper's, its row, and the share of the difference gone."""
    found = [("", None, 0.0)]
    for name, (rows, own) in things.items():
        other = rows.get(key)
        if other is not None and np.isfinite(other["ours"]) and differs(own[key]):
            found.append((name, other, 1 - distance(other) / distance(own[key])))
    return max(found, key=lambda one: one[2])


def paper_cell(row):
    mark = {"=": "", "~": "about "}.get(row["relation"], f"{row['relation']} ")
    return f"{mark}{row['paper']:.4g}"


def section(row):
    """The first section that a number stands in, or the abstract."""
    text = row["source"].removeprefix("abstract, ").split(",")[0]
    return text.replace("section ", "").replace("appendix ", "").strip()


def name_of(row):
    text = row["description"]
    for long, short in SHORT.items():
        text = text.replace(long, short)
    return text


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument("run", type=Path)
    parser.add_argument("--like", nargs="+", default=[], metavar="NAME=RUN")
    parser.add_argument("--all", type=Path, help="run with all of them")
    parser.add_argument("--reasons", action="store_true", help="print the reasons alone, as TOML")
    args = parser.parse_args()
    config, study = load(args.run)
    seed = config.run.seed
    here = compared(study, seed)
    things = {}
    for name, path in (one.split("=", 1) for one in args.like):
        if name not in THINGS:
            parser.error(f"{name!r} is none of {', '.join(THINGS)}")
        things[name] = beside(study, here, load(Path(path))[1], seed)
    for name, (other, only) in without_runs(config, study).items():
        things[name] = compared(other, seed, only), here
    every, deeper = {}, {}
    if args.all:
        theirs = load(args.all)[1]
        every, deeper = compared(theirs, seed), compared(with_proposal(theirs, 0.5), seed)
    best = {key: best_thing(key, things) for key, row in here.items() if differs(row)}
    if args.reasons:
        for key, (name, other, share) in best.items():
            if share >= OPEN:
                print(f'"{key}" = "{shown(other)} with {THINGS[name][1]} ({round(100 * share)} %)"')
        return
    order = sorted(here.values(), key=lambda row: section(row))
    library = things.get("libraries", ({}, {}))[0]
    agree, differ = [], []
    for row in order:
        cells = [name_of(row), section(row), paper_cell(row), shown(row)]
        other, full = library.get(row["key"]), every.get(row["key"])
        if not differs(row):
            agree.append(
                [*cells, *(f"{shown(one)} {apart(one)}" if one else "" for one in (other, full))]
            )
            continue
        name, found, share = best[row["key"]]
        cells[-1] += f", {apart(row)}"
        if share < OPEN:
            cells += ["open", "", ""]
        else:
            then = f"{shown(found)}, {apart(found)}" if differs(found) else f"**{shown(found)}**"
            cells += [THINGS[name][0], then, f"{round(100 * share)} %"]
        text = ""
        if full:
            text = f"{shown(full)}, {apart(full)}" if differs(full) else f"**{shown(full)}**"
        differ.append([*cells, text])
    fill = [[[cell.strip() or "\\ " for cell in row] for row in rows] for rows in (agree, differ)]
    header = ["number", "in", "paper", "here"]
    print(
        rst_table([*header, "one thing as theirs", "then", "gone", "all as theirs"], fill[1]), "\n"
    )
    print(rst_table([*header, "with libraries", "all as theirs"], fill[0]), "\n")
    runs = {"here": here, **{name: rows for name, (rows, _) in things.items()}, "all": every}
    for name, rows in runs.items():
        known = [row for row in rows.values() if np.isfinite(row["ours"])]
        print(name, len(known), "known,", sum(differs(row) for row in known), "differ")
    one = [key for key in best if best[key][1] is not None and not differs(best[key][1])]
    both = [k for k in best if k not in one and k in every and not differs(every[k])]
    print(
        len(here) - len(best), "agree;", len(one), "with one thing;", len(both), "with all alone;"
    )
    for key in set(best).difference(one, both) & set(deeper):
        print("all, and shallower limits:", key, shown(deeper[key]), apart(deeper[key]))
    print("open:", [str(key) for key, (_, _, share) in best.items() if share < OPEN])


if __name__ == "__main__":
    main()
