import json
import shutil
import threading
import types
import warnings
from concurrent.futures import BrokenExecutor, Executor, ThreadPoolExecutor

import pytest

from helpers.errors import refuses
from miricigale.refdata import locate
from miricigale.utils.exceptions import ConfigError, DataError, MiricigaleWarning, OtherResultsError
from miricigale.workflow.config import StudyConfig, load_config
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import Stage, Units
from miricigale.workflow.engine.store import ProductStore
from miricigale.workflow.stage_list import study_stages


def write(context, unit):
    """A stage that writes its unit."""
    name = unit or "all"
    context.save(f"{name}.txt", lambda path: path.write_text(name))


def run_stages(folder, *stages, config=None, **options):
    return StudyRunner(config or StudyConfig(), folder, stages, **options).run()


def run_side_by_side(folder, *stages, threads, pool=ThreadPoolExecutor, **run):
    """Run stages in some threads at once."""
    config = StudyConfig.from_dict({"run": {"threads": threads, **run}})
    with pool(4) as executor:
        return run_stages(folder, *stages, config=config, executor=executor)


@pytest.fixture
def folder(tmp_path):
    return tmp_path / "run"


class Recorder:
    """Two stages that write text and note that they ran."""

    def __init__(self, fail_at=None):
        self.ran = []
        self.fail_at = fail_at

    def first(self, context, unit):
        self.ran.append(f"first:{unit}")
        if self.fail_at == unit:
            raise KeyboardInterrupt
        context.save(f"first_{unit}.txt", lambda path: path.write_text(f"{context.seed} {unit}"))

    def second(self, context, unit):
        self.ran.append("second")
        text = "".join(context.path(f"first_{k}.txt").read_text() for k in "ab")
        context.save("second.txt", lambda path: path.write_text(text))

    def stages(self, version=1):
        parts = {"sections": ("scene",), "units": lambda _: "ab", "version": version}
        first = Stage("first", self.first, "first", **parts)
        return first, Stage("second", self.second, "second", needs=("first",))

    def run(self, folder, config=None, *, version=1, **options):
        self.ran.clear()
        run_stages(folder, *self.stages(version), config=config, **options)
        return list(self.ran)


@pytest.fixture
def recorder(folder):
    """The recorder of a run that is finished."""
    recorder = Recorder()
    assert recorder.run(folder) == ["first:a", "first:b", "second"]
    return recorder


def test_an_interrupted_run_goes_on_where_it_was(folder):
    recorder = Recorder(fail_at="b")
    with pytest.raises(KeyboardInterrupt):
        recorder.run(folder)
    recorder.fail_at = None
    assert recorder.run(folder) == ["first:b", "second"]
    assert not (folder / "run.lock").exists()
    assert recorder.run(folder) == []
    # also while what was lost is made again
    (folder / "first_b.txt").unlink()
    recorder.fail_at = "b"
    with pytest.raises(KeyboardInterrupt):
        recorder.run(folder)
    recorder.fail_at = None
    assert recorder.run(folder) == ["first:b"]


@pytest.mark.filterwarnings("default")
def test_a_fact_is_warned_of_once_a_run_and_kept_for_each_unit(folder, caplog):
    def warn(context, unit):
        warnings.warn(f"3 sources are faint in {unit!r}", MiricigaleWarning, stacklevel=2)
        if unit == "b":
            warnings.warn("the field is crowded", MiricigaleWarning, stacklevel=2)

    with pytest.warns(MiricigaleWarning) as caught:
        store = run_stages(folder, Stage("one", warn, "one", units=lambda _: "abc"))
    texts = ["3 sources are faint in 'a'", "the field is crowded"]
    assert [str(one.message) for one in caught] == texts
    assert "2 more such warnings of other units" in caplog.text
    assert store.records["one:b"]["warnings"] == ["3 sources are faint in 'b'", texts[1]]

    # those before an error too
    def fail(context, unit):
        warn(context, "b")
        raise ValueError("no sources")

    with pytest.warns(MiricigaleWarning, match="crowded"):
        refuses("no sources", run_stages, folder, Stage("two", fail, "two"), redo=True)


