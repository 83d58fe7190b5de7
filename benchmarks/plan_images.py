"""
A plan beside images of the same exposures: python benchmarks/plan_images.py PLAN.toml FOLDER [--set KEY=VALUE]

The plan becomes the configuration of a run in FOLDER, which resumes like any run: slopes with the noise of ramps,
mosaics, forced photometry and error functions. Its catalog is the plan's, so that the sky has the very fluxes of
the sample, and its neighbors. The measured fluxes are then fitted in place of the mock ones. The sample is of the
plan's catalog, without a luminosity function ([sample] n_sources = 0 takes all), with a mix of AGN ([agn]).
Prints, for the sources that the images can measure, noise and images side by side.
"""

import argparse
import dataclasses
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.evaluation import bootstrap
from miricigale.evaluation.estimates import median, scatter
from miricigale.photometry import ErrorModel
from miricigale.planning import Planner, load_plan
from miricigale.planning.accuracy import NUMBERS, accuracy, columns_of
from miricigale.planning.sample import agn_mix
from miricigale.utils.files import replacing
from miricigale.utils.parallel import process_pool, thread_count
from miricigale.utils.random import stream
from miricigale.utils.tables import error_column
from miricigale.workflow.analysis_sections import FitSection, PointSourceSection
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.derived import rows_of
from miricigale.workflow.sections import (
    DetectorSection,
    ExposureSection,
    PointingSection,
    RunSection,
    SceneSection,
)
from miricigale.workflow.stages.inputs import study_catalog
from miricigale.workflow.stages.sample import SampleFlags
from miricigale.workflow.study import run_study
from miricigale.workflow.truths import CATALOG, FIELD, truth_names

#: Sources that images say nothing of.
_UNUSABLE = (
    SampleFlags.OUTSIDE_FIELD | SampleFlags.STAR | SampleFlags.NO_MODEL | SampleFlags.NOT_MATCHED
)


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class ImagedSample:
    """
    What the images of a plan say of its sample.

    Parameters
    ----------
    measured : `~astropy.table.QTable`
        A row for each source of the sample: ``id``, measured fluxes and errors in the MIRI bands, NaN where
        the source is not usable.
    in_field : `~numpy.ndarray` of bool, shape (n,)
        Which sources all bands image.
    usable : `~numpy.ndarray` of bool, shape (n,)
        Which of them are also found on the prior image and matched.
    errors : `~miricigale.photometry.ErrorModel`
        The error functions that the images gave.
    """

    measured: QTable
    in_field: np.ndarray
    usable: np.ndarray
    errors: ErrorModel


def images_catalog(planner):
    """
    The catalog of the run: the plan's, each source with its fracAGN.

    Sources that the sample does not have, which are neighbors in the images, get one of the same mix.
    """
    config = planner.config
    catalog = study_catalog(config.catalog)
    if not config.agn.frac_agn or "frac_agn" in catalog.colnames:
        return catalog
    rng = stream(config.plan.seed, "plan", "neighbors")
    fractions = agn_mix(config.agn, len(catalog), rng)
    own = dict(zip(planner.sources["id"], planner.sources["frac_agn"], strict=True))
    pairs = zip(catalog["id"], fractions, strict=True)
    catalog["frac_agn"] = [float(own.get(key, value)) for key, value in pairs]
    return catalog


#: Options of a catalog that is written here.
_PLAIN = {"columns": (), "units": (), "survey": "", "missing": (), "factor": ""}


def _levels(config, plans):
    """Levels of the background of a run, those of the plan."""
    if config.background.level == ("low",) and config.background.ra < 0:
        return config.background.level
    return tuple(f"{plan.background.to_value(u.MJy / u.sr)} MJy/sr" for plan in plans.values())


