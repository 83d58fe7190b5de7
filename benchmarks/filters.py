"""
Time the filters.

    python benchmarks/filters.py
"""

import subprocess
import sys
import time

import numpy as np

from miricigale.filters import Filter, FilterSet

BANDS = [
    "megacam.u",
    "megacam.g",
    "megacam.r",
    "megacam.i",
    "megacam.z",
    "acs.f606w",
    "acs.f814w",
    "wfc3.f125w",
    "wfc3.f140w",
    "wfc3.f160w",
    "irac.ch1",
    "irac.ch2",
    "irac.ch3",
    "irac.ch4",
    "mips.24",
    "miri.f770w",
    "miri.f1000w",
    "miri.f1280w",
    "miri.f1500w",
    "miri.f1800w",
    "miri.f2100w",
]


def clock(function, n):
    start = time.perf_counter()
    for _ in range(n):
        function()
    return (time.perf_counter() - start) / n


def main():
    cold = clock(
        lambda: subprocess.run(
            [
                sys.executable,
                "-c",
                "from miricigale.filters import Filter; Filter.from_name('miri.f770w')",
            ],
            check=True,
        ),
        3,
    )
    first = clock(lambda: FilterSet.from_names(BANDS), 1)
    filters = FilterSet.from_names(BANDS)
    rows = [
        ("new process to the first filter", cold),
        ("21 filters, read", first),
        (
            "every filter of the library, read",
            clock(lambda: [Filter.from_name(n) for n in Filter.names()], 1),
        ),
    ]
    for n in (1000, 4000, 16000):
        wave = np.geomspace(0.05, 1000, n)
        filters.weights(wave)
        rows.append(
            (f"weights, 21 filters x {n} wavelengths", clock(lambda w=wave: filters.weights(w), 20))
        )
    for label, seconds in rows:
        print(f"{label:45s} {seconds * 1e3:9.2f} ms")


if __name__ == "__main__":
    main()
