"""Runs the stages in order; what stands already and is current is not done again."""

import dataclasses
import hashlib
import json
import logging
import shutil
import time
import types
from collections.abc import Callable
from pathlib import Path

import numba

from miricigale.refdata.locate import file_sha256, fingerprint
from miricigale.utils.exceptions import ConfigError, DataError
from miricigale.utils.progress import progress
from miricigale.workflow.products import ProductStore, read_image, write_image

__all__ = ["Context", "Stage", "StudyRunner", "run_stages"]

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Stage:
    """
    One step of the study.

    Parameters
    ----------
    name : str
        Such as ``"mosaic"``.
    function : callable
        Called as ``function(context, unit)``; saves its products through the context.
    title : str
        What it does, for the progress line.
    needs : tuple of str
        Stages whose products it reads.
    sections : tuple of str
        Sections (``"scene"``) or keys (``"run.keep_level1b"``) of the configuration that it
        reads; reading another one is an error.
    resources : tuple of str
        Reference data that it depends on.
    version : int
        Raised when the stage's own algorithm changes its products.
    units : callable, optional
        Called with the configuration; names of the pieces that are done and resumed one
        by one.
    plan : callable, optional
        Called with the configuration and the unit; plain values that the stage takes from the
        package (the exposures of a named plan, the axes of a named grid), so that a change
        of those is seen.
    """

    name: str
    function: Callable
    title: str
    needs: tuple = ()
    sections: tuple = ()
    resources: tuple = ()
    version: int = 1
    units: Callable | None = None
    plan: Callable | None = None

    def unit_names(self, config):
        """Names of the pieces; a single empty one for a stage that has none."""
        return tuple(self.units(config)) if self.units else ("",)


class ConfigView:
    """
    What a stage has declared of a configuration; reading anything else is an error.

    A stage that reads what is not in its hash would be taken for current when it is not.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    stage : `Stage`
        Whose declaration counts.
    """

    def __init__(self, config, stage):
        self._config, self._stage = config, stage

    def __getattr__(self, section):
        if section in self._stage.sections:
            return getattr(self._config, section)
        keys = [k.split(".")[1] for k in self._stage.sections if k.startswith(f"{section}.")]
        if not keys:
            msg = f"stage {self._stage.name!r} reads [{section}] without declaring it"
            raise RuntimeError(msg)
        values = getattr(self._config, section)
        return types.SimpleNamespace(**{key: getattr(values, key) for key in keys})


class Context:
    """
    What a stage sees of the run.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    store : `~miricigale.workflow.products.ProductStore`
        The products.
    progress_bar : bool
        Whether progress bars are shown.
    """

    def __init__(self, config, store, *, stage=None, progress_bar=False):
        self.config = config if stage is None else ConfigView(config, stage)
        self.store = store
        self.progress_bar = progress_bar
        self.saved = []
        # neither changes a product by itself: the seed is in every hash, threads in none
        self.seed = config.run.seed
        self.n_threads = config.run.threads or numba.config.NUMBA_NUM_THREADS

    def path(self, name):
        """Path of a product."""
        return self.store.path(name)

    def save(self, name, writer):
        """Write a product whole or not at all, and note it for the manifest."""
        path = self.store.save(name, writer)
        self.saved.append(name)
        return path

    def save_table(self, name, table):
        """Write a table as ECSV or FITS by the suffix of ``name``."""
        table = table.copy(copy_data=False)
        # the manifest says when; the same run gives the same bytes
        table.meta.pop("created", None)
        return self.save(name, lambda path: table.write(path, overwrite=True))

    def save_image(self, name, image, **planes):
        """Write an image and further planes."""
        return self.save(name, lambda path: write_image(image, path, planes=planes))

    def image(self, name, *planes):
        """Read an image (and planes) that an earlier stage wrote."""
        return read_image(self.path(name), planes=planes)


