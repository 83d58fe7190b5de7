"""How much disk, memory and processor time a study takes, from its configuration."""

import math

import numpy as np
from astropy.table import QTable

from miricigale.instrument import imager_columns
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import convert_values, first_value
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.workflow.config import check_config
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.exposures import study_exposures, study_pointings
from miricigale.workflow.stages.grids import grid_of, patch_bands, study_patches
from miricigale.workflow.stages.inputs import REDSHIFT_STEP, bright_sources, study_catalog
from miricigale.workflow.truths import study_truths


@takes_other_keywords
def disk_use(config):
    """
    Estimate how many bytes the products of a run take, as `study_cost` has them by stage.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    n_bytes : dict of str to int
        By stage, all units together; stages of small tables only are left out.

    Examples
    --------
    >>> from miricigale.workflow import disk_use, load_config
    >>> use = disk_use(load_config("goodss", quick=True))
    >>> print(f"{sum(use.values()) / 1e6:.0f} MB")
    270 MB
    """
    check_config(config)
    return convert_values(int, _Size(config).disk())


@takes_other_keywords
def study_cost(config):
    """
    Estimate what a run takes: units, processor time, disk and memory by stage.

    Times are of a core on which the plain loop of ``benchmarks/fit.py`` takes 0.03 s an object with ``--kind
    quick``, kernels compiled, after runs of 1, 9 and 25 pointings (docs/accuracy/running.rst).

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    cost : `~astropy.table.QTable`
        A row for each stage: ``stage``, ``units``, ``cpu`` (s, all units together), ``disk`` (MB) and ``memory``
        (MB, the largest unit; 0 where it is small).

    Examples
    --------
    >>> from miricigale.workflow import load_config, study_cost
    >>> cost = study_cost(load_config("goodss", quick=True))
    >>> print(cost["units"][cost["stage"] == "exposures"][0], "exposures")
    12 exposures
    """
    check_config(config)
    size = _Size(config)
    disk = size.disk()
    seconds = size.seconds()
    rows = []
    for stage in study_stages():
        units = stage.unit_names(config)
        memory = 0
        if stage.memory is not None:
            memory = max((stage.memory(config, unit) for unit in units), default=0)
        row = {
            "stage": stage.name,
            "units": len(units),
            "cpu": round(seconds.get(stage.name, 0.0)),
            "disk": round(disk.get(stage.name, 0) / 1e6),
            "memory": round(memory / 1e6),
        }
        rows.append(row)
    return QTable(rows=rows, units={"cpu": "s", "disk": "Mbyte", "memory": "Mbyte"})


