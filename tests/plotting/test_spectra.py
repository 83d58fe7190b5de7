import numpy as np
from matplotlib.lines import CARETDOWNBASE

from helpers.figures import error_bars
from miricigale.plotting.spectra import plot_photometry, plot_spectrum


def assert_labels(ax):
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "log")
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("observed wavelength (µm)", r"$F_\nu$ (µJy)")


def test_a_spectrum_on_logarithmic_axes_leaves_out_what_is_not_positive(ax):
    assert plot_spectrum([1.0, 2.0, 4.0], [3.0, -1.0, 0.0], ax=ax, label="model") is ax
    (line,) = ax.lines
    np.testing.assert_array_equal(line.get_xdata(), [1.0, 2.0, 4.0])
    np.testing.assert_array_equal(line.get_ydata(), [3.0, np.nan, np.nan])
    assert line.get_label() == "model"
    assert_labels(ax)


def test_fluxes_have_their_errors_and_those_below_them_are_limits(ax):
    wave, flux = [5.0, 7.0, 9.0, 11.0, 13.0], [2.0, 0.1, np.nan, -0.3, 1.0]
    error = [0.5, 0.4, 1.0, 0.2, np.nan]
    assert plot_photometry(wave, flux, error, ax=ax, label="seen") is ax
    (seen, low, high), (limits, *_) = error_bars(ax)
    np.testing.assert_allclose(seen, [[5.0, 2.0]])
    np.testing.assert_allclose((low, high), ([1.5], [2.5]))
    # three errors, with an arrow down
    np.testing.assert_allclose(limits, [[7.0, 1.2], [11.0, 0.6]])
    arrows = [line for line in ax.lines if line.get_marker() == CARETDOWNBASE]
    assert [len(line.get_xdata()) for line in arrows] == [2]
    # the label stands once
    assert [bar.get_label() for bar in ax.containers].count("seen") == 1
    assert_labels(ax)


def test_fluxes_without_errors_are_points(ax):
    plot_photometry([5.0, 7.0, 9.0], [2.0, -0.1, np.nan], ax=ax)
    points = [bar.lines[0].get_xydata().tolist() for bar in ax.containers]
    assert points == [[[5.0, 2.0]], []]
