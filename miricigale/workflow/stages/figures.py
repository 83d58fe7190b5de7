"""Figures of the report, from tables and images."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.visualization import simple_norm
from scipy.spatial import ConvexHull

from miricigale.evaluation import (
    main_sequence_sfr,
    number_counts,
    running_median,
    sfr_to_infrared_luminosity,
)
from miricigale.plotting.axes import new_figure
from miricigale.plotting.comparison import (
    MEASURED,
    SECOND,
    plot_counts,
    plot_error_function,
    plot_histogram,
    plot_magnitudes,
    plot_offsets,
    plot_redshifts,
    plot_relation,
)
from miricigale.sed import COSMOLOGY, SEDModel
from miricigale.workflow.stages.sample import magnitude

__all__ = [
    "catalog_area",
    "colour_figure",
    "counts_figure",
    "error_figure",
    "example_figure",
    "fraction_figure",
    "input_figure",
    "magnitude_figure",
    "offset_figure",
    "point_figure",
    "redshift_figure",
    "triptych_figure",
]


def _noise(data):
    """Robust scatter of an image about its median."""
    values = data[np.isfinite(data)]
    return 1.4826 * np.median(np.abs(values - np.median(values)))


def _filled(image, floor=0.0):
    data = np.array(image.data, float)
    bad = ~np.isfinite(data)
    if image.mask is not None:
        bad |= np.asarray(image.mask, bool)
    data[bad] = floor
    return data


def colour_figure(blue, green, red, prior, names):
    """The three-colour MIRI image beside the high-resolution image of the same field."""
    figure, axes = new_figure(1, 2, size=(4.8, 6.8))
    channels = []
    for image in (red, green, blue):
        data = _filled(image)
        # one scale for all channels, in units of their own noise
        channels.append(np.arcsinh(np.clip(data / _noise(data[data != 0]) - 1, 0, None) / 4))
    rgb = np.stack(channels, axis=-1)
    rgb = np.clip(rgb / np.percentile(rgb, 99.7), 0, 1)
    used = np.argwhere(rgb.sum(axis=-1) > 0)
    (y0, x0), (y1, x1) = used.min(axis=0), used.max(axis=0) + 1
    data = _filled(prior)[y0:y1, x0:x1]
    axes[0, 0].imshow(
        data, origin="lower", cmap="gray", norm=simple_norm(data, "asinh", percent=99.6)
    )
    axes[0, 0].set_title(f"prior, {names[3]}")
    axes[0, 1].imshow(rgb[y0:y1, x0:x1], origin="lower")
    axes[0, 1].set_title(f"{names[0]} (blue), {names[1]} (green), {names[2]} (red)")
    for ax in axes.flat:
        ax.set(xticks=[], yticks=[])
    return figure


def triptych_figure(images, names, *, size=220):
    """
    Mosaic, model and residual of several bands, cut to the same crowded part.

    Parameters
    ----------
    images : list of tuple of `~astropy.nddata.CCDData`
        Mosaic, model, residual of each band.
    names : list of str
        Their filters.
    size : int, optional
        Side of the cutout in pixels.
    """
    figure, axes = new_figure(len(images), 3, size=(3.2, 3.2))
    model = _filled(images[0][1])
    # where the model has most light: the part that tests deblending
    rows, columns = np.arange(0, model.shape[0], 60), np.arange(0, model.shape[1], 60)
    light = np.sqrt(np.clip(model, 0, None))
    smooth = np.add.reduceat(np.add.reduceat(light, rows, axis=0), columns, axis=1)
    iy, ix = np.unravel_index(np.argmax(smooth), smooth.shape)
    y0 = int(np.clip(iy * 60 - size // 2 + 30, 0, max(0, model.shape[0] - size)))
    x0 = int(np.clip(ix * 60 - size // 2 + 30, 0, max(0, model.shape[1] - size)))
    part = (slice(y0, y0 + size), slice(x0, x0 + size))
    for row, (name, triple) in enumerate(zip(names, images, strict=True)):
        data = [_filled(image)[part] for image in triple]
        sigma = _noise(_filled(triple[2])[part])
        for ax, values, label in zip(axes[row], data, ("mosaic", "model", "residual"), strict=True):
            ax.imshow(values, origin="lower", cmap="gray", vmin=-3 * sigma, vmax=12 * sigma)
            ax.set(xticks=[], yticks=[])
            if row == 0:
                ax.set_title(label)
        axes[row, 0].set_ylabel(name)
    return figure


def _panels(n):
    columns = min(3, n)
    return -(-n // columns), columns


def magnitude_figure(table, bands):
    """Measured against true magnitude in every band."""
    figure, axes = new_figure(*_panels(len(bands)), size=(3.9, 3.7))
    for ax, name in zip(axes.flat, bands, strict=False):
        true, measured = magnitude(table[f"{name}_true"]), magnitude(table[name])
        plot_magnitudes(true, measured, ax=ax, title=name)
    for ax in list(axes.flat)[len(bands) :]:
        ax.set_visible(False)
    return figure


def offset_figure(table, bands):
    """Relative difference over its error, and magnitude differences with running medians."""
    figure, axes = new_figure(*_panels(len(bands)), size=(3.9, 3.3))
    for ax, name in zip(axes.flat, bands, strict=False):
        true, measured = magnitude(table[f"{name}_true"]), magnitude(table[name])
        offset = measured - true
        good = np.isfinite(offset)
        running = running_median(true[good], offset[good], size=20)
        plot_offsets(true[good], offset[good], running=running, ax=ax, title=name)
    for ax in list(axes.flat)[len(bands) :]:
        ax.set_visible(False)
    return figure


def error_figure(errors, bands, limits):
    """The error function of every band, with the 5-sigma limits."""
    figure, axes = new_figure(size=(6, 4.4))
    flux = np.geomspace(0.02, 300, 120) * u.uJy
    plot_error_function(
        dict.fromkeys(bands, flux.value),
        {name: errors.sigma(flux, name).to_value(u.uJy) for name in bands},
        limits=limits,
        ax=axes[0, 0],
    )
    return figure


def redshift_figure(truth, fits):
    """Fitted against true redshifts, with and without MIRI."""
    figure, axes = new_figure(1, len(fits), size=(4.8, 4.5))
    for ax, (label, table) in zip(axes.flat, fits.items(), strict=True):
        plot_redshifts(
            truth["redshift"],
            table["redshift_mean"],
            z_err=table["redshift_std"],
            ax=ax,
            title=label.replace("_", " "),
        )
    return figure


def fraction_figure(fits, frac_true):
    """Posterior means and widths of fracAGN, with and without MIRI."""
    figure, axes = new_figure(1, 2, size=(5, 3.8))
    means = {k.replace("_", " "): t["frac_agn_mean"] for k, t in fits.items()}
    widths = {k.replace("_", " "): t["frac_agn_std"] for k, t in fits.items()}
    plot_histogram(
        means,
        np.linspace(0, 1, 41),
        ax=axes[0, 0],
        xlabel="fracAGN (posterior mean)",
        truth=frac_true,
    )
    plot_histogram(
        widths, np.linspace(0, 0.5, 41), ax=axes[0, 1], xlabel="width of the posterior (std)"
    )
    return figure


def point_figure(points, bands):
    """Measured over true flux of the bright point sources of each band."""
    figure, axes = new_figure(size=(6.4, 3.8))
    ax = axes[0, 0]
    for k, name in enumerate(bands):
        table = points[name]
        ratio = (table["flux"] / table["flux_true"]).to_value(u.one)
        x = k + np.linspace(-0.3, 0.3, len(ratio))
        ax.plot(x, ratio, ".", ms=4, color="#9a3412", alpha=0.6)
        ax.plot([k - 0.35, k + 0.35], [np.nanmedian(ratio)] * 2, color="#1d4ed8", lw=2)
    ax.axhline(1, color="0.4", lw=1)
    ax.axhspan(0.97, 1.03, color="0.9", zorder=0)
    ax.set(
        xticks=range(len(bands)),
        xticklabels=bands,
        ylim=(0.85, 1.15),
        ylabel="measured / true flux",
    )
    return figure


def catalog_area(catalog):
    """Solid angle inside the convex hull of the catalogue's positions."""
    sky = catalog["sky"]
    center = SkyCoord(np.mean(sky.ra), np.mean(sky.dec))
    x, y = center.spherical_offsets_to(sky)
    hull = ConvexHull(np.transpose([x.to_value(u.arcmin), y.to_value(u.arcmin)]))
    return hull.volume * u.arcmin**2


