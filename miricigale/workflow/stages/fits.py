"""Stages 12 and 13: error function, matches, fits."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale import evaluation, fitting, photometry, sed
from miricigale.utils.tables import error_column
from miricigale.workflow.perturbation import Perturbation
from miricigale.workflow.stage import stage
from miricigale.workflow.stages.conditions import ConditionFlags, add_conditions, any_condition
from miricigale.workflow.stages.exposures import (
    GRID,
    bands_of_truth,
    pointing_exposures,
    pointing_time,
)
from miricigale.workflow.stages.inputs import fit_plan, sed_resources
from miricigale.workflow.stages.sample import (
    add_selection,
    in_field,
    matched_errors,
    mean_coverage,
)
from miricigale.workflow.truths import (
    band_sets,
    of_truth,
    reference,
    study_truths,
    truth_names,
)

__all__ = [
    "FIT_SECTIONS",
    "band_photometry",
    "fit_photometry",
    "fit_units",
    "make_errors",
    "match_sources",
    "mock_photometry",
]


def band_photometry(context, truth, bands):
    """The photometry of all bands of a truth in one table, a row for each detection."""
    columns = ["id", "sky", "flux", error_column("flux"), "flags"]
    tables = {n: QTable.read(context.path(f"{truth}/photometry/{n}.ecsv")) for n in bands}
    return photometry.join_bands({name: table[columns] for name, table in tables.items()})


class _Field:
    """Truth, detections and the two matched: what error functions and samples are made of."""

    def __init__(self, context, name):
        config = context.config
        bands = config.exposures.filters
        radius = config.photometry.match_radius * u.arcsec
        self.truth = QTable.read(context.path(f"{name}/truth.ecsv"))
        self.detections = band_photometry(context, name, bands)
        self.matched = evaluation.match_truth(self.truth, self.detections, bands, radius=radius)
        self.association = evaluation.associate(self.truth, self.detections, radius=radius)
        mosaics = {}
        for band in bands:
            path = f"{name}/mosaic_{band}.fits"
            mosaics[band], n_images = context.image(path, "n_images")
            exposure = pointing_exposures(config, band)[0]
            seen = mean_coverage(self.truth["sky"], mosaics[band], n_images)
            self.matched[f"{band}_time"] = seen * exposure.exposure_time
        self.inside = in_field(self.truth["sky"], mosaics.values())
        self.detections["in_field"] = in_field(self.detections["sky"], mosaics.values())

    def noise(self, config):
        """
        Noise at each source by band, in units of that at the exposure time of one pointing.

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


_MATCHED = {"truth": of_truth, "mosaics": bands_of_truth, "photometry": bands_of_truth}


@stage(
    "errors",
    "error function",
    version=4,
    needs={
        name: lambda config, _, select=select: select(config, reference(config))
        for name, select in _MATCHED.items()
    },
    sections=(*GRID, "errors", "photometry.match_radius"),
    plan=lambda config, _: reference(config),
)
def make_errors(context, _):
    """Stage 12: error function of every band, of the matched sources of the reference truth."""
    config, bands = context.config, context.config.exposures.filters
    field = _Field(context, context.plan)
    errors = matched_errors(
        field.matched,
        field.inside,
        bands,
        statistic=config.errors.statistic,
        bin_size=config.errors.bin_size,
        noise=field.noise(config),
    )
    context.save_result("errors.ecsv", errors)


