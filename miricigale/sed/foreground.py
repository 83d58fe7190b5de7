"""Galactic extinction of band fluxes: how much it is, and tables freed from it."""

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from miricigale.filters import FilterSet
from miricigale.filters.filter import spectrum_arrays
from miricigale.sed.components.foreground import LAWS, check_bands, coverage, extinction_curve
from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import error_column, require_columns
from miricigale.utils.units import FNU

__all__ = ["band_extinction", "deredden"]

_RESOLUTION = 600.0  # of the grid in a band: good to 2e-5 of the extinction
_ROWS = 1024  # rows worked out at once
_KEY = "galactic_extinction"


def _colour_excess(ebv):
    """Colour excesses in mag as an array of one dimension, and whether it was one number."""
    masked = np.ravel(getattr(ebv, "mask", False))
    value = getattr(ebv, "unmasked", ebv)
    value = value.data if isinstance(value, np.ma.MaskedArray) else value
    unit = getattr(ebv, "unit", None)
    try:
        array = np.asarray(getattr(value, "value", value), dtype=float)
        if unit is not None:
            array = u.Quantity(array, unit).to_value(u.mag)
    except (u.UnitConversionError, u.UnitTypeError):
        msg = f"'ebv' must be convertible to mag, got {unit}"
        raise u.UnitsError(msg) from None
    except (TypeError, ValueError):
        raise argument_error("ebv", "numbers in mag", repr(ebv)) from None
    if array.ndim > 1:
        raise argument_error("ebv", "one number or one for each row", f"shape {array.shape}")
    flat = np.atleast_1d(array)
    wrong = np.flatnonzero(masked | ~(np.isfinite(flat) & (flat >= 0)))
    if wrong.size:
        some = ", ".join(map(str, wrong[:10])) + (", ..." if wrong.size > 10 else "")
        got = f"something else in {wrong.size} of {flat.size} rows: {some}"
        raise argument_error("ebv", "finite and not negative", got)
    return flat, array.ndim == 0


def _band_grid(band, low, high, sed):
    """Wavelengths in um where the law is defined, weights of the light there, their whole sum."""
    first, last = band.wave.value[[0, -1]]
    wave = np.geomspace(first, last, max(int(_RESOLUTION * np.log(last / first)), 2) + 1)
    wave[0], wave[-1] = first, last
    if sed is not None:
        wave = np.union1d(wave, sed[0][(sed[0] > first) & (sed[0] < last)])
    weights = band.weights(wave)
    if sed is not None:
        weights = weights * np.interp(wave, *sed)
    if not weights.sum() > 0:
        raise argument_error("sed", f"of positive flux in {band.name}", weights.sum())
    used = (weights != 0) & (wave >= low) & (wave <= high)
    return wave[used], weights[used], weights.sum()


def band_extinction(filters, ebv, *, law="G23", r_v=3.1, sed=None, beyond="refuse"):
    """
    Galactic extinction in bands.

    Parameters
    ----------
    filters : `~miricigale.filters.FilterSet` or iterable of str
        The bands.
    ebv : float, array_like or `~astropy.units.Quantity`, shape () or (n,)
        Colour excess E(B-V) of each source; a bare number is in mag. Those of the map of Schlegel,
        Finkbeiner & Davis (1998) are to be multiplied by 0.86 (Schlafly & Finkbeiner 2011).
    law : {"G23", "F99", "F19", "F04", "M14", "O94", "CCM89"}, optional
        The law.
    r_v : float, optional
        A(V) / E(B-V).
    sed : object, optional
        Spectrum of the source before extinction, with ``wave`` and ``fnu`` (observed); else F_nu is
        constant.
    beyond : {"refuse", "transparent"}, optional
        Whether bands that reach beyond the long end of the law are refused, or taken as free of
        extinction there.

    Returns
    -------
    extinction : `~astropy.table.QTable`, n rows
        ``ebv`` and a column in mag for each band, by its name: -2.5 log10 of the photon-weighted
        mean of F_nu 10^(-0.4 A) over that of F_nu. The meta say law and R_V.

    Raises
    ------
    ValueError
        If a colour excess is missing or negative (the message names the rows), the law is not
        defined for the R_V or over a band, or the spectrum does not cover a band.
    `~astropy.units.UnitsError`
        If ``ebv`` is no magnitude.

    Examples
    --------
    >>> from miricigale.sed.foreground import band_extinction
    >>> table = band_extinction(["acs.f606w", "miri.f770w"], 0.01)
    >>> table["acs.f606w"].round(3), table["miri.f770w"].round(4)
    (<Quantity [0.029] mag>, <Quantity [0.0009] mag>)
    """
    bands = filters if isinstance(filters, FilterSet) else FilterSet(filters)
    values, _ = _colour_excess(ebv)
    check_bands(bands, law, beyond)
    low, high = coverage(law)
    points = None if sed is None else spectrum_arrays(sed)
    if points is not None:
        bands.weights(points[0])  # refuses what the spectrum does not cover
    # many sources lie in one cell of a map
    different, row = np.unique(values, return_inverse=True)
    out = QTable({"ebv": values * u.mag})
    for band in bands:
        wave, weights, norm = _band_grid(band, low, high, points)
        exponent = -0.4 * np.log(10.0) * extinction_curve(wave, law, r_v)
        lost = np.empty(different.size)
        for start in range(0, different.size, _ROWS):
            part = different[start : start + _ROWS, None]
            # the difference from 1 keeps small extinctions exact
            lost[start : start + _ROWS] = np.expm1(part * exponent) @ weights
        # + 0 makes no extinction 0 and not -0
        out[band.name] = (-2.5 / np.log(10.0) * np.log1p(lost / norm)[row] + 0.0) * u.mag
    out.meta[_KEY] = {"law": law, "r_v": float(r_v), "beyond": beyond, "reference": LAWS[law]}
    return out


