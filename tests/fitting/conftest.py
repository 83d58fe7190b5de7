import pytest

from helpers import grids


@pytest.fixture(scope="session")
def grid():
    return grids.make_grid()


@pytest.fixture(scope="session")
def photometry(grid):
    return grids.draw_photometry(grid, 12, missing=0.1)[0]
