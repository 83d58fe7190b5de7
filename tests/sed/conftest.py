import pytest


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
