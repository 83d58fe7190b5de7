import numpy as np
import pytest
from numpy.testing import assert_array_equal

from helpers.figures import legend_texts, line_data
from miricigale.filters import FilterSet
from miricigale.plotting.curves import plot_filters


def test_curves_are_drawn_with_their_names(ax):
    curves = [([1, 2, 3], [0.1, 0.5, 0.2], "one"), ([2, 4], [0.3, 0.4], "two")]
    assert plot_filters(iter(curves), ax=ax, linestyle="--") is ax
    for got, (wave, throughput, _) in zip(line_data(ax, "--"), curves, strict=True):
        assert_array_equal(got, np.transpose([wave, throughput]))
    assert legend_texts(ax) == ["one", "two"]


def test_one_curve_needs_no_legend_and_takes_another_label(ax):
    plot_filters([([1, 2], [0.1, 0.2], "f")], ax=ax, label="mine")
    assert ax.get_legend() is None
    assert ax.lines[0].get_label() == "mine"


def test_the_curves_of_a_set_have_one_height_and_the_axis_says_so(ax):
    FilterSet.from_names(["miri.f770w", "miri.f2100w"]).plot(ax=ax)
    assert [line.get_ydata().max() for line in ax.lines] == pytest.approx([1.0, 1.0])
