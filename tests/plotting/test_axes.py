import matplotlib.pyplot as plt
import pytest

from miricigale.plotting.axes import AxesArray, new_figure, panel_columns, resolve_axes


def test_a_new_figure_has_a_grid_of_axes_and_no_window():
    before = plt.get_fignums()
    figure, axes = new_figure(2, 3, size=(4.0, 3.0), sharex=True)
    assert axes.shape == (2, 3)
    assert all(one.figure is figure for one in axes.flat)
    assert tuple(figure.get_size_inches()) == (12.0, 6.0)
    axes[0, 0].set_xlim(3, 5)
    assert axes[1, 2].get_xlim() == (3, 5)
    assert plt.get_fignums() == before
    # one panel is a grid too
    assert new_figure()[1].shape == (1, 1)


def test_axes_that_are_not_given_are_the_current_ones(ax):
    assert resolve_axes(ax) is ax
    current = plt.figure().add_subplot()
    try:
        assert resolve_axes(None) is current
    finally:
        plt.close(current.figure)


@pytest.mark.parametrize("n", range(1, 25))
def test_rows_of_panels_are_of_three_or_leave_fewer_places_empty(n):
    columns = panel_columns(n)
    assert columns == min(n, 3) or (columns in (2, 4) and -n % columns < -n % 3)
    # seven skies, four ranges of redshift
    assert (panel_columns(7), panel_columns(4), panel_columns(18)) == (4, 2, 3)


def test_plots_leave_the_panels_of_others_alone():
    """After panels of ours, such as those of a corner plot, a plot has a figure of its own."""
    figure, axes = plt.subplots(2, 2)
    assert resolve_axes(None) is axes[1, 1]
    AxesArray(axes)
    own = resolve_axes(None)
    assert own.figure is not figure
    # which is then the current one
    assert resolve_axes(None) is own
    plt.close("all")
