"""How much disk a study takes, from its configuration."""

import math

import numpy as np

from miricigale.instrument import imager_columns
from miricigale.workflow.stages.exposures import grid_of, study_exposures, study_pointings
from miricigale.workflow.stages.inputs import REDSHIFT_STEP, bright_sources, study_catalog
from miricigale.workflow.truths import study_truths

#: Bytes, measured (``docs/guide/workflow.rst``): of a calibrated image and of slopes for each pixel of
#: the detector; of mosaics, of model and residual, of the prior and of templates for each pixel of
#: their grids.
_PIXEL = {
    "cal": 3.5,
    "rate": 3.6,
    "mosaic": 2.05,
    "photometry": 6.0,
    "highres": 3.8,
    "templates": 2.7,
}
#: Bytes for each source of the catalog: of the input, its fit (and for each node in redshift), the truth,
#: the matched table (and for each band) and the page of the sources.
_SOURCE = {
    "catalog": 240,
    "seds": 5_100,
    "redshift": 14.5,
    "truth": 800,
    "matches": 240,
    "band": 70,
    "page": 600,
}
#: Bytes for each source in the images: of its template and of its row of the photometry in a band; of
#: a fit; of its picture, and that in a band.
_IMAGED = {"templates": 9_400, "photometry": 250, "fit": 4_500, "picture": 6_000, "band": 4_100}
_KERNEL = 2_950_000
_REPORT = 6_200_000


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
    exposed = _PIXEL["cal"] * sum(pixels.values())
    # of one dither of each band of the reference
    rates = _PIXEL["rate"] * sum(pixels[name] for name, e in exposures.items() if e.dither == 0)
    if config.run.keep_level1b:
        # counts, and the planes that only a simulation knows
        for name, e in exposures.items():
            exposed += (2 * e.n_groups * e.n_integrations + 8 + _PIXEL["rate"]) * pixels[name]
        rates = 0
    fit = _IMAGED["fit"] * n_imaged
    pictured = min(n_imaged, config.report.pictures)
    by_stage = {
        "catalog": _SOURCE["catalog"] * n,
        "seds": (_SOURCE["seds"] + _SOURCE["redshift"] * n_redshifts) * n,
        "truth": truths * _SOURCE["truth"] * n,
        "exposures": truths * exposed + rates,
        "mosaics": truths * n_bands * _PIXEL["mosaic"] * (native + fine),
        "highres": _PIXEL["highres"] * fine,
        "kernels": n_bands * _KERNEL,
        "templates": _PIXEL["templates"] * fine + _IMAGED["templates"] * n_imaged,
        "photometry": truths
        * n_bands
        * (_PIXEL["photometry"] * measured + _IMAGED["photometry"] * n_imaged),
        "matches": truths * n * (_SOURCE["matches"] + n_bands * _SOURCE["band"]),
        "fits": truths * n_sets * fit,
        "experiments": truths * len(config.fit.experiments) * fit,
        "sources": truths
        * (_SOURCE["page"] * n + (_IMAGED["picture"] + n_bands * _IMAGED["band"]) * pictured),
        "report": _REPORT,
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
