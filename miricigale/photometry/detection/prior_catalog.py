"""Segmentation maps and catalogs that others made, as the prior of forced photometry."""

import logging
import os

import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table

from miricigale.instrument import epoch_of
from miricigale.photometry.images.arrays import nearest_values, sky_to_pixels
from miricigale.photometry.images.fits_images import open_map
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import CatalogWarning, data_error, warn
from miricigale.utils.files import is_path, open_fits, split_extension
from miricigale.utils.ids import counted_ids, id_column
from miricigale.utils.options import check_data, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.positions import as_positions
from miricigale.utils.table_formats import table_suffix
from miricigale.utils.tables import as_table, unique_ids
from miricigale.utils.text_reading import first_bytes

_log = logging.getLogger(__name__)

#: Extensions of segmentation maps.
SEGMENTS = ("SEGMENTATION", "SEGMAP", "SEG", "SCI")


@takes_other_keywords
def read_prior(highres, *, segmentation=None, catalog=None):
    """
    Read the sources of a prior.

    Parameters
    ----------
    highres : `~astropy.nddata.CCDData`
        The image that the segments belong to.
    segmentation : path-like or int `~numpy.ndarray`, optional
        Segmentation map: whole numbers, 0 for the sky, any ids; ``file.fits[EXTENSION]`` names
        an extension.
    catalog : path-like, table or `~astropy.coordinates.SkyCoord`, optional
        A table in any form (`~miricigale.utils.tables.as_table`) with positions
        (`~miricigale.utils.positions.as_positions`) and ``id``. Without it every segment is a source, whose
        id is that of the segment.

    Returns
    -------
    segments : int32 `~numpy.ndarray`, shape (ny, nx)
        Labels 1 to n; None without a segmentation.
    sources : `~astropy.table.QTable`
        ``id``, ``sky`` and, with a segmentation, ``label``: the segment of the same id if
        most of the catalog's ids are those of the segments at their positions, and the segment
        at the position otherwise (0 for none).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If a file is missing or damaged, the segmentation is not on the image's pixels, or
        columns are missing.
    ValueError
        If ids are not unique, or neither file is given.

    Warns
    -----
    `~miricigale.utils.exceptions.CatalogWarning`
        If segments belong to no source of the catalog: their light stays in the image; if most
        sources have no segment, or some are on another one than that of their id.

    Examples
    --------
    >>> from miricigale.photometry import read_prior
    >>> segments, sources = read_prior(image, segmentation="seg.fits.gz")  # doctest: +SKIP
    """
    if segmentation is None and catalog is None:
        msg = "'segmentation' or 'catalog' must be given, got neither"
        raise ValueError(msg)
    segments = ids = None
    if segmentation is not None:
        if isinstance(segmentation, np.ndarray):
            data = segmentation
            segmentation = "the segmentation"
            wanted = "whole numbers, one for each source (scipy.ndimage.label makes them)"
            check_that(data.dtype != bool, "segmentation", wanted, "a mask")
        else:
            image = highres.data.shape, highres.wcs, highres.meta.get("source", "the image")
            wanted = "a segmentation map"
            with open_map(segmentation, wanted, "the segmentation", SEGMENTS, image) as hdu:
                data = np.array(hdu.data)
        # labels count from 1; ids are those of the map
        segments, ids = _numbered(data, segmentation)
    if catalog is None:
        return segments, _from_segments(highres, segments, ids)
    sources = read_catalog(catalog, epoch=epoch_of(highres))
    if is_path(catalog):
        # other columns of a file may be called as ours without being meant
        kept = [name for name in ("id", "sky", "components") if name in sources.colnames]
        sources = sources[kept]
    else:
        catalog = "the catalog"
    if segments is not None:
        sources["label"] = _labels(sources, segments, ids, highres.wcs, catalog, segmentation)
    return segments, sources