def images_study(planner, source):
    """
    The configuration of the run that images a plan.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        The plan.
    source : path-like
        File of `images_catalog`.

    Returns
    -------
    config : `~miricigale.workflow.StudyConfig`
        Its first truth has no AGN and gives prior and error functions, as in a study; the last is that of
        the sample.
    """
    config, plans = planner.config, planner.band_plans()
    own, fit = study_catalog(config.catalog), config.fit
    center = SkyCoord(own["sky"].cartesian.mean(), representation_type="cartesian")
    center.representation_type = "spherical"
    ra, dec = float(center.ra.deg), float(center.dec.deg)
    fractions = (0.0,)
    if "frac_agn" in own.colnames or np.any(np.asarray(planner.sources["frac_agn"], float) > 0):
        fractions = (0.0, CATALOG)
    if not (config.agn.frac_agn or "frac_agn" in own.colnames):
        fractions = (0.0, FIELD)
    run, exposures = config.plan, [plan.exposure for plan in plans.values()]
    return StudyConfig(
        run=RunSection(name=f"{run.name} images", seed=run.seed, threads=run.threads),
        catalog=dataclasses.replace(config.catalog, source=str(source), **_PLAIN),
        pointing=PointingSection(ra=ra, dec=dec),
        sed=dataclasses.replace(config.sed, frac_agn=fractions),
        scene=SceneSection(background=_levels(config, plans)),
        exposures=ExposureSection(
            filters=tuple(plans),
            kind="rates",
            n_groups=tuple(one.n_groups for one in exposures),
            n_integrations=tuple(one.n_integrations for one in exposures),
            n_dithers=tuple(plan.n_dithers for plan in plans.values()),
        ),
        detector=DetectorSection(residual=config.noise.residual),
        fit=FitSection(**dataclasses.asdict(fit) | {"min_detected": planner.min_detected}),
        point_sources=PointSourceSection(enabled=False),
    )


def image_sample(planner, folder, *, executor=None, progress_bar=False):
    """
    Image the exposures of a plan, and measure its sample.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        The plan, with a sample of its catalog.
    folder : path-like
        Folder of the run, which `~miricigale.workflow.run_study` resumes; what belongs to another plan
        is done again. The catalog is written to ``<folder>.ecsv``.
    executor : `concurrent.futures.Executor`, optional
        As for `~miricigale.workflow.run_study`.
    progress_bar : bool, optional
        Whether to show one.

    Returns
    -------
    imaged : `ImagedSample`

    """
    folder = Path(folder).resolve()
    source = folder.with_name(f"{folder.name}.ecsv")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with replacing(source, overwrite=True) as partial:
        images_catalog(planner).write(partial, format="ascii.ecsv")
    study = images_study(planner, source)
    parallel = {"executor": executor, "progress_bar": progress_bar}
    run_study(study, folder, redo=True, until="matches", **parallel)
    truth = truth_names(study)[-1]
    matched = QTable.read(folder / truth / "matched.ecsv")
    matched = rows_of(matched, planner.sources["id"])
    selection = np.asarray(matched["selection"])
    usable = (selection & int(_UNUSABLE)) == 0
    measured = QTable({"id": planner.sources["id"]})
    for name in study.exposures.filters:
        for column in (name, error_column(name)):
            values = matched[column].to_value(u.uJy)
            measured[column] = np.where(usable, values, np.nan) * u.uJy
    in_field = (selection & int(SampleFlags.OUTSIDE_FIELD)) == 0
    return ImagedSample(measured, in_field, usable, ErrorModel.read(folder / "errors.ecsv"))


def paired_bands(planner, imaged):
    """
    Noise of the plan and of its images, band by band, of the same sources.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        The plan.
    imaged : `ImagedSample`
        Of `image_sample`.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``filter``; ``limit`` and ``limit_images``, 5-sigma limits of points by the plan and by the error
        functions of the images; ``scatter`` and its ``_err``, sigma_MAD of (measured - true) over the error that
        the plan gives each source, 1 if both agree; ``offset``, the median relative difference of the
        sources above 10 sigma; ``n`` sources in the field, ``n_detected`` of them in the plan's mock fluxes and
        ``n_detected_images`` in the images.
    """
    plans, seed = planner.band_plans(), planner.config.plan.seed
    mock = planner.photometry(plans.values())
    rows = []
    for name, plan in plans.items():
        true = planner.sources[name].to_value(u.uJy)
        flux, error = (imaged.measured[c].value for c in (name, error_column(name)))
        own_flux, own_error = (mock[c].to_value(u.uJy) for c in (name, error_column(name)))
        pulls = bootstrap(scatter, ((flux - true) / own_error)[imaged.usable], seed=seed)
        bright = imaged.usable & (true > 10 * own_error)
        offset = bootstrap(median, (flux / true - 1)[bright], seed=seed)
        with np.errstate(invalid="ignore"):
            detected = [own_flux > 5 * own_error, flux > 5 * error]
        counts = [int(np.count_nonzero(found & imaged.in_field)) for found in detected]
        rows.append(
            {
                "filter": name,
                "limit": plan.errors().limiting_magnitude(name),
                "limit_images": imaged.errors.limiting_magnitude(name),
                "scatter": pulls.value,
                "scatter_err": pulls.error,
                "offset": offset.value,
                "offset_err": offset.error,
                "n": int(np.count_nonzero(imaged.in_field)),
                "n_detected": counts[0],
                "n_detected_images": counts[1],
            }
        )
    return QTable(rows)


