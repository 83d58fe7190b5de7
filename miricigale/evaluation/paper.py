"""The numbers of Yang et al. 2021, and a study's beside them."""

import dataclasses

import numpy as np

from miricigale.evaluation.estimates import Estimate
from miricigale.evaluation.quantities import QUANTITIES, SHARES, measure
from miricigale.pages import Missing
from miricigale.utils.exceptions import unknown_name
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import described_rows

__all__ = ["PUBLISHED", "PublishedNumber", "compare_with_paper", "comparison_rows"]

#: Differences below this many errors are none.
_AGREES = 2.0


@dataclasses.dataclass(frozen=True)
class PublishedNumber:
    """
    A number of Yang et al. 2021 (ApJ 908, 144).

    Parameters
    ----------
    key : str
        Unique name.
    quantity : str
        Name of `~miricigale.evaluation.QUANTITIES`, or ``"extra"`` for one of other products.
    value : float
        What the paper has.
    text : str
        What it is of.
    section : str
        Part of the paper's results.
    error : float, optional
        The paper's error or range; none by default.
    relation : str, optional
        ``"="``, ``"~"`` (about), ``"<"`` or ``">"`` (a bound).
    truth : float or None, optional
        Injected AGN fraction; None for those above 0 together.
    band_set : str, optional
        MIRI bands of the fit.
    option : optional
        A band, magnitude, bin of redshift or class.
    definition : str, optional
        How it is taken.
    source : str, optional
        Where it was read; without, it is second hand, marked ``[?]``.
    why : str, optional
        Why a study may differ.
    """

    key: str
    quantity: str
    value: float
    text: str
    section: str
    error: float = 0.0
    relation: str = "="
    truth: float | None = 0.0
    band_set: str = "all"
    option: object = None
    definition: str = ""
    source: str = ""
    why: str = ""


#: What has been read of the paper: https://arxiv.org/abs/2011.08192.
_ABSTRACT = "abstract"
#: Reason for which any number of a sample differs.
ONE_FIELD = "another field and another random draw"
_PRIOR = "an empty posterior centers on the mean of the prior"


def _detection():
    for limit, share in ((26.0, 0.53), (25.0, 0.75)):
        yield PublishedNumber(
            f"detected.{limit:g}", "detected_share", share, f"H < {limit:g}", "detection",
            option=limit, why=ONE_FIELD,
            definition="sources of the field above 5 sigma of the error function in two or more bands",
        )  # fmt: skip
    for limit, share in ((26.0, 0.05), (25.0, 0.09)):
        yield PublishedNumber(
            f"mips.{limit:g}", "mips_share", share, f"H < {limit:g}", "detection",
            option=(limit, "mips.24", 19.3), why=ONE_FIELD,
            definition="true flux at 24 µm above 19.3 AB, the depth of the mock photometry",
        )  # fmt: skip
    own = {"detected_catalog": (545, "detections on the F160W image"),
           "matched_catalog": (388 / 463, "share of the catalog matched within 1 arcsec")}  # fmt: skip
    for key, (value, text) in own.items():
        yield PublishedNumber(key, "extra", value, text, "detection", why=ONE_FIELD)


def _limits():
    etc = {"f770w": 25.5, "f1000w": 24.8, "f1280w": 24.3, "f1500w": 23.8, "f1800w": 22.9,
           "f2100w": 22.8}  # fmt: skip
    for name, limit in etc.items():
        band = f"miri.{name}"
        yield PublishedNumber(
            f"etc.{name}", "etc_limit", limit, name.upper(), "limits", option=band,
            why="another version of the calculator",
        )  # fmt: skip
        last = name == "f2100w"
        yield PublishedNumber(
            f"limit.{name}", "limit_offset", -0.95 if last else -1.0, name.upper(), "limits",
            relation="=" if last else ">", option=band,
            definition="limit where the error function, of the paper's statistic, is 0.217 mag",
            why="the calculator allows for residuals of flat field and sky in its own way",
        )  # fmt: skip


