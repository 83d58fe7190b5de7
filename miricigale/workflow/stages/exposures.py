"""What is exposed, and the grids that cover it, from the configuration alone."""

import logging
import math
import operator
from pathlib import Path
from typing import NamedTuple

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord

from miricigale.instrument import (
    Exposure,
    ceers_exposures,
    dither_patterns,
    read_centers,
    read_dithers,
    tangent_offset,
    tile_offsets,
)
from miricigale.utils.caching import cached
from miricigale.utils.options import check_that
from miricigale.utils.positions import as_positions
from miricigale.utils.table_files import read_table
from miricigale.workflow.background import band_background, of_filter, text_by_filter
from miricigale.workflow.options import of_option, require
from miricigale.workflow.truths import truth_names

log = logging.getLogger(__name__)

#: Sections of the configuration on which the grids of images depend, what is exposed, and kernels.
GRID = ("pointing", "exposures")
IMAGES = (*GRID, "scene", "detector", "reduction")
KERNEL = (*GRID, "patches", "highres", "photometry.regularization", "reduction")

#: Reference data of the simulated images.
IMAGE_RESOURCES = (
    "instrument.siaf",
    "instrument.imager",
    "instrument.thermal",
    "psf.jwst_pupil",
    "filters.sedpy",
)
# residual = "etc" says whose pattern it is, not how strong, and a level whose sky
EXPOSURE_RESOURCES = (*IMAGE_RESOURCES, "instrument.etc", "instrument.zodiacal")


def study_exposures(config):
    """
    The exposures of each truth: name, ``<filter>-<dither>``, to `Exposure`.

    Dithers are counted through all pointings, so that each exposure has random numbers of its own.
    """
    return all_exposures(*exposure_sections(config))


def exposure_sections(config):
    """What exposures follow from, as a key of caches: sections, dithers, state of the file of pointings."""
    options = config.exposures
    patterns = tuple(_dithers(options, k)[0] for k in range(len(options.filters)))
    return config.pointing, options, patterns, _stamp(config.pointing)


def dithers_text(config):
    """Where the dithers of the study are from, in words."""
    options = config.exposures
    return text_by_filter({f: _dithers(options, k)[1] for k, f in enumerate(options.filters)})


def _dithers(options, k):
    """Dithers of a filter, the name of a pattern or offsets in arcsec as pairs, and where they are from."""
    name = of_filter(options.dithers or ("ceers",), k)
    if name in dither_patterns():
        form = "of the form of the observatory's but not its digits"
        return name, f"the package's pattern {name!r}, {form}"
    path, part = Path(name).expanduser(), {}
    wanted = f"must be a file or one of {list(dither_patterns())}"
    require(path.is_file(), "exposures", "dithers", wanted, repr(name))
    if path.suffix.lower() == ".pointing":
        if options.dither_observation:
            part["observation"] = options.dither_observation
        if options.dither_exposures:
            part["exposure"] = options.dither_exposures[k]
    text = "".join(f", {key} {value}" for key, value in part.items())
    stat = path.stat()
    offsets = _file_pattern(path, stat.st_mtime_ns, stat.st_size, **part)
    return offsets, f"offsets in the file {path.name}{text}"


@cached(maxsize=64)
def _file_pattern(path, *_, **part):
    """Offsets in a file, which is read again when it has changed."""
    with of_option(f"[exposures] dithers: {path.name}:", ValueError, u.UnitsError):
        offsets = read_dithers(path, **part)
    return tuple(map(tuple, offsets.to_value(u.arcsec).tolist()))


class Pointing(NamedTuple):
    """
    Where the telescope looks once.

    Parameters
    ----------
    center : `~astropy.coordinates.SkyCoord`
        Of the field.
    roll : `~astropy.units.Quantity`
        Position angle of V3.
    bands : tuple of str
        Filters that are exposed there.
    time : `~astropy.units.Quantity`, optional
        Exposure time of each, all dithers; as elsewhere if None.
    """

    center: SkyCoord
    roll: u.Quantity
    bands: tuple
    time: u.Quantity | None = None


def study_pointings(config):
    """Centers of the pointings."""
    return tuple(one.center for one in _study_pointings(config))


def _study_pointings(config):
    return _pointings(config.pointing, config.exposures.filters, _stamp(config.pointing))


def pointing_of(config, exposure):
    """Center of the pointing that an exposure is a dither of: the nearest one."""
    return min(study_pointings(config), key=exposure.pointing.separation)


def _stamp(field):
    """Time and size of the file of pointings, which is read again when it has changed; none without one."""
    if field.table is None:
        return None
    with of_option("[pointing] centers:", OSError):
        stat = field.table.stat()
    return stat.st_mtime_ns, stat.st_size


@cached(maxsize=8)
def _pointings(field, filters, _):
    """Pointings of a section of a configuration."""
    roll = field.roll * u.deg
    if field.table is not None:
        with of_option(f"[pointing] centers: {field.table.name}:", ValueError, u.UnitsError):
            if field.table.suffix.lower() == ".pointing":
                centers, others = read_centers(field.table, roll)
                if others:
                    text = "%s: exposures that are not of the full imager are not used: %s"
                    log.warning(text, field.table.name, ", ".join(others))
                return tuple(Pointing(center, roll, filters) for center in centers)
            return _read_pointings(read_table(field.table, wanted="pointings"), roll, filters)
    if field.centers:
        centers = [SkyCoord(*map(float, text.split()), unit="deg") for text in field.centers]
        return tuple(Pointing(center, roll, filters) for center in centers)
    center = SkyCoord(field.ra * u.deg, field.dec * u.deg)
    if field.tiles == (1, 1):
        return (Pointing(center, roll, filters),)
    # as dithers are, along the axes of the imager
    pa = Exposure("miri.f770w", n_groups=2, pointing=center, roll=roll).pa_aper
    offsets = tile_offsets(*field.tiles, overlap=field.overlap)
    return tuple(Pointing(tangent_offset(center, dx, dy, pa), roll, filters) for dx, dy in offsets)


