"""All truths of a run compared with Yang et al. 2021: tables, numbers of other products, differences."""

import collections

import numpy as np

from miricigale.evaluation import Estimate, StudyResults, TruthResults, compare_with_paper
from miricigale.pages import number, sentence
from miricigale.utils.named_values import first_value, subset
from miricigale.workflow.labels import texts_of
from miricigale.workflow.stages.conditions import ConditionFlags, has_flag
from miricigale.workflow.stages.sample import matched_errors

#: Magnitudes of a small relative change of the flux.
_MAG = 2.5 / np.log(10)


def study_results(config, truths, tables, metrics):
    """
    Return all truths as `~miricigale.evaluation.StudyResults`.

    ``truths`` and ``tables`` are `~miricigale.workflow.truths.Truth` and ``StudyTables`` by name, the
    reference first; ``metrics`` are those of the report.
    """
    bands = config.exposures.filters
    reference = first_value(tables)
    # the paper's limits are where the median absolute difference is a fifth of the flux
    errors = matched_errors(
        reference.matched,
        reference.inside,
        bands,
        statistic="median_abs",
        bin_size=config.errors.bin_size,
    )
    limits = {}
    calculator = {}
    for band in bands:
        limits[band] = float(errors.limiting_magnitude(band).value)
        calculator[band] = metrics["bands"][band]["etc_limit"]
    results = []
    for name, study in tables.items():
        frac_agn = truths[name].frac_agn
        if isinstance(frac_agn, str):
            frac_agn = None
        crowded = {}
        for band in bands:
            column = f"{band}_condition"
            crowded[band] = has_flag(study.matched, column, ConditionFlags.CROWDED)
        results.append(
            TruthResults(
                name, frac_agn, study.truth, study.matched, study.fits, study.field, crowded
            )
        )
    return StudyResults(tuple(results), bands, config.highres.filter, limits, calculator)


def extra_numbers(study, metrics, kernels):
    """
    Return numbers by key of `~miricigale.evaluation.PUBLISHED` that are not of the tables of the truths.

    Of detection, kernels (`~miricigale.psf.MatchingKernel` by band) and bright point sources.
    """
    reference = study.truths[0]
    matched = np.asarray(reference.matched["matched"], bool)[reference.field]
    extra = {
        "detected_catalog": Estimate.of_count(metrics["detections"]["n_field"]),
        "matched_catalog": Estimate.of_fraction(np.count_nonzero(matched), matched.size),
    }
    for truth in study.truths:
        if truth.frac_agn is None:
            n_agn = np.count_nonzero(truth.field & (np.asarray(truth.truth["frac_agn"]) > 0))
            extra["agn.field"] = Estimate.of_count(n_agn)
    errors = {}
    for band, kernel in kernels.items():
        errors[band] = np.abs(kernel.encircled_energy_error()).max()
    extra["kernels"] = Estimate(max(errors.values()), n=len(errors))
    errors.pop("miri.f770w", None)
    extra["kernels.red"] = Estimate(max(errors.values(), default=np.nan), n=len(errors))
    offsets = []
    scatters = []
    for band, entry in metrics["bands"].items():
        if "points_n" not in entry:
            continue
        n = entry["points_n"]
        label = band.rpartition(".")[2]
        scaling = entry["f_scaling"]
        error = entry["f_scaling_err"]
        extra[f"f_scaling.{label}"] = Estimate(scaling, scaling - error, scaling + error, n)
        extra[f"f_aper.{label}"] = Estimate(entry["f_aper"])
        offsets.append((abs(_MAG * entry["points_median"]), n))
        scatters.append((abs(_MAG * entry["points_scatter"]), n))
    for key, sizes in (("points.offset", offsets), ("points.scatter", scatters)):
        # the largest of all bands
        sizes = [(size, n) for size, n in sizes if np.isfinite(size)]
        if sizes:
            size, n = max(sizes)
            extra[key] = Estimate(size, n=n)
    return extra


#: Of the dust with which most numbers of the paper come out (inferred).
_PAPER_ALPHA = 1.0


def differences_of(config, metrics, model):
    """Return what a run does otherwise than Yang et al. 2021: a list of sentences."""
    deeper = [entry["limit"] - entry["proposal"] for entry in metrics["bands"].values()]
    shares = {row["limit"]: row["to_proposal"] for row in metrics["detected"]}
    stand_ins = [name for name in model.resources if name in texts_of("stand_ins")]
    to_proposal = [f"{100 * share:.0f} % of H < {limit:g}" for limit, share in shares.items()]
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
        "to_proposal": " and ".join(to_proposal),
        "alpha": config.sed.alpha,
        "stand_ins": ", ".join(stand_ins),
    }
    texts = texts_of("differences")
    return [sentence(texts[topic], facts) for topic, differ in differs.items() if differ]


#: What verdicts are in the plural, by their first words; others are as they stand.
_VERDICTS = {"agrees": "agree", "differs": "differ"}


def write_comparison(page, reasons, sentences):
    """Write the section with all numbers of Yang et al. 2021 and those of the run."""
    same_exposures = page.metrics["as_paper"]
    table = compare_with_paper(
        page.study,
        seed=page.context.seed,
        reasons=reasons,
        same_exposures=same_exposures,
    )
    counts = collections.Counter(_VERDICTS.get(v.split()[0], v) for v in table["verdict"])
    verdicts = ", ".join(f"{n} {verdict}" for verdict, n in counts.most_common())
    page.numbers("paper", table, verdicts=verdicts)
    page.text("judged" if same_exposures else "other_exposures")
    with page.folding("differences", n_differences=len(sentences)):
        page.report.bullets(sentences)
    rows = []
    for numbers in table:
        row = subset(numbers, table.colnames)
        row["paper"] = f"{_relation(row['relation'])}{row['paper']:.3g}"
        form = ".3g"
        low = row["low"]
        high = row["high"]
        if np.isfinite(low) and np.isfinite(high):
            form = f"{{:.3g}} ± {0.5 * (high - low):.2g}"
        row["ours"] = number(row["ours"], form, "not measured in this study")
        rows.append(row)
    page.table("table", rows, n_numbers=len(rows))


def _relation(sign):
    """Return the relation of a number in front of it: nothing for an equal one."""
    if sign == "=":
        return ""
    if sign == "~":
        return "about "
    return f"{sign} "
