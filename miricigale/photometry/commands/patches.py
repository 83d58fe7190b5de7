"""Patches of a fixed grid on the prior: their pixels, the sources that are theirs, and their tables as one."""

import dataclasses
import itertools
import warnings

import numpy as np
import scipy.sparse
from astropy.table import QTable, vstack
from astropy.wcs.utils import pixel_to_pixel
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.photometry.fit.bands import spread_rows
from miricigale.photometry.fit.result_table import new_ids
from miricigale.photometry.images.arrays import lengths, sky_pixels
from miricigale.photometry.images.flags import ForcedFlags
from miricigale.utils.exceptions import PhotometryWarning, warn

#: Pixels of the prior beyond its core in which a patch lists detections too: one that two patches see on
#: either side of the line between them would be in both tables or in none.
RIM = 5.0


@dataclasses.dataclass(frozen=True)
class PatchGrid:
    """
    Squares of the prior's pixels, as the patches of a tract of LSST.

    Lines between cores are at multiples of ``size``, whatever the images are. A patch is a core and its overlap; a
    position belongs to the patch whose core holds it (its lower edges included).

    Parameters
    ----------
    size, overlap : int
        Side of the cores, and width of the rim around them, in pixels of the prior.
    first, shape : tuple of int
        Number of the first core along y and x (0 begins with the prior's first pixel), and how many there are.

    Examples
    --------
    >>> from miricigale.photometry.commands.patches import PatchGrid
    >>> grid = PatchGrid(1000, 200, (0, 0), (2, 3))
    >>> grid.names[4], grid.box(4)
    ('y01x01', (slice(800, 2200, None), slice(800, 2200, None)))
    >>> grid.holder([[999.4, 999.5], [5000.0, -3.0]])
    array([3, 2])
    """

    size: int
    overlap: int
    first: tuple
    shape: tuple

    @classmethod
    def over(cls, prior, images, size, overlap):
        """Make the grid over a prior and images (each with ``wcs`` and ``shape``), as far as these reach."""
        low, high = np.array([[0, 0], prior.shape])
        for image in images:
            ny, nx = image.shape
            x, y = _raster((slice(0, ny), slice(0, nx)))
            xy = pixel_to_pixel(image.wcs, prior.wcs, x, y)
            # the patches at the edge have an overlap beyond it too
            low = np.fmin(low, np.nanmin(xy, axis=1)[::-1] + overlap)
            high = np.fmax(high, np.nanmax(xy, axis=1)[::-1] - overlap)
        first = np.floor(low / size).astype(int)
        last = np.ceil(high / size).astype(int)
        return cls(size, overlap, tuple(first.tolist()), tuple((last - first).tolist()))

    @property
    def names(self):
        """Names of the patches, row by row."""
        ny, nx = self.shape
        return [f"y{y:02d}x{x:02d}" for y, x in itertools.product(range(ny), range(nx))]

    def box(self, k):
        """Return rows and columns of a patch with its overlap, which may be beyond the prior."""
        # the core, and the overlap around it
        place = np.array(np.unravel_index(k, self.shape))
        low = (place + self.first) * self.size - self.overlap
        y0, x0 = low.tolist()
        side = self.size + 2 * self.overlap
        return slice(y0, y0 + side), slice(x0, x0 + side)

    def holder(self, xy):
        """Return the patch whose core holds each pixel (x, y), (n,); the nearest beyond them, -1 for NaN."""
        xy = np.asarray(xy, float).reshape(-1, 2)
        is_known = np.isfinite(xy).all(axis=1)
        place = (
            np.floor((np.where(is_known[:, None], xy, 0)[:, ::-1] + 0.5) / self.size) - self.first
        )
        place = np.clip(place, 0, np.array(self.shape) - 1).astype(int)
        return np.where(is_known, np.ravel_multi_index(tuple(place.T), self.shape), -1)

    def is_near(self, k, xy, margin):
        """Return whether pixels (x, y) are in the core of a patch or within a margin of it."""
        steps = itertools.product((-margin, 0.0, margin), repeat=2)
        return np.any([self.holder(np.asarray(xy) + step) == k for step in steps], axis=0)


def patch_parts(inputs, grid, k):
    """Return the parts (slices, or None) of the prior and of each image that a patch has with its overlap."""
    box = grid.box(k)
    prior = inputs.highres.header
    parts = [_within(box, prior.shape)]
    for image in inputs.images:
        parts.append(seen_part(box, prior.wcs, image.header.wcs, image.header.shape))
    return parts


def seen_part(box, wcs, other_wcs, shape):
    """Return the part (slices, or None) of an image with a WCS that shows the same sky as a box of another."""
    x, y = _raster(box)
    other_x, other_y = pixel_to_pixel(wcs, other_wcs, x, y)
    return _within((_span(other_y), _span(other_x)), shape)


