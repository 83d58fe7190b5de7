import matplotlib.pyplot as plt

from miricigale.plotting.axes import new_figure, resolve_axes


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
