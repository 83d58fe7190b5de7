"""Contents of the headers of images that observers bring."""

import contextlib
import json

import numpy as np

from miricigale.instrument.image_planes import PLANES
from miricigale.photometry.images.fits_images import filter_name, find_image, open_image
from miricigale.utils.arrays import finite_values
from miricigale.utils.values import value_class

#: Position angles that differ by less are one (deg).
SAME_ANGLE = 1.0


@value_class
class MosaicHeader:
    """Contents of the header of an image."""

    index: int  # Extension of the image.
    shape: tuple  # Rows and columns.
    wcs: object  # Celestial coordinates.
    filter: str | None  # As ``instrument.filter`` in lower case, or as it was given; None without.
    pa_aper: object  # Position angle of the detector's +y axis; None without.
    unit: str  # Unit of the pixels as the header or the caller has it; may be empty.
    #: Whether it is a single exposure of JWST (``_cal``, ``_rate``) rather than a mosaic.
    exposure: bool
    keywords: dict  # Those of the photometric calibration.
    meta: dict  # What our own files carry, with ``filter`` and ``pa_aper`` (deg).


def stated_filter(path):
    """Return the filter that the header of an image names, None if it names none; coordinates are not read."""
    with open_image(path, "an image") as (hdus, extension):
        header = hdus[find_image(hdus, extension, path, ("SCI",), no_images=PLANES)].header
        first = hdus[0].header
        name = filter_name(lambda key: header.get(key, first.get(key)))
        return name or own_facts(header).get("filter")


def own_facts(header):
    """Return the facts that the package's own files carry, by name."""
    # of another program it may be no JSON
    with contextlib.suppress(json.JSONDecodeError):
        return json.loads(header.get("META", "{}"))
    return {}


def angles_of_exposures(hdus):
    """
    Position angles (deg) of the exposures of a mosaic of jwst, from its extension HDRTAB, in their shares.

    None without such a table, or if all are that of the header within a degree.
    """
    if "HDRTAB" not in hdus or "PA_APER" not in hdus["HDRTAB"].columns.names:
        return None
    angles = np.asarray(hdus["HDRTAB"].data["PA_APER"], dtype=float)
    angles = np.round(finite_values(angles), 1)
    if not angles.size:
        return None
    apart = (angles - angles[0] + 180.0) % 360.0 - 180.0
    if np.max(np.abs(apart)) <= SAME_ANGLE:
        return None
    values, counts = np.unique(angles, return_counts=True)
    return np.repeat(values, counts // np.gcd.reduce(counts)).tolist()


def unit_of(header):
    """Return the unit of the pixels as a header has it; it may be empty."""
    return str(header.get("BUNIT", "") or "").strip()
