"""Derived quantities of a grid: masses, rates and luminosities that grow with the scale."""

from dataclasses import dataclass

import astropy.units as u
import numpy as np

from miricigale.utils.units import LUMINOSITY, MASS

__all__ = ["DERIVED_LEVELS", "Quantities"]

#: Levels at which the distributions of derived quantities are kept.
DERIVED_LEVELS = np.array(
    [0.001, 0.005, 0.01, 0.025, 0.05, 0.1, 0.16, 0.2, 0.25, 0.3, 0.35, 0.4, 0.45, 0.5]
    + [0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.84, 0.9, 0.95, 0.975, 0.99, 0.995, 0.999]
)
DERIVED_LEVELS.flags.writeable = False


@dataclass(frozen=True, eq=False)
class Quantities:
    """
    What is derived from the models of a grid, and how.

    The order is: the galaxy's quantities (for each solar mass formed), the AGN's (for each W of
    AGN power), then the one that both have a part in.

    Parameters
    ----------
    names : tuple of str
        Names.
    units : tuple of `~astropy.units.UnitBase`
        Units of the quantities.
    descriptions : tuple of str
        One line each.
    galaxy_scale, agn_scale : `~numpy.ndarray`, shapes (n_qg, nG) and (n_qa, nA)
        Values for each solar mass formed and for each W.
    mixed_galaxy, mixed_agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        The two parts of the last quantity.
    """

    names: tuple
    units: tuple
    descriptions: tuple
    galaxy_scale: np.ndarray
    agn_scale: np.ndarray
    mixed_galaxy: np.ndarray
    mixed_agn: np.ndarray

    @classmethod
    def of_grid(cls, grid):
        """
        Quantities of a model grid.

        All columns of its property tables are taken. A column of both tables (``ir_luminosity``)
        gives three quantities: the sum, and the parts ``<name>_galaxy`` and ``<name>_agn``;
        without one, the sum is ``total_luminosity``, dust luminosity and AGN power.
        """
        n_galaxy, n_agn = grid.dust_luminosity.size, grid.agn_multiplicity.size
        of_galaxy, of_agn = grid.galaxy_properties, grid.agn_properties
        both = [n for n in of_galaxy.colnames if n_agn and n in of_agn.colnames]
        names, units, texts = ["mass"], [MASS], ["mass of stars formed"]
        galaxy_scale, agn_scale = [np.ones(n_galaxy)], []
        for name in of_galaxy.colnames:
            names.append(f"{name}_galaxy" if name in both else name)
            column = of_galaxy[name]
            unit = (getattr(column, "unit", None) or u.dimensionless_unscaled) * MASS
            in_watt = unit.is_equivalent(LUMINOSITY)
            factor = unit.to(LUMINOSITY) if in_watt else 1.0
            units.append(LUMINOSITY if in_watt else unit)
            texts.append(_text(column, ", for one solar mass formed"))
            galaxy_scale.append(np.asarray(getattr(column, "value", column), float) * factor)
        for name in of_agn.colnames if n_agn else ():
            names.append(f"{name}_agn" if name in both else name)
            column = of_agn[name]
            unit = getattr(column, "unit", None) or u.dimensionless_unscaled
            units.append(LUMINOSITY if unit == u.dimensionless_unscaled else unit * LUMINOSITY)
            texts.append(_text(column, ", W for each W of AGN power"))
            agn_scale.append(np.asarray(getattr(column, "value", column), float))
        if both:
            name = both[0]
            mixed_galaxy = galaxy_scale[1 + of_galaxy.colnames.index(name)]
            mixed_agn = agn_scale[of_agn.colnames.index(name)]
            names.append(name)
            texts.append(f"{texts[1 + of_galaxy.colnames.index(name)]}; and of the AGN")
        else:
            mixed_galaxy, mixed_agn = np.asarray(grid.dust_luminosity), np.ones(n_agn)
            names.append("total_luminosity")
            texts.append("dust luminosity and AGN power")
        units.append(LUMINOSITY)
        return cls(
            tuple(names),
            tuple(units),
            tuple(texts),
            np.array(galaxy_scale),
            np.array(agn_scale, float).reshape(len(agn_scale), n_agn),
            np.array(mixed_galaxy, float),
            np.array(mixed_agn, float),
        )

    def best(self, grid, g, k, frac, scale):
        """
        Values for single models.

        Parameters
        ----------
        grid : `~miricigale.sed.ModelGrid`
            The grid.
        g, k : `~numpy.ndarray` of int, shape (n,)
            Galaxies and tori.
        frac, scale : `~numpy.ndarray`, shape (n,)
            AGN fractions and solar masses formed.

        Returns
        -------
        values : `~numpy.ndarray`, shape (n_quantities, n)
        """
        power = scale * frac / (1.0 - frac) * grid.dust_luminosity[g]
        rows = [scale * row[g] for row in self.galaxy_scale]
        rows += [power * row[k] for row in self.agn_scale]
        mixed = scale * self.mixed_galaxy[g]
        if self.mixed_agn.size:
            mixed = mixed + power * self.mixed_agn[k]
        return np.array([*rows, mixed])


def _text(column, ending):
    text = getattr(column.info, "description", None) or column.info.name
    return text.removesuffix(ending)
