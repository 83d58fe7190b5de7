"""Spectral libraries that users bring: read as distributed, kept as memory-mapped FITS."""

from miricigale.sed.libraries.register import READERS, Report, add_library, openers
from miricigale.sed.libraries.table import (
    LibraryTable,
    open_library,
    verify_library,
    write_library,
)

__all__ = [
    "READERS",
    "LibraryTable",
    "Report",
    "add_library",
    "open_library",
    "openers",
    "verify_library",
    "write_library",
]
