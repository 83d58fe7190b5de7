"""A map from the columns of a catalog of other people to ours: names, units, magnitudes, missing values."""

import dataclasses
import tomllib
import types
from collections.abc import Mapping
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.coordinates import Angle
from astropy.table import MaskedColumn, QTable

from miricigale.filters.band_names import eazy_filter, name_and_unit
from miricigale.filters.filter import Filter
from miricigale.filters.surveys import SURVEYS, is_band
from miricigale.utils.column_units import silent_units
from miricigale.utils.exceptions import (
    CatalogWarning,
    argument_error,
    data_error,
    file_errors,
    units_error,
    unknown_name,
    warn,
)
from miricigale.utils.ids import id_column, ids_and_missing
from miricigale.utils.missing_values import (
    is_code,
    negative_codes,
    negative_errors,
    plain_floats,
    without_codes,
)
from miricigale.utils.named_values import convert_values, field_names, field_values
from miricigale.utils.options import check_choice, check_data, check_names, check_that, check_type
from miricigale.utils.tables import error_column
from miricigale.utils.units import FNU, flux_unit, own_unit
from miricigale.utils.values import value_class

#: Unit that a column without any has.
_DEFAULT_UNITS = {"ra": u.deg, "dec": u.deg, "position_angle": u.deg}
#: Endings of translate files of EAZY.
TRANSLATE_SUFFIXES = (".translate", ".csv")
#: Error in magnitudes times flux is an error of the flux.
_PER_MAGNITUDE = 0.4 * np.log(10)


