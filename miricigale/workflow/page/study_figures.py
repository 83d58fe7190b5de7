"""Figures of the fits of all truths and of what is known of their sources."""

import functools

import astropy.units as u
import numpy as np

from miricigale.evaluation import (
    CLASS_NAMES,
    COLOR_WINDOWS,
    KIRKPATRICK_LIMITS,
    PAH_FEATURES,
    REDSHIFT_BINS,
    XRAY_LIMITS,
    ColorCircles,
    classify,
    completeness,
    feature_redshifts,
    measure,
    sfr_to_infrared_luminosity,
    sigma_mad,
    xray_fluxes,
)
from miricigale.filters import Filter
from miricigale.plotting.axes import label_outer, panels
from miricigale.plotting.comparison import plot_redshifts
from miricigale.plotting.examples import fit_figure, sequence_figure
from miricigale.plotting.measurements import features_figure, offsets_figure
from miricigale.plotting.truths import (
    classes_figure,
    colors_figure,
    completeness_figure,
    fractions_figure,
    histograms_figure,
    luminosity_figure,
    ranks_figure,
    recovery_figure,
)
from miricigale.utils.units import FNU, ab_magnitude
from miricigale.workflow.page.labels import (
    SET_LABELS,
    band_label,
    by_wavelength,
    class_label,
    parameter_label,
    truth_label,
)
from miricigale.workflow.page.numbers import MIPS_LIMIT

#: fracAGN of the spectra that are drawn over each other.
SEQUENCE = (0.0, 0.2, 0.4, 0.6, 0.8, 0.99)
#: Classes that sources are found in, as columns of tables.
CLASS_COLUMNS = (*CLASS_NAMES, "unknown")
#: PAH features that are looked for in the residuals.
FEATURES = PAH_FEATURES[1:3]


def _both(one):
    """The fits with and without MIRI that a truth has: name and label."""
    return {name: SET_LABELS[name] for name in ("all", "none") if name in one.fits}


#: Histograms: values of a truth and a set of bands, edges of bins, label, and the true value of a truth.
_HISTOGRAMS = {
    "redshift": (
        lambda one, name: one.redshift_error(name),
        np.linspace(-0.3, 0.3, 31),
        r"(z$_{\rm fit}$ - z) / (1 + z)",
        lambda one: 0.0,
    ),
    "fraction": (
        lambda one, name: one.fitted(name, "frac_agn_mean"),
        np.linspace(0, 1, 26),
        "fracAGN (posterior mean)",
        lambda one: one.frac_agn,
    ),
    "width": (
        lambda one, name: one.fitted(name, "frac_agn_std"),
        np.linspace(0, 0.4, 26),
        "posterior width of fracAGN (std)",
        lambda one: None,
    ),
}


def histogram_figure(study, quantity):
    """Histograms of ``"redshift"`` errors, or the ``"fraction"`` of the AGN or its ``"width"``, by truth."""
    values, bins, xlabel, true = _HISTOGRAMS[quantity]
    truths = {truth_label(one): one for one in study.truths if one.sample.any()}
    return histograms_figure(
        {
            title: {label: values(one, name) for name, label in _both(one).items()}
            for title, one in truths.items()
        },
        bins,
        xlabel=xlabel,
        truth={title: true(one) for title, one in truths.items()},
    )


def redshift_figure(truth, fits):
    """Fitted against true redshifts, by set of bands."""
    figure, axes = panels([SET_LABELS[unit] for unit in fits], height=4.7)
    for (title, ax), table in zip(axes.items(), fits.values(), strict=True):
        error, z = table["redshift_std"], table["redshift_mean"]
        plot_redshifts(truth["redshift"], z, z_err=error, ax=ax, title=title)
    label_outer(axes)
    return figure


def fraction_bins_figure(study):
    """Median and scatter of fitted against injected fracAGN, by bin of redshift."""
    truths = [one for one in study.truths if one.frac_agn is not None and one.sample.any()]
    values = {}
    for low, high in REDSHIFT_BINS:
        own = {}
        for name, label in _both(truths[0]).items():
            rows = []
            for one in truths:
                z = one.true("redshift")
                found = one.fitted(name, "frac_agn_mean")[(z >= low) & (z < high)]
                found = found[np.isfinite(found)]
                # a scatter of fewer says nothing
                if found.size >= 5:
                    rows.append((one.frac_agn, np.median(found), sigma_mad(found)))
            if rows:
                own[label] = tuple(np.array(rows).T)
        if own:
            values[f"{low:g} < z < {high:g}" if np.isfinite(high) else f"z > {low:g}"] = own
    return fractions_figure(values)


