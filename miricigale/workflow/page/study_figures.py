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
    label_outer,
    legend,
    new_figure,
    panels,
    plain_text,
)
from miricigale.plotting.comparison import plot_offsets, plot_redshifts
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
CLASS_COLUMNS = (*CLASS_NAMES, "unknown")
#: Bins of the histograms of ranks.
_RANK_BINS = 10
#: PAH features that are looked for in the residuals.
FEATURES = PAH_FEATURES[1:3]


def _both(one):
    """The fits with and without MIRI that a truth has: name and label."""
    return {name: SET_LABELS[name] for name in ("all", "none") if name in one.fits}


def answer_figure(study, numbers):
    """
    Outliers and scatter of redshifts, and fitted fracAGN, against the injected one, with and without MIRI.

    ``numbers`` are as for `~miricigale.workflow.page.result_sections.write_results`; None of one truth.
    """
    truths = [one for one in study.truths if one.frac_agn is not None and one.sample.any()]
    if len(truths) < 2:
        return None
    figure, axes = panels(("redshift outliers (%)", "redshift scatter (%)", "fitted fracAGN"))
    injected = np.array([one.frac_agn for one in truths])
    for k, (name, label) in enumerate(_both(truths[0]).items()):
        color, marker = STYLES[k]
        place = injected + 0.012 * (k - 0.5)
        quantities = (("z_outliers", 100), ("z_scatter", 100), ("frac_offset", 1))
        for ax, (quantity, scale) in zip(axes.values(), quantities, strict=True):
            rows = [numbers[one.name, name, quantity] for one in truths]
            found = [[row[column] for row in rows] for column in ("value", "low", "high")]
            value, low, high = scale * np.array(found)
            if quantity == "frac_offset":
                scatter = [numbers[one.name, name, "frac_scatter"]["value"] for one in truths]
                value = value + injected
                low, high = value - scatter, value + scatter
            spread = np.abs([value - low, high - value])
            style = {"fmt": marker, "ls": "-", "ms": 4.5, "color": color, "lw": 1.2}
            ax.errorbar(place, value, spread, label=label, **style)
            ax.set_xlabel("injected fracAGN")
    list(axes.values())[-1].plot([0, 1], [0, 1], color=TRUE, lw=0.8, ls="--")
    legend(next(iter(axes.values())), loc="upper left")
    return figure


def _fitted(column):
    return lambda one, name: one.fitted(name, column)


#: Histograms: values of a truth and a set of bands, edges of bins, and label.
_HISTOGRAMS = {
    "redshift": (TruthResults.redshift_error, (-0.3, 0.3, 61), r"(z$_{\rm fit}$ - z) / (1 + z)"),
    "fraction": (_fitted("frac_agn_mean"), (0, 1, 26), "fracAGN (posterior mean)"),
    "width": (_fitted("frac_agn_std"), (0, 0.4, 26), "posterior width of fracAGN (std)"),
    "difference": (TruthResults.fraction_error, (-0.2, 0.8, 26), "fitted - true fracAGN"),
}


def histogram_figure(study, quantity):
    """
    Histograms of ``"redshift"`` errors, or the ``"fraction"`` of the AGN or its ``"width"``, by truth.

    Or of its ``"difference"`` to that of the first truth, by bin of redshift. A step line for each set of bands,
    with median, scatter and, of redshifts, the share of outliers; values beyond the bins are counted in the
    outermost ones.
    """
    values, bins, xlabel = _HISTOGRAMS[quantity]
    bins = np.linspace(*bins)
    shown = {truth_label(one): (one, (0, np.inf)) for one in study.truths if one.sample.any()}
    if quantity == "difference":
        one = study.truths[0]
        labels = [f"{low:g} < z < {high:g}".removesuffix(" < inf") for low, high in REDSHIFT_BINS]
        shown = {label: (one, span) for label, span in zip(labels, REDSHIFT_BINS, strict=True)}
    figure, axes = panels(shown, sharex=True)
    ends = 0.5 * (bins[[0, -2]] + bins[[1, -1]])
    for title, ax in axes.items():
        one, (low, high) = shown[title]
        true = {"fraction": one.frac_agn, "width": None}.get(quantity, 0.0)
        inside = (one.true("redshift") >= low) & (one.true("redshift") < high)
        for k, (name, label) in enumerate(_both(one).items()):
            some = values(one, name)[inside]
            some = some[np.isfinite(some)]
            color = STYLES[k][0]
            ax.hist(np.clip(some, *ends), bins, label=label, histtype="step", color=color, lw=1.6)
            if some.size:
                note = f"{np.median(some):.3f} ± {sigma_mad(some):.3f}"
                if quantity == "redshift":
                    note += f"\n{100 * outlier_share(some):.1f} % outliers"
                # away from the truth
                x, side = (0.03, "left") if (true or 0) > 0.5 else (0.97, "right")
                at = {"transform": ax.transAxes, "va": "top", "ha": side, "fontsize": 7.5}
                ax.text(x, 0.97 - 0.2 * k, note, color=color, **at)
        if true is not None:
            ax.axvline(true, color=TRUE, lw=1, ls="--", label="truth")
        # space for the numbers
        ax.set(xlim=(bins[0], bins[-1]), ylim=(0, 1.3 * ax.get_ylim()[1]))
    label_outer(axes, xlabel, "sources")
    handles = next(iter(axes.values())).get_legend_handles_labels()
    figure.legend(*handles, loc="outside upper left", ncols=3, fontsize=8, frameon=False)
    return figure


