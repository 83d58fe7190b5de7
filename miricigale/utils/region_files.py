"""Regions of DS9: files of positions, read and written by the package regions."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.utils.exceptions import data_error
from miricigale.utils.files import replacing
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_data
from miricigale.utils.positions import sky_as_angles
from miricigale.utils.units import ANGLE, positive

#: Colors of circles by what they are.
COLORS = {"good": "green", "flagged": "orange", "missing": "red"}


def region_table(source):
    """
    Positions of regions.

    Parameters
    ----------
    source : path-like or `~regions.Regions`
        Regions of DS9 on the sky, of a file or as they are: points, circles, ellipses, boxes and annuli; regions
        that are taken off others (with a minus) are no sources.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id`` (the texts if all regions have different ones, otherwise they are counted from 1), ``ra`` and
        ``dec`` of the centers, and ``radius`` of circles (NaN otherwise).

    Raises
    ------
    ImportError
        If the package regions is not installed.
    `~miricigale.utils.exceptions.DataError`
        If a region has no center on the sky, or there is none.
    """
    regions = require("regions", extra="regions")
    label = source
    if isinstance(source, regions.Regions):
        label = "the list of regions"
    else:
        source = regions.Regions.read(source, format="ds9")
    centers = []
    texts = []
    radii = []
    for k, region in enumerate(source, 1):
        if not region.meta.get("include", True):
            continue
        center = getattr(region, "center", None)
        if not isinstance(center, SkyCoord):
            kind = type(region).__name__
            problem = f"has a region (number {k}, {kind}) without a center on the sky"
            raise data_error(label, problem)
        centers.append(center.icrs)
        texts.append(str(region.meta.get("text", "")))
        radii.append(getattr(region, "radius", np.nan * u.arcsec).to_value(ANGLE))
    check_data(centers, label, "has no regions")
    ids = np.array(texts)
    if "" in texts or len(set(texts)) < len(texts):
        ids = np.arange(1, len(texts) + 1)
    elif all(text.isdecimal() and str(int(text)) == text for text in texts):
        ids = ids.astype(int)
    sky = SkyCoord(centers)
    return QTable({"id": ids, "ra": sky.ra, "dec": sky.dec, "radius": radii * ANGLE})


def is_regions(data):
    """Whether something is a list of regions of the package regions, which is not loaded for it."""
    return type(data).__name__ == "Regions" and type(data).__module__.startswith("regions.")


def circles(table, radius):
    """
    Make circles about positions.

    Parameters
    ----------
    table : `~astropy.table.Table`
        ``id``, ``sky``, and ``kind``, one of `COLORS`; rows whose position is not finite have no circle.
    radius : `~astropy.units.Quantity`
        Of the circles.

    Returns
    -------
    regions : `~regions.Regions`

    Raises
    ------
    ImportError
        If the package regions is not installed.
    """
    regions = require("regions", extra="regions")
    radius = positive(radius, ANGLE, "radius") * ANGLE
    angles = sky_as_angles(table)
    out = []
    for row in angles:
        if np.isfinite(row["ra"].value) and np.isfinite(row["dec"].value):
            center = SkyCoord(row["ra"], row["dec"])
            visual = {"color": COLORS[row["kind"]]}
            meta = {"text": str(row["id"])}
            out.append(regions.CircleSkyRegion(center, radius, meta=meta, visual=visual))
    return regions.Regions(out)


def write_circles(table, path, *, radius, overwrite=False):
    """Write `circles` to a file, which ``overwrite`` replaces."""
    regions = circles(table, radius)
    with replacing(path, overwrite=overwrite) as partial:
        regions.write(partial, format="ds9", overwrite=True)
