"""The page of a plan: tables and figures."""

import astropy.units as u
import numpy as np

from miricigale.pages import Page, number
from miricigale.planning.exposures import background_options
from miricigale.plotting.axes import new_figure
from miricigale.plotting.comparison import MEASURED, SECOND, plot_redshifts
from miricigale.workflow.background import background_text

__all__ = ["write_page"]

_NO_COUNT = "nothing to count"
#: Columns of the tables: name, heading, format, factor.
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
    page = Page(
        f"Plan {config.plan.name}",
        subtitle=f"{len(planner.sources)} sources, seed {config.plan.seed}",
        notices=_notices(planner),
    )
    page.section("The sets of bands")
    page.items(_headline(comparison, best))
    page.table(
        [_numbers(row, "plan", rank=True) for row in comparison],
        header=[
            "bands",
            "hours",
            *(text for _, text, _, _ in _NUMBERS),
            "detected",
            "AGN",
            "merit",
        ],
        caption=(
            f"{comparison['n'][0]} sources that one of the sets detects, the same in each row, with "
            "and without MIRI. Scatter (sigma_MAD) and offsets are of posterior means, z over 1+z; "
            "widths are median posterior standard deviations. 'detected' and 'AGN' are sources above 5 sigma in "
            f"{config.fit.min_detected} MIRI bands, or in all of a set with fewer, and AGN detected so and "
            "selected, expected in the area. Ranked by merit for each "
            f"hour: {_MERITS[config.survey.rank]}."
        ),
        text=2,
    )
    page.figure(_comparison_figure(comparison), _COMPARED)
    every = max(miri, key=lambda plan: len(plan.bands))
    page.section("Exposures", _exposure_text(planner, every))
    page.table(
        [
            (
                row["filter"].removeprefix("miri."),
                f"{row['time'].to_value(u.s):.0f}",
                f"{row['dithers']} x {row['integrations']} x {row['groups']}",
                f"{row['background'].value:.1f}",
                f"{100 * row['sky_in_well']:.0f}",
                *(f"{row[name].value:.2f}" for name in ("limit_etc", "limit", "limit_used")),
                f"{row['saturates'].value:.1f}",
                row["n_saturated"],
            )
            for row in every.band_table()
        ],
        header=[
            "band", "s", "dithers x integrations x groups", "sky (MJy/sr)", "sky in well (%)",
            "calculator", "aperture", "used", "saturates", "sources",
        ],
        caption=(
            "5-sigma limits of point sources (AB): the exposure time calculator's, scaled (low "
            "background); in its aperture, by these exposures; of the errors that are drawn. A point "
            "saturates at the magnitude given, as do so many sources of the sample, if they were points."
        ),
    )  # fmt: skip
    shown = list({plan.name: plan for plan in (plans[0], best, every)}.values())
    chosen = planner.common(plans)
    page.section("Redshift and fracAGN")
    page.figure(
        _redshift_figure(shown, chosen), "Redshifts of the compared sources, posterior means."
    )
    page.figure(
        _fraction_figure(shown, chosen, config.agn.limit),
        "Posterior means of fracAGN by true value: median, and 16th to 84th percentile of the sources. "
        "The dashed line is the limit from which a source is an AGN.",
    )
    if images is not None:
        _write_images(page, *images)
    if areas is not None and len(areas):
        page.section(
            "Depth against area",
            "The exposure times of all bands divided among more pointings, each a visit of its own.",
        )
        page.table(
            [_numbers(row, "pointings") for row in areas],
            header=["pointings", "hours", *(text for _, text, _, _ in _NUMBERS), "detected", "AGN"],
            caption="Numbers of the sources that each plan detects; counts are of its area.",
        )
        page.figure(
            _area_figure(areas), "Sources detected, AGN found, and the scatter of their fits."
        )
    return page.write(path)


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
        [
            (
                row["filter"].removeprefix("miri."),
                f"{row['limit'].value:.2f}",
                f"{row['limit_images'].value:.2f}",
                _with_error(row, "scatter", ".2f", 1),
                _with_error(row, "offset", "+.1f", 100),
                row["n_detected"],
                row["n_detected_images"],
            )
            for row in bands
        ],
        header=[
            "band", "limit, plan", "limit, images", "scatter", "offset (%)", "detected, plan",
            "detected, images",
        ],
        caption=(
            "5-sigma limits of points (AB) by the plan and by the error functions that the images gave; scatter "
            "of measured less true flux, over the error that the plan gives the source (1 if the images have "
            "no other noise); median offset of sources above 10 sigma; sources of the field above 5 sigma."
        ),
    )  # fmt: skip
    formats = {name: (text, spec, scale) for name, text, spec, scale in _NUMBERS}
    for name in dict.fromkeys(numbers["plan"]):
        rows = []
        for row in numbers[numbers["plan"] == name]:
            text, spec, scale = formats[row["number"]]
            signed = "+" + spec.removeprefix("+")
            cells = [_with_error(row, key, spec, scale) for key in ("noise", "images")]
            cells += [_with_error(row, "difference", signed, scale)]
            cells += [number(row["sigma"], "+.1f", "all sources agree")]
            rows.append((text, *cells))
        page.table(
            rows,
            header=[f"bands: {name}", "noise", "images", "difference", "sigma"],
            caption="The difference has the error of the same sources drawn together.",
        )


