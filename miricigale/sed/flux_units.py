"""Units of flux densities per frequency and per wavelength."""

import astropy.units as u

from miricigale.utils.exceptions import units_error
from miricigale.utils.units import FLAM, FNU


def flux_density_unit(unit):
    """Return the unit of a flux density, and what stands for it on an axis."""
    unit = u.Unit(unit)
    for kind, symbol in ((FNU, r"F_\nu"), (FLAM, r"F_\lambda"), (FLAM * u.AA, r"\nu F_\nu")):
        if unit.is_equivalent(kind):
            label = unit.to_string("unicode", fraction="inline")
            if unit == FNU:
                label = "µJy"
            return unit, f"${symbol}$ ({label})"
    raise units_error("unit", "one of F_nu, F_lambda or nu F_nu", unit)
