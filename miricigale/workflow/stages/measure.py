"""Stages 11 to 13: forced photometry, error function, fits."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.evaluation import associate, match_truth
from miricigale.fitting import BayesFitter
from miricigale.photometry import (
    ErrorModel,
    ForcedPhotometer,
    SourceTemplates,
    Yang2021Photometer,
    join_bands,
)
from miricigale.photometry.error_model import fractional_error
from miricigale.psf import MatchingKernel, hst_psf
from miricigale.sed import SEDModel
from miricigale.utils.tables import error_column
from miricigale.workflow.stages.conditions import ConditionFlags, add_conditions, any_condition
from miricigale.workflow.stages.images import measured_mosaic, mosaic_psf
from miricigale.workflow.stages.sample import add_selection, in_field

__all__ = [
    "band_photometry",
    "fit_photometry",
    "make_errors",
    "make_templates",
    "measure_photometry",
    "mock_photometry",
    "yang2021_photometer",
]


def make_templates(context, _):
    """Stage 11, once for all bands: what the detected sources look like on the prior."""
    options = context.config.highres
    _, labels = context.image("segm.fits", "segmentation")
    templates = SourceTemplates.from_images(
        context.image("f160w.fits"),
        labels.astype(np.int32),
        QTable.read(context.path("detections.ecsv")),
        psf=hst_psf(options.filter, pixel_scale=options.pixel_scale * u.arcsec),
        n_threads=context.n_threads,
    )
    context.save_result("templates.fits", templates)


def measure_photometry(context, name):
    """Stage 11: forced photometry of one band, on its own grid or as the paper did."""
    if context.config.photometry.method == "yang2021":
        result = _as_yang2021(context, name)
    else:
        kernel = MatchingKernel.read(context.path(f"kernel_{name}.fits"))
        # a constant takes up what faint sources and wings left in the background
        result = ForcedPhotometer(kernel, fit_background=True, n_threads=context.n_threads).measure(
            context.image(f"mosaic_{name}.fits"),
            templates=SourceTemplates.read(context.path("templates.fits")),
        )
    table = result.to_table()
    context.save_table(f"photometry/{name}.ecsv", table)
    context.save_image(f"photometry/{name}_model.fits", result.model_image)
    context.save_image(f"photometry/{name}_residual.fits", result.residual_image)


def yang2021_photometer(config, name, n_threads):
    """The paper's photometer of one band; images that are our own have the scale of the truth."""
    options = config.highres
    _, scale = measured_mosaic(config)
    return Yang2021Photometer(
        hst_psf(options.filter, pixel_scale=options.pixel_scale * u.arcsec),
        mosaic_psf(config, name, scale),
        n_threads=n_threads,
    )


def _as_yang2021(context, name):
    """Forced photometry of one band by the steps of the paper."""
    suffix, _ = measured_mosaic(context.config)
    _, labels = context.image("segm.fits", "segmentation")
    return yang2021_photometer(context.config, name, context.n_threads).measure(
        context.image(f"mosaic_{name}{suffix}.fits"),
        context.image("f160w.fits"),
        labels.astype(np.int32),
        QTable.read(context.path("detections.ecsv")),
    )


def band_photometry(context, bands):
    """The photometry of all bands in one table, a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    return join_bands(
        {name: QTable.read(context.path(f"photometry/{name}.ecsv"))[columns] for name in bands}
    )


def make_errors(context, _):
    """Stage 12: match to the truth, error function of every band, sample of the fit."""
    config = context.config
    bands = config.exposures.filters
    photometry = band_photometry(context, bands)
    truth = QTable.read(context.path("truth.ecsv"))
    radius = config.photometry.match_radius * u.arcsec
    matched = match_truth(truth, photometry, bands, radius=radius)
    association = associate(truth, photometry, radius=radius)
    mosaics = [context.image(f"mosaic_{name}.fits") for name in bands]
    inside = in_field(truth["sky"], mosaics)
    # the error function is for galaxies of the field: what was matched there
    errors = ErrorModel.from_tables(
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
    nodes = SEDModel.yang2021_axes(config.fit.axes)["redshift"]
    add_selection(
        matched,
        truth,
        bands,
        inside=inside,
        min_detected=config.fit.min_detected,
        redshifts=(nodes[0], nodes[-1]),
    )
    add_conditions(matched, bands, suffix="_true")
    photometry["association"] = np.zeros(len(photometry), int)
    here = np.asarray(association["second"]) >= 0
    photometry["association"][association["second"][here]] = association["reasons"][here]
    photometry["in_field"] = in_field(photometry["sky"], mosaics)
    add_conditions(photometry, bands, detections=True)
    context.save_table("association.ecsv", association)
    context.save_table("photometry.ecsv", photometry)
    context.save_table("matched.ecsv", matched)
    context.save_result("errors.ecsv", errors)


def mock_photometry(config, truth, matched, *, seed):
    """
    Photometry of the fitted sample: mock existing bands, measured MIRI bands.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        Bands and depths.
    truth, matched : `~astropy.table.QTable`, n rows
        Of stages 3 and 12.
    seed : int
        Noise of a source in a band depends on its id and the band only.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        A row for each source of the sample (``selection`` 0).
    """
    bands = config.fit.bands
    errors = ErrorModel.from_depths(
        dict(zip(bands, config.fit.depths, strict=True)),
        fractional={name: fractional_error(name) for name in bands},
    )
    sample = np.asarray(matched["selection"]) == 0
    photometry = errors.perturb(truth[["id", *bands]][sample], seed=seed)
    for name in config.exposures.filters:
        for column in (name, error_column(name)):
            photometry[column] = matched[column][sample]
    return photometry


def fit_photometry(context, unit):
    """Stage 13: fit the detected sources with or without MIRI."""
    config = context.config
    truth = QTable.read(context.path("truth.ecsv"))
    matched = QTable.read(context.path("matched.ecsv"))
    photometry = mock_photometry(config, truth, matched, seed=context.seed)
    miri = config.exposures.filters if unit == "with_miri" else ()
    fitter = BayesFitter(
        SEDModel.yang2021(),
        [*config.fit.bands, *miri],
        axes=SEDModel.yang2021_axes(config.fit.axes),
        model_error=config.fit.model_error,
    )
    with ThreadPoolExecutor(context.n_threads) as executor:
        results = fitter.fit(photometry, executor=executor, progress_bar=context.progress_bar)
    context.save_result(f"fits_{unit}.fits", results)
    table = results.to_table()
    table["condition"] = any_condition(matched, config.exposures.filters)[
        np.asarray(matched["selection"]) == 0
    ]
    table["condition"].info.description = ConditionFlags.describe()
    context.save_table(f"fits_{unit}.ecsv", table)
