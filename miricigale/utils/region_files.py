"""Regions of DS9: files of positions, read and written by the package regions."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.utils.exceptions import data_error
from miricigale.utils.files import replacing
from miricigale.utils.optional_packages import require
from miricigale.utils.positions import sky_as_angles
from miricigale.utils.units import ANGLE, positive

#: Colors of circles by what they are.
COLORS = {"good": "green", "flagged": "orange", "missing": "red"}


def region_table(path):
    """
    Positions of a file of regions.

    Parameters
    ----------
    path : path-like
        Regions of DS9 on the sky: points, circles, ellipses, boxes and annuli; regions that are taken off others
        (with a minus) are no sources.

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
    centers, texts, radii = [], [], []
    for k, one in enumerate(regions.Regions.read(path, format="ds9"), 1):
        if not one.meta.get("include", True):
            continue
        center = getattr(one, "center", None)
        if not isinstance(center, SkyCoord):
            kind = type(one).__name__
            raise data_error(path, f"has a region (number {k}, {kind}) without a center on the sky")
        centers.append(center.icrs)
        texts.append(str(one.meta.get("text", "")))
        radii.append(getattr(one, "radius", np.nan * u.arcsec).to_value(ANGLE))
    if not centers:
        raise data_error(path, "has no regions")
    ids = np.array(texts)
    if "" in texts or len(set(texts)) < len(texts):
        ids = np.arange(1, len(texts) + 1)
    elif all(text.isdecimal() and str(int(text)) == text for text in texts):
        ids = ids.astype(int)
    sky = SkyCoord(centers)
    return QTable({"id": ids, "ra": sky.ra, "dec": sky.dec, "radius": radii * ANGLE})


def write_circles(table, path, *, radius, overwrite=False):
    """
    Write circles about positions.

    Parameters
    ----------
    table : `~astropy.table.Table`
        ``id``, ``sky``, and ``kind``, one of `COLORS`; rows whose position is not finite have no circle.
    path : path-like
        The file.
    radius : `~astropy.units.Quantity`
        Of the circles.
    overwrite : bool, optional
        Whether an existing file is replaced.

    Raises
    ------
    ImportError
        If the package regions is not installed.
    """
    regions = require("regions", extra="regions")
    radius = positive(radius, ANGLE, "radius") * ANGLE
    angles = sky_as_angles(table)
    circles = []
    for row in angles:
        if np.isfinite(row["ra"].value) and np.isfinite(row["dec"].value):
            center = SkyCoord(row["ra"], row["dec"])
            visual = {"color": COLORS[row["kind"]]}
            meta = {"text": str(row["id"])}
            circles.append(regions.CircleSkyRegion(center, radius, meta=meta, visual=visual))
    with replacing(path, overwrite=overwrite) as partial:
        regions.Regions(circles).write(partial, format="ds9", overwrite=True)
