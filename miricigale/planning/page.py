"""The page of a plan: tables and figures."""

import astropy.units as u
import numpy as np

from miricigale.pages import Page, number
from miricigale.planning.exposures import background_options
from miricigale.plotting.axes import MEASURED, SECOND, TRUE, legend, new_figure
from miricigale.plotting.comparison import plot_redshifts
from miricigale.workflow.background import background_text

_NO_COUNT = "nothing to count"
#: Numbers of a plan: name, heading, format, factor.
_NUMBERS = (
    ("z_scatter", "scatter of z", ".4f", 1),
    ("z_outliers", "outliers (%)", ".1f", 100),
    ("z_width", "width of z", ".4f", 1),
    ("frac_bias", "offset of fracAGN", "+.3f", 1),
    ("frac_scatter", "scatter of fracAGN", ".3f", 1),
    ("frac_width", "width of fracAGN", ".3f", 1),
    ("completeness", "completeness (%)", ".0f", 100),
    ("purity", "purity (%)", ".0f", 100),
)
_HEADINGS = ("hours", *(text for _, text, _, _ in _NUMBERS), "detected", "AGN")
#: Columns of the exposures: heading, and the format of their values by name.
_EXPOSURES = {
    "band": "{filter}",
    "s": "{time:.0f}",
    "dithers x integrations x groups": "{dithers} x {integrations} x {groups}",
    "sky (MJy/sr)": "{background:.1f}",
    "sky in well": "{sky_in_well:.0%}",
    "calculator": "{limit_etc:.2f}",
    "aperture": "{limit:.2f}",
    "used": "{limit_used:.2f}",
    "saturates": "{saturates:.1f}",
    "sources": "{n_saturated}",
}
#: Columns of the images; those with an error: name, format, factor.
_IMAGES = {
    "band": "{filter}",
    "limit, plan": "{limit:.2f}",
    "limit, images": "{limit_images:.2f}",
    "scatter": ("scatter", ".2f", 1),
    "offset (%)": ("offset", "+.1f", 100),
    "detected, plan": "{n_detected}",
    "detected, images": "{n_detected_images}",
}
_MERITS = {
    "agn": "AGN found times the purity",
    "frac_agn": "inverse variance of fracAGN gained over the existing bands, relative to these",
    "redshift": "inverse variance of redshift gained over the existing bands, relative to these",
}
_NOISE = {
    "fitted": "of forced photometry of the mosaic, from photons, dark and read noise",
    "aperture": "of the exposure time calculator's aperture",
    "run": "of the run {}, scaled",
}