def difference(first, second, *, agn_limit, seed):
    """
    Numbers of `accuracy` of the second plan less those of the first.

    Parameters
    ----------
    first, second : `~astropy.table.QTable`
        Tables of the same sources, row by row.
    agn_limit, seed
        As for `accuracy`.

    Returns
    -------
    numbers : dict of str to `~miricigale.evaluation.Estimate`
        With the errors of sources that are drawn together.
    """
    columns = [columns_of(one, agn_limit) for one in (first, second)]
    numbers = {}
    for name, (statistic, *wanted) in NUMBERS.items():
        n = len(wanted)

        def change(*values, statistic=statistic, n=n):
            return statistic(*values[n:]) - statistic(*values[:n])

        values = [one[key] for one in columns for key in wanted]
        numbers[name] = bootstrap(change, *values, seed=seed)
    return numbers


def paired_numbers(planner, plans, imaged_plans, imaged):
    """
    Accuracies with the noise of the plan and with its images, of the same sources.

    Parameters
    ----------
    planner : `~miricigale.planning.Planner`
        The plan.
    plans, imaged_plans : list of `~miricigale.planning.Plan`
        Of `Planner.compare`, without and with what the images measured.
    imaged : `ImagedSample`
        Of `image_sample`.

    Returns
    -------
    table : `~astropy.table.QTable`
        For each set with MIRI and each number of `~miricigale.planning.accuracy.accuracy`: ``plan``,
        ``number``, ``n`` sources (in the field, found on the prior, and detected in one of the plans by either),
        ``noise`` and ``images`` with their errors, ``difference`` (images less noise) with the error that
        sources drawn together give it, and ``sigma``, their ratio.
    """
    chosen = imaged.usable & (planner.common(plans) | planner.common(imaged_plans))
    options = {"agn_limit": planner.config.agn.limit, "seed": planner.config.plan.seed}
    rows = []
    for plan, other in zip(plans, imaged_plans, strict=True):
        if not plan.bands:
            continue
        pair = [one.sources[chosen] for one in (plan, other)]
        noise, images = (accuracy(one, **options) for one in pair)
        for name, change in difference(*pair, **options).items():
            row = {"plan": plan.name, "number": name, "n": int(np.count_nonzero(chosen))}
            numbers = {"noise": noise[name], "images": images[name], "difference": change}
            for key, one in numbers.items():
                row |= {key: one.value, f"{key}_err": one.error}
            row["sigma"] = change.value / change.error if change.error > 0 else np.nan
            rows.append(row)
    return QTable(rows)


def plans_of_images(planner, plans, imaged):
    """Return the plans, each set of bands evaluated with the photometry of the images."""
    of_images = [plans[0]]
    for plan, name in zip(plans[1:], planner.config.exposures.sets, strict=True):
        bands = planner.config.set_bands(name)
        share = planner.share(bands)
        measured = planner.evaluate(bands, name=plan.name, share=share, measured=imaged.measured)
        of_images.append(measured)
    return of_images


def main():
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("plan", help="configuration of the plan")
    parser.add_argument("folder", type=Path, help="of the run")
    parser.add_argument(
        "--set", action="append", default=[], help="of the plan, as miricigale plan"
    )
    args = parser.parse_args()
    planner = Planner(load_plan(args.plan, overrides=args.set))
    plans = planner.compare()
    with process_pool(thread_count(planner.config.plan.threads or None)) as pool:
        imaged = image_sample(planner, args.folder, executor=pool, progress_bar=True)
    numbers = paired_numbers(planner, plans, plans_of_images(planner, plans, imaged), imaged)
    for table in (paired_bands(planner, imaged), numbers):
        for name in table.colnames:
            if table[name].dtype.kind == "f":
                table[name].info.format = ".4g"
        table.pprint_all()


if __name__ == "__main__":
    main()
