import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.lines import CARETDOWNBASE
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import norm

from helpers.figures import error_bars, legend_texts, line_data
from miricigale.plotting.axes import new_figure
from miricigale.plotting.posteriors import (
    plot_pdf,
    plot_pdf_2d,
    plot_pulls,
    plot_recovery,
    plot_sed_band,
    plot_sed_fit,
)

WAVE = np.array([1.0, 4.0, 15.0]) * u.um


@pytest.fixture
def pair():
    """Axes of photometry and residuals."""
    return tuple(new_figure(2)[1][:, 0])


def test_density_integrates_to_one(ax):
    assert plot_pdf([0.0, 1.0, 3.0], [0.5, 0.5], ax=ax, label="x", truth=1.0) is ax
    values, edges, _ = ax.patches[0].get_data()
    assert_array_equal(edges, [0.0, 1.0, 3.0])
    assert np.sum(values * np.diff(edges)) == pytest.approx(1.0)
    assert line_data(ax, "--")[0][:, 0].tolist() == [1.0, 1.0]
    assert ax.get_ylim()[0] == 0


def test_a_logarithmic_density_is_one_in_dex(ax):
    plot_pdf([1.0, 10.0, 1000.0] * u.Gyr, [0.5, 0.5], ax=ax, label="age", log=True)
    values, edges, _ = ax.patches[0].get_data()
    assert_allclose(values, [0.5, 0.25])
    assert_array_equal(edges, [1.0, 10.0, 1000.0])


def test_cells_without_width_have_no_density(ax):
    plot_pdf([2.0, 2.0], [1.0], ax=ax)
    assert ax.patches[0].get_data().values.tolist() == [0.0]


def test_the_axis_is_where_the_probability_is(ax):
    """A normal density falls to 0.01 of its maximum at sqrt(2 ln 100) = 3.03 sigma."""
    edges = np.linspace(0.0, 10.0, 2001)
    centers = 0.5 * (edges[1:] + edges[:-1])
    weights = np.exp(-0.5 * ((centers - 3.0) / 0.1) ** 2)
    plot_pdf(edges, weights, ax=ax)
    half = 0.1 * np.sqrt(2 * np.log(100))
    margin = 1 + 2 * ax.margins()[0]
    assert_allclose(ax.get_xlim(), (3 - margin * half, 3 + margin * half), atol=0.006)
    # all cells are there for other limits
    assert_array_equal(ax.patches[0].get_data().edges, edges)
    # several posteriors, and a truth
    plot_pdf(edges, np.roll(weights, 200), ax=ax)
    assert_allclose(ax.get_xlim(), (3 - half, 4 + half), atol=0.12)
    plot_pdf(edges, weights, ax=ax, truth=8.0)
    assert_allclose(ax.get_xlim()[1], 8.0, atol=0.3)
    ax.set_xlim(0, 10)
    plot_pdf(edges, weights, ax=ax)
    assert ax.get_xlim() == (0, 10)


def test_a_value_of_little_weight_does_not_widen_the_axis(ax):
    edges = np.array([0.0, 0.0, 0.5, 0.6, 0.7, 1.0])
    plot_pdf(edges, [0.001, 0.0, 0.5, 0.499, 0.0], ax=ax)
    assert 0.45 < ax.get_xlim()[0] < 0.5
    assert 0.7 < ax.get_xlim()[1] < 0.75
    plot_pdf(edges, [0.1, 0.0, 0.5, 0.4, 0.0], ax=ax)
    assert ax.get_xlim()[0] < 0


def test_limits_of_a_logarithmic_axis(ax):
    plot_pdf(10.0 ** np.arange(7), [0, 0, 0.5, 0.5, 0, 0], ax=ax, log=True)
    low, high = np.log10(ax.get_xlim())
    assert 1.8 < low < 2
    assert 4 < high < 4.2


def test_outline_holds_the_stated_part(ax):
    weights = np.zeros((5, 4))
    weights[2, 1] = 0.7
    weights[2, 2] = 0.3
    edges = np.arange(6.0), np.arange(5.0)
    options = {"labels": ("a", "b"), "levels": (0.68,), "truth": (2.5, 1.5)}
    assert plot_pdf_2d(*edges, weights, ax=ax, **options) is ax
    # a single cell: four sides
    sides = np.array(ax.collections[-1].get_segments())
    assert sides.shape == (4, 2, 2)
    assert_array_equal(np.unique(sides[..., 0]), [2.0, 3.0])
    assert_array_equal(np.unique(sides[..., 1]), [1.0, 2.0])
    # cells of unit area
    assert_array_equal(ax.collections[0].get_array(), weights.T)
    assert_array_equal(line_data(ax, "x"), [[[2.5, 1.5]]])


