"""Figures of single sources: a fit with its posteriors with and without MIRI, spectra by AGN fraction."""

import astropy.units as u
import numpy as np

from miricigale.evaluation import PAH_FEATURES
from miricigale.filters import Filter
from miricigale.plotting.axes import MEASURED, SECOND, TRUE, WIDTH, legend, new_figure, plain_text
from miricigale.plotting.curves import plot_filters, plot_spectrum
from miricigale.plotting.posteriors import plot_pdf_2d
from miricigale.utils.arrays import middles, quotient
from miricigale.utils.units import FNU
from miricigale.workflow.labels import SET_LABELS, band_label, by_wavelength

#: fracAGN of the spectra that are drawn over each other.
SEQUENCE = (0.0, 0.2, 0.4, 0.6, 0.8, 0.99)
#: Sets of bands whose posteriors are drawn: color, line style and colors of the plane.
_SETS = {"all": (MEASURED, "-", "Oranges"), "none": (SECOND, "--", "Blues")}
_AXES = {"redshift": "redshift", "frac_agn": "fracAGN"}


def spectra_figure(study, key, model):
    """
    Draw spectra of a source with AGN of several fractions and PAH features, above the curves of the filters.

    ``model`` is one with AGN.
    """
    from matplotlib import colormaps

    values = {}
    for truth in (*study.with_agn[:1], study.truths[0]):
        row = truth.truth[np.asarray(truth.truth["id"]) == key][0]
        values |= {name: row[name] for name in row.colnames if name in model.parameters}
    figure, axes = new_figure(2, 1, size=(8.5, 2.6), sharex=True, height_ratios=(2.6, 1))
    ax, lower = axes[:, 0]
    light = []
    for fraction, shade in zip(SEQUENCE, np.linspace(0.0, 0.85, len(SEQUENCE)), strict=True):
        sed = model.evaluate(**(values | {"frac_agn": fraction}))
        wave = sed.wave.to_value(u.um)
        # the whole range of the bands, and of the features that are marked
        shown = (wave > 0.3) & (wave < 40)
        wave = wave[shown]
        flux = sed.fnu.to_value(FNU)[shown]
        color = colormaps["plasma"](shade)
        label = f"fracAGN {fraction:g}"
        plot_spectrum(wave, flux, ax=ax, label=label, color=color, lw=1.6)
        light.append(flux[flux > 0])
    top = np.concatenate(light).max()
    bottom = max(np.concatenate(light).min(), 1e-5 * top)
    span = np.log10(top / bottom)
    ax.set_xlim(wave.min(), wave.max())
    ax.set_ylim(bottom * 10 ** (-0.12 * span), top * 10 ** (0.1 * span))
    curves = []
    for name in by_wavelength(study.bands):
        band = Filter.from_name(name)
        curves.append((band.wave.value, band.throughput, band_label(name)))
    plot_filters(curves, ax=lower, lw=1.4)
    legend(lower, loc="upper left", ncols=2, fontsize=7)
    redshift = float(values["redshift"])
    for wavelength in PAH_FEATURES.value:
        place = wavelength * (1 + redshift)
        if wave.min() < place < wave.max():
            for axis in (ax, lower):
                axis.axvline(place, color=TRUE, lw=0.7, ls=":")
            ax.text(
                place,
                0.98,
                f"{wavelength:g}",
                rotation=90,
                fontsize=7,
                color=TRUE,
                transform=ax.get_xaxis_transform(),
                ha="right",
                va="top",
            )
    ax.set_title(f"z = {redshift:g}", fontsize="medium")
    ax.set_xlabel("")
    lower.set_xlabel("observed wavelength (µm)")
    legend(ax, loc="upper left")
    return figure


