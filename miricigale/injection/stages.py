"""A run of injection: the field itself, each trial, and the result, resumed one by one."""

import dataclasses
import io
import json
import tempfile
from pathlib import Path
from typing import ClassVar

import numpy as np
from astropy.table import QTable, vstack

from miricigale.injection.field import image_field, over_noise
from miricigale.injection.population import read_sources
from miricigale.injection.ramps import Exposures
from miricigale.injection.results import InjectionResult
from miricigale.injection.settings import InjectionSettings
from miricigale.injection.trials import (
    Base,
    injected_sources,
    measure_base,
    place_names,
    run_trial,
)
from miricigale.photometry import DetectionPreset, MosaicFile
from miricigale.photometry.commands.file_inputs import Inputs
from miricigale.psf import read_psf
from miricigale.utils.exceptions import argument_error
from miricigale.utils.files import is_path
from miricigale.utils.meta import provenance
from miricigale.utils.named_values import field_values
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import as_table
from miricigale.utils.units import ab_magnitude
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import Context, stage
from miricigale.workflow.options import Configuration, Section, option
from miricigale.workflow.recorded_inputs import (
    absolute,
    as_text,
    file_states,
    from_text,
    inputs_from_text,
    inputs_text,
    path_states,
)
from miricigale.workflow.sections import RunBasics, memory_of

#: Bytes of a process with the images of a field, for each pixel, beside those of its photometry.
_BYTES = 60

#: Options of photometry that are not of one image.
_FOREIGN = ("detection", "output", "page", "model", "residual", "overwrite")


class RunSection(RunBasics):
    """How the run goes."""

    name: str = option(
        "injection", "Name of the run; its folder unless --output is given.", folder=True
    )
    memory: float = memory_of("trials")


class InjectionSection(Section):
    """What is measured, and what is injected."""

    inputs: str = option(
        "",
        "Files and options of the photometry as JSON.",
    )
    settings: str = option(
        "",
        "Settings of the injection as JSON.",
    )
    n_trials: int = option(1, "How often sources are injected.", low=1)


class InjectionConfig(Configuration):
    """What a run of injection depends on."""

    heading: ClassVar = "# miricigale inject; a record of what was asked for"

    run: RunSection
    injection: InjectionSection


@dataclasses.dataclass(frozen=True)
class Task:
    """
    What a run does, of its configuration.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs` or None
        What is measured on a prior; None without one.
    image : `~miricigale.photometry.MosaicFile`
        The image.
    options : dict
        Of the photometer, without a prior.
    injection : `~miricigale.injection.settings.InjectionSettings`
        Settings.
    exposures : `~miricigale.injection.ramps.Exposures` or None
        Ramps that the image was reduced from, into which sources are put.
    """

    inputs: Inputs | None
    image: MosaicFile
    options: dict
    injection: InjectionSettings
    exposures: Exposures | None = None

    @classmethod
    def of(cls, config, seed):
        """Of a configuration and the seed of the run."""
        values = json.loads(config.injection.inputs)
        inputs = None
        if values["inputs"] is not None:
            inputs = inputs_from_text(values["inputs"])
        settings = from_text(config.injection.settings)
        if isinstance(settings["preset"], dict):
            settings["preset"] = DetectionPreset(**settings["preset"])
        image = from_text(values["image"])
        options = from_text(values["options"])
        exposures = None
        if values["exposures"] is not None:
            exposures = from_text(values["exposures"])
            exposures = Exposures(**exposures | {"paths": tuple(exposures["paths"])})
        return cls(inputs, image, options, InjectionSettings(**settings, seed=seed), exposures)

    def field(self, n_threads):
        """Return the field that is measured."""
        return image_field(self.image, self.inputs, self.injection.preset, self.options, n_threads)

    def sources(self, field, wcs):
        """Return the own catalog, or None."""
        catalog = self.injection.catalog
        if catalog is None:
            return None
        if catalog.startswith("#"):
            catalog = QTable.read(catalog, format="ascii.ecsv")
        return read_sources(catalog, field.band, field.prior_band, wcs)

    @property
    def files(self):
        """Files that it reads, but for those of ``inputs``."""
        catalog = self.injection.catalog
        paths = [getattr(self.image, name) for name in ("path", "psf", "error", "variance")]
        paths += [self.image.inverse_variance, self.image.weight]
        if catalog is not None and not catalog.startswith("#"):
            paths.append(catalog)
        if self.exposures is not None:
            paths += self.exposures.paths
        return [path for path in paths if path is not None]


def _states(config, unit):
    task = Task.of(config, config.run.seed)
    if task.inputs is not None:
        return file_states(task.inputs, task.files)
    return path_states(task.files)


