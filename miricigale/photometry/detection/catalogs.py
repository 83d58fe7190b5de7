"""The columns of a catalog that photometry uses."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import Table

from miricigale.profiles.sersic import describe_faults, sersic_faults
from miricigale.utils.exceptions import CatalogWarning, argument_error, warn
from miricigale.utils.ids import counted_ids, id_column
from miricigale.utils.missing_values import floats, mask_of
from miricigale.utils.options import check_that, check_type
from miricigale.utils.positions import at_epoch
from miricigale.utils.tables import require_columns, unique_ids
from miricigale.utils.units import to_array

#: Columns of a catalog that need not be there, and that templates keep.
OPTIONAL = ("flux", "components")


def catalog_sources(catalog, epoch=None):
    """
    Return ``id``, ``sky`` (ICRS), ``flux`` and ``components`` of a catalog, by name; None without such a column.

    Proper motions bring positions to an epoch (`~miricigale.utils.positions.at_epoch`).

    Raises
    ------
    TypeError, ValueError
        If it is no table, has no ``sky``, an id twice, or a number of components other than 1 and 2.
    """
    check_type(catalog, "catalog", Table, "a table with the column 'sky'")
    require_columns(catalog, ["sky"], "catalog")
    sky = catalog["sky"]
    check_type(sky, "catalog", SkyCoord, "a table whose 'sky' is a SkyCoord")
    name = id_column(catalog.colnames, "catalog", labels=False)
    if name is None:
        ids = counted_ids(catalog, "catalog")
    else:
        ids = unique_ids(catalog[name], "catalog")
    # optional columns
    flux = components = None
    if "flux" in catalog.colnames:
        flux = floats(catalog["flux"])
    if "components" in catalog.colnames:
        components = catalog["components"]
        wanted = "a column 'components' without masked values"
        check_that(not np.any(mask_of(components)), "catalog", wanted, "some")
        components = np.asarray(components)
        if components.dtype.kind not in "iu" or not np.isin(components, (1, 2)).all():
            numbers = np.unique(components)[:5].tolist()
            raise argument_error("catalog", "a column 'components' of 1 and 2", f"{numbers}")
    # positions at the epoch of the image
    sky = at_epoch(sky, epoch, "catalog")
    sky = SkyCoord(sky.ra.deg, sky.dec.deg, unit="deg")
    return {"id": ids, "sky": sky, "flux": flux, "components": components}


def sersic_rows(catalog):
    """
    Return half-light radius (arcsec), index, axis ratio and angle (rad), (n, 4); NaN for points.

    Profiles with a number that is missing or of no profile are points too; a `CatalogWarning` says how many.
    """
    units = {"half_light_radius": u.arcsec, "position_angle": u.deg}
    names = ["half_light_radius", "sersic_index", "axis_ratio", "position_angle"]
    require_columns(catalog, names, "catalog", units=units)
    radius = to_array(catalog["half_light_radius"], u.arcsec, "half_light_radius")
    angle = to_array(catalog["position_angle"], u.rad, "position_angle")
    index = floats(catalog["sersic_index"])
    ratio = floats(catalog["axis_ratio"])
    rows = np.stack([radius, index, ratio, angle], axis=1)
    sersic = np.ones(len(catalog), dtype=bool)
    if "profile" in catalog.colnames:
        sersic = np.asarray(catalog["profile"]) == "sersic"
    faults = sersic_faults(radius, index, ratio, angle)
    text = describe_faults(faults, sersic)
    if text:
        warn(f"catalog: {text}", CatalogWarning)
    points = ~sersic | np.any(list(faults.values()), axis=0)
    rows[points] = np.nan
    # the angle of a round profile is of no use
    rows[~points & ~np.isfinite(angle), 3] = 0.0
    return rows


def joined_sky(skies):
    """Join positions (ICRS) one after the other."""
    ra = np.concatenate([sky.icrs.ra.deg for sky in skies])
    dec = np.concatenate([sky.icrs.dec.deg for sky in skies])
    return SkyCoord(ra, dec, unit="deg")
