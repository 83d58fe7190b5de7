import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.figures import error_bars, legend_texts, line_data
from miricigale.plotting.comparison import (
    plot_error_function,
    plot_offsets,
    plot_redshifts,
    plot_relation,
)


def labels(ax):
    return ax.get_xlabel(), ax.get_ylabel()


def test_offsets_beyond_the_limit_are_triangles_at_its_edge(ax):
    running = [20.5], np.array([0.1]), np.array([0.2])
    assert plot_offsets([20.0, 21.0, 22.0], [0.1, 3.0, -2.0], running=running, ax=ax) is ax
    assert_allclose(line_data(ax, ".")[0], [[20, 0.1]])
    assert_allclose(line_data(ax, "^")[0], [[21, 0.97]])
    assert_allclose(line_data(ax, "v")[0], [[22, -0.97]])
    # a single bin is a point
    assert_allclose(line_data(ax, "o")[0], [[20.5, 0.1]])
    assert ax.get_ylim() == (-1.0, 1.0)


def test_the_running_median_has_a_band_of_its_scatter(ax):
    middle, median, scatter = [20.0, 21.0, 22.0], np.array([0.1, 0.0, -0.1]), np.full(3, 0.2)
    plot_offsets([20.0], [0.0], running=(middle, median, scatter), ax=ax, limit=0.5)
    (line,) = (one for one in ax.lines if one.get_label() == "running median, scatter")
    assert_allclose(line.get_xydata(), np.transpose([middle, median]))
    corners = ax.collections[0].get_paths()[0].vertices
    for x, m in zip(middle, median, strict=True):
        y = corners[corners[:, 0] == x, 1]
        assert (y.min(), y.max()) == pytest.approx((m - 0.2, m + 0.2))
    assert ax.get_ylim() == (-0.5, 0.5)


def test_error_functions_meet_their_limits_at_five_sigma(ax):
    flux = {name: np.geomspace(0.1, 10, 5) for name in "abc"}
    sigma = {"a": np.full(5, 0.2), "b": np.full(5, 0.3), "c": np.full(5, 0.4)}
    limits = {"a": 1.0, "b": np.nan}
    assert plot_error_function(flux, sigma, limits=limits, ax=ax, colors={"a": "red"}) is ax
    curves = [line for line in ax.lines if len(line.get_xdata()) == 5]
    for line, name in zip(curves, "abc", strict=True):
        assert_array_equal(line.get_xydata(), np.transpose([flux[name], sigma[name]]))
    assert curves[0].get_color() == "red"
    assert_allclose(line_data(ax, "o"), [[[1.0, 0.2]]])
    assert legend_texts(ax) == ["a", "b", "c"]


def test_outliers_of_redshifts_are_marked(ax):
    true = np.array([0.5, 1.0, 3.0])
    assert plot_redshifts(true, true + [0.01, 1.0, -0.1], z_err=[0.1] * 3, ax=ax) is ax
    assert_allclose(line_data(ax, "x")[0], [[1.0, 2.0]])
    assert_allclose(line_data(ax, ".")[0], [[0.5, 0.51], [3.0, 2.9]])
    _, low, high = error_bars(ax)[0]
    assert_allclose(high - low, 0.2)
    for sign, curve in zip((1, -1), line_data(ax, "--"), strict=True):
        assert_allclose(curve[:, 1], curve[:, 0] + sign * 0.15 * (1 + curve[:, 0]))
    # equal steps in log(1 + z)
    places = ax.transData.transform([(0.0, 0.0), (1.0, 0.0), (3.0, 0.0)])[:, 0]
    assert places[2] - places[1] == pytest.approx(places[1] - places[0])
    assert legend_texts(ax) == ["outliers"]


def test_points_and_the_relations_over_them(ax):
    lines = [([1, 2], [5, 6], "law"), ([1, 2], [7, 8], "rule")]
    assert plot_relation([1, 2], [10, 20], lines=lines, ax=ax, labels=("M", "SFR")) is ax
    assert_allclose(line_data(ax, ".")[0], [[1, 10], [2, 20]])
    for line, (x, y, label) in zip(ax.lines[1:], lines, strict=True):
        assert_allclose(line.get_xydata(), np.transpose([x, y]))
        assert line.get_label() == label
    assert legend_texts(ax) == ["law", "rule"]
