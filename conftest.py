"""Tests see neither the data nor the caches of whoever runs them."""

import shutil
import tempfile
from pathlib import Path


def pytest_configure(config):
    from miricigale.refdata import conf

    config.own_folder = Path(tempfile.mkdtemp(prefix="miricigale-tests-"))
    conf.data_folder = str(config.own_folder / "data")
    conf.cache_folder = str(config.own_folder / "cache")


def pytest_unconfigure(config):
    shutil.rmtree(config.own_folder, ignore_errors=True)
