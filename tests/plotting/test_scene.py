import numpy as np
from matplotlib.colors import AsinhNorm
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal

from helpers.figures import line_data
from miricigale.plotting.scene import plot_scene

IMAGE = np.random.default_rng(3).normal(5.0, 0.01, (30, 40))
IMAGE[10, 20] = 8.0


def test_an_image_is_drawn_about_its_median_with_marks(ax):
    assert plot_scene(IMAGE, ax=ax, marks=([1.0, 7.0], [2.0, 3.0]), label="MJy/sr") is ax
    (drawn,) = ax.images
    assert_array_equal(drawn.get_array(), IMAGE - np.median(IMAGE))
    assert isinstance(drawn.norm, AsinhNorm)
    assert drawn.origin == "lower"
    low, high = np.percentile(IMAGE, [2, 99.9]) - np.median(IMAGE)
    assert_allclose((drawn.norm.vmin, drawn.norm.vmax), (low, high))
    assert_array_equal(line_data(ax, "o")[0], [[1.0, 2.0], [7.0, 3.0]])
    # the label states what was subtracted: nothing where the median is within the noise
    plot_scene(IMAGE - 5.0, ax=(other := Figure().subplots()), label="MJy/sr")
    assert_array_equal(other.images[0].get_array(), IMAGE - 5.0)


def test_limits_of_the_colors_are_those_asked_for(ax):
    plot_scene(IMAGE, ax=ax, vmin=4.0, vmax=6.0, cmap="viridis", label="MJy/sr")
    (drawn,) = ax.images
    assert_array_equal(drawn.get_array(), IMAGE)
    assert (drawn.norm.vmin, drawn.norm.vmax) == (4.0, 6.0)
    assert drawn.get_cmap().name == "viridis"


def test_a_flat_image_and_one_with_gaps_draw(ax):
    plot_scene(np.full((4, 5), 2.0), ax=ax)
    holed = IMAGE.copy()
    holed[3, 4] = np.nan
    plot_scene(holed, ax=ax)
    assert ax.images[1].get_array().mask[3, 4]
