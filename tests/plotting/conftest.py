import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure


@pytest.fixture
def ax():
    """Axes of a figure that belongs to no window."""
    return Figure().subplots()


@pytest.fixture(autouse=True)
def no_figure_is_left():
    """What draws on given axes opens no figure of pyplot's."""
    before = plt.get_fignums()
    yield
    assert plt.get_fignums() == before
