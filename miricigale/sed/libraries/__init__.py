"""Spectral libraries that users bring: read as distributed, kept as memory-mapped FITS."""

from miricigale.sed.libraries.table import LibraryTable, open_library, write_library

__all__ = ["LibraryTable", "open_library", "write_library"]
