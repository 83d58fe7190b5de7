"""The page of an injection: limits, completeness, errors and purity."""

import numpy as np
from astropy.stats import mad_std
from astropy.table import Table

from miricigale.injection.results import BINNED_BY, QUESTIONS, limit_columns, measured_values
from miricigale.injection.trials import APART
from miricigale.pages import Page, SectionWriter
from miricigale.plotting.axes import new_figure
from miricigale.utils.named_values import subset
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import row_dicts

#: Colors and names of the two questions in figures.
_LOOKS = {"detection": ("#c2410c", "detection"), "forced": ("#1d4ed8", "forced photometry")}

#: Shift of their points (mag), so that one is not behind the other.
_ASIDE = {"detection": -0.04, "forced": 0.04}

#: How tables are headed.
_HEADS = {
    "magnitude": "magnitude (AB)",
    "size": "half-light radius",
    "place": "part of the image",
    "neighbors": "position",
}

#: Magnitudes about the limit of sources on the map.
_NEAR_LIMIT = 1.0


def write_page(path, result, name):
    """
    Write the page of an injection.

    Parameters
    ----------
    path : path-like
        The file.
    result : `~miricigale.injection.InjectionResult`
        What was found.
    name : str
        What it was injected into.
    """
    meta = result.meta
    report = Page("Injected sources", subtitle=f"{name}, {meta['band']}")
    page = SectionWriter(report, declared("miricigale.injection"))
    is_star = np.asarray(result.sources["kind"]) == "star"
    facts = subset(meta, ("n_trials", "preset", "threshold"))
    positions = "the injected sources, taken as known"
    if meta.get("prior_band"):
        positions = "the prior"
    facts |= {"n": len(result.sources), "n_stars": int(is_star.sum()), "positions": positions}
    page.section("answer", **facts)
    page.items(_headline(result))
    page.figure("curves", _curves(result))
    page.figure("fluxes", _fluxes(result))
    page.figure("map", _map(result))
    page.section("recovery")
    for by in BINNED_BY:
        page.table("table", row_dicts(Table(result.recovery(by))), by=_HEADS[by])
    page.section("purity")
    for by in BINNED_BY:
        head = "size (arcsec, rms)"
        if by != "size":
            head = _HEADS[by]
        page.table("table", row_dicts(Table(result.purity(by))), by=head)
    has_catalog = np.any(np.asarray(result.sources["row"]) >= 0)
    drawn = "those of the field's sources"
    if has_catalog:
        drawn = "those of the catalog"
    page.section("method", drawn=drawn, apart=f"{APART:g}", noise=meta["photon_noise"])
    report.write(path, overwrite=True)


def _headline(result):
    row = {}
    for question in QUESTIONS:
        row |= limit_columns(question, result.curve(question))
    row |= result.errors()
    pulls = result.empty_pulls[np.isfinite(result.empty_pulls)]
    if len(pulls):
        row["empty"] = float(mad_std(pulls))
    else:
        row["empty"] = np.nan
    row["false_rate"] = result.false_rate()
    return row


def _curves(result):
    """Draw the completeness of stars and galaxies."""
    figure, axes = new_figure(1, 2, size=(5.0, 3.4), sharey=True)
    kinds = np.asarray(result.sources["kind"])
    for ax, kind in zip(axes[0], ("star", "galaxy"), strict=True):
        ax.set(xlabel="true magnitude (AB)", title={"star": "stars", "galaxy": "galaxies"}[kind])
        if not np.any(kinds == kind):
            continue
        table = result.recovery("magnitude", kind=kind)
        middle = (table["low"] + table["high"]) / 2
        fine = np.linspace(table["low"].min(), table["high"].max(), 200)
        for question, column in QUESTIONS.items():
            color, label = _LOOKS[question]
            share = table[column]
            bars = np.clip([share - table[f"{column}_low"], table[f"{column}_high"] - share], 0, 1)
            at = middle + _ASIDE[question]
            ax.errorbar(at, share, bars, fmt="o", ms=4, color=color, label=label)
            curve = result.curve(question, kind=kind)
            if curve is not None:
                ax.plot(fine, curve(fine), color=color, lw=1)
        ax.axhline(0.5, color="0.7", lw=0.8, ls=":")
        ax.legend(frameon=False, loc="lower left")
    axes[0, 0].set_ylabel("share that is found")
    return figure


def _fluxes(result):
    """Draw the measured over true fluxes, and pulls."""
    figure, [[bias_axes, right]] = new_figure(1, 2, size=(5.0, 3.4))
    sources = result.sources
    magnitude = np.asarray(sources["magnitude"])
    true, flux, error = measured_values(sources)
    good = np.isfinite(flux) & (error > 0)
    bias_axes.plot(magnitude[good], (flux / true)[good], ".", ms=3, color="0.5")
    bias_axes.axhline(1.0, color="0.7", lw=0.8, ls=":")
    bias_axes.set(xlabel="true magnitude (AB)", ylabel="measured / true flux", ylim=(0, 2))
    table = result.recovery("magnitude")
    middle = (table["low"] + table["high"]) / 2
    right.plot(magnitude[good], ((flux - true) / error)[good], ".", ms=3, color="0.5")
    right.errorbar(
        middle, table["pull_median"], table["pull_mad"], fmt="o", ms=4, color="#1d4ed8",
        label="median, scatter",
    )  # fmt: skip
    for level in (-1.0, 0.0, 1.0):
        right.axhline(level, color="0.7", lw=0.8, ls=":")
    right.set(xlabel="true magnitude (AB)", ylabel="(measured - true) / error", ylim=(-5, 5))
    right.legend(frameon=False)
    return figure


def _map(result):
    """Draw where sources near the limit are found."""
    curve = result.curve("forced")
    if curve is None:
        return None
    sources = result.sources
    if np.isfinite(curve.limit):
        middle = curve.limit
    else:
        middle = curve.middle
    at_limit = np.abs(np.asarray(sources["magnitude"]) - middle) < _NEAR_LIMIT
    detected = at_limit & np.asarray(sources["detected"])
    measured = at_limit & np.asarray(sources["recovered"]) & ~detected
    neither = at_limit & ~detected & ~measured
    figure, [[ax]] = new_figure(1, 1, size=(5.2, 4.6))
    x = np.asarray(sources["x"])
    y = np.asarray(sources["y"])
    style = {"ls": "none", "ms": 4}
    ax.plot(x[detected], y[detected], "o", color="#c2410c", label="detected", **style)
    ax.plot(x[measured], y[measured], "o", mfc="none", color="#1d4ed8", label="measured", **style)
    ax.plot(x[neither], y[neither], "x", color="0.6", label="neither", **style)
    ax.set(xlabel="x (pixels)", ylabel="y (pixels)", aspect="equal")
    ax.legend(framealpha=0.9, loc="upper right")
    return figure
