"""All truths of a run compared with Yang et al. 2021: tables, numbers of other products, reasons."""

import numpy as np

from miricigale.evaluation import (
    COLOR_WINDOWS,
    PUBLISHED,
    Estimate,
    StudyResults,
    TruthResults,
    color_estimates,
    compare_with_paper,
    mid_infrared_fractions,
)
from miricigale.evaluation.paper import ONE_FIELD
from miricigale.pages import number, sentence
from miricigale.workflow.page.declared import texts_of
from miricigale.workflow.stages.conditions import ConditionFlags, has_flag
from miricigale.workflow.stages.sample import matched_errors

#: Magnitudes of a small relative change of the flux.
_MAG = 2.5 / np.log(10)


def study_results(config, truths, every, metrics):
    """
    All truths as `~miricigale.evaluation.StudyResults`.

    ``truths`` and ``every`` are `~miricigale.workflow.truths.Truth` and ``StudyTables`` by name, the
    reference first; ``metrics`` are those of the report.
    """
    bands = config.exposures.filters
    reference = next(iter(every.values()))
    # the paper's limits are where the median absolute difference is a fifth of the flux
    options = {"statistic": "median_abs", "bin_size": config.errors.bin_size}
    errors = matched_errors(reference.matched, reference.inside, bands, **options)
    return StudyResults(
        tuple(
            TruthResults(
                name,
                None if isinstance(truths[name].frac_agn, str) else truths[name].frac_agn,
                tables.truth,
                tables.matched,
                tables.fits,
                tables.field,
                {
                    band: has_flag(tables.matched, f"{band}_condition", ConditionFlags.CROWDED)
                    for band in bands
                },
            )
            for name, tables in every.items()
        ),
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
    points = {band: one for band, one in metrics["bands"].items() if "points_n" in one}
    for band, one in points.items():
        label, scaling, error = band.rpartition(".")[2], one["f_scaling"], one["f_scaling_err"]
        ends = (scaling - error, scaling + error)
        extra[f"f_scaling.{label}"] = Estimate(scaling, *ends, one["points_n"])
        extra[f"f_aper.{label}"] = Estimate(one["f_aper"])
    for key, name in (("points.offset", "points_median"), ("points.scatter", "points_scatter")):
        sizes = [(abs(_MAG * one[name]), one["points_n"]) for one in points.values()]
        sizes = [(size, n) for size, n in sizes if np.isfinite(size)]
        if sizes:
            value, count = max(sizes)
            extra[key] = Estimate(value, n=count)
    if shares:
        extra |= color_estimates(study, shares, seed=seed)
    return extra


#: Of the dust with which most numbers of the paper come out (inferred).
_PAPER_ALPHA = 1.0


def _differences(config, metrics, model):
    """What a run does otherwise than Yang et al. 2021: topics, in their order, with facts for their sentences."""
    deeper = [m["limit"] - m["proposal"] for m in metrics["bands"].values()]
    shares = {row["limit"]: row["to_proposal"] for row in metrics["detected"]}
    stand_ins = [name for name in model.resources if name in texts_of("stand_ins")]
    differs = {
        "field": True,
        "exposures": not metrics["as_paper"],
        "statistic": config.errors.statistic == "mad",
        "residual": config.detector.residual == 0.0,
        "method": config.photometry.method != "yang2021",
        "grid": config.fit.axes != "fit",
        "limits": bool(shares) and np.isfinite([*deeper, *shares.values()]).all(),
        "dust": set(config.sed.alpha) != {_PAPER_ALPHA},
        "libraries": bool(stand_ins),
    }
    facts = {
        "n_field": metrics["n_field"],
        "least_deeper": min(deeper),
        "most_deeper": max(deeper),
        "to_proposal": " and ".join(f"{100 * x:.0f} % of H < {h:g}" for h, x in shares.items()),
        "alpha": config.sed.alpha,
        "stand_ins": ", ".join(stand_ins),
    }
    return [topic for topic, differ in differs.items() if differ], facts


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
    topics, facts = _differences(config, metrics, model)
    words, reasons = {topic: texts_of("differences")[topic] for topic in topics}, {}
    bearing = texts_of("bearing")
    for one in PUBLISHED:
        topic = one.quantity if one.quantity != "extra" else one.key.partition(".")[0]
        if topic == "f_aper":
            reasons[one.key] = "a PSF with other wings; the factor is not applied"
        if topic in ("feature", "f_scaling", "f_aper", "source_extractor"):
            continue
        # that the field is another one is among the run's own
        general = [part for part in one.why.split("; ") if part and part != ONE_FIELD]
        own = [words[name][0] for name in bearing.get(topic, bearing["other"]) if name in words]
        reasons[one.key] = "; ".join([*general, *own])
    return reasons, [sentence(f"{short}: {text}", facts) for short, text in words.values()]


def write_comparison(page, reasons, sentences):
    """The section with all numbers of Yang et al. 2021 and those of the run."""
    table = compare_with_paper(page.study, seed=page.context.seed, reasons=reasons)
    page.numbers("paper", table)
    page.report.bullets(sentences)
    rows = []
    for row in table:
        mark = {"=": "", "~": "about "}.get(row["relation"], f"{row['relation']} ")
        second_hand = "" if row["source"] else " [?]"
        low, high = row["low"], row["high"]
        known = np.isfinite([low, high]).all()
        form = f"{{:.3g}} ± {0.5 * (high - low):.2g}" if known else ".3g"
        cells = {
            "paper": f"{mark}{row['paper']:.3g}{second_hand}",
            "ours": number(row["ours"], form, "not measured in this study"),
        }
        rows.append({name: row[name] for name in table.colnames} | cells)
    page.table("table", rows)
