"""All truths of a run beside Yang et al. 2021: tables, numbers of other products, reasons."""

import numpy as np

from miricigale.evaluation import (
    COLOR_WINDOWS,
    PUBLISHED,
    Estimate,
    StudyResults,
    TruthResults,
    color_estimates,
    compare_with_paper,
    comparison_rows,
    mid_infrared_fractions,
)
from miricigale.evaluation.paper import ONE_FIELD
from miricigale.workflow.stages.conditions import ConditionFlags
from miricigale.workflow.stages.provenance import STAND_INS
from miricigale.workflow.stages.sample import SampleFlags, matched_errors

__all__ = ["agn_shares", "extra_numbers", "reasons_of", "study_results", "write_comparison"]

_OUT = SampleFlags.OUTSIDE_FIELD | SampleFlags.STAR | SampleFlags.NO_MODEL
#: Magnitudes of a small relative change of the flux.
_MAG = 2.5 / np.log(10)


def _truth_results(truth, tables, bands):
    """One truth as `~miricigale.evaluation.TruthResults`."""
    matched = tables.matched
    near = int(ConditionFlags.CROWDED)
    return TruthResults(
        truth.name,
        None if isinstance(truth.frac_agn, str) else truth.frac_agn,
        tables.truth,
        matched,
        tables.fits,
        (np.asarray(matched["selection"]) & _OUT) == 0,
        {name: (np.asarray(matched[f"{name}_condition"]) & near) > 0 for name in bands},
    )


def study_results(config, truths, every, metrics):
    """
    All truths as `~miricigale.evaluation.StudyResults`.

    ``truths`` and ``every`` are `~miricigale.workflow.truths.Truth` and ``StudyTables`` by name, the
    reference first; ``metrics`` are those of the report.
    """
    bands = config.exposures.filters
    reference = next(iter(every.values()))
    # the paper's limits are where the median absolute difference is a fifth of the flux
    errors = matched_errors(
        reference.matched,
        (np.asarray(reference.matched["selection"]) & SampleFlags.OUTSIDE_FIELD) == 0,
        bands,
        statistic="median_abs",
        bin_size=config.errors.bin_size,
    )
    return StudyResults(
        tuple(_truth_results(truths[name], tables, bands) for name, tables in every.items()),
        bands,
        config.highres.filter,
        {name: float(errors.limiting_magnitude(name).value) for name in bands},
        {name: metrics["bands"][name]["etc_limit"] for name in bands},
    )


def agn_shares(study, model):
    """
    True AGN shares of the 5-15 um light of the fitted sources, by truth; NaN of all others.

    Empty without the bands of the colors that they are for, or without an AGN.
    """
    needed = {band for window in COLOR_WINDOWS for band in window.bands}
    if not needed <= set(study.bands) or len(study.truths) < 2:
        return {}
    shares = {}
    for one in study.truths:
        values = np.full(len(one.truth), np.nan)
        agn = np.asarray(one.truth["frac_agn"], float) > 0
        values[one.sample & ~agn] = 0.0
        rows = one.sample & agn
        if rows.any():
            values[rows] = mid_infrared_fractions(model, one.truth[rows])
        shares[one.name] = values
    return shares


def extra_numbers(study, metrics, shares, seed):
    """
    Numbers by key of `~miricigale.evaluation.PUBLISHED` that are not of the tables of the truths.

    Of detection, bright point sources and colors; ``shares`` are those of `agn_shares`.
    """
    n, one = metrics["detections"]["n_field"], study.truths[0]
    found = np.asarray(one.matched["matched"], bool)[one.field]
    extra = {
        "detected_catalog": Estimate(n, n - np.sqrt(n), n + np.sqrt(n), n),
        "matched_catalog": Estimate.of_fraction(np.count_nonzero(found), found.size),
    }
    offsets, scatters = [], []
    for band, entry in metrics["bands"].items():
        if "points_n" not in entry:
            continue
        label = band.rpartition(".")[2]
        scaling, error = entry["f_scaling"], entry["f_scaling_err"]
        count = entry["points_n"]
        extra[f"f_scaling.{label}"] = Estimate(scaling, scaling - error, scaling + error, count)
        extra[f"f_aper.{label}"] = Estimate(entry["f_aper"])
        offsets.append((abs(_MAG * entry["points_median"]), count))
        scatters.append((_MAG * entry["points_scatter"], count))
    for key, values in (("points.offset", offsets), ("points.scatter", scatters)):
        values = [(value, count) for value, count in values if np.isfinite(value)]
        if values:
            value, count = max(values)
            extra[key] = Estimate(value, n=count)
    if shares:
        extra |= color_estimates(study, shares, seed=seed)
    return extra


#: Of the dust with which most numbers of the paper come out (inferred).
_PAPER_ALPHA = 1.0


