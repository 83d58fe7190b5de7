"""Finding, adding and checking reference data."""

import hashlib
import json
import shutil
import sys
from pathlib import Path

import pytest

from helpers.errors import refuses
from miricigale import conf
from miricigale.refdata import (
    Resource,
    add_resource,
    cache_folder,
    check_resources,
    find_resource,
    locate,
    registry,
)
from miricigale.refdata.locate import data_folder, fingerprint, record_path
from miricigale.utils.exceptions import DataError, MiricigaleWarning
from miricigale.utils.store import PARTIAL

TEXT = b"some numbers\n"


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """An empty data folder, no environment, and records of three user resources."""
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    common = {"kind": "user", "title": "T", "licence": "L", "citation": "C", "source": "a page"}
    records = {
        "test.file": Resource(
            name="test.file", file="sub/file.dat", sha256=hashlib.sha256(TEXT).hexdigest(), **common
        ),
        "test.folder": Resource(name="test.folder", file="folder", **common),
        "test.package": Resource(name="test.package", **(common | {"kind": "package"})),
    }
    bundled = registry.resources()
    everything = {"instrument.siaf": bundled["instrument.siaf"], **records}
    for module in (registry, sys.modules["miricigale.refdata.check"]):
        monkeypatch.setattr(module, "resources", lambda: everything)
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        yield tmp_path


def source(folder):
    path = folder / "mine.dat"
    path.write_bytes(TEXT)
    return path


def test_bundled_files_are_there_and_whole():
    bundled = {name for name, record in registry.resources().items() if record.kind == "bundled"}
    states = {row.name: row.state for row in check_resources()}
    assert {states[name] for name in bundled} == {"ok"}
    assert bundled


def test_data_folder_is_set_by_the_user(folders):
    assert data_folder() == folders / "data"
    with conf.set_temp("data_folder", ""):
        assert data_folder().name == "miricigale"


def test_cache_folder_is_set_by_the_user(folders):
    with conf.set_temp("cache_folder", ""):
        assert cache_folder().parts[-2:] == ("miricigale", "cache")
    with conf.set_temp("cache_folder", str(folders / "c")):
        assert cache_folder() == folders / "c"
    assert conf.grid_cache_size == 1000
    with pytest.raises(TypeError, match="too small"):
        conf.grid_cache_size = -1


def test_absent_resource_says_where_to_get_it(folders):
    with pytest.raises(
        DataError, match=r"'test.file' \(T\) is in none of the data folder .*a page"
    ):
        locate("test.file")
    refuses("no resource 'nope'", locate, "nope", error=KeyError)
    refuses("'name' must be a resource that is a file", locate, "test.package")


def test_absent_resource_can_be_asked_for(folders):
    assert find_resource("test.file") is None
    path = add_resource("test.file", source(folders))
    assert find_resource("test.file") == path
    refuses("no resource 'nope'", find_resource, "nope", error=KeyError)


def test_an_empty_environment_is_no_folder(folders, monkeypatch):
    """The working folder must not be taken for the data folder."""
    monkeypatch.setenv("MIRICIGALE_DATA", "")
    monkeypatch.chdir(folders)
    (folders / "sub").mkdir()
    (folders / "sub" / "file.dat").write_bytes(TEXT)
    assert find_resource("test.file") is None


def test_added_file_is_found(folders):
    target = add_resource("test.file", source(folders))
    assert target == folders / "data" / "sub" / "file.dat"
    assert locate("test.file", check=True) == target
    assert target.read_bytes() == TEXT
    assert not list(target.parent.glob(f"{PARTIAL}*"))


def test_added_folder_replaces_the_old(folders):
    old, new = folders / "old", folders / "new"
    for folder in (old, new):
        folder.mkdir()
        (folder / folder.name).write_text("x")
    add_resource("test.folder", old)
    path = add_resource("test.folder", new)
    assert [p.name for p in path.iterdir()] == ["new"]
    assert locate("test.folder") == path
    assert [p.name for p in path.parent.iterdir() if p.suffix != ".lock"] == ["folder"]


