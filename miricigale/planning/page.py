"""The page of a plan: tables and figures."""

import dataclasses

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import band_label
from miricigale.pages import Link, Page, SectionWriter, number, sentence
from miricigale.planning.browser import MAX_SOURCES, write_browser
from miricigale.planning.exposures import background_options
from miricigale.plotting.axes import MEASURED, SECOND, TRUE, legend, new_figure, plain_text
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import plain_rows
from miricigale.workflow.background import background_text
from miricigale.workflow.page.study_figures import redshift_figure


def write_page(path, planner, plans, comparison, areas=None, *, overwrite=False):
    """
    Write the page of a plan.

    Parameters
    ----------
    path : path-like
        HTML file.
    planner : `~miricigale.planning.Planner`
        That made the plans.
    plans : list of `~miricigale.planning.Plan`
        Of `Planner.compare`.
    comparison, areas : `~astropy.table.QTable`
        Of `comparison_table` and, if there is one, `area_table`.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Returns
    -------
    path : `pathlib.Path`
    """
    config = planner.config
    miri = [plan for plan in plans if plan.bands]
    best = next(plan for plan in miri if plan.name == comparison["plan"][1])
    deepest = max(miri, key=lambda plan: len(plan.bands))
    report = Page(f"Plan {config.plan.name}", subtitle=comparison.meta["answer"])
    page = SectionWriter(report, declared("miricigale.planning"))
    _notices(page, planner)
    page.section("sets")
    rows = list(_entries(comparison))
    page.items(rows[1])
    merit = page.texts["sets"]["merits"][config.survey.rank]
    page.table("table", rows, n=rows[0]["n"], min_detected=planner.min_detected, merit=merit)
    page.table("accuracy", rows)
    page.figure("figure", _comparison_figure(comparison))
    _write_exposures(page, config, miri, deepest)
    by_name = {}
    for plan in (plans[0], best, deepest):
        by_name[plan.name] = plan
    shown = list(by_name.values())
    chosen = planner.common(plans)
    browser = write_browser(path, f"Plan {config.plan.name}", planner, shown)
    n_listed = min(len(planner.sources), MAX_SOURCES)
    n_all = len(planner.sources)
    page.section("fits", browser=Link("one by one", browser), n_listed=n_listed, n_all=n_all)
    fits = {plan.name: plan.sources[chosen] for plan in shown}
    first = chosen & (np.asarray(planner.sources.columns.get("sky", 0)) == 0)
    redshifts = {
        plan.name: (plan.sources["redshift"][first], plan.sources[first]) for plan in shown
    }
    page.figure("redshifts", redshift_figure(redshifts))
    page.figure("fractions", _fraction_figure(fits, config.agn.limit))
    if areas is not None and len(areas):
        page.section("areas")
        page.table("table", _entries(areas))
        page.figure("figure", _area_figure(areas))
    return report.write(path, overwrite=overwrite)


def answer(planner, plans, comparison):
    """Return what the best set reaches and finds, in one sentence."""
    row = comparison[1]
    plan = next(plan for plan in plans if plan.name == row["plan"])
    bands = plan.bands.values()
    facts = {"limit": planner.config.agn.limit}
    facts["mix"] = ""
    if planner.sources.meta.get("agn") == "mix":
        facts["mix"] = " of a made-up mix"
    facts["bands"] = _bands_in_words(row["plan"], plans)
    limits = [band.errors().limiting_magnitude(band.filter).value for band in bands]
    facts["limits"] = ", ".join(f"{limit:.1f}" for limit in limits)
    times = [f"{band.time.to_value(u.s):.0f}" for band in bands]
    dithers = [str(band.n_dithers) for band in bands]
    for key, values in (("times", times), ("dithers", dithers)):
        if len(set(values)) == 1:
            # the same for all bands
            values = values[:1]
        facts[key] = ", ".join(values)
    for name, spec in (("n_agn", ".1f"), ("n_agn_true", ".1f"), ("purity", ".0f %")):
        facts[name] = number(row[name], spec, "not known", error=row[f"{name}_err"])
    facts |= {"area": f"{plan.area.value:.1f}", "hours": f"{plan.time.to_value(u.h):.1f}"}
    if np.isfinite(row["n_agn"]):
        reason = "text"
    else:
        reason = "no_area"
    texts = declared("miricigale.planning")
    said = str(sentence(texts["answer"][reason], facts))
    # the first row is that of the existing bands
    if len(comparison) > 2 and np.all(np.isfinite(comparison["merit"][1:3])):
        ranking = {
            "n": len(comparison) - 1,
            "merit": texts["sets"]["merits"][planner.config.survey.rank],
            "next": _bands_in_words(comparison["plan"][2], plans),
        }
        for key, value in zip(("first", "second"), comparison["merit"][1:3], strict=True):
            ranking[key] = f"{value:.2g}"
        said += " " + str(sentence(texts["answer"]["rank"], ranking))
    return said


def _bands_in_words(name, plans):
    """Return the bands of a plan, such as F770W + F1000W."""
    bands = next(plan.bands for plan in plans if plan.name == name)
    return " + ".join(band_label(band) for band in bands)


