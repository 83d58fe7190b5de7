"""Truth and measurement side by side."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.utils.exceptions import argument_error
from miricigale.utils.tables import error_column, match_sky, require_columns
from miricigale.utils.units import FNU

__all__ = ["match_truth"]


def match_truth(truth, measured, bands, *, radius=0.5 * u.arcsec):
    """
    Match a measured catalogue to the truth, one to one.

    Parameters
    ----------
    truth : `~astropy.table.QTable`
        With ``id``, ``sky`` and a flux column for each band.
    measured : `~astropy.table.QTable`
        With ``id``, ``sky``, ``flags`` and, for each band, flux and error columns.
    bands : iterable of str
        Filter names.
    radius : `~astropy.units.Quantity`, optional
        Largest separation.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each row of ``truth``, in its order: ``id``, ``sky``, ``measured_id``
        (-1 where nothing matched), ``separation``, ``matched`` and, for each band,
        ``<band>_true``, ``<band>`` and ``<band>_err`` (NaN where nothing matched), and
        the flag columns of ``measured`` (``<band>_flags`` or ``flags``).

    Raises
    ------
    ValueError
        If a column is missing or ``bands`` is one name.
    `~astropy.units.UnitsError`
        If a flux column or ``radius`` has a wrong unit or none.
    """
    if isinstance(bands, str):
        raise argument_error("bands", "a list of filter names", repr(bands))
    bands = list(bands)
    units = dict.fromkeys([c for band in bands for c in (band, error_column(band))], FNU)
    require_columns(truth, ["id", "sky", *bands], "truth", units=dict.fromkeys(bands, FNU))
    require_columns(measured, ["id", "sky"], "measured", units=units)
    index, separation = match_sky(measured["sky"], truth["sky"], radius=radius)
    found = index >= 0
    table = QTable({"id": truth["id"], "sky": truth["sky"]})
    table["measured_id"] = (
        np.where(found, np.asarray(measured["id"])[index], -1) if len(measured) else -1
    )
    table["separation"] = separation
    table["matched"] = found
    for band in bands:
        table[f"{band}_true"] = u.Quantity(truth[band]).to(u.uJy)
        for name in (band, error_column(band)):
            values = np.full(len(truth), np.nan)
            if name in measured.colnames:
                values[found] = u.Quantity(measured[name]).to_value(u.uJy)[index[found]]
            table[name] = values * u.uJy
    for name in [c for c in measured.colnames if c == "flags" or c.endswith("_flags")]:
        values = np.zeros(len(truth), int)
        values[found] = np.asarray(measured[name])[index[found]]
        table[name] = values
    return table