def test_only_what_depends_on_a_change_is_done_again(folder, recorder):
    def run(values, **options):
        return recorder.run(folder, StudyConfig.from_dict(values), **options)

    assert run({"fit": {"model_error": 0.2}}) == []
    # the second stage's input did not change although the first was done again
    changed = {"scene": {"background_scale": 2.0}}
    assert run(changed, redo=True) == ["first:a", "first:b"]
    seed = {"run": {"seed": 7}}
    assert run(seed, redo=True) == ["first:a", "first:b", "second"]
    assert run(seed, redo=True, version=2) == ["first:a", "first:b"]


@pytest.mark.parametrize(
    ("values", "version", "reason"),
    [
        ({"run": {"seed": 7}}, 1, r"\[run\] seed: 20210211 -> 7"),
        ({"scene": {"background_scale": 2.0}}, 1, r"\[scene\] background_scale: 1.0 -> 2.0"),
        ({}, 2, "by another version of the package, its data or the catalog"),
    ],
)
def test_nothing_is_done_again_unasked(folder, recorder, values, version, reason):
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    call = {"config": StudyConfig.from_dict(values), "version": version}
    text = rf"3 finished steps.*{reason}.*first \(2\), second; "
    refuses(text, recorder.run, folder, error=OtherResultsError, **call)
    assert recorder.ran == []
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    assert recorder.run(folder, **call, redo=True)[:2] == ["first:a", "first:b"]


def test_an_edited_configuration_is_not_overwritten(folder, recorder):
    path = folder / "config.toml"
    edited = path.read_text().replace("min_detected = 2", "min_detected = 3 # mine")
    path.write_text(edited)
    refuses(r"config\.toml was edited since", recorder.run, folder, error=OtherResultsError)
    # whatever else there is to say
    other = StudyConfig.from_dict({"run": {"seed": 7}})
    text = r"was edited since.*3 finished steps"
    refuses(text, recorder.run, folder, other, error=OtherResultsError)
    assert path.read_text() == edited
    # nor is what was kept the first time
    for name, text in (("edited", edited), ("edited2", edited.replace("mine", "mine again"))):
        path.write_text(text)
        recorder.run(folder, redo=True)
        assert (folder / f"config.{name}.toml").read_text() == text
        assert load_config(path) == StudyConfig()
    assert (folder / "config.edited.toml").read_text() == edited
    # it is used when it is asked for, and stays as it was written
    path.write_text(edited)
    assert recorder.run(folder, load_config(path)) == []
    assert path.read_text() == edited


def test_a_configuration_of_which_the_manifest_says_nothing_is_kept(folder, recorder):
    stages = json.loads((folder / "manifest.json").read_text())["stages"]

    def forget():
        # as an earlier version wrote it
        (folder / "manifest.json").write_text(json.dumps({"stages": stages}))
        (folder / ".manifest.copy.json").unlink()

    forget()
    assert recorder.run(folder) == []
    forget()
    before = (folder / "config.toml").read_text()
    other = StudyConfig.from_dict({"fit": {"model_error": 0.2}})
    text = r"edited since .*or that run was of an earlier"
    refuses(text, recorder.run, folder, other, error=OtherResultsError)
    assert recorder.run(folder, other, redo=True) == []
    assert (folder / "config.edited.toml").read_text() == before


@pytest.mark.parametrize("values", [{}, {"threads": 1}, {"memory": 0.5}])
def test_a_finished_run_writes_nothing(folder, recorder, monkeypatch, values):
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    # not even a lock: the disk may be full, the folder read-only
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=0))
    monkeypatch.setattr(ProductStore, "__enter__", None)
    config = StudyConfig.from_dict({"run": values})
    recorder.run(folder, config, disk={"first": 10**12})
    assert {p.name: p.stat().st_mtime_ns for p in folder.iterdir()} == before


def test_what_stands_needs_no_disk_again(folder, recorder, monkeypatch):
    (folder / "second.txt").unlink()
    # what a unit wrote before it was stopped is replaced, so that it needs no more either
    (folder / "part").mkdir()
    (folder / "part" / "of_second.txt").write_text("x" * 20_000)
    size = sum(path.stat().st_size for path in folder.rglob("*.*") if path.is_file())
    assert size > 20_000
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=9_000))
    disk = {"first": size, "second": 10_000}
    refuses("the run needs about", recorder.run, folder, error=DataError, disk=disk)
    assert recorder.run(folder, disk={"first": size, "second": 9_000}) == ["second"]


