"""The page of a survey of AGN: totals, luminosity function, selection function, prior, obscured share."""

import numpy as np
from astropy.table import Table

from miricigale.agn.numbers import FLOOR
from miricigale.pages import Missing, Page, SectionWriter
from miricigale.plotting.axes import WIDTH, new_figure
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import row_dicts

#: Colors of the measured prior, and of the prior of the fits.
_MEASURED, _SHIPPED = "#1d4ed8", "#c2410c"
#: Smallest share of galaxies that the figure of the prior shows.
_LEAST_SHARE = 1e-4
#: Formats of numbers with intervals, and why one is missing.
_INTERVALS = {
    "n": (".0f", "no object"),
    "n_corrected": (".1f", "no injected AGN is selected"),
    "completeness": (".0f %", "none was injected"),
    "above": (".0f %", "none was injected"),
    "density": (".1e", "the bin has no upper end, or no such injected AGN"),
    "obscured": (".0f %", "no quasars were fitted"),
    "measured": (".1f %", "no object"),
}


def write_page(result, path, name):
    """
    Write the page of a survey of AGN.

    Parameters
    ----------
    result : `~miricigale.agn.AGNResult`
        The result.
    path : path-like
        The file, which replaces one that is there.
    name : str
        Name of the catalog.
    """
    meta = result.meta
    report = Page(f"AGN of {name}", subtitle=f"{meta['n_all']} objects")
    page = SectionWriter(report, declared("miricigale.agn"))
    classes = ", ".join(meta["classes"])
    facts = {"limit": f"{meta['limit']:g}", "n_used": meta["n_used"], "n_all": meta["n_all"]}
    n_unused = meta["n_all"] - meta["n_used"]
    if n_unused:
        page.notice("unused", n=n_unused, n_all=meta["n_all"])
    if not len(result.injected):
        page.notice("no_injections")
    if meta.get("redshift_column") is None:
        page.notice("photometric")
    edges = (
        f"{np.min(result.numbers['redshift_low']):g} to {np.max(result.numbers['redshift_high']):g}"
    )
    page.section("totals", classes=classes, edges=edges, **facts)
    page.table("table", _rows(result.totals))
    page.section("numbers", floor=f"{FLOOR:g}")
    page.figure("figure", _luminosity_function(result.numbers))
    page.table("table", _rows(result.numbers), floor=f"{FLOOR:g}")
    page.table("densities", _rows(result.numbers), floor=f"{FLOOR:g}")
    if np.isfinite(result.numbers["obscured"]).any():
        page.section("obscured")
        page.table("table", _rows(result.numbers))
    where = "none of them in images"
    n_in_images = int(np.count_nonzero(result.injected["n_images"]))
    if n_in_images:
        where = f"{n_in_images} of them were put into images and measured in the bands of these"
    stated = {"error": f"{100 * meta['completeness_error']:g}", "n_most": meta["n_most"]}
    stated["n_models"] = meta["injected_models"]
    stated["worst"] = f"{100 * _largest_error(result.numbers):.1f}"
    page.section("selection", n=len(result.injected), where=where, **stated, **facts)
    if meta["photon_noise"]:
        noises = [{"band": band, "noise": text} for band, text in meta["photon_noise"].items()]
        page.table("photons", noises)
    page.figure("figure", _completeness(result.numbers))
    page.section("prior")
    page.figure("figure", _prior(result.prior))
    page.table("table", _rows(result.prior))
    page.section("method", area=f"{meta['area_deg2'] * 3600:.4g}", seed=meta["seed"])
    report.write(path, overwrite=True)


def _rows(table):
    """Rows as dictionaries, with the edges of their bins as text."""
    rows = row_dicts(Table(table))
    for row in rows:
        for name in ("redshift", "log_luminosity", "frac_agn"):
            if f"{name}_low" in row:
                row[name] = _span(row[f"{name}_low"], row[f"{name}_high"])
        for name, (spec, reason) in _INTERVALS.items():
            if f"{name}_low" in row and name in row:
                row[f"{name}_interval"] = _interval(row, name, spec, reason)
    return rows


def _interval(row, name, spec, reason):
    """Value of a row with the ends of its interval, which may be on one side of it only, as text."""
    value, low, high = (row[key] for key in (name, f"{name}_low", f"{name}_high"))
    if not np.isfinite(value):
        return Missing(reason)
    spec, percent, _ = spec.partition(" %")
    scale = 100.0 if percent else 1.0
    value, low, high = (f"{scale * number:{spec}}" for number in (value, low, high))
    return f"{value} ({low} to {high}){percent}"