def write_page(path, planner, plans, comparison, areas=None, images=None):
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
    images : tuple of `~astropy.table.QTable`, optional
        Of `paired_bands` and `paired_numbers`.

    Returns
    -------
    path : `pathlib.Path`
    """
    config, miri = planner.config, [plan for plan in plans if plan.bands]
    best = next(plan for plan in miri if plan.name == comparison["plan"][1])
    every = max(miri, key=lambda plan: len(plan.bands))
    subtitle = f"{len(planner.sources)} sources, seed {config.plan.seed}"
    page = Page(f"Plan {config.plan.name}", subtitle=subtitle, notices=_notices(planner))
    _write_sets(page, config, comparison, best)
    page.section("Exposures", _exposure_text(config, every))
    page.table(
        _rows(every.band_table(), _EXPOSURES),
        header=list(_EXPOSURES),
        caption="5-sigma limits of point sources (AB): the exposure time calculator's, scaled (low "
        "background); in its aperture, by these exposures; of the errors that are drawn. A point "
        "saturates at the magnitude given, as do so many sources of the sample, if they were points.",
    )
    shown = list({plan.name: plan for plan in (plans[0], best, every)}.values())
    chosen = planner.common(plans)
    page.section("Redshift and fracAGN")
    caption = "Redshifts of the compared sources, posterior means."
    page.figure(_redshift_figure(shown, chosen), caption)
    page.figure(
        _fraction_figure(shown, chosen, config.agn.limit),
        "Posterior means of fracAGN by true value: median, and 16th to 84th percentile of the sources. "
        "The dashed line is the limit from which a source is an AGN.",
    )
    if images is not None:
        _write_images(page, *images)
    if areas is not None and len(areas):
        _write_areas(page, areas)
    return page.write(path)


def _write_sets(page, config, comparison, best):
    """The section on the sets of bands: the best, and all of them."""
    row = comparison[1]
    page.section("The sets of bands")
    page.items(
        [
            ("best for each hour", best.name),
            ("hours", f"{row['time'].to_value(u.h):.1f}"),
            ("scatter of z", number(row["z_scatter"], ".4f", _NO_COUNT)),
            ("scatter of fracAGN", number(row["frac_scatter"], ".3f", _NO_COUNT)),
        ]
    )
    page.table(
        [
            (row["plan"], *_scores(row), number(row["merit"], ".3g", "no time is spent"))
            for row in comparison
        ],
        header=["bands", *_HEADINGS, "merit"],
        caption=f"{comparison['n'][0]} sources that one of the sets detects, the same in each row, with "
        "and without MIRI. Scatter (sigma_MAD) and offsets are of posterior means, z over 1+z; "
        "widths are median posterior standard deviations. 'detected' and 'AGN' are sources above 5 sigma in "
        f"{config.fit.min_detected} MIRI bands, or in all of a set with fewer, and AGN detected so and "
        f"selected, expected in the area. Ranked by merit for each hour: {_MERITS[config.survey.rank]}.",
        text=2,
    )
    page.figure(
        _comparison_figure(comparison),
        "Scatter of posterior means (points, with the ranks of the table) and widths of posteriors (circles) "
        "against time.",
    )


def _write_images(page, bands, numbers):
    """The section on the images of the exposures."""
    n, n_field = numbers["n"][0], bands["n"][0]
    page.section(
        "Images of the exposures",
        f"The same exposures imaged and measured as in a run of the study. Of the sample {n_field} sources "
        f"are in the field; {n} of them are found on the high-resolution image, detected by one of the sets, and "
        "compared here, with the same fluxes in the existing bands. Neighbors, edges and what photometry makes "
        "of them are in the images only.",
    )
    page.table(
        _rows(bands, _IMAGES),
        header=list(_IMAGES),
        caption="5-sigma limits of points (AB) by the plan and by the error functions that the images gave; "
        "scatter of measured less true flux, over the error that the plan gives the source (1 if the images "
        "have no other noise); median offset of sources above 10 sigma; sources of the field above 5 sigma.",
    )
    for name in dict.fromkeys(numbers["plan"]):
        rows = []
        own = numbers[numbers["plan"] == name]
        for row, (_, text, spec, scale) in zip(own, _NUMBERS, strict=True):
            signed = "+" + spec.removeprefix("+")
            cells = [_with_error(row, key, spec, scale) for key in ("noise", "images")]
            cells += [_with_error(row, "difference", signed, scale)]
            rows.append((text, *cells, number(row["sigma"], "+.1f", "all sources agree")))
        page.table(
            rows,
            header=[f"bands: {name}", "noise", "images", "difference", "sigma"],
            caption="The difference has the error of the same sources drawn together.",
        )


def _write_areas(page, areas):
    """The section on more pointings with the same time."""
    page.section(
        "Depth against area",
        "The exposure times of all bands divided among more pointings, each a visit of its own.",
    )
    page.table(
        [(row["pointings"], *_scores(row)) for row in areas],
        header=["pointings", *_HEADINGS],
        caption="Numbers of the sources that each plan detects; counts are of its area.",
    )
    page.figure(_area_figure(areas), "Sources detected, AGN found, and the scatter of their fits.")


def _notices(planner):
    """What a reader has to know first."""
    config, agn = planner.config, planner.config.agn
    images = "; a section compares it with images" if config.images.enabled else ": no images"
    noise, share = _NOISE[config.noise.kind].format(config.noise.run), config.noise.fractional
    notices = [
        f"A source is measured with Gaussian noise, without blends or cosmic rays{images}.",
        f"MIRI errors are those {noise}, and {100 * share:g} % of the flux.",
        f"Truth and fit share models; the fit allows for {100 * config.fit.model_error:g} % of error.",
        "Hours are approximations to what APT charges, a visit for each pointing; APT decides.",
    ]
    if planner.given is None:
        mix = ", ".join(f"{f:g}: {s:.2g}" for f, s in zip(agn.frac_agn, agn.shares, strict=True))
        field = "those of a real field, after an X-ray luminosity function"
        mix = field if agn.field else f"shares by fracAGN {mix}"
        notices.append(f"AGN, on which completeness, purity and counts depend: {mix}.")
    notices.append(f"Background: {background_text(**background_options(config))}.")
    return notices + [f"Models: {text}" for text in planner.sources.meta.get("libraries", ())]


def _exposure_text(config, plan):
    n = config.exposures.pointings
    own = sum(band.time.to_value(u.h) for band in plan.bands.values())
    where = "one pointing" if n == 1 else f"each of {n} pointings"
    return (
        f"{plan.name}: {own:.1f} h of light in {where}, {plan.area.value:.1f} square arcmin; "
        f"{plan.time.to_value(u.h):.1f} h with overheads."
    )


def _rows(table, columns):
    """Rows of a table on the page: formats of plain values, or numbers with errors."""
    for row in table:
        values = {name: getattr(row[name], "value", row[name]) for name in table.colnames}
        values["filter"] = row["filter"].removeprefix("miri.")
        yield [
            column.format_map(values) if isinstance(column, str) else _with_error(row, *column)
            for column in columns.values()
        ]


def _with_error(row, name, spec, scale):
    value, error = row[name], row[f"{name}_err"]
    text = f"{{:{spec}}}"
    if np.isfinite(error):
        text += f" ± {scale * error:{spec.removeprefix('+')}}"
    return number(value, text, _NO_COUNT, scale=scale)


def _scores(row):
    """Hours, numbers and counts of a plan."""
    cells = [_with_error(row, name, spec, scale) for name, _, spec, scale in _NUMBERS]
    unknown = "nothing is detected without MIRI, or the area of the catalog is not known"
    counts = [number(row[name], ".0f", unknown) for name in ("n_detected", "n_agn")]
    return [f"{row['time'].to_value(u.h):.1f}", *cells, *counts]


def _comparison_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.6))
    hours = table["time"].to_value(u.h)
    labels = (r"$\Delta z / (1 + z)$", "fracAGN")
    for ax, name, label in zip(axes[0], ("z", "frac"), labels, strict=True):
        scatter, error = table[f"{name}_scatter"], table[f"{name}_scatter_err"]
        ax.errorbar(hours, scatter, error, fmt="o", ms=5, color=MEASURED, label="scatter")
        ax.plot(hours, table[f"{name}_width"], "o", mfc="none", color=SECOND, label="width")
        for k, place in enumerate(zip(hours, scatter, strict=True)):
            ax.annotate(str(k), place, (7, 3), textcoords="offset points", fontsize=9)
        ax.margins(x=0.12, y=0.12)
        ax.set(xlabel="hours", ylabel=label, ylim=(0, None))
        legend(ax)
    return figure


def _redshift_figure(plans, chosen):
    width = 9.6 / len(plans) if len(plans) > 2 else 4.2
    figure, axes = new_figure(1, len(plans), size=(width, 3.6))
    for ax, one in zip(axes[0], plans, strict=True):
        rows = one.sources[chosen]
        plot_redshifts(rows["redshift"], rows["redshift_mean"], ax=ax, title=one.name)
    return figure


def _fraction_figure(plans, chosen, limit):
    figure, axes = new_figure(size=(6.4, 4.2))
    ax = axes[0, 0]
    for k, (one, color) in enumerate(zip(plans, (SECOND, "0.45", MEASURED), strict=False)):
        rows = one.sources[chosen]
        true, mean = (np.array(rows[name], float) for name in ("frac_agn", "frac_agn_mean"))
        if len(np.unique(true)) > 12:
            # of a continuous mix, the median of each tenth
            for tenth in np.array_split(np.argsort(true, kind="stable"), 10):
                true[tenth] = np.median(true[tenth])
        place = np.unique(true)
        levels = [np.nanpercentile(mean[true == value], (16, 50, 84)) for value in place]
        low, middle, high = np.transpose(levels)
        place = place + 0.015 * (k - (len(plans) - 1) / 2)
        spread = (middle - low, high - middle)
        ax.errorbar(place, middle, spread, fmt="o", color=color, capsize=2, label=one.name)
    ax.plot([0, 1], [0, 1], color=TRUE, lw=1)
    ax.axvline(limit, color=TRUE, lw=0.8, ls="--")
    ax.set(xlabel="true fracAGN", ylabel="posterior mean", xlim=(-0.05, 1.05), ylim=(-0.03, 1.03))
    legend(ax)
    return figure


def _area_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.4))
    area = table["area"].to_value(u.arcmin**2)
    left, right = axes[0]
    z, fraction = (r"$\Delta z / (1 + z)$", "z_scatter"), ("fracAGN", "frac_scatter")
    for (label, name), color in ((z, SECOND), (fraction, MEASURED)):
        right.errorbar(area, table[name], table[f"{name}_err"], fmt="o-", color=color, label=label)
    left.plot(area, table["n_detected"], "o-", color=SECOND, label="detected")
    left.plot(area, table["n_agn"], "o-", color=MEASURED, label="AGN found")
    for ax, label in ((left, "sources"), (right, "scatter of the means")):
        ax.set(xlabel="area (square arcmin)", ylabel=label, xscale="log", ylim=(0, None))
        ax.set_xticks(area, [f"{v:.1f}" for v in area])
        ax.set_xticks([], minor=True)
        legend(ax)
    return figure
