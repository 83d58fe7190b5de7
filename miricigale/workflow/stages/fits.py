"""Stages 12 and 13: error function, fits."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale import evaluation, fitting, photometry, sed
from miricigale.utils.tables import error_column
from miricigale.workflow.stage import stage
from miricigale.workflow.stages.conditions import ConditionFlags, add_conditions, any_condition
from miricigale.workflow.stages.inputs import fit_plan, sed_resources
from miricigale.workflow.stages.sample import add_selection, in_field

__all__ = ["band_photometry", "fit_photometry", "make_errors", "mock_photometry"]


def band_photometry(context, bands):
    """The photometry of all bands in one table, a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    return photometry.join_bands(
        {name: QTable.read(context.path(f"photometry/{name}.ecsv"))[columns] for name in bands}
    )


@stage(
    "errors",
    "error function",
    version=2,
    needs=("truth", "mosaics", "photometry"),
    sections=(
        "errors",
        "exposures.filters",
        "photometry.match_radius",
        "fit.min_detected",
        "fit.axes",
    ),
    plan=fit_plan,
)
def make_errors(context, _):
    """Stage 12: match to the truth, error function of every band, sample of the fit."""
    config = context.config
    bands = config.exposures.filters
    detections = band_photometry(context, bands)
    truth = QTable.read(context.path("truth.ecsv"))
    radius = config.photometry.match_radius * u.arcsec
    matched = evaluation.match_truth(truth, detections, bands, radius=radius)
    association = evaluation.associate(truth, detections, radius=radius)
    mosaics = [context.image(f"mosaic_{name}.fits") for name in bands]
    inside = in_field(truth["sky"], mosaics)
    # the error function is measured with the matched sources of the field
    errors = photometry.ErrorModel.from_tables(
        QTable({"id": matched["id"], **{name: matched[f"{name}_true"] for name in bands}})[inside],
        matched[inside],
        filters=bands,
        statistic=config.errors.statistic,
        bin_size=config.errors.bin_size,
    )
    for name in bands:
        matched[f"{name}_formal_err"] = matched[error_column(name)]
        matched[f"{name}_extrapolated"] = errors.extrapolated(matched[name], name)
    matched = errors.assign(matched, filters=bands)
    nodes = sed.SEDModel.yang2021_axes(config.fit.axes)["redshift"]
    add_selection(
        matched,
        truth,
        bands,
        inside=inside,
        min_detected=config.fit.min_detected,
        redshifts=(nodes[0], nodes[-1]),
    )
    add_conditions(matched, bands, suffix="_true")
    detections["association"] = np.zeros(len(detections), int)
    here = np.asarray(association["second"]) >= 0
    detections["association"][association["second"][here]] = association["reasons"][here]
    detections["in_field"] = in_field(detections["sky"], mosaics)
    add_conditions(detections, bands, detections=True)
    context.save_table("association.ecsv", association)
    context.save_table("photometry.ecsv", detections)
    context.save_table("matched.ecsv", matched)
    context.save_result("errors.ecsv", errors)


def mock_photometry(config, truth, matched, *, seed):
    """
    Photometry of the fitted sample (``selection`` 0): mock existing bands, measured MIRI bands.

    ``truth`` and ``matched`` have the same sources row by row; the noise of a source in a band depends
    on ``seed``, its id and the band only.
    """
    from miricigale.photometry.surveys import fractional_error

    bands = config.fit.bands
    errors = photometry.ErrorModel.from_depths(
        dict(zip(bands, config.fit.depths, strict=True)),
        fractional={name: fractional_error(name) for name in bands},
    )
    sample = np.asarray(matched["selection"]) == 0
    table = errors.perturb(truth[["id", *bands]][sample], seed=seed)
    for name in config.exposures.filters:
        for column in (name, error_column(name)):
            table[column] = matched[column][sample]
    return table


@stage(
    "fits",
    "fit",
    version=4,
    needs=("truth", "errors"),
    sections=("fit", "exposures.filters"),
    resources=sed_resources,
    plan=fit_plan,
    units=lambda _: ("with_miri", "without_miri"),
    kernels=("fit",),
)
def fit_photometry(context, unit):
    """Stage 13: fit the detected sources with or without MIRI."""
    config = context.config
    truth = QTable.read(context.path("truth.ecsv"))
    matched = QTable.read(context.path("matched.ecsv"))
    mock = mock_photometry(config, truth, matched, seed=context.seed)
    miri = config.exposures.filters if unit == "with_miri" else ()
    fitter = fitting.BayesFitter(
        sed.SEDModel.yang2021(),
        [*config.fit.bands, *miri],
        axes=sed.SEDModel.yang2021_axes(config.fit.axes),
        model_error=config.fit.model_error,
    )
    with ThreadPoolExecutor(context.n_threads) as executor:
        results = fitter.fit(mock, executor=executor, progress_bar=context.progress_bar)
    context.save_result(f"fits_{unit}.fits", results)
    table = results.to_table()
    table["condition"] = any_condition(matched, config.exposures.filters)[
        np.asarray(matched["selection"]) == 0
    ]
    table["condition"].info.description = ConditionFlags.describe()
    context.save_table(f"fits_{unit}.ecsv", table)
