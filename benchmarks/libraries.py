"""
Time libraries of spectra: writing, opening, a row, checking.

    python benchmarks/libraries.py

The library has the axes of SKIRTOR, 19,200 rows, with six kinds of spectra (63 MB).
"""

import itertools
import tempfile
import time
from pathlib import Path

import numpy as np

from miricigale.refdata.libraries import LibraryTable, open_library, verify_library, write_library

AXES = {
    "tau97": (3, 5, 7, 9, 11),
    "p": (0, 0.5, 1, 1.5),
    "q": (0, 0.5, 1, 1.5),
    "opening_angle": range(10, 90, 10),
    "radius_ratio": (10, 20, 30),
    "inclination": range(0, 100, 10),
}


def resident():
    """Resident memory in MB (Linux)."""
    text = Path("/proc/self/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0]) / 1e3


def timed(what, function):
    before, start = resident(), time.perf_counter()
    result = function()
    seconds = time.perf_counter() - start
    print(f"{what:30s} {1e3 * seconds:9.2f} ms, {resident() - before:+6.1f} MB")
    return result


def main():
    rows = np.array(list(itertools.product(*AXES.values())), dtype=float)
    rng = np.random.default_rng(1)
    library = LibraryTable(
        name="benchmark",
        wave=np.geomspace(1e-3, 1e3, 132),
        axes=dict(zip(AXES, rows.T, strict=True)),
        spectra={f"k{k}": rng.random((len(rows), 132), dtype=np.float32) for k in range(6)},
        meta={"files": {f"{k}.dat": "0" * 64 for k in range(len(rows))}},
    )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "library.fits"
        timed("write", lambda: write_library(library, path))
        print(f"{path.stat().st_size / 1e6:.1f} MB")
        opened = timed("open", lambda: open_library(path, "benchmark"))
        timed("open again", lambda: open_library(path, "benchmark"))
        where = {name: values[1] for name, values in AXES.items()}
        row = timed("find a row", lambda: opened.row(**where))
        timed("read a row", lambda: opened.spectrum("k3", row))
        timed("check all", lambda: verify_library(path, "benchmark"))


if __name__ == "__main__":
    main()
