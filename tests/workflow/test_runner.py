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
from miricigale.workflow.engine import runner
from miricigale.workflow.engine.runner import StudyRunner, check_disk
from miricigale.workflow.engine.stage import Stage, stage
from miricigale.workflow.engine.store import ProductStore
from miricigale.workflow.stages import study_stages


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
        return (
            Stage(
                "first",
                self.first,
                "first",
                sections=("scene",),
                units=lambda _: "ab",
                version=version,
            ),
            Stage("second", self.second, "second", needs=("first",)),
        )

    def run(self, folder, config=None, *, redo=False, **kwargs):
        self.ran.clear()
        StudyRunner(config or StudyConfig(), folder, self.stages(**kwargs), redo=redo).run()
        return list(self.ran)


def test_a_second_run_does_nothing(tmp_path):
    recorder = Recorder()
    assert recorder.run(tmp_path / "run") == ["first:a", "first:b", "second"]
    assert recorder.run(tmp_path / "run") == []


def test_an_interrupted_run_goes_on_where_it_was(tmp_path):
    recorder = Recorder(fail_at="b")
    with pytest.raises(KeyboardInterrupt):
        recorder.run(tmp_path / "run")
    recorder.fail_at = None
    assert recorder.run(tmp_path / "run") == ["first:b", "second"]
    assert not (tmp_path / "run" / "run.lock").exists()


@pytest.mark.filterwarnings("default")
def test_a_fact_is_warned_of_once_a_run_and_kept_for_each_unit(tmp_path, caplog):
    def warn(context, unit):
        warnings.warn(f"3 sources are faint in {unit!r}", MiricigaleWarning, stacklevel=2)
        if unit == "b":
            warnings.warn("the field is crowded", MiricigaleWarning, stacklevel=2)

    stages = (Stage("one", warn, "one", units=lambda _: "abc"),)
    with pytest.warns(MiricigaleWarning) as caught:
        store = StudyRunner(StudyConfig(), tmp_path / "run", stages).run()
    texts = ["3 sources are faint in 'a'", "the field is crowded"]
    assert [str(one.message) for one in caught] == texts
    assert "2 more such warnings of other units" in caplog.text
    assert store.records["one:b"]["warnings"] == ["3 sources are faint in 'b'", texts[1]]


@pytest.mark.filterwarnings("default")
def test_warnings_before_an_error_are_shown(tmp_path):
    def fail(context, unit):
        warnings.warn("the field is crowded", MiricigaleWarning, stacklevel=2)
        raise ValueError("no sources")

    run = StudyRunner(StudyConfig(), tmp_path / "run", (Stage("one", fail, "one"),)).run
    with pytest.warns(MiricigaleWarning, match="crowded"), pytest.raises(ValueError, match="no so"):
        run()


def test_only_what_depends_on_a_change_is_done_again(tmp_path):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    other = StudyConfig.from_dict({"fit": {"model_error": 0.2}})
    assert recorder.run(tmp_path / "run", other) == []
    # the second stage's input did not change although the first was done again
    other = StudyConfig.from_dict({"scene": {"background_scale": 2.0}})
    assert recorder.run(tmp_path / "run", other, redo=True) == ["first:a", "first:b"]
    other = StudyConfig.from_dict({"run": {"seed": 7}})
    assert recorder.run(tmp_path / "run", other, redo=True) == ["first:a", "first:b", "second"]
    assert recorder.run(tmp_path / "run", other, redo=True, version=2) == ["first:a", "first:b"]


@pytest.mark.parametrize(
    ("values", "version", "reason"),
    [
        ({"run": {"seed": 7}}, 1, r"\[run\] seed: 20210211 -> 7"),
        ({"scene": {"background_scale": 2.0}}, 1, r"\[scene\] background_scale: 1.0 -> 2.0"),
        ({}, 2, "by another version of the package, its data or the catalog"),
    ],
)
def test_nothing_is_done_again_unasked(tmp_path, values, version, reason):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    before = {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()}
    other = StudyConfig.from_dict(values)
    with pytest.raises(
        OtherResultsError, match=rf"3 finished steps.*{reason}.*first \(2\), second; "
    ):
        recorder.run(tmp_path / "run", other, version=version)
    assert recorder.ran == []
    assert {path.name: path.read_bytes() for path in (tmp_path / "run").iterdir()} == before
    assert recorder.run(tmp_path / "run", other, version=version, redo=True)[:2] == [
        "first:a",
        "first:b",
    ]


