"""Runs that are killed, damaged or out of disk: nothing is lost, nothing is taken for whole."""

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from astropy.nddata import CCDData
from astropy.table import QTable

from helpers.errors import refuses
from miricigale.utils.exceptions import OtherResultsError
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.engine.stage import Context, Stage
from workflow import toy_study

#: Seconds after which a test gives up, far more than any machine needs: no statement on how fast anything is.
HANGS = 600


def contents(folder):
    """Bytes of all products by name."""
    paths = [path for path in sorted(folder.rglob("*.txt")) if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def start(folder, *words, **options):
    return subprocess.Popen(
        [sys.executable, toy_study.__file__, str(folder), "2", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # whoever runs the tests in the background hands down an ignored SIGINT
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


def ended(process, status=0):
    """What a process says that ends with a status."""
    _, message = process.communicate(timeout=HANGS)
    assert process.returncode == status, message
    return message


def killed(folder, name, *texts):
    """Start a study, and kill it when a file stands (and has some texts)."""
    process = start(folder)
    wait_for(folder / name, process, *texts)
    process.kill()
    process.communicate(timeout=HANGS)


def wait_for(path, process, *texts):
    """Wait until a file stands (and has some texts), or the process has ended."""
    deadline = time.monotonic() + HANGS
    while process.poll() is None and time.monotonic() < deadline:
        if path.exists() and all(text in path.read_text() for text in texts):
            return
        time.sleep(0.002)


def group_lives(group):
    """Whether a process group has processes."""
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """Products of a toy study that nobody stopped."""
    folder = tmp_path_factory.mktemp("undisturbed") / "run"
    toy_study.main(folder, 0)
    return contents(folder)


@pytest.mark.slow
def test_a_run_that_is_killed_eight_times_ends_with_the_same_bytes(tmp_path, undisturbed):
    folder = tmp_path / "run"
    # from the first file of the folder to the last product, and moments between
    text = "run.lock config.toml manifest.json a/0.txt b/2.txt c/1.txt d/2.txt second.txt"
    for name in text.split():
        killed(folder, name)
        # whatever carries its name is whole
        for product, data in contents(folder).items():
            if ".partial-" not in product:
                assert data == undisturbed[product]
    toy_study.main(folder, 0)
    assert contents(folder) == undisturbed


@pytest.mark.slow
def test_a_second_run_in_the_folder_is_refused_and_the_first_one_goes_on(tmp_path, undisturbed):
    folder = tmp_path / "run"
    first = start(folder)
    wait_for(folder / "a" / "0.txt", first)
    # however slow the second one starts
    first.send_signal(signal.SIGSTOP)
    try:
        message = ended(start(folder), 1)
    finally:
        first.send_signal(signal.SIGCONT)
    assert f"{folder} is in use by a run: process {first.pid} on" in message
    ended(first)
    assert contents(folder) == undisturbed


def test_a_configuration_that_changes_before_a_killed_run_goes_on(tmp_path, undisturbed):
    folder = tmp_path / "run"
    # whichever ends first
    killed(folder, ".manifest.journal", '"first:a"', '"first:b"', '"first:c"')
    before = contents(folder)
    # what units c and d depend on is refused, and nothing is touched
    text = r"(?s)\[scene\] background_scale: 1.0 -> 2.0.*redo=True to replace it"
    refuses(text, toy_study.main, folder, 0, "2.0", error=OtherResultsError)
    assert contents(folder) == before
    times = {name: (folder / name).stat().st_mtime_ns for name in before if name[0] in "ab"}
    assert len(times) == 6
    toy_study.main(folder, 0, "2.0", "redo")
    # units a and b stand as they were made; all that depends is that of a new run
    assert {name: (folder / name).stat().st_mtime_ns for name in times} == times
    toy_study.main(tmp_path / "new", 0, "2.0")
    assert contents(folder) == contents(tmp_path / "new")
    changed = {name for name, data in contents(folder).items() if data != undisturbed[name]}
    assert changed == {f"{unit}/{k}.txt" for unit in "cd" for k in range(3)} | {"second.txt"}


def products(context):
    """What writes each kind of product of a study, larger than the limit below, by name."""
    image = CCDData(np.random.default_rng(1).normal(size=(300, 300)), unit="MJy/sr")
    table = QTable({"id": np.arange(20_000), "flux": np.linspace(0, 1, 20_000)})
    return {
        "image.fits": lambda name: context.save_image(name, image),
        "table.ecsv": lambda name: context.save_table(name, table),
        "table.fits": lambda name: context.save_table(name, table),
        "page.html": lambda name: context.save(name, lambda path: path.write_text("x" * 200_000)),
    }


@pytest.mark.parametrize("name", ["image.fits", "table.ecsv", "table.fits", "page.html"])
def test_a_write_that_the_system_cuts_off_is_named_and_leaves_what_stood(tmp_path, name, full_disk):
    context = Context(StudyConfig(), tmp_path)
    (tmp_path / name).write_text("what stood")
    with full_disk(100_000):
        refuses(rf"{tmp_path}/{name}", products(context)[name], name, error=OSError)
    assert (tmp_path / name).read_text() == "what stood"
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert context.saved == []
    products(context)[name](name)
    assert (tmp_path / name).stat().st_size > 100_000


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_process_outlives_the_run(tmp_path, how):
    process = start(tmp_path / "run", start_new_session=True)
    wait_for(tmp_path / "run" / "a" / "0.txt", process)
    process.send_signal(how)
    # ends when every process that holds its pipes has ended; the limit is for a machine that hangs
    _, message = process.communicate(timeout=HANGS)
    assert process.returncode in (-how, 1, 130)
    # what Python says of a parent that had no time to tidy up is not ours
    assert how == signal.SIGKILL or "leaked" not in message
    # the system takes them off its list a moment later
    deadline = time.monotonic() + HANGS
    while group_lives(process.pid):
        assert time.monotonic() < deadline, "a process of the run goes on"
        time.sleep(0.05)


def toy(folder):
    def first(context, unit):
        context.save(f"{unit}.txt", lambda path: path.write_text(f"{context.seed} {unit}"))

    def second(context, _):
        text = "".join(context.path(f"{unit}.txt").read_text() for unit in "abc")
        context.save("second.txt", lambda path: path.write_text(text))

    one = Stage("first", first, "first", units=lambda _: "abc")
    two = Stage("second", second, "second", needs=("first",))
    StudyRunner(StudyConfig(), folder, (one, two)).run()


def refusal(folder):
    """What a run says if it stops, otherwise None."""
    try:
        toy(folder)
    except OSError as err:
        return str(err)
    return None


def test_a_flipped_byte_anywhere_is_mended(tmp_path):
    folder = tmp_path / "run"
    toy(folder)
    whole = {path.name: path.read_bytes() for path in folder.iterdir()}
    for name in ("a.txt", "b.txt", "c.txt", "second.txt", "manifest.json", ".manifest.copy.json"):
        for place in range(0, len(whole[name]), max(1, len(whole[name]) // 20)):
            data = bytearray(whole[name])
            data[place] ^= 0x10
            (folder / name).write_bytes(data)
            message = refusal(folder)
            if message:
                # the name of a product that leads elsewhere
                assert "manifest" in name
                assert "is not the name of a product" in message
                (folder / name).write_bytes(whole[name])
            assert contents(folder) == {k: v for k, v in whole.items() if k.endswith(".txt")}
            manifests = [folder / "manifest.json", folder / ".manifest.copy.json"]
            assert manifests[0].read_bytes() == manifests[1].read_bytes()


def test_a_disk_that_fills_at_any_write_is_named_and_the_run_goes_on(tmp_path, monkeypatch):
    toy(tmp_path / "whole")
    replace, n_failed = os.replace, 0
    for allowed in range(100):
        folder = tmp_path / f"full{allowed}"
        left = [allowed]

        def full(source, target, left=left):
            left[0] -= 1
            if left[0] < 0:
                raise OSError(28, "No space left on device")
            return replace(source, target)

        monkeypatch.setattr(os, "replace", full)
        message = refusal(folder)
        monkeypatch.setattr(os, "replace", replace)
        if message is None:
            break
        n_failed += 1
        assert f"{folder}{os.sep}" in message
        assert "No space left on device" in message
        toy(folder)
        assert contents(folder) == contents(tmp_path / "whole")
    # each product and each note of it was refused once
    assert n_failed >= 8