def redshift_figure(fits):
    """Fitted against true redshifts: by title, the true ones, and the table of the fit."""
    figure, axes = panels(fits, height=4.7)
    for title, ax in axes.items():
        true, table = fits[title]
        plot_redshifts(true, table["redshift_mean"], z_err=table["redshift_std"], ax=ax)
        ax.set_title(plain_text(title))
    label_outer(axes)
    return figure


def disk_figure(study):
    """
    Fitted against true accretion power of each truth with AGN, with a factor of two marked.

    None if there is no such truth.
    """
    values, unit = {}, u.erg / u.s
    for one in study.truths:
        if "all" not in one.fits or "accretion_power" not in one.truth.colnames:
            continue
        error = one.power_error("all")
        error = error[np.isfinite(error)]
        if error.size:
            true = one.truth["accretion_power"][one.sample].to_value(unit)
            fitted = one.fits["all"]["accretion_power_mean"].to_value(unit)
            good = (true > 0) & (fitted > 0) & np.isfinite(true * fitted)
            note = f"median {np.median(error):+.2f} dex, scatter {sigma_mad(error):.2f} dex ({error.size})"
            values[truth_label(one)] = (true[good], fitted[good], note)
    if not values:
        return None
    figure, axes = panels(values, height=2.7, sharex=True, sharey=True)
    every = np.concatenate([v for true, fitted, _ in values.values() for v in (true, fitted)])
    ends = np.percentile(every, [0.5, 99.5]) * [0.5, 2]
    for label, ax in axes.items():
        true, fitted, note = values[label]
        ax.loglog(true, fitted, ".", ms=4, color=MEASURED, alpha=0.6)
        ax.text(0.04, 0.95, note, transform=ax.transAxes, fontsize=8, va="top")
        ax.plot(ends, ends, color=TRUE, lw=1)
        ax.fill_between(ends, ends / 2, ends * 2, color=TRUE, alpha=0.12, lw=0)
        ax.set(xlim=ends, ylim=ends)
    label_outer(axes, "true disk luminosity (erg/s)", "fitted disk luminosity (erg/s)")
    return figure


def xray_figure(study, seed):
    """
    X-ray fluxes of the injected AGN of the field and of those in the sample, and the share found beneath.

    With the limits of other surveys (dotted where they are estimates) and the flux of 50 % completeness; None
    without an AGN.
    """
    truths = study.with_agn or study.truths
    truths = [one for one in truths if "l_6um" in one.truth.colnames]
    values = np.concatenate([[], *(xray_fluxes(one)[one.field] for one in truths)])
    found = np.concatenate([np.zeros(0, bool), *(one.sample[one.field] for one in truths)])
    good = np.isfinite(values)
    if not found[good].any():
        return None
    ends = np.percentile(values[good], [0.5, 99.5])
    bins = np.arange(np.floor(4 * ends[0]) / 4, np.ceil(4 * ends[1]) / 4 + 0.01, 0.25)
    table = completeness(values, found, bins)
    form = {"size": (7.0, 2.2), "sharex": True, "height_ratios": (1.5, 1)}
    figure, [[upper], [lower]] = new_figure(2, 1, **form)
    upper.stairs(table["n"], bins, color=TRUE, lw=1.6, label="all")
    upper.stairs(table["n_found"], bins, color=MEASURED, fill=True, alpha=0.35, label="found")
    upper.stairs(table["n_found"], bins, color=MEASURED, lw=1.6)
    some = table[table["n"] > 0]
    place = 0.5 * (some["low"] + some["high"])
    lower.vlines(place, some["share_low"], some["share_high"], color=MEASURED, lw=1.2)
    lower.plot(place, some["share"], "o", ms=4, color=MEASURED)
    lower.axhline(0.5, color=TRUE, lw=0.8, ls="--")
    half = measure(study, "xray_half", truth=None, seed=seed) if study.with_agn else None
    for ax in (upper, lower):
        if half is not None and np.isfinite(half.value):
            ax.axvspan(half.low, half.high, color=MEASURED, alpha=0.15, lw=0)
            ax.axvline(half.value, color=MEASURED, lw=1.2, label="50 % of these")
        for one, color in zip(XRAY_LIMITS, (SECOND, "0.2", "#15803d"), strict=True):
            style = {"color": color, "ls": "-" if one.checked else ":", "lw": 1.6}
            ax.axvline(np.log10(one.flux.value), label=f"{one.survey}, {one.kind}", **style)
    # above the axes, which are full of lines
    legend(upper, loc="lower left", bbox_to_anchor=(0, 1), ncols=3)
    upper.set(ylabel="sources", xlim=(bins[0], bins[-1]))
    xlabel = r"log X-ray flux, 0.5-7 keV (erg s$^{-1}$ cm$^{-2}$)"
    lower.set(ylabel="share found", xlabel=xlabel, ylim=(-0.05, 1.08))
    return figure