def _facts(config, metrics, model):
    """What the run does otherwise than Yang et al. 2021: by topic, in a few words and in a sentence."""
    n = metrics["n_field"]
    facts = {
        "field": ("another field", f"the field is another one: {n} galaxies; theirs has 463."),
    }
    if not metrics["as_paper"]:
        facts["exposures"] = ("other exposures", "exposures or bands are not theirs.")
    if config.errors.statistic == "mad":
        sentence = (
            "errors are 1.48 times the median absolute difference; theirs are the median itself, so that "
            "their 5 sigma are 3.4 of Gaussian errors."
        )
        facts["statistic"] = ("errors 1.48 times theirs, which lowers it", sentence)
    if config.detector.residual == 0.0:
        facts["residual"] = (
            "no residual of the flat field",
            "images have no residual of flat field and sky beyond photon and read noise.",
        )
    if config.photometry.method != "yang2021":
        facts["method"] = (
            "other templates",
            "templates of the photometry have wings, where theirs end at the segments.",
        )
    if config.fit.axes != "fit":
        facts["grid"] = ("a coarse grid", "the grid of the fit is coarser than theirs.")
    deeper = [m["limit"] - m["proposal"] for m in metrics["bands"].values()]
    shares = {row["limit"]: row["to_proposal"] for row in metrics["detected"]}
    if np.isfinite([*deeper, *shares.values()]).all() and shares:
        told = " and ".join(f"{100 * share:.0f} % of H < {h:g}" for h, share in shares.items())
        sentence = (
            f"5-sigma limits are {min(deeper):+.1f} to {max(deeper):+.1f} mag fainter than those of the CEERS "
            f"proposal; to those {told} would be detected."
        )
        facts["limits"] = ("other limits", sentence)
    low, high = config.sed.alpha
    if not low == high == _PAPER_ALPHA:
        sentence = (
            f"the dust of the galaxies has alpha from {low:g} to {high:g}, which the bands of their fit do not "
            "show; several numbers of the paper come out with alpha = 1 alone, dust with few PAHs, with which "
            "fewer galaxies are detected, and from which an AGN is told more easily."
        )
        facts["dust"] = ("dust of other alpha", sentence)
    names = [name for name in model.resources if name in STAND_INS]
    if names:
        facts["libraries"] = (
            "stand-in libraries",
            f"{', '.join(names)} stand in for their libraries.",
        )
    return facts


#: Topics of `_facts` that bear on a quantity; on numbers of other products by the beginning of the key.
_TOPICS = {
    "detected_share": ("field", "exposures", "limits", "dust", "statistic", "residual"),
    "frac_offset": ("exposures", "dust", "residual", "grid", "libraries", "field"),
    "frac_scatter": ("exposures", "dust", "residual", "grid", "libraries", "field"),
    "frac_offset_ratio": ("exposures", "dust", "residual", "grid", "libraries", "field"),
    "class_share": ("exposures", "dust", "residual", "grid", "libraries", "field"),
    "mips_share": ("field",),
    "detected_catalog": ("field",),
    "matched_catalog": ("field",),
    "etc_limit": ("exposures",),
    "limit_offset": ("residual", "exposures", "method"),
    "shape_offset": ("method", "field"),
    "magnitude_scatter": ("method", "residual", "field"),
    "shape_share": ("field",),
    "crowded_share": ("field",),
    "signal_to_noise": ("statistic", "exposures", "residual", "field"),
    "points": ("exposures", "residual"),
    "colors": ("exposures", "libraries"),
    "power_offset": ("exposures", "grid", "libraries"),
    "power_scatter": ("exposures", "grid", "libraries"),
    "xray_half": ("exposures", "residual", "field", "libraries"),
}
_OF_FITS = ("exposures", "residual", "grid", "libraries", "field")


def reasons_of(config, metrics, model):
    """
    Why numbers of a run may differ from the paper's: reasons by key, and what they mean.

    Returns
    -------
    reasons : dict of str to str
        General reasons, and the run's own in a few words, by key of `~miricigale.evaluation.PUBLISHED`.
    sentences : list of str
        What each of the run's own means.
    """
    facts, reasons = _facts(config, metrics, model), {}
    for one in PUBLISHED:
        topic = one.quantity if one.quantity != "extra" else one.key.partition(".")[0]
        if topic == "f_aper":
            reasons[one.key] = "a PSF with other wings; the factor is not applied"
        if topic in ("feature", "f_scaling", "f_aper", "source_extractor"):
            continue
        # that the field is another one is among the facts
        general = [part for part in one.why.split("; ") if part and part != ONE_FIELD]
        told = [facts[name][0] for name in _TOPICS.get(topic, _OF_FITS) if name in facts]
        reasons[one.key] = "; ".join([*general, *told])
    return reasons, [f"{short}: {sentence}" for short, sentence in facts.values()]


def write_comparison(context, report, study, reasons, sentences):
    """The section that holds all numbers of Yang et al. 2021 against those of the run."""
    table = compare_with_paper(study, seed=context.seed, reasons=reasons)
    context.save_table("report/paper.ecsv", table)
    report.section(
        "Beside Yang et al. 2021",
        "Every number of the paper's results, and this run's with its bootstrap error: conclusions are to be "
        "compared, not digits. [?] marks numbers that were not read in the paper itself; completeness is the "
        "share of the field's galaxies that a number is of. What this run does otherwise:",
    )
    report.bullets(sentences)
    report.table(
        comparison_rows(table),
        header=("part", "number", "paper", "here", "completeness", "verdict"),
        caption="Numbers of Yang et al. 2021 and of this run",
        text=(0, 1, 5),
    )
