"""Variant images of the first sky: what residual noise, gradient and background do to the limits."""

import astropy.units as u
import numpy as np
from astropy.stats import biweight_scale

from miricigale import psf, scene
from miricigale.evaluation import Estimate, match_truth
from miricigale.photometry.errors.error_curves import limiting_flux, measured_curve
from miricigale.utils.arrays import finite_values, quiet_division
from miricigale.utils.random import stream
from miricigale.utils.tables import described_rows, error_column
from miricigale.workflow.derived import changed_config
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.labels import texts_of
from miricigale.workflow.stages.conditions import has_flag
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
#: Names of the study's images, and of the same by rates, with the variants.
STUDY = "study"
RATES = "rates"


@stage(
    "variants",
    "variant images",
    version=3,
    needs=("truth", "highres", "kernels", "templates"),
    within=reference,
    sections=IMAGES + ("patches", "highres", "photometry.method", "photometry.match_radius"),
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
    config = context.config
    plan = context.plan
    truth = context.table(f"{plan['truth']}/truth.ecsv")
    exposures = band_exposures(config, band)
    # the sources on the sky are the same in all of them
    blur = psf.miri_psf(band)
    lights = []
    for exposure in exposures:
        sky = scene.Scene(
            truth, wcs=exposure.wcs, filter=band, psf=blur, n_threads=context.n_threads
        )
        lights.append(sky.render())
    suffix, _ = measured_mosaic(config)
    radius = config.photometry.match_radius * u.arcsec
    for name, changes in plan["changes"].items():
        # all by rates, also where the study simulates ramps
        changes = changes | {"exposures": {"kind": "rates"}}
        changed = changed_config(config, IMAGES + ("highres",), changes)
        images = []
        for exposure, light in zip(exposures, lights, strict=True):
            image = light.copy()
            image.data += background_of(changed, exposure).image(exposure.wcs, exposure.shape)
            _, cal = expose_image(
                changed,
                imager_of(changed),
                image,
                exposure,
                seed=context.seed,
                n_threads=context.n_threads,
            )
            images.append(cal)
        mosaics = mosaics_of(changed, images)
        mosaic = next(mosaic for label, mosaic, _ in mosaics if label == suffix)
        result = measure_band(context, mosaic, band, config.photometry.method).to_table()
        matched = match_truth(truth, joined_photometry({band: result}), [band], radius=radius)
        columns = ["id", f"{band}_true", band, error_column(band), f"{band}_flags"]
        context.save_table(f"variants/{name}/{band}.ecsv", matched[columns])


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
    inside = ~has_flag(matched, "selection", SampleFlags.OUTSIDE_FIELD)
    field = inside & ~has_flag(matched, "selection", NOT_COUNTED)
    rows = []
    for band, limit in calculator.items():
        true = matched[f"{band}_true"].value
        fluxes = {STUDY: matched[band].value}
        for name, variant in tables.items():
            fluxes[name] = variant[band][band].value
        good = inside & np.all(np.isfinite([true] + list(fluxes.values())), axis=0)
        bright = field & (true > 10 ** (-0.4 * (limit - 23.9)))
        faint = good & ~bright
        rng = stream(seed, "variants", band)
        # the whole sample, then its draws
        samples = [np.flatnonzero(good)]
        samples += [rng.choice(samples[0], size=good.sum()) for _ in range(N_DRAWS)]
        # limit and scatter of each sample, by images
        measures = {}
        for name, flux in fluxes.items():
            curves = []
            measures[name] = np.empty((len(samples), 2))
            for k, sample in enumerate(samples):
                curve = measured_curve(band, true[sample], flux[sample], bin_size, statistic)
                curves.append(curve)
                off = (flux - true)[sample]
                measures[name][k] = _measures(curve, off[faint[sample]])
            with quiet_division():
                detected = flux > 5 * curves[0].sigma(flux)
            # the images of the study, by rates too
            reference_name = STUDY
            if RATES in tables and name not in (STUDY, RATES):
                reference_name = RATES
            with quiet_division():
                change = measures[name] - measures[reference_name]
                change[:, 1] /= measures[reference_name][:, 1]
            if name == reference_name:
                change[:] = np.nan
            row = {"band": band, "images": name, "n": len(samples[0]), "calculator": limit}
            for k, measure in enumerate(("limit", "scatter")):
                row[measure] = measures[name][0, k]
                row[f"{measure}_err"] = _half_width(measures[name][1:, k])
                row[f"{measure}_change"] = change[0, k]
                row[f"{measure}_change_err"] = _half_width(change[1:, k])
            complete = Estimate.of_fraction(np.count_nonzero(detected & bright), bright.sum())
            row["detected"] = int(np.count_nonzero(detected & field))
            row["completeness"] = complete.value
            row["completeness_err"] = complete.error
            rows.append(row)
    return described_rows(rows, texts_of("variants")["numbers"])


def _measures(curve, faint):
    """Return the 5-sigma limit of a curve of errors in AB magnitudes, and the scatter of faint sources."""
    limit = float((limiting_flux(curve, 5.0) * u.uJy).to_value(u.ABmag))
    return limit, biweight_scale(faint) if faint.size else np.nan


def _half_width(draws):
    """Return half of the central 68 % of draws; NaN where there are none that are finite."""
    draws = finite_values(draws)
    if draws.size == 0:
        return np.nan
    low, high = np.percentile(draws, [15.865, 84.135])
    return float((high - low) / 2)