def test_axes_end_two_cells_beyond_what_has_weight(ax):
    weights = np.zeros((20, 20))
    weights[9, 4] = 1.0
    plot_pdf_2d(np.arange(21.0), np.arange(21.0), weights, ax=ax)
    assert ax.get_xlim() == (7.0, 12.0)
    assert ax.get_ylim() == (2.0, 7.0)


def test_every_one_of_many_levels_is_outlined(ax):
    weights = np.outer(*2 * [norm.pdf(np.linspace(-3, 3, 31))])
    levels = (0.2, 0.4, 0.6, 0.8, 0.9, 0.99)
    plot_pdf_2d(np.arange(32.0), np.arange(32.0), weights / weights.sum(), ax=ax, levels=levels)
    n_sides = [len(one.get_segments()) for one in ax.collections[1:]]
    assert len(n_sides) == 6
    assert np.all(np.diff(n_sides) > 0)


def test_photometry_with_and_without_residuals(ax, pair):
    flux = np.array([1.0, -0.5, np.nan]) * u.uJy
    err = np.array([0.1, 1.0, np.nan]) * u.uJy
    model = np.array([1.1, 0.5, 3.0]) * u.nJy * 1e3
    top, bottom = plot_sed_fit(WAVE, flux, err, model, ax=pair, title="x")
    assert (top, bottom) == pair
    xy, low, high = error_bars(top)[0]
    assert_allclose(xy, [[1.0, 1.0]])
    assert_allclose((low, high), ([0.9], [1.1]))
    assert_allclose(line_data(top, "s")[0], [[1, 1.1], [4, 0.5], [15, 3.0]])
    # a flux that is not positive: two errors
    assert_allclose(line_data(top, "v")[0], [[4.0, 2.0]])
    pulls = line_data(bottom, "o")[0]
    assert_allclose(pulls, [[1.0, -1.0], [4.0, -1.0], [15.0, np.nan]])
    assert top.get_title() == "x"
    assert plot_sed_fit(WAVE, flux, err, model, ax=ax) is ax
    assert ax.get_legend() is None
    # the errors of the measurement are heavy bars over those of the fit
    ax.clear()
    plot_sed_fit(WAVE, flux, err, model, measured_err=0.5 * err, ax=ax)
    (_, low, high), (_, measured_low, measured_high) = error_bars(ax)[:2]
    assert_allclose((low, high), ([0.9], [1.1]))
    assert_allclose((measured_low, measured_high), ([0.95], [1.05]))


def test_photometry_without_axes_gets_a_figure_of_two():
    flux = np.array([1.0, 2.0, 3.0]) * u.uJy
    top, bottom = plot_sed_fit(WAVE, flux, 0.1 * flux, flux)
    assert top.figure is bottom.figure
    top.set_xlim(2.0, 3.0)
    assert bottom.get_xlim() == (2.0, 3.0)
    plt.close(top.figure)


def test_bands_that_were_not_fitted_are_open(pair):
    flux = np.array([1.0, 2.0, 3.0]) * u.uJy
    top, bottom = plot_sed_fit(WAVE, flux, 0.1 * flux, flux, used=[True, False, True], ax=pair)
    for axes, lines in ((top, [bar.lines[0] for bar in top.containers]), (bottom, bottom.lines)):
        points = [line for line in lines if line.get_marker() == "o"]
        styles = {tuple(line.get_xdata()): line.get_fillstyle() for line in points}
        assert styles == {(1.0, 15.0): "full", (4.0,): "none"}, axes


def test_limits_are_arrows_in_both_panels(pair):
    flux, err = np.array([3.0, 5.0, -1.0]) * u.uJy, np.array([0.3, 0.5, 0.2]) * u.uJy
    for ax in plot_sed_fit(WAVE, flux, err, flux, limit=[False, True, True], ax=pair):
        caps = [line for bar in ax.containers for line in bar.lines[1]]
        arrows = [line for line in caps if line.get_marker() == CARETDOWNBASE]
        assert [line.get_xdata().tolist() for line in arrows] == [[4.0, 15.0]]


