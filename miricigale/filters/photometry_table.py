"""Catalogs of measured fluxes, however their columns are called."""

import re
from collections.abc import Mapping

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters.band_names import find_filter, name_and_unit
from miricigale.filters.catalog_files import catalog_messages, codes_of, without_codes_of
from miricigale.filters.catalog_map import CatalogMap
from miricigale.filters.library import FILTERS
from miricigale.utils.column_units import quantity_table, silent_units
from miricigale.utils.exceptions import CatalogWarning, units_error, warn
from miricigale.utils.ids import counted_ids, id_column
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.tables import as_table, error_column
from miricigale.utils.units import FNU, flux_unit, own_unit

# what stands before or after the band in names of fluxes, magnitudes and their errors
_ERROR = re.compile(
    r"(?:e|err|error|sigma|d|(?:mag|flux|f|m)_?(?:err|error))_(?:mag_|flux_)?(?P<a>.+)"
    r"|(?P<b>.+?)(?:_flux|_mag)?_?(?:err|error|unc|_e)",
    re.IGNORECASE,
)
_FLUX = re.compile(r"(?:f|flux|mag|m)_(?P<a>.+)|(?P<b>.+?)_(?:flux|mag)", re.IGNORECASE)
_MAGNITUDE = re.compile(
    r"(?:(?:e|err|error|sigma|d)_)?(?:mag|m)_?(?:err|error)?_|.*_mag(?:_?err(?:or)?)?$|(?:ab)?mag(?:nitude)?$",
    re.IGNORECASE,
)

# columns that are the only band asked for
_ALONE = ("flux", "flux_density", "fnu", "f_nu", "mag", "magnitude", "abmag")
# after the name of a band: whether its flux is an upper limit
_LIMIT = "_limit"


@takes_other_keywords
def as_photometry(data, bands, argument="photometry", *, units=None):
    """
    Return the catalog with columns by the names of bands, of any table.

    Parameters
    ----------
    data : `~astropy.table.Table` or anything for `~miricigale.utils.tables.as_table`
        Fluxes by any usual name of a band (``F770W``, ``f_F770W``, ``mag_F770W``, ``jwst.miri.F770W``) and
        their errors (``F770W_err``, ``e_F770W``, ``err_F770W``), as flux densities or AB magnitudes; a unit may
        end the name of a column without one (``F770W [uJy]``, ``f_F770W_nJy``). Where one band is meant and none
        is named, ``flux`` or ``mag`` is it. Also the ``obs`` of Prospector, a single object in maggies: a dict, or
        its ``Photometry``.
    bands : iterable of str
        Our names of the bands that are meant; other columns stay as they are.
    argument : str, optional
        The argument's name, for messages.
    units : unit-like or dict of str to unit-like, optional
        Unit of fluxes and errors that have none, such as ``"uJy"`` or ``"ABmag"`` (errors are in magnitudes then),
        for all or by band. Columns with a unit keep it.

    Returns
    -------
    table : `~astropy.table.Table`
        Itself, if its columns have our names already and no number stands for no value; else a copy with fluxes
        by band, errors ``<band>_err`` and ``id`` (`miricigale.utils.ids.id_column`), which counts the rows from 1
        where there is none.

    Raises
    ------
    ValueError
        If it is no table, two columns are the same band (of a flux and a magnitude the flux is taken), or several
        columns could be the ids.
    `~astropy.units.UnitsError`
        If errors of magnitudes are in another unit than mag or a flux density's, or ``units`` has one that is
        none of flux densities and AB magnitudes.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of numbers that stand for no value and become NaN, by band: magnitudes such as 99 or -99, and fluxes such
        as -99 whose error is not of its size (:doc:`/method/filters`); and if rows are counted though a column
        looks like ids.

    Examples
    --------
    >>> from miricigale.filters import as_photometry
    >>> table = as_photometry({"mag_F770W": [23.9], "e_mag_F770W": [0.1]}, ["miri.f770w"])
    >>> table["miri.f770w"], table["miri.f770w_err"].round(3)
    (<Quantity [1.] uJy>, <Quantity [0.092] uJy>)
    """
    if _is_of_prospector(data):
        data = _of_prospector(data)
    table = as_table(data, argument)
    bands = tuple(bands)
    names = _our_names(table.colnames, bands, argument)
    stated_units = _stated_units(table, names, bands, units)
    magnitudes = []
    for name in bands:
        if _is_ab(table, names.get(name)) and name not in stated_units:
            magnitudes.append(name)
    if (
        not magnitudes
        and not stated_units
        and "id" in names
        and all(ours == name for ours, name in names.items())
    ):
        coded = codes_of(table, bands)
        _warn_of_codes(coded, argument)
        return without_codes_of(table, coded)
    back = {theirs: ours for ours, theirs in names.items()}
    with silent_units():
        out = quantity_table(table, copy=False)
        if back:
            out = QTable({back.get(name, name): out[name] for name in table.colnames}, copy=False)
    out.meta = table.meta
    if "id" not in out.colnames:
        out["id"] = counted_ids(table, argument)
    catalog_map = CatalogMap(units=dict.fromkeys(magnitudes, u.ABmag) | stated_units)
    coded = {}
    in_their_unit = []
    for name in bands:
        if name in magnitudes or {name, error_column(name)} & set(stated_units):
            coded[name] = catalog_map.set_band(out, name, 1.0, argument)
        else:
            in_their_unit.append(name)
    of_their_unit = codes_of(out, in_their_unit)
    _warn_of_codes(coded | of_their_unit, argument)
    return without_codes_of(out, of_their_unit)