def detection_figure(study):
    """Infrared luminosities of the reference truth against redshift, and which are detected."""
    one = study.truths[0]
    table, least = one.truth, min(2, len(study.bands))
    named = "two or more MIRI bands" if least == 2 else "the MIRI band"
    seen = np.asarray(one.matched["n_detected"]) >= least
    groups = {f"detected in {named}": seen}
    if "mips.24" in table.colnames:
        with np.errstate(invalid="ignore"):
            groups["MIPS 24 µm above its limit"] = ab_magnitude(table["mips.24"]) < MIPS_LIMIT
    z, power = np.asarray(table["redshift"], float), table["ir_luminosity"].to_value(u.Lsun)
    good = one.field & (power > 0) & np.isfinite(z)
    figure, [[ax]] = new_figure(size=(7.0, 3.8))
    rest = good & ~np.any(list(groups.values()), axis=0)
    ax.semilogy(z[rest], power[rest], ".", ms=4, color="0.75", label="not detected", zorder=1)
    for k, (name, rows) in enumerate(groups.items()):
        color, marker = STYLES[k]
        style = {"ms": 3 + 2.5 * k, "color": color, "mfc": "none" if k else color, "alpha": 0.75}
        ax.plot(z[good & rows], power[good & rows], marker, label=name, **style)
    if good.any():
        low, high = np.percentile(power[good], [1, 100])
        ax.set(xlim=(0, 1.03 * z[good].max()), ylim=(0.5 * low, 2 * high))
    ax.set(xlabel="redshift", ylabel=r"L$_\mathrm{IR}$ (L$_\odot$)")
    # of light of AGN it is no star-formation rate
    if one.frac_agn == 0:
        rate = 1 / sfr_to_infrared_luminosity(1 * u.Msun / u.yr).to_value(u.Lsun)
        right = ax.secondary_yaxis("right", functions=(lambda v: v * rate, lambda v: v / rate))
        right.set_ylabel(r"SFR (M$_\odot$/yr), Kennicutt 1998")
    # above the axes, which are full of points
    legend(ax, loc="lower left", bbox_to_anchor=(0, 1), ncols=4)
    return figure


def shape_figure(study):
    """Magnitude errors of sources above 5 sigma by band and shape, crowded ones marked."""
    one, groups = study.truths[0], {}
    labels = {"point": "points", "n < 2": "n < 2", "n >= 2": "n ≥ 2"}
    for band in study.bands:
        mag, error = ab_magnitude(one.matched[f"{band}_true"]), one.magnitude_error(band)
        bright = one.field & one.is_bright(band) & np.isfinite(mag) & np.isfinite(error)
        for shape, rows in one.shapes.items():
            rows = bright & rows
            title = f"{band_title(band)}, {labels[shape]} ({np.count_nonzero(rows)})"
            groups[title] = (mag[rows], error[rows], one.crowded[band][rows])
    figure, axes = panels(groups, height=3.1, sharex=True, sharey=True)
    for title, ax in axes.items():
        mag, error, crowded = groups[title]
        plot_offsets(mag, error, ax=ax)
        ax.set_title(title, fontsize="medium")
        place = np.clip(error[crowded], -0.97, 0.97)
        ax.plot(mag[crowded], place, "o", ms=6, mfc="none", mec="0.35", mew=0.7)
        if mag.size:
            text = f"median {np.median(error):+.3f}"
            ax.text(0.96, 0.95, text, transform=ax.transAxes, ha="right", va="top", fontsize=8)
    label_outer(axes)
    return figure


