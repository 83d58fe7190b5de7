"""What the models of a grid are: parameters and derived quantities by index and scale."""

import astropy.units as u
import numpy as np

from miricigale.fitting.fractions import FRACTIONS
from miricigale.fitting.quantities import Quantities
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.random import stream

__all__ = ["ModelValues", "check_draws"]

#: AGN fractions in both definitions: the AGN's part and the galaxy's.
_FRACTIONS = {
    "frac_agn_dust": ("agn_power", "dust_luminosity"),
    "frac_agn_ir": ("ir_luminosity_agn", "ir_luminosity_galaxy"),
}


def check_draws(grid, ids, flags, index, scale):
    """
    Check models drawn from a grid; see `~miricigale.fitting.Samples` for the arguments.

    Raises
    ------
    ValueError
        If shapes do not agree, an index is not one of the grid, or there is no torus where the
        AGN fraction is above 0.
    """
    n, shape = ids.size, np.shape(scale)
    if len(shape) != 2 or shape[0] != n or shape[1] < 1:
        raise argument_error("scale", f"of shape ({n}, n_draws)", f"{shape}")
    if np.shape(index) != (*shape, 4):
        raise argument_error("index", f"of shape {(*shape, 4)}", f"{np.shape(index)}")
    if np.shape(flags) != (n,):
        raise argument_error("flags", f"of shape ({n},)", f"{np.shape(flags)}")
    sizes = (grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size)
    index = np.asarray(index, dtype=np.int64)
    drawn = index[(index[:, :, 0] >= 0).all(axis=1)].reshape(-1, 4)
    lowest = np.array([0, 0, -1, 0])
    if np.any(drawn < lowest) or np.any(drawn >= np.array(sizes)):
        raise argument_error("index", f"within the grid's {sizes}", "others")
    if np.any((drawn[:, 2] < 0) & (grid.frac_agn[drawn[:, 3]] > 0)):
        raise argument_error("index", "with a torus where the AGN fraction is above 0", "none")


class ModelValues:
    """
    Values of parameters and derived quantities of models of a grid.

    Parameters
    ----------
    grid : `~miricigale.sed.ModelGrid`
        The grid.
    axes : dict of str to `~miricigale.fitting.priors.GridAxis`
        Parameters that have several values, with ``share``.
    seed : int
        Chooses values of parameters without effect.
    """

    def __init__(self, grid, axes, seed):
        self.grid, self.axes, self.seed = grid, axes, seed
        self.quantities = Quantities.of_grid(grid)
        have = set(self.quantities.names)
        self.fractions = tuple(n for n, parts in _FRACTIONS.items() if set(parts) <= have)

    @property
    def names(self):
        """Names of parameters, derived quantities and AGN fractions."""
        return (*self.axes, *self.quantities.names, *self.fractions)

    def unit(self, name):
        """Unit of a parameter or quantity."""
        if name in self.axes:
            return u.Unit(self.axes[name].unit)
        if name in self.fractions:
            return u.dimensionless_unscaled
        if name not in self.quantities.names:
            raise unknown_name("parameter", name, self.names)
        return self.quantities.units[self.quantities.names.index(name)]

    def description(self, name):
        """One line on a parameter or quantity."""
        if name in self.quantities.names:
            return self.quantities.descriptions[self.quantities.names.index(name)]
        if name in self.fractions:
            return FRACTIONS[name]
        for table in (self.grid.galaxy_parameters, self.grid.agn_parameters):
            if name in table.colnames and table[name].info.description:
                return table[name].info.description
        return name

    def extensive(self, name):
        """Whether a quantity scales with mass."""
        return name in self.quantities.names and name not in self.quantities.shape.names

    def values(self, name, ids, index, scale):
        """
        Values in models drawn for n objects.

        Parameters
        ----------
        name : str
            A parameter or quantity.
        ids : `~numpy.ndarray`, shape (n,)
            Ids of the objects, which key the streams of parameters without effect.
        index : `~numpy.ndarray` of int, shape (n, n_draws, 4)
            Redshift, galaxy, torus (-1: none) and AGN fraction.
        scale : `~numpy.ndarray`, shape (n, n_draws)
            Solar masses formed.

        Returns
        -------
        values : `~numpy.ndarray`, shape (n, n_draws)
            NaN for parameters of a torus that is not there.
        """
        z, g, k, f = np.moveaxis(index, -1, 0)
        grid = self.grid
        if name == "redshift":
            return grid.redshift[z]
        if name in self.axes:
            axis = self.axes[name]
            if axis.kind == "frac_agn":
                return grid.frac_agn[f]
            return self._of_axis(axis, g if axis.kind == "galaxy" else k, ids)
        if name in self.fractions:
            agn, galaxy = (self.values(part, ids, index, scale) for part in _FRACTIONS[name])
            whole = agn + galaxy
            return np.divide(agn, whole, out=np.zeros_like(whole), where=whole != 0)
        frac = grid.frac_agn[f]
        return self.quantities.evaluate(name, grid, g, np.maximum(k, 0), frac, scale)

    def _of_axis(self, axis, model, ids):
        """Values of a parameter; where a model stands for several, drawn as its prior has it."""
        share = axis.share
        out = axis.values[np.argmax(share, axis=0)][model]
        several = np.count_nonzero(share > 0, axis=0) > 1
        many = several[model] & (model >= 0)
        total = np.cumsum(share, axis=0)
        for i in np.flatnonzero(many.any(axis=1)):
            rng = stream(self.seed, "samples", axis.name, str(ids[i]))
            draw = rng.random(model.shape[1])[many[i]]
            cdf = total[:, model[i][many[i]]]
            out[i, many[i]] = axis.values[np.sum(draw * cdf[-1] >= cdf, axis=0)]
        return np.where(model >= 0, out, np.nan)
