"""Tables of spectra: their columns and units, and samples that are not to be used."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.instrument import DQ
from miricigale.utils.curve_columns import (
    FLUX_NAME,
    curve_columns,
    is_quality,
    unit_of_fluxes,
    unit_of_wavelengths,
)
from miricigale.utils.exceptions import data_error
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without
from miricigale.utils.units import FNU, own_unit


def spectrum_columns(table, path):
    """
    Return the spectrum of a table, and the names of its parts.

    Parameters
    ----------
    table : `~astropy.table.Table`
        With a column of wavelengths and one of flux densities, both with units.
    path : path-like
        The file, for messages.

    Returns
    -------
    wave, fnu : `~astropy.units.Quantity`, shape (n,)
        Flux densities are NaN where a column of flags forbids their use.
    lights : list of str
        Other columns of F_nu, which are no errors, weights or flags.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there are no two such columns with units.
    """
    wave_name, flux_name = curve_columns(table, FLUX_NAME, path)
    wave = _with_unit(table[wave_name], unit_of_wavelengths)
    fnu = _with_unit(table[flux_name], unit_of_fluxes)
    if wave is None or fnu is None:
        raise data_error(path, "has no two columns with units, wavelengths and flux densities")
    fnu = _without_flagged(fnu, table)
    lights = []
    for name in table.colnames:
        unit = own_unit(table[name])
        is_other = name not in (wave_name, flux_name) and not is_quality(name)
        if is_other and isinstance(unit, u.UnitBase) and unit.is_equivalent(FNU):
            lights.append(name)
    return wave, fnu, lights


def spectrum_table(sed):
    """Return a spectrum as a `~astropy.table.QTable` of ``wave`` (um), ``fnu`` (uJy) and the parts."""
    table = QTable({"wave": sed.wave, "fnu": sed.fnu})
    for name, part in sed.components.items():
        table[name] = part.fnu
    table.meta["redshift"] = sed.redshift
    for values in (sed.parameters, sed.derived):
        table.meta |= {name: float(u.Quantity(quantity).value) for name, quantity in values.items()}
    table.meta |= without(sed.meta, ("parameters", "derived"))
    return table


def _with_unit(column, parse):
    """Return a column as a quantity, its unit read by ``parse``; None without one."""
    unit = own_unit(column)
    if unit is None:
        return None
    unit = parse(unit)
    if unit == column.unit:
        return column
    return floats(column) * unit


def _without_flagged(fnu, table):
    """Fluxes that are NaN where a column DQ of JWST forbids their use, or a column of truth values masks them."""
    for name in table.colnames:
        flags = np.ma.getdata(table[name])
        if name.lower() == "dq" and flags.dtype.kind in "iu":
            bad = flags.astype(np.int64) & int(DQ.DO_NOT_USE) != 0
        elif name.lower() == "mask" and flags.dtype.kind == "b":
            bad = flags
        else:
            continue
        if bad.any():
            fnu = np.where(bad, np.nan, floats(fnu)) * fnu.unit
    return fnu
