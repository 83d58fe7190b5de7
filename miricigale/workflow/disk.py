"""How much disk a study takes, from its configuration."""

import math

import numpy as np

from miricigale.instrument import imager_columns
from miricigale.workflow.stages.exposures import grid_of, study_exposures, study_pointings
from miricigale.workflow.stages.inputs import REDSHIFT_STEP, bright_sources, study_catalog
from miricigale.workflow.truths import study_truths


def disk_use(config):
    """
    About how many bytes the products of a run take.

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
    273 MB
    """
    exposures, truths = study_exposures(config), len(study_truths(config))
    pixels = {name: math.prod(e.shape) for name, e in exposures.items()}
    native, fine = (
        math.prod(grid_of(config, scale).pixel_shape)
        for scale in (config.reduction.pixel_scale, config.highres.pixel_scale)
    )
    measured = fine if config.photometry.method == "yang2021" else native
    n_bands, n_sets = len(config.exposures.filters), len(config.fit.sets)
    catalog = bright_sources(study_catalog(config.catalog), config.catalog, config.highres.filter)
    n, n_imaged = len(catalog), _n_imaged(config, catalog, native)
    n_redshifts = len(np.unique(np.round(np.asarray(catalog["redshift"], float) / REDSHIFT_STEP)))
    pictured = min(n_imaged, config.report.pictures)
    # bytes for each pixel and source, measured (docs/accuracy/running.rst)
    exposed = 3.5 * sum(pixels.values())
    if config.run.keep_level1b:
        # counts, the planes that only a simulation knows, and slopes
        for name, e in exposures.items():
            exposed += (2 * e.n_groups * e.n_integrations + 11.6) * pixels[name]
        rates = 0
    else:
        # slopes of one dither of each band of the reference
        rates = 3.6 * sum(pixels[name] for name, e in exposures.items() if e.dither == 0)
    pointed = min(2, n_bands) / len(study_pointings(config)) * config.point_sources.enabled
    by_stage = {
        "catalog": 240 * n,
        "seds": (5_100 + 14.5 * n_redshifts) * n,
        "truth": truths * 800 * n,
        "exposures": truths * exposed + rates,
        "mosaics": truths * n_bands * 2.05 * (native + fine),
        "highres": 3.8 * fine,
        "points": pointed * 2.05 * measured,
        "kernels": n_bands * 2_950_000,
        "templates": 2.7 * fine + 9_400 * n_imaged,
        "photometry": truths * n_bands * (6 * measured + 250 * n_imaged),
        "matches": truths * (240 + 70 * n_bands) * n,
        "fits": truths * n_sets * 4_500 * n_imaged,
        "experiments": truths * len(config.fit.experiments) * 4_500 * n_imaged,
        "sources": truths * (600 * n + (6_000 + 4_100 * n_bands) * pictured),
        "report": 13_000_000,
    }
    return {name: int(n_bytes) for name, n_bytes in by_stage.items()}


def _n_imaged(config, catalog, n_pixels):
    """About how many sources of a catalog the mosaics, of ``n_pixels``, show."""
    wcs = grid_of(config, config.reduction.pixel_scale)
    inside = np.count_nonzero(wcs.footprint_contains(catalog["sky"]))
    # the box about the fields has corners that no field covers
    first, last = imager_columns()
    height = next(iter(study_exposures(config).values())).shape[0]
    share = len(study_pointings(config)) * (last - first) * height / n_pixels
    return int(inside * min(1.0, share))
