"""Real files by other people, for tests: they are read where they lie, and not part of the package."""

import os
from pathlib import Path

import pytest

__all__ = ["real_file"]


def real_file(name):
    """Path of a file in the folder of the variable MIRICIGALE_DATA; the test is skipped without it."""
    path = Path(os.environ.get("MIRICIGALE_DATA", "")) / name
    if not os.environ.get("MIRICIGALE_DATA") or not path.exists():
        pytest.skip(f"no real file {name} in the folder of MIRICIGALE_DATA")
    return path
