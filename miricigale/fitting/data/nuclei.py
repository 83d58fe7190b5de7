"""Fluxes of the point in the center of galaxies, by band, as a catalog has them beside the total fluxes."""

from collections.abc import Mapping
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters.band_names import find_filter
from miricigale.filters.photometry_table import unit_of_fluxes
from miricigale.fitting.data.likelihood import NUCLEUS_SUFFIXES, flux_column, limits
from miricigale.utils.exceptions import argument_error, units_error
from miricigale.utils.missing_values import own_mask
from miricigale.utils.options import check_that
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, flux_unit, own_unit

#: Ends of the names of columns of `nucleus_table`: of the flux, its correlation and its mark as an upper limit.
NUCLEUS = "_nucleus"
CORRELATION = "_corr"
IS_LIMIT = "_limit"
#: Values of a nucleus in `read_nuclei`.
FLUX, SIGMA, COVARIANCE, LIMIT = range(4)
#: ``nuclei`` of a fitter whose models are nothing but a point.
WHOLE = "whole"


@dataclass(frozen=True)
class NucleusColumns:
    """
    Columns of a catalog with the fluxes of nuclei.

    Parameters
    ----------
    bands : tuple of str
        Bands that have one and are fitted, by our names.
    columns : tuple of str
        Columns of their fluxes; ``<column>_err``, ``<column>_corr`` and ``<column>_limit`` belong to them.
    """

    bands: tuple
    columns: tuple

    @classmethod
    def of_table(cls, colnames, bands):
        """
        Find the columns of nuclei.

        Parameters
        ----------
        colnames : list of str
            Columns of the catalog.
        bands : iterable of str
            Bands that are fitted, by our names.

        Returns
        -------
        columns : `NucleusColumns`
            Without bands if there are none.

        Raises
        ------
        ValueError
            If two columns are of the same band, or one has no errors.
        """
        bands = tuple(bands)
        _check_errors(colnames, bands)
        column_of_band = {}
        for column, band in nucleus_columns(colnames).items():
            if band not in bands:
                continue
            check_that(
                band not in column_of_band,
                "photometry",
                f"a table with one flux of nuclei in {band!r}",
                f"{column_of_band.get(band)!r} and {column!r}",
            )
            column_of_band[band] = column
        ordered = [band for band in bands if band in column_of_band]
        return cls(tuple(ordered), tuple(column_of_band[band] for band in ordered))


def nucleus_columns(colnames):
    """Find the columns that hold fluxes of nuclei and have errors: dict of band, by our names, by column."""
    band_of_column = {}
    for column in colnames:
        band = _band_of_nucleus(column)
        if band is not None and error_column(column) in colnames:
            band_of_column[column] = band
    return band_of_column


def _check_errors(colnames, bands):
    """Refuse fluxes of nuclei of bands without a column of errors."""
    for column in colnames:
        band = _band_of_nucleus(column)
        if band in bands and error_column(column) not in colnames:
            wanted = f"a table with the errors {error_column(column)!r} of {column!r} for 'nuclei'"
            raise argument_error("photometry", wanted, "none")


def _band_of_nucleus(column):
    """Name a band, by our names, whose fluxes of nuclei a column holds by its name; None for another column."""
    for suffix in NUCLEUS_SUFFIXES:
        if column.endswith(suffix):
            name = column.removesuffix(suffix)
            return find_filter(name) or name
    return None


def with_units(table, unit):
    """
    Give fluxes of nuclei without a unit that of the fluxes of bands.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        The catalog.
    unit : unit-like, dict of str to unit-like or None
        As for `~miricigale.filters.as_photometry`; AB magnitudes are left out.

    Returns
    -------
    table : `~astropy.table.QTable`
        Itself, or a copy.
    """
    unit_of_column = {}
    for column, band in nucleus_columns(table.colnames).items():
        if isinstance(unit, Mapping):
            of_band = unit.get(band, unit.get("flux"))
        else:
            of_band = unit
        if of_band is None:
            continue
        parsed = unit_of_fluxes(of_band)
        for name in (column, error_column(column)):
            if own_unit(table[name]) is None and parsed != u.ABmag:
                unit_of_column[name] = parsed
    if not unit_of_column:
        return table
    out = table.copy(copy_data=False)
    for name, parsed in unit_of_column.items():
        out[name] = out[name] * parsed
    return out


