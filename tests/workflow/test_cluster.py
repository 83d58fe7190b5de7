"""Units on the workers of dask: the same bytes, also where workers die."""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import command

TOY = Path(__file__).with_name("toy_study.py")


def run(folder, *arguments, fails=False):
    """Messages and products of a toy study, which may be one that fails."""
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    words = [sys.executable, TOY, folder, "2", *arguments]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    paths = [path for path in folder.rglob("*.txt") if ".partial-" not in path.name]
    products = {str(path.relative_to(folder)): path.read_bytes() for path in paths}
    assert (done.returncode != 0) == fails, done.stderr
    return done.stderr, products


def test_workers_that_die_are_replaced_or_named_and_the_run_resumes(tmp_path):
    _, whole = run(tmp_path / "processes")
    # one worker dies
    (tmp_path / "one.deaths").write_text("1")
    message, products = run(tmp_path / "one", "cluster")
    assert "is lost; first c is done again by another worker" in message
    assert (tmp_path / "one.deaths").read_text() == "0"
    assert products == whole
    # every worker that does the unit dies
    (tmp_path / "all.deaths").write_text("4")
    message, products = run(tmp_path / "all", "cluster", fails=True)
    assert (tmp_path / "all.deaths").read_text() == "0"
    for text in (
        "4 workers died over first c",
        "the last at tcp://",
        "the same command resumes it",
    ):
        assert text in message
    assert products.items() < whole.items()
    assert "c/0.txt" not in products
    assert run(tmp_path / "all", "cluster")[1] == whole


def test_a_scheduler_that_is_none_is_named(tmp_path, capsys):
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    words = ["run", "goodss", "--quick", "-o", tmp_path / "run", "--scheduler", "nowhere"]
    told = command(capsys, *words, "--no-progress", status=2)
    assert "there is no dask scheduler at 'nowhere'" in told.err
    assert not (tmp_path / "run").exists()