def test_an_edited_configuration_is_not_overwritten(tmp_path):
    recorder, folder = Recorder(), tmp_path / "run"
    recorder.run(folder)
    path = folder / "config.toml"
    edited = path.read_text().replace("min_detected = 2", "min_detected = 3 # mine")
    path.write_text(edited)
    refuses(r"config\.toml was edited since", recorder.run, folder, error=OtherResultsError)
    assert path.read_text() == edited
    # it is used when it is asked for, and stays as it was written
    assert recorder.run(folder, load_config(path)) == []
    assert path.read_text() == edited
    recorder.run(folder, redo=True)
    assert (folder / "config.edited.toml").read_text() == edited
    assert load_config(path) == StudyConfig()
    # whatever else there is to say
    path.write_text(edited)
    with pytest.raises(OtherResultsError, match=r"was edited since.*3 finished steps"):
        recorder.run(folder, StudyConfig.from_dict({"run": {"seed": 7}}))
    # nor is what was kept the first time
    path.write_text(edited.replace("mine", "mine again"))
    recorder.run(folder, redo=True)
    assert (folder / "config.edited.toml").read_text() == edited
    assert "mine again" in (folder / "config.edited2.toml").read_text()


def test_a_configuration_of_which_no_checksum_is_known_is_kept(tmp_path):
    recorder, folder = Recorder(), tmp_path / "run"
    recorder.run(folder)
    values = json.loads((folder / "manifest.json").read_text())
    # as an earlier version wrote it
    (folder / "manifest.json").write_text(json.dumps({"stages": values["stages"]}))
    (folder / ".manifest.copy.json").unlink()
    assert recorder.run(folder) == []
    (folder / "manifest.json").write_text(json.dumps({"stages": values["stages"]}))
    (folder / ".manifest.copy.json").unlink()
    before = (folder / "config.toml").read_text()
    other = StudyConfig.from_dict({"fit": {"model_error": 0.2}})
    with pytest.raises(OtherResultsError, match=r"edited since .*or that run was of an earlier"):
        recorder.run(folder, other)
    assert recorder.run(folder, other, redo=True) == []
    assert (folder / "config.edited.toml").read_text() == before


@pytest.mark.parametrize("values", [{}, {"threads": 1}, {"memory": 0.5}])
def test_a_finished_run_writes_nothing(tmp_path, monkeypatch, values):
    recorder, folder = Recorder(), tmp_path / "run"
    recorder.run(folder)
    before = {p.name: p.stat().st_mtime_ns for p in folder.iterdir()}
    # not even a lock: the disk may be full, the folder read-only
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=0))
    monkeypatch.setattr(ProductStore, "__enter__", None)
    config = StudyConfig.from_dict({"run": values})
    StudyRunner(config, folder, recorder.stages(), disk={"first": 10**12}).run()
    assert {p.name: p.stat().st_mtime_ns for p in folder.iterdir()} == before


def test_what_stands_needs_no_disk_again(tmp_path, monkeypatch):
    recorder, folder = Recorder(), tmp_path / "run"
    recorder.run(folder)
    (folder / "second.txt").unlink()
    # what a unit wrote before it was stopped is replaced, so that it needs no more either
    (folder / "part").mkdir()
    (folder / "part" / "of_second.txt").write_text("x" * 20_000)
    size = sum(path.stat().st_size for path in folder.rglob("*.*") if path.is_file())
    assert size > 20_000
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=9_000))
    with pytest.raises(DataError, match="the run needs about"):
        StudyRunner(
            StudyConfig(), folder, recorder.stages(), disk={"first": size, "second": 10_000}
        ).run()
    StudyRunner(
        StudyConfig(), folder, recorder.stages(), disk={"first": size, "second": 9_000}
    ).run()
    assert recorder.ran[-1] == "second"


def test_of_a_part_of_the_steps_the_disk_of_that_part_counts(tmp_path, monkeypatch, capsys):
    recorder, folder = Recorder(), tmp_path / "run"
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=15_000_000))
    options = {"disk": {"first": 20_000_000, "second": 5_000_000, "no stage": 10**12}}
    runner = StudyRunner(
        StudyConfig(), folder, recorder.stages(), until="first:a", progress_bar=True, **options
    )
    runner.run()
    text = capsys.readouterr().err
    assert "1 of 1 steps to do, which take about 0.01 GB" in text
    assert "(0.0 GB are free)" in text
    message = (
        r"needs about 0.02 GB in .*, only 0.0\d GB are free; free some space, choose another folder"
    )
    with pytest.raises(DataError, match=message):
        StudyRunner(StudyConfig(), folder, recorder.stages(), **options).run()
    assert recorder.ran == ["first:a"]


