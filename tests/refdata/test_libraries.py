"""Libraries of spectra: the format they are kept in, and their registration."""

import hashlib
import json
import mmap
import os
import pkgutil
import sys
import threading
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from unittest import mock

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from filelock import FileLock
from numpy.testing import assert_allclose, assert_array_equal

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale import conf, refdata
from miricigale.refdata import Resource, check_resources, find_resource, locate, registry
from miricigale.refdata.libraries import (
    READERS,
    LibraryTable,
    add_library,
    open_library,
    register,
    verify_library,
    write_library,
)
from miricigale.refdata.lookup import file_sha256, fingerprint, record_path, stored_record
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import PARTIAL

NAME = "test.library"
AXES = {"tau": [3.0, 3.0, 7.0, 7.0], "q": [0.0, 0.97, 0.0, 0.97]}


def make(name=NAME, n_wave=5, factor=1.0, **changes):
    """Four spectra on two axes; row k is factor * (10 k + wavelength)."""
    wave = np.geomspace(0.1, 1000.0, n_wave)
    spectra = factor * (10.0 * np.arange(4)[:, None] + wave).astype(np.float32)
    options = {
        "axes": {k: np.array(v) for k, v in AXES.items()},
        "spectra": {"dust": spectra, "disk": 2 * spectra.astype(float)},
        "units": {"dust": "W / um", "disk": "solLum / Angstrom"},
        "values": {"mass": np.array([0.1, 0.2, 0.3, 0.4])},
        "meta": {"files": {"a.dat": "0" * 64}, "note": "Calzetti, Größe µ"},
        "summary": ("4 Spektren für λ > 0.1 µm",),
    } | changes
    return LibraryTable(name=name, wave=wave, **options)


# ----------------------------------------------------------------------------- the table


def same(found, library):
    for kind in ("axes", "values", "spectra"):
        for name, column in getattr(library, kind).items():
            assert_array_equal(getattr(found, kind)[name], column)
    assert {name: found.units[name] for name in library.units} == library.units
    assert found.meta == library.meta


def test_what_is_written_comes_back(tmp_path):
    library = make()
    path = tmp_path / "sub" / "x.fits"
    write_library(library, path)
    found = open_library(path, NAME)
    assert_array_equal(found.wave, library.wave)
    same(found, library)
    assert found.spectra["dust"].dtype.itemsize == 4
    assert found.spectra["disk"].dtype.itemsize == 8
    assert found.summary == library.summary
    assert found.spectrum("dust", 2).tolist() == pytest.approx((20 + library.wave).tolist())
    assert found.spectrum("dust", [0, 3]).shape == (2, 5)
    assert [p.name for p in path.parent.iterdir()] == ["x.fits"]


def test_other_programs_read_it(tmp_path):
    """A FITS reader finds images with units, a table of axes, and checksums that hold."""
    path = tmp_path / "x.fits"
    write_library(make(), path)
    with fits.open(path, checksum=True) as hdus:
        hdus.verify("exception")
        assert hdus["SPECTRA_DUST"].data[3, 0] == pytest.approx(30.1)
        assert u.Unit(hdus["SPECTRA_DISK"].header["BUNIT"]) == u.L_sun / u.AA
        assert hdus["WAVE"].header["BUNIT"] == "um"
        assert hdus["ROWS"].columns.names == ["tau", "q", "mass"]


def test_a_large_library_stays_on_disk(tmp_path):
    n, wave = 15000, np.geomspace(1e-3, 1e3, 500)
    spectra = np.ones((n, wave.size), dtype=np.float32)
    big = LibraryTable(NAME, wave, {"k": np.arange(n)}, {"a": spectra, "b": spectra})
    path = tmp_path / "big.fits"
    write_library(big, path)
    assert path.stat().st_size > 60e6
    tracemalloc.start()
    try:
        library = open_library(path, NAME)
        row = library.spectrum("b", 14000)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert np.all(row == 1)
    assert peak < 10e6
    base = library.spectra["b"]
    while isinstance(base, np.ndarray) and base.base is not None:
        base = base.base
    assert isinstance(base, mmap.mmap)
    with pytest.raises(ValueError, match="read-only"):
        library.spectra["b"][0, 0] = 2.0


def test_rows_are_found_by_the_values_of_their_axes():
    library = make(axes={"tau": np.array([3, 3, 7, 7]), "q": [0.0, np.float32(0.97)] * 2})
    assert library.row(tau=7, q=0.97) == 3
    assert library.row(tau=7.0, q=0.0) == 2
    assert library.row(tau=0.1 + 0.2 + 2.7, q=0.97, other=1.0) == 1
    assert library.row(tau=5.0, q=0.97) is None
    assert library.row(tau=7.001, q=0.97) is None
    assert library.row(tau=7.0, q=1e-4) is None
    assert_allclose(library.levels["q"], [0.0, 0.97], rtol=1e-7)
    refuses(r"'q' must be given to find a row of 'test.library'", library.row, tau=3.0)


