"""Spectral libraries that users bring: read as distributed, kept as memory-mapped FITS."""

from miricigale.utils.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "register": ("READERS", "Report", "add_library"),
        "table": ("LibraryTable", "open_library", "verify_library", "write_library"),
    },
)