class StudyRunner:
    """
    Runs a study in a folder.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    folder : path-like
        Where the products go.
    stages : tuple of `Stage`
        In an order in which every stage comes after what it needs.
    progress_bar : bool, optional
        Whether progress is shown.
    """

    def __init__(self, config, folder, stages, *, progress_bar=False):
        self.config = config
        self.folder = Path(folder)
        self.stages = tuple(stages)
        self.progress_bar = progress_bar
        seen = set()
        for stage in self.stages:
            missing = set(stage.needs) - seen
            if missing:
                msg = f"stage {stage.name!r} needs {sorted(missing)}, which do not come before it"
                raise ConfigError(msg)
            seen.add(stage.name)

    def digest(self, stage, unit, store):
        """
        Hash of everything that a stage's products depend on.

        That is its own version, its sections of the configuration (and the seed), the
        checksums of the products it reads and of its reference data.
        """
        values = {
            "stage": stage.name,
            "unit": unit,
            "version": stage.version,
            "seed": self.config.run.seed,
            "config": self.config.values(*stage.sections),
            "inputs": {name: store.checksums(name) for name in stage.needs},
            "data": {name: fingerprint(name) for name in stage.resources},
        }
        if stage.plan is not None:
            values["plan"] = stage.plan(self.config, unit)
        source = Path(self.config.catalog.source).expanduser()
        if "catalog" in stage.sections and source.is_file():
            # a user's own file may change under the same name
            values["catalog"] = file_sha256(source)
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def run(self):
        """
        Do what is not done yet.

        Returns
        -------
        store : `~miricigale.workflow.products.ProductStore`

        Raises
        ------
        KeyboardInterrupt
            Passed on; everything that was finished stays and is not done again.
        """
        threads = numba.get_num_threads()
        if self.config.run.threads:
            numba.set_num_threads(min(self.config.run.threads, numba.config.NUMBA_NUM_THREADS))
        jobs = [(stage, unit) for stage in self.stages for unit in stage.unit_names(self.config)]
        try:
            with (
                ProductStore(self.folder) as store,
                progress(total=len(jobs), show=self.progress_bar, desc="study", unit="step") as bar,
            ):
                self._drop_stale(store, jobs)
                store.save("config.toml", lambda path: path.write_text(self.config.to_toml()))
                for stage, unit in jobs:
                    bar.set_description(f"{stage.title}{' ' + unit if unit else ''}")
                    self._run_one(stage, unit, store)
                    bar.update()
        finally:
            numba.set_num_threads(threads)
        return store

    @staticmethod
    def _drop_stale(store, jobs):
        """Forget units that the configuration no longer has, and remove their products."""
        keys = {_key(stage.name, unit) for stage, unit in jobs}
        for key in [key for key in store.records if key not in keys]:
            store.drop(key)

    def _run_one(self, stage, unit, store):
        key, digest = _key(stage.name, unit), self.digest(stage, unit, store)
        if store.is_current(key, digest):
            log.info("%s stands already", key)
            return
        store.drop(key)
        context = Context(self.config, store, stage=stage, progress_bar=self.progress_bar)
        begin = time.perf_counter()
        try:
            stage.function(context, unit)
        except (ValueError, KeyError, OSError) as err:
            err.add_note(f"in stage {key}")
            raise
        seconds = time.perf_counter() - begin
        store.finish(key, digest, context.saved, seconds=seconds)
        log.info("%s took %.1f s", key, seconds)


def _key(name, unit):
    return f"{name}:{unit}" if unit else name


def check_disk(folder, needed):
    """
    Refuse to begin where the products would not fit.

    Parameters
    ----------
    folder : path-like
        Where they will go.
    needed : int
        Bytes.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If less than that is free.
    """
    place = Path(folder).absolute()
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free
    if needed > free:
        msg = f"the run needs about {needed / 1e9:.2f} GB in {folder}, only {free / 1e9:.2f} GB are free"
        raise DataError(msg)


def run_stages(config, folder, stages, *, progress_bar=False):
    """Run ``stages`` in ``folder``; see `StudyRunner`."""
    return StudyRunner(config, folder, stages, progress_bar=progress_bar).run()
