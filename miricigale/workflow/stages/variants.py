"""Variant images of the first sky: what residual noise, gradient and background do to the limits."""

import dataclasses
import types

import astropy.units as u
import numpy as np
from astropy.stats import biweight_scale
from astropy.table import QTable

from miricigale import photometry, psf, scene
from miricigale.evaluation import fraction_interval, match_truth
from miricigale.filters import Filter
from miricigale.pages import number
from miricigale.photometry.error_curves import limiting_flux, measured_curve
from miricigale.utils.random import stream
from miricigale.utils.tables import described_rows, error_column
from miricigale.workflow.page.band_figures import variant_figure
from miricigale.workflow.page.labels import band_label
from miricigale.workflow.stage import stage
from miricigale.workflow.stages.exposures import (
    EXPOSURE_RESOURCES,
    IMAGES,
    band_exposures,
    band_names,
    exposure_plan,
)
from miricigale.workflow.stages.images import (
    background_of,
    expose_image,
    imager_of,
    measured_mosaic,
    mosaics_of,
)
from miricigale.workflow.stages.measure import measure_band
from miricigale.workflow.stages.sample import SampleFlags
from miricigale.workflow.truths import reference, variant_changes

__all__ = [
    "HEADER",
    "add_reasons",
    "measure_variants",
    "variant_numbers",
    "variant_rows",
    "write_variants",
]

#: Draws of the sources for the errors of limits.
N_DRAWS = 100
#: What images are called: where the key is on, and where it is off.
_LABELS = {
    "residual": ("with the calculator's residual noise", "without residual noise"),
    "gradient": ("with a gradient", "without the gradient"),
    "plane": ("plane taken off before the mesh", "background by the mesh alone"),
}
STUDY, RATES = "study", "rates"
HEADER = (
    "band", "images", "5 sigma", "minus calculator", "change (mag)", "faint scatter (µJy)", "change",
    "detected", "complete",
)  # fmt: skip
_OUT = SampleFlags.OUTSIDE_FIELD | SampleFlags.STAR | SampleFlags.NO_MODEL


@stage(
    "variants",
    "variant images",
    version=3,
    needs={
        "truth": lambda config, _: (reference(config),),
        "highres": None,
        "kernels": lambda config, unit: (unit,),
        "templates": None,
    },
    sections=(*IMAGES, "highres", "photometry.method", "photometry.match_radius"),
    resources=EXPOSURE_RESOURCES,
    units=lambda config: band_names(config) if config.variants.images else (),
    plan=lambda config, unit: {
        "truth": reference(config),
        "exposures": exposure_plan(config, unit),
        "changes": variant_changes(config),
    },
    kernels=("images", "photometry"),
)
def measure_variants(context, band):
    """Expose, reduce and measure a band of the reference truth with one thing otherwise at a time."""
    config, plan = context.config, context.plan
    truth = QTable.read(context.path(f"{plan['truth']}/truth.ecsv"))
    exposures = band_exposures(config, band)
    # the sources on the sky are the same in all of them
    lights = [
        scene.Scene(
            truth, filter=band, wcs=e.wcs, psf=psf.miri_psf(band), n_threads=context.n_threads
        ).render()
        for e in exposures
    ]
    for name, changes in plan["changes"].items():
        own = changed_config(config, changes)
        imager, images = imager_of(own), []
        for exposure, light in zip(exposures, lights, strict=True):
            image = light.copy()
            image.data += background_of(own, exposure).image(exposure.wcs, exposure.shape)
            images.append(
                expose_image(
                    own, imager, image, exposure, seed=context.seed, n_threads=context.n_threads
                )[1]
            )
        suffix, _ = measured_mosaic(config)
        mosaic = next(one for label, one, _ in mosaics_of(own, images) if label == suffix)
        result = measure_band(context, mosaic, band, config.photometry.method).to_table()
        columns = ["id", "sky", "flux", error_column("flux"), "flags"]
        measured = photometry.join_bands({band: result[columns]})
        radius = config.photometry.match_radius * u.arcsec
        matched = match_truth(truth, measured, [band], radius=radius)
        kept = ["id", f"{band}_true", band, error_column(band), f"{band}_flags"]
        context.save_table(f"variants/{name}/{band}.ecsv", matched[kept])


def changed_config(config, changes):
    """The sections of a configuration that images are made of, with other values, for rates."""
    changes = {**changes, "exposures": {"kind": "rates"}}
    sections = {name: getattr(config, name) for name in (*IMAGES, "highres")}
    for name, values in changes.items():
        sections[name] = dataclasses.replace(sections[name], **values)
    return types.SimpleNamespace(**sections)


def read_variants(context, changes):
    """Tables of the stage by name and band."""
    return {
        name: {
            band: QTable.read(context.path(f"variants/{name}/{band}.ecsv"))
            for band in band_names(context.config)
        }
        for name in changes
    }