def _bytes(config, unit):
    """Estimate how many bytes a trial takes."""
    task = Task.of(config, config.run.seed)
    pixels = np.prod(task.image.header.shape, dtype=float)
    if task.inputs is None:
        return int(600_000_000 + 4 * _BYTES * pixels)
    pixels += np.prod(task.inputs.highres.header.shape, dtype=float)
    return int(task.inputs.n_bytes() + 200_000_000 + _BYTES * pixels)


def trial_names(config):
    """Return the names of the trials."""
    return [f"trial-{k + 1:03d}" for k in range(config.injection.n_trials)]


_READS = {"sections": ("injection.inputs", "injection.settings"), "plan": _states}


@stage("field", "field", memory=_bytes, **_READS)
def field_stage(context, _):
    """Measure the field as its user does."""
    task = Task.of(context.config, context.seed)
    base = measure_base(task.field(context.n_threads), task.injection)
    context.save_table("photometry.fits", base.table)
    context.save_rows("field/sources", base.former)
    context.save_rows("field/population", base.population)
    detections = [_detection_rows(table, base.model) for table in (base.detections, base.negatives)]
    for name, rows in zip(("detections", "negatives"), detections, strict=True):
        context.save_rows(f"field/{name}", rows)
    if base.empty_pulls is None:
        pulls = np.zeros(0)
    else:
        pulls = np.asarray(base.empty_pulls)
    context.save_table("field/empty.fits", QTable({"pull": pulls}))
    if base.noise_correlation is not None:
        context.save_table(
            "field/noise_correlation.fits", QTable({"covariance": base.noise_correlation})
        )
    context.save_image("field/model.fits", base.model)
    for name, psf in zip(("psf", "prior_psf"), base.psfs, strict=True):
        if psf is not None:
            context.save(f"field/{name}.fits", lambda path, psf=psf: psf.write(path))
    text = json.dumps(base.facts, sort_keys=True)
    context.save("field/facts.json", lambda path: path.write_text(text, "utf-8"))


def _detection_rows(table, model):
    """Return the detections with what results are binned by."""
    xy = np.stack([table["x_centroid"], table["y_centroid"]], axis=-1).reshape(-1, 2)
    rows = QTable({"sky": table["sky"], "flux": table["flux"]})
    rows["magnitude"] = ab_magnitude(table["flux"])
    rows["size"] = table["semimajor_axis"]
    rows["place"] = place_names(xy, model.data.shape)
    rows["neighbor_light"] = over_noise(model, xy)
    return rows


def _read_base(context):
    """Return what `field_stage` has written."""
    psfs = [None, None]
    for k, name in enumerate(("psf", "prior_psf")):
        if context.products.path(f"field/{name}.fits").exists():
            psfs[k] = read_psf(context.path(f"field/{name}.fits"))
    correlation = None
    if context.products.path("field/noise_correlation.fits").exists():
        table = context.table("field/noise_correlation.fits")
        correlation = np.asarray(table["covariance"])
    return Base(
        table=None,
        former=context.table("field/sources.ecsv"),
        detections=context.table("field/detections.ecsv"),
        negatives=context.table("field/negatives.ecsv"),
        population=context.table("field/population.ecsv"),
        psfs=tuple(psfs),
        model=context.image("field/model.fits"),
        empty_pulls=np.asarray(context.table("field/empty.fits")["pull"]),
        noise_correlation=correlation,
        facts=json.loads(context.path("field/facts.json").read_text("utf-8")),
    )


@stage("trial", "trial", needs=("field",), units=trial_names, memory=_bytes, **_READS)
def trial_stage(context, unit):
    """Inject sources into the field and measure it."""
    task = Task.of(context.config, context.seed)
    base = _read_base(context)
    number = int(unit.rpartition("-")[2])
    field = task.field(context.n_threads)
    usable = _usable(base, field, task)
    sources = injected_sources(
        task.injection, task.sources(field, base.model.wcs), base, usable, base.model.wcs, number
    )
    with tempfile.TemporaryDirectory() as folder:
        image = None
        if task.exposures is not None and len(sources):
            mosaic = task.exposures.injected(
                sources, context.seed, number, folder, context.n_threads
            )
            image = task.image.replace(path=mosaic)
        rows, table = run_trial(field, task.injection, base, sources, image, number)
    if len(rows):
        rows.add_column(np.full(len(rows), number), name="trial", index=0)
        texts = column_texts("miricigale.injection", "sources")
        for name in rows.colnames:
            rows[name].info.description = texts[name]
    else:
        # the user's own result
        context.save_table(f"trials/{unit}-photometry.fits", table)
        rows = QTable({"trial": np.zeros(0, int)})
    context.save_table(f"trials/{unit}.fits", rows)


def _usable(base, field, task):
    prior = None
    if task.inputs is not None:
        prior = task.inputs.highres.read()
    return field.usable(base.model, prior)