def names_of_columns(data, bands, argument="photometry"):
    """
    Return the names that a catalog has for fluxes and errors of bands.

    Parameters
    ----------
    data : object
        As for `as_photometry`.
    bands : iterable of str
        Bands.
    argument : str, optional
        The argument's name, for messages.

    Returns
    -------
    names : dict of str to str
        Column of the catalog by that of `as_photometry`; empty of photometry that is no table.
    """
    if _is_of_prospector(data):
        return {}
    return _our_names(as_table(data, argument).colnames, tuple(bands), argument)


def _warn_of_codes(coded, argument):
    """Count the numbers that were taken as missing (as `codes_of` returns them) in a warning."""
    for text in catalog_messages((), [coded]):
        warn(f"{argument}: {text}", CatalogWarning)


def _stated_units(table, names, bands, units):
    """Return the units that a caller says of fluxes and errors without one: by our names of the columns."""
    by_name = _units_in_names(table, names, bands)
    if units is None:
        return by_name
    by_band = units
    if isinstance(units, Mapping):
        by_band = {find_filter(str(name)) or str(name): unit for name, unit in units.items()}
        accepted = list(bands) + ["flux"]
        check_that(
            set(by_band) <= set(accepted), "units", f"a dict with keys among {accepted}", units
        )
    else:
        by_band = {"flux": units}
    units_by_column = {}
    for band in bands:
        asked_unit = by_band.get(band, by_band.get("flux"))
        if asked_unit is None or band not in names:
            continue
        unit = unit_of_fluxes(asked_unit)
        if _is_ab(table, names[band]):
            # magnitudes by their name or unit
            continue
        if own_unit(table[names[band]]) is None:
            units_by_column[band] = unit
        error = error_column(band)
        lacks_unit = error in names and own_unit(table[names[error]]) is None
        if lacks_unit and unit != u.ABmag:
            units_by_column[error] = unit
    return units_by_column | by_name


def _units_in_names(table, names, bands):
    """Return the units at the end of names of columns that have no other, by our names of the columns."""
    units = {}
    for band in bands:
        for name in (band, error_column(band)):
            if name not in names or own_unit(table[names[name]]) is not None:
                continue
            unit = name_and_unit(names[name])[1]
            if unit is not None:
                units[name] = unit
    return units


def unit_of_fluxes(unit, argument="units"):
    """
    Return the unit of flux densities, or AB magnitudes, that a caller names.

    Parameters
    ----------
    unit : unit-like
        Such as ``"uJy"``, ``"nanomaggies"``, ``"ABmag"``.
    argument : str, optional
        The argument's name, for messages.

    Returns
    -------
    unit : `~astropy.units.UnitBase` or `~astropy.units.FunctionUnitBase`

    Raises
    ------
    `~astropy.units.UnitsError`
        If it is something else.
    """
    wanted = f"a unit of flux density, such as {FNU}, or 'ABmag'"
    try:
        parsed = flux_unit(unit) or u.Unit(unit)
    except (TypeError, ValueError):
        raise units_error(argument, wanted, repr(unit)) from None
    is_flux = isinstance(parsed, u.UnitBase) and parsed.is_equivalent(FNU)
    if not is_flux and parsed != u.ABmag:
        raise units_error(argument, wanted, repr(str(unit)))
    return parsed


def _is_of_prospector(data):
    """Tell whether something is the photometry of an object as Prospector has it."""
    if isinstance(data, Mapping):
        return {"filters", "maggies", "maggies_unc"} <= set(data)
    return all(hasattr(data, name) for name in ("filters", "flux", "uncertainty"))


def _of_prospector(data):
    """Return the columns of one row of the photometry of Prospector, in maggies; masked bands are missing."""
    if isinstance(data, Mapping):
        flux = floats(data["maggies"])
        error = floats(data["maggies_unc"])
        good = data.get("phot_mask")
        filters = data["filters"]
    else:
        flux = floats(data.flux)
        error = floats(data.uncertainty)
        good = getattr(data, "mask", None)
        filters = data.filters
    if good is None:
        good = np.ones(flux.shape, dtype=bool)
    else:
        good = np.broadcast_to(good, flux.shape)
    names = [getattr(item, "name", str(item)) for item in getattr(filters, "filters", filters)]
    names = [find_filter(name) or name for name in names]
    is_consistent = len(names) == flux.size == error.size
    check_that(
        is_consistent, "photometry", "a flux and an error for each filter", f"{len(names)} filters"
    )
    unit = flux_unit("maggies")
    columns = {}
    for name, value, sigma, is_good in zip(names, flux, error, good, strict=True):
        columns[name] = [value if is_good else np.nan] * unit
        columns[error_column(name)] = [sigma if is_good else np.nan] * unit
    return columns