def detected_prior(highres, catalog):
    """
    Detect segments on an image, and return them with its sources: those of a catalog, or the detected ones.

    Parameters
    ----------
    highres : `~astropy.nddata.CCDData`
        The image.
    catalog
        As for `read_prior`.

    Returns
    -------
    segments : int32 `~numpy.ndarray`, shape (ny, nx)
        Labels.
    sources : `~astropy.table.QTable`
        As of `read_prior`, or of `~miricigale.photometry.detect_sources`.
    """
    from miricigale.photometry.detection.detection import detect_sources

    segments, detected = detect_sources(highres)
    _log.info("%d sources detected on the high-resolution image", len(detected))
    if catalog is None:
        return segments.data, detected
    return sources_of(highres, segments.data, catalog)


def sources_of(highres, segmentation, catalog):
    """Read a prior as `read_prior`, from a map (an array) that may be without segments: all are points then."""
    if np.any(np.nan_to_num(segmentation)):
        return read_prior(highres, segmentation=segmentation, catalog=catalog)
    from astropy.coordinates import SkyCoord

    if catalog is None:
        catalog = {"id": np.empty(0, int), "sky": SkyCoord([], [], unit="deg")}
    sources = read_catalog(catalog, epoch=epoch_of(highres))
    sources["label"] = np.zeros(len(sources), int)
    return np.zeros(segmentation.shape, np.int32), sources["id", "sky", "label"]


def _numbered(data, path):
    """Return labels 1 to n in the order of the ids, and the ids."""
    if data.dtype.kind == "f":
        rounded = np.where(np.isfinite(data), np.rint(data), 0)
        if not np.array_equal(rounded, np.where(np.isfinite(data), data, 0)):
            raise data_error(path, "is no map of segments: it has values that are no whole numbers")
        # single precision holds no larger whole numbers
        if data.dtype.itemsize <= 4 and rounded.max(initial=0) > 2**24:
            raise data_error(path, "has ids above 2^24 in single precision: not distinct")
        data = rounded
    data = data.astype(np.int64)
    if data.min(initial=0) < 0:
        raise data_error(path, f"has negative ids, such as {data.min()}; 0 is the sky")
    values, labels = np.unique(data, return_inverse=True)
    labels = labels.reshape(data.shape).astype(np.int32)
    # the sky is 0 even where every pixel belongs to a segment
    if values[0] != 0:
        return labels + np.int32(1), values
    check_data(len(values) != 1, path, "has no segment: all of its pixels are 0")
    return labels, values[1:]


def _from_segments(highres, segments, ids):
    """Make a source of each segment, at the centroid of its bright part."""
    from astropy.table import QTable
    from scipy.ndimage import center_of_mass

    from miricigale.photometry.detection.detection import bright_centroids

    index = np.arange(1, len(ids) + 1)
    # segments without a bright part have the middle of their pixels
    middle = np.array(center_of_mass(np.ones(segments.shape), segments, index)).T
    flux = np.where(np.isfinite(highres.data), highres.data, 0.0)
    if highres.mask is not None:
        flux = np.where(highres.mask, 0.0, flux)
    x, y = bright_centroids(np.asarray(flux, float), segments, (middle[1], middle[0]))
    sky = highres.wcs.pixel_to_world(x, y).icrs
    return QTable({"id": ids, "sky": sky, "label": index})


def read_catalog(catalog, wcs=None, epoch=None):
    """
    Read ids and positions of a catalog in any of the usual forms; see ``catalog`` of `read_prior`.

    Proper motions, of a `~astropy.coordinates.SkyCoord` or in columns, bring positions to an epoch
    (`~miricigale.utils.positions.at_epoch`).
    With a WCS positions may be pixels ``x`` and ``y``. A position that is missing is NaN; other columns are kept.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`, ValueError
        If a file is missing or damaged, or there are no positions; if ids are not unique.
    """
    is_file = is_path(catalog)
    name = "catalog"
    if is_file:
        name = f"catalog {catalog}"
    if isinstance(catalog, SkyCoord):
        catalog = QTable({"sky": catalog.reshape(-1)})
    table = quantity_table(as_table(catalog, "catalog"), copy=False)
    table["sky"] = as_positions(table, name, wcs, missing=True, epoch=epoch, motions=True)
    if "id" not in table.colnames:
        # labels are the ids of files, and in tables those of segments
        theirs = id_column(table.colnames, name, labels=is_file)
        if theirs is None:
            _log.info("%s has no ids; its rows are counted from 1", name)
            table["id"] = counted_ids(table, name)
        else:
            table["id"] = table[theirs]
    table["id"] = unique_ids(table["id"], name)
    return table


