"""The data command: list, check and add, their output and exit statuses."""

import importlib
import sys

import numpy as np
import pytest

from helpers.commands import command
from miricigale import conf
from miricigale.refdata import Resource, locate, registry
from miricigale.refdata.libraries import READERS, LibraryTable
from miricigale.refdata.lookup import file_sha256

NAME = "test.library"


def read(path):
    spectra = np.loadtxt(path, ndmin=2)
    axes = {"wave": np.arange(1.0, 1.0 + spectra.shape[1])}
    axes["axes"] = {"k": np.arange(float(len(spectra)))}
    facts = {"meta": {"files": {path.name: file_sha256(path)}}, "summary": ("numbers of nobody",)}
    return LibraryTable(name=NAME, spectra={"dust": spectra}, **axes, **facts)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    record = Resource(NAME, "user", "A test", "Free", "Nobody 2030", "a page", file="sed/x.fits")
    known = registry.resources()
    everything = {name: known[name] for name in ("ssp.bc03", "filters.sedpy")} | {NAME: record}
    importlib.import_module("miricigale.refdata.check")
    for name in ("registry.resources", "check.resources", "resources"):
        monkeypatch.setattr(f"miricigale.refdata.{name}", lambda: everything)
    monkeypatch.setitem(READERS, NAME, read)
    (tmp_path / "good.txt").write_text("1 2 3\n4 5 6\n")
    (tmp_path / "bad.txt").write_text("1 2 3\nnumbers?\n")
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        yield tmp_path


def test_a_library_is_added_listed_and_checked(folder, capsys):
    text = command(capsys, "data", "list", NAME).out
    assert "test.library (user): absent; miricigale data add test.library PATH" in text
    assert "source: a page" in text
    told = command(capsys, "data", "add", NAME, folder / "good.txt")
    for part in ("numbers of nobody", "2 of each kind: dust", file_sha256(folder / "good.txt")):
        assert part in told.out
    # no terminal, no bar
    assert told.err == ""
    path = locate(NAME)
    text = command(capsys, "data", "list", NAME).out
    for part in (f"test.library (user): {path}", "A test", "license: Free", "cite: Nobody 2030"):
        assert part in text
    assert f"ok              {path}" in command(capsys, "data", "check").out
    # damage is an exit status
    path.write_bytes(path.read_bytes()[:-2880])
    told = command(capsys, "data", "check", status=1)
    assert f"damaged         {path}" in told.out
    assert told.err == f"miricigale: not as they should be: {NAME}\n"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([NAME, "bad.txt"], "bad.txt cannot be read as 'test.library': "),
        ([NAME, "absent.txt"], "absent.txt is no file or folder"),
        (["nothing", "good.txt"], "no library 'nothing'; known: "),
        (["ssp.bc03", "good.txt"], "no library 'ssp.bc03'; known: "),
    ],
)
def test_refusals_are_one_sentence_on_stderr(folder, capsys, arguments, message):
    name, path = arguments
    told = command(capsys, "data", "add", name, folder / path, status=2)
    assert told.out == ""
    assert told.err.startswith("miricigale: ")
    assert message in told.err
    assert told.err.count("\n") == 1
    assert not (folder / "data" / "sed" / "x.fits").exists()


def test_a_stop_changes_nothing(folder, capsys, monkeypatch):
    def stop(path):
        raise KeyboardInterrupt

    monkeypatch.setitem(READERS, NAME, stop)
    told = command(capsys, "data", "add", NAME, folder / "good.txt", status=130)
    assert "nothing was changed" in told.err


def test_steps_are_shown_on_a_terminal(folder, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    text = command(capsys, "data", "add", NAME, folder / "good.txt").err
    assert "test.library: reading" in text
    assert "test.library: checking" in text


def test_an_unknown_name_is_told(folder, capsys):
    told = command(capsys, "data", "list", "nonsense", status=1)
    assert "no resource has 'nonsense' in its name" in told.err
