"""Catalogs of users, read from common formats with their own names and units."""

from pathlib import Path

import astropy.units as u
import numpy as np

from miricigale.filters import Filter
from miricigale.filters.catalog_files import as_catalog_map, catalog_messages, mapped_table
from miricigale.filters.surveys import flux_bands
from miricigale.refdata import locate, resources
from miricigale.scene.catalog import CatalogFlags, check_catalog
from miricigale.utils.exceptions import CatalogWarning, DataError, warn
from miricigale.utils.files import reading, split_extension
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ab_magnitude

#: Counts of galaxies in K: AB magnitude and log of the number per magnitude and square degree (Weaver et
#: al. 2022, ApJS 258, 11, table 2).
_COUNTS_MAG = np.arange(19.25, 25.5, 0.5)
_COUNTS = (3.65, 3.86, 4.02, 4.16, 4.29, 4.42, 4.54, 4.66, 4.78, 4.88, 4.97, 5.07, 5.18)
_COUNTS_SLOPE = 0.6, 0.2  # dex per magnitude beyond the ends: Euclid's at the bright one
_FAR_OFF = 10.0  # times the counts; overdense fields have a few times as many
_FAINTEST = 29.5  # AB magnitude that half of the sources of a catalog may be brighter than
_SPARSE = 27.5, 0.02  # a sample that is fainter, and has fewer times the counts
_FEW = 20  # sources that counts and colors are not judged by
#: Median color in dex between bands below and beyond 10 um that indicates another unit.
_COLOR = 2.2, 2.9


@takes_other_keywords
def read_catalog(path, catalog_map=None, **options):
    """
    Read a catalog of sources.

    Parameters
    ----------
    path : str or path-like
        Name of a resource (``"catalog.goodss"``) or a FITS, ECSV, VOTable, CSV or text file
        (CIGALE's too).
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names and units of the file, the name of a survey or a file (TOML, or a translate file of EAZY), as for
        `~miricigale.filters.read_catalog_photometry`. Our names are those of `CATALOG_COLUMNS`, ``ra``,
        ``dec``, ``star``, names of filters, those with ``_err`` for errors, and any other without a dot.
    **options
        As for `~miricigale.filters.CatalogMap`, in place of what it has: ``columns``, ``units``, ``survey``,
        ``missing``, ``factor``, ``limits``.

    Returns
    -------
    catalog : `~astropy.table.QTable`
        As made by `check_catalog`.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file does not exist, or is no table.
    KeyError
        If the map names an unknown column or filter.
    ValueError, `~astropy.units.UnitsError`
        If the table is refused by `check_catalog`.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        Of numbers that stand for no value (`CatalogFlags`, ``MISSING_CODE``), sources without a usable
        flux (``NO_FLUX``), right ascensions that look like hours, fluxes that look like those of another
        unit by counts or colors, units other than the file's, bands without a filter, and shapes that are
        not complete.

    Examples
    --------
    >>> from miricigale.scene import read_catalog
    >>> catalog = read_catalog("catalog.goodss")
    >>> len(catalog)
    1308
    """
    name = str(path)
    if not isinstance(path, Path) and name in resources():
        path = locate(name)
    path = Path(path).expanduser()
    if not Path(split_extension(path)[0]).is_file():
        catalogs = ", ".join(key for key in sorted(resources()) if key.startswith("catalog."))
        msg = f"no catalog {name!r}: neither a file nor one of {catalogs}"
        raise DataError(msg)
    table, lost, coded = mapped_table(path, as_catalog_map(catalog_map, options))
    with reading(path, "a catalog"):
        _flags_of_stars(table)
        catalog = check_catalog(table, argument=path.name)
    texts = list(catalog_messages(lost, [coded]))
    for codes in coded.values():
        catalog["flags"][~np.isnan(codes)] |= CatalogFlags.MISSING_CODE
    texts += _missing_fluxes(catalog)
    # counts need an area that is right
    texts += list(_hours(table, catalog)) or _odd_units(catalog)
    for text in texts:
        warn(f"{path.name}: {text}", CatalogWarning)
    return catalog


