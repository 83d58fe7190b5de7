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
PATCHED = (*GRID, "patches", "highres.pixel_scale")


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
def _whole(key, pixel_scale):
    return mosaic_wcs(list(all_exposures(*key).values()), pixel_scale * u.arcsec)


@cached(maxsize=4)
def _patches(key, options, pixel_scale):
    """`~miricigale.photometry.commands.patches.PatchGrid` and `SkyPatch` by name."""
    # whole fields need none of these, and commands that only read settings import nothing heavy
    from matplotlib.path import Path
    from matplotlib.transforms import Bbox

    from miricigale.photometry.commands.patches import PatchGrid

    exposures, whole = all_exposures(*key), _whole(key, pixel_scale)
    side, rim = (math.ceil(x / pixel_scale) for x in (options.size, options.overlap))
    ny, nx = shape = whole.pixel_shape[::-1]
    grid = PatchGrid(side, rim, (0, 0), tuple(math.ceil(n / side) for n in shape))
    outlines = [
        Path(np.transpose(whole.all_world2pix(*e.wcs.calc_footprint().T, 0)))
        for e in exposures.values()
    ]
    ends = np.array([[path.vertices.min(axis=0), path.vertices.max(axis=0)] for path in outlines])
    names, filters, found = list(exposures), key[1].filters, {}
    for k, name in enumerate(grid.names):
        y, x = grid.box(k)
        low, high = np.array([x.start, y.start]) - 0.5, np.array([x.stop, y.stop]) - 0.5
        near = np.flatnonzero(np.all((ends[:, 0] < high) & (ends[:, 1] > low), axis=1))
        seen, cored = (
            [names[i] for i in near if outlines[i].intersects_bbox(box, filled=True)]
            for box in (Bbox([low, high]), Bbox([low + rim, high - rim]))
        )
        if cored:
            box = slice(max(y.start, 0), min(y.stop, ny)), slice(max(x.start, 0), min(x.stop, nx))
            own = {exposures[one].filter for one in cored}
            bands = tuple(band for band in filters if band in own)
            found[name] = SkyPatch(box, tuple(seen), bands)
    return grid, found


def _patching(config):
    return _patches(exposure_sections(config), config.patches, config.highres.pixel_scale)


def patch_grid(config):
    """The `~miricigale.photometry.commands.patches.PatchGrid` of a study in patches, on the prior's grid."""
    return _patching(config)[0]


def study_patches(config):
    """The patches that exposures see, `SkyPatch` by name; one without a name for the whole field."""
    if config.patches.size:
        return _patching(config)[1]
    ny, nx = grid_of(config, config.highres.pixel_scale).pixel_shape[::-1]
    every = tuple(all_exposures(*exposure_sections(config)))
    return {"": SkyPatch((slice(0, ny), slice(0, nx)), every, config.exposures.filters)}


def shown_patch(config):
    """The patch that is shown on the page: the first with most bands, and of these that with most exposures."""
    patches = study_patches(config)
    return max(patches, key=lambda name: (len(patches[name].bands), len(patches[name].exposures)))


def of_patch(name, patch):
    """Name of a product of a patch."""
    return f"{name}_{patch}" if patch else name


def grid_of(config, pixel_scale, patch=""):
    """North-up WCS that covers every exposure of the study, or a patch of it with its overlap."""
    key = exposure_sections(config)
    whole = _whole(key, pixel_scale)
    if not patch:
        return whole
    box, fine = study_patches(config)[patch].box, _whole(key, config.highres.pixel_scale)
    if pixel_scale != config.highres.pixel_scale:
        from miricigale.photometry.commands.patches import seen_part

        box = seen_part(box, fine, whole, whole.pixel_shape[::-1])
    wcs = whole[box]
    wcs.pixel_shape = tuple(one.stop - one.start for one in box[::-1])
    return wcs


def by_patch(config, sky):
    """Patches and the numbers of those of some positions, (n,), that are in the core of each, as pairs."""
    if not config.patches.size:
        return [("", np.arange(len(sky)))]
    grid, found = _patching(config)
    xy = grid_of(config, config.highres.pixel_scale).world_to_pixel(sky)
    holder = grid.holder(np.transpose(xy))
    return [(name, np.flatnonzero(holder == grid.names.index(name))) for name in found]


def parts_of(unit):
    """Truth, band and patch of a unit ``<truth>/<filter>/<patch>``, of which the patch may lack."""
    return (*unit.split("/"), "")[:3]


def patch_exposures(config, band, patch=""):
    """The exposures of a band that see a patch, by name."""
    every, seen = study_exposures(config), study_patches(config)[patch].exposures
    return {name: every[name] for name in seen if every[name].filter == band}


def patch_bands(config):
    """Names of the bands of all patches, ``<filter>/<patch>``."""
    patches = study_patches(config).items()
    return tuple(
        "/".join(filter(None, (band, name))) for name, one in patches for band in one.bands
    )


def study_bands(config):
    """Names of the bands of all truths, ``<truth>/<filter>``."""
    return unit_names(truth_names(config), config.exposures.filters)


def truth_bands(config):
    """Names of the bands of all truths and patches, ``<truth>/<filter>/<patch>``."""
    return unit_names(truth_names(config), patch_bands(config))


def patch_plan(config, unit):
    """Plain values of the exposures of a unit of `truth_bands`, for hashing."""
    return plain_exposures(patch_exposures(config, *parts_of(unit)[1:]))


def mosaic_memory(config, unit):
    """
    About how many bytes a process takes for a mosaic of a band, the prior, or what is measured on them.

    Measured, of one to four pointings: 0.5 GB, 60 MB for each exposure, and 120 bytes for each pixel of the
    prior's grid.
    """
    _, band, patch = parts_of(unit) if "/" in unit else ("", "", unit)
    n_images = len(patch_exposures(config, band, patch)) if band else 0
    pixels = math.prod(grid_of(config, config.highres.pixel_scale, patch).pixel_shape)
    return 500_000_000 + 60_000_000 * n_images + 120 * pixels