def _photometry():
    shape = "sources of the field whose true flux is above 5 sigma, all bands together, fracAGN 0"
    for name in ("point", "n < 2"):
        yield PublishedNumber(
            f"offset.{name}", "shape_offset", 0.0, name, "photometry", relation="~", error=0.05,
            option=name, definition=shape,
        )  # fmt: skip
    yield PublishedNumber(
        "offset.n >= 2", "shape_offset", 0.0, "n >= 2", "photometry", relation=">",
        option="n >= 2", definition=shape,
        why="the paper's templates end at their segments and lose the wings (tenths of a magnitude)",
    )  # fmt: skip
    yield PublishedNumber(
        "share.n >= 2", "shape_share", 0.21, "n >= 2", "photometry", option="n >= 2",
        why=ONE_FIELD,
    )  # fmt: skip
    yield PublishedNumber(
        "share.crowded", "crowded_share", 0.15, "a neighbor within 2 arcsec brighter than m + 1",
        "photometry", why=f"{ONE_FIELD}; here crowded in any band",
    )  # fmt: skip
    for name, scatter in (("crowded", 0.23), ("isolated", 0.17)):
        yield PublishedNumber(
            f"scatter.{name}", "magnitude_scatter", scatter, name, "photometry", option=name,
            definition=shape, why=ONE_FIELD,
        )  # fmt: skip
    for name, ratio in (("f1000w", 6.6), ("f1800w", 3.9)):
        yield PublishedNumber(
            f"snr.{name}", "signal_to_noise", ratio, name.upper(), "photometry",
            option=f"miri.{name}", definition="measured flux over the error function, fitted sample",
            why=ONE_FIELD,
        )  # fmt: skip
    rows = (
        ("f_scaling.f770w", 1.08, "=", "image scaling F770W",
         "the paper's is a mismatch between simulator and pipeline: 1.00 is right"),
        ("f_scaling.f1800w", 0.87, "=", "image scaling F1800W",
         "the paper's is a mismatch between simulator and pipeline: 1.00 is right"),
        ("f_aper.f770w", 1.10, "=", "flux outside the PSF stamp F770W",
         "the paper's stamps are cut to 3 arcsec: 1.00 with whole ones"),
        ("f_aper.f2100w", 1.19, "=", "flux outside the PSF stamp F2100W",
         "the paper's stamps are cut to 3 arcsec: 1.00 with whole ones"),
        ("points.offset", 0.02, "<", "largest median offset of bright points (mag)", ""),
        ("points.scatter", 0.02, "<", "largest scatter of bright points (mag)", ""),
        ("source_extractor.detected", 379, "=", "Source Extractor, detections in F1500W", ONE_FIELD),
        ("source_extractor.matched", 177, "=", "Source Extractor, matched in F1500W", ONE_FIELD),
        ("source_extractor.missed", 0.53, "=", "Source Extractor, share missed in F1500W", ONE_FIELD),
        ("source_extractor.offset", 0.05, "<", "Source Extractor - template fit (mag)",
         "a circle corrected as for points loses light of larger galaxies, and so do AUTO ellipses of faint ones"),
    )  # fmt: skip
    for key, value, relation, text, why in rows:
        yield PublishedNumber(key, "extra", value, text, "photometry", relation=relation, why=why)


def _redshifts():
    outliers = "share with abs(dz)/(1+z) > 0.15, posterior means"
    for band_set, share in (("all", 0.015), ("none", 0.10), ("blue", 0.037), ("red", 0.059)):
        yield PublishedNumber(
            f"outliers.{band_set}", "z_outliers", share, _SETS[band_set], "redshifts",
            band_set=band_set, definition=outliers, why=ONE_FIELD,
        )  # fmt: skip
    for band_set, scatter in (("blue", 0.029), ("red", 0.042)):
        yield PublishedNumber(
            f"z_scatter.{band_set}", "z_scatter", scatter, _SETS[band_set], "redshifts",
            band_set=band_set, why=ONE_FIELD,
        )  # fmt: skip
    yield PublishedNumber(
        "outlier_ratio", "z_outlier_ratio", 7.0, "six MIRI bands", "redshifts", relation="~",
        error=2.0, why="a ratio of a few outliers",
    )  # fmt: skip
    yield PublishedNumber(
        "scatter_ratio", "z_scatter_ratio", 2.0, "six MIRI bands, z < 3", "redshifts", relation=">",
        option=(0.0, 3.0), source=_ABSTRACT, why=ONE_FIELD,
    )  # fmt: skip