@pytest.mark.parametrize("name", ["first_a.txt", "first_b.txt", "second.txt"])
def test_a_deleted_product_makes_only_itself_anew(tmp_path, name):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    (tmp_path / "run" / name).unlink()
    made = name.removesuffix(".txt").replace("_", ":")
    assert recorder.run(tmp_path / "run") == [made]


def test_a_redo_of_a_lost_product_that_is_stopped_goes_on(tmp_path):
    recorder = Recorder()
    recorder.run(tmp_path / "run")
    (tmp_path / "run" / "first_b.txt").unlink()
    recorder.fail_at = "b"
    with pytest.raises(KeyboardInterrupt):
        recorder.run(tmp_path / "run")
    recorder.fail_at = None
    assert recorder.run(tmp_path / "run") == ["first:b"]


def test_a_change_of_the_packages_own_plan_is_seen(tmp_path):
    ran = []

    def function(context, _):
        ran.append(1)
        context.save("x.txt", lambda path: path.write_text("x"))

    for groups in (200, 200, 100):
        stage = Stage("one", function, "one", plan=lambda _, __, n=groups: {"n_groups": n})
        StudyRunner(StudyConfig(), tmp_path / "run", [stage], redo=True).run()
    assert len(ran) == 2


def test_other_reference_data_make_other_exposures(tmp_path, monkeypatch):
    # what residual = "etc" means stands in a file, not in the configuration
    class Nothing:
        def checksums(self, name):
            return {}

    def digests():
        stages = [s for s in study_stages() if s.name in ("exposures", "points", "kernels")]
        runner = StudyRunner(StudyConfig(), tmp_path / "run", study_stages())
        units = [next(iter(stage.units(runner.config))) for stage in stages]
        return {
            stage.name: runner.digest(stage, unit, Nothing())
            for stage, unit in zip(stages, units, strict=True)
        }

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
def test_a_damaged_product_is_named_and_made_again(tmp_path, caplog, damage, text):
    recorder, folder = Recorder(), tmp_path / "run"
    recorder.run(folder)
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


def test_products_that_no_longer_belong_are_removed(tmp_path):
    def function(context, unit):
        context.save(f"{unit}.txt", lambda path: path.write_text(unit))

    stages = [[Stage("one", function, "one", units=lambda _, u=units: u)] for units in ("ab", "a")]
    StudyRunner(StudyConfig(), tmp_path / "run", stages[0]).run()
    with pytest.raises(OtherResultsError, match="1 finished steps of another run"):
        StudyRunner(StudyConfig(), tmp_path / "run", stages[1]).run()
    assert (tmp_path / "run" / "b.txt").exists()
    StudyRunner(StudyConfig(), tmp_path / "run", stages[1], redo=True).run()
    assert (tmp_path / "run" / "a.txt").exists()
    assert not (tmp_path / "run" / "b.txt").exists()


def test_a_stage_that_reads_what_it_has_not_declared_is_an_error(tmp_path):
    stage = Stage("one", lambda context, _: context.config.scene, "one", sections=("run.name",))
    with pytest.raises(RuntimeError, match=r"stage 'one' reads \[scene\] without declaring it"):
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()
    stage = Stage(
        "one", lambda context, _: context.config.run.keep_level1b, "one", sections=("run.name",)
    )
    with pytest.raises(AttributeError, match="keep_level1b"):
        StudyRunner(StudyConfig(), tmp_path / "run", [stage]).run()


def test_a_product_of_a_stage_that_is_not_declared_cannot_be_read(tmp_path):
    def make(context, unit):
        context.save(f"{unit}.txt", lambda path: path.write_text(unit))

    def read(context, _):
        text = "".join(context.path(f"{unit}.txt").read_text() for unit in "ab")
        context.save("sum.txt", lambda path: path.write_text(text))

    first = Stage("first", make, "first", units=lambda _: "ab")
    between = Stage("between", lambda context, _: None, "between", needs=("first",))
    for needs in ((), ("between",)):
        stages = [first, between, Stage("last", read, "last", needs=needs)]
        with pytest.raises(RuntimeError, match=r"stage 'last' reads 'a\.txt' without declaring"):
            StudyRunner(StudyConfig(), tmp_path / "run", stages).run()
    StudyRunner(
        StudyConfig(), tmp_path / "run", [first, Stage("last", read, "last", needs=("first",))],
        redo=True,
    ).run()  # fmt: skip
    assert (tmp_path / "run" / "sum.txt").read_text() == "ab"