def _read_pointings(table, roll, filters):
    """Pointings of the rows of a table; a row without a roll, bands or time has those of the study."""
    known = {name.rpartition(".")[2]: name for name in filters}
    columns, found = {name.lower(): name for name in table.colnames}, []
    for row, center in zip(table, as_positions(table, "centers"), strict=True):
        given = {"roll": roll, "time": None}
        for name, unit in (("roll", u.deg), ("time", u.s)):
            value = row[columns[name]] if name in columns else np.ma.masked
            if not np.ma.is_masked(value):
                given[name] = u.Quantity(value, unit)
        text = row[columns["bands"]] if "bands" in columns else ""
        names = [] if np.ma.is_masked(text) else str(text).lower().replace(",", " ").split()
        bands = [known.get(name.rpartition(".")[2]) for name in names] or filters
        wanted = f"of [exposures] filters {list(filters)}"
        check_that(None not in bands, "bands", wanted, repr(text))
        found.append(Pointing(center, bands=tuple(bands), **given))
    return tuple(found)


@cached(maxsize=8)
def all_exposures(field, options, patterns, stamp):
    """Exposures by name of what `exposure_sections` gives; not to be changed."""
    units = {}
    for k, name in enumerate(options.filters):
        keys = ("n_groups", "n_integrations")
        own = {key: getattr(options, key)[k] for key in keys if getattr(options, key)}
        pattern, named = patterns[k], isinstance(patterns[k], str)
        n_dithers = options.n_dithers[k] if options.n_dithers else None
        if not named:
            n_dithers = n_dithers or len(pattern)
            wanted = f"must be at most {len(pattern)} for {name}, as its file of dithers has"
            good = n_dithers <= len(pattern)
            require(good, "exposures", "n_dithers", wanted, n_dithers)
        offsets = pattern if named else pattern * u.arcsec
        number = 0
        for center, roll, bands, time in _pointings(field, options.filters, stamp):
            if name not in bands:
                continue
            exposure, n = _planned(name, own, n_dithers, center, roll, options)
            exposure = exposure if time is None else exposure.replace(time=time / n)
            for dither in exposure.dithered(offsets, n):
                units[f"{name}-{number}"] = dither.replace(dither=number)
                number += 1
    return units


def _planned(name, own, n_dithers, pointing, roll, options):
    """The exposure of a band at a pointing and the number of its dithers, where not given those of the plan."""
    if "n_groups" in own and n_dithers:
        return Exposure(name, pointing=pointing, roll=roll, **own), n_dithers
    planned = ceers_exposures(pointing, roll, filters=[name], quick=options.plan == "quick")
    return planned[0].replace(pointing=pointing, **own), n_dithers or len(planned)


def background_options(config):
    """Arguments of `~miricigale.workflow.background.band_background`, but for the filter."""
    options = config.scene
    at_pointing = options.background_date or options.background_of == "pointing"
    return {
        "filters": config.exposures.filters,
        "levels": options.background,
        "position": study_pointings(config)[0] if at_pointing else None,
        "date": options.background_date,
    }


def study_background(config, filter):
    """Surface brightness of sky and telescope at the center of the field in a filter."""
    return config.scene.background_scale * band_background(filter, **background_options(config))


def band_names(config):
    """Names of the bands."""
    return config.exposures.filters


def exposure_units(config):
    """Names of all exposures, ``<truth>/<filter>-<dither>``."""
    return tuple(f"{t}/{name}" for t in truth_names(config) for name in study_exposures(config))


def exposures_of(config, unit=""):
    """Exposures by name of a unit that ends with the name of an exposure or of a band; all without one."""
    name = unit.rpartition("/")[2]
    every = study_exposures(config)
    if name in every:
        return {name: every[name]}
    return {own: e for own, e in every.items() if name in ("", e.filter)}


def exposure_plan(config, unit=""):
    """Plain values of the exposures of a unit, a filter, or the whole study, for hashing."""
    return plain_exposures(exposures_of(config, unit))


def plain_exposures(exposures):
    """Plain values of exposures by name."""
    counts = operator.attrgetter("readout", "n_groups", "n_integrations", "subarray")
    return {
        name: [*counts(e), e.pointing.ra.deg, e.pointing.dec.deg, e.roll.value]
        for name, e in exposures.items()
    }


def band_exposures(config, name):
    """The exposures of one band, in order."""
    return list(exposures_of(config, name).values())


def pointing_exposures(config, name):
    """The exposures of one band at its first pointing; there are as many dithers at the others."""
    own = band_exposures(config, name)
    return own[: len(own) // sum(name in one.bands for one in _study_pointings(config))]


def pointing_time(config, name):
    """Exposure time of one band at one pointing; where pointings overlap it is longer."""
    return sum(exposure.exposure_time for exposure in pointing_exposures(config, name))


def exposure_memory(config, unit):
    """
    About how many bytes a process takes for an exposure, of a unit or the largest of a filter.

    Measured: 0.5 GB, and counts and flags of each group.
    """
    if config.exposures.kind == "rates":
        return 600_000_000
    chosen = exposures_of(config, unit).values()
    groups = max(math.prod(e.shape) * e.n_groups * e.n_integrations for e in chosen)
    return 500_000_000 + int(3.3 * groups)
