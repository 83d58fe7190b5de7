"""Corner plots: panels of a parameter have the same limits."""

import matplotlib.pyplot as plt
import numpy as np
from numpy.testing import assert_allclose

from miricigale.plotting.corner import plot_corner


def test_panels_of_a_parameter_have_the_limits_of_its_own():
    """Of a narrow posterior on a wide axis, and of one that fills its axis."""
    edges = [np.linspace(0.0, 10.0, 101), np.linspace(0.0, 1.0, 11)]
    weights = [np.zeros(100), np.full(10, 0.1)]
    weights[0][50:54] = [0.2, 0.3, 0.3, 0.2]
    joint = np.outer(weights[0], weights[1])
    cells = {(1, 0): (*edges, joint)}
    axes = plot_corner(["z", "f"], list(zip(edges, weights, strict=True)), cells)
    for ax in axes[:, 0]:
        assert_allclose(ax.get_xlim(), (5.0, 5.4))
    assert_allclose(axes[1, 0].get_ylim(), (0.0, 1.0))
    assert_allclose(axes[1, 1].get_xlim(), (0.0, 1.0))
    plt.close("all")