def test_a_stage_is_declared_beside_its_function():
    @stage("name", "title", needs=("other",), resources=lambda: ["a", "b"], version=3)
    def make(context, unit):
        return context, unit

    assert (make.name, make.title, make.needs, make.version) == ("name", "title", ("other",), 3)
    assert make.resource_names() == ("a", "b")
    assert make.function(1, 2) == (1, 2)
    names = [one.name for one in study_stages()]
    assert names[:3] == ["catalog", "seds", "truth"]
    assert len(set(names)) == len(names) == 18


def test_a_unit_depends_on_the_units_that_it_reads_only(tmp_path):
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
        stages = [
            Stage("first", first, "first", units=lambda _: units, plan=lambda _, unit: texts[unit]),
            Stage(
                "second",
                second,
                "second",
                units=lambda _: units,
                needs={"first": lambda _, unit: (unit,)},
            ),
        ]
        StudyRunner(StudyConfig(), tmp_path / "run", stages, redo=True).run()
        return sorted(ran)

    assert run("a") == ["first:a", "second:a"]
    # a further unit leaves what stands
    assert run("ab") == ["first:b", "second:b"]
    texts["b"] = "2"
    assert run("ab") == ["first:b", "second:b"]
    assert run("ab") == []


def test_a_part_of_the_stages_and_units(tmp_path):
    ran = []

    def make(context, unit):
        ran.append(unit or "all")
        context.save(f"{unit or 'all'}.txt", lambda path: path.write_text("same"))

    stages = [
        Stage("first", make, "first", units=lambda _: ("a/1", "b/1", "b/2")),
        Stage(
            "second",
            make,
            "second",
            units=lambda _: ("a", "b"),
            needs={"first": lambda _, unit: (f"{unit}/1",)},
        ),
        Stage("third", make, "third", needs=("second",)),
    ]

    def run(**options):
        ran.clear()
        StudyRunner(StudyConfig(), tmp_path / "run", stages, **options).run()
        return list(ran)

    assert run(until="second:b") == ["b/1", "b"]
    # what is left out is not taken for another run's
    assert run(until="first") == ["a/1", "b/2"]
    assert run() == ["a", "all"]
    assert run(until="first:b/*", again="first") == ["b/1", "b/2"]
    # the same bytes: what follows stands
    assert run(again="first:a/*") == ["a/1"]
    assert run() == []
    wanted = "'until' is 'fourth', which is no stage and matches no unit .*; stages: first, second, third;"
    refuses(wanted, run, error=ConfigError, until="fourth")
    with pytest.raises(
        ConfigError, match="nothing of 'again', 'second', is among what 'until', 'first', needs"
    ):
        run(until="first", again="second")


def test_stages_must_come_after_what_they_need(tmp_path):
    stage = Stage("second", print, "second", needs=("first",))
    with pytest.raises(ConfigError, match="stage 'second' needs"):
        StudyRunner(StudyConfig(), tmp_path, [stage])


def test_a_full_disk_is_text_before_the_run(tmp_path):
    refuses("the run needs about", check_disk, tmp_path / "not" / "yet", 10**18, error=DataError)
    check_disk(tmp_path / "not" / "yet", 1)


def units_side_by_side(n_units, **options):
    """The largest number of units that ran at once, and the order in which stages began."""
    state = types.SimpleNamespace(now=0, most=0, order=[])
    lock = threading.Lock()

    def work(context, unit):
        with lock:
            state.now += 1
            state.most = max(state.most, state.now)
            state.order.append(unit[:1])
        threading.Event().wait(0.05)
        context.save(f"{unit}.txt", lambda path: path.write_text(unit))
        with lock:
            state.now -= 1

    def names(letter):
        return lambda _: [f"{letter}{k}" for k in range(n_units)]

    memory = options.pop("memory", None)
    stages = (
        Stage("a", work, "a", units=names("a"), memory=memory),
        Stage("b", work, "b", units=names("b"), needs=("a",), memory=memory),
        Stage("c", work, "c", units=names("c"), memory=memory),
    )
    return state, stages