def class_figure(tables):
    """
    Shares of the sources of each true class that are found in each class, a panel for each set of bands.

    ``tables`` are of `~miricigale.evaluation.study_confusion`, by the title of the panel.
    """
    figure, axes = new_figure(1, len(tables), size=(WIDTH / 2, 3.4), sharey=True)
    for ax, (title, table) in zip(axes[0], tables.items(), strict=True):
        found = [name for name in CLASS_COLUMNS if name in table.colnames]
        table = table[table["n"] > 0]
        counts = np.transpose([table[name] for name in found])
        total = counts.sum(axis=1, keepdims=True)
        share = np.divide(counts, total, out=np.zeros(counts.shape), where=total > 0)
        ax.imshow(share, cmap="Oranges", vmin=0, vmax=1.2, aspect="auto")
        for (i, j), value in np.ndenumerate(share):
            text = f"{100 * value:.0f} %\n{counts[i, j]}"
            ax.text(j, i, text, ha="center", va="center", fontsize=9)
        for axis, names in ((ax.xaxis, found), (ax.yaxis, table["class"])):
            axis.set_ticks(range(len(names)), [class_label(name) for name in names])
        ax.tick_params(length=0)
        ax.spines[:].set_visible(False)
        ax.set_title(title, fontsize="medium")
        ax.set_xlabel("found as")
    axes[0, 0].set_ylabel("true class")
    return figure


def band_residuals(results, bands):
    """
    Measured minus best-model magnitudes of the MIRI bands, of sources above 5 sigma in them.

    ``results`` is a `~miricigale.workflow.stages.inputs.FitPieces`; dict of str to `~numpy.ndarray`, NaN where
    fainter.
    """
    out = {}
    for band in bands:
        k = results.first.filters.index(band)
        flux, error, model = (results.of(n)[:, k] for n in ("flux", "flux_err", "best_flux"))
        with np.errstate(invalid="ignore", divide="ignore"):
            good = (flux > 5 * error) & (model > 0)
            out[band] = np.where(good, -2.5 * np.log10(np.where(good, flux / model, 1.0)), np.nan)
    return out


def residual_figure(redshift, residuals):
    """
    Residuals of the fit in each band (`band_residuals`) against redshift.

    Redshifts at which a PAH feature is within the band are shaded, with the median there.
    """
    figure, axes = panels(residuals, height=2.9, sharex=True, sharey=True)
    for k, (band, ax) in enumerate(axes.items()):
        own, good = Filter.from_name(band), np.isfinite(redshift) & np.isfinite(residuals[band])
        z, residual = redshift[good], residuals[band][good]
        plot_offsets(z, residual, ax=ax, limit=0.6)
        ax.set_title(band_title(band), fontsize="medium")
        for rest, color in zip(FEATURES, (SECOND, "#15803d"), strict=True):
            low, high = feature_redshifts(rest, own.pivot, own.width)
            if high > low:
                ax.axvspan(low, high, color=color, alpha=0.12, lw=0, label=f"{rest.value:g} µm")
                inside = residual[(z >= low) & (z < high)]
                if inside.size > 2:
                    ax.plot([low, high], [np.median(inside)] * 2, color=color, lw=2)
        if k == 0:
            legend(ax, loc="upper right", ncols=2)
    label_outer(axes, "redshift", "measured - model (mag)")
    return figure


def rank_figure(ranks):
    """
    Histograms of the ranks of the truth in the posteriors, with what chance allows.

    ``ranks`` are arrays by set of bands and parameter, in which NaN is left out.
    """
    by_name = {}
    for (unit, name), values in ranks.items():
        if unit in ("all", "none"):
            by_name.setdefault(parameter_label(name), {})[SET_LABELS[unit]] = values
    figure, axes = panels(by_name, height=2.6, sharex=True)
    for label, ax in axes.items():
        most = 0
        for k, (name, values) in enumerate(by_name[label].items()):
            n, edges = np.histogram(values[np.isfinite(values)], _RANK_BINS, (0, 1))
            most = max(most, n.sum())
            style = {"color": STYLES[k][0], "lw": 1.6, "ls": ("-", "--")[k]}
            ax.stairs(n * _RANK_BINS / max(n.sum(), 1), edges, label=name, **style)
        if most:
            # binomial, of a uniform distribution
            error = np.sqrt((_RANK_BINS - 1) / most)
            ax.axhspan(1 - error, 1 + error, color="0.88", zorder=0)
        ax.axhline(1, color=TRUE, lw=0.8)
        ax.set(xlim=(0, 1), ylim=(0, max(2.0, 1.05 * ax.get_ylim()[1])))
        legend(ax, loc="upper center")
    label_outer(axes, "rank of the truth", "density")
    return figure
