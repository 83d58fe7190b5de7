"""Memory of the process."""

import ctypes
import os
import sys

#: Growth of the process in bytes that is worth a walk through all free memory.
_WORTH = 32_000_000
#: Its size in bytes when memory was last given back, or less if it has shrunk since.
_sizes = [0]


def _malloc_trim():
    """Return glibc's function that gives freed memory back; None for other C libraries."""
    if sys.platform != "linux":
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None


def _resident():
    """Size of this process in memory, in bytes, as Linux tells it."""
    with open("/proc/self/statm", "rb") as file:
        n_pages = int(file.read().split()[1])
    return n_pages * os.sysconf("SC_PAGE_SIZE")


def return_freed_memory():
    """
    Give memory that Python has freed back to the system, where the C library can (glibc).

    Notes
    -----
    glibc keeps freed arrays of up to 32 MB for later ones. Where stages of a calculation need arrays of other
    sizes, what one stage has freed is of no use to the next, and the process grows. Takes some milliseconds, more
    in a process that has many pieces of free memory: nothing is done until it has grown by 32 MB since.
    """
    trim = _malloc_trim()
    if trim is None:
        return
    size = _resident()
    _sizes[0] = min(_sizes[0], size)
    if size > _sizes[0] + _WORTH:
        trim(ctypes.c_size_t(0))
        _sizes[0] = _resident()