def deredden(photometry, ebv, filters, *, law="G23", r_v=3.1, sed=None, beyond="refuse"):
    """
    Free a table of band fluxes from Galactic extinction.

    Parameters
    ----------
    photometry : `~astropy.table.Table`, n rows
        With a column of flux density for each band, in any linear unit; those of their errors,
        ``<band>_err``, where they are there. Missing fluxes are NaN or masked and stay so.
    ebv : float, array_like or `~astropy.units.Quantity`, shape () or (n,)
        Colour excess; see `band_extinction`.
    filters : `~miricigale.filters.FilterSet` or iterable of str
        The bands to be corrected.
    law, r_v, sed, beyond
        See `band_extinction`.

    Returns
    -------
    photometry : `~astropy.table.Table`
        A copy whose fluxes and errors are multiplied by 10^(0.4 A). The meta say law and R_V.

    Raises
    ------
    ValueError
        If a band or a colour excess is missing (the message names the rows), if there are not as
        many as rows, or if the meta say that the table is corrected already.
    `~astropy.units.UnitsError`
        If a flux or an error is in magnitudes or in no unit.
    """
    bands = filters if isinstance(filters, FilterSet) else FilterSet(filters)
    if not isinstance(photometry, Table):
        raise argument_error("photometry", "a table", type(photometry).__name__)
    if _KEY in photometry.meta:
        got = f"one whose meta say {_KEY}: {photometry.meta[_KEY]}"
        raise argument_error("photometry", "a table not corrected yet", got)
    require_columns(photometry, bands.names, "photometry")
    values, scalar = _colour_excess(ebv)
    if not scalar and values.size != len(photometry):
        got = f"{values.size} for {len(photometry)} rows"
        raise argument_error("ebv", "one number or one for each row", got)
    table = band_extinction(bands, values, law=law, r_v=r_v, sed=sed, beyond=beyond)
    out = photometry.copy()
    for name in bands.names:
        factor = 10.0 ** (0.4 * table[name].value)
        factor = factor[0] if scalar else factor
        for column in (name, error_column(name)):
            if column not in out.colnames:
                continue
            _require_flux(out, column)
            if out[column].ndim != 1 or out[column].dtype.kind not in "fiu":
                raise argument_error("photometry", "one number in each row", f"column {column!r}")
            info = out[column].info
            kept = info.description, info.format
            out[column] = out[column] * factor
            out[column].info.description, out[column].info.format = kept
    out.meta[_KEY] = dict(table.meta[_KEY])
    return out


def _require_flux(table, column):
    """Check that a column is in a linear unit of flux."""
    unit = getattr(table[column], "unit", None)
    unit = None if unit is None else u.Unit(unit)
    linear = unit is not None and not isinstance(unit, u.function.FunctionUnitBase)
    known = linear and (
        unit.is_equivalent(FNU, u.spectral_density(1.0 * u.um)) or unit.is_equivalent(u.mgy)
    )
    if not known:
        msg = f"'photometry' column {column!r} must be in a linear unit of flux, got {unit}"
        raise u.UnitsError(msg)