def _fractions():
    rows = (
        (0.0, "all", 0.002, 0.003), (0.0, "none", 0.200, 0.155),
        (0.6, "blue", -0.155, 0.170), (0.6, "red", -0.185, 0.165),
    )  # fmt: skip
    for truth, band_set, offset, scatter in rows:
        text = f"fracAGN {truth:g}, {_SETS[band_set]}"
        for name, value in (("frac_offset", offset), ("frac_scatter", scatter)):
            yield PublishedNumber(
                f"{name}.{truth:g}.{band_set}", name, value, text, "AGN fraction", truth=truth,
                band_set=band_set, why=_PRIOR if band_set == "none" else ONE_FIELD,
                definition="of posterior means",
            )  # fmt: skip
    yield PublishedNumber(
        "frac_scatter_ratio", "frac_scatter_ratio", 2.0, "fracAGN 0, six MIRI bands, z < 3",
        "AGN fraction", relation=">", option=(0.0, 3.0), source=_ABSTRACT,
    )  # fmt: skip
    yield PublishedNumber(
        "frac_offset_ratio", "frac_offset_ratio", 100.0, "fracAGN 0, six MIRI bands", "AGN fraction",
        relation="~", error=30.0, source=_ABSTRACT,
        definition="its 'accuracy' is taken for the median offset: 0.200 over 0.002, of which the last digit "
        "is uncertain by a quarter",
        why="the offset with MIRI, by which it is divided, is larger here",
    )  # fmt: skip
    for low, high in ((0, 1), (1, 2), (2, 3)):
        for name in ("frac_offset", "frac_scatter"):
            yield PublishedNumber(
                f"{name}.0.all.z{low}", name, 0.02, f"fracAGN 0, {low} < z < {high}",
                "AGN fraction", relation="<", option=(float(low), float(high)),
                why="fewer sources and bands of rest 5-15 µm at high redshift",
            )  # fmt: skip
    yield PublishedNumber(
        "frac_scatter.0.99.all", "frac_scatter", 0.003, "fracAGN 0.99", "AGN fraction",
        relation="<", truth=0.99,
    )  # fmt: skip
    for truth in (0.2, 0.4, 0.6, 0.8):
        yield PublishedNumber(
            f"frac_scatter.{truth:g}.all", "frac_scatter", 0.1, f"fracAGN {truth:g}",
            "AGN fraction", relation=">", truth=truth,
        )  # fmt: skip
    for truth in (0.0, 0.2, 0.4, 0.6, 0.8, 0.99):
        composite = truth in (0.2, 0.4)
        yield PublishedNumber(
            f"width_ratio.{truth:g}", "width_ratio", 2.0 if composite else 1.0,
            f"fracAGN {truth:g}", "AGN fraction", relation="~" if composite else ">",
            error=0.5 if composite else 0.0, truth=truth,
        )  # fmt: skip


def _agn():
    shares = {0.0: 0.88, 0.2: 0.72, 0.6: 0.77, 0.8: 0.90, 0.99: 0.99}
    for truth, share in shares.items():
        yield PublishedNumber(
            f"class.{truth:g}", "class_share", share, f"fracAGN {truth:g}", "classes", truth=truth,
            definition="galaxy below 0.1, composite below 0.4, AGN above, of posterior means",
            why=ONE_FIELD,
        )  # fmt: skip
    for name, share in (("galaxy", 0.79), ("composite", 0.76), ("agn", 0.87)):
        yield PublishedNumber(
            f"colors.{name}", "extra", share, f"colors of Kirkpatrick et al. 2017, {name}", "classes",
            definition="share of the class found by colors, classes by the share of 5-15 µm light",
            why="other templates, and circles fitted to them",
        )  # fmt: skip
    yield PublishedNumber(
        "power_offset", "power_offset", -0.1, "all fracAGN above 0", "accretion power", truth=None,
        why=ONE_FIELD, definition="log10 of the posterior mean over the truth",
    )  # fmt: skip
    yield PublishedNumber(
        "power_scatter", "power_scatter", 0.3, "all fracAGN above 0", "accretion power",
        relation="~", error=0.05, truth=None, source=_ABSTRACT,
        definition="log10 of the posterior mean over the truth",
        why="the torus is free in the sky and fixed in part in the fit",
    )  # fmt: skip
    yield PublishedNumber(
        "xray_half", "xray_half", -16.0, "all fracAGN above 0", "X-rays", relation="~", error=0.2,
        truth=None, definition="AGN of the field that are in the fitted sample, by 0.5-7 keV flux",
        why=f"{ONE_FIELD}; it follows the luminosities of the injected AGN",
    )  # fmt: skip
    yield PublishedNumber(
        "pah.f1500w", "feature", 0.4, "6.2 µm, equivalent width 0.5 µm, F1500W at z = 1.5", "templates",
        relation="~", error=0.05, option=("miri.f1500w", 0.5, 1.5),
        definition="2.5 log10(1 + W (1 + z) / filter width)",
    )  # fmt: skip


#: What a band set is called.
_SETS = {
    "all": "six MIRI bands",
    "none": "no MIRI band",
    "blue": "three blue MIRI bands",
    "red": "three red MIRI bands",
}
#: All numbers that are compared.
PUBLISHED = (*_detection(), *_limits(), *_photometry(), *_redshifts(), *_fractions(), *_agn())


