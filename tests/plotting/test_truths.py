import numpy as np
import pytest
from astropy.table import Table

from helpers.figures import error_bars, legend_texts, line_data
from miricigale.plotting.truths import (
    classes_figure,
    colors_figure,
    completeness_figure,
    fractions_figure,
    histograms_figure,
    luminosity_figure,
    ranks_figure,
    recovery_figure,
)


def heights(ax):
    """Counts of the step lines of a panel, each from left to right."""
    return [patch.get_xy()[:, 1].max() for patch in ax.patches]


def test_every_truth_has_a_panel_with_every_band_set():
    samples = {f"f{k}": {"all": [0.1] * (k + 1), "none": [0.9, np.nan]} for k in range(4)}
    figure = histograms_figure(samples, [0, 0.5, 1.0], xlabel="fracAGN", truth={"f1": 0.3})
    assert [ax.get_title() for ax in figure.axes] == ["f0", "f1", "f2", "f3"]
    assert [max(heights(ax)) for ax in figure.axes] == [1, 2, 3, 4]
    # one legend, and the truth where it is known
    assert [bool(ax.get_legend()) for ax in figure.axes] == [True, False, False, False]
    assert line_data(figure.axes[1], "--")[0][:, 0].tolist() == [0.3, 0.3]
    assert line_data(figure.axes[0], "--") == []
    assert [ax.get_xlabel() for ax in figure.axes] == ["", "", "fracAGN", "fracAGN"]


def test_every_one_of_many_samples_is_drawn_and_differs():
    figure = histograms_figure(
        {"f": {f"s{i}": [0.1] * (i + 1) for i in range(6)}}, [0, 1], xlabel=""
    )
    (ax,) = figure.axes
    assert heights(ax) == [1, 2, 3, 4, 5, 6]
    assert len({(patch.get_edgecolor(), patch.get_linestyle()) for patch in ax.patches}) == 6


def test_values_beyond_the_bins_are_counted_at_their_ends():
    figure = histograms_figure({"f": {"all": [-9, 0.2, 9.0, 9.0]}}, [0, 1, 2], xlabel="z")
    assert heights(figure.axes[0]) == [2]
    xy = figure.axes[0].patches[0].get_xy()
    assert xy[(xy[:, 0] > 0) & (xy[:, 0] < 2), 1].max() == 2


def test_fractions_stand_beside_each_other_with_their_scatter():
    true, median, scatter = np.array([0.0, 0.4]), np.array([0.1, 0.5]), np.array([0.05, 0.2])
    values = {"z < 1": {"all": (true, median, scatter), "none": (true, median, scatter)}}
    (ax,) = fractions_figure(values).axes
    (first, low, high), (second, _, _) = error_bars(ax)
    np.testing.assert_allclose(first[:, 1], median)
    np.testing.assert_allclose(0.5 * (high - low), scatter)
    np.testing.assert_allclose(second[:, 0] - first[:, 0], 0.015)
    np.testing.assert_allclose(0.5 * (second[:, 0] + first[:, 0]), true)
    assert legend_texts(ax) == ["all", "none"]


def test_recovered_luminosities_lie_about_the_line_of_equality():
    values = {"f": ([1e37, 1e38, -1.0], [2e37, 1e38, 1e38]), "g": ([1e36], [np.nan])}
    figure = recovery_figure(values, label="power (W)", notes={"f": "+0.15 dex"})
    ax = figure.axes[0]
    np.testing.assert_allclose(line_data(ax, ".")[0], [[1e37, 2e37], [1e38, 1e38]])
    (equality,) = (one.get_xydata() for one in ax.lines if one.get_marker() == "None")
    np.testing.assert_array_equal(equality[:, 0], equality[:, 1])
    assert ax.texts[0].get_text() == "+0.15 dex"
    assert ax.get_ylabel() == "fitted power (W)"
    assert len(line_data(figure.axes[1], ".")[0]) == 0


def test_completeness_has_counts_above_and_shares_beneath():
    table = Table({"low": [0.0, 1, 2], "high": [1.0, 2, 3], "n": [4, 2, 0], "n_found": [1, 2, 0]})
    table["share"] = [0.25, 1.0, np.nan]
    table["share_low"], table["share_high"] = [0.1, 0.7, np.nan], [0.5, 1.0, np.nan]
    limits = [(0.5, "CDF-S", True), (1.5, "EGS", False)]
    figure = completeness_figure(table, xlabel="log flux", limits=limits, half=(1.2, 1.0, 1.4))
    upper, lower = figure.axes
    # empty bins have no share
    np.testing.assert_allclose(line_data(lower, "o")[0], [[0.5, 0.25], [1.5, 1.0]])
    np.testing.assert_allclose(
        [s[:, 1] for s in lower.collections[0].get_segments()], [[0.1, 0.5], [0.7, 1.0]]
    )
    # estimates are dotted
    assert line_data(upper, ":")[0][:, 0].tolist() == [1.5, 1.5]
    assert {"all", "found", "50 % of these", "CDF-S", "EGS"} == set(legend_texts(upper))
    assert lower.get_xlabel() == "log flux"


def test_luminosities_with_an_axis_of_star_formation():
    z, power = [0.5, 1.0, 2.0, 3.0], [1e10, 1e11, 1e12, -1.0]
    groups = {"MIRI": [False, True, True, True], "MIPS": [False, False, True, False]}
    figure = luminosity_figure(z, power, groups, sfr=(1e-10, "SFR"))
    ax = figure.axes[0]
    np.testing.assert_allclose(line_data(ax, ".")[0], [[0.5, 1e10]])
    np.testing.assert_allclose(line_data(ax, "o")[0], [[1, 1e11], [2, 1e12]])
    np.testing.assert_allclose(line_data(ax, "s")[0], [[2, 1e12]])
    (right,) = ax.child_axes
    figure.draw_without_rendering()
    np.testing.assert_allclose(right.get_ylim(), np.array(ax.get_ylim()) * 1e-10)
    assert legend_texts(ax) == ["not detected", "MIRI", "MIPS"]


def test_classes_say_shares_and_numbers():
    figure = classes_figure(
        [[3, 1, 0], [0, 0, 0]], ["galaxy", "agn"], found=["galaxy", "agn", "none"]
    )
    (ax,) = figure.axes
    assert ax.texts[0].get_text() == "75 %\n3"
    assert ax.texts[3].get_text() == "0 %\n0"
    assert [t.get_text() for t in ax.get_xticklabels()] == ["galaxy", "agn", "none"]


def test_colors_have_their_circles():
    planes = {"z = 1": ([[0, 0], [1, 1]], ["agn", "galaxy"], (0.1, 0.2), (0.5, 0.9))}
    (ax,) = colors_figure(planes, labels={"z = 1": ("a", "b")}).axes
    assert [(c.center, c.radius) for c in ax.patches] == [((0.1, 0.2), 0.5), ((0.1, 0.2), 0.9)]
    np.testing.assert_allclose(line_data(ax, "o")[0], [[0, 0]])
    np.testing.assert_allclose(line_data(ax, "s")[0], [[1, 1]])
    assert legend_texts(ax) == ["agn", "galaxy"]


def test_uniform_ranks_have_the_density_one():
    ranks = {"z": {"fit": np.r_[np.arange(0.05, 1, 0.1), np.nan]}, "f": {"fit": np.zeros(8)}}
    figure = ranks_figure(ranks)
    steps = figure.axes[0].patches[0].get_data()
    np.testing.assert_allclose(steps.values, 1.0)
    assert figure.axes[1].patches[0].get_data().values[0] == pytest.approx(10)
    assert figure.axes[1].get_ylim()[1] > 10
