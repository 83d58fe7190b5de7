"""Figures with a panel or a curve for each band: photometry, limits, inputs."""

import astropy.units as u
import numpy as np

from miricigale import sed
from miricigale.evaluation import main_sequence_sfr, number_counts, running_median
from miricigale.filters import Filter
from miricigale.plotting.axes import (
    MEASURED,
    SECOND,
    TRUE,
    WIDTH,
    corner_note,
    label_outer,
    legend,
    new_figure,
    panels,
)
from miricigale.plotting.comparison import plot_error_function, plot_offsets, plot_relation
from miricigale.utils.arrays import finite_values, middles
from miricigale.utils.units import ab_magnitude
from miricigale.workflow.labels import band_label, band_title, by_wavelength
from miricigale.workflow.stages.conditions import has_flag

#: Panels of one range.
_SHARED = {"sharex": True, "sharey": True}


def magnitude_figure(table, bands):
    """Draw measured against true magnitude; ticks are sources without positive flux or off the axis."""
    figure, axes = panels(bands, height=3.3, **_SHARED)
    true = {name: ab_magnitude(table[f"{name}_true"]) for name in bands}
    measured = {name: ab_magnitude(table[name]) for name in bands}
    magnitudes = np.concatenate([finite_values(values) for values in true.values()])
    high = magnitudes.max(initial=20) + 1.5
    for name, ax in axes.items():
        ax.plot(true[name], measured[name], ".", ms=3.5, color=MEASURED, alpha=0.7)
        ax.axline((high, high), slope=1, color=TRUE, lw=1)
        lost = true[name][np.isfinite(true[name]) & ~(measured[name] < high)]
        ax.plot(
            lost,
            np.full(len(lost), 0.02),
            "|",
            color=TRUE,
            ms=6,
            transform=ax.get_xaxis_transform(),
        )
        ax.set_title(band_title(name))
    low = magnitudes.min(initial=high)
    bright = np.nanmin(np.concatenate([*measured.values(), [low]]))
    ax.set(xlim=(low - 0.4, high - 1.1), ylim=(high, min(low, bright) - 0.4))
    label_outer(axes, "true magnitude (AB)", "measured magnitude (AB)")
    return figure


def offset_figure(table, bands, limits, marks=()):
    """
    Draw magnitude differences of matched sources with running medians.

    ``limits`` are 5-sigma limits (AB), drawn as lines; ``marks`` are bit of the condition, marker and
    label of the sources that are marked.
    """
    figure, axes = panels(bands, height=2.9, **_SHARED)
    for name, ax in axes.items():
        true = ab_magnitude(table[f"{name}_true"])
        offset = ab_magnitude(table[name]) - true
        good = np.isfinite(offset)
        running = running_median(true[good], offset[good], size=20)
        plot_offsets(true[good], offset[good], running=running, ax=ax, title=band_title(name))
        style = {"ms": 5, "mfc": "none", "mec": "0.35", "mew": 0.7}
        for bit, marker, label in marks:
            rows = good & has_flag(table, f"{name}_condition", bit) & (np.abs(offset) <= 1)
            ax.plot(true[rows], offset[rows], marker, label=label, **style)
        if np.isfinite(limits[name]):
            ax.axvline(limits[name], color="0.35", ls=":", lw=1.2, label="5-sigma limit")
        if ax.get_legend_handles_labels()[0]:
            legend(ax, loc="lower left")
    label_outer(axes)
    return figure


def error_figure(errors, bands, limits):
    """Draw the error function of every band, with the 5-sigma limits in uJy."""
    from matplotlib import colormaps

    figure, [[ax]] = new_figure(size=(WIDTH, 4.2))
    order = by_wavelength(bands)
    finite = [value for value in limits.values() if np.isfinite(value)]
    flux = np.geomspace(0.02, max(300, 30 * max(finite, default=1)), 120) * u.uJy
    # darker at shorter wavelengths, distinct to color-blind readers
    shades = colormaps["viridis"](np.linspace(0, 0.82, len(order)))
    sigma = {}
    label_limits = {}
    colors = {}
    for name, shade in zip(order, shades, strict=True):
        label = band_label(name)
        sigma[label] = errors.sigma(flux, name).to_value(u.uJy)
        label_limits[label] = limits[name]
        colors[label] = shade
    fluxes = dict.fromkeys(sigma, flux.value)
    plot_error_function(fluxes, sigma, ax=ax, limits=label_limits, colors=colors)
    legend(ax, ncols=2)
    return figure


#: Limits that are drawn against wavelength: format, color and fill of the marks, and label.
_LIMITS = {
    "limit": ("o-", MEASURED, MEASURED, "error function"),
    "formal_limit": ("s", MEASURED, "none", "formal error"),
    "etc_limit": ("^--", SECOND, SECOND, "calculator, scaled to these exposures"),
}