@stage("result", "result", needs=("field", "trial"), sections=("injection",), plan=_states)
def result_stage(context, _):
    """Put all trials together, and write the page."""
    from miricigale.injection.page import write_page

    result = _result(context, context.config, context.seed)
    context.save_table("sources.fits", result.sources)
    if not len(result.sources):
        return
    context.save_table("summary.ecsv", result.summary)
    context.save_table("purity.ecsv", result.purity())
    task = Task.of(context.config, context.seed)
    name = Path(task.image.path).name
    if task.exposures is not None:
        name = f"{len(task.exposures.paths)} ramps"
    context.save("index.html", lambda path: write_page(path, result, name))


def _result(context, config, seed):
    base = _read_base(context)
    paths = [context.path(f"trials/{name}.fits") for name in trial_names(config)]
    tables = [read_table(path, wanted="a table of a trial") for path in paths]
    filled = [table for table in tables if len(table)]
    sources = vstack(filled or tables, metadata_conflicts="silent")
    for table, negative in ((base.detections, False), (base.negatives, True)):
        table["negative"] = np.full(len(table), negative)
    detections = vstack([base.detections, base.negatives], metadata_conflicts="silent")
    task = Task.of(config, seed)
    facts = dict(base.facts)
    if task.exposures is not None:
        facts["photon_noise"] = "drawn in the ramps"
    meta = provenance(
        seed=seed,
        n_trials=config.injection.n_trials,
        threshold=task.injection.threshold,
        preset=str(task.injection.preset),
        **facts,
    )
    sources.meta = dict(meta)
    return InjectionResult(
        sources=sources,
        detections=detections,
        photometry=read_table(context.products.path("photometry.fits"), wanted="the table"),
        empty_pulls=base.empty_pulls,
        meta=meta,
    )


def injection_stages():
    """Return the stages of a run of injection."""
    return field_stage, trial_stage, result_stage


def run_injection(
    injection,
    image,
    highres,
    folder,
    *,
    executor,
    redo,
    n_threads,
    progress_bar,
    options,
    exposures=None,
):
    """Run a `~miricigale.injection.Injection`; see its method ``run``."""
    foreign = sorted(set(options) & set(_FOREIGN))
    check_that(not foreign, "options", f"others than {list(_FOREIGN)}", foreign)
    file = image
    if not isinstance(image, MosaicFile):
        file = MosaicFile(image)
    inputs = None
    if highres is not None:
        inputs = Inputs.of(file, highres, **{"psf_stars": None, **options})
        named = {name: absolute(getattr(inputs, name)) for name in ("segmentation", "catalog")}
        kernels = tuple(map(absolute, inputs.kernels))
        inputs = dataclasses.replace(inputs, kernels=kernels, **named)
        inputs.check()
        options = {}
    if file.header.filter is None:
        raise argument_error("filter", f"given, for {file.path} does not name it", None)
    values = {
        "inputs": None if inputs is None else inputs_text(inputs),
        "image": as_text(file),
        "options": as_text(options),
        "exposures": None if exposures is None else as_text(_plain_exposures(exposures)),
    }
    settings = field_values(injection)
    del settings["n_trials"], settings["seed"]
    settings["catalog"] = _catalog_text(injection.catalog)
    if isinstance(injection.preset, DetectionPreset):
        settings["preset"] = dataclasses.asdict(injection.preset)
    config = InjectionConfig(
        run=RunSection(threads=n_threads or 0, seed=injection.seed),
        injection=InjectionSection(
            inputs=json.dumps(values, sort_keys=True),
            settings=json.dumps(settings, sort_keys=True),
            n_trials=injection.n_trials,
        ),
    )
    # faults of the user's are refused here rather than in a trial
    field = Task.of(config, injection.seed).field(n_threads)
    if inputs is not None:
        _ = field.photometers
    else:
        _ = field.photometer
    Task.of(config, injection.seed).sources(field, file.header.wcs)
    runner = StudyRunner(
        config, folder, injection_stages, executor=executor, redo=redo, progress_bar=progress_bar
    )
    runner.run()
    result = _result(Context(config, folder), config, injection.seed)
    return dataclasses.replace(result, folder=Path(folder))


def _plain_exposures(exposures):
    """Return the ramps and settings as `as_text` takes them."""
    values = field_values(exposures)
    values["paths"] = [absolute(path) for path in exposures.paths]
    values["reducer"] = exposures.reducer.replace(n_threads=None)
    return values


def _catalog_text(catalog):
    """Return an own catalog as a path, or as text."""
    if catalog is None:
        return None
    if is_path(catalog):
        return absolute(catalog)
    text = io.StringIO()
    as_table(catalog, "catalog").write(text, format="ascii.ecsv")
    return text.getvalue()