@stage(
    "matches",
    "match to the truth",
    version=2,
    needs={**_MATCHED, "errors": None},
    sections=(
        *GRID,
        "errors.coverage",
        "photometry.match_radius",
        "fit.min_detected",
        "fit.axes",
    ),
    units=truth_names,
    plan=fit_plan,
)
def match_sources(context, unit):
    """Stage 12: each truth matched, with the errors of the error function; sample of the fit."""
    config, bands = context.config, context.config.exposures.filters
    field = _Field(context, unit)
    matched, detections = field.matched, field.detections
    errors = photometry.ErrorModel.read(context.path("errors.ecsv"))
    for name in bands:
        matched[f"{name}_formal_err"] = matched[error_column(name)]
        matched[f"{name}_extrapolated"] = errors.extrapolated(matched[name], name)
    matched = errors.assign(matched, filters=bands, noise=field.noise(config))
    nodes = sed.SEDModel.yang2021_axes(config.fit.axes)["redshift"]
    add_selection(
        matched,
        field.truth,
        bands,
        inside=field.inside,
        min_detected=config.fit.min_detected,
        redshifts=(nodes[0], nodes[-1]),
    )
    add_conditions(matched, bands, suffix="_true")
    association = field.association
    detections["association"] = np.zeros(len(detections), int)
    here = np.asarray(association["second"]) >= 0
    detections["association"][association["second"][here]] = association["reasons"][here]
    add_conditions(detections, bands, detections=True)
    context.save_table(f"{unit}/association.ecsv", association)
    context.save_table(f"{unit}/photometry.ecsv", detections)
    context.save_table(f"{unit}/matched.ecsv", matched)


def mock_photometry(config, truth, matched, *, seed, zero_point=0.0):
    """
    Photometry of the fitted sample (``selection`` 0): mock existing bands, measured MIRI bands.

    ``truth`` and ``matched`` have the same sources row by row; the noise of a source in a band depends
    on ``seed``, its id and the band only. The light of existing bands is higher or lower by the share
    ``zero_point``, of which the fits do not know.
    """
    from miricigale.photometry.surveys import fractional_error

    bands = config.fit.bands
    errors = photometry.ErrorModel.from_depths(
        dict(zip(bands, config.fit.depths, strict=True)),
        fractional={name: fractional_error(name) for name in bands},
    )
    sample = np.asarray(matched["selection"]) == 0
    name = "zero_point_existing"
    light = Perturbation({name: zero_point}, seed).fluxes(name, truth[["id", *bands]], bands)
    table = errors.perturb(light[sample], seed=seed)
    for name in config.exposures.filters:
        for column in (name, error_column(name)):
            table[column] = matched[column][sample]
    return table


def fit_units(config):
    """Names of the fits, ``<truth>/<set>``."""
    return tuple(f"{truth}/{name}" for truth in truth_names(config) for name in config.fit.sets)


#: What fits of mock photometry read of the configuration.
FIT_SECTIONS = ("fit.bands", "fit.depths", "fit.axes", "fit.model_error", "exposures.filters")


def _fit_plan(config, unit):
    """Axes and MIRI bands of a fit, and the zero points of its existing bands where they are others."""
    truth, _, chosen = unit.partition("/")
    plan = {"axes": fit_plan(config, unit), "bands": band_sets(config)[chosen]}
    size = dict(study_truths(config)[truth].perturbations).get("zero_point_existing")
    return plan | ({"zero_point": size} if size else {})


@stage(
    "fits",
    "fit",
    version=5,
    needs={"truth": of_truth, "matches": of_truth},
    sections=FIT_SECTIONS,
    resources=sed_resources,
    plan=_fit_plan,
    units=fit_units,
    kernels=("fit",),
)
def fit_photometry(context, unit):
    """Stage 13: fit the detected sources of a truth with a set of the MIRI bands."""
    config = context.config
    name, chosen = unit.split("/")
    truth = QTable.read(context.path(f"{name}/truth.ecsv"))
    matched = QTable.read(context.path(f"{name}/matched.ecsv"))
    zero_point = context.plan.get("zero_point", 0.0)
    mock = mock_photometry(config, truth, matched, seed=context.seed, zero_point=zero_point)
    fitter = fitting.BayesFitter(
        sed.SEDModel.yang2021(),
        [*config.fit.bands, *context.plan["bands"]],
        axes=sed.SEDModel.yang2021_axes(config.fit.axes),
        model_error=config.fit.model_error,
    )
    with ThreadPoolExecutor(context.n_threads) as executor:
        results = fitter.fit(mock, executor=executor, progress_bar=context.progress_bar)
    context.save_result(f"{name}/fits_{chosen}.fits", results)
    table = results.to_table()
    table["condition"] = any_condition(matched, config.exposures.filters)[
        np.asarray(matched["selection"]) == 0
    ]
    table["condition"].info.description = ConditionFlags.describe()
    context.save_table(f"{name}/fits_{chosen}.ecsv", table)