@value_class
class CatalogMap:
    """
    Names, units and missing values of a catalog.

    Parameters
    ----------
    columns : dict of str to str, optional
        Our name of a column to the file's, such as ``{"wfc3.f160w": "FLUX_H"}``. Ours are ``id``, ``ra``,
        ``dec``, ``redshift``, names of filters, those with ``_err`` for errors, and any other without a dot.
        Columns that are not named keep their names, but for the ids (`miricigale.utils.ids.id_column`).
    units : dict of str to str or `~astropy.units.Unit`, optional
        Units by our name, for columns whose file gives none or a wrong one; ``"flux"`` stands for all
        fluxes and errors: ``{"flux": "mJy", "ra": "hourangle"}``, ``{"flux": "0.3631 uJy"}`` for a
        zero point of 25, ``{"flux": "ABmag"}`` for AB magnitudes, whose errors are in magnitudes too.
        Without unit ``ra``, ``dec`` and ``position_angle`` are in degrees.
    survey : str, optional
        Name in `SURVEYS`, whose names of columns and units are taken where ``columns`` and ``units``
        have no other.
    missing : iterable of float, optional
        Further numbers that stand for no value in fluxes and errors, in the file's unit.
    factor : str, optional
        The file's name of a column of factors on all fluxes and errors of a source, as from an aperture to
        the total; if it is in mag it is added to the magnitudes.
    limits : bool, optional
        Whether a negative error marks an upper limit, as in CIGALE: the flux is the limit and minus the error its
        1 sigma, marked in a column ``<filter>_limit``. Limits that are not positive are missing.
    error_factors : dict of str to float, optional
        By filter, what its errors are multiplied by, as the third column of a translate file of EAZY says.
    left_out : iterable of str, optional
        Columns of fluxes that have no filter here, which a warning names.

    Raises
    ------
    KeyError
        If ``columns`` or ``units`` name a filter that there is not, or ``survey`` is unknown.
    ValueError
        If two columns are one of the file, or something is no dict or no truth value.

    Examples
    --------
    >>> from astropy.table import Table
    >>> from miricigale.filters import CatalogMap
    >>> catalog_map = CatalogMap({"wfc3.f160w": "H"}, units={"flux": "ABmag"}, missing=[0])
    >>> table, coded = catalog_map.convert(Table({"H": [23.9, 21.4, -99.0]}))
    >>> table["wfc3.f160w"]
    <Quantity [ 1., 10., nan] uJy>
    """

    columns: Mapping = dataclasses.field(default_factory=dict)
    units: Mapping = dataclasses.field(default_factory=dict)
    survey: str | None = None
    missing: tuple = ()
    factor: str | None = None
    limits: bool = False
    error_factors: Mapping = dataclasses.field(default_factory=dict)
    left_out: tuple = ()

    def __post_init__(self):
        for argument in ("columns", "units", "error_factors"):
            names = getattr(self, argument) or {}
            check_type(names, argument, Mapping, "a dict by our names of columns")
            for name in names:
                if "." in str(name) and not is_band(name):
                    band = str(name).removesuffix(error_column(""))
                    raise unknown_name("filter", band, Filter.names())
            object.__setattr__(self, argument, types.MappingProxyType(dict(names)))
        if len(set(self.columns.values())) < len(self.columns):
            raise argument_error("columns", "a dict whose values differ", dict(self.columns))
        if self.survey is not None:
            check_names([self.survey], "survey", SURVEYS)
        check_choice(self.limits, "limits", (True, False))
        for name, factor in self.error_factors.items():
            good = np.isfinite(factor) and factor > 0
            check_that(good, "error_factors", f"positive for {name!r}", factor)
        object.__setattr__(self, "left_out", tuple(map(str, self.left_out)))
        object.__setattr__(self, "missing", tuple(map(float, self.missing)))

    @classmethod
    def read(cls, path):
        """
        Read a map in TOML: tables ``columns`` and ``units``, keys ``survey``, ``missing``, ``factor``, ``limits``.

        A file that ends in ``.translate`` or ``.csv`` is one of EAZY's (`from_translate`), without units.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing, not TOML, has another key or a value that a map cannot have, such as an unknown
            filter; if two columns of a translate file are one filter.
        """
        path = Path(path).expanduser()
        with file_errors(path, "cannot be read as a map of columns", OSError, RecursionError):
            text = path.read_text(encoding="utf-8")
            if path.suffix.lower() in TRANSLATE_SUFFIXES:
                return cls(**_translated(_translate_rows(text), path))
            values = tomllib.loads(text)
        fields = field_names(cls)
        unknown = sorted(set(values) - set(fields))
        check_data(not unknown, path, f"is no map of columns: it has {unknown}; known: {fields}")
        with file_errors(path, "is no map of columns"):
            return cls(**values)

    @classmethod
    def from_translate(cls, translate):
        """
        Make a map of a translate file of EAZY.

        Parameters
        ----------
        translate : str or `eazy.param.TranslateFile`
            Lines of a column of the catalog, ``F<number>`` (flux) or ``E<number>`` (error) of a filter in
            ``FILTER.RES.latest``, ``id``, ``z_spec``, ``ra`` or ``dec``, and for errors a factor; or the text with
            commas that its ``to_csv`` gives.

        Returns
        -------
        catalog_map : `CatalogMap`
            Fluxes in filters without a curve here are in ``left_out``; errors are multiplied by their factors.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If two columns are one filter, or a line means something else.
        """
        if isinstance(translate, str):
            rows = _translate_rows(translate)
        else:
            factors = translate.error
            rows = []
            for key, kind in translate.trans.items():
                rows.append((key, str(kind), float(factors.get(key, 1.0))))
        return cls(**_translated(rows, "the translate file"))

    @property
    def id_names(self):
        """Column of the file that the map calls ``id``: a tuple, empty if it names none."""
        if "id" in self.columns:
            return (self.columns["id"],)
        return ()

    def settings(self):
        """Return what the map says, in plain values."""
        values = field_values(self)
        if not self.limits:
            # as before limits were known, so that results of such maps can be resumed
            del values["limits"]
        del values["left_out"]
        if self.error_factors:
            values["error_factors"] = dict(self.error_factors)
        else:
            del values["error_factors"]
        values["columns"] = dict(self.columns)
        values["units"] = convert_values(str, self.units)
        return values

    def names(self, colnames, argument="catalog"):
        """
        Return our names of the columns of a file.

        Parameters
        ----------
        colnames : iterable of str
            The file's.
        argument : str, optional
            What the file is called in messages.

        Returns
        -------
        names : dict of str to str
            The file's names to ours, in the order of the file; a column whose name is ours but is not meant
            is left out.
        lost : list of str
            Fluxes by the survey's names that no filter here belongs to.

        Raises
        ------
        KeyError, ValueError
            If a column is not there; if there is none of the survey, or several could be the ids.
        """
        colnames = list(colnames)
        columns = {}
        lost = []
        if self.survey is not None:
            columns, lost = SURVEYS[self.survey].columns(colnames)
            if not any(map(is_band, {**columns, **self.columns})):
                raise argument_error(
                    argument, f"a table with columns of {self.survey!r}", f"columns {colnames}"
                )
        mapped = set(self.columns.values())
        if "id" not in {**columns, **self.columns}:
            theirs = id_column([name for name in colnames if name not in mapped], argument)
            columns |= {} if theirs in (None, "id") else {"id": theirs}
        columns = {ours: theirs for ours, theirs in columns.items() if theirs not in mapped}
        columns |= self.columns
        for ours, theirs in columns.items():
            check_names([theirs], f"column of {argument} (for {ours!r})", colnames)
        ours = {theirs: name for name, theirs in columns.items()}
        unmapped = (name for name in colnames if name in ours or name not in columns)
        lost = lost + [name for name in self.left_out if name in colnames]
        return {name: ours.get(name, name) for name in unmapped}, [n for n in lost if n not in ours]

    def convert(self, table, argument="catalog"):
        """
        Bring a table to our names and units.

        Parameters
        ----------
        table : `~astropy.table.Table`
            As the file has it.
        argument : str, optional
            What it is called in messages.

        Returns
        -------
        table : `~astropy.table.QTable`
            Fluxes and errors in uJy, NaN where they are missing; with ``limits`` whether each flux is an upper
            limit; ids that are whole numbers as integers, and other numbers as text.
        coded : dict of str to `~numpy.ndarray` of float, shape (n,)
            By band the number that stands for no value, NaN in rows that have none.

        Raises
        ------
        KeyError
            If a column is not there.
        ValueError, `~astropy.units.UnitsError`
            If a column holds no numbers, or has no unit or a wrong one; with ``limits``, if an error in
            magnitudes is negative, which is no 1 sigma of a flux, or the file has ``<filter>_limit`` already.

        Warns
        -----
        `~miricigale.utils.exceptions.CatalogWarning`
            Of units other than the file's.
        """
        names, _ = self.names(table.colnames, argument)
        out = QTable(meta=table.meta)
        for theirs, ours in names.items():
            with silent_units():
                out[ours] = table[theirs]
            unit = name_and_unit(theirs)[1]
            if is_band(ours) and unit is not None and own_unit(out[ours]) is None:
                out[ours].unit = unit
        check_names(self.units, f"column of {argument}", out.colnames + ["flux"])
        _plain_ids(out, argument)
        coded = {}
        factor = self._factor(table, argument, coded)
        for name in out.colnames:
            if is_band(name):
                if not name.endswith(error_column("")):
                    coded[name] = self.set_band(out, name, factor, argument)
                elif name.removesuffix(error_column("")) not in out.colnames:
                    self.set_band(out, name, factor, argument)
            else:
                self._set_unit(out, name, argument)
        return out, coded

    def _factor(self, table, argument, coded):
        """Factor on the fluxes of each source, NaN where it is missing; such numbers go to ``coded``."""
        if self.factor is None:
            return 1.0
        check_names([self.factor], f"column of {argument}", table.colnames)
        column = table[self.factor]
        values = _column_floats(column, self.factor, argument)
        in_magnitudes = column.unit == u.mag
        missing = is_code(values) | np.isinf(values)
        if not in_magnitudes:
            missing |= values <= 0
        coded[self.factor] = np.where(missing, values, np.nan)
        values = np.where(missing, np.nan, values)
        if in_magnitudes:
            return 10 ** (-0.4 * values)
        return values

    def _unit_of_column(self, name, column, of_flux, argument):
        """Return the unit that the caller says a column has, or the file's; a warning where these differ."""
        asked_unit = self.units.get(name, self.units.get("flux") if of_flux else None)
        column_unit = own_unit(column)
        if column_unit is not None:
            column_unit = flux_unit(column_unit) or u.Unit(column_unit)
        if asked_unit is None:
            if column_unit is None and of_flux and self.survey is not None:
                return u.Unit(SURVEYS[self.survey].unit)
            if column_unit is None:
                return _DEFAULT_UNITS.get(name)
            return column_unit
        asked_unit = _unit(asked_unit, name)
        differs = column_unit is not None and column_unit != asked_unit
        if differs and not (column_unit == u.mag and _is_ab(asked_unit)):
            msg = f"{argument}: {name!r} taken in {asked_unit}, the file says {column_unit}"
            warn(msg, CatalogWarning)
        return asked_unit

    def _set_unit(self, table, name, argument):
        """Give a column that is no flux the unit that the caller says, or the usual one."""
        column = table[name]
        unit = self._unit_of_column(name, column, False, argument)
        is_asked = name in self.units
        if unit is None or not (is_asked or own_unit(column) is None):
            return
        if is_asked and column.dtype.kind in "USO" and unit.is_equivalent(u.deg):
            table[name] = _angles(column, unit, name, argument)
        elif is_asked or column.dtype.kind in "if":
            table[name] = u.Quantity(plain_floats(column, name, argument), unit)

    def set_band(self, table, name, factor, argument):
        """Bring fluxes and errors of a band to uJy; returns the numbers that stand for no value."""
        error = error_column(name)
        unit = self._unit_of_column(name, table[name], True, argument)
        if unit is None or unit == u.mag or not (_is_ab(unit) or unit.is_equivalent(FNU)):
            say = "give one, such as units={'flux': 'uJy'} (or 'ABmag', 'mJy')"
            if unit == u.mag:
                say = "AB magnitudes are units={'flux': 'ABmag'}"
            elif unit is not None:
                say = "say another, such as units={'flux': 'uJy'}, if it is wrong"
            raise units_error(
                argument, f"convertible to {FNU}", f"{unit or 'no unit'}: {say}", column=name
            )
        values = _column_floats(table[name], name, argument)
        errors = None
        if error in table.colnames:
            errors = _column_floats(table[error], error, argument)
        ab = _is_ab(unit)
        missing, no_error = without_codes(values, errors, magnitudes=ab, further=self.missing)
        if errors is not None and not self.limits and not ab:
            # -99 nJy of both is -0.099 uJy of both
            missing |= (errors < 0) & (errors == values)
            no_error |= ~missing & negative_codes(values, errors)
        code = np.where(missing, values, np.nan)
        if ab:
            flux = 10 ** (-0.4 * (np.where(missing, np.nan, values) - 23.9))
        else:
            flux = u.Quantity(np.where(missing, np.nan, values), unit).to_value(FNU)
        table[name] = flux * factor * FNU
        if errors is None:
            return code
        code = np.where(no_error & ~missing, errors, code)
        errors = np.where(missing | no_error, np.nan, errors)
        if self.limits:
            limit, nothing = negative_errors(flux, errors)
            wanted = f"a table without '{name}_limit' where negative errors mark limits"
            check_that(f"{name}_limit" not in table.colnames, argument, wanted, "both")
            wanted = f"fluxes in {name!r} where negative errors mark limits"
            check_that(not (ab and np.any(limit | nothing)), argument, wanted, "AB magnitudes")
            code = np.where(nothing, values, code)
            table[name] = np.where(nothing, np.nan, flux * factor) * FNU
            table[f"{name}_limit"] = limit
            errors = np.where(nothing, np.nan, np.abs(errors))
        table[error] = self._errors(table[error], error, errors, flux, ab, argument) * factor * FNU
        return code

    def _errors(self, column, name, errors, flux, ab, argument):
        """Return the errors of fluxes in uJy, from those in the file's unit."""
        has_unit = not ab or name in self.units or "flux" not in self.units
        unit = u.mag
        if has_unit:
            unit = self._unit_of_column(name, column, not ab, argument)
        factor = self.error_factors.get(name.removesuffix(error_column("")), 1.0)
        if ab and (unit in (None, u.mag, u.dimensionless_unscaled) or _is_ab(unit)):
            return _PER_MAGNITUDE * flux * errors * factor
        if unit is None or not unit.is_equivalent(FNU):
            raise units_error(argument, f"convertible to {FNU}", unit, column=name)
        return u.Quantity(errors, unit).to_value(FNU) * factor


