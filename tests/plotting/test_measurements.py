import numpy as np
import pytest

from helpers.figures import legend_texts, line_data
from miricigale.plotting.measurements import (
    background_figure,
    encircled_energy_figure,
    features_figure,
    offsets_figure,
)


def test_background_has_profiles_that_leave_sources_out():
    x = np.arange(96.0)
    before = np.tile(x, (48, 1))
    before[10:20, 32:64] += 1e4
    mask = before > 1e3
    figure = background_figure(before, before - x, pixel_scale=0.5, mask=mask, unit="DN")
    last = figure.axes[2]
    along_x, along_y = (line.get_xydata() for line in last.lines[:2])
    # the gradient of 1 DN per pixel of half an arcsec
    np.testing.assert_allclose(np.diff(along_x[:, 1]) / np.diff(along_x[:, 0]), 2.0, rtol=0.05)
    assert np.abs(along_x[:, 0]).max() < 24
    assert np.ptp(along_y[:, 1]) < 20
    assert legend_texts(last)[0] == "before (48), along x"
    np.testing.assert_allclose(last.lines[2].get_ydata(), 0, atol=1e-9)
    assert [figure.axes[k].get_title() for k in (0, 1)] == ["before", "after"]


def test_encircled_energy_is_in_percent_and_the_limit_is_shown():
    radius = np.array([0.1, 0.2])
    before = {"F770W": np.array([0.3, 0.2]), "F1000W": np.array([0.4, 0.3])}
    after = {name: 0.1 * values for name, values in before.items()}
    figure = encircled_energy_figure(radius, before, after, limit=0.05)
    left, right = figure.axes
    np.testing.assert_allclose(left.lines[0].get_ydata(), [30, 20])
    np.testing.assert_allclose(right.lines[1].get_ydata(), [4, 3])
    assert right.get_ylim() == pytest.approx((-5.75, 5.75))
    assert legend_texts(left) == ["F770W", "F1000W"]


def test_offsets_have_a_panel_for_each_kind():
    groups = {"n < 2": ([20.0, 21.0], [0.1, 0.3]), "n >= 2": ([20.0, 22.0], [np.nan, 5.0])}
    figure = offsets_figure(groups, limit=0.5)
    first, second = figure.axes
    np.testing.assert_allclose(line_data(first, ".")[0], [[20, 0.1], [21, 0.3]])
    np.testing.assert_allclose(line_data(second, "^")[0], [[22, 0.485]])
    assert (first.get_title(), second.get_title()) == ("n < 2 (2)", "n >= 2 (1)")
    assert first.texts[0].get_text() == "median +0.200"
    assert (first.get_ylabel(), second.get_ylabel()) == ("measured - true (mag)", "")


def test_features_are_shaded_with_the_median_inside():
    z = np.linspace(0.1, 2.9, 29)
    residual = np.where((z > 1) & (z < 2), 0.2, 0.0)
    figure = features_figure({"F1500W": (z, residual)}, {"F1500W": {"6.2 µm": (1.0, 2.0)}})
    (ax,) = figure.axes
    (median,) = [line for line in ax.lines if line.get_linewidth() == 2]
    assert list(median.get_xdata()) == [1.0, 2.0]
    assert list(median.get_ydata()) == [0.2, 0.2]
    assert "6.2 µm" in ax.get_legend_handles_labels()[1]


def test_marked_sources_have_a_circle():
    mag, offset = np.array([20.0, 21.0, 22.0]), np.array([0.0, 0.1, 3.0])
    figure = offsets_figure({"all": (mag, offset)}, marked={"all": [False, True, True]})
    (circles,) = [line for line in figure.axes[0].lines if line.get_marker() == "o"]
    assert list(circles.get_xdata()) == [21.0, 22.0]
    # that beyond the axis at its edge
    assert circles.get_ydata()[1] == pytest.approx(0.97)
