"""Units on the workers of dask: the same bytes, also where workers die."""

import subprocess
import sys

import pytest

from helpers.commands import command
from workflow import toy_study


def products_of(folder):
    paths = [path for path in folder.rglob("*.txt") if ".partial-" not in path.name]
    return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


def run(folder, fails=False):
    """Messages and products of a toy study on a cluster, which may be one that fails."""
    words = [sys.executable, toy_study.__file__, folder, "2", "cluster"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300)
    assert (done.returncode != 0) == fails, done.stderr
    return done.stderr, products_of(folder)


@pytest.mark.slow
def test_workers_that_die_are_replaced_or_named_and_the_run_resumes(tmp_path):
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    toy_study.main(tmp_path / "whole", 0)
    whole = products_of(tmp_path / "whole")
    # one worker dies
    (tmp_path / "one.deaths").write_text("1")
    message, products = run(tmp_path / "one")
    assert "is lost; first c is done again by another worker" in message
    assert (tmp_path / "one.deaths").read_text() == "0"
    assert products == whole
    # every worker that does the unit dies
    (tmp_path / "all.deaths").write_text("4")
    message, products = run(tmp_path / "all", fails=True)
    assert (tmp_path / "all.deaths").read_text() == "0"
    for text in (
        "4 workers died over first c",
        "the last at tcp://",
        "the same command resumes it",
    ):
        assert text in message
    assert products.items() < whole.items()
    assert "c/0.txt" not in products
    toy_study.main(tmp_path / "all", 0)
    assert products_of(tmp_path / "all") == whole


def test_a_scheduler_that_is_none_is_named(tmp_path, capsys):
    pytest.importorskip("distributed", reason="dask.distributed is not installed")
    words = ["run", "goodss", "--quick", "-o", tmp_path / "run", "--scheduler", "nowhere"]
    told = command(capsys, *words, "--no-progress", status=2)
    assert "there is no dask scheduler at 'nowhere'" in told.err
    assert not (tmp_path / "run").exists()
