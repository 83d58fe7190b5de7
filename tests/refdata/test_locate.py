"""Finding, adding and checking reference data."""

import hashlib
import json
import sys

import pytest

from helpers.errors import refuses
from miricigale import conf
from miricigale.refdata import (
    Resource,
    cache_folder,
    check_resources,
    find_resource,
    locate,
    registry,
)
from miricigale.refdata.lookup import data_folder, fingerprint, record_path
from miricigale.utils.exceptions import DataError, MiricigaleWarning

TEXT = b"some numbers\n"


@pytest.fixture
def folders(tmp_path, monkeypatch):
    """An empty data folder, no environment, and records of two user resources."""
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    common = {"kind": "user", "title": "T", "licence": "L", "citation": "C", "source": "a page"}
    digest = hashlib.sha256(TEXT).hexdigest()
    records = {
        "test.file": Resource("test.file", **common, file="sub/file.dat", sha256=digest),
        "test.package": Resource("test.package", **(common | {"kind": "package"})),
    }
    bundled = registry.resources()
    everything = {"instrument.siaf": bundled["instrument.siaf"], **records}
    for module in (registry, sys.modules["miricigale.refdata.check"]):
        monkeypatch.setattr(module, "resources", lambda: everything)
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        yield tmp_path


def put(folders, content=TEXT):
    """The file of a resource in the data folder."""
    path = folders / "data" / "sub" / "file.dat"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


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
    refuses("too small", setattr, conf, "grid_cache_size", -1, error=TypeError)


def test_absent_resource_says_where_to_get_it(folders):
    match = r"'test.file' \(T\) is in none of the data folder .*a page"
    refuses(match, locate, "test.file", error=DataError)
    refuses("'name' must be a resource that is a file", locate, "test.package")

    refuses("no resource 'nope'", find_resource, "nope", error=KeyError)
    assert find_resource("test.file") is None
    path = put(folders)
    assert locate("test.file") == find_resource("test.file") == path


def test_an_empty_environment_is_no_folder(folders, monkeypatch):
    """The working folder must not be taken for the data folder."""
    monkeypatch.setenv("MIRICIGALE_DATA", "")
    monkeypatch.chdir(folders)
    (folders / "sub").mkdir()
    (folders / "sub" / "file.dat").write_bytes(TEXT)
    assert find_resource("test.file") is None


def test_the_record_beside_a_file_answers_only_while_it_is_fresh(folders):
    path = put(folders)
    status = path.stat()
    record = {"sha256": "kept", "size": status.st_size, "mtime_ns": status.st_mtime_ns}
    record_path(path).write_text(json.dumps(record))
    assert fingerprint("test.file") == "kept"
    path.write_bytes(TEXT + b"more")
    assert fingerprint("test.file") == hashlib.sha256(TEXT + b"more").hexdigest()
    record_path(path).write_text("[]")
    assert fingerprint("test.file") == hashlib.sha256(TEXT + b"more").hexdigest()


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
    with pytest.warns(MiricigaleWarning, match=message):
        assert fingerprint("instrument.siaf") == hashlib.sha256(b"mine").hexdigest()


def test_the_fingerprint_is_that_of_the_file_found(folders):
    path = locate("instrument.siaf")
    assert fingerprint("instrument.siaf") == hashlib.sha256(path.read_bytes()).hexdigest()


def test_check_tells_the_state_of_each(folders):
    put(folders, b"broken\n")
    states = {row.name: row.state for row in check_resources()}
    wanted = {"test.file": "wrong checksum", "test.package": "from package"}
    assert states == wanted | {"instrument.siaf": "ok"}