class _Size:
    """Numbers of exposures, pixels and sources, from which the cost of a study follows."""

    def __init__(self, config):
        self.config = config
        self.exposures = study_exposures(config)
        self.truths = len(study_truths(config))
        self.pixels = {}
        for name, exposure in self.exposures.items():
            self.pixels[name] = math.prod(exposure.shape)
        patches = study_patches(config)
        self.native = _n_pixels(config, config.reduction.pixel_scale, patches)
        self.fine = _n_pixels(config, config.highres.pixel_scale, patches)
        # patches have no mosaics on the prior's pixels
        if config.patches.size:
            self.drizzled = 0
        else:
            self.drizzled = self.fine
        self.n_bands = len(config.exposures.filters)
        self.n_sets = len(config.fit.sets)
        self.n_kernels = len(patch_bands(config))
        # exposures of the mosaics, of which an exposure is in several
        self.n_drizzled = sum(len(patch.exposures) for patch in patches.values())
        catalog = study_catalog(config.catalog)
        catalog = bright_sources(catalog, config.catalog, config.highres.filter)
        self.n = len(catalog)
        redshifts = np.round(floats(catalog["redshift"]) / REDSHIFT_STEP)
        self.n_redshifts = len(np.unique(redshifts))
        wcs = grid_of(config, config.reduction.pixel_scale)
        inside = np.count_nonzero(wcs.footprint_contains(catalog["sky"]))
        n_pixels = math.prod(wcs.pixel_shape)
        # sources of the prior; those where patches overlap are in each
        self.n_drawn = inside * self.native / n_pixels
        # the box about the fields has corners that no field covers
        first, last = imager_columns()
        height = first_value(self.exposures).shape[0]
        share = len(study_pointings(config)) * (last - first) * height / n_pixels
        self.n_imaged = int(inside * min(1.0, share))
        self.pictured = min(self.n_imaged, config.report.pictures)

    def disk(self):
        """Return the bytes by stage, as they were measured; stages of small tables only are left out."""
        config = self.config
        pixels = self.pixels
        exposed = 3.5 * sum(pixels.values())
        n_rates = 0
        for name, exposure in self.exposures.items():
            if config.run.keep_level1b:
                # counts, the planes that only a simulation knows, and slopes
                groups = exposure.n_groups * exposure.n_integrations
                exposed += (2 * groups + 11.6) * pixels[name]
            elif exposure.dither == 0:
                # slopes of one dither of each band of the reference
                n_rates += pixels[name]
        if config.photometry.method == "yang2021":
            measured = self.fine
        else:
            measured = self.native
        pointed = min(2, self.n_bands) / len(study_pointings(config)) * config.point_sources.enabled
        n = self.n
        truths = self.truths
        bands = self.n_bands
        return {
            "catalog": 240 * n,
            "seds": (5_100 + 14.5 * self.n_redshifts) * n,
            "truth": truths * 800 * n,
            "exposures": truths * exposed + 3.6 * n_rates,
            "mosaics": truths * bands * 2.05 * (self.native + self.drizzled),
            "highres": 3.8 * self.fine,
            "points": pointed * 2.05 * measured,
            "kernels": self.n_kernels * 2_950_000,
            "templates": 2.7 * self.fine + 9_400 * self.n_imaged,
            "photometry": truths * bands * (6 * measured + 250 * self.n_imaged),
            "matches": truths * (240 + 70 * bands) * n,
            "fits": truths * self.n_sets * 4_500 * self.n_imaged,
            "experiments": truths * len(config.fit.experiments) * 4_500 * self.n_imaged,
            "sources": truths * (600 * n + (6_000 + 4_100 * bands) * self.pictured),
            "report": 10_000_000,
        }

    def seconds(self):
        """Return the processor time by stage; small and optional stages have none."""
        config = self.config
        truths = self.truths
        bands = self.n_bands
        # of an exposure as rates, or of an exposure and all groups of its pixels
        exposure_time = 5.0
        if config.exposures.kind == "ramps":
            groups = 0
            for name, exposure in self.exposures.items():
                groups += exposure.n_groups * exposure.n_integrations * self.pixels[name]
            exposure_time = 1.7 + 5.9e-8 * groups / len(self.exposures)
        return {
            "seds": (1.6e-3 + truths * 4e-4) * self.n,
            "exposures": truths * exposure_time * len(self.exposures),
            "mosaics": truths * (0.46 * self.n_drizzled + 9e-7 * self.drizzled * bands),
            "highres": 5e-7 * self.fine + 3e-3 * self.n_drawn,
            "kernels": 0.8 * self.n_kernels,
            "templates": 5e-7 * self.fine + 7e-3 * self.n_drawn,
            "photometry": truths * bands * (5e-7 * self.native + 1.4e-2 * self.n_drawn),
            "points": config.point_sources.enabled * bands * (exposure_time + 3.0),
            "fits": truths * self.n_sets * 1.9e-3 * self.n_imaged,
            "sources": truths * (5.0 + 2.5e-3 * self.n),
            "report": 12.0 + 1.5e-3 * self.n,
        }


def _n_pixels(config, pixel_scale, patches):
    """Return the number of pixels of all patches together on grids of a pixel scale (arcsec)."""
    return sum(math.prod(grid_of(config, pixel_scale, name).pixel_shape) for name in patches)