def _span(low, high):
    if low == high:
        return f"{low:g}"
    return f"above {low:g}" if np.isinf(high) else f"{low:g} to {high:g}"


def _bars(table, name):
    """Values and the lengths of their bars."""
    value = np.asarray(Table(table)[name])
    low = np.asarray(Table(table)[f"{name}_low"])
    high = np.asarray(Table(table)[f"{name}_high"])
    return value, np.maximum([value - low, high - value], 0.0)


def _largest_error(numbers):
    """Error of the completeness of the bin in which it is known least; 0 without injected AGN."""
    _, bars = _bars(numbers, "completeness")
    if not np.any(np.isfinite(bars)):
        return 0.0
    return np.nanmax(bars)


def _by_redshift(table):
    """Rows of each bin of redshift."""
    edges = np.unique(np.asarray(table["redshift_low"]))
    return [table[np.asarray(table["redshift_low"]) == edge] for edge in edges]


def _title(rows):
    return f"z {rows['redshift_low'][0]:g} to {rows['redshift_high'][0]:g}"


def _luminosity_function(numbers):
    """Densities by luminosity, a panel for each bin of redshift."""
    parts = _by_redshift(numbers)
    figure, axes = new_figure(1, len(parts), size=(WIDTH / 2.2, 3.4), sharey=True)
    lowest = np.min(numbers["log_luminosity_low"])
    highest = np.max(numbers["log_luminosity_low"])
    for ax, rows in zip(axes[0], parts, strict=True):
        ax.set_xlim(lowest, max(highest, lowest + 1.0))
        rows = rows[np.isfinite(rows["log_luminosity_high"])]
        middle = 0.5 * (rows["log_luminosity_low"] + rows["log_luminosity_high"])
        ax.set(xlabel="log L (erg/s)", title=_title(rows) if len(rows) else "", yscale="log")
        if not len(rows):
            continue
        value, bars = _bars(rows, "density")
        good = np.asarray(rows["constrained"], bool)
        for points, filled, label in ((good, _MEASURED, "measured prior"), (~good, "none", None)):
            style = {"fmt": "o", "color": _MEASURED, "mfc": filled, "label": label}
            ax.errorbar(middle[points], value[points], bars[:, points], **style)
        shipped = Table(rows)["density_shipped"]
        ax.plot(
            middle,
            np.where(shipped > 0, shipped, np.nan),
            "x",
            color=_SHIPPED,
            label="shipped prior",
        )
        ax.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("density (1 / Mpc3 / dex)")
    return figure


def _completeness(numbers):
    """Completeness by luminosity, with the purity of what is selected."""
    parts = _by_redshift(numbers)
    figure, axes = new_figure(1, len(parts), size=(WIDTH / 2.2, 3.0), sharey=True)
    for ax, rows in zip(axes[0], parts, strict=True):
        high = np.asarray(rows["log_luminosity_high"])
        middle = np.where(np.isinf(high), rows["log_luminosity_low"] + 0.5, 0.0)
        middle = np.where(np.isinf(high), middle, 0.5 * (rows["log_luminosity_low"] + high))
        value, bars = _bars(rows, "completeness")
        finite = np.isfinite(value)
        style = {"fmt": "o", "color": _MEASURED, "label": "completeness"}
        ax.errorbar(middle[finite], value[finite], bars[:, finite], **style)
        ax.plot(middle, np.asarray(rows["purity"]), "s", color="0.5", mfc="none", label="purity")
        ax.set(xlabel="log L (erg/s)", title=_title(rows), ylim=(-0.05, 1.05))
        ax.legend(frameon=False, fontsize=8)
    axes[0, 0].set_ylabel("share")
    return figure


def _prior(prior):
    """Shares of the AGN fraction, shipped and measured, for all redshifts."""
    low = prior["redshift_low"][0]
    high = prior["redshift_high"][0]
    rows = prior[(prior["redshift_low"] == low) & (prior["redshift_high"] == high)]
    figure, [[ax]] = new_figure(1, 1, size=(WIDTH / 1.6, 3.2))
    place = np.arange(len(rows))
    value, bars = _bars(rows, "measured")
    ax.errorbar(place, value, bars, fmt="o", color=_MEASURED, label="measured")
    ax.plot(place, np.asarray(rows["shipped"]), "x", color=_SHIPPED, label="shipped")
    names = [_span(row["frac_agn_low"], row["frac_agn_high"]) for row in rows]
    ax.set_xticks(place, names, fontsize=8)
    ax.set(xlabel="fracAGN", ylabel="share of galaxies", yscale="log", ylim=(_LEAST_SHARE, 1.5))
    ax.legend(frameon=False)
    return figure
