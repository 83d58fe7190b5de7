"""Files that cannot be read are named."""

import errno

import numpy as np
import pytest
from astropy.io import fits

from miricigale.utils.exceptions import DataError
from miricigale.utils.files import open_fits, read_ecsv, writing


def test_a_good_file_is_open(tmp_path):
    fits.PrimaryHDU(np.arange(6)).writeto(tmp_path / "a.fits")
    with open_fits(tmp_path / "a.fits", wanted="an image", memmap=False) as hdus:
        assert hdus[0].data.tolist() == list(range(6))


@pytest.mark.parametrize("reader", [open_fits, read_ecsv])
def test_missing_and_foreign_files_are_named(tmp_path, reader):
    with pytest.raises(DataError, match=r"none\.x cannot be read as a kernel: no such file"):
        reader(tmp_path / "none.x", wanted="a kernel")
    for text in ("", "not a file of that kind"):
        (tmp_path / "text.x").write_text(text)
        with pytest.raises(DataError, match=r"text\.x cannot be read as a kernel: \w"):
            reader(tmp_path / "text.x", wanted="a kernel")


def test_truncated_files_are_named(tmp_path):
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(np.zeros((100, 100)), name="SCI")]
    fits.HDUList(hdus).writeto(tmp_path / "whole.fits")
    part = (tmp_path / "whole.fits").read_bytes()[:20000]
    (tmp_path / "part.fits").write_bytes(part)
    with pytest.raises(DataError, match=r"part\.fits cannot be read as an image: .*truncated"):
        open_fits(tmp_path / "part.fits", wanted="an image")


def test_a_file_that_could_not_be_written_is_named(tmp_path, full_disk):
    path, partial = tmp_path / "a.fits", tmp_path / "a.partial"
    with full_disk(5000):
        # Python's files tell the number of the error, numpy's do not
        with pytest.raises(OSError, match=r"\[Errno \d+\] .*: '.*a\.fits'") as info, writing(path):
            partial.write_bytes(bytes(9000))
        assert info.value.errno == errno.EFBIG
        with (
            pytest.raises(OSError, match=r"a\.fits could not be written \(is the disk full\?\)"),
            writing(path),
        ):
            fits.PrimaryHDU(np.zeros(9000)).writeto(path)


def test_errors_that_say_what_they_are_about_are_left_alone(tmp_path):
    for wanted in (DataError("no such exposure"), FileNotFoundError(2, "none", "b.fits")):
        with pytest.raises(OSError) as info, writing(tmp_path / "a.fits"):
            raise wanted
        assert info.value is wanted
