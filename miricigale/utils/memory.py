"""Memory of the process."""

import ctypes
import sys


def _malloc_trim():
    """Return glibc's function that gives freed memory back; None for other C libraries."""
    if sys.platform != "linux":
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (OSError, AttributeError):
        return None


def return_freed_memory():
    """
    Give memory that Python has freed back to the system, where the C library can (glibc).

    Notes
    -----
    glibc keeps freed arrays of up to 32 MB for later ones. Where stages of a calculation need arrays of other
    sizes, what one stage has freed is of no use to the next, and the process grows. Takes some milliseconds.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(ctypes.c_size_t(0))