def is_catalog(value):
    """
    Whether something is a catalog and no image: positions, a table, or a file that holds a table.

    A FITS file is one where it holds no image; other files are, except ASDF, which is read as an image.
    """
    if isinstance(value, (SkyCoord, Table)) or hasattr(value, "iloc"):
        return True
    if not is_path(value):
        return False
    path = split_extension(value)[0]
    if not os.path.isfile(path):
        return False
    if not first_bytes(path).startswith(b"SIMPLE"):
        return table_suffix(path) != ".asdf"
    with open_fits(path, wanted="an image or a catalog") as hdus:
        return not any(hdu.is_image and hdu.shape for hdu in hdus)


def check_labels(labels, found_labels, name):
    """
    Refuse labels that are those of another segmentation map, or warn of them.

    ``labels`` are those of the sources, ``found_labels`` those at their positions (0 for none),
    ``name`` is for messages. Refused if more than half of the sources are on another segment than
    theirs, warned of from three and a tenth on.
    """
    on_both = (labels > 0) & (found_labels > 0)
    n = int(np.count_nonzero(on_both))
    wrong = int(np.count_nonzero(on_both & (labels != found_labels)))
    text = f"{wrong} of {n} sources that stand on another segment than theirs"
    wanted = "labels of the segmentation map"
    check_that(not wrong > 0.5 * n, name, wanted, f"{text}: is it the map of another detection?")
    if wrong >= max(3, 0.1 * n):
        msg = f"the labels of {name} are those of {text}"
        warn(msg, CatalogWarning)


def _labels(sources, segments, ids, wcs, catalog, segmentation):
    """Return the label of each source's segment: by id if ids are those of segments, by position otherwise."""
    sky = sources["sky"]
    is_placed = np.isfinite(sky.ra.deg) & np.isfinite(sky.dec.deg)
    xy = nans((len(sources), 2))
    if is_placed.any():
        xy[is_placed] = sky_to_pixels(sky[is_placed], wcs)
    labels_at, inside = nearest_values(segments, xy)
    # the segment of the same id, 0 if there is none
    by_number = np.zeros(len(sources), np.int64)
    if np.asarray(sources["id"]).dtype.kind in "iu":
        place = np.clip(np.searchsorted(ids, sources["id"]), 0, len(ids) - 1)
        by_number = np.where(ids[place] == sources["id"], place + 1, 0)
    has_label = labels_at > 0
    # ids are those of segments if most are right at their positions
    by_id = has_label.any() and np.mean(by_number[has_label] == labels_at[has_label]) > 0.5
    if by_id:
        label = by_number
        _log.info("%s: segments of %s by id", catalog, segmentation)
    else:
        label = labels_at.astype(np.int64)
        _log.info("%s: segments of %s by position", catalog, segmentation)
    check_labels(label, labels_at, f"{catalog} by id")
    # sources on the map without a segment
    n_without = int(np.count_nonzero(inside & (label == 0)))
    n_inside = int(np.count_nonzero(inside))
    msg = f"{n_without} of the {n_inside} sources of {catalog} on the map have no segment"
    msg += f" of {segmentation} and are taken as points"
    if n_without > 0.5 * n_inside:
        msg += ": is it the map of another detection?"
        warn(msg, CatalogWarning)
    elif n_without:
        _log.info(msg)
    # what the edge cuts may be a source beyond it
    edge = np.concatenate([segments[[0, -1]].ravel(), segments[:, [0, -1]].ravel()])
    orphans = np.setdiff1d(np.arange(1, len(ids) + 1), np.append(label, edge))
    if orphans.size:
        examples = ", ".join(map(str, ids[orphans[:5] - 1]))
        if orphans.size > 5:
            examples += ", ..."
        msg = (
            f"{orphans.size} segments of {segmentation} belong to no source of {catalog} and are not "
            f"fitted (ids {examples})"
        )
        warn(msg, CatalogWarning)
    return label