def band_columns(table, argument="photometry"):
    """
    Return the columns that are fluxes or magnitudes, and errors, of bands under names other than ours.

    Parameters
    ----------
    table : `~astropy.table.Table`
        A catalog, or its first rows.
    argument : str, optional
        The argument's name, for messages.

    Returns
    -------
    names : dict of str to str
        Our names by theirs, of bands with an error and of the ids.
    magnitudes : list of str
        Those of the bands whose column holds AB magnitudes, by its unit or, without one, its name.

    Raises
    ------
    ValueError
        If two columns are the same band, or several could be the ids.
    """
    columns = _our_names(table.colnames, FILTERS.names(), argument)
    complete = [name for name in columns if error_column(name) in columns]
    used_names = {
        "id",
        *complete,
        *map(error_column, complete),
        *(f"{name}{_LIMIT}" for name in complete),
    }
    names = {}
    for ours, theirs in columns.items():
        if ours in used_names and ours != theirs:
            names[theirs] = ours
    return names, [name for name in complete if _is_ab(table, columns[name])]


def our_names(colnames):
    """Our names of columns that are fluxes, magnitudes and errors of bands, and ids: dict by their names."""
    out = {}
    for ours, theirs in _our_names(colnames, FILTERS.names(), "photometry").items():
        out[theirs] = ours
    return out


def _our_names(colnames, bands, argument):
    """Return our names of the columns that are fluxes and errors of bands, and of ids, to theirs."""
    errors = {error_column(name): name for name in bands}
    columns = {name: name for name in (*bands, *errors) if name in colnames}
    ids = id_column(colnames, argument)
    if ids is not None:
        columns["id"] = ids
    for name in columns:
        namesakes = [label for label in colnames if label.lower() == name.lower()]
        if name != "id":
            check_that(
                len(namesakes) == 1, argument, f"a table with one column for {name!r}", namesakes
            )
    unmatched = [name for name in colnames if name not in columns and name != ids]
    logarithmic = [name for name in unmatched if _MAGNITUDE.match(name_and_unit(name)[0])]
    linear = [name for name in unmatched if name not in logarithmic]
    columns |= _matched(linear, colnames, bands, argument)
    magnitudes = _matched(logarithmic, colnames, bands, argument)
    for band in bands:
        if _magnitude_counts(band, columns, magnitudes):
            columns[band] = magnitudes[band]
            error = error_column(band)
            if error in magnitudes:
                columns[error] = magnitudes[error]
    for theirs in colnames:
        if not theirs.endswith(_LIMIT):
            continue
        band = _band_of(theirs.removesuffix(_LIMIT), bands)
        if band in bands and f"{band}{_LIMIT}" not in colnames:
            columns[f"{band}{_LIMIT}"] = theirs
    ambiguous = [name for name in colnames if name.lower() in _ALONE]
    if len(bands) == len(ambiguous) == 1 and bands[0] not in columns:
        columns[bands[0]] = ambiguous[0]
    return columns


def _magnitude_counts(band, columns, magnitudes):
    """Tell whether the magnitude of a band is taken: without a flux, or with an error that the flux has not."""
    if band not in magnitudes:
        return False
    if band not in columns:
        return True
    error = error_column(band)
    return error not in columns and error in magnitudes


def _matched(names, colnames, bands, argument):
    """Return our names of columns under other names, to theirs."""
    matches = {}
    for theirs in names:
        ours = _band_of(theirs, bands)
        if ours is None or (ours in colnames):
            continue
        wanted = f"a table with one column for {ours!r}"
        check_that(ours not in matches, argument, wanted, f"{matches.get(ours)!r} and {theirs!r}")
        matches[ours] = theirs
    return matches


def _band_of(name, bands):
    """Our name of a column of flux or error; None of others. A unit at the end of a name is no part of it."""
    bare_name, _ = name_and_unit(name)
    band = _find(name, bands) or _find(bare_name, bands)
    if band is not None:
        return band
    for pattern, called in ((_ERROR, error_column), (_FLUX, str)):
        match = pattern.fullmatch(bare_name)
        part = match and (match["a"] or match["b"])
        # errors of what is called flux_F770W
        inner = part and _FLUX.fullmatch(part)
        for text in filter(None, (part, inner and (inner["a"] or inner["b"]))):
            if _find(text, bands):
                return called(_find(text, bands))
    return None


def _find(text, bands):
    band = text
    if text not in bands:
        band = find_filter(text)
    if band in bands:
        return band
    return None


def _is_ab(table, name):
    if name is None:
        return False
    unit = own_unit(table[name])
    if unit is None:
        label, unit = name_and_unit(name)
        if unit is None:
            return _MAGNITUDE.match(label) is not None
    # columns of astropy keep a name such as "ABmag" as text
    return (flux_unit(unit) or unit) == u.ABmag
