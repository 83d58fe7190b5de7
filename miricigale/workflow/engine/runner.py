"""Runs the stages, side by side where they can be; what stands already and is current is kept."""

import collections
import dataclasses
import fnmatch
import functools
import hashlib
import itertools
import json
import logging
import os
import warnings
from pathlib import Path

from miricigale.refdata.lookup import fingerprint
from miricigale.utils.exceptions import ConfigError, MiricigaleWarning, OtherResultsError
from miricigale.utils.named_values import convert_values
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.parallel import available_memory, thread_count
from miricigale.utils.progress import print_line
from miricigale.workflow.engine.display import Display
from miricigale.workflow.engine.schedule import Task, local_place, run_tasks
from miricigale.workflow.engine.stage import Units, run_unit
from miricigale.workflow.engine.store import CONFIG, ProductStore, check_disk
from miricigale.workflow.options import read_text

log = logging.getLogger(__name__)

#: Bytes that a process takes for a unit whose stage does not say how many: measured, of a field
#: of one pointing.
_MEMORY = 1_200_000_000
_REMEDY = "redo=True to replace it"
#: Damaged products that are named in a message.
_NAMED = 5


@takes_other_keywords
class StudyRunner:
    """
    Runs a study in a folder.

    Parameters
    ----------
    config : `~miricigale.workflow.config.StudyConfig`
        The configuration.
    folder : path-like
        Where the products go.
    stages : callable or tuple of `~miricigale.workflow.engine.stage.Stage`
        In an order in which every stage comes after what it needs, or a function that returns
        them, which executors of processes need.
    executor : `concurrent.futures.Executor` or `~miricigale.workflow.engine.cluster.Cluster`, optional
        Does units that do not need each other side by side, as many at once as there are
        threads and as the memory allows. Without it they are done one by one, each on all
        threads. The products are the same bytes either way.
    redo : bool, optional
        Whether products of another configuration are replaced; otherwise they are refused.
    until : str, optional
        A stage, or a pattern of units such as ``"fits:agn20/*"``: only these and what they need is
        done; all by default.
    again : str, optional
        A stage, or a pattern of units, that is done again (or for the first time, what is not done
        yet); what needs it follows if its products change.
    disk : dict of str to int, optional
        By stage: bytes that its products take, all units together.
    prepare : callable, optional
        Called with the number of threads before the first unit is done, such as to compile.
    progress_bar : bool, optional
        Whether progress is shown: a bar on a terminal, otherwise a line for each stage.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If a stage comes before what it needs, ``until`` or ``again`` match nothing, or nothing that is
        asked for again is among what is done.

    Examples
    --------
    >>> from miricigale.workflow import StudyRunner, load_config, study_stages  # doctest: +SKIP
    >>> runner = StudyRunner(load_config("goodss", quick=True), "study", study_stages)  # doctest: +SKIP
    >>> store = runner.run()  # doctest: +SKIP
    """

    def __init__(
        self,
        config,
        folder,
        stages,
        *,
        executor=None,
        redo=False,
        until=None,
        again=None,
        disk=None,
        prepare=None,
        progress_bar=False,
    ):
        # other runs have configurations of their own
        wanted = "a StudyConfig (load_config('goodss', quick=True) makes one)"
        check_that(hasattr(config, "run"), "config", wanted, type(config).__name__)
        self.config = config
        self.folder = Path(folder)
        if callable(stages):
            self._source = stages
            stages = stages()
        else:
            stages = tuple(stages)
            self._source = stages
        self.stages = tuple(stages)
        self.executor = executor
        self.redo = redo
        self.disk = dict(disk or {})
        self.prepare = prepare
        self.progress_bar = progress_bar
        self.n_threads = thread_count(config.run.threads or None)
        self._list_units()
        chosen = self._chosen(until)
        self.keys = [key for key in self._parts if key in chosen]
        self._again = set()
        if again is not None:
            self._again = self._matching(again, "again") & chosen
            if not self._again:
                msg = f"nothing of 'again', {again!r}, is among what 'until', {until!r}, needs"
                raise ConfigError(msg)

    def __repr__(self):
        return f"<StudyRunner of {len(self.stages)} stages in {self.folder}>"

    def _list_units(self):
        """List the units of all stages, and those that each of them reads."""
        self.units = {}
        # stage and name of each unit, by key
        self._parts = {}
        for stage in self.stages:
            missing = set(stage.needs) - set(self.units)
            if missing:
                msg = f"stage {stage.name!r} needs {sorted(missing)}, which do not come before it"
                raise ConfigError(msg)
            self.units[stage.name] = stage.unit_names(self.config)
            for unit in self.units[stage.name]:
                self._parts[stage.key(unit)] = (stage, unit)
        names = convert_values(Units, self.units)
        # by unit and stage: keys of the units that it reads
        self._inputs = {}
        self._needed = {}
        for key, (stage, unit) in self._parts.items():
            inputs = stage.needed(self.config, unit, names)
            self._inputs[key] = inputs
            self._needed[key] = frozenset(itertools.chain.from_iterable(inputs.values()))

    def _chosen(self, until):
        """Return keys of the units of a stage or pattern and of all that they need, of every unit if None."""
        if until is None:
            return set(self._parts)
        chosen = self._matching(until, "until")
        # a unit comes after those that it needs
        for key in reversed(self._parts):
            if key in chosen:
                chosen |= self._needed[key]
        return chosen

    def _matching(self, pattern, argument):
        """Return keys of units by stage or pattern."""
        keys = set()
        for key, (stage, _) in self._parts.items():
            if stage.name == pattern or fnmatch.fnmatchcase(key, pattern):
                keys.add(key)
        if not keys:
            msg = (
                f"'{argument}' is {pattern!r}, which is no stage and matches no unit of this configuration; "
                f"stages: {', '.join(self.units)}; a unit: {next(reversed(self._parts))}"
            )
            raise ConfigError(msg)
        return keys

    def digest(self, key, store):
        """
        Hash of everything that a stage's products depend on.

        That is its own version, its sections of the configuration (and the seed), the
        checksums of the products it reads and of its reference data.
        """
        stage, unit = self._parts[key]
        if callable(stage.resources):
            resources = stage.resources()
        else:
            resources = stage.resources
        values = {
            "stage": stage.name,
            "unit": unit,
            "version": stage.version,
            "seed": self.config.run.seed,
            "config": self.config.values(*stage.sections),
            "inputs": {name: store.checksums(keys) for name, keys in self._inputs[key].items()},
            "data": {name: fingerprint(name) for name in resources},
        }
        if stage.plan is not None:
            values["plan"] = stage.plan(self.config, unit)
        text = json.dumps(values, sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()

    def forecast(self, store):
        """
        Return what a run would do.

        Parameters
        ----------
        store : `~miricigale.workflow.engine.store.ProductStore`
            The folder.

        Returns
        -------
        states : dict of str to str
            By key: ``"current"``; ``"new"``; ``"again"``, if it was asked for; ``"lost"``, if products are
            missing or damaged;
            ``"changed"``, if they were made otherwise than this run would make them; or
            ``"surplus"``, if this run has no such unit.
        """
        states = {}
        moved = set()
        for key in self.keys:
            record = store.records.get(key)
            if record is None:
                state = "new"
            elif key in self._again:
                state = "again"
            elif moved & self._needed[key] or record["hash"] != self.digest(key, store):
                state = "changed"
            else:
                # making them again gives the same bytes, so that dependent stages stay current
                state = "lost"
                if store.is_whole(key):
                    state = "current"
            states[key] = state
            if state in ("new", "changed"):
                moved.add(key)
        return states | {key: "surplus" for key in store.records if key not in self._parts}

    def run(self):
        """
        Do what is not done yet.

        Returns
        -------
        store : `~miricigale.workflow.engine.store.ProductStore`

        Raises
        ------
        `~miricigale.utils.exceptions.OtherResultsError`
            If products of another configuration would be replaced, or an edited
            ``config.toml``, and ``redo`` is False.
        `~miricigale.utils.exceptions.DataError`
            If the folder is another's, in use, or on a disk that is too full.
        KeyboardInterrupt
            Passed on; everything that was finished stays and is not done again.
        """
        store = ProductStore(self.folder)
        states = self.forecast(store)
        if store.is_sound and set(states.values()) <= {"current"} and self._config_stands(store):
            # nothing is written: a finished run can be called on a full or read-only disk
            self._tell(f"{self.config.run.name}: all {len(self.keys)} steps stand")
            return store
        with store:
            states = self.forecast(store)
            self._refuse_replacing(store, states)
            self._warn_of_faults(store, states)
            self._warn_of_new_keys(store)
            n_left = sum(states[key] != "current" for key in self.keys)
            if n_left:
                needed = max(0, self._products_bytes() - store.standing_bytes())
                n_free = check_disk(self.folder, needed)
                self._tell(
                    f"{self.config.run.name}: {n_left} of {len(self.keys)} steps to do, which take "
                    f"about {needed / 1e9:.2f} GB in {self.folder}/ ({n_free / 1e9:.1f} GB are free)"
                )
            self._write_config(store)
            for key, state in states.items():
                if state in ("surplus", "again"):
                    store.drop(key)
            if n_left and self.prepare is not None:
                self.prepare(self.n_threads)
            self._execute(store)
        return store

    def _products_bytes(self):
        """Return about how many bytes the products take of the units that this run has."""
        n_units = collections.Counter(self._parts[key][0].name for key in self.keys)
        total = 0
        for name, n in n_units.items():
            total += self.disk.get(name, 0) * n / len(self.units[name])
        return int(total)

    def _config_stands(self, store):
        """Tell whether manifest and ``config.toml`` say what this run does."""
        values = _values(self.config)
        return store.config == values == self._values_of(store.path(CONFIG))

    def _values_of(self, path):
        """Return plain values of a configuration file; none where it is missing or cannot be read."""
        try:
            return self._read_values(path)
        except (ConfigError, OSError, ValueError):
            return {}

    def _read_values(self, path):
        """Return plain values of a configuration; keys of earlier versions are warned of where users read it."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MiricigaleWarning)
            return _values(self.config.from_texts([(str(path), read_text(path))]))

    def _unreadable(self, path):
        """Return why this version does not take a configuration, in words; empty if it does."""
        try:
            self._read_values(path)
        except (ConfigError, OSError, ValueError) as err:
            return str(err)
        return ""

    def _edited_config(self, store):
        """Return the path of a ``config.toml`` that is of neither this run nor the last one, or None."""
        path = store.path(CONFIG)
        if not path.is_file():
            return None
        if self._values_of(path) in (store.config, _values(self.config)):
            return None
        return path

    def _refuse_replacing(self, store, states):
        if self.redo:
            return
        reasons = []
        if edited := self._edited_config(store):
            advice = "run"
            if fault := self._unreadable(edited):
                advice = f"change it where it says {fault}, and run"
            reasons.append(
                f"{edited} was edited since the run that made this folder (or that run was of an "
                f"earlier version), and this run has another configuration, which would replace it: "
                f"{advice} {edited} itself to use it"
            )
        outdated = [key for key, state in states.items() if state in ("changed", "surplus")]
        if outdated:
            reasons.append(
                f"{self.folder} holds {len(outdated)} finished steps of another run ({self._differences(store)}), "
                f"which would be done again or removed: {_summary(outdated)}"
            )
        if reasons:
            raise OtherResultsError("; ".join(reasons), _REMEDY)

    def _warn_of_faults(self, store, states):
        """Name products that are missing or damaged, and are made again."""
        faults = {}
        for key, state in states.items():
            if state == "lost":
                faults |= store.faults(key)
        if faults:
            names = [f"{name} ({fault})" for name, fault in faults.items()]
            text = ", ".join(names[:_NAMED])
            if len(names) > _NAMED:
                text += f" and {len(names) - _NAMED} more"
            log.warning(
                "%s: %s; what made them is done again, with the same bytes (keep copies of what "
                "you edit elsewhere)",
                self.folder,
                text,
            )

    def _changed_keys(self, store):
        """Yield name, value and value in the folder's configuration (None without) of keys that differ."""
        if not store.config:
            return
        for section, values in _values(self.config).items():
            values_before = store.config.get(section, {})
            for key, value in values.items():
                before = values_before.get(key)
                if before != value:
                    yield f"[{section}] {key}", value, before

    def _warn_of_new_keys(self, store):
        """Name keys that the version which made the folder did not have, and their values in this run."""
        added = []
        for name, value, before in self._changed_keys(store):
            if before is None:
                added.append(f"{name} = {_short(value)}")
        if added:
            log.warning(
                "%s was made by a version without %s: what is made now has these values",
                self.folder,
                ", ".join(added),
            )

    def _differences(self, store):
        """Return what is other in the configuration than in that of the folder, in words."""
        changes = []
        for name, value, before in self._changed_keys(store):
            changes.append(f"{name}: {_short(before)} -> {_short(value)}")
        if changes:
            return "; ".join(changes)
        return "by another version of the package, its data or the catalog, or before a redo that was stopped"

    def _write_config(self, store):
        if self._config_stands(store):
            return
        if edited := self._edited_config(store):
            copy = _unused_name(edited)
            os.replace(edited, copy)
            log.warning("the edited %s is kept as %s", edited, copy.name)
        values = _values(self.config)
        store.facts["config"] = values
        if self._values_of(store.path(CONFIG)) != values:
            store.save(CONFIG, lambda path: path.write_text(self.config.to_toml(), "utf-8"))
        store.write_manifest()

    def _tell(self, text):
        if self.progress_bar:
            print_line(text)

    def _execute(self, store):
        """Do all units, each when what it needs is done."""
        limits = self.config.run
        places = getattr(self.executor, "places", None)
        n_threads = self.n_threads
        if places is None:
            memory = limits.memory * 1e9 or 0.5 * available_memory()
            places = functools.partial(dict, local_place(self.executor, n_threads, memory))
        elif not limits.threads:
            n_threads = sum(place.slots for place in places().values())
        with Display(self.progress_bar, self.units, self.keys) as display:
            tasks = [self._task(key, store, display) for key in self.keys]
            wait_for = getattr(self.executor, "wait_for", None)
            run_tasks(
                tasks, places=places, n_threads=n_threads, wait_for=wait_for, report=display.begin
            )

    def _task(self, key, store, display):
        stage, unit = self._parts[key]
        needed = self._needed[key]
        memory = _MEMORY
        if stage.memory is not None:
            memory = stage.memory(self.config, unit)
        inline = self.executor is None
        digest = None

        def begin(submit, n_threads):
            nonlocal digest
            digest = self.digest(key, store)
            if store.is_current(key, digest):
                display.finish(stage, 0.0)
                return None
            if store.records.get(key, {}).get("hash") != digest:
                store.drop(key)
            return submit(
                run_unit,
                self.config,
                # workers elsewhere have another working directory
                self.folder.absolute(),
                self._source,
                stage.name,
                unit,
                inputs=list(store.checksums(needed)),
                n_threads=n_threads,
                progress_bar=display.is_bar and inline,
            )

        def finish(result):
            products, seconds, warned = result
            notes = {}
            if warned:
                notes = {"warnings": [text for _, text in warned]}
            store.finish(key, digest, products, seconds=round(seconds, 2), **notes)
            for category, text in warned:
                display.warn(category, text)
            log.debug("%s took %.1f s", key, seconds)
            display.finish(stage, seconds)

        return Task(
            key,
            f"{stage.title} {unit}".strip(),
            begin,
            finish,
            needs=needed,
            memory=memory,
        )


def _values(config):
    """Return plain values of what products may depend on."""
    values = json.loads(json.dumps(dataclasses.asdict(config)))
    # threads and memory do not change products
    del values["run"]["threads"], values["run"]["memory"]
    return values


def _unused_name(path):
    """Return the first of ``config.edited.toml``, ``config.edited2.toml``, ... that is not there."""
    for n in itertools.count(1):
        number = ""
        if n > 1:
            number = n
        copy = path.with_name(f"config.edited{number}.toml")
        if not os.path.lexists(copy):
            return copy


def _summary(keys):
    """Return stages in words, with the number of units where there are several."""
    counts = collections.Counter(key.split(":")[0] for key in keys)
    return ", ".join(f"{name} ({n})" if n > 1 else name for name, n in counts.items())


def _short(value):
    text = json.dumps(value)
    if len(text) <= 60:
        return text
    return f"{text[:57]}..."
