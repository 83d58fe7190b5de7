import numpy as np
from numpy.testing import assert_array_equal

from miricigale.plotting.curves import plot_spectrum


def test_a_spectrum_on_logarithmic_axes_leaves_out_what_is_not_positive(ax):
    assert plot_spectrum([1.0, 2.0, 4.0], [3.0, -1.0, 0.0], ax=ax, label="model") is ax
    (line,) = ax.lines
    assert_array_equal(line.get_xdata(), [1.0, 2.0, 4.0])
    assert_array_equal(line.get_ydata(), [3.0, np.nan, np.nan])
    assert line.get_label() == "model"
