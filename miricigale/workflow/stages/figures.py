"""Figures of the report, from tables."""

import astropy.units as u
import numpy as np

from miricigale import sed
from miricigale.evaluation import (
    main_sequence_sfr,
    number_counts,
    running_median,
)
from miricigale.filters import Filter
from miricigale.plotting.axes import WIDTH, new_figure, panel_columns, panels
from miricigale.plotting.comparison import (
    MEASURED,
    SECOND,
    plot_counts,
    plot_error_function,
    plot_magnitudes,
    plot_offsets,
    plot_redshifts,
    plot_relation,
)
from miricigale.utils.units import ab_magnitude

__all__ = [
    "SET_COLORS",
    "SET_LABELS",
    "band_label",
    "counts_figure",
    "error_figure",
    "input_figure",
    "limit_figure",
    "magnitude_figure",
    "offset_figure",
    "point_figure",
    "redshift_figure",
    "three_bands",
    "variant_figure",
]

#: Sets of bands: what they are called, and their colors.
SET_LABELS = {
    "all": "with MIRI",
    "none": "without MIRI",
    "blue": "with the shorter half of MIRI",
    "red": "with the longer half of MIRI",
}
SET_COLORS = {"all": MEASURED, "none": SECOND, "blue": "tab:blue", "red": "tab:red"}


def band_label(name):
    """What a band is called on the page: ``F770W`` for ``miri.f770w``."""
    return name.rpartition(".")[2].upper()


