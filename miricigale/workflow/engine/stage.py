"""A stage of the study, and what it sees of the run."""

import collections
import dataclasses
import itertools
import socket
import time
import types
import warnings
from collections.abc import Callable

from astropy.table import QTable

from miricigale.instrument.image_files import read_image, write_planes
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import data_error, warn
from miricigale.utils.folder import FileFolder
from miricigale.utils.meta import undated
from miricigale.utils.parallel import single_threaded
from miricigale.utils.table_files import write_table

#: Rows above which tables of sources are FITS, and which a unit takes of them.
LONG = 10_000


@dataclasses.dataclass(frozen=True)
class Stage:
    """
    One step of the study; made by the decorator `stage` beside its function.

    Parameters
    ----------
    name : str
        Such as ``"mosaics"``.
    function : callable
        Called as ``function(context, unit)``; saves its products through the context.
    title : str
        What it does, for the progress line.
    needs : tuple of str
        Stages whose products it reads; reading another product is an error. Of these a unit reads the
        units that are parts of it, or it of them (see `Units`): ``"sky/band"`` those named
        ``"sky"``, ``"band"``, ``"sky/band"`` and ``"sky/band-1"``, and a stage's only one.
    sections : tuple of str
        Sections (``"scene"``) or keys (``"run.keep_level1b"``) of the configuration that it
        reads; reading another one is an error.
    resources : tuple of str or callable
        Reference data that it depends on, or a function that gives their names.
    version : int
        Raised when the stage's own algorithm changes its products.
    units : callable, optional
        Called with the configuration; names of the pieces that are done and resumed one
        by one, in parts joined by ``/``.
    within : callable, optional
        Called with the configuration; a part that counts as one of the name of each unit in
        what it reads.
    reads : callable, optional
        Called with the configuration and the unit; names that count in place of its own in what it reads.
    plan : callable, optional
        Called with the configuration and the unit; plain values that the stage takes from the
        package (the exposures of a named plan, the axes of a named grid) or from a part of the
        configuration, so that a change of those is seen. The stage has them as ``context.plan``.
    memory : callable, optional
        Called with the configuration and the unit; about how many bytes it takes to do it.

    Examples
    --------
    >>> from miricigale.workflow import study_stages
    >>> stage = study_stages()[4]
    >>> stage.name, stage.needs
    ('mosaics', ('exposures',))
    """

    name: str
    function: Callable
    title: str
    needs: tuple = ()
    sections: tuple = ()
    resources: tuple | Callable = ()
    version: int = 1
    units: Callable | None = None
    within: Callable | None = None
    reads: Callable | None = None
    plan: Callable | None = None
    memory: Callable | None = None

    def unit_names(self, config):
        """Return names of the pieces; a single empty one for a stage that has none."""
        if self.units:
            return tuple(self.units(config))
        return ("",)

    def needed(self, config, unit, units):
        """
        Return what a unit reads.

        Parameters
        ----------
        config : `~miricigale.workflow.config.StudyConfig`
            The configuration.
        unit : str
            Which.
        units : dict of str to `Units`
            The units of each stage.

        Returns
        -------
        keys : dict of str to list of str
            By stage: keys of its units in the manifest.
        """
        names = [unit]
        if self.within is not None:
            names = [f"{self.within(config)}/{unit}"]
        if self.reads is not None:
            names = self.reads(config, unit)
        keys = {}
        for stage in self.needs:
            related = itertools.chain.from_iterable(map(units[stage].related, names))
            # each once, in their order
            related = dict.fromkeys(related)
            keys[stage] = [f"{stage}:{name}" if name else stage for name in related]
        return keys

    def key(self, unit):
        """Return the name of a piece in the manifest."""
        if unit:
            return f"{self.name}:{unit}"
        return self.name


class Units:
    """
    Names of the units of a stage, and which of them belong to another unit.

    Two units are related if all parts of one are parts of the other. A part with a number (``"band-1"``) is
    a part of that without (``"band"``).

    Parameters
    ----------
    names : iterable of str
        In their order.
    """

    def __init__(self, names):
        self._names = tuple(names)
        self._parts = [_parts(name) for name in self._names]
        # numbers of the units by all of their parts and by each, so that looking for one does not
        # go through all
        self._by_parts = collections.defaultdict(list)
        self._by_part = collections.defaultdict(list)
        for k, parts in enumerate(self._parts):
            self._by_parts[parts].append(k)
            for part in parts:
                self._by_part[part].append(k)

    def related(self, unit):
        """Return names of the units that are parts of a unit, or it of them, in their order."""
        parts = _parts(unit)
        numbers = set()
        for n in range(len(parts) + 1):
            for subset in itertools.combinations(parts, n):
                numbers.update(self._by_parts.get(frozenset(subset), ()))
        # units with all parts are among those with the rarest one
        candidates = range(len(self._names))
        for part in parts:
            candidates = min(candidates, self._by_part.get(part, ()), key=len)
        numbers.update(k for k in candidates if parts <= self._parts[k])
        return [self._names[k] for k in sorted(numbers)]


@cached
def _parts(unit):
    """Return the parts of the name of a unit, those with a number also without it."""
    parts = set()
    for name in unit.split("/"):
        if name:
            parts.add(name)
            parts.add(name.rpartition("-")[0] or name)
    return frozenset(parts)