def disk_figure(study):
    """Fitted against true accretion power of each truth with AGN; None if there is no such."""
    values, notes = {}, {}
    unit = u.erg / u.s
    for one in study.truths:
        if "all" not in one.fits or "accretion_power" not in one.truth.colnames:
            continue
        error = one.power_error("all")
        error = error[np.isfinite(error)]
        if error.size:
            fitted = one.fits["all"]["accretion_power_mean"]
            true = one.truth["accretion_power"][one.sample]
            label = truth_label(one)
            values[label] = (true.to_value(unit), fitted.to_value(unit))
            notes[label] = (
                f"median {np.median(error):+.2f} dex, scatter {sigma_mad(error):.2f} dex ({error.size})"
            )
    if not values:
        return None
    return recovery_figure(values, label="disk luminosity (erg/s)", notes=notes)


def xray_figure(study, seed):
    """X-ray fluxes of the injected AGN of the field and of those in the sample; None without any."""
    truths = study.with_agn or study.truths
    truths = [one for one in truths if "l_6um" in one.truth.colnames]
    fluxes = [xray_fluxes(one)[one.field] for one in truths]
    values = np.concatenate([[], *fluxes])
    found = np.concatenate([np.zeros(0, bool), *(one.sample[one.field] for one in truths)])
    good = np.isfinite(values)
    if not found[good].any():
        return None
    ends = np.percentile(values[good], [0.5, 99.5])
    edges = np.arange(np.floor(4 * ends[0]) / 4, np.ceil(4 * ends[1]) / 4 + 0.01, 0.25)
    half = None
    if study.with_agn:
        half = measure(study, "xray_half", truth=None, seed=seed)
        half = (half.value, half.low, half.high)
    return completeness_figure(
        completeness(values, found, edges),
        xlabel=r"log X-ray flux, 0.5-7 keV (erg s$^{-1}$ cm$^{-2}$)",
        limits=[
            (np.log10(one.flux.value), f"{one.survey}, {one.kind}", one.checked)
            for one in XRAY_LIMITS
        ],
        half=half,
    )


def detection_figure(study):
    """Infrared luminosities of the reference truth against redshift, and which are detected."""
    one = study.truths[0]
    table = one.truth
    least = min(2, len(study.bands))
    named = "two or more MIRI bands" if least == 2 else "the MIRI band"
    seen = one.field & (np.asarray(one.matched["n_detected"]) >= least)
    groups = {f"detected in {named}": seen}
    if "mips.24" in table.colnames:
        with np.errstate(invalid="ignore"):
            bright = ab_magnitude(table["mips.24"]) < MIPS_LIMIT
        groups["MIPS 24 µm above its limit"] = one.field & bright
    power = np.where(one.field, table["ir_luminosity"].to_value(u.Lsun), np.nan)
    rate = 1 / sfr_to_infrared_luminosity(1 * u.Msun / u.yr).to_value(u.Lsun)
    # of light of AGN it is no star-formation rate
    sfr = (rate, r"SFR (M$_\odot$/yr), Kennicutt 1998") if one.frac_agn == 0 else None
    return luminosity_figure(np.asarray(table["redshift"], float), power, groups, sfr=sfr)


def shape_figure(study):
    """Magnitude errors of sources above 5 sigma by band and shape, crowded ones marked."""
    one = study.truths[0]
    labels = {"point": "points", "n < 2": "n < 2", "n >= 2": "n ≥ 2"}
    groups, marked = {}, {}
    for band in study.bands:
        true, error = one.matched[f"{band}_true"], one.magnitude_error(band)
        bright = one.field & one.is_bright(band)
        for shape, rows in one.shapes.items():
            name, rows = f"{band_label(band)}, {labels[shape]}", bright & rows
            groups[name] = (ab_magnitude(true[rows]), error[rows])
            marked[name] = one.crowded[band][rows]
    return offsets_figure(groups, marked=marked)


def spectra_figure(study, key, model):
    """Spectra of one source with AGN of several fractions; ``model`` is one with AGN."""
    values = {}
    for one in (*study.with_agn[:1], study.truths[0]):
        row = one.truth[np.asarray(one.truth["id"]) == key][0]
        values |= {name: row[name] for name in row.colnames if name in model.parameters}
    redshift = float(values["redshift"])
    spectra = {}
    for fraction in SEQUENCE:
        sed = model.evaluate(**{**values, "frac_agn": fraction})
        wave = sed.wave.to_value(u.um)
        # the whole range of the bands, and of the features that are marked
        shown = (wave > 0.3) & (wave < 40)
        spectra[fraction] = sed.fnu.to_value(FNU)[shown]
    bands = {}
    for name in by_wavelength(study.bands):
        band = Filter.from_name(name)
        middle, half = band.pivot.to_value(u.um), 0.5 * band.width.to_value(u.um)
        bands[band_label(name)] = (middle - half, middle + half)
    options = {"bands": bands, "features": PAH_FEATURES.value, "redshift": redshift}
    return sequence_figure(wave[shown], spectra, **options)