@pytest.mark.parametrize("scale", [1e-12, 1e-4, 1.0, 1e9])
def test_small_and_large_values_of_an_axis_are_told_apart(scale):
    """Whatever the unit, values one part in a thousand apart are different rows."""
    values = scale * np.array([0.0, 1.0, 1.001, 97.0])
    library = make(axes={"k": values})
    assert [library.row(k=v) for v in values] == [0, 1, 2, 3]
    assert [library.row(k=v * (1 + 1e-9)) for v in values] == [0, 1, 2, 3]
    assert library.row(k=scale * 1.0005) is None


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"axes": {"tau": [1, 1, 2, 2], "q": [0, 0, 0, 1]}}, "tau = 1, q = 0 in rows 0 and 1"),
        ({"axes": {"tau": [1.0, 2.0, 3.0]}}, r"'tau' must be of shape \(4,\)"),
        ({"axes": {"tau": [1.0, 2.0, 3.0, np.nan]}}, "'tau' must be finite in every row"),
        ({"axes": {"tau": [1, 2, 3, 4] * u.um}}, "'tau' must be plain numbers"),
        ({"axes": {"tau": 1 + 8e-7 * np.arange(4)}}, "'tau' must be of values that differ by more"),
        ({"axes": {}}, "one axis and one kind of spectra at least"),
        ({"axes": {"MASS": [1, 2, 3, 4]}}, "of other names"),
        ({"axes": {"a b": [1, 2, 3, 4]}}, "plain identifiers, got 'a b'"),
        ({"spectra": {"dust": np.zeros((4, 4))}, "units": {}}, r"'dust' must be of shape \(4, 5\)"),
    ],
)
def test_what_is_no_library_is_refused(changes, message):
    refuses(message, make, **changes)


@pytest.mark.parametrize("wave", [[1.0], [2.0, 1.0], [0.0, 1.0], [1.0, np.inf], [1.0, 1.0]])
def test_wavelengths_ascend(wave):
    match, spectra = "'wave' must be two or more positive, ascending", np.ones((1, len(wave)))
    refuses(match, LibraryTable, NAME, np.array(wave), {"a": [1.0]}, {"b": spectra})


def test_wavelengths_may_be_a_quantity_and_meta_are_plain(tmp_path):
    wave, numbers = [1000, 2000] * u.nm, {"n": np.int64(3), "x": np.float32(0.5), "v": np.arange(3)}
    library = LibraryTable(NAME, wave, {"a": [1.0]}, {"b": np.ones((1, 2))}, meta=numbers)
    write_library(library, tmp_path / "x.fits")
    found = open_library(tmp_path / "x.fits", NAME)
    assert_allclose(found.wave, [1.0, 2.0])
    assert found.meta == {"n": 3, "x": 0.5, "v": [0, 1, 2]}


def test_foreign_and_other_files_are_refused_by_name(tmp_path):
    path = tmp_path / "x.fits"

    def refused(match):
        refuses(rf"x\.fits {match}", open_library, path, NAME, error=DataError)

    refused("cannot be read as .*'test.library'.*no such file")
    path.write_text("not FITS at all")
    refused("cannot be read as library 'test.library'")
    fits.PrimaryHDU(np.zeros(3)).writeto(path, overwrite=True)
    refused("holds no library .*miricigale data add")
    write_library(make("other"), path)
    refused("holds 'other', not 'test.library'")
    refuses(r"cannot be read as library", open_library, tmp_path, NAME, error=DataError)


def test_truncated_and_changed_files_are_found(tmp_path):
    path = tmp_path / "x.fits"
    write_library(make(n_wave=3000), path)
    verify_library(path, NAME)
    whole = path.read_bytes()
    for kept in (0.02, 0.3, 0.5, 0.7, 0.9, 0.999):
        for size in {int(kept * len(whole)), 2880 * int(kept * len(whole) / 2880)}:
            path.write_bytes(whole[:size])
            match = r"x.fits (cannot be read as|is not a complete file of) library"
            refuses(match, open_library, path, NAME, error=DataError)
    # one bit
    for place in (0.1, 0.5, 0.9):
        data = bytearray(whole)
        data[int(place * len(data))] ^= 1
        path.write_bytes(bytes(data))
        refuses(r"x.fits", verify_library, path, NAME, error=DataError)


