"""Grids kept between sessions, under a name made of everything that shapes them."""

import contextlib
import importlib.metadata
import logging
import os
from dataclasses import replace
from pathlib import Path

from miricigale.filters import filter as filter_curves
from miricigale.refdata.lookup import cache_folder, fingerprint_of
from miricigale.sed import chain
from miricigale.sed.grid import ModelGrid
from miricigale.sed.parameter import default_values
from miricigale.utils.configuration import conf
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.exceptions import DataError
from miricigale.utils.files import make_folder

_log = logging.getLogger(__name__)


def grid_key(model, axes, filters):
    """
    Return the checksum of everything that a grid depends on: components, data, cosmology, axes, curves of bands.

    Code is known by the versions that it states, ``Component.version`` of a component and its
    bases and ``VERSION`` of what all share: a change of numbers raises one of them.
    """
    parts = []
    for c in model.components:
        parts.append(
            {
                "name": c.name,
                "versions": [vars(t)["version"] for t in type(c).__mro__ if "version" in vars(t)],
                "settings": c.settings,
                "defaults": default_values(c.parameters),
                "data": c.fingerprint,
                "packages": {name: importlib.metadata.version(name) for name in c.packages},
            }
        )
    cosmology = model.cosmology
    content = {
        "versions": [chain.VERSION, filter_curves.VERSION],
        "components": parts,
        "cosmology": [type(cosmology), dict(cosmology.parameters)],
        "definition": model.frac_agn_definition,
        "axes": dict(axes),
        "bands": [[f.name, f.wave, f.throughput] for f in filters],
    }
    return content_sha256(content)


def is_own(model):
    """Tell whether all components are of this package: the code of others may change under the same name."""
    return all(type(c).__module__.startswith("miricigale.") for c in model.components)


def _unchanged(model):
    """Tell whether the files that were read are those that are there now."""
    return all(
        c.fingerprint == fingerprint_of(Path(c.path)) for c in model.components if c.resource
    )


def cached_grid(model, axes, filters, make):
    """
    Return a grid from the cache folder, or one of ``make(model, axes, filters)`` that is then kept there.

    The least recently used grids go when all together are larger than
    ``miricigale.conf.grid_cache_size`` (MB; 0: nothing is kept). A cache that cannot be
    read or written is logged and done without: the grid is the same. Models with components from
    outside this package are not cached, since their code may change under the same name.
    """
    limit = conf.grid_cache_size * 1e6
    if limit <= 0 or not is_own(model):
        return make(model, axes, filters)
    path = cache_folder() / "grids" / f"{grid_key(model, axes, filters)}.fits"
    if path.exists():
        try:
            grid = ModelGrid.read(path)
            os.utime(path)
            # the numbers are those of the file, the provenance is that of this model
            return replace(grid, meta=model.meta, recipe=model.recipe, preset=model.preset)
        except (DataError, OSError) as err:
            _log.warning("cached grid not used: %s", err)
    grid = make(model, axes, filters)
    if grid.galaxy.nbytes + grid.agn.nbytes > limit or not _unchanged(model):
        return grid
    try:
        make_folder(path.parent)
        # another thread, process or machine may be at the same grid
        grid.write(path, overwrite=True)
        _make_room(path.parent, limit, keep=path)
    except OSError as err:
        _log.warning("grid not kept in the cache: %s", err)
    return grid


def _make_room(folder, limit, keep):
    """Remove what was used least recently, unfinished files too, until the rest is small enough."""
    entries = {}
    for path in folder.iterdir():
        # another process may be at the same
        with contextlib.suppress(FileNotFoundError):
            entries[path] = path.stat()
    total = sum(status.st_size for status in entries.values())
    for path in sorted(entries, key=lambda path: entries[path].st_mtime_ns):
        if total > limit and path != keep:
            path.unlink(missing_ok=True)
            total -= entries[path].st_size
