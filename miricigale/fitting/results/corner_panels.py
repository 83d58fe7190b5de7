"""Panels of corner plots: cells for the draws of one object, the share of draws in each, values to mark."""

import numpy as np
from scipy.ndimage import gaussian_filter

from miricigale.fitting.posterior.posterior import cell_edges
from miricigale.utils.arrays import finite_values
from miricigale.utils.options import check_names, check_that
from miricigale.utils.values import value_class

#: Cells of a derived quantity.
N_BINS = 20
#: Cells of joint panels for each of them, and the standard deviation in such cells to which counts are smoothed:
#: otherwise outlines would be around single draws.
_FINER = 2
_SMOOTHING = 1.5
#: Share of the draws of a derived quantity that are beyond its panel.
CUT = 0.01


@value_class
class DrawPanel:
    """
    Values of a parameter in the draws of one object, and the cells in which they are counted.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (n_draws,)
        In the unit of the parameter, or their logarithm.
    edges : `~numpy.ndarray`, shape (n_cells + 1,)
        Edges of the cells, likewise.
    is_log : bool
        Whether both are log10.
    is_continuous : bool
        Whether the cells are of equal width, not those of nodes or labels.
    """

    values: np.ndarray
    edges: np.ndarray
    is_log: bool
    is_continuous: bool

    @property
    def joint_edges(self):
        """Edges of the cells of joint panels, shape (n_joint + 1,): finer ones of what is continuous."""
        if not self.is_continuous:
            return self.edges
        return np.linspace(self.edges[0], self.edges[-1], _FINER * (len(self.edges) - 1) + 1)

    def shares(self):
        """Return the share of the draws in each cell, shape (n_cells,)."""
        return np.histogram(self.values, self.edges)[0] / self.values.size

    def joint_shares(self, other):
        """
        Return the share of the draws in each pair of `joint_edges`, shape (n_joint, n_joint of ``other``).

        Along what is continuous they are smoothed with a Gaussian.
        """
        edges = (self.joint_edges, other.joint_edges)
        counts = np.histogram2d(self.values, other.values, edges)[0]
        smoothing = [_SMOOTHING * panel.is_continuous for panel in (self, other)]
        # what is smoothed beyond an edge comes back, so that sums stay
        counts = gaussian_filter(counts, smoothing, mode="reflect")
        return counts / self.values.size


def draw_panel(draws, name):
    """
    Choose the cells of a parameter from its draws.

    Parameters
    ----------
    draws : `~miricigale.fitting.Samples`
        Of a single object.
    name : str
        A parameter or derived quantity.

    Returns
    -------
    panel : `DrawPanel`
        On nodes of the grid, and of labels of libraries, the cells of the grid. Otherwise cells of equal width, in
        the logarithm of what scales with mass, without the outermost 1 % of the draws.

    Raises
    ------
    ValueError
        If no draw has a value.
    """
    values = draws.values(name).value
    if name in draws.axes and (draws.on_nodes or draws.axes[name].label):
        axis = draws.axes[name]
        return DrawPanel(values, cell_edges(axis.values, axis.bounds), False, False)
    good = finite_values(values)
    check_that(good.size, "names", "of parameters with values in the draws", repr(name))
    is_log = bool(draws.extensive(name) and np.all(good > 0))
    if is_log:
        values = np.log10(values)
        good = np.log10(good)
    # the outermost draws would squeeze the panel
    low, high = np.quantile(good, [0.5 * CUT, 1.0 - 0.5 * CUT])
    # equal values get a narrow bin
    high = max(high, low + 1e-6 * max(abs(low), 1e-30))
    return DrawPanel(values, np.linspace(low, high, N_BINS + 1), is_log, True)


def marked_values(result, names, truths):
    """
    Look up the values to mark in the panels of a corner plot.

    Parameters
    ----------
    result : `~miricigale.fitting.Samples` or `~miricigale.fitting.FitResult`
        Whose names of parameters count.
    names : list of str
        Parameters of the panels.
    truths : dict of str to float or None
        Values by name, or other names of the same.

    Returns
    -------
    values : list of float or None
        One for each panel; None without a value.

    Raises
    ------
    KeyError
        If a name in ``truths`` is none of the panels.
    """
    marked = {result._named(name): value for name, value in (truths or {}).items()}
    check_names(marked, "parameter for 'truths'", names)
    return [marked.get(name) for name in names]
