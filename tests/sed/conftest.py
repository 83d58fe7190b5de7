import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_file():
    """Path of a file of the development data, or a skip that names it."""

    def find(name):
        folder = os.environ.get("MIRICIGALE_DATA")
        if not folder or not (Path(folder) / name).exists():
            pytest.skip(f"needs {name} in $MIRICIGALE_DATA")
        return Path(folder) / name

    return find


@pytest.fixture(scope="session")
def model():
    from miricigale.sed import SEDModel

    return SEDModel.yang2021()


@pytest.fixture(scope="session")
def filters():
    from miricigale.filters import FilterSet

    return FilterSet.from_names(
        ["megacam.g", "wfc3.f160w", "irac.ch1", "mips.24", "miri.f770w", "miri.f2100w"]
    )