def _compared_with(name, tables):
    """The images whose change a variant is: those of the study, by rates too."""
    return RATES if RATES in tables and name not in (STUDY, RATES) else STUDY


def _measures(band, true, seen, faint, bin_size, statistic):
    """Curve of the errors; the limit in AB magnitudes, and the scatter of faint sources."""
    curve = measured_curve(band, true, seen, bin_size, statistic)
    limit = float((limiting_flux(curve, 5.0) * u.uJy).to_value(u.ABmag))
    return curve, np.array([limit, biweight_scale((seen - true)[faint]) if faint.any() else np.nan])


def variant_numbers(matched, tables, calculator, *, seed, statistic="mad", bin_size=30):
    """
    Limits, errors and detections of the study's images and of the variants.

    Parameters
    ----------
    matched : `~astropy.table.QTable`
        Of the study (stage 12), with ``selection``; row by row the sources of the variants.
    tables : dict of str to dict of str to `~astropy.table.QTable`
        Of the stage, by name and band.
    calculator : dict of str to float
        Limits of the exposure time calculator in AB magnitudes, by band.
    seed : int
        Seed of the draws.
    statistic, bin_size : optional
        As in `~miricigale.photometry.ErrorModel.from_tables`.

    Returns
    -------
    numbers : `~astropy.table.QTable`
        A row for each band and images (``"study"``, and the names): ``limit`` (5 sigma, AB) and its
        ``limit_change``; ``scatter`` (biweight, uJy) of the fluxes of sources fainter than the calculator's
        limit, and its relative ``scatter_change``; ``detected`` galaxies of the field (5 sigma), and
        ``completeness``, the share of those brighter than the calculator's limit that are. Errors
        (``_err``) are of draws of the sources, the same for all images: what these share does not count
        in changes.
    """
    selection = np.asarray(matched["selection"])
    inside, field = (selection & SampleFlags.OUTSIDE_FIELD) == 0, (selection & _OUT) == 0
    rows = []
    for band, limit in calculator.items():
        true = matched[f"{band}_true"].value
        fluxes = {STUDY: matched[band].value} | {
            name: one[band][band].value for name, one in tables.items()
        }
        good = inside & np.all([np.isfinite(v) for v in (true, *fluxes.values())], axis=0)
        bright = field & (true > 10 ** (-0.4 * (limit - 23.9)))
        faint = good & ~bright
        rng = stream(seed, "variants", band)
        draws = [rng.choice(np.flatnonzero(good), size=good.sum()) for _ in range(N_DRAWS)]
        values, drawn = {}, {}
        for name, flux in fluxes.items():
            # the whole sample, then its draws
            found = [
                _measures(band, true[k], flux[k], faint[k], bin_size, statistic)
                for k in (np.flatnonzero(good), *draws)
            ]
            (curve, values[name]), drawn[name] = found[0], np.array([one for _, one in found[1:]])
            with np.errstate(invalid="ignore"):
                seen = flux > 5 * curve.sigma(flux)
            other = _compared_with(name, tables)
            change, spread = values[name] - values[other], drawn[name] - drawn[other]
            with np.errstate(divide="ignore", invalid="ignore"):
                change[1] /= values[other][1]
                spread[:, 1] /= drawn[other][:, 1]
            if name == other:
                change, spread = np.full(2, np.nan), np.full((1, 2), np.nan)
            share, low, high = fraction_interval(
                int(np.count_nonzero(seen & bright)), int(bright.sum())
            )
            numbers = [
                (
                    values[name][k],
                    _half_width(drawn[name][:, k]),
                    change[k],
                    _half_width(spread[:, k]),
                )
                for k in range(2)
            ]
            count = int(np.count_nonzero(seen & field))
            sizes = len(draws[0]), count, share, (high - low) / 2
            rows.append((band, name, sizes[0], limit, *numbers[0], *numbers[1], *sizes[1:]))
    texts = {
        "band": "Band",
        "images": "Images: of the study, or with one thing otherwise",
        "n": "Measured sources",
        "calculator": "Limit of the exposure time calculator, scaled, AB",
        "limit": "5-sigma limit of the error function, AB",
        "limit_err": "Its error",
        "limit_change": "Against the study's images (by rates)",
        "limit_change_err": "Its error",
        "scatter": "Biweight scatter of the fluxes of sources fainter than the calculator's limit, uJy",
        "scatter_err": "Its error",
        "scatter_change": "Relative change against the study's images (by rates)",
        "scatter_change_err": "Its error",
        "detected": "Galaxies of the field above 5 sigma",
        "completeness": "Share of galaxies brighter than the calculator's limit that are detected",
        "completeness_err": "Half of its 68 % interval",
    }
    return described_rows(rows, texts)


