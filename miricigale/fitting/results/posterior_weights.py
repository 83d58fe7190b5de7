"""Posterior weights of all parameters, by name."""

import astropy.units as u

from miricigale.utils.object_rows import ArraysByName


class PosteriorWeights(ArraysByName):
    """Posterior weights by name of parameter; a call has the values of the parameter too."""

    def __init__(self, weights, other_name, axes, quantities):
        super().__init__(weights, other_name)
        self.axes = axes
        self.quantities = quantities

    def __missing__(self, name):
        if self.other_name(name, self.quantities) in self.quantities:
            msg = (
                f"{name!r} is a derived quantity, which has no nodes: results.distribution({name!r}) gives the "
                "edges of its cells and their weights"
            )
            raise KeyError(msg)
        return super().__missing__(name)

    def __call__(self, name=None, *others):
        weights = super().__call__(name, *others)
        axis = self.axes[self.other_name(name, self)]
        return axis.values * u.Unit(axis.unit), weights