def _span(positions):
    """Return the pixels along an axis that hold some positions."""
    first = int(np.floor(np.nanmin(positions)))
    last = int(np.ceil(np.nanmax(positions)))
    return slice(first, last + 1)


def _within(box, shape):
    """Cut a box of rows and columns to an image; None if nothing is left."""
    rows, columns = box
    y0 = max(rows.start, 0)
    x0 = max(columns.start, 0)
    y1 = min(rows.stop, shape[0])
    x1 = min(columns.stop, shape[1])
    if y0 >= y1 or x0 >= x1:
        return None
    return slice(y0, y1), slice(x0, x1)


def _raster(box):
    """Return pixels x, y all over a box of rows and columns."""
    rows, columns = box
    y_nodes = np.linspace(rows.start, rows.stop - 1, 33)
    x_nodes = np.linspace(columns.start, columns.stop - 1, 33)
    y, x = np.meshgrid(y_nodes, x_nodes, indexing="ij")
    return x.ravel(), y.ravel()


def own_rows(patch, grid, xy):
    """
    Choose the rows of the tables of patches that are kept, so that each source is there once.

    A row is that of its patch's core. Sources that two patches list within `RIM` of each other, and no nearer one,
    are the same: of these the one in its core stays, or else that of the first patch.

    Parameters
    ----------
    patch : int `~numpy.ndarray`, shape (n,)
        Number of the patch of each row.
    grid : `PatchGrid`
        The patches.
    xy : `~numpy.ndarray`, shape (n, 2)
        Pixels of the prior.

    Returns
    -------
    kept : bool `~numpy.ndarray`, shape (n,)
    """
    core = grid.holder(xy) == patch
    is_kept = core.copy()
    links = []
    used_keys = set()
    pairs = cKDTree(xy).query_pairs(RIM, output_type="ndarray")
    pairs = pairs[patch[pairs[:, 0]] != patch[pairs[:, 1]]]
    far = lengths(xy[pairs[:, 0]] - xy[pairs[:, 1]])
    for i, j in pairs[np.argsort(far, kind="stable")].tolist():
        # the nearest that each patch has for a source of the other
        keys = {(i, patch[j]), (j, patch[i])}
        if not keys & used_keys:
            links.append((i, j))
            used_keys |= keys
    if links:
        # rows that are linked, directly or not, are one source
        graph = scipy.sparse.coo_array(
            (np.ones(len(links)), np.transpose(links)), shape=(len(patch),) * 2
        )
        component = connected_components(graph, directed=False)[1]
        rows = np.unique(links)
        # the core first, then the first patch
        rows = rows[np.lexsort((patch[rows], ~core[rows], component[rows]))]
        is_kept[rows] = False
        is_kept[rows[np.unique(component[rows], return_index=True)[1]]] = True
    return is_kept


def join_patches(tables, grid, prior, catalog, ids):
    """
    Join the tables of patches.

    Parameters
    ----------
    tables : dict of int to `~astropy.table.QTable`
        By number of the patch: its rows in its core, and within `RIM` of that; ``new`` says which the prior lacks.
    grid : `PatchGrid`
        The patches.
    prior : `~miricigale.photometry.images.mosaic_headers.MosaicHeader`
        That of the prior.
    catalog : `~astropy.table.QTable` or None
        ``id`` and ``sky`` of all sources: then the table has these rows.
    ids : bool
        Whether ids are those of segments; otherwise sources are counted, patch by patch.

    Returns
    -------
    table : `~astropy.table.QTable`
        With ``patch``, the name of the patch, in place of ``new``; new sources are the last rows.
    """
    # all rows of all patches, of which each source keeps one
    patch = np.repeat(list(tables), list(map(len, tables.values())))
    table = vstack(list(tables.values()), metadata_conflicts="silent")
    xy = _pixels(table["sky"], prior)
    is_known = ~np.asarray(table["new"])
    new = np.asarray(table["new"])
    is_kept = np.zeros(len(table), bool)
    is_kept[new] = own_rows(patch[new], grid, xy[new])
    if catalog is None and not ids:
        is_kept[is_known] = own_rows(patch[is_known], grid, xy[is_known])
    table["patch"] = np.array(grid.names)[patch]
    table["patch"].info.description = "Patch whose core holds the source"
    # segments that reach beyond their patch
    flags = [table[name] for name in table.colnames if name.endswith("flags")]
    cut = np.any([values & ForcedFlags.CUT for values in flags], axis=0)
    if catalog is None:
        rows = np.flatnonzero(is_known if ids else is_known & is_kept)
        if ids:
            # of several rows of an id the one that is not cut, then that in its core
            core = grid.holder(xy[rows]) == patch[rows]
            rows = rows[np.lexsort((~core, cut[rows]))]
            rows = rows[np.unique(np.asarray(table["id"])[rows], return_index=True)[1]]
        source_rows = rows
        sky = table["sky"][rows]
        key = np.arange(1, len(rows) + 1)
        if ids:
            key = np.asarray(table["id"])[rows]
    else:
        row_of_id = {}
        for k, source_id in enumerate(np.asarray(table["id"]).tolist()):
            if is_known[k]:
                row_of_id[source_id] = k
        key = np.asarray(catalog["id"])
        sky = catalog["sky"].icrs
        source_rows = np.array([row_of_id.get(source_id, -1) for source_id in key.tolist()], int)
    # sources that the prior lacks come last
    extra = np.flatnonzero(new & is_kept)
    source_rows = np.concatenate([source_rows, extra])
    if n_cut := np.count_nonzero(cut[source_rows[source_rows >= 0]]):
        text = f"{n_cut} sources have segments that reach beyond their patches (flag CUT): a larger overlap"
        warn(f"{text} than {grid.overlap} pixels has them whole", PhotometryWarning)
    joined = QTable()
    joined["id"] = np.concatenate([key, new_ids(key, len(extra))])
    joined["sky"] = joined_sky([sky, table["sky"][extra]])
    for name in table.colnames:
        if name not in ("id", "sky", "new"):
            kind = name
            if name.endswith("flags"):
                kind = "flags"
            joined[name] = spread_rows(table[name], source_rows, kind)
            joined[name].info.description = table[name].info.description
    return joined