def _half_width(draws):
    """Half of the central 68 % of draws; NaN where there are none that are finite."""
    draws = draws[np.isfinite(draws)]
    return float(np.diff(np.percentile(draws, [15.865, 84.135]))[0] / 2) if draws.size else np.nan


def variant_label(name, changes):
    """What images are called on the page."""
    if name == STUDY:
        return "of the study"
    if name == RATES:
        return "the same, by rates"
    (values,) = changes[name].values()
    (value,) = values.values()
    return _LABELS[name][0 if value else 1]


def variant_rows(table, changes):
    """
    Rows under `HEADER`.

    ``table`` is of `variant_numbers`, ``changes`` of `~miricigale.workflow.truths.variant_changes`.
    """
    none, same = "the error function reaches 5 sigma nowhere", "compared with itself"
    return [
        (
            band_label(row["band"]),
            variant_label(row["images"], changes),
            number(row["limit"], ".2f", none),
            number(row["limit"] - row["calculator"], "+.2f", none),
            _change(row, "limit_change", 1, ".2f", same if row["images"] == STUDY else none),
            f"{row['scatter']:.3g}",
            _change(row, "scatter_change", 100, ".1f", same, " %"),
            row["detected"],
            number(row["completeness"], "{:.0f} %", "no such galaxy", scale=100),
        )
        for row in table
    ]


def write_variants(context, report, matched, limits):
    """
    The section on variant images; ``matched`` is of the reference truth, ``limits`` the calculator's by band.

    Returns the numbers, or None where there are no variants.
    """
    config, changes = context.config, variant_changes(context.config)
    if not changes:
        return None
    tables = read_variants(context, changes)
    options = {"statistic": config.errors.statistic, "bin_size": config.errors.bin_size}
    table = variant_numbers(matched, tables, limits, seed=context.seed, **options)
    context.save_table("report/variants.ecsv", table)
    report.section(
        "What sets the limits",
        "The first sky was exposed again with one thing otherwise, by rates. Prior, PSFs, kernels and "
        "templates are those of the study, photons and cosmic rays have the same seeds, and errors of "
        "changes are of draws of the same sources.",
    )
    labels = {name: variant_label(name, changes) for name in (STUDY, *changes)}
    report.figure(
        variant_figure(table, labels),
        "5-sigma limits of the error function minus those of the exposure time calculator (4.0, low "
        "background), scaled to the same time; below 0: shallower.",
    )
    report.table(
        variant_rows(table, changes),
        header=HEADER,
        caption="5-sigma limits of error functions of the flux alone (AB), scatter of the fluxes of "
        "sources fainter than the calculator's limit, galaxies of the field above 5 sigma, and the share "
        "of those brighter than the calculator's limit that are; changes against the images of the study"
        + (" by rates" if RATES in changes else ""),
        text=2,
    )
    told = _gradient_told(table, changes)
    if told:
        report.text(told)
    return table


def _change(row, name, scale, form, why, unit=""):
    if not np.isfinite(row[name]):
        return number(np.nan, form, why)
    return f"{scale * row[name]:+{form}} ± {scale * row[f'{name}_err']:{form}}{unit}"


def _gradient_told(table, changes):
    """What the gradient does in the longest band, in words; empty if that was not tried."""
    if "gradient" not in changes:
        return ""
    band = max(set(table["band"]), key=lambda name: Filter.from_name(name).pivot)
    told = []
    for name in ("gradient", "plane"):
        row = _row(table, band, name) if name in changes else None
        if row is not None and np.isfinite(row["limit_change"]):
            limit = _change(row, "limit_change", 1, ".2f", "no limit", " mag")
            scatter = _change(row, "scatter_change", 100, ".1f", "no faint source", " %")
            label = variant_label(name, changes)
            told.append(
                f"{label} the limit changes by {limit}, the scatter of faint fluxes by {scatter}"
            )
    if not told:
        return ""
    return (
        f"In {band_label(band)}: {'; '.join(told)}. Yang et al. 2021 hold the gradient of 5 % per arcmin "
        "responsible for a limit in F2100W that is 0.95 mag shallower than the calculator's."
    )


def _row(table, band, name):
    return table[(table["band"] == band) & (table["images"] == name)][0]


def add_reasons(reasons, table, config):
    """Add to the reasons of `~miricigale.workflow.page.paper.reasons_of` what the variants cost."""
    changes = variant_changes(config)
    for row in () if table is None else table:
        key = f"limit.{row['band'].removeprefix('miri.')}"
        if key in reasons and row["images"] in _LABELS and np.isfinite(row["limit_change"]):
            told = f"{variant_label(row['images'], changes)} {row['limit_change']:+.2f} mag"
            reasons[key] = "; ".join(part for part in (reasons[key], told) if part)
