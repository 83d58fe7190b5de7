"""Stages 12 and 13: error function, matches, fits."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np

from miricigale import evaluation, fitting, photometry, sed
from miricigale.evaluation import posterior_ranks
from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.photometry.errors.error_model import add_noise, fractional_error
from miricigale.utils.named_values import without_none
from miricigale.utils.tables import error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.perturbation import Perturbation
from miricigale.workflow.stages.conditions import ConditionFlags, add_conditions, any_condition
from miricigale.workflow.stages.exposures import pointing_exposures, pointing_time
from miricigale.workflow.stages.grids import PATCHED, by_patch, of_patch, parts_of, study_patches
from miricigale.workflow.stages.inputs import (
    FitPieces,
    catalog_pieces,
    existing_bands,
    fit_plan,
    piece_rows,
    sed_resources,
    sources_memory,
)
from miricigale.workflow.stages.measure import joined_photometry
from miricigale.workflow.stages.sample import (
    CUTS,
    add_selection,
    cut_flags,
    in_field,
    is_sample,
    matched_errors,
    mean_coverage,
)
from miricigale.workflow.truths import band_sets, reference, study_truths, truth_names, unit_names


class _Field:
    """Truth, detections and the two matched, of which error functions and samples are made."""

    def __init__(self, context, name):
        config = context.config
        bands = config.exposures.filters
        radius = config.photometry.match_radius * u.arcsec
        self.truth = context.table(f"{name}/truth.ecsv")
        tables = context.tables(f"{name}/photometry", bands)
        self.detections = joined_photometry(tables)
        self.matched = evaluation.match_truth(self.truth, self.detections, bands, radius=radius)
        self.association = evaluation.associate(self.truth, self.detections, radius=radius)
        n = len(self.truth)
        sky = joined_sky([self.truth["sky"], self.detections["sky"]])
        # exposures at each source and detection, and whether it is in the field, by band
        coverage = np.zeros((len(bands), len(sky)))
        inside = np.zeros((len(bands), len(sky)), bool)
        patches = study_patches(config)
        for patch, rows in by_patch(config, sky):
            for k, band in enumerate(bands):
                if band in patches[patch].bands:
                    path = of_patch(f"{name}/mosaic_{band}", patch)
                    mosaic, n_images = context.image(f"{path}.fits", "n_images")
                    coverage[k, rows] = mean_coverage(sky[rows], mosaic, n_images)
                    inside[k, rows] = in_field(sky[rows], [mosaic])
        for k, band in enumerate(bands):
            time = pointing_exposures(config, band)[0].exposure_time
            self.matched[f"{band}_time"] = coverage[k, :n] * time
        inside = inside.all(axis=0)
        self.inside = inside[:n]
        self.detections["in_field"] = inside[n:]

    def noise(self, config):
        """
        Return the noise at each source by band, in units of that at the exposure time of one pointing.

        None where errors follow the flux alone. That of the sky and of a source's photons goes with the
        root of the time; what does not, as errors of templates, is small where noise counts.
        """
        if not config.errors.coverage:
            return None
        noise = {}
        for name in config.exposures.filters:
            time = self.matched[f"{name}_time"]
            with np.errstate(divide="ignore"):
                noise[name] = np.sqrt(pointing_time(config, name) / time).to_value(u.one)
        return noise


@stage(
    "errors",
    "error function",
    version=4,
    needs=("truth", "mosaics", "photometry", "joined"),
    within=reference,
    sections=PATCHED + ("errors", "photometry.match_radius"),
    plan=lambda config, _: reference(config),
    memory=sources_memory,
)
def make_errors(context, _):
    """Stage 12: error function of every band, of the matched sources of the reference truth."""
    config = context.config
    field = _Field(context, context.plan)
    errors = matched_errors(
        field.matched,
        field.inside,
        config.exposures.filters,
        noise=field.noise(config),
        statistic=config.errors.statistic,
        bin_size=config.errors.bin_size,
    )
    context.save_result("errors.ecsv", errors)


#: What the sample depends on.
_SAMPLE = ("fit.min_detected", "fit.axes", *(f"fit.{key}" for key in CUTS))


@stage(
    "matches",
    "match to the truth",
    version=2,
    needs=("catalog", "seds", "truth", "mosaics", "photometry", "joined", "errors"),
    sections=PATCHED + ("errors.coverage", "photometry.match_radius") + _SAMPLE,
    units=truth_names,
    reads=lambda config, unit: [unit, *filter(None, catalog_pieces(config))],
    plan=fit_plan,
    memory=sources_memory,
)
def match_sources(context, unit):
    """Stage 12: each truth matched, with the errors of the error function; sample of the fit."""
    config = context.config
    bands = config.exposures.filters
    field = _Field(context, unit)
    matched = field.matched
    detections = field.detections
    association = field.association
    errors = photometry.ErrorModel.read(context.path("errors.ecsv"))
    for name in bands:
        matched[f"{name}_formal_err"] = matched[error_column(name)]
        matched[f"{name}_extrapolated"] = errors.extrapolated(matched[name], name)
    matched = errors.assign(matched, filters=bands, noise=field.noise(config))
    chi2 = FitPieces(context, "input_seds", len(field.truth)).of("reduced_chi2")
    add_selection(
        matched,
        field.truth,
        bands,
        inside=field.inside,
        min_detected=config.fit.min_detected,
        redshifts=sed.SEDModel.yang2021_axes(config.fit.axes)["redshift"],
        cuts=cut_flags(config.fit, context.table("catalog.ecsv"), field.truth, chi2),
    )
    add_conditions(matched, bands, suffix="_true")
    detections["association"] = np.zeros(len(detections), int)
    associated = association[np.asarray(association["second"]) >= 0]
    detections["association"][associated["second"]] = associated["reasons"]
    add_conditions(detections, bands, detections=True)
    context.save_table(f"{unit}/association.ecsv", association)
    context.save_rows(f"{unit}/photometry", detections)
    context.save_rows(f"{unit}/matched", matched)


def existing_errors(depths):
    """Return errors (`~miricigale.photometry.ErrorModel`) of existing bands of some depths, by band."""
    fractional = {name: fractional_error(name) for name in depths}
    return photometry.ErrorModel.from_depths(depths, fractional=fractional)


def mock_photometry(config, truth, matched, *, seed, zero_point=0.0):
    """
    Return photometry of the fitted sample (``selection`` 0): mock existing bands, measured MIRI bands.

    Existing bands without a depth have the errors that the truth has of the catalog, no flux where it has none.
    ``truth`` and ``matched`` have the same sources row by row; the noise of a source in a band depends
    on ``seed``, its id and the band only. The light of existing bands is higher or lower by the share
    ``zero_point``, of which the fits do not know.
    """
    limits = existing_bands(config)
    bands = list(limits)
    sample = is_sample(matched)
    effect = "zero_point_existing"
    light = Perturbation({effect: zero_point}, seed).fluxes(
        effect, truth[["id"] + list(bands)], bands
    )
    table = light[sample]
    depths = without_none(limits)
    if depths:
        table = existing_errors(depths).perturb(table, seed=seed)
    for band in bands:
        if band not in depths:
            add_noise(table, band, truth[error_column(band)][sample], seed)
    for name in config.exposures.filters:
        for column in (name, error_column(name)):
            table[column] = matched[column][sample]
    return table


#: What fits of mock photometry read of the configuration.
_EXISTING = ("catalog", "fit.bands", "fit.depths", "exposures.filters")
FIT_SECTIONS = _EXISTING + ("fit.axes", "fit.model_error")


def set_plan(config, unit):
    """Return axes and MIRI bands of a fit, and the zero points of its existing bands where they are others."""
    truth, name = unit.split("/")[:2]
    plan = {"axes": fit_plan(config, unit), "bands": band_sets(config)[name]}
    size = dict(study_truths(config)[truth].perturbations).get("zero_point_existing")
    if size:
        plan["zero_point"] = size
    return plan


@stage(
    "fits",
    "fit",
    version=5,
    needs=("truth", "matches"),
    sections=FIT_SECTIONS,
    resources=sed_resources,
    plan=set_plan,
    units=lambda config: unit_names(truth_names(config), config.fit.sets, catalog_pieces(config)),
)
def fit_photometry(context, unit):
    """Stage 13: fit the detected sources of a truth with a set of the MIRI bands."""
    name, band_set, piece = parts_of(unit)
    _, matched, mock = fit_sample(
        context,
        name,
        rows=piece_rows(piece),
        zero_point=context.plan.get("zero_point", 0.0),
    )
    results = fit_mock(context, mock, context.plan["bands"], axes=context.plan["axes"])
    place = of_patch(f"{name}/fits_{band_set}", piece)
    context.save_result(f"{place}.fits", results)
    table = results.to_table()
    conditions = any_condition(matched, context.config.exposures.filters)
    table["condition"] = conditions[is_sample(matched)]
    table["condition"].info.description = ConditionFlags.describe()
    context.save_table(f"{place}.ecsv", table)


def fit_sample(context, name, rows=slice(None), **options):
    """Return truth, matched sources and `mock_photometry` of a truth, or of these rows of it."""
    truth = context.table(f"{name}/truth.ecsv")[rows]
    matched = context.table(f"{name}/matched.ecsv")[rows]
    mock = mock_photometry(context.config, truth, matched, seed=context.seed, **options)
    return truth, matched, mock


def study_fitter(fit, bands, **options):
    """Return a `BayesFitter` in bands, with the model error of a section ``[fit]``."""
    # galaxies of a study are models of the nodes
    settings = fitting.GridSettings(interpolate=0)
    options = {"model_error": fit.model_error, "settings": settings} | options
    return fitting.BayesFitter(sed.SEDModel.yang2021(), bands, **options)


def fit_mock(context, mock, bands, *, redshift=None, **options):
    """
    Fit mock photometry in the existing and in further bands as the study does.

    Parameters
    ----------
    context : `~miricigale.workflow.Context`
        Of a stage with `FIT_SECTIONS`.
    mock : `~astropy.table.QTable`
        As of `mock_photometry`.
    bands : iterable of str
        Bands that join the existing ones.
    redshift : array-like, optional
        Redshifts that are not fitted.
    **options
        Further arguments of `~miricigale.fitting.BayesFitter`, or others than the study's.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
    """
    bands = [*existing_bands(context.config), *bands]
    fitter = study_fitter(context.config.fit, bands, **options)
    with ThreadPoolExecutor(context.n_threads) as executor:
        show = context.progress_bar
        return fitter.fit(mock, redshift=redshift, executor=executor, progress_bar=show)


def true_ranks(results, sample, name, seed):
    """
    Return the ranks of the true values of a parameter in their posteriors.

    Ranks are randomized within cells of the grid, for injected fractions lie on its nodes.
    """
    values, levels = results.cdf(name)
    true = u.Quantity(sample[name]).to_value(values.unit)
    return posterior_ranks(true, values.value, levels, seed=seed)