@pytest.mark.parametrize("name", ["test.file", "test.folder"])
def test_an_interrupted_copy_leaves_the_old_one(folders, monkeypatch, name):
    path = source(folders)
    (folders / "old").mkdir()
    mine = path if name == "test.file" else folders / "old"
    target = add_resource(name, mine)
    before = fingerprint(name)
    (folders / "old" / "new.dat").write_text("x")

    def interrupt(_, partial):
        Path(partial).mkdir() if name == "test.folder" else Path(partial).write_bytes(b"half")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(shutil, "copyfile" if name == "test.file" else "copytree", interrupt)
        with pytest.raises(KeyboardInterrupt):
            add_resource(name, mine)
    assert fingerprint(name) == before
    assert not list(target.parent.glob(f"{PARTIAL}*"))


def test_the_record_beside_a_file_answers_only_while_it_is_fresh(folders):
    path = add_resource("test.file", source(folders))
    status = path.stat()
    record = {"sha256": "kept", "size": status.st_size, "mtime_ns": status.st_mtime_ns}
    record_path(path).write_text(json.dumps(record))
    assert fingerprint("test.file") == "kept"
    path.write_bytes(TEXT + b"more")
    assert fingerprint("test.file") == hashlib.sha256(TEXT + b"more").hexdigest()
    record_path(path).write_text("[]")
    assert fingerprint("test.file") == hashlib.sha256(TEXT + b"more").hexdigest()


def test_wrong_file_is_refused(folders):
    path = source(folders)
    path.write_bytes(b"other numbers\n")
    with pytest.raises(DataError, match=r"mine.dat is not the file .* 'test.file' describes"):
        add_resource("test.file", path)
    refuses("no file or folder", add_resource, "test.file", folders / "absent", error=DataError)
    refuses("'name' must be a resource that is a file", add_resource, "test.package", path)


def test_file_that_changed_is_noticed(folders):
    path = add_resource("test.file", source(folders))
    path.write_bytes(b"broken\n")
    assert locate("test.file") == path
    refuses("sha256 differs", locate, "test.file", error=DataError, check=True)


def test_environment_wins_over_the_folder_over_the_package(folders, monkeypatch):
    bundled = locate("instrument.siaf")
    assert "miricigale" in bundled.parts
    for folder in (folders / "data", folders / "env"):
        (folder / "instrument").mkdir(parents=True)
        (folder / "instrument" / bundled.name).write_text("mine")
    # another file than the bundled one is taken, and said
    message = "'instrument.siaf' is taken from .* which differs from the bundled file"
    with pytest.warns(MiricigaleWarning, match=message):
        assert locate("instrument.siaf").is_relative_to(folders / "data")
    monkeypatch.setenv("MIRICIGALE_DATA", str(folders / "env"))
    with pytest.warns(MiricigaleWarning, match=message):
        assert locate("instrument.siaf").is_relative_to(folders / "env")


def test_the_fingerprint_is_that_of_the_file_found(folders, monkeypatch):
    path = locate("instrument.siaf")
    assert fingerprint("instrument.siaf") == hashlib.sha256(path.read_bytes()).hexdigest()
    other = folders / "env" / "instrument" / path.name
    other.parent.mkdir(parents=True)
    other.write_text("mine")
    monkeypatch.setenv("MIRICIGALE_DATA", str(folders / "env"))
    with pytest.warns(MiricigaleWarning, match="differs from the bundled file"):
        assert fingerprint("instrument.siaf") == hashlib.sha256(b"mine").hexdigest()


def test_check_tells_the_state_of_each(folders):
    add_resource("test.file", source(folders)).write_bytes(b"broken\n")
    states = {row.name: row.state for row in check_resources()}
    assert states == {
        "instrument.siaf": "ok",
        "test.file": "wrong checksum",
        "test.folder": "absent",
        "test.package": "from package",
    }
