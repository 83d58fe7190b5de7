"""Many skies of the truth 'field' without images: fluxes with the errors that the run measured, fitted alike."""

import numpy as np
from astropy.table import QTable

from miricigale import photometry, sed
from miricigale.evaluation.classes import CLASS_LIMITS, quality_columns, sky_quality
from miricigale.fitting.results.pulls import without_warnings
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.stages.conditions import has_flag
from miricigale.workflow.stages.fits import FIT_SECTIONS, fit_mock, mock_photometry, set_plan
from miricigale.workflow.stages.inputs import existing_bands, sed_resources
from miricigale.workflow.stages.sample import NOT_COUNTED, SampleFlags, detected_bands
from miricigale.workflow.stages.truth import library_fluxes, other_skies
from miricigale.workflow.truths import FIELD, unit_names

#: Of so many skies one has all galaxies, the others AGN only.
PER_WHOLE = 20
#: Sources to either side in flux, one of which lends its errors.
NEAR = 25
_FEW = int(SampleFlags.FEW_BANDS)


def sky_units(config):
    """Return sets of bands with which the skies are fitted, ``field/<set>``; none without a truth 'field'."""
    if FIELD not in config.sed.frac_agn or not config.fit.skies:
        return ()
    return unit_names((FIELD,), config.fit.sets)


@stage(
    "skies",
    "many skies",
    needs=("truth", "errors", "matches"),
    sections=FIT_SECTIONS + ("fit.skies", "fit.min_detected"),
    resources=sed_resources,
    plan=set_plan,
    units=sky_units,
)
def fit_skies(context, unit):
    """Draw the AGN that the galaxies of the field have in many skies, and fit them with a set of bands."""
    config = context.config
    n_skies = config.fit.skies
    truth, matched = context.tables(FIELD, ("truth", "matched")).values()
    field = ~has_flag(matched, "selection", SampleFlags.OUTSIDE_FIELD | NOT_COUNTED)
    truth = truth[field]
    matched = matched[field]
    model = sed.SEDModel.yang2021()
    existing = list(existing_bands(config))
    bands = list(config.exposures.filters)
    parameters = [name for name in truth.colnames if name in model.parameters]
    # of these skies all galaxies are drawn, of the others those with AGN
    n_complete = -(-n_skies // PER_WHOLE)
    skies, rows = other_skies(
        truth[["id"] + list(parameters)],
        model,
        bands[0],
        n_skies,
        min_frac_agn=CLASS_LIMITS[0],
        seed=context.seed,
        n_complete=n_complete,
    )
    light = library_fluxes(model, skies, existing + bands)
    light["id"] = skies["id"]
    for name in map(error_column, existing):
        if name in truth.colnames:
            light[name] = truth[name][rows]
    errors = photometry.ErrorModel.read(context.path("errors.ecsv"))
    mock = sky_photometry(matched, rows, light, bands, errors, seed=context.seed)
    selection = np.asarray(matched["selection"])[rows] & ~_FEW
    mock["selection"] = selection + _FEW * (mock["n_detected"] < config.fit.min_detected)
    sample = mock["selection"] == 0
    data = mock_photometry(config, light, mock, seed=context.seed)
    with without_warnings():
        results = fit_mock(context, data, context.plan["bands"], axes=context.plan["axes"])
    table = skies["sky", "redshift", "frac_agn"]
    table["id"] = truth["id"][rows]
    table["frac_agn_p50"] = np.nan
    table["frac_agn_p50"][sample] = results.median("frac_agn").value
    table["n_detected"] = mock["n_detected"]
    table["selection"] = mock["selection"]
    table["selection"].info.description = SampleFlags.describe()
    table.meta = {"n_skies": n_skies, "n_whole": n_complete}
    context.save_table(_product(unit), table)


def _product(unit):
    return unit.replace("/", "/skies_") + ".ecsv"


def sky_photometry(matched, rows, light, bands, errors, *, seed):
    """
    Simulate what would be measured of galaxies with other AGN.

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
    table = QTable({"id": light["id"]})
    middle = bands[len(bands) // 2]
    noise = {}
    pulls = {}
    for name in bands:
        # more than that of one pointing where fewer exposures are
        noise[name] = matched[error_column(name)] / errors.sigma(matched[name], name)
        true = matched[f"{name}_true"]
        pulls[name] = (matched[name] - true) / (noise[name] * errors.sigma(true, name))
    complete = np.all([np.isfinite(values) for values in pulls.values()], axis=0)
    if not complete.any():
        # all fluxes are NaN, and nothing is detected
        complete = ~complete
    order = np.flatnonzero(complete)
    order = order[np.argsort(matched[f"{middle}_true"][order], kind="stable")]
    place = np.searchsorted(matched[f"{middle}_true"][order].value, light[middle].value)
    # a donor up to NEAR places away in flux
    last = len(order) - 1
    half = min(NEAR, last // 2)
    steps = [stream(seed, "skies", str(key)).integers(-half, half + 1) for key in light["id"]]
    donor = order[np.clip(place, half, last - half) + np.array(steps, int)]
    for name in bands:
        factor = noise[name][rows]
        error = factor * pulls[name][donor] * errors.sigma(light[name], name)
        table[name] = light[name] + error
        table[error_column(name)] = factor * errors.sigma(table[name], name)
    table["n_detected"] = detected_bands(table, bands)
    return table


def sky_numbers(context):
    """
    Measure purity and completeness of AGN by fitted fracAGN in the skies, by set of bands and limit.

    Returns
    -------
    numbers : `~astropy.table.QTable`
        ``band_set``, ``limit``, ``n_skies``, ``n_wanted`` AGN, ``wanted`` and ``selected`` sources of a sky,
        ``completeness`` and ``purity`` with ``_low`` and ``_high``; no rows without skies.
    """
    names = ("band_set", "limit", "n_skies", "n_wanted", "wanted", "selected")
    columns = {name: [] for name in names}
    qualities = []
    for unit in sky_units(context.config):
        table = context.table(_product(unit))
        n_skies = table.meta["n_skies"]
        true = np.asarray(table["frac_agn"])
        fitted = np.asarray(table["frac_agn_p50"])
        weight = np.where(true >= CLASS_LIMITS[0], 1 / n_skies, 1 / table.meta["n_whole"])
        for limit in CLASS_LIMITS:
            wanted = true >= limit
            # NaN is below every limit
            selected = fitted >= limit
            qualities.append(sky_quality(table["id"], wanted, selected, weight))
            columns["band_set"].append(unit.split("/")[1])
            columns["limit"].append(limit)
            columns["n_skies"].append(n_skies)
            columns["n_wanted"].append(np.count_nonzero(wanted))
            columns["wanted"].append(np.sum(weight * wanted))
            columns["selected"].append(np.sum(weight * selected))
    numbers = QTable(columns)
    for name, values in quality_columns(qualities).items():
        numbers[name] = values
    return numbers
