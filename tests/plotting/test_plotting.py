"""Figures show the numbers that they are given, on the axes that they are given."""

import numpy as np
import pytest
from matplotlib.figure import Figure

from miricigale.plotting.axes import new_figure
from miricigale.plotting.comparison import (
    plot_counts,
    plot_error_function,
    plot_histogram,
    plot_magnitudes,
    plot_offsets,
    plot_redshifts,
    plot_relation,
)
from miricigale.plotting.filters import plot_filters
from miricigale.plotting.scene import plot_scene
from miricigale.plotting.spectra import plot_photometry, plot_spectrum


@pytest.fixture
def ax():
    return Figure().subplots()


def points(ax, style):
    """Data of the lines of one marker or line style."""
    return [line.get_xydata() for line in ax.lines if style in (line.get_marker(), line.get_ls())]


def test_a_new_figure_has_a_grid_of_axes_and_no_window():
    import matplotlib.pyplot as plt

    before = plt.get_fignums()
    figure, axes = new_figure(2, 3)
    assert axes.shape == (2, 3)
    assert all(one.figure is figure for one in axes.flat)
    assert plt.get_fignums() == before


def test_magnitudes_leave_out_what_is_not_measured(ax):
    true = np.array([20.0, 22.0, 24.0])
    assert plot_magnitudes(true, [20.1, np.nan, 23.9], ax=ax, lost=[25.0], title="F770W") is ax
    np.testing.assert_allclose(points(ax, ".")[0], [[20, 20.1], [24, 23.9]])
    assert points(ax, "|")[0][0, 0] == 25.0
    # bright sources are at the top
    assert ax.get_ylim()[0] > ax.get_ylim()[1]
    assert ax.get_title() == "F770W"


def test_offsets_beyond_the_limit_are_arrows_at_its_edge(ax):
    running = [20.5], np.array([0.1]), np.array([0.2])
    assert plot_offsets([20.0, 21.0, 22.0], [0.1, 3.0, -2.0], running=running, ax=ax) is ax
    np.testing.assert_allclose(points(ax, ".")[0], [[20, 0.1]])
    np.testing.assert_allclose(points(ax, "^")[0], [[21, 0.97]])
    np.testing.assert_allclose(points(ax, "v")[0], [[22, -0.97]])
    np.testing.assert_allclose(points(ax, "o")[0], [[20.5, 0.1]])


def test_error_functions_meet_their_limits_at_five_sigma(ax):
    flux = {"a": np.geomspace(0.1, 10, 5), "b": np.geomspace(0.1, 10, 5)}
    sigma = {"a": np.full(5, 0.2), "b": np.full(5, 0.3)}
    assert plot_error_function(flux, sigma, limits={"a": 1.0, "b": np.nan}, ax=ax) is ax
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 0.2)
    np.testing.assert_allclose(points(ax, "o"), [[[1.0, 0.2]]])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["a", "b"]


def test_outliers_of_redshifts_are_marked(ax):
    true = np.array([0.5, 1.0, 3.0])
    assert plot_redshifts(true, true + [0.01, 1.0, -0.1], z_err=[0.1] * 3, ax=ax) is ax
    np.testing.assert_allclose(points(ax, "x")[0], [[1.0, 2.0]])
    assert len(points(ax, ".")[0]) == 2


def test_histograms_count_what_is_finite(ax):
    assert plot_histogram({"one": [0.1, 0.2, np.nan], "two": [0.7]}, [0, 0.5, 1], ax=ax) is ax
    heights = sorted(patch.get_xy()[:, 1].max() for patch in ax.patches)
    assert heights == [1.0, 2.0]


def test_relations_and_counts(ax):
    assert plot_relation([1, 2], [10, 20], lines=[([1, 2], [5, 6], "law")], ax=ax) is ax
    np.testing.assert_allclose(points(ax, ".")[0], [[1, 10], [2, 20]])
    assert (ax.get_xscale(), ax.get_yscale()) == ("linear", "log")
    other = Figure().subplots()
    assert plot_counts([20, 21, 22], [5.0, 0.0], [1.0, 0.0], ax=other) is other
    np.testing.assert_allclose(other.lines[0].get_xydata(), [[20.5, 5.0]])


def test_spectra_filters_and_scenes(ax):
    assert plot_spectrum([1.0, 2.0], [3.0, -1.0], ax=ax) is ax
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), [3.0, np.nan])
    assert plot_photometry([5.0, 7.0, 9.0], [2.0, 0.1, np.nan], [0.5, 0.4, 1.0], ax=ax) is ax
    drawn = [one.get_children()[0].get_xydata() for one in ax.containers]
    np.testing.assert_allclose(drawn[0], [[5.0, 2.0]])
    # below its error: three of them as a limit
    np.testing.assert_allclose(drawn[1], [[7.0, 1.2]])
    other = Figure().subplots()
    assert plot_filters([([1, 2], [0.1, 0.2], "f")], ax=other) is other
    np.testing.assert_allclose(other.lines[0].get_xydata(), [[1, 0.1], [2, 0.2]])
    assert other.lines[0].get_label() == "f"
    third = Figure().subplots()
    image = np.arange(12.0).reshape(3, 4)
    assert plot_scene(image, ax=third, marks=([1.0], [2.0])) is third
    np.testing.assert_allclose(third.images[0].get_array(), image - np.median(image))
    np.testing.assert_allclose(points(third, "o")[0], [[1.0, 2.0]])