def stage(name, title, **declaration):
    """
    Declare a function as a stage of the study.

    Parameters
    ----------
    name, title, **declaration
        As for `Stage`.

    Returns
    -------
    decorator : callable
        Makes a `Stage` of a function.
    """
    return lambda function: Stage(name, function, title, **declaration)


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
        self._config = config
        self._stage = stage

    def __getattr__(self, section):
        if section in self._stage.sections:
            return getattr(self._config, section)
        view = types.SimpleNamespace()
        for name in self._stage.sections:
            declared, _, key = name.partition(".")
            if declared == section:
                setattr(view, key, getattr(getattr(self._config, section), key))
        if not vars(view):
            msg = f"stage {self._stage.name!r} reads [{section}] without declaring it"
            raise RuntimeError(msg)
        return view


class Context:
    """
    What a stage sees of the run.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    folder : path-like
        The folder of the run.
    stage : `Stage`, optional
        Whose declaration limits what is seen of the configuration.
    unit : str, optional
        Which piece of the stage.
    inputs : iterable of str, optional
        Names of the products of the stages that it needs, which are all that it may read; any by
        default.
    n_threads : int, optional
        Threads that the stage may use; they change no product.
    progress_bar : bool, optional
        Whether progress bars are shown.
    """

    def __init__(
        self, config, folder, *, stage=None, unit="", inputs=None, n_threads=1, progress_bar=False
    ):
        self.config = config
        self.plan = None
        self._name = ""
        if stage is not None:
            self.config = ConfigView(config, stage)
            self._name = stage.name
            if stage.plan is not None:
                self.plan = stage.plan(config, unit)
        self.products = FileFolder(folder)
        self.progress_bar = progress_bar
        self.saved = []
        # available without a declaration: the seed enters every hash, threads change no product
        self.seed = config.run.seed
        self.n_threads = n_threads
        if inputs is None:
            self._inputs = None
        else:
            self._inputs = frozenset(inputs)

    def __repr__(self):
        stage = ""
        if self._name:
            stage = f" of stage {self._name!r}"
        return f"<Context{stage} in {self.products.folder}>"

    def path(self, name):
        """Return the path of a product that an earlier stage wrote."""
        if self._inputs is not None and name not in self._inputs:
            msg = f"stage {self._name!r} reads {name!r} without declaring the stage that makes it"
            raise RuntimeError(msg)
        return self.products.path(name)

    def table(self, name):
        """Read a table that an earlier stage wrote; a long one is FITS."""
        if not self.products.path(name).exists():
            name = name.replace(".ecsv", ".fits")
        return QTable.read(self.path(name))

    def tables(self, folder, names):
        """Read the tables ``<folder>/<name>.ecsv`` that an earlier stage wrote, by name."""
        return {name: self.table(f"{folder}/{name}.ecsv") for name in names}

    def save(self, name, writer):
        """Write a product whole or not at all, and note it for the manifest."""
        path = self.products.save(name, writer)
        self.saved.append(name)
        return path

    def save_table(self, name, table):
        """Write a table as ECSV or FITS by the suffix of ``name``."""
        table = table.copy(copy_data=False)
        table.meta = undated(table.meta)
        return self.save(name, lambda path: write_table(table, path, overwrite=True))

    def save_rows(self, name, table):
        """Write a table with a row for each source: a long one as FITS, which is read 20 times faster."""
        return self.save_table(f"{name}.{'ecsv' if len(table) <= LONG else 'fits'}", table)

    def save_result(self, name, result, **options):
        """Write a result by its own method, without dates: the manifest says when."""
        meta = undated(result.meta)
        result.meta.clear()
        result.meta.update(meta)
        return self.save(name, lambda path: result.write(path, overwrite=True, **options))

    def save_image(self, name, image, **planes):
        """Write an image, rounded far below its noise, and further planes."""
        return self.save(name, lambda path: write_planes(image, path, planes=planes, rounded=True))

    def image(self, name, *planes):
        """Read an image (and planes) that an earlier stage wrote."""
        return read_image(self.path(name), planes=planes)


def run_unit(config, folder, stages, name, unit, **options):
    """
    Do one unit of a stage, in whatever process or thread this is called.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    folder : `pathlib.Path`
        The folder of the run.
    stages : callable or tuple of `Stage`
        The stages, or a function that makes them.
    name, unit : str
        Which.
    **options
        ``inputs``, ``n_threads`` and ``progress_bar`` of `Context`.

    Returns
    -------
    products : dict of str to dict
        Checksum and size of what was written, by name.
    seconds : float
        Time that it took.
    warned : list of (type, str)
        Class and text of each warning, for the process of the run to show.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If this machine does not see the folder.
    """
    if not folder.is_dir():
        host = socket.gethostname()
        raise data_error(folder, f"is not on {host}: all workers must see the folder of the run")
    if callable(stages):
        stages = stages()
    (stage,) = (candidate for candidate in stages if candidate.name == name)
    context = Context(config, folder, stage=stage, unit=unit, **options)
    begin = time.perf_counter()
    caught = []
    try:
        # results independent of the number of cores to the last digit
        with single_threaded(), warnings.catch_warnings(record=True) as caught:
            stage.function(context, unit)
    except Exception as err:
        for warning in caught:
            warn(warning.message, warning.category)
        err.add_note(f"in stage {stage.key(unit)}")
        raise
    products = {product: context.products.describe(product) for product in context.saved}
    warned = [(warning.category, str(warning.message)) for warning in caught]
    return products, time.perf_counter() - begin, warned