def _entries(table):
    """Yield the rows of a table as dictionaries of plain values, with what bands and frames are called."""
    for entry in plain_rows(table):
        if "filter" in entry:
            entry["band"] = entry["filter"].removeprefix("miri.")
        if "groups" in entry:
            numbers = (entry[name] for name in ("dithers", "integrations", "groups"))
            entry["frames"] = " x ".join(map(str, numbers))
        yield entry


def _notices(page, planner):
    """What a reader has to know first."""
    config = planner.config
    agn = planner.config.agn
    skies = planner.sources.meta.get("n_skies", 1)
    n = np.count_nonzero(np.asarray(planner.sources.columns.get("sky", 0)) == 0)
    page.notice("skies" if skies > 1 else "sample", n=n, skies=skies, seed=config.plan.seed)
    page.notice("noise")
    noise = dataclasses.asdict(config.noise)
    page.notice("errors", **noise | {"fractional": 100 * noise["fractional"]})
    models = "models_ceers" if config.sed.infrared == "ceers" else "models"
    page.notice(models, model_error=100 * config.fit.model_error)
    page.notice("hours")
    if planner._caller_sources is None:
        mix = ", ".join(f"{value:g}" for value in agn.frac_agn)
        page.notice(planner.sources.meta["agn"], mix=mix)
    page.notice("background", background=background_text(**background_options(config)))
    for library in planner.sources.meta.get("libraries", ()):
        page.notice("library", library=library)


def _write_exposures(page, config, plans, full_plan):
    """The section on the exposures of all sets of bands, the one of most bands first."""
    n = config.exposures.pointings
    page.section(
        "exposures",
        "budget" if config.exposures.hours else "text",
        plan=full_plan.name,
        light=sum(band.time.to_value(u.h) for band in full_plan.bands.values()),
        where="one pointing" if n == 1 else f"each of {n} pointings",
        area=full_plan.area.value,
        time=full_plan.time.to_value(u.h),
        hours=config.exposures.hours,
    )
    rows = []
    shown = set()
    for plan in sorted(plans, key=lambda candidate: candidate is not full_plan):
        for entry in _entries(plan.band_table()):
            exposure = entry["band"], entry["time"], entry["frames"]
            if exposure not in shown:
                # of the same exposures there is a row for one set
                shown.add(exposure)
                rows.append(entry | {"set": plan.name})
    page.table("table", rows)


def _comparison_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.6))
    hours = table["time"].to_value(u.h)
    labels = (r"$\Delta z / (1 + z)$", "fracAGN")
    for ax, name, label in zip(axes[0], ("z", "frac"), labels, strict=True):
        scatter = table[f"{name}_scatter"]
        error = table[f"{name}_scatter_err"]
        ax.errorbar(hours, scatter, error, fmt="o", ms=5, color=MEASURED, label="scatter")
        ax.plot(hours, table[f"{name}_width"], "o", mfc="none", color=SECOND, label="width")
        for k, place in enumerate(zip(hours, scatter, strict=True)):
            ax.annotate(str(k), place, (7, 3), textcoords="offset points", fontsize=9)
        ax.margins(x=0.12, y=0.12)
        ax.set(xlabel="hours", ylabel=label, ylim=(0, None))
        legend(ax)
    return figure


def _fraction_figure(fits, limit):
    figure, axes = new_figure(size=(6.4, 4.2))
    ax = axes[0, 0]
    colors = (SECOND, "0.45", MEASURED)
    for k, ((name, rows), color) in enumerate(zip(fits.items(), colors, strict=False)):
        true = np.array(rows["frac_agn"], float)
        mean = np.array(rows["frac_agn_mean"], float)
        if len(np.unique(true)) > 12:
            # of a continuous mix, the median of each tenth
            for tenth in np.array_split(np.argsort(true, kind="stable"), 10):
                true[tenth] = np.median(true[tenth])
        place = np.unique(true)
        levels = [np.nanpercentile(mean[true == value], (16, 50, 84)) for value in place]
        low, middle, high = np.transpose(levels)
        place = place + 0.015 * (k - (len(fits) - 1) / 2)
        spread = (middle - low, high - middle)
        ax.errorbar(place, middle, spread, fmt="o", color=color, capsize=2, label=plain_text(name))
    ax.plot([0, 1], [0, 1], color=TRUE, lw=1)
    ax.axvline(limit, color=TRUE, lw=0.8, ls="--")
    ax.set(xlabel="true fracAGN", ylabel="posterior mean", xlim=(-0.05, 1.05), ylim=(-0.03, 1.03))
    legend(ax)
    return figure


def _area_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.4))
    area = table["area"].to_value(u.arcmin**2)
    area_axes, right = axes[0]
    z = (r"$\Delta z / (1 + z)$", "z_scatter")
    fraction = ("fracAGN", "frac_scatter")
    for (label, name), color in ((z, SECOND), (fraction, MEASURED)):
        right.errorbar(area, table[name], table[f"{name}_err"], fmt="o-", color=color, label=label)
    area_axes.plot(area, table["n_detected"], "o-", color=SECOND, label="detected")
    area_axes.plot(area, table["n_agn"], "o-", color=MEASURED, label="AGN found")
    for ax, label in ((area_axes, "sources"), (right, "scatter of the means")):
        ax.set(xlabel="area (square arcmin)", ylabel=label, xscale="log", ylim=(0, None))
        ax.set_xticks(area, [f"{v:.1f}" for v in area])
        ax.set_xticks([], minor=True)
        legend(ax)
    return figure