def measure_patch(inputs, grid, k, catalog, n_threads):
    """
    Measure the sources of a patch.

    Parameters
    ----------
    inputs : `~miricigale.photometry.commands.file_inputs.Inputs`
        The files.
    grid : `PatchGrid`
        The patches.
    k : int
        Which.
    catalog : `~astropy.table.QTable` or None
        ``id`` and ``sky`` of all sources, where there is one.
    n_threads : int or None
        Number of threads.

    Returns
    -------
    table : `~astropy.table.QTable`
        For `join_patches`; without rows where the files have nothing.
    measured : `~miricigale.photometry.commands.file_inputs.Measurement` or None
        None without a source and an image.
    """
    prior = inputs.highres.header
    part, *parts = patch_parts(inputs, grid, k)
    pixels = inputs.read(part, parts)
    in_core = None
    if catalog is not None:
        xy = _pixels(catalog["sky"], prior)
        rows = np.flatnonzero(grid.is_near(k, xy, grid.overlap))
        catalog = catalog[rows]
        in_core = grid.holder(xy[rows]) == k
    # sources of the patch with its overlap
    segments, sources = inputs.find_sources(pixels, catalog, part or ())
    if not len(sources) and not any("source" in image.meta for image in pixels.images.values()):
        return QTable({"id": [], "new": []}), None
    with warnings.catch_warnings():
        # of images without data here
        warnings.filterwarnings("ignore", "none of the .* sources is on or near", PhotometryWarning)
        measured = inputs.measure(pixels, inputs.photometers(n_threads), segments, sources)
    table = measured.table
    for band, section in zip(inputs.bands, parts, strict=True):
        # pixels are those of the whole image
        for name, pixels in zip(("y", "x"), section or (), strict=False):
            table[f"{band}_{name}"] += pixels.start
    columns = [table[name] for name in table.colnames if name.endswith("flags")]
    table["new"] = np.any([flags & ForcedFlags.NOT_IN_CATALOG for flags in columns], axis=0)
    xy = _pixels(table["sky"], prior)
    is_kept = grid.is_near(k, xy, RIM)
    if part:
        cut = _is_cut(segments, part, prior.shape, xy)
        for flags in columns:
            flags[cut] |= ForcedFlags.CUT
        if inputs.segmentation is not None:
            # its position may be in another core than that of the whole, and in none
            is_kept |= cut
    if in_core is not None:
        is_kept[: len(in_core)] = in_core
    return table[is_kept], measured


def _is_cut(segments, part, shape, xy):
    """Return whether the segment at each pixel x, y of the prior is cut by an edge of a part."""
    edges = [np.zeros(0, int)]
    for labels, axis, n in zip((segments, segments.T), part, shape, strict=True):
        edges += [labels[0]] * (axis.start > 0) + [labels[-1]] * (axis.stop < n)
    rows, columns = part
    place = np.nan_to_num(xy[:, ::-1] - [rows.start, columns.start], nan=-1.0)
    place = np.rint(place).astype(int)
    inside = np.all((place >= 0) & (place < segments.shape), axis=1)
    label = np.where(inside, segments[tuple(np.where(inside[:, None], place, 0).T)], 0)
    return (label > 0) & np.isin(label, np.concatenate(edges))


def _pixels(sky, header):
    """Return pixels (x, y), (n, 2), of the prior's grid; NaN for positions that are missing or a degree off."""
    return sky_pixels(sky, header.wcs, header.shape, 1e5)