def test_of_a_part_of_the_steps_the_disk_of_that_part_counts(folder, monkeypatch, capsys):
    recorder = Recorder()
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=15_000_000))
    options = {"disk": {"first": 20_000_000, "second": 5_000_000, "no stage": 10**12}}
    assert recorder.run(folder, until="first:a", progress_bar=True, **options) == ["first:a"]
    text = capsys.readouterr().err
    assert "1 of 1 steps to do, which take about 0.01 GB" in text
    assert "(0.0 GB are free)" in text
    message = r"needs about 0.02 GB in .*, only 0.0\d GB are free; free some space, choose another"
    refuses(message, recorder.run, folder, error=DataError, **options)
    assert recorder.ran == []


@pytest.mark.parametrize("name", ["first_a.txt", "first_b.txt", "second.txt"])
def test_a_deleted_product_makes_only_itself_anew(folder, recorder, name):
    (folder / name).unlink()
    assert recorder.run(folder) == [name.removesuffix(".txt").replace("_", ":")]


def test_a_change_of_the_packages_own_plan_is_seen(folder):
    ran = []

    def function(context, _):
        ran.append(context.plan)

    for groups in (200, 200, 100):
        plan = {"plan": lambda _, __, n=groups: {"n_groups": n}}
        run_stages(folder, Stage("one", function, "one", **plan), redo=True)
    assert ran == [{"n_groups": 200}, {"n_groups": 100}]


def test_other_reference_data_make_other_exposures(tmp_path, monkeypatch):
    # what residual = "etc" means stands in a file, not in the configuration
    nothing = types.SimpleNamespace(checksums=lambda name: {})

    def digests():
        stages = [s for s in study_stages() if s.name in ("exposures", "points", "kernels")]
        runner = StudyRunner(StudyConfig(), tmp_path / "run", study_stages())
        keys = {stage.name: stage.key(stage.units(runner.config)[0]) for stage in stages}
        return {name: runner.digest(key, nothing) for name, key in keys.items()}

    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    before = digests()
    text = locate("instrument.etc").read_text()
    other = tmp_path / "data" / "instrument" / "etc.toml"
    other.parent.mkdir(parents=True)
    other.write_text(text.replace("f770w = ", "f770w = 2.0  # "))
    monkeypatch.setenv("MIRICIGALE_DATA", str(tmp_path / "data"))
    with pytest.warns(MiricigaleWarning, match="differs from the bundled file"):
        after = digests()
    changed = {name for name in before if after[name] != before[name]}
    assert changed == {"exposures", "points"}


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (None, "missing"),
        (lambda data: data[:-3], "7 bytes in place of 10"),
        (lambda data: bytes([data[0] ^ 4]) + data[1:], "another content than was written"),
        (lambda data: b"my own note", "11 bytes in place of 10"),
    ],
    ids=["removed", "truncated", "flipped", "edited"],
)
def test_a_damaged_product_is_named_and_made_again(folder, recorder, caplog, damage, text):
    path = folder / "first_a.txt"
    whole = path.read_bytes()
    assert len(whole) == 10
    path.unlink() if damage is None else path.write_bytes(damage(whole))
    assert recorder.run(folder) == ["first:a"]
    assert path.read_bytes() == whole
    (message,) = [line for line in caplog.messages if "first_a.txt" in line]
    assert f"first_a.txt ({text})" in message
    assert "is done again, with the same bytes" in message
    # of many products some are named
    caplog.clear()
    with ProductStore(folder) as store:
        for k in range(9):
            store.save(f"{k}.txt", lambda path: path.write_text("x"))
        names = [f"{k}.txt" for k in range(9)]
        record = store.records["second"]
        record["products"] |= {name: store.describe(name) for name in names}
        store.write_manifest()
    for name in names:
        (folder / name).unlink()
    recorder.run(folder)
    assert any("4.txt (missing) and 4 more" in line for line in caplog.messages)


