"""Many skies of the truth 'field' without images: fluxes with the errors that the run measured, fitted alike."""

import numpy as np
from astropy.table import QTable

from miricigale import photometry, sed
from miricigale.evaluation.classes import CLASS_LIMITS, quality_columns, sky_quality
from miricigale.fitting.results.pulls import without_warnings
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.stages.fits import FIT_SECTIONS, fit_mock, mock_photometry, set_plan
from miricigale.workflow.stages.inputs import existing_bands, sed_resources
from miricigale.workflow.stages.sample import NOT_COUNTED, SampleFlags, detected_bands
from miricigale.workflow.stages.truth import library_fluxes, other_skies
from miricigale.workflow.truths import FIELD

#: Of so many skies one has all galaxies, the others AGN only.
PER_WHOLE = 20
#: Sources to either side in flux, one of which lends its errors.
NEAR = 25
_FEW = int(SampleFlags.FEW_BANDS)


def sky_units(config):
    """Sets of bands with which the skies are fitted, ``field/<set>``; none without a truth 'field'."""
    chosen = FIELD in config.sed.frac_agn and config.fit.skies
    return tuple(f"{FIELD}/{name}" for name in config.fit.sets) if chosen else ()


@stage(
    "skies",
    "many skies",
    needs=("truth", "errors", "matches"),
    sections=(*FIT_SECTIONS, "fit.skies", "fit.min_detected"),
    resources=sed_resources,
    plan=set_plan,
    units=sky_units,
)
def fit_skies(context, unit):
    """Draw the AGN that the galaxies of the field have in many skies, and fit them with a set of bands."""
    config, n_skies = context.config, context.config.fit.skies
    truth, matched = context.tables(FIELD, ("truth", "matched")).values()
    field = (np.asarray(matched["selection"]) & (SampleFlags.OUTSIDE_FIELD | NOT_COUNTED)) == 0
    truth, matched = truth[field], matched[field]
    model, existing = sed.SEDModel.yang2021(), list(existing_bands(config))
    bands = list(config.exposures.filters)
    galaxies = truth[["id", *(name for name in truth.colnames if name in model.parameters)]]
    whole = -(-n_skies // PER_WHOLE)
    options = {"least": CLASS_LIMITS[0], "seed": context.seed, "whole": whole}
    skies, rows = other_skies(galaxies, model, bands[0], n_skies, **options)
    light = library_fluxes(model, skies, [*existing, *bands])
    light["id"] = skies["id"]
    for name in map(error_column, existing):
        if name in truth.colnames:
            light[name] = truth[name][rows]
    errors = photometry.ErrorModel.read(context.path("errors.ecsv"))
    mock = sky_photometry(matched, rows, light, bands, errors, seed=context.seed)
    found = np.asarray(matched["selection"])[rows] & ~_FEW
    mock["selection"] = found + _FEW * (mock["n_detected"] < config.fit.min_detected)
    sample, plan = mock["selection"] == 0, context.plan
    given = mock_photometry(config, light, mock, seed=context.seed)
    # errors have wings on purpose
    with without_warnings():
        results = fit_mock(context, given, plan["bands"], axes=plan["axes"])
    table = skies["sky", "redshift", "frac_agn"]
    table["id"] = truth["id"][rows]
    table["frac_agn_p50"] = np.nan
    table["frac_agn_p50"][sample] = results.median("frac_agn").value
    table["n_detected"], table["selection"] = mock["n_detected"], mock["selection"]
    table["selection"].info.description = SampleFlags.describe()
    table.meta = {"n_skies": n_skies, "n_whole": whole}
    context.save_table(_product(unit), table)


def _product(unit):
    return unit.replace("/", "/skies_") + ".ecsv"


def sky_photometry(matched, rows, light, bands, errors, *, seed):
    """
    What would be measured of galaxies with other AGN.

    Each flux is off by as many sigma of the error function as that of a measured source which is near in flux, one
    for all bands: errors have the wings that blends give them, together in all bands.

    Parameters
    ----------
    matched : `~astropy.table.QTable`
        Measured sources of a truth with errors.
    rows : `~numpy.ndarray` of int, shape (n,)
        Row of ``matched`` of the galaxy of each source.
    light : `~astropy.table.QTable`
        ``id`` and true fluxes of the n sources.
    bands : list of str
        MIRI bands; the nearest sources are those in the middle one.
    errors : `~miricigale.photometry.ErrorModel`
        The error functions.
    seed : int
        Seed; each source has its own stream by its id.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id``, fluxes and errors by band, and ``n_detected``, as of `miricigale.workflow.stages.sample`.
    """
    table, middle = QTable({"id": light["id"]}), bands[len(bands) // 2]
    noise, pulls = {}, {}
    for name in bands:
        # more than that of one pointing where fewer exposures are
        noise[name] = matched[error_column(name)] / errors.sigma(matched[name], name)
        true = matched[f"{name}_true"]
        pulls[name] = (matched[name] - true) / (noise[name] * errors.sigma(true, name))
    whole = np.all([np.isfinite(values) for values in pulls.values()], axis=0)
    # without any all fluxes are NaN, and nothing is detected
    order = np.flatnonzero(whole if whole.any() else ~whole)
    order = order[np.argsort(matched[f"{middle}_true"][order], kind="stable")]
    place = np.searchsorted(matched[f"{middle}_true"][order].value, light[middle].value)
    last = len(order) - 1
    half = min(NEAR, last // 2)
    drawn = [stream(seed, "skies", str(key)).integers(-half, half + 1) for key in light["id"]]
    donor = order[np.clip(place, half, last - half) + np.array(drawn, int)]
    for name in bands:
        own = noise[name][rows]
        table[name] = light[name] + own * pulls[name][donor] * errors.sigma(light[name], name)
        table[error_column(name)] = own * errors.sigma(table[name], name)
    table["n_detected"] = detected_bands(table, bands)
    return table


def sky_numbers(context):
    """
    Purity and completeness of AGN by fitted fracAGN in the skies, by set of bands and limit.

    Returns
    -------
    numbers : `~astropy.table.QTable`
        ``band_set``, ``limit``, ``n_skies``, ``n_wanted`` AGN, ``wanted`` and ``selected`` sources of a sky,
        ``completeness`` and ``purity`` with ``_low`` and ``_high``; no rows without skies.
    """
    rows, qualities = [], []
    for unit in sky_units(context.config):
        table = context.table(_product(unit))
        n, true = table.meta["n_skies"], np.asarray(table["frac_agn"])
        weight = np.where(true >= CLASS_LIMITS[0], 1 / n, 1 / table.meta["n_whole"])
        for limit in CLASS_LIMITS:
            # NaN is below every limit
            wanted, selected = true >= limit, np.asarray(table["frac_agn_p50"]) >= limit
            qualities.append(sky_quality(table["id"], wanted, selected, weight))
            sums = np.sum(weight * wanted), np.sum(weight * selected)
            rows.append((unit.split("/")[1], limit, n, np.count_nonzero(wanted), *sums))
    names = ["band_set", "limit", "n_skies", "n_wanted", "wanted", "selected"]
    numbers = QTable(rows=rows, names=names) if rows else QTable(names=names)
    for name, values in quality_columns(qualities).items():
        numbers[name] = values
    return numbers