def example_figure(results, row, key, model):
    """
    One source: photometry with the best model and residuals, and posteriors of redshift and fracAGN.

    ``results`` has a `~miricigale.fitting.FitResults` for each set of bands, "all" among them; "none" is
    drawn too if it is there. ``row`` of the truth has ``redshift`` and ``frac_agn``; ``model`` is that of
    the fits.
    """
    best = results["all"].loc[key]
    parts, posteriors, joint = {}, {}, {}
    for name in ("all", "none"):
        one = results[name].loc[key] if name in results else None
        if one is None or not np.isfinite(one.chi2):
            continue
        label = SET_LABELS[name]
        posteriors[label] = tuple(one.distribution(axis) for axis in ("redshift", "frac_agn"))
        joint[label] = one.joint_pdf("redshift", "frac_agn")
        if name == "none":
            other = one.best_sed(model)
            parts["best model without MIRI"] = (other.wave, other.fnu)
    redshift, fraction = (best.best[axis].value for axis in ("redshift", "frac_agn"))
    if fraction > 0:
        total, galaxy = best.best_sed(model), best.best_sed(model, frac_agn=0.0)
        parts["galaxy of the best model"] = (galaxy.wave, galaxy.fnu)
        parts["AGN of the best model"] = (total.wave, total.fnu - galaxy.fnu)
    draw_fit = functools.partial(
        best.plot_sed,
        model=model,
        parts=parts,
        groups=["MIRI" if n.startswith("miri.") else "existing bands" for n in best.filters],
        title=f"source {key}: injected z = {row['redshift']:.3f}, fracAGN = {row['frac_agn']:.2g}; "
        f"best model with MIRI: z = {redshift:.3f}, fracAGN = {fraction:g}, "
        f"chi2 = {best.chi2:.1f} in {best.n_bands} bands",
    )
    truth = (float(row["redshift"]), float(row["frac_agn"]))
    return fit_figure(draw_fit, posteriors, joint, truth=truth)


def class_figure(table):
    """Shares found of each class, of a table of `~miricigale.evaluation.study_confusion`."""
    found = [name for name in CLASS_COLUMNS if name in table.colnames]
    rows = [row for row in table if row["n"]]
    counts = np.array([[row[name] for name in found] for row in rows], float)
    names = [class_label(row["class"]) for row in rows]
    return classes_figure(counts, names, found=[class_label(name) for name in found])


def color_figure(study, shares):
    """
    Two colors of the fitted sources in each range of redshifts, with circles about the AGN.

    ``shares`` are true AGN shares of the 5-15 um light by name of the truth, of all sources; None if no
    range has an AGN.
    """
    planes, labels = {}, {}
    share = np.concatenate([shares[one.name] for one in study.truths])
    redshift = np.concatenate([np.asarray(one.truth["redshift"], float) for one in study.truths])
    sample = np.concatenate([one.sample for one in study.truths]) & np.isfinite(share)
    for window in COLOR_WINDOWS:
        colors = np.concatenate([window.colors(one.matched) for one in study.truths])
        rows = sample & (redshift >= window.z_low) & (redshift < window.z_high)
        rows &= np.isfinite(colors).all(axis=1)
        classes = classify(share[rows], limits=KIRKPATRICK_LIMITS)
        if CLASS_NAMES[2] not in classes:
            continue
        circles = ColorCircles.fit(colors[rows], classes)
        title = f"{window.z_low:g} < z < {window.z_high:g}"
        shown = [class_label(name) for name in classes.tolist()]
        planes[title] = (colors[rows], shown, circles.center, (circles.inner, circles.outer))
        labels[title] = tuple(
            f"log {band_label(a)} / {band_label(b)}" for a, b in (window.x, window.y)
        )
    return colors_figure(planes, labels=labels) if planes else None


def band_residuals(results, bands):
    """
    Measured minus best-model magnitudes of the MIRI bands, of sources above 5 sigma in them.

    ``results`` is a `~miricigale.fitting.FitResults`; dict of str to `~numpy.ndarray`, NaN where fainter.
    """
    out = {}
    for band in bands:
        k = results.filters.index(band)
        flux, error, model = (v[:, k] for v in (results.flux, results.flux_err, results.best_flux))
        with np.errstate(invalid="ignore", divide="ignore"):
            good = (flux > 5 * error) & (model > 0)
            out[band] = np.where(good, -2.5 * np.log10(np.where(good, flux / model, 1.0)), np.nan)
    return out


def residual_figure(redshift, residuals):
    """Residuals of the fit in each band (`band_residuals`) against redshift, with PAH features."""
    ranges = {}
    for band in residuals:
        own = Filter.from_name(band)
        ranges[band_label(band)] = {
            f"{rest.value:g} µm": feature_redshifts(rest, own.pivot, own.width) for rest in FEATURES
        }
    values = {band_label(band): (redshift, values) for band, values in residuals.items()}
    return features_figure(values, ranges)


def rank_figure(ranks):
    """Ranks of the truth in the posteriors: dict of (set, parameter) to arrays."""
    by_name = {}
    for (unit, name), values in ranks.items():
        if unit in ("all", "none"):
            by_name.setdefault(parameter_label(name), {})[SET_LABELS[unit]] = values
    return ranks_figure(by_name)