def limit_figure(entries):
    """
    Draw limits against wavelength.

    Entries have ``limit``, ``formal_limit``, ``etc_limit``, ``proposal`` (AB or NaN) and ``ceers``,
    whether the exposures are those of the proposal.
    """
    figure, [[ax]] = new_figure(size=(WIDTH, 3.4))
    bands = by_wavelength(entries)
    wave = np.array([Filter.from_name(name).pivot.to_value(u.um) for name in bands])
    values = {}
    for key in (*_LIMITS, "proposal"):
        values[key] = np.array([entries[name][key] for name in bands], float)
    for key, (fmt, color, fill, label) in _LIMITS.items():
        ax.plot(wave, values[key], fmt, color=color, mfc=fill, lw=1.2, label=label)
    as_ceers = np.array([entries[name]["ceers"] for name in bands], bool)
    proposal = values["proposal"]
    for rows, fill, label in (
        (as_ceers, "0.35", "CEERS proposal"),
        (~as_ceers, "none", "CEERS proposal, for other exposures"),
    ):
        if np.any(rows & np.isfinite(proposal)):
            ax.plot(wave[rows], proposal[rows], "D", color="0.35", mfc=fill, label=label)
    shown = np.concatenate([finite_values(limits) for limits in values.values()])
    low = 20
    high = 26
    if shown.size:
        low = shown.min()
        high = shown.max()
    for x, name in zip(wave, bands, strict=True):
        ax.text(x, high + 0.35, band_title(name), ha="center", va="bottom", fontsize=8, rotation=30)
    ax.set(xlim=(wave.min() - 1.5, wave.max() + 1.5), xlabel="wavelength (µm)")
    ax.set(ylim=(low - 0.6, high + 1.3), ylabel="5-sigma limit (AB)")
    legend(ax, loc="lower left")
    return figure


def variant_figure(numbers, labels):
    """
    Draw limits of several images against the calculator's.

    ``numbers`` are those of `~miricigale.workflow.stages.variants.variant_numbers`, ``labels`` the names of
    images to what they are called.
    """
    figure, [[ax]] = new_figure(size=(WIDTH, 3.4))
    bands = by_wavelength(set(numbers["band"]))
    for k, (name, label) in enumerate(labels.items()):
        rows = {row["band"]: row for row in numbers[numbers["images"] == name]}
        offsets = [rows[band]["limit"] - rows[band]["calculator"] for band in bands]
        place = np.arange(len(bands)) + 0.12 * (k - 0.5 * (len(labels) - 1))
        errors = [rows[band]["limit_err"] for band in bands]
        ax.errorbar(place, offsets, errors, fmt="o", ms=5, capsize=2, label=label)
    ax.axhline(0, color="0.6", lw=1, zorder=0)
    ax.set(xlim=(-0.6, len(bands) - 0.4), ylabel="limit minus calculator (mag)")
    ax.set_xticks(range(len(bands)), [band_title(name) for name in bands])
    # space for the legend
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)
    legend(ax, loc="lower left", ncols=2)
    return figure


def point_figure(points, bands):
    """Draw measured over true flux of the bright point sources of each band; triangles lie beyond."""
    figure, [[ax]] = new_figure(size=(WIDTH, 3.2))
    ratios = [(points[n]["flux"] / points[n]["flux_true"]).to_value(u.one) for n in bands]
    finite = np.concatenate([finite_values(ratio) for ratio in ratios])
    far = 0.0
    if finite.size:
        far = np.percentile(np.abs(finite - 1), 98, method="higher")
    reach = np.clip(1.3 * far, 0.05, 0.5)
    for k, ratio in enumerate(ratios):
        x = k + np.linspace(-0.3, 0.3, len(ratio))
        marks = {".": np.abs(ratio - 1) <= reach, "^": ratio > 1 + reach, "v": ratio < 1 - reach}
        for marker, rows in marks.items():
            y = np.clip(ratio[rows], 1 - 0.97 * reach, 1 + 0.97 * reach)
            ax.plot(x[rows], y, marker, ms=4, color=MEASURED, alpha=0.6)
        if np.isfinite(ratio).any():
            ax.plot([k - 0.35, k + 0.35], [np.nanmedian(ratio)] * 2, color=SECOND, lw=2)
    ax.axhline(1, color="0.4", lw=1)
    ax.axhspan(0.97, 1.03, color="0.9", zorder=0)
    ax.set_xticks(range(len(bands)), [band_title(name) for name in bands])
    ax.set(xlim=(-0.6, len(bands) - 0.4), ylim=(1 - reach, 1 + reach))
    ax.set_ylabel("measured / true flux")
    return figure