def input_figure(galaxies):
    """Infrared luminosity against redshift, and star-formation rate against mass."""
    figure, axes = new_figure(1, 2, size=(5.4, 4.2))
    redshift = np.asarray(galaxies["redshift"])
    rates = [1, 10, 100] * u.Msun / u.yr
    lines = [
        ([0, 6], [value.value] * 2, f"{rate.value:g} Msun/yr")
        for rate, value in zip(rates, sfr_to_infrared_luminosity(rates), strict=True)
    ]
    plot_relation(
        redshift,
        galaxies["ir_luminosity"].to_value(u.Lsun),
        lines=lines,
        ax=axes[0, 0],
        labels=("redshift", r"L$_{IR}$(3-1000 um) / L$_\odot$"),
    )
    axes[0, 0].set_ylim(1e7, None)
    mass = np.geomspace(1e8, 2e11, 30) * u.Msun
    lines = [
        (mass.value, main_sequence_sfr(mass, COSMOLOGY.age(z)).value, f"main sequence, z = {z:g}")
        for z in (0.5, 1, 2)
    ]
    plot_relation(
        galaxies["stellar_mass"].to_value(u.Msun),
        galaxies["sfr_100myr"].to_value(u.Msun / u.yr),
        lines=lines,
        ax=axes[0, 1],
        labels=(r"stellar mass / M$_\odot$", r"SFR (100 Myr) / (M$_\odot$/yr)"),
        color=redshift,
        log=(True, True),
    )
    axes[0, 1].set(xlim=(1e7, None), ylim=(1e-3, None))
    return figure


