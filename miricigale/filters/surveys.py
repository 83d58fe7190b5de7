"""How surveys call the columns of their catalogs."""

import dataclasses
import re
import types

from miricigale.filters.band_names import find_filter
from miricigale.filters.filter import Filter
from miricigale.utils.exceptions import DataError
from miricigale.utils.package_tables import declared
from miricigale.utils.tables import error_column


@dataclasses.dataclass(frozen=True)
class _Survey:
    """
    How a survey calls its columns.

    ``flux`` is a regular expression whose first group is the band, ``error`` the name of its errors by the
    groups, ``unit`` that of both where the file has none, ``names`` the choices for other columns, ``bands``
    filters of names that mean another one elsewhere (empty: no curve here).
    """

    flux: str
    error: str
    unit: str
    names: dict
    bands: dict = dataclasses.field(default_factory=dict)

    def columns(self, colnames):
        """Return our names of the columns that are there to theirs; the bands without a filter."""
        columns = {}
        lost = []
        for ours, choices in self.names.items():
            theirs = next((name for name in choices if name in colnames), None)
            if theirs is not None:
                columns[ours] = theirs
        for name in colnames:
            match = re.fullmatch(self.flux, name)
            error = match and match.expand(self.error)
            if error not in colnames:
                continue
            if match[1] in self.bands:
                band = self.bands[match[1]]
            else:
                band = find_filter(match[1])
            if not (band and is_band(band)):
                lost.append(name)
            elif band in columns:
                msg = f"the columns {columns[band]} and {name} are both the filter {band}"
                raise DataError(msg)
            else:
                columns |= {band: name, error_column(band): error}
        return columns, lost


#: Bands that a catalog has at least whose columns are taken for those of a survey.
_MIN_BANDS = 2
#: Column names and units of catalogs, by name of the survey.
SURVEYS = types.MappingProxyType(
    {n: _Survey(**entry) for n, entry in declared("miricigale.filters", "surveys.toml").items()}
)


def flux_bands(colnames):
    """Return those of some columns that are the fluxes of filters of the library."""
    bands = []
    for name in colnames:
        if is_band(name) and not name.endswith(error_column("")):
            bands.append(name)
    return bands


def is_band(name):
    """Tell whether a column is called by a filter of the library, or is the error of one."""
    band = name.removesuffix(error_column(""))
    return band in Filter.names() or band.startswith("sedpy.")


def map_names(colnames, *, own_names=True):
    """
    Say how catalogs with some columns are read by the map of their survey.

    Parameters
    ----------
    colnames : iterable of str
        Columns of a catalog.
    own_names : bool, optional
        Whether maps count whose columns are bands and ``<band>_err``, as any catalog may have them.

    Returns
    -------
    text : str
        Options of the command line and calls; empty if no map has two bands of these columns.
    """
    surveys = []
    for survey, columns in SURVEYS.items():
        if not own_names and columns.error.endswith("_err"):
            continue
        try:
            ours, _ = columns.columns(colnames)
        except DataError:
            # two columns of a band, of which the map says more
            surveys.append(survey)
            continue
        if len(flux_bands(ours)) >= _MIN_BANDS:
            surveys.append(survey)
    options = " or ".join(f"--map {survey}" for survey in surveys)
    calls = " or ".join(f"read_catalog_photometry(path, {survey!r})" for survey in surveys)
    if not surveys:
        return ""
    return f"{options} ({calls} in Python)"