_MERITS = {
    "agn": "AGN found times the purity",
    "frac_agn": "inverse variance of fracAGN gained over the existing bands, relative to these",
    "redshift": "inverse variance of redshift gained over the existing bands, relative to these",
}
_COMPARED = (
    "Scatter of posterior means (points, with the ranks of the table) and widths of posteriors (circles) "
    "against time."
)


def _notices(planner):
    """What a reader has to know first."""
    config, libraries = planner.config, planner.sources.meta.get("libraries", ())
    noise = {
        "fitted": "of forced photometry of the mosaic, from photons, dark and read noise",
        "aperture": "of the exposure time calculator's aperture",
        "run": f"of the run {config.noise.run}, scaled",
    }[config.noise.kind]
    notices = [
        "A source is measured with Gaussian noise, without blends or cosmic rays"
        + ("; a section compares it with images." if config.images.enabled else ": no images."),
        f"MIRI errors are those {noise}, and {100 * config.noise.fractional:g} % of the flux.",
        f"Truth and fit share models; the fit allows for {100 * config.fit.model_error:g} % of error.",
        "Hours are approximations to what APT charges, a visit for each pointing; APT decides.",
    ]
    agn = config.agn
    mix = ", ".join(f"{f:g}: {s:.2g}" for f, s in zip(agn.frac_agn, agn.shares, strict=True))
    mix = f"shares by fracAGN {mix}"
    if agn.field:
        mix = "those of a real field, after an X-ray luminosity function"
    if planner.given is None:
        notices.append(f"AGN, on which completeness, purity and counts depend: {mix}.")
    options = background_options(config)
    notices.append(f"Background: {background_text(**options)}.")
    return [*notices, *(f"Models: {text}" for text in libraries)]


def _headline(comparison, best):
    row = comparison[1]
    return [
        ("best for each hour", best.name),
        ("hours", f"{row['time'].to_value(u.h):.1f}"),
        ("scatter of z", number(row["z_scatter"], ".4f", _NO_COUNT)),
        ("scatter of fracAGN", number(row["frac_scatter"], ".3f", _NO_COUNT)),
    ]


def _with_error(row, name, spec, scale):
    value, error = row[name], row[f"{name}_err"]
    if not np.isfinite(error):
        return number(value, spec, _NO_COUNT, scale=scale)
    plain = spec.removeprefix("+")
    return number(value, f"{{:{spec}}} ± {scale * error:{plain}}", _NO_COUNT, scale=scale)


def _numbers(row, first, *, rank=False):
    cells = [row[first], f"{row['time'].to_value(u.h):.1f}"]
    cells += [_with_error(row, name, spec, scale) for name, _, spec, scale in _NUMBERS]
    unknown = "nothing is detected without MIRI, or the area of the catalog is not known"
    cells += [number(row[name], ".0f", unknown) for name in ("n_detected", "n_agn")]
    return cells + ([number(row["merit"], ".3g", "no time is spent")] if rank else [])


def _exposure_text(planner, plan):
    n = planner.config.exposures.pointings
    own = sum(band.time.to_value(u.h) for band in plan.bands.values())
    where = "one pointing" if n == 1 else f"each of {n} pointings"
    return (
        f"{plan.name}: {own:.1f} h of light in {where}, {plan.area.value:.1f} square arcmin; "
        f"{plan.time.to_value(u.h):.1f} h with overheads."
    )