def _column_floats(column, name, argument):
    """Return the numbers of a column that has one in each row (`miricigale.utils.missing_values.plain_floats`)."""
    shape = np.shape(column)
    check_that(
        len(shape) == 1, argument, f"a table with one number in a row of {name!r}", f"shape {shape}"
    )
    return plain_floats(column, name, argument)


def _translate_rows(text):
    """Return the rows of a translate file of EAZY, in either of its forms: column, meaning and factor."""
    lines = [line.partition("#")[0].strip().lstrip("\ufeff") for line in text.splitlines()]
    lines = [line for line in lines if line]
    with_commas = bool(lines) and lines[0].replace(" ", "").startswith("column,trans")
    rows = []
    for line in lines[1:] if with_commas else lines:
        if with_commas:
            parts = [part.strip() for part in line.split(",")]
        else:
            parts = line.split()
        parts = [part for part in parts if part]
        if len(parts) > 1:
            rows.append((parts[0], parts[1], parts[2] if len(parts) > 2 else 1.0))
    return rows


def _translated(rows, path):
    """Return the arguments of a `CatalogMap` from the rows of a translate file of EAZY."""
    columns = {}
    factors = {}
    left_out = []
    names = {"id": "id", "z_spec": "redshift", "ra": "ra", "dec": "dec"}
    for theirs, meaning, factor in rows:
        kind = meaning[:1].upper()
        number = meaning[1:]
        if meaning.lower() in names:
            columns[names[meaning.lower()]] = theirs
        elif kind in ("F", "E") and number.isdigit():
            band = eazy_filter(number)
            if band is None:
                left_out += [theirs] if kind == "F" else []
                continue
            ours = band
            if kind != "F":
                ours = error_column(band)
            problem = f"has two columns for {ours} ({meaning}): {columns.get(ours)} and {theirs}; remove one"
            check_data(ours not in columns, path, problem)
            columns[ours] = theirs
            if kind == "E" and float(factor) != 1.0:
                factors[band] = float(factor)
        elif meaning.upper().startswith("TOT"):
            msg = f"{path}: {meaning} ({theirs}) is not applied: masses and luminosities are those of the "
            msg += "catalog's apertures; multiply fluxes and errors by total over aperture flux beforehand"
            warn(msg, CatalogWarning)
        else:
            wanted = "F or E and a number, id, z_spec, ra, dec or TOT"
            raise data_error(path, f"must have {wanted} after {theirs}, got {meaning!r}")
    return {"columns": columns, "error_factors": factors, "left_out": left_out}


def _plain_ids(table, argument):
    """Ids as integers or text (`miricigale.utils.ids`), masked where they are missing."""
    if "id" not in table.colnames:
        return
    ids, missing = ids_and_missing(table["id"], argument)
    if missing.any():
        table["id"] = MaskedColumn(ids, mask=missing)
    else:
        table["id"] = ids


def _angles(column, unit, name, argument):
    """Return the angles from text such as 3:32:30.1."""
    try:
        return u.Quantity(Angle(np.asarray(column).astype(str), unit).to(u.deg))
    except (ValueError, u.UnitsError) as err:
        raise argument_error(
            argument, f"a table with angles in {name!r}", repr(str(column[0]))
        ) from err


def _unit(unit, name):
    """Return a unit that the caller gave; AB magnitudes by any of their names."""
    flux = None
    if isinstance(unit, (str, u.UnitBase)):
        flux = flux_unit(unit)
    if flux is not None:
        return flux
    try:
        return u.Unit(unit)
    except (TypeError, ValueError) as err:
        raise argument_error("units", f"a dict of units, also for {name!r}", unit) from err


def _is_ab(unit):
    return isinstance(unit, u.function.FunctionUnitBase) and unit == u.ABmag
