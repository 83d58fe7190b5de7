"""The AGN fraction in the definition that the grid does not use."""

from dataclasses import dataclass

import numpy as np

__all__ = ["FRACTIONS", "OtherFraction"]

#: AGN fractions by name, and what they are.
FRACTIONS = {
    "frac_agn_ir": "AGN share of 3-1000 um light",
    "frac_agn_dust": "AGN power over the sum with the dust luminosity",
}

_ALL = 1e30


@dataclass(frozen=True, eq=False)
class OtherFraction:
    """
    AGN fraction of every model in a second definition: y / (1 + y), y = c galaxy[g] agn[k].

    c = f / (1 - f) is that of the grid's own fraction f. If the latter refers to the dust
    luminosity the other is the AGN's share of 3-1000 um light, and the other way round. It does
    not scale with mass.

    Parameters
    ----------
    name : str
        ``frac_agn_ir`` or ``frac_agn_dust``.
    description : str
        One line.
    galaxy, agn : `~numpy.ndarray`, shapes (nG,) and (nA,)
        The two factors of y.
    """

    name: str
    description: str
    galaxy: np.ndarray
    agn: np.ndarray

    @classmethod
    def of_grid(cls, grid):
        """Of a `~miricigale.sed.ModelGrid`; None if it has no AGN or not the quantities needed."""
        by_dust = grid.meta.get("frac_agn_definition", "dust") == "dust"
        name = "frac_agn_ir" if by_dust else "frac_agn_dust"
        of_galaxy = "ir_luminosity" if by_dust else "dust_luminosity"
        of_agn = "ir_luminosity" if by_dust else "agn_power"
        tables = (grid.galaxy_properties, of_galaxy), (grid.agn_properties, of_agn)
        if not grid.n_agn or any(column not in table.colnames for table, column in tables):
            return None
        galaxy, agn = (np.asarray(_in_watt(table[column]), float) for table, column in tables)
        reference = np.asarray(grid.dust_luminosity, float)
        # where a galaxy has none of it all of it is the AGN's
        ratio = np.where(reference > 0, _ALL, 0.0)
        np.divide(reference, galaxy, out=ratio, where=galaxy > 0)
        return cls(name, FRACTIONS[name], ratio, agn)

    def evaluate(self, g, k, frac):
        """Values for models of galaxies g and tori k at fractions of the grid."""
        y = frac / (1.0 - frac) * self.galaxy[g] * self.agn[k]
        return y / (1.0 + y)


def _in_watt(column):
    """Values in W for each solar mass, or plain ones."""
    if hasattr(column, "to_value") and column.unit.is_equivalent("W / solMass"):
        return column.to_value("W / solMass")
    return getattr(column, "value", column)