def example_figure(results, row, key, model):
    """
    Draw a source: photometry with the best model and residuals, and posteriors of redshift and fracAGN.

    ``results`` has a `~miricigale.fitting.FitResults` for each set of bands, "all" among them; "none" is
    drawn too if it is there. ``row`` of the truth has ``redshift`` and ``frac_agn``; ``model`` is that of
    the fits.
    """
    from matplotlib.figure import Figure

    fits = {}
    for name in _SETS:
        if name in results:
            result = results[name].loc[key]
            if np.isfinite(result.chi2):
                fits[name] = result
    figure = Figure(figsize=(WIDTH, 7.2), layout="constrained")
    grid = figure.add_gridspec(3, 4, height_ratios=(2.6, 0.9, 2.6))
    upper = figure.add_subplot(grid[0, :])
    lower = figure.add_subplot(grid[1, :], sharex=upper)
    _draw_fit((upper, lower), results["all"].loc[key], fits.get("none"), row, model)
    upper.set_xlabel("")
    upper.tick_params(labelbottom=False)
    low, high = upper.get_ylim()
    upper.set_ylim(low, high * (high / low) ** 0.3)
    legend(upper, loc="upper left", ncols=3)
    for k, (axis, label) in enumerate(_AXES.items()):
        ax = figure.add_subplot(grid[2, k])
        _draw_posteriors(ax, {name: result.distribution(axis) for name, result in fits.items()})
        ax.axvline(row[axis], ymax=0.6, color="0.2", ls=":", lw=1.4, label="truth")
        ax.set_xlabel(label)
        if k == 0:
            ax.set_ylabel("posterior density (peak 1)")
            legend(ax, loc="upper left")
    planes = []
    for k, (name, result) in enumerate(fits.items()):
        ax = figure.add_subplot(grid[2, 2 + k])
        plot_pdf_2d(
            *[u.Quantity(result.distribution(axis)[0]).value for axis in _AXES],
            result.joint_pdf(*_AXES),
            ax=ax,
            labels=tuple(_AXES.values()),
            truth=tuple(float(row[axis]) for axis in _AXES),
            cmap=_SETS[name][2],
        )
        ax.set_title(SET_LABELS[name], fontsize="medium")
        planes.append(ax)
    # both planes alike, so that the areas can be compared
    xlim = [ax.get_xlim() for ax in planes]
    ylim = [ax.get_ylim() for ax in planes]
    for ax in planes:
        ax.set(xlim=(np.min(xlim), np.max(xlim)), ylim=(np.min(ylim), np.max(ylim)))
    for ax in planes[1:]:
        ax.set_ylabel("")
    return figure


def _draw_fit(ax, best, without, row, model):
    """Draw photometry and residuals on a pair of axes, with the best models, their parts, and the truth."""
    parts = {}
    if without is not None:
        spectrum = without.best_sed(model)
        parts["best model without MIRI"] = (spectrum.wave, spectrum.fnu)
    redshift = best.best["redshift"].value
    fraction = best.best["frac_agn"].value
    if fraction > 0:
        total = best.best_sed(model)
        galaxy = best.best_sed(model, frac_agn=0.0)
        parts["galaxy of the best model"] = (galaxy.wave, galaxy.fnu)
        parts["AGN of the best model"] = (total.wave, total.fnu - galaxy.fnu)
    groups = ["MIRI" if name.startswith("miri.") else "existing bands" for name in best.filters]
    title = (
        f"source {plain_text(row['id'])}: injected z = {row['redshift']:.3f}, "
        f"fracAGN = {row['frac_agn']:.2g}; "
        f"best model with MIRI: z = {redshift:.3f}, fracAGN = {fraction:g}, "
        f"chi2 = {best.chi2:.1f} in {best.n_bands} bands"
    )
    best.plot_sed(ax=ax, model=model, parts=parts, groups=groups, title=title)


def _draw_posteriors(ax, distributions):
    """Draw posteriors of a parameter over each other, as curves with a peak of 1, over 99.8 % of each."""
    ends = []
    for name, (edges, weights) in distributions.items():
        edges = u.Quantity(edges).value
        weights = np.asarray(weights, float)
        color, line, _ = _SETS[name]
        width = np.diff(edges)
        density = quotient(weights, width)
        # straight lines between the middles of the cells, level to the ends
        density = np.pad(density / max(density.max(), 1e-300), 1, mode="edge")
        place = np.r_[edges[0], middles(edges), edges[-1]]
        if not ends:
            ax.fill_between(place, density, alpha=0.2, color=color, lw=0)
        ax.plot(place, density, color=color, lw=1.6, ls=line, label=SET_LABELS[name])
        total = np.cumsum(weights) / weights.sum()
        inside = np.flatnonzero((total > 1e-3) & (np.r_[0, total[:-1]] < 1 - 1e-3))
        ends += [edges[inside[0]], edges[inside[-1] + 1]]
    margin = 0.06 * (max(ends) - min(ends))
    ax.set(xlim=(min(ends) - margin, max(ends) + margin), ylim=(0, 1.75))
