import pytest

from helpers import scenes


@pytest.fixture
def wcs():
    return scenes.tan_wcs()


@pytest.fixture
def psf():
    return scenes.gaussian_psf()