def counts_figure(galaxies, bands, area):
    """Number counts of the injected fluxes in every band."""
    figure, axes = new_figure(*_panels(len(bands)), size=(3.6, 3.0), sharex=True, sharey=True)
    edges = np.arange(17, 28.1, 0.5)
    for ax, name in zip(axes.flat, bands, strict=False):
        counts, error = number_counts(galaxies[name], area, edges)
        plot_counts(edges, counts.to_value(u.deg**-2), error.to_value(u.deg**-2), ax=ax, title=name)
    for ax in list(axes.flat)[len(bands) :]:
        ax.set_visible(False)
    return figure


def example_figure(results, truth, key):
    """
    One source: photometry with the best fit, and posteriors of redshift and AGN fraction.

    Parameters
    ----------
    results : dict of str to `~miricigale.fitting.FitResults`
        ``with_miri`` and ``without_miri``.
    truth : `~astropy.table.QTable`
        With ``id``, ``redshift`` and ``frac_agn``.
    key : object
        Id of the source.
    """
    from matplotlib.figure import Figure

    row = truth[np.asarray(truth["id"]) == key][0]
    figure = Figure(figsize=(12, 4.8), layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(3, 1), width_ratios=(1.7, 1, 1))
    upper = figure.add_subplot(grid[0, 0])
    lower = figure.add_subplot(grid[1, 0], sharex=upper)
    results["with_miri"][key].plot_sed(ax=(upper, lower), model=SEDModel.yang2021())
    upper.tick_params(labelbottom=False)
    for column, (name, label) in enumerate(
        (("redshift", "redshift"), ("frac_agn", "AGN fraction")), start=1
    ):
        ax = figure.add_subplot(grid[:, column])
        for unit, color in (("with_miri", MEASURED), ("without_miri", SECOND)):
            edges, weights = results[unit][key].pdf(name)
            density = weights / np.diff(edges.value)
            ax.stairs(
                density / density.max(),
                edges.value,
                color=color,
                lw=1.6,
                label=unit.replace("_", " "),
            )
        ax.axvline(row[name], color="0.35", ls="--", lw=1, label="truth")
        ax.set(xlabel=label, ylabel="posterior density (peak 1)", ylim=(0, 1.08))
        if name == "redshift":
            ax.set_xlim(max(0, row[name] - 1.2), row[name] + 1.2)
        ax.legend(fontsize=8, frameon=False)
    return figure
