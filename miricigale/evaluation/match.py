"""Matches of measured and true sources, and associations of two catalogs."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.utils.arrays import nans
from miricigale.utils.ids import id_column, ids_and_missing
from miricigale.utils.options import check_that, check_type
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import at_epoch
from miricigale.utils.tables import (
    Flags,
    described_table,
    error_column,
    match_sky,
    read_ids,
    require_columns,
)
from miricigale.utils.units import ANGLE, FNU, positive, to_array


class AssociationFlags(Flags):
    """
    Why rows of two catalogs are no plain match.

    Examples
    --------
    >>> from miricigale.evaluation import AssociationFlags
    >>> AssociationFlags(5)
    <AssociationFlags.SEVERAL_SECOND|NOT_MUTUAL: 5>
    >>> AssociationFlags.NONE_NEAR.value
    8
    """

    SEVERAL_SECOND = (
        1,
        "More than one row of the second catalog is within the radius of the row of the first.",
    )
    SEVERAL_FIRST = (
        2,
        "More than one row of the first catalog is within the radius of the row of the second.",
    )
    NOT_MUTUAL = 4, "The nearest row of the other catalog is nearer to another one."
    NONE_NEAR = 8, "No row of the other catalog is within the radius."
    NO_POSITION = 16, "The position is not finite."


#: What the flags come to.
_STATUS = ("matched", "ambiguous", "unmatched")


@takes_other_keywords
def associate(first, second, *, radius):
    """
    Sort the rows of two catalogs into matched, ambiguous and unmatched ones.

    Parameters
    ----------
    first, second : `~astropy.coordinates.SkyCoord` or `~astropy.table.QTable`
        Positions, or tables with ``sky`` and, if there are any, ids (`miricigale.utils.ids`).
    radius : `~astropy.units.Quantity`
        Largest separation.

    Returns
    -------
    table : `~astropy.table.QTable`
        Every row of either catalog once: those of the first in their order (with their
        partner, if they have one), then those of the second without a partner. ``first`` and
        ``second`` are row numbers, -1 for none; ``first_id`` and ``second_id`` the ids of tables
        that have them (masked for none); ``separation`` (arcsec, NaN without partner); ``n_first``
        and ``n_second``, how many rows of the first are within the radius of the row of the second
        and the other way round (-1 without such a row); ``status`` and ``reasons``
        (`AssociationFlags`). ``meta["counts"]`` has the number of rows of each status,
        ``meta["reasons"]`` of each reason.

    Raises
    ------
    ValueError
        If the radius is not positive, or a table lacks ``sky``.

    Notes
    -----
    Partners are two rows that are each other's nearest within the radius. They are ``matched`` if neither has
    another candidate, otherwise ``ambiguous``. A row without a partner is ``ambiguous`` if it has
    candidates, and ``unmatched`` if it has none.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from miricigale.evaluation import associate
    >>> first = SkyCoord([0.0, 9.0] * u.arcsec, [0, 0] * u.arcsec)
    >>> second = SkyCoord([0.1, 20.0] * u.arcsec, [0, 0] * u.arcsec)
    >>> table = associate(first, second, radius=0.5 * u.arcsec)
    >>> print(table["first", "second", "status"])
    first second   status
    ----- ------ ---------
        0      0   matched
        1     -1 unmatched
       -1      1 unmatched
    """
    limit = positive(radius, ANGLE, "radius")
    sky = _at_one_time(_positions(first, "first"), _positions(second, "second"))
    candidates = _Candidates(*sky, limit)
    pair = candidates.partner[0]
    unmatched = np.flatnonzero(candidates.partner[1] < 0)
    rows = (
        np.append(np.arange(len(pair)), np.full(len(unmatched), -1)),
        np.append(pair, unmatched),
    )
    reasons = np.zeros(len(rows[0]), int)
    columns = {}
    ids = {}
    counts = {}
    for k, (name, partner) in enumerate((("first", "second"), ("second", "first"))):
        catalog = (first, second)[k]
        has_row = rows[k] >= 0
        columns[name] = (rows[k], f"Row of the {name} catalog, -1 for none")
        id_name = id_column(getattr(catalog, "colnames", ()), name)
        if id_name is not None:
            values, missing = ids_and_missing(catalog[id_name], name)
            values = np.append(values, np.zeros(1, values.dtype))[rows[k]]
            missing = np.append(missing, True)[rows[k]]
            ids[f"{name}_id"] = (np.ma.MaskedArray(values, mask=missing | ~has_row), None)
        near_by = np.full(len(has_row), -1)
        near_by[has_row] = candidates.count[k][rows[k][has_row]]
        text = f"Rows of the {partner} catalog within the radius of the row of the {name}"
        counts[f"n_{partner}"] = (near_by, text)
        reasons[has_row] |= candidates.reasons(k)[rows[k][has_row]]
    separation = np.append(candidates.separation, nans(len(unmatched)))
    columns |= ids | {"separation": (separation * ANGLE, "Distance between the partners")} | counts
    # of rows with a partner neither of the two reasons is set
    status = np.where(reasons == 0, 0, np.where(reasons & (_NONE | _LOST), 2, 1))
    columns["status"] = (np.array(_STATUS)[status], "matched, ambiguous or unmatched")
    columns["reasons"] = (reasons, AssociationFlags.describe())
    counts = {name: int(np.count_nonzero(status == k)) for k, name in enumerate(_STATUS)}
    why = {flag.name.lower(): int(np.count_nonzero(reasons & flag)) for flag in AssociationFlags}
    return described_table(columns, {"radius": limit, "counts": counts, "reasons": why})


_NONE = int(AssociationFlags.NONE_NEAR)
_LOST = int(AssociationFlags.NO_POSITION)


class _Candidates:
    """Which rows of two lists of positions are within a radius, and who is whose nearest."""

    def __init__(self, first, second, limit):
        self.sky = first, second
        self.finite = [np.isfinite(sky.ra.deg) & np.isfinite(sky.dec.deg) for sky in self.sky]
        rows = [np.flatnonzero(good) for good in self.finite]
        i = np.empty(0, int)
        j = np.empty(0, int)
        distance = np.empty(0)
        if len(rows[0]) and len(rows[1]):
            a, b, angle, _ = second[rows[1]].search_around_sky(first[rows[0]], limit * ANGLE)
            i = rows[0][a]
            j = rows[1][b]
            distance = angle.to_value(ANGLE)
        size = len(first), len(second)
        self.count = [np.bincount(k, minlength=n) for k, n in zip((i, j), size, strict=True)]
        # of equal distances the first row is taken
        order = np.lexsort((j, i, distance))[::-1]
        nearest = [np.full(n, -1) for n in size]
        nearest[0][i[order]], nearest[1][j[order]] = j[order], i[order]
        self.partner = []
        for forward, backward in (nearest, nearest[::-1]):
            mutual = forward >= 0
            mutual[mutual] = backward[forward[mutual]] == np.flatnonzero(mutual)
            self.partner.append(np.where(mutual, forward, -1))
        self.separation = nans(size[0])
        chosen = self.partner[0][i] == j
        self.separation[i[chosen]] = distance[chosen]

    def reasons(self, k):
        """Return the `AssociationFlags` of the rows of list ``k``."""
        flags = np.zeros(len(self.sky[k]), int)
        if k == 0:
            ambiguous = AssociationFlags.SEVERAL_SECOND
        else:
            ambiguous = AssociationFlags.SEVERAL_FIRST
        flags[self.count[k] > 1] |= int(ambiguous)
        flags[(self.count[k] > 0) & (self.partner[k] < 0)] |= AssociationFlags.NOT_MUTUAL
        flags[self.count[k] == 0] |= _NONE
        flags[~self.finite[k]] = _LOST
        return flags


def _positions(catalog, argument):
    sky = catalog
    if not isinstance(catalog, SkyCoord):
        require_columns(catalog, ["sky"], argument)
        sky = catalog["sky"]
        check_type(sky, argument, SkyCoord, "a table whose 'sky' is a SkyCoord")
    return sky.reshape(-1)


def _at_one_time(first, second):
    """Two catalogs at the time of the second, if they have proper motions; of the first, if only it has one."""
    if first.obstime is None or second.obstime is not None:
        epoch = second.obstime
    else:
        epoch = first.obstime
    return at_epoch(first, epoch, "first"), at_epoch(second, epoch, "second")


@takes_other_keywords
def match_truth(truth, measured, bands, *, radius=0.5 * u.arcsec):
    """
    Match a measured catalog to the truth, one to one.

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
        (-1 where nothing matched), ``separation``, ``matched``, ``association``
        (`AssociationFlags` of the row of the truth and of the one it was matched to) and, for each band,
        ``<band>_true``, ``<band>`` and ``<band>_err`` (NaN where nothing matched), and
        the flag columns of ``measured`` (``<band>_flags`` or ``flags``).

    Raises
    ------
    ValueError
        If a column is missing or ``bands`` is one name.
    `~astropy.units.UnitsError`
        If a flux column or ``radius`` has a wrong unit or none.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import match_truth
    >>> truth = QTable({"id": [1, 2], "sky": SkyCoord([0, 9] * u.arcsec, [0, 0] * u.arcsec)})
    >>> truth["miri.f770w"] = [5, 2] * u.uJy
    >>> measured = QTable({"id": [7], "sky": SkyCoord([0.1] * u.arcsec, [0] * u.arcsec)})
    >>> measured["miri.f770w"], measured["miri.f770w_err"] = [5.2] * u.uJy, [0.1] * u.uJy
    >>> table = match_truth(truth, measured, ["miri.f770w"])
    >>> print(table["id", "measured_id", "miri.f770w_true", "miri.f770w"])
     id measured_id miri.f770w_true miri.f770w
                          uJy          uJy
    --- ----------- --------------- ----------
      1           7             5.0        5.2
      2          -1             2.0        nan
    """
    check_that(not isinstance(bands, str), "bands", "a list of filter names", repr(bands))
    bands = list(bands)
    units = dict.fromkeys([c for band in bands for c in (band, error_column(band))], FNU)
    require_columns(truth, ["sky"] + bands, "truth", units=dict.fromkeys(bands, FNU))
    require_columns(measured, ["sky"], "measured", units=units)
    true_ids = read_ids(truth, "truth")
    index, separation = match_sky(measured["sky"], truth["sky"], radius=radius)
    matched = index >= 0
    table = QTable({"id": true_ids, "sky": truth["sky"]})
    ids = read_ids(measured, "measured")
    if len(measured):
        table["measured_id"] = np.where(matched, ids[index], -1)
    else:
        table["measured_id"] = -1
    table["separation"] = separation
    table["matched"] = matched
    limit = float(to_array(radius, ANGLE, "radius"))
    candidates = _Candidates(truth["sky"].icrs, measured["sky"].icrs, limit)
    reasons = candidates.reasons(0)
    reasons[matched] |= candidates.reasons(1)[index[matched]]
    table["association"] = reasons
    table["association"].info.description = AssociationFlags.describe()
    for band in bands:
        table[f"{band}_true"] = to_array(truth[band], FNU, band) * FNU
        for name in (band, error_column(band)):
            values = nans(len(truth))
            if name in measured.colnames:
                values[matched] = to_array(measured[name], FNU, name)[index[matched]]
            table[name] = values * u.uJy
    for name in [c for c in measured.colnames if c == "flags" or c.endswith("_flags")]:
        values = np.zeros(len(truth), int)
        values[matched] = np.asarray(measured[name])[index[matched]]
        table[name] = values
    return table
