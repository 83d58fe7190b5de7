"""Files that cannot be read are named."""

import errno
import gzip
import importlib
import subprocess
import sys
import textwrap
import zipfile

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from helpers.errors import refuses
from miricigale import conf
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits, packed_open, unpacked_size, writing
from miricigale.utils.table_files import read_table


def read_ecsv(path, wanted):
    return read_table(path, wanted=wanted, form="ascii.ecsv")


@pytest.mark.parametrize("name", ["t.fits", "t.fits.gz", "t.xml", "t.ecsv", "t.csv", "t.txt"])
def test_tables_are_recognized_by_content_and_name(tmp_path, name):
    table = QTable({"id": [1, 2], "name": ["a", "b"], "x": [1.5, 2.5]})
    kind = {"t.xml": "votable", "t.txt": "ascii"}.get(name)
    table.write(tmp_path / name, format=kind)
    if name in ("t.fits", "t.ecsv"):
        (tmp_path / name).rename(tmp_path / "t.other")
        name = "t.other"
    back = read_table(tmp_path / name, wanted="a table")
    assert isinstance(back, QTable)
    assert back.colnames == table.colnames
    for column in table.colnames:
        assert np.asarray(back[column]).tolist() == np.asarray(table[column]).tolist()


def opened(path, wanted):
    with open_fits(path, wanted=wanted) as hdus:
        return [hdu.name for hdu in hdus]


def not_read(match, path, reader=opened):
    refuses(match, reader, path, error=DataError, wanted="a kernel")


@pytest.mark.parametrize("reader", [opened, read_ecsv])
def test_missing_and_foreign_files_are_named(tmp_path, reader):
    not_read("none.x cannot be read as a kernel: no such file", tmp_path / "none.x", reader)
    not_read("cannot be read as a kernel: it is a folder, wanted is a file", tmp_path, reader)
    for text in ("", "not a file of that kind"):
        (tmp_path / "text.x").write_text(text)
        not_read(r"text\.x cannot be read as a kernel: \w", tmp_path / "text.x", reader)


def test_truncated_files_are_named(tmp_path):
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.zeros((100, 100)), name="SCI")]
    path = tmp_path / "part.fits"
    fits.HDUList(hdus).writeto(path)
    path.write_bytes(path.read_bytes()[:20000])
    not_read(r"part\.fits cannot be read as a kernel: .*truncated", path)


def test_text_that_would_take_far_more_memory_than_its_bytes_is_refused(tmp_path):
    path = tmp_path / "small.ecsv"
    columns = (
        "# - {name: id, datatype: int64}\n# - {name: v, datatype: string, subtype: 'float64[%s]'}\n"
    )
    for shape, wanted in (
        ("1000000000", "arrays of 1000000000 numbers"),
        ("9999,999,null", "9999,999"),
    ):
        path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n{columns % shape}id v\n1 [1.0]\n")
        not_read(rf"small\.ecsv cannot .* it declares .*{wanted}", path, read_table)
    path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n{columns % 2}id v\n1 [1.0,2.0]\n")
    assert read_table(path, wanted="a table")["v"].tolist() == [[1.0, 2.0]]
    path = tmp_path / "wide.csv"
    path.write_text("id,flux\n1,2.0\n2," + "1" * 3_000_000 + "\n")
    not_read(r"wide\.csv cannot .* a line is longer than", path, read_table)
    path.write_text("id,flux\n" + "1,2.0\n" * 500_000)
    assert len(read_table(path, wanted="a table")) == 500_000


def test_damaged_headers_are_named(tmp_path):
    path = tmp_path / "bad.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(np.zeros((9, 9)), name="SCI")]).writeto(path)
    whole = path.read_bytes()
    for old, new in (
        (b"NAXIS1  =                    9", b"NAXIS1  =                   -9"),
        (b"XTENSION= 'IMAGE", b"XTENSION= 'EGAMI"),
    ):
        path.write_bytes(whole.replace(old, new))
        not_read(r"bad\.fits cannot be read as a kernel: ", path)
    path.write_bytes(whole)
    # what goes wrong with what is in a file
    with (
        pytest.raises(
            DataError, match=r"bad\.fits cannot be read as a kernel: .*no attribute 'none'"
        ),
        open_fits(path, wanted="a kernel") as hdus,
    ):
        hdus[1].none  # noqa: B018
    with pytest.raises(ValueError, match="pixels") as info, open_fits(path, wanted="a kernel"):
        raise ValueError("too many pixels")
    assert info.value.__notes__ == [f"in {path}"]


def test_a_file_that_could_not_be_written_is_named(tmp_path, full_disk):
    path, partial = tmp_path / "a.fits", tmp_path / "a.partial"
    with full_disk(5000):
        # Python's files tell the number of the error, numpy's do not
        with pytest.raises(OSError, match=r"\[Errno \d+\] .*: '.*a\.fits'") as info, writing(path):
            partial.write_bytes(bytes(9000))
        assert info.value.errno == errno.EFBIG
        match = r"a\.fits could not be written \(is the disk full\?\)"
        with pytest.raises(OSError, match=match), writing(path):
            fits.PrimaryHDU(np.zeros(9000)).writeto(path)
    # a file under a temporary name within another is not named
    with pytest.raises(OSError) as info, writing(path), writing(partial):
        raise OSError("9000 requested and 100 written")
    assert (
        str(info.value)
        == f"{path} could not be written (is the disk full?): 9000 requested and 100 written"
    )