def test_threads_share_one_library_until_the_file_changes(tmp_path):
    path = tmp_path / "x.fits"
    write_library(make(n_wave=2000), path)
    with ThreadPoolExecutor(8) as pool:
        old, *others = pool.map(lambda _: open_library(path, NAME), range(32))
    assert all(library is old for library in others)
    write_library(make(n_wave=2000, factor=2.0), path)
    new = open_library(path, NAME)
    assert_allclose(new.spectra["dust"], 2.0 * old.spectra["dust"])


# ----------------------------------------------------------------------------- registration


def read_fake(path):
    """A line for each spectrum: tau, q and a number; the last line says 'end'."""
    lines = path.read_text().splitlines()
    if not lines or lines[-1] != "end":
        msg = f"{path} is truncated: the last line must be 'end'"
        raise DataError(msg)
    rows = np.array([[float(x) for x in line.split()] for line in lines[:-1]])
    axes = {"tau": rows[:, 0], "angle": rows[:, 1]}
    options = {"units": {"angle": "deg", "dust": "W / um"}}
    options["meta"] = {"files": {path.name: file_sha256(path)}}
    options["summary"] = (f"{len(rows)} spectra of nothing",)
    spectra = {"dust": rows[:, 2:] * np.ones(7, dtype=np.float32)}
    return LibraryTable(NAME, np.geomspace(1.0, 100.0, 7), axes, spectra, **options)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty data folder, and a library with a reader."""
    monkeypatch.delenv("MIRICIGALE_DATA", raising=False)
    record = Resource(NAME, "user", "A test", "L", "C", "a page", file="sed/test.fits")
    monkeypatch.setattr(registry, "resources", lambda: {NAME: record})
    monkeypatch.setattr(sys.modules["miricigale.refdata.check"], "resources", registry.resources)
    monkeypatch.setitem(READERS, NAME, read_fake)
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        yield tmp_path


def source(folder, text="3 0 1.5\n3 90 2.5\n7 0 3.5\n7 90 4.5\nend\n"):
    path = folder / "fake.dat"
    path.write_text(text)
    return path


def state():
    (row,) = check_resources()
    return row


def expect(wanted, *, bad, message=""):
    row = state()
    assert (row.state, row.bad) == (wanted, bad)
    assert message in row.message


def names(folder):
    """Files that are left in the data folder, without the lock."""
    found = (folder / "data").rglob("*")
    return sorted(p.name for p in found if p.is_file() and p.suffix != ".lock")


def stands(folder, report):
    """What was registered is there, whole and alone."""
    assert names(folder) == ["test.fits", "test.fits.json"]
    assert file_sha256(report.path) == report.sha256
    assert state().state == "ok"


def test_a_library_is_registered_and_found(folder):
    assert find_resource(NAME) is None
    assert state().state == "absent"
    path = source(folder)
    report = add_library(NAME, path)
    assert report.path == locate(NAME) == folder / "data" / "sed" / "test.fits"
    assert names(folder) == ["test.fits", "test.fits.json"]
    library = open_library(report.path, NAME)
    assert library.spectrum("dust", library.row(tau=7, angle=90)) == pytest.approx(4.5)
    found = report.library
    assert (found.n_rows, found.complete, found.wave.size) == (4, True, 7)
    assert found.levels["angle"].tolist() == [0.0, 90.0]
    assert found.units["angle"] == "deg"
    assert report.sha256 == hashlib.sha256(report.path.read_bytes()).hexdigest()
    assert found.meta["files"] == {"fake.dat": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert state().state == "ok"
    # the record
    record = json.loads(record_path(report.path).read_text())
    assert record == stored_record(report.path)
    assert record["source"] == str(path.resolve())
    assert record["files"] == found.meta["files"]
    assert record["sha256"] == report.sha256
    assert record["size"] == report.path.stat().st_size
    assert {"date", "version"} <= set(record)
    # the report in words
    text = str(report)
    parts = ("fake.dat (1 file read)", "2: 0 90 deg", "2 x 2: complete", "4 spectra of nothing")
    kinds = "4 of each kind: dust (W / um); 7 wavelengths, 1 to 100 um"
    for part in (*parts, kinds, record["sha256"], *record["files"].values()):
        assert part in text
    holes = add_library(NAME, source(folder, "3 0 1\n3 90 1\n7 90 2\nend\n"))
    assert "2 x 2: 1 of 4 not there" in str(holes)


@pytest.mark.parametrize(("text", "message"), cases_of(__file__, "refused"))
def test_a_refused_library_leaves_the_old_one(folder, text, message):
    before = add_library(NAME, source(folder))
    path = source(folder, text)
    refuses(message, add_library, NAME, path, error=DataError)
    stands(folder, before)


def test_a_better_library_replaces_the_old_one(folder):
    old = add_library(NAME, source(folder))
    opened = open_library(old.path, NAME)
    mark = fingerprint(NAME)
    assert mark == old.sha256
    new = add_library(NAME, source(folder, "3 0 9.5\nend\n"))
    assert fingerprint(NAME) == new.sha256 != mark
    # whoever works with the old one goes on with it
    assert opened.spectrum("dust", 3) == pytest.approx(4.5)
    assert open_library(new.path, NAME).n_rows == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError("No space left on device")])
@pytest.mark.parametrize(
    "place", [(os, "fsync"), (register, "verify_library"), (register, "file_sha256")]
)
def test_an_interrupted_conversion_changes_nothing(folder, monkeypatch, error, place):
    before = add_library(NAME, source(folder))
    path = source(folder, "3 0 9.5\nend\n")
    with monkeypatch.context() as patch:
        patch.setattr(*place, mock.Mock(side_effect=error))
        refuses(None, add_library, NAME, path, error=(KeyboardInterrupt, OSError))
    stands(folder, before)


def test_what_a_killed_process_left_is_ignored_and_swept(folder):
    report = add_library(NAME, source(folder))
    left = report.path.with_name(f"{PARTIAL}1-abc-{report.path.name}")
    left.write_bytes(b"half")
    assert locate(NAME) == report.path
    assert state().state == "ok"
    stands(folder, add_library(NAME, source(folder)))


def test_a_process_that_dies_between_file_and_record_leaves_a_library_that_works(
    folder, monkeypatch
):
    add_library(NAME, source(folder))
    replace = os.replace

    def die(old, new):
        if str(new).endswith(".json"):
            raise KeyboardInterrupt
        replace(old, new)

    path = source(folder, "3 0 9.5\nend\n")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", die)
        refuses(None, add_library, NAME, path, error=KeyboardInterrupt)
    assert open_library(locate(NAME), NAME).spectrum("dust", 0) == pytest.approx(9.5)
    assert state().state == "unchecked"
    assert fingerprint(NAME) == file_sha256(locate(NAME))


class AskedLock(FileLock):
    """A lock that tells when somebody has found it taken and waits."""

    found_taken = threading.Event()

    def _acquire(self):
        super()._acquire()
        if not self.is_locked:
            self.found_taken.set()


def test_who_comes_second_waits_for_the_first(folder, monkeypatch):
    before = add_library(NAME, source(folder))
    path = source(folder, "3 0 9.5\nend\n")
    monkeypatch.setattr(AskedLock, "found_taken", threading.Event())
    monkeypatch.setattr("miricigale.refdata.libraries.register.FileLock", AskedLock)
    with ThreadPoolExecutor(1) as pool:
        with FileLock(before.path.with_name(f".{before.path.name}.lock")):
            later = pool.submit(add_library, NAME, path)
            # the limit is for a machine that hangs
            assert AskedLock.found_taken.wait(timeout=600)
            assert not later.done()
            stands(folder, before)
        stands(folder, later.result(timeout=600))


def test_damage_is_told(folder):
    report = add_library(NAME, source(folder))
    whole = report.path.read_bytes()
    report.path.write_bytes(whole[:5000])
    expect("damaged", bad=True, message="test.fits")
    other = bytearray(whole)
    other[-2000] ^= 1
    report.path.write_bytes(bytes(other))
    expect("damaged", bad=True)
    # a whole library, but not the one of the record
    write_library(read_fake(source(folder, "1 2 3\nend\n")), report.path)
    expect("wrong checksum", bad=True)
    record_path(report.path).write_text("{")
    expect("damaged", bad=True, message="test.fits.json cannot be read")
    record_path(report.path).unlink()
    expect("unchecked", bad=False)
    report.path.write_text("something else")
    expect("damaged", bad=True)


def test_names_and_readers_are_checked(folder, monkeypatch):
    path = source(folder)
    with pytest.raises(KeyError, match=r"no library 'ssp.bc03'; known: .*test.library"):
        add_library("ssp.bc03", path)
    with pytest.raises(DataError, match=r"absent.dat is no file or folder"):
        add_library(NAME, folder / "absent.dat")
    monkeypatch.setitem(READERS, NAME, lambda path: make("other"))
    refuses("holds 'other', not 'test.library'", add_library, NAME, path, error=DataError)
    assert names(folder) == []


def test_every_reader_has_a_record_of_a_user_library():
    for name, reader in READERS.items():
        record = refdata.resource(name)
        assert record.kind == "user"
        assert record.file.endswith(".fits")
        assert callable(pkgutil.resolve_name(reader) if isinstance(reader, str) else reader)
