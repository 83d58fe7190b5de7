"""Cases of tests that are plain values, in a TOML file of the test file's name beside it."""

import tomllib
from pathlib import Path

__all__ = ["cases_of"]


def cases_of(file, name=None):
    """Table ``name`` of the cases beside a test file; all of them if not given."""
    tables = tomllib.loads(Path(file).with_suffix(".toml").read_text("utf-8"))
    return tables if name is None else tables[name]