@pytest.mark.parametrize(("threads", "gigabytes", "most"), [(3, 4.0, 3), (3, 2.5, 2), (1, 4.0, 1)])
def test_units_run_side_by_side_within_threads_and_memory(tmp_path, threads, gigabytes, most):
    state, stages = units_side_by_side(4, memory=lambda _, __: 1_000_000_000)
    config = StudyConfig.from_dict({"run": {"threads": threads, "memory": gigabytes}})
    with ThreadPoolExecutor(4) as executor:
        store = StudyRunner(config, tmp_path / "run", stages, executor=executor).run()
    assert state.most == most
    assert len(store.records) == 12
    # b waits for all of a; c for nobody
    last_a = max(k for k, letter in enumerate(state.order) if letter == "a")
    assert state.order.index("b") > last_a


def test_a_unit_larger_than_the_memory_runs_alone(tmp_path):
    state, stages = units_side_by_side(3, memory=lambda _, __: 10_000_000_000)
    config = StudyConfig.from_dict({"run": {"threads": 3, "memory": 1.0}})
    with ThreadPoolExecutor(3) as executor:
        StudyRunner(config, tmp_path / "run", stages, executor=executor).run()
    assert state.most == 1


def test_what_runs_beside_a_unit_that_fails_is_kept(tmp_path):
    begun = threading.Event()

    def work(context, unit):
        if unit == "bad":
            begun.wait(5)
            msg = "no such light"
            raise ValueError(msg)
        begun.set()
        threading.Event().wait(0.1)
        context.save(f"{unit}.txt", lambda path: path.write_text(unit))

    stage = Stage("one", work, "one", units=lambda _: ("bad", "good", "late"))
    config = StudyConfig.from_dict({"run": {"threads": 2}})
    with ThreadPoolExecutor(2) as executor, pytest.raises(ValueError, match="no such light") as err:
        StudyRunner(config, tmp_path / "run", [stage], executor=executor).run()
    assert "in stage one:bad" in err.value.__notes__
    assert set(ProductStore(tmp_path / "run").records) == {"one:good"}


def test_the_first_of_several_errors_is_raised(tmp_path):
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

    config = StudyConfig.from_dict({"run": {"threads": 2}})
    with Submits(2) as executor, pytest.raises(ValueError, match="first"):
        StudyRunner(config, tmp_path / "run", [stage], executor=executor).run()


def test_a_process_that_died_before_a_unit_began_is_text(tmp_path):
    class Broken(Executor):
        def submit(self, *_, **__):
            raise BrokenExecutor

    stage = Stage("one", None, "one")
    with pytest.raises(DataError, match="a process ended during one"):
        StudyRunner(StudyConfig(), tmp_path / "run", [stage], executor=Broken()).run()


def test_kernels_are_compiled_before_what_calls_them(tmp_path, monkeypatch, caplog):
    order = []
    caplog.set_level("INFO", logger="miricigale.utils.compilation")

    def work(context, _):
        order.append(context.stage_name)
        context.save(f"{context.stage_name}.txt", lambda path: path.write_text("x"))

    def compile_apart(name):
        threading.Event().wait(0.05)
        order.append(f"compiled {name}")
        if name == "photometry":
            msg = "numba cannot"
            raise ValueError(msg)

    monkeypatch.setattr(runner, "compile_apart", compile_apart)
    monkeypatch.setattr(runner, "is_compiled", lambda name: name == "images")

    def stage(name, *kernels):
        def function(context, unit):
            context.stage_name = name
            work(context, unit)

        return Stage(name, function, name, kernels=kernels)

    stages = (stage("a", "fit"), stage("b"), stage("c", "photometry"), stage("d", "images"))
    config = StudyConfig.from_dict({"run": {"threads": 4}})
    for expected in ({"a", "b", "c", "d", "compiled fit", "compiled photometry"}, set()):
        with ThreadPoolExecutor(4) as executor:
            StudyRunner(config, tmp_path / "run", stages, executor=executor).run()
        assert set(order) == expected
        if order:
            assert order.index("compiled fit") < order.index("a")
            # one that fails is compiled where it is called
            assert order.index("compiled photometry") < order.index("c")
        order.clear()
    # never silent, also where no progress is shown
    text = [line for line in caplog.messages if line.startswith("compiling")]
    assert len(text) == 2
