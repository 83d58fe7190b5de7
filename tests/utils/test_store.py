"""Files of our own: whole or not at all, and read back as they were."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io.registry import IORegistryError
from astropy.table import QTable

from helpers.errors import refuses
from miricigale.utils.exceptions import DataError
from miricigale.utils.file_formats import read_write, register
from miricigale.utils.files import replacing
from miricigale.utils.store import open_parts, write_parts


def test_what_stood_there_stays_when_writing_fails(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError, match="stop"), replacing(path) as partial:  # noqa: PT012
        partial.write_text("new")
        msg = "stop"
        raise RuntimeError(msg)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]
    with replacing(path) as partial:
        assert partial.suffix == path.suffix
        partial.write_text("new")
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]
    with pytest.raises(OSError, match="overwrite=True"), replacing(path, overwrite=False):
        pass


def test_parts_come_back(tmp_path):
    path = tmp_path / "a.fits"
    table = QTable({"id": ["a", "bb"], "flux": [1.0, np.nan] * u.uJy, "n": np.array([3, 4])})
    table.meta["citations"] = ["x" * 100]
    arrays = {"pdf": np.arange(24.0).reshape(2, 3, 4), "used": np.array([True, False])}
    arrays |= {"wave": [1.5, 2.5] * u.um, "none": np.zeros((0, 3))}
    text = {"meta": {"n": np.int64(3), "values": np.arange(3.0), "text": "\u03bb"}}
    write_parts(path, "test-1", text=text, arrays=arrays, tables={"rows": table})
    refuses("overwrite", write_parts, path, "test-1", error=OSError)
    before = path.read_bytes()
    write_parts(path, "test-1", text=text, arrays=arrays, tables={"rows": table}, overwrite=True)
    assert path.read_bytes() == before
    assert table.meta["citations"]
    with open_parts(path, ("test-2", "test-1"), wanted="a test", memmap=True) as parts:
        assert parts.layout == "test-1"
        assert parts.text == {"meta": {"n": 3, "values": [0.0, 1.0, 2.0], "text": "\u03bb"}}
        np.testing.assert_array_equal(parts.array("pdf"), arrays["pdf"])
        assert parts.array("pdf").dtype.isnative
        np.testing.assert_array_equal(parts.array("used"), [1, 0])
        assert "none" not in parts
        assert "pdf" in parts
        got = parts.table("rows", QTable)
    assert got["id"].tolist() == ["a", "bb"]
    assert got["flux"].unit == u.uJy
    np.testing.assert_array_equal(got["n"], table["n"])


def test_incomplete_and_foreign_files_are_named(tmp_path):
    path = tmp_path / "a.fits"
    write_parts(path, "test-1", arrays={"a": np.ones(3)})

    def read(layout, name):
        with open_parts(path, (layout,), wanted="fit results") as parts:
            return parts.array(name)

    match = r"a\.fits is not a complete file of fit results"
    refuses(match, read, "test-1", "b", error=DataError)
    refuses(r"a\.fits holds no fit results", read, "other-1", "a", error=DataError)
    match = r"layout 'test-1' of another version of the package, and this one reads 'test-2'"
    refuses(match, read, "test-2", "a", error=DataError)


class Number:
    io_module = __name__
    read, write = read_write("a number")

    def __init__(self, value):
        self.value = value


def _write(number, path, *, overwrite=False):
    write_parts(path, "number-1", arrays={"n": np.array([number.value])}, overwrite=overwrite)


def _read(path):
    with open_parts(path, ("number-1",), wanted="a number") as parts:
        return Number(parts.array("n")[0])


register(Number, read=_read, write=_write)


def test_read_and_write_are_unified_methods(tmp_path):
    Number(3.0).write(tmp_path / "a.fits")
    assert Number.read(tmp_path / "a.fits").value == 3.0
    Number(4.0).write(tmp_path / "b.dat", format="fits")
    assert Number.read(str(tmp_path / "b.dat"), format="fits").value == 4.0
    for name in ("a.ecsv", "b.dat"):
        match = rf"{name} must end in one of \.fits"
        refuses(match, Number(5.0).write, tmp_path / name, error=IORegistryError)
    assert "Read a number from" in Number.read.__doc__
    refuses(r"c\.fits", Number.read, tmp_path / "c.fits", error=DataError)