def test_parts_and_groups_stand_in_the_legend(ax):
    flux = np.array([1.0, 2.0, 3.0]) * u.uJy
    spectrum = (WAVE, flux)
    kind = {"parts": {"AGN": (WAVE, 0.1 * flux)}, "groups": ["old", "old", "MIRI"]}
    plot_sed_fit(WAVE, flux, 0.1 * flux, flux, spectrum=spectrum, ax=ax, **kind)
    labels = legend_texts(ax)
    assert labels[:2] == ["best model", "AGN"]
    assert {"old", "MIRI"} < set(labels)
    drawn = {line.get_label(): line.get_xydata() for line in ax.lines}
    assert_allclose(drawn["best model"], np.transpose([WAVE.value, flux.value]))
    assert_allclose(drawn["AGN"], np.transpose([WAVE.value, 0.1 * flux.value]))
    points = {bar.get_label(): bar.lines[0] for bar in ax.containers}
    assert points["old"].get_xdata().tolist() == [1.0, 4.0]
    assert points["MIRI"].get_xdata().tolist() == [15.0]
    assert points["old"].get_color() != points["MIRI"].get_color()


@pytest.mark.parametrize("rest", [True, False])
def test_percentiles_are_bands_about_a_line(ax, rest):
    unit = u.W / u.Hz if rest else u.mJy
    bands = [factor * np.array([1.0, 2.0, 4.0]) * unit for factor in (0.5, 0.8, 1.0, 1.3, 2.0)]
    assert plot_sed_band(WAVE, bands, ax=ax, rest=rest, label="median") is ax
    # nu L_nu in W, or F_nu in uJy
    scale = 299792458e6 / WAVE.value if rest else np.full(3, 1e3)
    assert_allclose(ax.lines[0].get_xydata().T, [WAVE.value, scale * [1.0, 2.0, 4.0]])
    for drawn, low, high in zip(ax.collections, (0.5, 0.8), (2.0, 1.3), strict=True):
        corners = drawn.get_paths()[0].vertices
        for x, s, y in zip(WAVE.value, scale, (1.0, 2.0, 4.0), strict=True):
            at = corners[corners[:, 0] == x, 1]
            assert (at.min(), at.max()) == pytest.approx((low * s * y, high * s * y))
    assert ax.lines[0].get_label() == "median"


def test_two_percentiles_are_one_band_that_has_the_label(ax):
    bands = [np.ones(3) * u.uJy, 2 * np.ones(3) * u.uJy]
    plot_sed_band(WAVE, bands, ax=ax, rest=False, label="68 %")
    assert len(ax.lines) == 0
    assert [band.get_label() for band in ax.collections] == ["68 %"]


@pytest.mark.parametrize("log", [False, True])
def test_recovered_values_stand_over_the_true_ones(ax, log):
    true, mean, std = [1.0, 2.0, np.nan, 4.0], [1.1, np.nan, 3.0, 3.8], [0.1, 0.1, 0.1, 0.3]
    if log:
        # what is not positive has no place on logarithmic axes
        true, mean, std = [*true, 0.0, 3.0], [*mean, 2.0, -1.0], [*std, 0.1, 0.1]
    assert plot_recovery(true, mean, std, ax=ax, name="age", unit="Gyr", log=log) is ax
    ((xy, low, high),) = error_bars(ax)
    assert_allclose(xy, [[1.0, 1.1], [4.0, 3.8]])
    assert_allclose((low, high), ([1.0, 3.5], [1.2, 4.1]))
    (equality,) = line_data(ax, "-")
    assert_array_equal(equality, [[1.0, 1.0], [4.0, 4.0]])


def test_pulls_are_a_density_beside_the_gaussian(ax):
    pull = [0.1, 0.2, -0.3, 9.0, -7.0, np.nan]
    assert plot_pulls(pull, ax=ax, label="F770W") is ax
    x, y = ax.lines[0].get_data()
    assert_allclose(y, norm.pdf(x))
    # half a sigma wide, the outermost with all that lies beyond: two, one, and one at each end
    corners = ax.patches[0].get_xy()
    for place, n in ((0.25, 2), (-0.25, 1), (4.75, 1), (-4.75, 1), (2.25, 0)):
        inside = corners[np.abs(corners[:, 0] - place) < 0.3]
        heights = {round(height, 9) for height in inside[:, 1]}
        assert round(n / 5 / 0.5, 9) in heights, place
    assert ax.get_xlim() == (-5.0, 5.0)
    assert ax.patches[0].get_label() == "F770W"


def test_no_pulls_leave_the_gaussian(ax):
    plot_pulls([np.nan], ax=ax, limit=3.0)
    assert len(ax.patches) == 0
    assert ax.get_xlim() == (-3.0, 3.0)