def test_errors_that_say_what_they_are_about_are_left_alone(tmp_path):
    for wanted in (DataError("no such exposure"), FileNotFoundError(2, "none", "b.fits")):
        with pytest.raises(OSError) as info, writing(tmp_path / "a.fits"):
            raise wanted
        assert info.value is wanted


def pack(module, path, n_mb):
    """Pack zeros."""
    with importlib.import_module(module).open(path, "wb") as stream:
        for _ in range(n_mb):
            stream.write(bytes(1_000_000))


@pytest.mark.parametrize("module", ["gzip", "bz2", "lzma"])
def test_what_unpacks_beyond_the_bound_is_refused_by_name(tmp_path, module):
    path = tmp_path / "bomb"
    pack(module, path, 3)
    assert unpacked_size(path) == 3_000_000
    with conf.set_temp("unpacked_size", 3):
        assert unpacked_size(path) == 3_000_000
    wanted = r"bomb \(.* MB .*\) would unpack to more than 0\.002 GB, .* bound is 0\.002 GB"
    with conf.set_temp("unpacked_size", 2):
        for reader in (opened, read_ecsv):
            not_read(wanted + ".*raise .*conf.unpacked_size", path, reader)


def test_a_bomb_takes_no_memory(tmp_path):
    # part of its content is not counted by the last bytes of a file of several members
    path = tmp_path / "bomb.fits.gz"
    pack("gzip", path, 100)
    path.write_bytes(3 * path.read_bytes())
    code = """
        import resource, sys
        from miricigale.utils.files import open_fits
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        from miricigale import conf
        conf.unpacked_size = 250
        try:
            with open_fits(sys.argv[1], wanted="an image"):
                pass
        except OSError as err:
            assert "more than 0.25 GB" in str(err), err
        else:
            raise SystemExit("opened")
        print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1e3)
    """
    pytest.importorskip("resource")
    command = [sys.executable, "-c", textwrap.dedent(code), str(path)]
    grown = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    # kB on Linux, bytes on macOS
    assert grown < 50 * (1000 if sys.platform == "darwin" else 1)


def test_a_large_file_may_unpack_to_eight_times_its_size(tmp_path):
    path = tmp_path / "noise.gz"
    noise = np.random.default_rng(1).bytes(500_000)
    with gzip.open(path, "wb") as stream:
        stream.write(noise + bytes(3_000_000))
    with conf.set_temp("unpacked_size", 1):
        assert unpacked_size(path) == 3_500_000
        with gzip.open(path, "wb") as stream:
            stream.write(noise + bytes(4_000_000))
        refuses("would unpack", unpacked_size, path, error=DataError)


def test_a_zip_archive_is_not_unpacked_beyond_the_bound(tmp_path):
    path = tmp_path / "table.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("table.csv", bytes(3_000_000))
    with conf.set_temp("unpacked_size", 3), packed_open(path) as stream:
        assert len(stream.read()) == 3_000_000
    with conf.set_temp("unpacked_size", 2):
        refuses("would unpack", packed_open, path, error=DataError)


def test_members_of_zip_files_are_counted_together(tmp_path):
    path = tmp_path / "two.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in ("a", "b"):
            archive.writestr(name, bytes(600_000))
    with conf.set_temp("unpacked_size", 1), pytest.raises(DataError, match=r"to 0\.0012 GB"):
        unpacked_size(path)
    assert unpacked_size(path) == 1_200_000


@pytest.mark.parametrize("start", [b"\x1f\x8b\x08\x00", b"BZh91AY", b"\xfd7zXZ\x00", b"PK\x03\x04"])
def test_damaged_packings_are_named(tmp_path, start):
    path = tmp_path / "broken.fits.x"
    path.write_bytes(start + bytes(5000))
    not_read(r"broken\.fits\.x cannot be read as a packed file: \w", path)
    path.write_bytes(b"\x1f\x9d" + bytes(5000))
    not_read("packed by 'compress'; unpack it first", path)


def test_a_packed_header_may_not_declare_more_than_there_is(tmp_path):
    header = fits.PrimaryHDU(np.zeros((10, 10))).header
    header["NAXIS2"] = 10_000_000_000
    path = tmp_path / "image.fits.gz"
    with gzip.open(path, "wb") as stream:
        stream.write(header.tostring().encode() + bytes(2880))
    not_read(r"image\.fits\.gz cannot be read as a kernel: truncated", path)
    data = np.arange(100.0).reshape(10, 10)
    fits.PrimaryHDU(data).writeto(path, overwrite=True)
    with open_fits(path, wanted="an image") as hdus:
        np.testing.assert_array_equal(hdus[0].data, data)


def test_tiles_may_not_unpack_beyond_the_bound(tmp_path):
    path = tmp_path / "tiles.fits"
    hdu = fits.CompImageHDU(np.zeros((1000, 500), np.float32), compression_type="GZIP_1")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)
    with conf.set_temp("unpacked_size", 1):
        not_read(r"to 0\.002 GB", path)
    with conf.set_temp("unpacked_size", 2), open_fits(path, wanted="an image") as hdus:
        assert hdus[1].data.shape == (1000, 500)


def test_large_files_that_are_not_packed_are_not_bound(tmp_path):
    path = tmp_path / "large.fits"
    fits.PrimaryHDU(np.random.default_rng(1).normal(size=(500, 500))).writeto(path)
    with conf.set_temp("unpacked_size", 1), open_fits(path, wanted="an image") as hdus:
        assert hdus[0].shape == (500, 500)