def _flags_of_stars(table):
    """Stars as bool, where the file has 0 and 1 or words."""
    if "star" not in table.colnames or np.any(getattr(table["star"], "mask", False)):
        return
    star = np.asarray(table["star"])
    words = {"true": True, "false": False, "1": True, "0": False}
    values = [str(value).strip().lower() for value in star.tolist()]
    if star.dtype.kind in "iuUS" and set(values) <= set(words):
        table["star"] = np.array([words[value] for value in values], dtype=bool)


def _missing_fluxes(catalog):
    """Yield the warnings about sources without a flux."""
    lost = (catalog["flags"] & CatalogFlags.NO_FLUX) > 0
    if np.any(lost):
        first = ", ".join(map(str, catalog["id"][lost][:5].tolist()))
        ellipsis = ""
        if lost.sum() > 5:
            ellipsis = ", ..."
        yield (
            f"{lost.sum()} of {len(catalog)} sources have no usable flux in any band "
            f"(flag no_flux): ids {first}{ellipsis}"
        )


def _hours(table, catalog):
    """Yield the warnings about right ascensions in degrees that look like hours."""
    if "ra" not in table.colnames or table["ra"].unit != u.deg or len(catalog) < 3:
        return
    ra = catalog["sky"].ra.deg
    dec = catalog["sky"].dec.deg
    width = np.ptp(ra) * np.cos(np.radians(dec.mean()))
    if ra.max() <= 24.0 and np.ptp(dec) > 0 and width < 0.2 * np.ptp(dec):
        yield (
            f"right ascensions span {width:.2g} deg on the sky and declinations {np.ptp(dec):.2g}: "
            "if they are in hours, say units={'ra': 'hourangle'}"
        )


def _odd_units(catalog):
    """Yield the warnings about units of fluxes, by their number on the sky and their colors."""
    pivots = {name: Filter.from_name(name).pivot.value for name in flux_bands(catalog.colnames)}
    galaxies = ~np.asarray(catalog["star"])
    mags = {name: np.where(galaxies, ab_magnitude(catalog[name]), np.nan) for name in pivots}
    bands = [name for name, mag in mags.items() if np.isfinite(mag).sum() >= _FEW]
    if not bands:
        return
    reference = min(bands, key=lambda name: abs(np.log(pivots[name] / 2.0)))
    yield from _odd_counts(catalog, mags[reference], reference)
    for name in bands:
        color = mags[reference] - mags[name]
        if np.isfinite(color).sum() < _FEW:
            continue
        factor = 0.4 * float(np.nanmedian(color))
        if abs(factor) > _COLOR[int(pivots[name] > 10.0)]:
            of = f"{name} over {reference}"
            yield f"the median of {of} is {10**factor:.2g}: are these fluxes in one unit?"


def _odd_counts(catalog, magnitudes, name):
    """Yield the warnings about the unit of a band, by the density of its sources."""
    median = float(np.nanmedian(magnitudes))
    sky = catalog["sky"][np.isfinite(magnitudes)]
    ra = sky.ra.wrap_at(sky.ra[0] + 180 * u.deg).deg
    area = np.ptp(ra) * np.cos(sky.dec.rad.mean()) * np.ptp(sky.dec.deg)
    if not area > 0:
        return
    ratio = 0.5 * len(sky) / area / _expected(median)
    sparse = median > _SPARSE[0] and ratio < _SPARSE[1]
    if ratio > _FAR_OFF or median > _FAINTEST or sparse:
        yield (
            f"half of the sources are brighter than {median:.1f} AB in {name}, {ratio:.2g} times "
            "as many as counts of galaxies: are the fluxes in the unit that is said?"
        )


def _expected(magnitude):
    """Return the galaxies in a square degree that are brighter than a magnitude, in the near infrared."""
    x = np.arange(5.0, magnitude, 0.02) + 0.01
    ends = np.minimum(x - _COUNTS_MAG[0], 0.0), np.maximum(x - _COUNTS_MAG[-1], 0.0)
    log = np.interp(x, _COUNTS_MAG, _COUNTS) + sum(
        slope * end for slope, end in zip(_COUNTS_SLOPE, ends, strict=True)
    )
    return float(np.sum(10.0**log) * 0.02)