def _comparison_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.6))
    hours = table["time"].to_value(u.h)
    labels = (r"$\Delta z / (1 + z)$", "fracAGN")
    for ax, name, label in zip(axes[0], ("z", "frac"), labels, strict=True):
        scatter = table[f"{name}_scatter"]
        ax.errorbar(
            hours,
            scatter,
            table[f"{name}_scatter_err"],
            fmt="o",
            ms=5,
            color=MEASURED,
            label="scatter",
        )
        ax.plot(hours, table[f"{name}_width"], "o", mfc="none", color=SECOND, label="width")
        for k, place in enumerate(zip(hours, scatter, strict=True)):
            ax.annotate(str(k), place, (7, 3), textcoords="offset points", fontsize=9)
        ax.set(xlabel="hours", ylabel=label)
        ax.margins(x=0.12, y=0.12)
        ax.set_ylim(0, None)
        ax.legend(fontsize=8, frameon=False)
    return figure


def _redshift_figure(plans, chosen):
    figure, axes = new_figure(
        1, len(plans), size=(9.6 / len(plans) if len(plans) > 2 else 4.2, 3.6)
    )
    for ax, one in zip(axes[0], plans, strict=True):
        rows = one.sources[chosen]
        plot_redshifts(rows["redshift"], rows["redshift_mean"], ax=ax, title=one.name)
    return figure


def _fraction_figure(plans, chosen, limit):
    figure, axes = new_figure(1, 1, size=(6.4, 4.2))
    ax = axes[0, 0]
    for k, (one, color) in enumerate(zip(plans, (SECOND, "0.45", MEASURED), strict=False)):
        rows = one.sources[chosen]
        true = np.asarray(rows["frac_agn"], float)
        values = np.unique(true)
        if len(values) > 12:
            # of a continuous mix, the median of each tenth
            edges = np.unique(np.percentile(true, np.linspace(0, 100, 11)))
            nearest = np.clip(np.searchsorted(edges, true, side="right") - 1, 0, len(edges) - 2)
            middle = [np.median(true[nearest == j]) for j in np.unique(nearest)]
            nearest = np.unique(nearest, return_inverse=True)[1]
        else:
            middle, nearest = values, np.searchsorted(values, true)
        mean = np.asarray(rows["frac_agn_mean"], float)
        levels = np.array(
            [np.nanpercentile(mean[nearest == j], (16, 50, 84)) for j in range(len(middle))]
        )
        x = np.asarray(middle) + 0.015 * (k - (len(plans) - 1) / 2)
        spread = np.abs(levels[:, [0, 2]] - levels[:, [1]]).T
        ax.errorbar(x, levels[:, 1], spread, fmt="o", color=color, capsize=2, label=one.name)
    ax.plot([0, 1], [0, 1], color="0.35", lw=1)
    ax.axvline(limit, color="0.35", lw=0.8, ls="--")
    ax.set(xlabel="true fracAGN", ylabel="posterior mean", xlim=(-0.05, 1.05), ylim=(-0.03, 1.03))
    ax.legend(fontsize=8, frameon=False)
    return figure


def _area_figure(table):
    figure, axes = new_figure(1, 2, size=(4.6, 3.4))
    area = table["area"].to_value(u.arcmin**2)
    left, right = axes[0]
    left.plot(area, table["n_detected"], "o-", color=SECOND, label="detected")
    left.plot(area, table["n_agn"], "o-", color=MEASURED, label="AGN found")
    left.set(xlabel="area (square arcmin)", ylabel="sources")
    for name, color, label in (
        ("z_scatter", SECOND, r"$\Delta z / (1 + z)$"),
        ("frac_scatter", MEASURED, "fracAGN"),
    ):
        right.errorbar(area, table[name], table[f"{name}_err"], fmt="o-", color=color, label=label)
    right.set(xlabel="area (square arcmin)", ylabel="scatter of the means")
    for ax in (left, right):
        ax.set_xscale("log")
        ax.set_ylim(0, None)
        ax.set_xticks(area, [f"{v:.1f}" for v in area])
        ax.set_xticks([], minor=True)
        ax.legend(fontsize=8, frameon=False)
    return figure
