"""What is exposed, and the grids that cover it, from the configuration alone."""

import logging
import math
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
from miricigale.workflow.truths import truth_names, unit_names

log = logging.getLogger(__name__)

#: Sections of the configuration on which the grids of images depend, what is exposed, and kernels.
GRID = ("pointing", "exposures")
IMAGES = GRID + ("scene", "detector", "reduction")
KERNEL = GRID + ("patches", "highres", "photometry.regularization", "reduction")

#: Reference data of the simulated images.
IMAGE_RESOURCES = (
    "instrument.siaf",
    "instrument.imager",
    "instrument.thermal",
    "psf.jwst_pupil",
    "filters.sedpy",
)
# of a residual and of a background that are named, not given as numbers
EXPOSURE_RESOURCES = IMAGE_RESOURCES + ("instrument.etc", "instrument.zodiacal")


def study_exposures(config):
    """
    Return the exposures of each truth: name, ``<filter>-<dither>``, to `Exposure`.

    Dithers are counted through all pointings, so that each exposure has random numbers of its own.
    """
    return all_exposures(*exposure_sections(config))


def exposure_sections(config):
    """Return what exposures follow from, as a key of caches: sections, dithers, state of the file of pointings."""
    options = config.exposures
    patterns = tuple(_dithers(options, k)[0] for k in range(len(options.filters)))
    return config.pointing, options, patterns, _stamp(config.pointing)


def dithers_text(config):
    """Return where the dithers of the study are from, in words."""
    options = config.exposures
    texts = {}
    for k, name in enumerate(options.filters):
        _, texts[name] = _dithers(options, k)
    return text_by_filter(texts)


def _dithers(options, k):
    """Return a filter's dithers, the name of a pattern or offsets (arcsec) as pairs, and where they are from."""
    name = of_filter(options.dithers or ("ceers",), k)
    if name in dither_patterns():
        form = "of the form of the observatory's but not its digits"
        return name, f"the package's pattern {name!r}, {form}"
    path = Path(name).expanduser()
    wanted = f"must be a file or one of {list(dither_patterns())}"
    require(path.is_file(), "exposures", "dithers", wanted, repr(name))
    selection = {}
    if path.suffix.lower() == ".pointing":
        if options.dither_observation:
            selection["observation"] = options.dither_observation
        if options.dither_exposures:
            selection["exposure"] = options.dither_exposures[k]
    stat = path.stat()
    offsets = _file_pattern(path, stat.st_mtime_ns, stat.st_size, **selection)
    text = f"offsets in the file {path.name}"
    for key, value in selection.items():
        text += f", {key} {value}"
    return offsets, text


@cached(maxsize=64)
def _file_pattern(path, *_, **selection):
    """Return the offsets in a file, which is read again when it has changed."""
    with of_option(f"[exposures] dithers: {path.name}:", ValueError, u.UnitsError):
        offsets = read_dithers(path, **selection)
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
    """Return the centers of the pointings."""
    return tuple(pointing.center for pointing in _study_pointings(config))


def _study_pointings(config):
    return _pointings(config.pointing, config.exposures.filters, _stamp(config.pointing))


def pointing_of(config, exposure):
    """Return the center of the pointing that an exposure is a dither of: the nearest one."""
    return min(study_pointings(config), key=exposure.pointing.separation)


def _stamp(field):
    """Return time and size of the file of pointings, which is read again when it has changed; None without one."""
    if field.table is None:
        return None
    with of_option("[pointing] centers:", OSError):
        stat = field.table.stat()
    return stat.st_mtime_ns, stat.st_size


@cached(maxsize=8)
def _pointings(field, filters, _):
    """Return the pointings of a section of a configuration."""
    roll = field.roll * u.deg
    if field.table is not None:
        with of_option(f"[pointing] centers: {field.table.name}:", ValueError, u.UnitsError):
            if field.table.suffix.lower() == ".pointing":
                centers, skipped = read_centers(field.table, roll)
                if skipped:
                    text = "%s: exposures that are not of the full imager are not used: %s"
                    log.warning(text, field.table.name, ", ".join(skipped))
            else:
                table = read_table(field.table, wanted="pointings")
                return _read_pointings(table, roll, filters)
    elif field.centers:
        centers = [SkyCoord(*map(float, text.split()), unit="deg") for text in field.centers]
    else:
        center = SkyCoord(field.ra * u.deg, field.dec * u.deg)
        centers = [center]
        if field.tiles != (1, 1):
            # as dithers are, along the axes of the imager
            pa = Exposure("miri.f770w", n_groups=2, pointing=center, roll=roll).pa_aper
            offsets = tile_offsets(*field.tiles, overlap=field.overlap)
            centers = [tangent_offset(center, dx, dy, pa) for dx, dy in offsets]
    return tuple(Pointing(center, roll, filters) for center in centers)


