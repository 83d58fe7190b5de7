"""Locks of folders, seen from several processes."""

import errno
import json
import os
import signal
import subprocess
import sys
import textwrap
from subprocess import PIPE

import pytest

from helpers.errors import refuses
from miricigale.utils.exceptions import DataError
from miricigale.utils.lock import FolderLock

HOLD = """
    import sys
    from miricigale.utils.lock import FolderLock
    with FolderLock(sys.argv[1]):
        print("held", flush=True)
        sys.stdin.read()
"""


def start(code, *args):
    command = [sys.executable, "-c", textwrap.dedent(code), *map(str, args)]
    return subprocess.Popen(command, stdin=PIPE, stdout=PIPE, text=True)


@pytest.fixture
def holder(tmp_path):
    process = start(HOLD, tmp_path)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def content(folder):
    return json.loads((folder / "run.lock").read_text())


def leave(folder, **changes):
    """Make a lock of this process and change what it says; returns the text."""
    with FolderLock(folder):
        text = json.dumps(content(folder) | changes)
    (folder / "run.lock").write_text(text)
    return text


def refused(match, folder):
    refuses(match, FolderLock(folder).__enter__, error=DataError)


def test_a_lock_is_there_while_it_is_held_and_alone(tmp_path):
    with FolderLock(tmp_path, name="fit.lock", purpose="fit") as held:
        assert names(tmp_path) == [".fit.lock", "fit.lock"]
        assert json.loads(held.path.read_text())["pid"] == os.getpid()
        again = FolderLock(tmp_path, name="fit.lock", purpose="fit")
        for other in (held, again):
            refuses(f"in use by a fit: process {os.getpid()} on", other.__enter__, error=DataError)
        assert held.path.is_file()
    assert names(tmp_path) == [".fit.lock"]


def test_another_process_keeps_out_until_it_ends(tmp_path, holder):
    wanted = rf"process {holder.pid} on .*, started 20.* UTC; if .* remove .*run\.lock"
    refused(wanted, tmp_path)
    assert content(tmp_path)["pid"] == holder.pid
    holder.communicate("")
    with FolderLock(tmp_path):
        assert content(tmp_path)["pid"] == os.getpid()


def test_a_killed_process_leaves_a_lock_that_is_taken_over(tmp_path, holder):
    holder.kill()
    if hasattr(os, "waitid"):
        # a process that ended and was not waited for still has its number, but holds nothing
        os.waitid(os.P_PID, holder.pid, os.WEXITED | os.WNOWAIT)
    else:
        holder.wait()
    assert content(tmp_path)["pid"] == holder.pid
    with FolderLock(tmp_path):
        assert content(tmp_path)["pid"] == os.getpid()
    assert names(tmp_path) == [".run.lock"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_children_of_a_killed_process_do_not_hold_its_lock(tmp_path):
    code = """
        import os, sys, time
        from miricigale.utils.lock import FolderLock
        with FolderLock(sys.argv[1]):
            if os.fork() == 0:
                print(os.getpid(), flush=True)
            time.sleep(60)
    """
    process = start(code, tmp_path)
    child = int(process.stdout.readline())
    try:
        process.kill()
        process.wait()
        os.kill(child, 0)
        with FolderLock(tmp_path):
            assert content(tmp_path)["pid"] == os.getpid()
    finally:
        os.kill(child, signal.SIGKILL)
        process.communicate()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_does_not_free_the_lock_of_its_parent(tmp_path):
    code = """
        import os, sys
        from miricigale.utils.lock import FolderLock
        with FolderLock(sys.argv[1]) as held:
            child = os.fork()
            if child == 0:
                held.__exit__(None, None, None)
                os._exit(0)
            os.waitpid(child, 0)
            print("waited", flush=True)
            sys.stdin.read()
    """
    process = start(code, tmp_path)
    try:
        assert process.stdout.readline() == "waited\n"
        refused(f"process {process.pid} ", tmp_path)
    finally:
        process.communicate("")
    assert process.returncode == 0
    assert names(tmp_path) == [".run.lock"]


@pytest.mark.parametrize("changes", [{"host": "node7"}, {"machine": "another"}])
def test_a_lock_of_another_host_is_never_taken_for_dead(tmp_path, changes):
    text = leave(tmp_path, pid=2**22 + 1, **changes)
    wanted = r"on another host: process 4194305 on .*if that process is gone, remove .*run\.lock"
    refused(wanted, tmp_path)
    assert (tmp_path / "run.lock").read_text() == text


@pytest.mark.parametrize("text", ["", "{", "[1]", '{"pid": "x"}', "\x00\xff", "[" * 60000, "17"])
def test_what_cannot_be_read_is_taken_over(tmp_path, text):
    (tmp_path / "run.lock").write_text(text)
    with FolderLock(tmp_path):
        assert content(tmp_path)["pid"] == os.getpid()


def test_a_removed_file_does_not_free_the_lock(tmp_path):
    with FolderLock(tmp_path) as first:
        first.path.unlink()
        refused("in use", tmp_path)
    assert names(tmp_path) == [".run.lock"]


def test_a_full_disk_leaves_no_lock(tmp_path, full_disk):
    with pytest.raises(OSError, match=r"run\.lock"), full_disk(10), FolderLock(tmp_path):
        pass
    assert names(tmp_path) == [".run.lock"]


@pytest.mark.slow
def test_of_many_that_find_an_old_lock_one_wins(tmp_path):
    # each takes over what another left, ten times: never are two inside at once
    code = """
        import os, sys
        from miricigale.utils.lock import FolderLock
        inside = os.path.join(sys.argv[1], "inside")
        print("ready", flush=True)
        sys.stdin.readline()
        n = 0
        while n < 10:
            try:
                lock = FolderLock(sys.argv[1])
                lock.__enter__()
            except OSError as err:
                assert "in use" in str(err), err
                continue
            os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
            n += 1
            os.unlink(inside)
            # as if killed: the file stays and names a process that is gone
            lock._lock.release()
    """
    leave(tmp_path, pid=2**22 + 1)
    processes = [start(code, tmp_path) for _ in range(5)]
    assert [process.stdout.readline() for process in processes] == ["ready\n"] * 5
    for process in processes:
        process.stdin.write("go\n")
        process.stdin.flush()
    for process in processes:
        process.communicate()
    assert [process.returncode for process in processes] == [0] * 5


def test_a_file_system_without_locks_is_named(tmp_path, monkeypatch):
    fcntl = pytest.importorskip("fcntl")

    def flock(file, operation):
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    refused(r"\.run\.lock cannot be locked \(No locks available\): choose a folder", tmp_path)