def three_bands(names):
    """Bands that a picture shows: the shortest, the middle one and the longest in wavelength."""
    by_wave = sorted(names, key=lambda name: Filter.from_name(name).pivot)
    if len(by_wave) < 3:
        return by_wave
    return [by_wave[0], by_wave[len(by_wave) // 2], by_wave[-1]]


def _panels(bands, height, **share):
    """A panel for each band, with labels on the outer axes only."""
    figure, axes = panels(bands, height=height, **share)
    axes, columns = list(axes.values()), panel_columns(len(bands))

    def tidy():
        for k, ax in enumerate(axes):
            if k + columns < len(bands):
                ax.set_xlabel("")
            else:
                ax.tick_params(labelbottom=True)
            if k % columns:
                ax.set_ylabel("")

    return figure, axes, tidy


def magnitude_figure(table, bands):
    """Measured against true magnitude; ticks are sources without positive flux or off the axis."""
    figure, axes, tidy = _panels(bands, 3.3, sharex=True, sharey=True)
    true = {name: ab_magnitude(table[f"{name}_true"]) for name in bands}
    measured = {name: ab_magnitude(table[name]) for name in bands}
    known = np.concatenate([values[np.isfinite(values)] for values in true.values()])
    high = known.max(initial=20) + 1.5
    for ax, name in zip(axes, bands, strict=True):
        lost = np.isfinite(true[name]) & ~(measured[name] < high)
        plot_magnitudes(
            true[name], measured[name], ax=ax, lost=true[name][lost], title=band_label(name)
        )
    low = known.min(initial=high)
    bright = np.nanmin(np.concatenate([*measured.values(), [low]]))
    axes[0].set(xlim=(low - 0.4, high - 1.1), ylim=(high, min(low, bright) - 0.4))
    tidy()
    return figure


def offset_figure(table, bands, limits=None, marks=()):
    """
    Magnitude differences of matched sources with running medians.

    ``limits`` are 5-sigma limits (AB), drawn as lines; ``marks`` are bit of the condition, marker and
    label of the sources that are marked.
    """
    figure, axes, tidy = _panels(bands, 2.9, sharex=True, sharey=True)
    for ax, name in zip(axes, bands, strict=True):
        true, measured = ab_magnitude(table[f"{name}_true"]), ab_magnitude(table[name])
        offset = measured - true
        good = np.isfinite(offset)
        running = running_median(true[good], offset[good], size=20)
        plot_offsets(true[good], offset[good], running=running, ax=ax, title=band_label(name))
        condition = np.asarray(table[f"{name}_condition"])
        for bit, marker, label in marks:
            rows = good & ((condition & bit) > 0) & (np.abs(offset) <= 1)
            ax.plot(
                true[rows], offset[rows], marker, ms=5, mfc="none", mec="0.35", mew=0.7, label=label
            )
        if limits and np.isfinite(limits[name]):
            ax.axvline(limits[name], color="0.35", ls=":", lw=1.2, label="5-sigma limit")
        if ax is axes[0] and ax.get_legend_handles_labels()[0]:
            ax.legend(loc="lower left", fontsize=8, frameon=False)
        elif ax.get_legend():
            ax.get_legend().remove()
    tidy()
    return figure


def _wave_colors(bands):
    """A color for each band, darker at shorter wavelengths, distinct to color-blind readers."""
    from matplotlib import colormaps

    order = sorted(bands, key=lambda name: Filter.from_name(name).pivot)
    steps = np.linspace(0.0, 0.82, len(order)) if len(order) > 1 else [0.0]
    return {n: colormaps["viridis"](step) for n, step in zip(order, steps, strict=True)}


def error_figure(errors, bands, limits):
    """The error function of every band, with the 5-sigma limits in uJy."""
    figure, axes = new_figure(size=(WIDTH, 4.2))
    finite = [value for value in limits.values() if np.isfinite(value)]
    high = max(300, 30 * max(finite, default=1))
    flux = np.geomspace(0.02, high, 120) * u.uJy
    plot_error_function(
        dict.fromkeys(bands, flux.value),
        {name: errors.sigma(flux, name).to_value(u.uJy) for name in bands},
        limits=limits,
        ax=axes[0, 0],
        colors=_wave_colors(bands),
    )
    handles, names = axes[0, 0].get_legend_handles_labels()
    names = [band_label(name) for name in names]
    axes[0, 0].legend(handles, names, fontsize=8, frameon=False, ncols=2)
    return figure


def limit_figure(entries):
    """
    Limits against wavelength.

    Entries have ``limit``, ``formal_limit``, ``etc_limit``, ``proposal`` (AB or NaN) and ``ceers``,
    whether the exposures are those of the proposal.
    """
    figure, axes = new_figure(size=(WIDTH, 3.4))
    ax = axes[0, 0]
    bands = sorted(entries, key=lambda name: Filter.from_name(name).pivot)
    wave = np.array([Filter.from_name(name).pivot.to_value(u.um) for name in bands])
    values = {key: np.array([entries[n][key] for n in bands], float) for key in (
        "limit", "formal_limit", "etc_limit", "proposal")}  # fmt: skip
    own = np.array([entries[name]["ceers"] for name in bands], bool)
    ax.plot(wave, values["limit"], "o-", color=MEASURED, lw=1.2, label="error function")
    ax.plot(wave, values["formal_limit"], "s", color=MEASURED, mfc="none", label="formal error")
    label = "calculator, scaled to these exposures"
    ax.plot(wave, values["etc_limit"], "^--", color=SECOND, lw=1.2, label=label)
    for keep, label in ((own, "CEERS proposal"), (~own, "CEERS proposal, for other exposures")):
        if np.any(keep & np.isfinite(values["proposal"])):
            fill = {} if keep is own else {"mfc": "none"}
            ax.plot(wave[keep], values["proposal"][keep], "D", color="0.35", label=label, **fill)
    shown = np.concatenate([v[np.isfinite(v)] for v in values.values()])
    low, high = (shown.min(), shown.max()) if shown.size else (20, 26)
    for x, name in zip(wave, bands, strict=True):
        ax.text(x, high + 0.35, band_label(name), ha="center", va="bottom", fontsize=8, rotation=30)
    ax.set(
        xlim=(wave.min() - 1.5, wave.max() + 1.5),
        ylim=(low - 0.6, high + 1.3),
        xlabel="wavelength (µm)",
        ylabel="5-sigma limit (AB)",
    )
    ax.legend(fontsize=8, frameon=False, loc="lower left")
    return figure


def variant_figure(numbers, labels):
    """
    Limits of several images against the calculator's.

    ``numbers`` are those of `~miricigale.workflow.stages.variants.variant_numbers`, ``labels`` the names of
    images to what they are called.
    """
    figure, axes = new_figure(size=(WIDTH, 3.4))
    ax = axes[0, 0]
    bands = sorted(set(numbers["band"]), key=lambda name: Filter.from_name(name).pivot)
    for k, (name, label) in enumerate(labels.items()):
        rows = {row["band"]: row for row in numbers[numbers["images"] == name]}
        offsets = [rows[band]["limit"] - rows[band]["calculator"] for band in bands]
        place = np.arange(len(bands)) + 0.12 * (k - 0.5 * (len(labels) - 1))
        errors = [rows[band]["limit_err"] for band in bands]
        ax.errorbar(place, offsets, errors, fmt="o", ms=5, capsize=2, label=label)
    ax.axhline(0, color="0.6", lw=1, zorder=0)
    ax.set(xlim=(-0.6, len(bands) - 0.4), ylabel="limit minus calculator (mag)")
    ax.set_xticks(range(len(bands)), [band_label(name) for name in bands])
    # room for the legend
    low, high = ax.get_ylim()
    ax.set_ylim(low - 0.35 * (high - low), high)
    ax.legend(fontsize=8, frameon=False, loc="lower left", ncols=2)
    return figure


def redshift_figure(truth, fits):
    """Fitted against true redshifts, by set of bands."""
    rows = -(-len(fits) // 2)
    # a single one is half a page wide
    figure, axes = new_figure(rows, min(2, len(fits)), size=(WIDTH / 2, 4.7))
    for ax in axes.ravel()[len(fits) :]:
        ax.remove()
    for ax, (unit, table) in zip(axes.flat, fits.items(), strict=False):
        plot_redshifts(
            truth["redshift"],
            table["redshift_mean"],
            z_err=table["redshift_std"],
            ax=ax,
            title=SET_LABELS[unit],
        )
    for ax in axes[:, 1:].flat:
        ax.set_ylabel("")
    for ax in axes[:-1].flat:
        ax.set_xlabel("")
    return figure


def point_figure(points, bands):
    """Measured over true flux of the bright point sources of each band; triangles lie beyond."""
    figure, axes = new_figure(size=(WIDTH, 3.2))
    ax = axes[0, 0]
    ratios = [(points[n]["flux"] / points[n]["flux_true"]).to_value(u.one) for n in bands]
    finite = np.concatenate([r[np.isfinite(r)] for r in ratios])
    reach = np.clip(1.3 * np.percentile(np.abs(finite - 1), 98, method="higher"), 0.05, 0.5) if (
        finite.size) else 0.05  # fmt: skip
    for k, ratio in enumerate(ratios):
        x = k + np.linspace(-0.3, 0.3, len(ratio))
        for keep, marker in (
            (np.abs(ratio - 1) <= reach, "."),
            (ratio > 1 + reach, "^"),
            (ratio < 1 - reach, "v"),
        ):
            y = np.clip(ratio[keep], 1 - 0.97 * reach, 1 + 0.97 * reach)
            ax.plot(x[keep], y, marker, ms=4, color=MEASURED, alpha=0.6)
        if np.isfinite(ratio).any():
            ax.plot([k - 0.35, k + 0.35], [np.nanmedian(ratio)] * 2, color=SECOND, lw=2)
    ax.axhline(1, color="0.4", lw=1)
    ax.axhspan(0.97, 1.03, color="0.9", zorder=0)
    ax.set(
        xticks=range(len(bands)),
        xticklabels=[band_label(name) for name in bands],
        xlim=(-0.6, len(bands) - 0.4),
        ylim=(1 - reach, 1 + reach),
        ylabel="measured / true flux",
    )
    return figure


#: Least values that the figure of the inputs shows, and redshifts of its panels.
LEAST_RATE, LEAST_MASS = 1e-3 * u.Msun / u.yr, 1e7 * u.Msun
INPUT_REDSHIFTS = ((0.0, 1.0), (1.0, 2.0), (2.0, 3.0))


def input_figure(galaxies):
    """
    Star-formation rate against mass in ranges of redshift, with the main sequence at their middle.

    Of a table with ``redshift``, ``stellar_mass`` and ``sfr_100myr``. Returns the figure and the number of
    galaxies that it does not show: beyond its redshifts, or below the axes.
    """
    figure, axes = new_figure(
        1, len(INPUT_REDSHIFTS), size=(WIDTH / len(INPUT_REDSHIFTS), 3.4), sharex=True, sharey=True
    )
    redshift = np.asarray(galaxies["redshift"])
    mass, rate = galaxies["stellar_mass"], galaxies["sfr_100myr"]
    seen = (rate >= LEAST_RATE) & (mass >= LEAST_MASS)
    line = np.geomspace(1e8, 2e11, 30) * u.Msun
    shown = 0
    for ax, (low, high) in zip(axes[0], INPUT_REDSHIFTS, strict=True):
        rows = seen & (redshift >= low) & (redshift < high)
        shown += int(np.count_nonzero(rows))
        middle = 0.5 * (low + high)
        sequence = main_sequence_sfr(line, sed.COSMOLOGY.age(middle))
        plot_relation(
            mass[rows].to_value(u.Msun),
            rate[rows].to_value(u.Msun / u.yr),
            lines=[(line.value, sequence.value, f"main sequence, z = {middle:g}")],
            ax=ax,
            labels=(r"stellar mass / M$_\odot$", r"SFR (100 Myr) / (M$_\odot$/yr)"),
        )
        ax.set_title(f"{low:g} < z < {high:g} ({np.count_nonzero(rows)})", fontsize="medium")
        if ax is not axes[0, 0]:
            ax.set_ylabel("")
    axes[0, 0].set(xlim=(LEAST_MASS.value, None), ylim=(LEAST_RATE.value, None))
    return figure, len(galaxies) - shown


def counts_figure(galaxies, bands, area):
    """Number counts of the injected fluxes in every band."""
    figure, axes, tidy = _panels(bands, 2.7, sharex=True, sharey=True)
    edges = np.arange(15, 30.1, 0.5)
    for ax, name in zip(axes, bands, strict=True):
        counts, error = (v.to_value(u.deg**-2) for v in number_counts(galaxies[name], area, edges))
        plot_counts(edges, counts, error, ax=ax, title=band_label(name))
    tidy()
    return figure
