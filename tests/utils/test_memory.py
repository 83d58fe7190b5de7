"""Memory that is given back to the system."""

import sys

import numpy as np
import pytest

from miricigale.utils import memory
from miricigale.utils.memory import return_freed_memory


def resident():
    """Memory of this process in bytes."""
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="another C library")


def test_freed_arrays_go_back_to_the_system():
    # what other tests have freed is no matter
    return_freed_memory()
    # of 100 kB, which come from the heap: one in ten is held, so that the heap cannot shrink from its end
    arrays = [np.ones(12_500) for _ in range(2000)]
    held = arrays[::10]
    full = resident()
    del arrays
    return_freed_memory()
    # nine tenths of 200 MB are free
    assert full - resident() > 120e6
    assert len(held) == 200


def test_nothing_is_done_until_the_process_has_grown(monkeypatch):
    sizes = [500e6, 520e6, 540e6, 505e6, 530e6, 400e6, 425e6, 440e6, 410e6]
    n_given_back = []
    monkeypatch.setattr(memory, "_sizes", [480e6])
    monkeypatch.setattr(memory, "_resident", lambda: sizes.pop(0))
    monkeypatch.setattr(memory, "_malloc_trim", lambda: n_given_back.append)
    while sizes:
        return_freed_memory()
    # at 520 and 440 MB, which 540 and 410 are left of
    assert len(n_given_back) == 2
