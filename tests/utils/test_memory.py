"""Memory that is given back to the system."""

import sys

import numpy as np
import pytest

from miricigale.utils.memory import return_freed_memory


def resident():
    """Memory of this process in bytes."""
    with open("/proc/self/status") as file:
        line = next(line for line in file if line.startswith("VmRSS"))
    return int(line.split()[1]) * 1024


@pytest.mark.skipif(sys.platform != "linux", reason="another C library")
def test_freed_arrays_go_back_to_the_system():
    # of 100 kB, which come from the heap: one in ten is held, so that the heap cannot shrink from its end
    arrays = [np.ones(12_500) for _ in range(2000)]
    held = arrays[::10]
    full = resident()
    del arrays
    return_freed_memory()
    # nine tenths of 200 MB are free
    assert full - resident() > 120e6
    assert len(held) == 200