def test_products_that_no_longer_belong_are_removed(folder):
    stages = [Stage("one", write, "one", units=lambda _, u=units: u) for units in ("ab", "a")]
    run_stages(folder, stages[0])
    text = "1 finished steps of another run"
    refuses(text, run_stages, folder, stages[1], error=OtherResultsError)
    assert (folder / "b.txt").exists()
    run_stages(folder, stages[1], redo=True)
    assert (folder / "a.txt").exists()
    assert not (folder / "b.txt").exists()


def test_a_stage_that_reads_what_it_has_not_declared_is_an_error(folder):
    for read, error, message in (
        (lambda config: config.scene, RuntimeError, r"'one' reads \[scene\] without declaring"),
        (lambda config: config.run.keep_level1b, AttributeError, "keep_level1b"),
    ):
        stage = Stage("one", lambda c, _, f=read: f(c.config), "one", sections=("run.name",))
        refuses(message, run_stages, folder, stage, error=error)


def test_a_product_of_a_stage_that_is_not_declared_cannot_be_read(folder):
    def read(context, _):
        text = "".join(context.path(f"{unit}.txt").read_text() for unit in "ab")
        context.save("sum.txt", lambda path: path.write_text(text))

    first = Stage("first", write, "first", units=lambda _: "ab")
    between = Stage("between", lambda context, _: None, "between", needs=("first",))
    text = r"stage 'last' reads 'a\.txt' without declaring"
    for needs in ((), ("between",)):
        last = Stage("last", read, "last", needs=needs)
        refuses(text, run_stages, folder, first, between, last, error=RuntimeError)
    run_stages(folder, first, Stage("last", read, "last", needs=("first",)), redo=True)
    assert (folder / "sum.txt").read_text() == "ab"


@pytest.mark.parametrize(
    ("first", "known", "others"),
    [
        ("sky/band", True, ("sky/band", "sky", "band", "sky/band-1", "")),
        ("sky/band", False, ("sky/other", "other", "sky/band2-1")),
        ("sky", False, ("sky+psf", "band")),
    ],
)
def test_units_belong_together_by_the_parts_of_their_names(first, known, others):
    wanted = list(others) if known else []
    assert Units(others).related(first) == wanted
    for second in others:
        assert Units([first]).related(second) == ([first] if known else []), second


def test_a_unit_depends_on_the_units_that_it_reads_only(folder):
    ran, texts = [], {"a": "1", "b": "1"}

    def first(context, unit):
        ran.append(f"first:{unit}")
        context.save(f"{unit}/first.txt", lambda path: path.write_text(context.plan))

    def second(context, unit):
        ran.append(f"second:{unit}")
        text = context.path(f"{unit}/first.txt").read_text()
        context.save(f"{unit}/second.txt", lambda path: path.write_text(text))
        other = {"a": "b", "b": "a"}[unit]
        refuses("without declaring", context.path, f"{other}/first.txt", error=RuntimeError)

    def run(units):
        ran.clear()
        options = {"units": lambda _: units, "plan": lambda _, unit: texts[unit]}
        one = Stage("first", first, "first", **options)
        two = Stage("second", second, "second", needs=("first",), units=options["units"])
        run_stages(folder, one, two, redo=True)
        return sorted(ran)

    assert run("a") == ["first:a", "second:a"]
    # a further unit leaves what stands
    assert run("ab") == ["first:b", "second:b"]
    texts["b"] = "2"
    assert run("ab") == ["first:b", "second:b"]
    assert run("ab") == []


