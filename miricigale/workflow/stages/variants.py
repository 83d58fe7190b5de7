"""Variant images of the first sky: what residual noise, gradient and background do to the limits."""

import astropy.units as u
import numpy as np
from astropy.stats import biweight_scale

from miricigale import psf, scene
from miricigale.evaluation import PUBLISHED, Estimate, match_truth
from miricigale.photometry.errors.error_curves import limiting_flux, measured_curve
from miricigale.utils.random import stream
from miricigale.utils.tables import described_rows, error_column
from miricigale.workflow.derived import changed_config
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.labels import band_label, texts_of
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
from miricigale.workflow.stages.measure import joined_photometry, measure_band
from miricigale.workflow.stages.sample import NOT_COUNTED, SampleFlags
from miricigale.workflow.truths import reference, variant_changes

#: Draws of the sources for the errors of limits.
N_DRAWS = 100
#: What images are called: where the key is on, and where it is off.
_LABELS = texts_of("variants")["labels"]
STUDY, RATES = "study", "rates"
_OUT = SampleFlags.OUTSIDE_FIELD | NOT_COUNTED


@stage(
    "variants",
    "variant images",
    version=3,
    needs=("truth", "highres", "kernels", "templates"),
    within=reference,
    sections=(*IMAGES, "patches", "highres", "photometry.method", "photometry.match_radius"),
    resources=EXPOSURE_RESOURCES,
    units=lambda config: band_names(config) if config.variants.images else (),
    plan=lambda config, unit: {
        "truth": reference(config),
        "exposures": exposure_plan(config, unit),
        "changes": variant_changes(config),
    },
)
def measure_variants(context, band):
    """Expose, reduce and measure a band of the reference truth with one setting changed at a time."""
    config, plan = context.config, context.plan
    truth = context.table(f"{plan['truth']}/truth.ecsv")
    exposures = band_exposures(config, band)
    # the sources on the sky are the same in all of them
    options = {"filter": band, "psf": psf.miri_psf(band), "n_threads": context.n_threads}
    lights = [scene.Scene(truth, wcs=e.wcs, **options).render() for e in exposures]
    suffix, _ = measured_mosaic(config)
    common = {"seed": context.seed, "n_threads": context.n_threads}
    for name, changes in plan["changes"].items():
        # all by rates, also where the study simulates ramps
        changes = {**changes, "exposures": {"kind": "rates"}}
        own = changed_config(config, (*IMAGES, "highres"), changes)
        images = []
        for exposure, light in zip(exposures, lights, strict=True):
            image = light.copy()
            image.data += background_of(own, exposure).image(exposure.wcs, exposure.shape)
            images.append(expose_image(own, imager_of(own), image, exposure, **common)[1])
        mosaic = next(one for label, one, _ in mosaics_of(own, images) if label == suffix)
        result = measure_band(context, mosaic, band, config.photometry.method).to_table()
        radius = config.photometry.match_radius * u.arcsec
        matched = match_truth(truth, joined_photometry({band: result}), [band], radius=radius)
        kept = ["id", f"{band}_true", band, error_column(band), f"{band}_flags"]
        context.save_table(f"variants/{name}/{band}.ecsv", matched[kept])


def variant_numbers(matched, tables, calculator, *, seed, statistic="mad", bin_size=30):
    """
    Return limits, errors and detections of the study's images and of the variants.

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
        fluxes = {STUDY: matched[band].value}
        fluxes |= {name: one[band][band].value for name, one in tables.items()}
        good = inside & np.all([np.isfinite(v) for v in (true, *fluxes.values())], axis=0)
        bright = field & (true > 10 ** (-0.4 * (limit - 23.9)))
        faint = good & ~bright
        rng = stream(seed, "variants", band)
        # the whole sample, then its draws
        samples = [np.flatnonzero(good)]
        samples += [rng.choice(samples[0], size=good.sum()) for _ in range(N_DRAWS)]
        found = {}
        for name, flux in fluxes.items():
            curves = [measured_curve(band, true[k], flux[k], bin_size, statistic) for k in samples]
            off = ((flux - true)[k][faint[k]] for k in samples)
            found[name] = np.array([_measures(*pair) for pair in zip(curves, off, strict=True)])
            # the images of the study, by rates too
            other = RATES if RATES in tables and name not in (STUDY, RATES) else STUDY
            with np.errstate(divide="ignore", invalid="ignore"):
                change = found[name] - found[other]
                change[:, 1] /= found[other][:, 1]
                seen = flux > 5 * curves[0].sigma(flux)
            if name == other:
                change[:] = np.nan
            row = {"band": band, "images": name, "n": len(samples[0]), "calculator": limit}
            for k, measure in enumerate(("limit", "scatter")):
                row[measure] = found[name][0, k]
                row[f"{measure}_err"] = _half_width(found[name][1:, k])
                row[f"{measure}_change"] = change[0, k]
                row[f"{measure}_change_err"] = _half_width(change[1:, k])
            complete = Estimate.of_fraction(np.count_nonzero(seen & bright), bright.sum())
            row["detected"] = int(np.count_nonzero(seen & field))
            row["completeness"] = complete.value
            row["completeness_err"] = complete.error
            rows.append(row)
    return described_rows(rows, texts_of("variants")["numbers"])


def _measures(curve, faint):
    """The 5-sigma limit of a curve of errors in AB magnitudes, and the scatter of faint sources."""
    limit = float((limiting_flux(curve, 5.0) * u.uJy).to_value(u.ABmag))
    return limit, biweight_scale(faint) if faint.size else np.nan


def _half_width(draws):
    """Half of the central 68 % of draws; NaN where there are none that are finite."""
    draws = draws[np.isfinite(draws)]
    return float(np.diff(np.percentile(draws, [15.865, 84.135]))[0] / 2) if draws.size else np.nan


def variant_label(name, changes):
    """Return the name of images on the page."""
    if name == STUDY:
        return "of the study"
    if name == RATES:
        return "the same, by rates"
    (values,) = changes[name].values()
    (value,) = values.values()
    return _LABELS[name][0 if value else 1]


def variant_entries(table, changes):
    """
    Rows of the table of the page.

    ``table`` is of `variant_numbers`, ``changes`` of `~miricigale.workflow.truths.variant_changes`.
    """
    rows = []
    for row in table:
        labels = {"band": band_label(row["band"]), "images": variant_label(row["images"], changes)}
        rows.append(dict(row) | labels | {"offset": row["limit"] - row["calculator"]})
    return rows


def measured_reasons(table, config):
    """Reasons by key of `~miricigale.evaluation.PUBLISHED`: of limits with what the variants change of them."""
    changes, reasons = variant_changes(config), {one.key: one.why for one in PUBLISHED}
    for row in () if table is None else table:
        key = f"limit.{row['band'].removeprefix('miri.')}"
        if key in reasons and row["images"] in _LABELS and np.isfinite(row["limit_change"]):
            cost = f"{variant_label(row['images'], changes)} {row['limit_change']:+.2f} mag"
            reasons[key] = "; ".join(part for part in (reasons[key], cost) if part)
    return reasons