def rival_figure(table):
    """
    Draw Source Extractor in a band against the truth and the template fit, with both error functions.

    ``table`` is one of `~miricigale.workflow.stages.rivals.rival_table` with the fluxes of both.
    """
    true = ab_magnitude(table["flux_true"])
    blind = ab_magnitude(table["source_extractor"])
    forced = ab_magnitude(table["yang2021"])
    usable = np.asarray(table["field"]) & ~np.asarray(table["edge"]) & np.isfinite(true)
    bright = usable & (table["snr"] > 5)
    spheroid = np.asarray(table["shape"]) == "n >= 2"
    titles = ("Source Extractor", "error functions", "points and n < 2", "n ≥ 2")
    figure, axes = panels(titles, height=3.1)
    accuracy, errors, disks, spheroids = axes.values()
    _draw_differences(accuracy, true, blind - true, usable)
    accuracy.set(xlabel="true magnitude (AB)", ylabel="measured - true (mag)")
    for ax, rows in ((disks, bright & ~spheroid), (spheroids, bright & spheroid)):
        _draw_differences(ax, blind, blind - forced, rows)
        ax.set(xlabel="Source Extractor (AB)", ylabel="Source Extractor - template fit (mag)")
    spheroids.sharex(disks)
    methods = (("template fit", forced, MEASURED), ("Source Extractor", blind, SECOND))
    for label, measured, color in methods:
        rows = usable & np.isfinite(measured)
        x = true[rows]
        y = np.abs(measured - true)[rows]
        errors.semilogy(x, y, ".", ms=3, color=color, alpha=0.3)
        middle, error, _ = running_median(x, y)
        errors.plot(middle, error, color=color, lw=1.8, label=label)
    errors.axhline(0.2, color=TRUE, lw=0.8, ls="--")
    errors.set(ylim=(2e-3, 2), xlabel="true magnitude (AB)", ylabel="|measured - true| (mag)")
    legend(errors, loc="upper left")
    return figure


def _draw_differences(ax, magnitude, difference, rows):
    """Draw differences of magnitudes with their running median; number in the title, median in the corner."""
    rows = rows & np.isfinite(difference)
    x = magnitude[rows]
    y = difference[rows]
    title = f"{ax.get_title()} ({np.count_nonzero(rows)})"
    plot_offsets(x, y, running=running_median(x, y), ax=ax, title=title)
    if y.size:
        corner_note(ax, f"median {np.median(y):+.3f} mag")


#: Least star-formation rate and stellar mass that the figure of the inputs shows.
MIN_RATE = 1e-3 * u.Msun / u.yr
MIN_MASS = 1e7 * u.Msun
#: Redshifts of its panels.
INPUT_REDSHIFTS = ((0.0, 1.0), (1.0, 2.0), (2.0, 3.0))


def input_figure(galaxies):
    """
    Draw star-formation rate against mass in ranges of redshift, with the main sequence at their middle.

    Of a table with ``redshift``, ``stellar_mass`` and ``sfr_100myr``. Returns the figure and the number of
    galaxies that it does not show: beyond its redshifts, or below the axes.
    """
    titles = [f"{low:g} < z < {high:g}" for low, high in INPUT_REDSHIFTS]
    figure, axes = panels(titles, height=3.4, **_SHARED)
    redshift = np.asarray(galaxies["redshift"])
    mass = galaxies["stellar_mass"]
    rate = galaxies["sfr_100myr"]
    on_axes = (rate >= MIN_RATE) & (mass >= MIN_MASS)
    line = np.geomspace(1e8, 2e11, 30) * u.Msun
    shown = 0
    for (title, ax), (low, high) in zip(axes.items(), INPUT_REDSHIFTS, strict=True):
        rows = on_axes & (redshift >= low) & (redshift < high)
        shown += int(np.count_nonzero(rows))
        middle = 0.5 * (low + high)
        sequence = main_sequence_sfr(line, sed.COSMOLOGY.age(middle))
        x = mass[rows].to_value(u.Msun)
        y = rate[rows].to_value(u.Msun / u.yr)
        lines = [(line.value, sequence.value, f"main sequence, z = {middle:g}")]
        labels = (r"stellar mass / M$_\odot$", r"SFR (100 Myr) / (M$_\odot$/yr)")
        plot_relation(x, y, lines=lines, ax=ax, labels=labels)
        ax.set_title(f"{title} ({np.count_nonzero(rows)})", fontsize="medium")
    label_outer(axes)
    ax.set(xlim=(MIN_MASS.value, None), ylim=(MIN_RATE.value, None))
    return figure, len(galaxies) - shown


def counts_figure(galaxies, bands, area):
    """Draw number counts of the injected fluxes in every band."""
    figure, axes = panels(bands, height=2.7, **_SHARED)
    edges = np.arange(15, 30.1, 0.5)
    for name, ax in axes.items():
        counts, error = number_counts(galaxies[name], area, edges)
        counts = counts.to_value(u.deg**-2)
        error = error.to_value(u.deg**-2)
        good = counts > 0
        middle = middles(edges)[good]
        ax.errorbar(middle, counts[good], error[good], fmt="o", ms=4, color=MEASURED, lw=1)
        ax.set(yscale="log", title=band_title(name))
    label_outer(axes, "magnitude (AB)", r"N (deg$^{-2}$ mag$^{-1}$)")
    return figure