def test_a_part_of_the_stages_and_units(folder):
    ran = []

    def make(context, unit):
        ran.append(unit or "all")
        write(context, unit)

    stages = (
        Stage("first", make, "first", units=lambda _: ("a/1", "b/1", "c/2")),
        Stage("second", make, "second", units=lambda _: ("a", "b"), needs=("first",)),
        Stage("third", make, "third", needs=("second",)),
    )

    def run(**options):
        ran.clear()
        run_stages(folder, *stages, **options)
        return list(ran)

    assert run(until="second:b") == ["b/1", "b"]
    # what is left out is not taken for another run's
    assert run(until="first") == ["a/1", "c/2"]
    assert run() == ["a", "all"]
    assert run(until="first:[bc]/*", again="first") == ["b/1", "c/2"]
    # the same bytes: what follows stands
    assert run(again="first:a/*") == ["a/1"]
    assert run() == []
    wanted = "'until' is 'fourth', which is no stage and matches no unit .*; stages: first, second, third;"
    refuses(wanted, run, error=ConfigError, until="fourth")
    wanted = "nothing of 'again', 'second', is among what 'until', 'first', needs"
    refuses(wanted, run, error=ConfigError, until="first", again="second")
    # stages must come after what they need
    refuses("stage 'second' needs", run_stages, folder, *stages[1:], error=ConfigError)


@pytest.mark.parametrize(
    ("threads", "memory", "each", "most"),
    # the last units are larger than the memory
    [(3, 4.0, 1.0, 3), (3, 2.5, 1.0, 2), (1, 4.0, 1.0, 1), (3, 1.0, 10.0, 1)],
)
def test_units_run_side_by_side_within_threads_and_memory(folder, threads, memory, each, most):
    state = types.SimpleNamespace(now=0, most=0, order=[])
    lock = threading.Lock()

    def work(context, unit):
        with lock:
            state.now += 1
            state.most = max(state.most, state.now)
            state.order.append(unit[:1])
        threading.Event().wait(0.1)
        write(context, unit)
        with lock:
            state.now -= 1

    def stage(name, needs=()):
        units, size = [f"{name}{k}" for k in range(4)], 1e9 * each
        parts = {"units": lambda _: units, "memory": lambda _, __: size}
        return Stage(name, work, name, needs=needs, **parts)

    between = Stage("between", lambda *_: None, "between", needs=("a",))
    stages = (stage("a"), between, stage("b", ("between",)), stage("c"))
    store = run_side_by_side(folder, *stages, threads=threads, memory=memory)
    assert state.most == most
    assert len(store.records) == 13
    # b waits for all of a; c for nobody
    last_a = max(k for k, letter in enumerate(state.order) if letter == "a")
    assert state.order.index("b") > last_a


def test_what_runs_beside_a_unit_that_fails_is_kept(folder):
    begun = threading.Event()

    def work(context, unit):
        if unit == "bad":
            begun.wait(5)
            msg = "no such light"
            raise ValueError(msg)
        begun.set()
        threading.Event().wait(0.1)
        write(context, unit)

    stage = Stage("one", work, "one", units=lambda _: ("bad", "good", "late"))
    with pytest.raises(ValueError, match="no such light") as err:
        run_side_by_side(folder, stage, threads=2)
    assert "in stage one:bad" in err.value.__notes__
    assert set(ProductStore(folder).records) == {"one:good"}


def test_the_first_of_several_errors_is_raised(folder):
    both, failed = threading.Barrier(2), threading.Event()

    def work(context, unit):
        both.wait(5)
        if unit == "second":
            failed.wait(5)
        raise ValueError(unit)

    stage = Stage("one", work, "one", units=lambda _: ("first", "second"))

    class Submits(ThreadPoolExecutor):
        def submit(self, function, *args, **kwargs):
            future = super().submit(function, *args, **kwargs)
            if args[4] == "first":
                # when its end has been seen
                future.add_done_callback(lambda _: threading.Timer(0.2, failed.set).start())
            return future

    refuses("first", run_side_by_side, folder, stage, threads=2, pool=Submits)


def test_a_process_that_died_before_a_unit_began_is_text(folder):
    class Broken(Executor):
        def submit(self, *_, **__):
            raise BrokenExecutor

    stage, text = Stage("one", None, "one"), "a process ended during one"
    refuses(text, run_stages, folder, stage, error=DataError, executor=Broken())


def test_what_prepares_a_run_comes_before_its_first_unit(folder):
    order = []
    stage = Stage("one", lambda *_: order.append("one"), "one")
    config = StudyConfig.from_dict({"run": {"threads": 3}})
    for _ in range(2):
        # a finished run prepares nothing
        run_stages(folder, stage, config=config, prepare=order.append)
        assert order == [3, "one"]
