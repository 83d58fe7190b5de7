"""What is exposed, and the grids that cover it, from the configuration alone."""

import dataclasses
import functools
import math

import astropy.units as u
from astropy.coordinates import SkyCoord

from miricigale.instrument import Exposure, ceers_exposures, mosaic_wcs
from miricigale.workflow.truths import truth_names

__all__ = [
    "EXPOSURE_RESOURCES",
    "GRID",
    "IMAGES",
    "IMAGE_RESOURCES",
    "KERNEL",
    "band_exposures",
    "band_names",
    "bands_of_truth",
    "dithers_of_band",
    "exposure_memory",
    "exposure_plan",
    "exposure_units",
    "grid_of",
    "study_exposures",
    "truth_bands",
]

#: Sections of the configuration on which the grids of images depend, what is exposed, and kernels.
GRID = ("pointing", "exposures")
IMAGES = (*GRID, "scene", "detector", "reduction")
KERNEL = (*GRID, "highres", "photometry.regularization", "reduction")

#: Reference data of the simulated images.
IMAGE_RESOURCES = (
    "instrument.siaf",
    "instrument.imager",
    "instrument.thermal",
    "psf.jwst_pupil",
    "filters.sedpy",
)
# residual = "etc" says whose pattern it is, not how strong
EXPOSURE_RESOURCES = (*IMAGE_RESOURCES, "instrument.etc")


def study_exposures(config):
    """The exposures of each truth: name, ``<filter>-<dither>``, to `Exposure`."""
    return dict(_exposures(config.pointing, config.exposures))


@functools.lru_cache(maxsize=8)
def _exposures(field, options):
    """Names and exposures of two sections of a configuration."""
    pointing = SkyCoord(field.ra * u.deg, field.dec * u.deg)
    roll = field.roll * u.deg
    quick = options.plan == "quick"
    units = {}
    for k, name in enumerate(options.filters):
        own = {
            key: getattr(options, key)[k]
            for key in ("n_groups", "n_integrations")
            if getattr(options, key)
        }
        n_dithers = options.n_dithers[k] if options.n_dithers else None
        if "n_groups" in own and n_dithers:
            exposure = Exposure(name, pointing=pointing, roll=roll, **own)
            exposures = exposure.dithered("ceers", n_dithers)
        else:
            exposures = ceers_exposures(pointing, roll, filters=[name], quick=quick)
            if n_dithers:
                exposures = exposures[0].replace(pointing=pointing).dithered("ceers", n_dithers)
            exposures = [dataclasses.replace(exposure, **own) for exposure in exposures]
        for exposure in exposures:
            units[f"{name}-{exposure.dither}"] = exposure
    return tuple(units.items())


def band_names(config):
    """Names of the bands."""
    return config.exposures.filters


def exposure_units(config):
    """Names of all exposures, ``<truth>/<filter>-<dither>``."""
    return tuple(f"{t}/{name}" for t in truth_names(config) for name in study_exposures(config))


def truth_bands(config):
    """Names of the bands of all truths, ``<truth>/<filter>``."""
    return tuple(f"{truth}/{name}" for truth in truth_names(config) for name in band_names(config))


def bands_of_truth(config, unit):
    """Units of `truth_bands` of the truth with which a unit begins."""
    truth = unit.partition("/")[0]
    return tuple(f"{truth}/{name}" for name in band_names(config))


def dithers_of_band(config, unit):
    """Units of `exposure_units` of a unit of `truth_bands`."""
    truth, _, band = unit.partition("/")
    return tuple(
        f"{truth}/{name}" for name, e in study_exposures(config).items() if e.filter == band
    )


def exposure_plan(config, unit=None):
    """Plain values of the exposures of a unit, a filter, or the whole study, for hashing."""
    return {
        name: [
            e.readout,
            e.n_groups,
            e.n_integrations,
            e.subarray,
            e.pointing.ra.deg,
            e.pointing.dec.deg,
            e.roll.value,
        ]
        for name, e in study_exposures(config).items()
        if not unit or unit.rpartition("/")[2] in (name, e.filter)
    }


def band_exposures(config, name):
    """The exposures of one band, in order."""
    return [e for e in study_exposures(config).values() if e.filter == name]


def grid_of(config, pixel_scale):
    """North-up WCS that covers every exposure of the study."""
    return mosaic_wcs(list(study_exposures(config).values()), pixel_scale * u.arcsec)


def exposure_memory(config, unit):
    """
    About how many bytes a process takes for an exposure, of a unit or the largest of a filter.

    Measured: 0.5 GB, and counts and flags of each group.
    """
    if config.exposures.kind == "rates":
        return 600_000_000
    name = unit.rpartition("/")[2]
    chosen = [e for own, e in study_exposures(config).items() if name in (own, e.filter)]
    groups = max(math.prod(e.shape) * e.n_groups * e.n_integrations for e in chosen)
    return 500_000_000 + int(3.3 * groups)
