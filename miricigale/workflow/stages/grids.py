"""The pixels of mosaics and prior, of the whole field or of patches of it, and the exposures that see them."""

import math
from typing import NamedTuple

import astropy.units as u
import numpy as np

from miricigale.instrument import mosaic_wcs
from miricigale.utils.caching import cached
from miricigale.workflow.stages.exposures import (
    GRID,
    all_exposures,
    exposure_sections,
    plain_exposures,
    study_exposures,
)
from miricigale.workflow.truths import truth_names, unit_names

#: Sections of the configuration on which the grids of patches depend.
PATCHED = GRID + ("patches", "highres.pixel_scale")


class SkyPatch(NamedTuple):
    """
    A patch of the field.

    Parameters
    ----------
    box : tuple of slice
        Rows and columns of the prior's grid, with the overlap.
    exposures : tuple of str
        Names of the exposures that see some of it, in their order.
    bands : tuple of str
        Filters of those that see its core.
    """

    box: tuple
    exposures: tuple
    bands: tuple


@cached(maxsize=8, copies=True)
def _field_wcs(key, pixel_scale):
    """Return the WCS of the whole field on pixels of a scale (arcsec)."""
    return mosaic_wcs(list(all_exposures(*key).values()), pixel_scale * u.arcsec)


@cached(maxsize=4)
def _patches(key, options, pixel_scale):
    """Return the `~miricigale.photometry.commands.patches.PatchGrid`, and `SkyPatch` by name."""
    # whole fields need none of these, and commands that only read settings import nothing heavy
    from matplotlib.path import Path
    from matplotlib.transforms import Bbox

    from miricigale.photometry.commands.patches import PatchGrid

    exposures = all_exposures(*key)
    wcs = _field_wcs(key, pixel_scale)
    side = math.ceil(options.size / pixel_scale)
    rim = math.ceil(options.overlap / pixel_scale)
    nx, ny = wcs.pixel_shape
    grid = PatchGrid(side, rim, (0, 0), (math.ceil(ny / side), math.ceil(nx / side)))
    outlines = {}
    for name, exposure in exposures.items():
        corners = wcs.all_world2pix(exposure.wcs.calc_footprint(), 0)
        outlines[name] = Path(corners)
    smallest = np.array([outline.vertices.min(axis=0) for outline in outlines.values()])
    largest = np.array([outline.vertices.max(axis=0) for outline in outlines.values()])
    names = np.array(list(exposures))
    patches = {}
    for k, patch in enumerate(grid.names):
        y, x = grid.box(k)
        low = np.array([x.start, y.start]) - 0.5
        high = np.array([x.stop, y.stop]) - 0.5
        box = Bbox([low, high])
        core = Bbox([low + rim, high - rim])
        overlapping = []
        bands = set()
        # only outlines whose own boxes overlap are compared
        for name in names[np.all((smallest < high) & (largest > low), axis=1)].tolist():
            if outlines[name].intersects_bbox(box, filled=True):
                overlapping.append(name)
            if outlines[name].intersects_bbox(core, filled=True):
                bands.add(exposures[name].filter)
        if bands:
            rows = slice(max(y.start, 0), min(y.stop, ny))
            columns = slice(max(x.start, 0), min(x.stop, nx))
            bands = tuple(band for band in key[1].filters if band in bands)
            patches[patch] = SkyPatch((rows, columns), tuple(overlapping), bands)
    return grid, patches


def _patching(config):
    return _patches(exposure_sections(config), config.patches, config.highres.pixel_scale)


def patch_grid(config):
    """Return the grid of a study in patches (`~miricigale.photometry.commands.patches.PatchGrid`) on the prior."""
    return _patching(config)[0]


def study_patches(config):
    """Return the patches that exposures see, `SkyPatch` by name; one without a name for the whole field."""
    if config.patches.size:
        return _patching(config)[1]
    nx, ny = grid_of(config, config.highres.pixel_scale).pixel_shape
    box = (slice(0, ny), slice(0, nx))
    return {"": SkyPatch(box, tuple(study_exposures(config)), config.exposures.filters)}


def shown_patch(config):
    """Return the patch that the page shows: the first with most bands, and of these that with most exposures."""
    patches = study_patches(config)
    return max(patches, key=lambda name: (len(patches[name].bands), len(patches[name].exposures)))


def of_patch(name, patch):
    """Return the name of a product of a patch."""
    if patch:
        return f"{name}_{patch}"
    return name


def grid_of(config, pixel_scale, patch=""):
    """Return the north-up WCS that covers every exposure of the study, or a patch of it with its overlap."""
    key = exposure_sections(config)
    field = _field_wcs(key, pixel_scale)
    if not patch:
        return field
    box = study_patches(config)[patch].box
    if pixel_scale != config.highres.pixel_scale:
        from miricigale.photometry.commands.patches import seen_part

        prior = _field_wcs(key, config.highres.pixel_scale)
        box = seen_part(box, prior, field, field.pixel_shape[::-1])
    wcs = field[box]
    rows, columns = box
    wcs.pixel_shape = (columns.stop - columns.start, rows.stop - rows.start)
    return wcs


def by_patch(config, sky):
    """Return patches and the numbers of those of some positions, (n,), that are in the core of each, as pairs."""
    if not config.patches.size:
        return [("", np.arange(len(sky)))]
    grid, patches = _patching(config)
    xy = grid_of(config, config.highres.pixel_scale).world_to_pixel(sky)
    holder = grid.holder(np.transpose(xy))
    return [(name, np.flatnonzero(holder == grid.names.index(name))) for name in patches]


def parts_of(unit):
    """Split a unit ``<truth>/<filter>/<patch>``, of which the patch may lack, into its three parts."""
    truth, _, part = unit.partition("/")
    band, _, patch = part.partition("/")
    return truth, band, patch


def patch_exposures(config, band, patch):
    """Return the exposures of a band that see a patch, by name."""
    exposures = study_exposures(config)
    names = study_patches(config)[patch].exposures
    return {name: exposures[name] for name in names if exposures[name].filter == band}


def patch_bands(config):
    """Return the names of the bands of all patches, ``<filter>/<patch>``."""
    names = []
    for patch, sky in study_patches(config).items():
        names += unit_names(sky.bands, (patch,))
    return tuple(names)


def study_bands(config):
    """Return the names of the bands of all truths, ``<truth>/<filter>``."""
    return unit_names(truth_names(config), config.exposures.filters)


def truth_bands(config):
    """Return the names of the bands of all truths and patches, ``<truth>/<filter>/<patch>``."""
    return unit_names(truth_names(config), patch_bands(config))


def patch_plan(config, unit):
    """Return plain values of the exposures of a unit of `truth_bands`, for hashing."""
    _, band, patch = parts_of(unit)
    return plain_exposures(patch_exposures(config, band, patch))


def mosaic_memory(config, unit):
    """
    Estimate how many bytes a process takes for a mosaic of a band, the prior, or what is measured on them.

    Measured, of one to four pointings: 0.5 GB, 60 MB for each exposure, and 120 bytes for each pixel of the
    prior's grid.
    """
    patch = unit
    n_images = 0
    if "/" in unit:
        _, band, patch = parts_of(unit)
        n_images = len(patch_exposures(config, band, patch))
    pixels = math.prod(grid_of(config, config.highres.pixel_scale, patch).pixel_shape)
    return 500_000_000 + 60_000_000 * n_images + 120 * pixels
