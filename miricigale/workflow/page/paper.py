"""All truths of a run compared with Yang et al. 2021: tables, numbers of other products, differences."""

import collections

import numpy as np

from miricigale.evaluation import Estimate, StudyResults, TruthResults, compare_with_paper
from miricigale.pages import number, sentence
from miricigale.workflow.labels import texts_of
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
    results, crowded = [], ConditionFlags.CROWDED
    for name, tables in every.items():
        fraction, matched = truths[name].frac_agn, tables.matched
        fraction = None if isinstance(fraction, str) else fraction
        parts = fraction, tables.truth, matched, tables.fits, tables.field
        near = {band: has_flag(matched, f"{band}_condition", crowded) for band in bands}
        results.append(TruthResults(name, *parts, near))
    limits = {name: float(errors.limiting_magnitude(name).value) for name in bands}
    calculator = {name: metrics["bands"][name]["etc_limit"] for name in bands}
    return StudyResults(tuple(results), bands, config.highres.filter, limits, calculator)


def extra_numbers(study, metrics, kernels):
    """
    Numbers by key of `~miricigale.evaluation.PUBLISHED` that are not of the tables of the truths.

    Of detection, kernels (`~miricigale.psf.MatchingKernel` by band) and bright point sources.
    """
    n, one = metrics["detections"]["n_field"], study.truths[0]
    found = np.asarray(one.matched["matched"], bool)[one.field]
    extra = {
        "detected_catalog": Estimate.of_count(n),
        "matched_catalog": Estimate.of_fraction(np.count_nonzero(found), found.size),
    }
    for one in study.truths:
        if one.frac_agn is None:
            n_agn = np.count_nonzero(one.field & (np.asarray(one.truth["frac_agn"]) > 0))
            extra["agn.field"] = Estimate.of_count(n_agn)
    off = {band: np.abs(one.encircled_energy_error()).max() for band, one in kernels.items()}
    extra["kernels"] = Estimate(max(off.values()), n=len(off))
    red = [value for band, value in off.items() if band != "miri.f770w"]
    extra["kernels.red"] = Estimate(max(red, default=np.nan), n=len(red))
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
    return extra


#: Of the dust with which most numbers of the paper come out (inferred).
_PAPER_ALPHA = 1.0


def differences_of(config, metrics, model):
    """What a run does otherwise than Yang et al. 2021: a list of sentences."""
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
    texts = texts_of("differences")
    return [sentence(texts[topic], facts) for topic, differ in differs.items() if differ]


#: What verdicts are in the plural, by their first words; others are as they stand.
_VERDICTS = {"agrees": "agree", "differs": "differ"}


def write_comparison(page, reasons, sentences):
    """The section with all numbers of Yang et al. 2021 and those of the run."""
    same = page.metrics["as_paper"]
    options = {"seed": page.context.seed, "reasons": reasons, "same_exposures": same}
    table = compare_with_paper(page.study, **options)
    counts = collections.Counter(_VERDICTS.get(v.split()[0], v) for v in table["verdict"])
    verdicts = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    page.numbers("paper", table, verdicts=verdicts)
    page.text("judged" if same else "other_exposures")
    with page.folding("differences", n_differences=len(sentences)):
        page.report.bullets(sentences)
    rows = []
    for row in table:
        mark = {"=": "", "~": "about "}.get(row["relation"], f"{row['relation']} ")
        low, high = row["low"], row["high"]
        known = np.isfinite([low, high]).all()
        form = f"{{:.3g}} ± {0.5 * (high - low):.2g}" if known else ".3g"
        cells = {
            "paper": f"{mark}{row['paper']:.3g}",
            "ours": number(row["ours"], form, "not measured in this study"),
        }
        rows.append({name: row[name] for name in table.colnames} | cells)
    page.table("table", rows, n_numbers=len(rows))