def read_nuclei(table, columns, data, reader):
    """
    Take fluxes of nuclei from a catalog.

    Zero points, the factors of errors and the part of the flux that is added to errors are those of the bands.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        The catalog.
    columns : `NucleusColumns`
        Its columns of nuclei.
    data : `~miricigale.fitting.data.likelihood.FitData`
        Its photometry of n objects.
    reader : `~miricigale.fitting.data.likelihood.PhotometryReader`
        How that was read.

    Returns
    -------
    values : `~numpy.ndarray`, shape (n, n_nuclei, 4)
        Of each band: flux and error in uJy, covariance with the total flux in uJy^2, and 1 where the flux is an
        upper limit. The error is infinite where there is none that can be used.
    left_out : `~numpy.ndarray` of bool, shape (n,)
        Objects of which a flux was left out: its error or correlation cannot be used, or the band has no total.

    Raises
    ------
    ValueError, `~astropy.units.UnitsError`
        As `nucleus_table`.
    """
    n = len(table)
    values = np.zeros((n, len(columns.bands), 4))
    values[:, :, SIGMA] = np.inf
    left_out = np.zeros(n, bool)
    measured = nucleus_table(table, columns)
    for j, band in enumerate(columns.bands):
        i = reader.bands.index(band)
        point = reader.zero_point.get(band, 1.0)
        factor = point * reader.error_factor.get(band, 1.0)
        name = band + NUCLEUS
        flux = point * measured[name].value
        error = factor * measured[error_column(name)].value
        correlation = measured[name + CORRELATION]
        limited = measured[name + IS_LIMIT]
        # no point was fitted where both are missing
        present = np.isfinite(flux) | np.isfinite(error)
        usable = np.isfinite(flux) & np.isfinite(error) & (error > 0) & data.used[:, i]
        usable &= limited | (np.abs(correlation) < 1.0)
        left_out |= present & ~usable
        # errors of models are a part of the flux; limits have none
        sigma = np.hypot(error, reader.model_error[band] * np.abs(flux))
        sigma = np.where(limited, error, sigma)
        # cov = rho sigma_point sigma_total
        covariance = correlation * error * data.flux_err[:, i]
        paired = usable & ~limited & data.measured[:, i]
        values[:, j, FLUX] = np.where(usable, flux, 0.0)
        values[:, j, SIGMA] = np.where(usable, sigma, np.inf)
        values[:, j, COVARIANCE] = np.where(paired, covariance, 0.0)
        values[:, j, LIMIT] = usable & limited
    return values, left_out


def nucleus_table(table, columns):
    """
    Read the columns of nuclei as they are, under one name for each band.

    Parameters
    ----------
    table : `~astropy.table.QTable`
        The catalog.
    columns : `NucleusColumns`
        Its columns of nuclei.

    Returns
    -------
    nuclei : `~astropy.table.QTable`
        Of each band: ``<band>_nucleus`` and ``<band>_nucleus_err`` in uJy, NaN where missing,
        ``<band>_nucleus_corr``, 0 without that column, and ``<band>_nucleus_limit``, true of upper limits.

    Raises
    ------
    ValueError
        If a column holds something else than numbers.
    `~astropy.units.UnitsError`
        If a flux has no unit of flux density, or a correlation has a unit.
    """
    nuclei = QTable()
    for band, column in zip(columns.bands, columns.columns, strict=True):
        name = band + NUCLEUS
        nuclei[name] = _fluxes(table, column) * FNU
        nuclei[error_column(name)] = _fluxes(table, error_column(column)) * FNU
        correlation = np.zeros(len(table))
        if column + CORRELATION in table.colnames:
            correlation = _numbers(table, column + CORRELATION)
        nuclei[name + CORRELATION] = correlation
        nuclei[name + IS_LIMIT] = limits(table, column)
    return nuclei


def _fluxes(table, name):
    """Read fluxes or errors of a column in uJy, NaN where masked."""
    unit = own_unit(table[name])
    parsed = None
    if unit is not None:
        parsed = flux_unit(unit) or unit
    if parsed is None or not parsed.is_equivalent(FNU):
        got = "no unit"
        if unit is not None:
            got = repr(str(unit))
        raise units_error("photometry", f"convertible to {FNU}", got, column=name)
    return flux_column(table, name)


def _numbers(table, name):
    """Read numbers of a column without unit (10 % is 0.1), NaN where masked."""
    column = table[name]
    unit = own_unit(column) or u.dimensionless_unscaled
    if not unit.is_equivalent(u.dimensionless_unscaled):
        raise units_error("photometry", "a number without a unit", repr(str(unit)), column=name)
    mask = np.broadcast_to(np.asarray(own_mask(column)), (len(table),))
    try:
        numbers = np.array(getattr(column, "unmasked", column), float)
    except (TypeError, ValueError):
        check_that(
            False, "photometry", f"a table with numbers in column {name!r}", str(column.dtype)
        )
    numbers[mask] = np.nan
    return numbers * unit.to(u.dimensionless_unscaled)
