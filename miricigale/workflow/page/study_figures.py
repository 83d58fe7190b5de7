"""Figures of the fits of all truths and of what is known of their sources."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import (
    CLASS_NAMES,
    PAH_FEATURES,
    REDSHIFT_BINS,
    XRAY_LIMITS,
    TruthResults,
    completeness,
    feature_redshifts,
    measure,
    sfr_to_infrared_luminosity,
    sigma_mad,
    xray_fluxes,
)
from miricigale.evaluation.estimates import outlier_share
from miricigale.filters import Filter
from miricigale.plotting.axes import (
    MEASURED,
    SECOND,
    STYLES,
    TRUE,
    WIDTH,
    corner_note,
    label_outer,
    legend,
    new_figure,
    panels,
    plain_log_ticks,
    plain_text,
)
from miricigale.plotting.comparison import plot_offsets, plot_redshifts
from miricigale.utils.arrays import finite_values, quiet_division, quotient
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import first_value
from miricigale.utils.units import ab_magnitude
from miricigale.workflow.labels import (
    SET_LABELS,
    band_title,
    class_label,
    parameter_label,
    truth_label,
)
from miricigale.workflow.page.numbers import MIPS_LIMIT

#: Classes that sources are found in, as columns of tables.
CLASS_COLUMNS = CLASS_NAMES + ("unknown",)
#: Bins of the histograms of ranks.
_RANK_BINS = 10
#: PAH features that are looked for in the residuals.
FEATURES = PAH_FEATURES[1:3]


def _main_sets(truth):
    """Return the fits with and without MIRI that a truth has: name and label."""
    return {name: SET_LABELS[name] for name in ("all", "none") if name in truth.fits}


def answer_figure(study, numbers):
    """
    Draw outliers and scatter of redshifts, and fitted fracAGN, against the injected one, with and without MIRI.

    ``numbers`` are as for `~miricigale.workflow.page.result_sections.write_results`; None of one truth.
    """
    truths = []
    for truth in study.truths:
        if truth.frac_agn is not None and truth.sample.any():
            truths.append(truth)
    if len(truths) < 2:
        return None
    figure, axes = panels(("redshift outliers (%)", "redshift scatter (%)", "fitted fracAGN"))
    outliers, scatter, fraction = axes.values()
    injected = np.array([truth.frac_agn for truth in truths])
    for k, (unit, label) in enumerate(_main_sets(truths[0]).items()):
        for ax, quantity in ((outliers, "z_outliers"), (scatter, "z_scatter")):
            rows = [numbers[truth.name, unit, quantity] for truth in truths]
            ends = [100 * np.array([row[key] for row in rows]) for key in ("value", "low", "high")]
            _draw_estimates(ax, k, injected, *ends, label)
        offsets = [numbers[truth.name, unit, "frac_offset"]["value"] for truth in truths]
        width = [numbers[truth.name, unit, "frac_scatter"]["value"] for truth in truths]
        fitted = np.array(offsets) + injected
        _draw_estimates(fraction, k, injected, fitted, fitted - width, fitted + width, label)
    fraction.plot([0, 1], [0, 1], color=TRUE, lw=0.8, ls="--")
    legend(outliers, loc="upper left")
    return figure


def _draw_estimates(ax, k, injected, value, low, high, label):
    """Draw values with their intervals against the injected fracAGN, for the k-th set of bands."""
    color, marker = STYLES[k]
    spread = np.abs([value - low, high - value])
    # the sets apart
    place = injected + 0.012 * (k - 0.5)
    ax.errorbar(place, value, spread, label=label, fmt=marker, ls="-", ms=4.5, color=color, lw=1.2)
    ax.set_xlabel("injected fracAGN")


def _fitted(column):
    return lambda truth, name: truth.fitted(name, column)


#: Histograms: values of a truth and a set of bands, edges of bins, and label.
_HISTOGRAMS = {
    "redshift": (TruthResults.redshift_error, (-0.3, 0.3, 61), r"(z$_{\rm fit}$ - z) / (1 + z)"),
    "fraction": (_fitted("frac_agn_mean"), (0, 1, 26), "fracAGN (posterior mean)"),
    "width": (_fitted("frac_agn_std"), (0, 0.4, 26), "posterior width of fracAGN (std)"),
    "difference": (TruthResults.fraction_error, (-0.2, 0.8, 26), "fitted - true fracAGN"),
}


def histogram_figure(study, quantity):
    """
    Draw histograms of ``"redshift"`` errors, or the ``"fraction"`` of the AGN or its ``"width"``, by truth.

    Or of its ``"difference"`` to that of the first truth, by bin of redshift. A step line for each set of bands,
    with median, scatter and, of redshifts, the share of outliers; values beyond the bins are counted in the
    outermost ones.
    """
    values, bins, xlabel = _HISTOGRAMS[quantity]
    bins = np.linspace(*bins)
    # truth and range of redshifts of each panel
    shown = {}
    if quantity == "difference":
        for low, high in REDSHIFT_BINS:
            label = f"{low:g} < z < {high:g}".removesuffix(" < inf")
            shown[label] = (study.truths[0], low, high)
    else:
        for truth in study.truths:
            if truth.sample.any():
                shown[truth_label(truth)] = (truth, 0, np.inf)
    figure, axes = panels(shown, sharex=True)
    ends = 0.5 * (bins[[0, -2]] + bins[[1, -1]])
    for title, ax in axes.items():
        truth, low, high = shown[title]
        true = {"fraction": truth.frac_agn, "width": None}.get(quantity, 0.0)
        inside = (truth.true("redshift") >= low) & (truth.true("redshift") < high)
        for k, (name, label) in enumerate(_main_sets(truth).items()):
            sample = values(truth, name)[inside]
            sample = finite_values(sample)
            color = STYLES[k][0]
            ax.hist(np.clip(sample, *ends), bins, label=label, histtype="step", color=color, lw=1.6)
            if sample.size:
                note = f"{np.median(sample):.3f} ± {sigma_mad(sample):.3f}"
                if quantity == "redshift":
                    note += f"\n{100 * outlier_share(sample):.1f} % outliers"
                # away from the truth
                x = 0.97
                side = "right"
                if true is not None and true > 0.5:
                    x = 0.03
                    side = "left"
                ax.text(
                    x,
                    0.97 - 0.2 * k,
                    note,
                    color=color,
                    transform=ax.transAxes,
                    va="top",
                    ha=side,
                    fontsize=7.5,
                )
        if true is not None:
            ax.axvline(true, color=TRUE, lw=1, ls="--", label="truth")
        # space for the numbers
        ax.set(xlim=(bins[0], bins[-1]), ylim=(0, 1.3 * ax.get_ylim()[1]))
    label_outer(axes, xlabel, "sources")
    handles = first_value(axes).get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=3, fontsize=8, frameon=False)
    return figure


def redshift_figure(fits):
    """Draw fitted against true redshifts: by title, the true ones, and the table of the fit."""
    figure, axes = panels(fits, height=4.7)
    for title, ax in axes.items():
        true, table = fits[title]
        plot_redshifts(true, table["redshift_mean"], z_err=table["redshift_std"], ax=ax)
        ax.set_title(plain_text(title))
    label_outer(axes)
    return figure


def disk_figure(study):
    """
    Draw fitted against true accretion power of each truth with AGN, with a factor of two marked.

    None if there is no such truth.
    """
    unit = u.erg / u.s
    values = {}
    powers = []
    for truth in study.truths:
        if "all" not in truth.fits or "accretion_power" not in truth.truth.colnames:
            continue
        error = truth.power_error("all")
        error = finite_values(error)
        if error.size:
            true = truth.truth["accretion_power"][truth.sample].to_value(unit)
            fitted = truth.fits["all"]["accretion_power_mean"].to_value(unit)
            good = (true > 0) & (fitted > 0) & np.isfinite(true * fitted)
            note = f"median {np.median(error):+.2f} dex, scatter {sigma_mad(error):.2f} dex ({error.size})"
            values[truth_label(truth)] = (true[good], fitted[good], note)
            powers += [true[good], fitted[good]]
    if not values:
        return None
    figure, axes = panels(values, height=2.7, sharex=True, sharey=True)
    ends = np.percentile(np.concatenate(powers), [0.5, 99.5]) * [0.5, 2]
    for label, ax in axes.items():
        true, fitted, note = values[label]
        ax.loglog(true, fitted, ".", ms=4, color=MEASURED, alpha=0.6)
        plain_log_ticks(ax.xaxis, ax.yaxis)
        corner_note(ax, note, "left")
        ax.plot(ends, ends, color=TRUE, lw=1)
        ax.fill_between(ends, ends / 2, ends * 2, color=TRUE, alpha=0.12, lw=0)
        ax.set(xlim=ends, ylim=ends)
    label_outer(axes, "true disk luminosity (erg/s)", "fitted disk luminosity (erg/s)")
    return figure


def xray_figure(study, seed):
    """
    Draw X-ray fluxes of the injected AGN of the field and of those in the sample, and the share found beneath.

    With the limits of other surveys (dotted where they are estimates) and the flux of 50 % completeness; None
    without an AGN.
    """
    # without an AGN values are empty
    values = [np.zeros(0)]
    in_sample = [np.zeros(0, bool)]
    for truth in study.with_agn or study.truths:
        if "l_6um" in truth.truth.colnames:
            values.append(xray_fluxes(truth)[truth.field])
            in_sample.append(truth.sample[truth.field])
    values = np.concatenate(values)
    in_sample = np.concatenate(in_sample)
    good = np.isfinite(values)
    if not in_sample[good].any():
        return None
    low, high = np.percentile(values[good], [0.5, 99.5])
    bins = np.arange(np.floor(4 * low) / 4, np.ceil(4 * high) / 4 + 0.01, 0.25)
    table = completeness(values, in_sample, bins)
    figure, [[upper], [lower]] = new_figure(
        2, 1, size=(7.0, 2.2), sharex=True, height_ratios=(1.5, 1)
    )
    upper.stairs(table["n"], bins, color=TRUE, lw=1.6, label="all")
    upper.stairs(table["n_found"], bins, color=MEASURED, fill=True, alpha=0.35, label="found")
    upper.stairs(table["n_found"], bins, color=MEASURED, lw=1.6)
    filled = table[table["n"] > 0]
    place = 0.5 * (filled["low"] + filled["high"])
    lower.vlines(place, filled["share_low"], filled["share_high"], color=MEASURED, lw=1.2)
    lower.plot(place, filled["share"], "o", ms=4, color=MEASURED)
    lower.axhline(0.5, color=TRUE, lw=0.8, ls="--")
    half = None
    if study.with_agn:
        half = measure(study, "xray_half", truth=None, seed=seed)
    for ax in (upper, lower):
        if half is not None and np.isfinite(half.value):
            ax.axvspan(half.low, half.high, color=MEASURED, alpha=0.15, lw=0)
            ax.axvline(half.value, color=MEASURED, lw=1.2, label="50 % of these")
        for limit, color in zip(XRAY_LIMITS, (SECOND, "0.2", "#15803d"), strict=True):
            style = {"color": color, "ls": "-" if limit.checked else ":", "lw": 1.6}
            label = f"{limit.survey}, {limit.kind}"
            ax.axvline(np.log10(limit.flux.value), label=label, **style)
    # above the axes, which are full of lines
    legend(upper, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    upper.set(ylabel="sources", xlim=(bins[0], bins[-1]))
    xlabel = r"log X-ray flux, 0.5-7 keV (erg s$^{-1}$ cm$^{-2}$)"
    lower.set(ylabel="share found", xlabel=xlabel, ylim=(-0.05, 1.08))
    return figure


def detection_figure(study):
    """Draw infrared luminosities of the reference truth against redshift, and which are detected."""
    reference = study.truths[0]
    table = reference.truth
    n_detected = np.asarray(reference.matched["n_detected"])
    if len(study.bands) > 1:
        groups = {"detected in two or more MIRI bands": n_detected >= 2}
    else:
        groups = {"detected in the MIRI band": n_detected >= 1}
    if "mips.24" in table.colnames:
        groups["MIPS 24 µm above its limit"] = ab_magnitude(table["mips.24"]) < MIPS_LIMIT
    z = floats(table["redshift"])
    power = table["ir_luminosity"].to_value(u.Lsun)
    good = reference.field & (power > 0) & np.isfinite(z)
    figure, [[ax]] = new_figure(size=(7.0, 3.8))
    undetected = good & ~np.any(list(groups.values()), axis=0)
    ax.semilogy(
        z[undetected], power[undetected], ".", label="not detected", ms=4, color="0.75", zorder=1
    )
    for k, (name, rows) in enumerate(groups.items()):
        color, marker = STYLES[k]
        ax.plot(
            z[good & rows],
            power[good & rows],
            marker,
            label=name,
            ms=3 + 2.5 * k,
            color=color,
            mfc="none" if k else color,
            alpha=0.75,
        )
    if good.any():
        low, high = np.percentile(power[good], [1, 100])
        ax.set(xlim=(0, 1.03 * z[good].max()), ylim=(0.5 * low, 2 * high))
    ax.set(xlabel="redshift", ylabel=r"L$_\mathrm{IR}$ (L$_\odot$)")
    # of light of AGN it is no star-formation rate
    if reference.frac_agn == 0:
        rate = 1 / sfr_to_infrared_luminosity(1 * u.Msun / u.yr).to_value(u.Lsun)
        right = ax.secondary_yaxis("right", functions=(lambda v: v * rate, lambda v: v / rate))
        right.set_ylabel(r"SFR (M$_\odot$/yr), Kennicutt 1998")
    # above the axes, which are full of points
    legend(ax, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
    return figure


def shape_figure(study):
    """Draw magnitude errors of sources above 5 sigma by band and shape, crowded ones marked."""
    truth = study.truths[0]
    labels = {"point": "points", "n < 2": "n < 2", "n >= 2": "n ≥ 2"}
    groups = {}
    for band in study.bands:
        mag = ab_magnitude(truth.matched[f"{band}_true"])
        error = truth.magnitude_error(band)
        bright = truth.field & truth.is_bright(band) & np.isfinite(mag) & np.isfinite(error)
        for shape, rows in truth.shapes.items():
            rows = bright & rows
            title = f"{band_title(band)}, {labels[shape]} ({np.count_nonzero(rows)})"
            groups[title] = (mag[rows], error[rows], truth.crowded[band][rows])
    figure, axes = panels(groups, height=3.1, sharex=True, sharey=True)
    for title, ax in axes.items():
        mag, error, crowded = groups[title]
        plot_offsets(mag, error, ax=ax)
        ax.set_title(title, fontsize="medium")
        place = np.clip(error[crowded], -0.97, 0.97)
        ax.plot(mag[crowded], place, "o", ms=6, mfc="none", mec="0.35", mew=0.7)
        if mag.size:
            corner_note(ax, f"median {np.median(error):+.3f}")
    label_outer(axes)
    return figure


def class_figure(tables):
    """
    Draw shares of the sources of each true class that are found in each class, a panel for each set of bands.

    ``tables`` are of `~miricigale.evaluation.study_confusion`, by the title of the panel.
    """
    figure, axes = new_figure(1, len(tables), size=(WIDTH / 2, 3.4), sharey=True)
    for ax, (title, table) in zip(axes[0], tables.items(), strict=True):
        classes = [name for name in CLASS_COLUMNS if name in table.colnames]
        table = table[table["n"] > 0]
        counts = np.transpose([table[name] for name in classes])
        total = counts.sum(axis=1, keepdims=True)
        share = quotient(counts, total)
        ax.imshow(share, cmap="Oranges", vmin=0, vmax=1.2, aspect="auto")
        for (i, j), value in np.ndenumerate(share):
            text = f"{100 * value:.0f} %\n{counts[i, j]}"
            ax.text(j, i, text, ha="center", va="center", fontsize=9)
        for axis, names in ((ax.xaxis, classes), (ax.yaxis, table["class"])):
            axis.set_ticks(range(len(names)), [class_label(name) for name in names])
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set_title(title, fontsize="medium")
        ax.set_xlabel("found as")
    axes[0, 0].set_ylabel("true class")
    return figure


def band_residuals(results, bands):
    """
    Return measured minus best-model magnitudes of the MIRI bands, of sources above 5 sigma in them.

    ``results`` is a `~miricigale.workflow.stages.inputs.FitPieces`; dict of str to `~numpy.ndarray`, NaN where
    fainter.
    """
    out = {}
    for band in bands:
        k = results.first.filters.index(band)
        flux = results.of("flux")[:, k]
        error = results.of("flux_err")[:, k]
        model = results.of("best_flux")[:, k]
        with quiet_division():
            good = (flux > 5 * error) & (model > 0)
            ratio = np.where(good, flux / model, 1.0)
        out[band] = np.where(good, -2.5 * np.log10(ratio), np.nan)
    return out


def residual_figure(redshift, residuals):
    """
    Draw residuals of the fit in each band (`band_residuals`) against redshift.

    Redshifts at which a PAH feature is within the band are shaded, with the median there.
    """
    figure, axes = panels(residuals, height=2.9, sharex=True, sharey=True)
    for k, (band, ax) in enumerate(axes.items()):
        filter = Filter.from_name(band)
        good = np.isfinite(redshift) & np.isfinite(residuals[band])
        z = redshift[good]
        residual = residuals[band][good]
        plot_offsets(z, residual, ax=ax, limit=0.6)
        ax.set_title(band_title(band), fontsize="medium")
        for feature, color in zip(FEATURES, (SECOND, "#15803d"), strict=True):
            low, high = feature_redshifts(feature, filter.pivot, filter.width)
            if high > low:
                label = f"{feature.value:g} µm"
                ax.axvspan(low, high, color=color, alpha=0.12, lw=0, label=label)
                inside = residual[(z >= low) & (z < high)]
                if inside.size > 2:
                    ax.plot([low, high], [np.median(inside)] * 2, color=color, lw=2)
        if k == 0:
            legend(ax, loc="upper right", ncols=2)
    label_outer(axes, "redshift", "measured - model (mag)")
    return figure


def rank_figure(ranks):
    """
    Draw histograms of the ranks of the truth in the posteriors, with what chance allows.

    ``ranks`` are arrays by set of bands and parameter, in which NaN is left out.
    """
    by_name = {}
    for (unit, name), values in ranks.items():
        if unit in ("all", "none"):
            by_name.setdefault(parameter_label(name), {})[SET_LABELS[unit]] = values
    figure, axes = panels(by_name, height=2.6, sharex=True)
    for label, ax in axes.items():
        n_max = 0
        for k, (name, values) in enumerate(by_name[label].items()):
            n, edges = np.histogram(finite_values(values), _RANK_BINS, (0, 1))
            n_max = max(n_max, n.sum())
            ax.stairs(
                n * _RANK_BINS / max(n.sum(), 1),
                edges,
                label=name,
                color=STYLES[k][0],
                lw=1.6,
                ls=("-", "--")[k],
            )
        if n_max:
            # binomial, of a uniform distribution
            error = np.sqrt((_RANK_BINS - 1) / n_max)
            ax.axhspan(1 - error, 1 + error, color="0.88", zorder=0)
        ax.axhline(1, color=TRUE, lw=0.8)
        ax.set(xlim=(0, 1), ylim=(0, max(2.0, 1.05 * ax.get_ylim()[1])))
        legend(ax, loc="upper center")
    label_outer(axes, "rank of the truth", "density")
    return figure