def compare_with_paper(study, *, seed, n_draws=1000, reasons=None):
    """
    Every published number beside that of a study.

    Parameters
    ----------
    study : `~miricigale.evaluation.StudyResults`
        The tables; numbers of other products are taken from its ``extra``, by key.
    seed : int
        Of the bootstrap; each number has its own stream.
    n_draws : int, optional
        Draws of the bootstrap.
    reasons : dict of str to str, optional
        Why numbers differ, by key, instead of the general reasons.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each of `PUBLISHED`: ``key``, ``section``, ``description``, ``relation``, ``paper``,
        ``paper_err``, ``ours`` with its 68 % interval ``low``, ``high``, ``n``, ``completeness`` (the
        share of the sources of the field that ours is of), ``of_all`` (for shares of right sources: their
        share among all sources of the field), ``sigma`` (difference in units of its error; 0 where a bound
        holds), ``verdict``, ``definition`` and ``source``.

    Raises
    ------
    KeyError
        If ``reasons`` has a key that no published number has.
    """
    seed, reasons = check_seed(seed), dict(reasons or {})
    for key in reasons:
        if key not in {one.key for one in PUBLISHED}:
            raise unknown_name("published number", key, [one.key for one in PUBLISHED])
    rows = []
    for one in PUBLISHED:
        if one.quantity == "extra":
            ours = study.extra.get(one.key, Estimate(np.nan))
        else:
            ours = measure(
                study, one.quantity, truth=one.truth, band_set=one.band_set, option=one.option,
                seed=stream(seed, "paper", one.key), n_draws=n_draws,
            )  # fmt: skip
        sigma = _difference(one, ours)
        text = QUANTITIES.get(one.quantity)
        right = one.quantity == "class_share"
        rows.append(
            (
                one.key,
                one.section,
                f"{text}: {one.text}" if text else one.text,
                one.relation,
                one.value,
                one.error,
                ours.value,
                ours.low,
                ours.high,
                ours.n,
                ours.completeness,
                ours.value * ours.completeness if right else np.nan,
                sigma,
                _verdict(one, ours, sigma, reasons.get(one.key, one.why)),
                one.definition,
                one.source,
            )
        )
    texts = {
        "key": "Name of the number",
        "section": "Part of the paper",
        "description": "What it is",
        "relation": "= equal, ~ about, < and > bounds",
        "paper": "Yang et al. 2021",
        "paper_err": "Its error or range, 0 if none is known",
        "ours": "The study's",
        "low": "Lower end of its 68 % interval",
        "high": "Upper end of its 68 % interval",
        "n": "Sources",
        "completeness": "Share of the sources of the field that it is of",
        "of_all": "Share of right sources among all of the field",
        "sigma": "Difference in units of its error; 0 where a bound holds",
        "verdict": "Whether they agree, and why not",
        "definition": "How it is taken",
        "source": "Where the paper's number was read; empty if it is second hand",
    }
    return described_rows(rows, texts)


def _difference(one, ours):
    """Difference in units of its error; that of the paper is ours, where it has none, for a like sample."""
    delta = ours.value - one.value
    if (one.relation == "<" and abs(ours.value) <= one.value) or (
        one.relation == ">" and delta >= 0
    ):
        return 0.0
    if one.relation == "<":
        delta = abs(ours.value) - one.value
    error = np.nan_to_num(ours.error)
    published = one.error or error
    if one.quantity in SHARES and ours.n:
        # our interval is none for theirs where one of the shares is near 0 or 1
        published = max(published, np.sqrt(one.value * (1 - one.value) / ours.n))
    total = np.hypot(error, published)
    return float(delta / total) if total > 0 else np.nan


def _verdict(one, ours, sigma, why):
    """Whether the two agree, in words."""
    if not np.isfinite(ours.value):
        return "not measured"
    if one.relation in "<>" and sigma == 0:
        return "within the bound"
    if not np.isfinite(sigma):
        same = np.isclose(ours.value, one.value, rtol=0.02)
        return "agrees" if same else f"differs by {ours.value - one.value:+.3g}: {why or 'open'}"
    if abs(sigma) < _AGREES:
        return f"agrees ({sigma:+.1f} sigma)"
    return f"differs by {sigma:+.1f} sigma: {why or 'open'}"


def comparison_rows(table):
    """
    Rows for a table of a report.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        Of `compare_with_paper`.

    Returns
    -------
    rows : list of tuple
        Section, description, paper (with ``[?]`` if second hand), ours with its error, completeness and
        verdict: text, or `~miricigale.pages.Missing`.
    """
    rows = []
    for row in table:
        mark = {"=": "", "~": "about "}.get(row["relation"], f"{row['relation']} ")
        paper = f"{mark}{row['paper']:.3g}{'' if row['source'] else ' [?]'}"
        ours, ends = row["ours"], (row["low"], row["high"])
        error = 0.5 * (ends[1] - ends[0]) if np.isfinite(ends).all() else np.nan
        if not np.isfinite(ours):
            ours = Missing("not measured in this study")
        elif np.isfinite(error):
            ours = f"{ours:.3g} ± {error:.2g}"
        else:
            ours = f"{ours:.3g}"
        share = row["completeness"]
        share = f"{100 * share:.0f} %" if np.isfinite(share) else Missing("not a sample's number")
        rows.append((row["section"], row["description"], paper, ours, share, row["verdict"]))
    return rows