def _read_pointings(table, roll, filters):
    """Return the pointings of the rows of a table; a row without a roll, bands or time has those of the study."""
    columns = {name.lower(): name for name in table.colnames}

    def cell(row, name):
        """Return the value of a column of a row; None without one."""
        value = None
        if name in columns:
            value = row[columns[name]]
        if np.ma.is_masked(value):
            return None
        return value

    full_names = {name.rpartition(".")[2]: name for name in filters}
    wanted = f"of [exposures] filters {list(filters)}"
    pointings = []
    for row, center in zip(table, as_positions(table, "centers"), strict=True):
        row_roll = cell(row, "roll")
        time = cell(row, "time")
        text = cell(row, "bands") or ""
        names = str(text).lower().replace(",", " ").split()
        bands = [full_names.get(name.rpartition(".")[2]) for name in names]
        check_that(None not in bands, "bands", wanted, repr(text))
        pointing = Pointing(
            center,
            roll if row_roll is None else u.Quantity(row_roll, u.deg),
            tuple(bands or filters),
            None if time is None else u.Quantity(time, u.s),
        )
        pointings.append(pointing)
    return tuple(pointings)


@cached(maxsize=8)
def all_exposures(field, options, patterns, stamp):
    """Return exposures by name of what `exposure_sections` gives; not to be changed."""
    pointings = _pointings(field, options.filters, stamp)
    units = {}
    for k, name in enumerate(options.filters):
        pattern = patterns[k]
        n_dithers = None
        if options.n_dithers:
            n_dithers = options.n_dithers[k]
        if not isinstance(pattern, str):
            # offsets of a file
            n_dithers = n_dithers or len(pattern)
            wanted = f"must be at most {len(pattern)} for {name}, as its file of dithers has"
            require(n_dithers <= len(pattern), "exposures", "n_dithers", wanted, n_dithers)
            pattern = pattern * u.arcsec
        number = 0
        for pointing in pointings:
            if name in pointing.bands:
                exposure, n = _planned(k, pointing, n_dithers, options)
                for dither in exposure.dithered(pattern, n):
                    units[f"{name}-{number}"] = dither.replace(dither=number)
                    number += 1
    return units


def _planned(k, pointing, n_dithers, options):
    """
    Return the exposure of the k-th band at a pointing and the number of its dithers.

    What the options do not say is as in the plan.
    """
    name = options.filters[k]
    place = {"pointing": pointing.center, "roll": pointing.roll}
    counts = {}
    if options.n_groups:
        counts["n_groups"] = options.n_groups[k]
    if options.n_integrations:
        counts["n_integrations"] = options.n_integrations[k]
    if "n_groups" in counts and n_dithers:
        exposure = Exposure(name, **place, **counts)
    else:
        is_quick = options.plan == "quick"
        planned = ceers_exposures(**place, filters=[name], quick=is_quick)
        exposure = planned[0].replace(pointing=pointing.center, **counts)
        n_dithers = n_dithers or len(planned)
    if pointing.time is not None:
        exposure = exposure.replace(time=pointing.time / n_dithers)
    return exposure, n_dithers


def background_options(config):
    """Return the arguments of `~miricigale.workflow.background.band_background`, but for the filter."""
    options = config.scene
    position = None
    if options.background_date or options.background_of == "pointing":
        position = study_pointings(config)[0]
    return {
        "filters": config.exposures.filters,
        "levels": options.background,
        "position": position,
        "date": options.background_date,
    }


def study_background(config, filter):
    """Return the surface brightness of sky and telescope at the center of the field in a filter."""
    return config.scene.background_scale * band_background(filter, **background_options(config))


def band_names(config):
    """Return the names of the bands."""
    return config.exposures.filters


def exposure_units(config):
    """Return the names of all exposures, ``<truth>/<filter>-<dither>``."""
    return unit_names(truth_names(config), study_exposures(config))


def exposures_of(config, unit):
    """Return exposures by name of a unit that ends with the name of an exposure or of a band; all without one."""
    name = unit.rpartition("/")[2]
    exposures = study_exposures(config)
    if not name:
        return dict(exposures)
    if name in exposures:
        return {name: exposures[name]}
    return {key: exposure for key, exposure in exposures.items() if exposure.filter == name}


def exposure_plan(config, unit=""):
    """Return plain values of the exposures of a unit, a filter, or the whole study, for hashing."""
    return plain_exposures(exposures_of(config, unit))


def plain_exposures(exposures):
    """Return plain values of exposures by name."""
    values = {}
    for name, exposure in exposures.items():
        values[name] = [
            exposure.readout,
            exposure.n_groups,
            exposure.n_integrations,
            exposure.subarray,
            exposure.pointing.ra.deg,
            exposure.pointing.dec.deg,
            exposure.roll.value,
        ]
    return values


def band_exposures(config, name):
    """Return the exposures of one band, in order."""
    return list(exposures_of(config, name).values())


def pointing_exposures(config, name):
    """Return the exposures of one band at its first pointing; there are as many dithers at the others."""
    exposures = band_exposures(config, name)
    n_pointings = sum(name in pointing.bands for pointing in _study_pointings(config))
    return exposures[: len(exposures) // n_pointings]


def pointing_time(config, name):
    """Return the exposure time of one band at one pointing; where pointings overlap it is longer."""
    return sum(exposure.exposure_time for exposure in pointing_exposures(config, name))


def exposure_memory(config, unit):
    """
    Estimate how many bytes a process takes for an exposure, of a unit or the largest of a filter.

    Measured: 0.5 GB, and counts and flags of each group.
    """
    if config.exposures.kind == "rates":
        return 600_000_000
    n_values = []
    for exposure in exposures_of(config, unit).values():
        groups = exposure.n_groups * exposure.n_integrations
        n_values.append(math.prod(exposure.shape) * groups)
    return 500_000_000 + int(3.3 * max(n_values))
