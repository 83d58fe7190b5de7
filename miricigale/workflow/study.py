"""The study as one call."""

import math

import astropy.units as u
import numpy as np

from miricigale.depth import saturation_forecast
from miricigale.filters import Filter
from miricigale.instrument import background_level, imager_filters
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow.config import HighresSection
from miricigale.workflow.runner import StudyRunner
from miricigale.workflow.stages import study_stages
from miricigale.workflow.stages.exposures import grid_of, study_exposures
from miricigale.workflow.stages.inputs import study_catalog
from miricigale.workflow.truths import study_truths

__all__ = ["MIN_SOURCES", "check_study", "disk_use", "run_study"]

#: Sources that a field must have for an error function to be measured.
MIN_SOURCES = 3

#: Bytes of products, measured: of a calibrated image and a mosaic for each pixel of their grids, of
#: a model (not compressed); tables of a truth and a fit for each source of the catalog; the prior's
#: images and templates for each of its pixels; a kernel; the fits of the input for each source.
_BYTES = {
    "image": 3.5,
    "mosaic": 1.9,
    "model": 4.0,
    "truth": 2400.0,
    "fit": 4000.0,
    "prior": 7.8,
    "kernel": 2.9e6,
    "seds": 9600.0,
}


def disk_use(config):
    """
    About how many bytes the products of a run take.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Returns
    -------
    n_bytes : int
    """
    exposures = study_exposures(config)
    total = 0
    for exposure in exposures.values():
        pixels = math.prod(exposure.shape)
        total += _BYTES["image"] * pixels
        if config.run.keep_level1b:
            # counts, the planes that only a simulation knows, and the rates
            counts = exposure.n_groups * exposure.n_integrations
            total += (2 * counts + 8 + _BYTES["image"]) * pixels
    native = math.prod(grid_of(config, config.reduction.pixel_scale).pixel_shape)
    fine = math.prod(grid_of(config, config.highres.pixel_scale).pixel_shape)
    measured = fine if config.photometry.method == "yang2021" else native
    # mosaics on both grids; model and residual
    planes = native + fine + measured
    n_bands, n_sets = len(config.exposures.filters), len(config.fit.sets)
    total += n_bands * (_BYTES["mosaic"] * planes + _BYTES["model"] * measured)
    # pictures of the sources in every band
    total += n_bands * 2 * native
    n_sources = len(study_catalog(config.catalog))
    total += n_sources * (_BYTES["truth"] + _BYTES["fit"] * n_sets)
    shared = _BYTES["prior"] * fine + _BYTES["kernel"] * n_bands + _BYTES["seds"] * n_sources
    return int(len(study_truths(config)) * total + shared)


def check_study(config):
    """
    Refuse what would fail only after hours of work.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration.

    Raises
    ------
    `~miricigale.utils.exceptions.ConfigError`
        If a filter is unknown, the high-resolution image has no PSF, the sky fills the well, or
        fewer than `MIN_SOURCES` sources of the catalog fall in the field.
    """
    known = set(Filter.names())
    unknown = [name for name in config.fit.bands if name not in known]
    if unknown:
        msg = f"[fit] bands has unknown filters {unknown}; 'miricigale filters' lists them"
        raise ConfigError(msg)
    unknown = [name for name in config.exposures.filters if name not in imager_filters()]
    if unknown:
        msg = f"[exposures] filters has {unknown}; known: {list(imager_filters())}"
        raise ConfigError(msg)
    try:
        exposures = study_exposures(config)
    except (KeyError, ValueError) as err:
        msg = f"[exposures] {err.args[0]}"
        raise ConfigError(msg) from err
    for exposure in exposures.values():
        level = background_level(exposure.filter) * config.scene.background_scale
        fill = float(saturation_forecast(exposure, background=level))
        if fill >= 1:
            msg = (
                f"[exposures] {exposure.filter}: the sky fills {100 * fill:.0f} % of the well in "
                f"{exposure.n_groups} groups; take fewer groups and more integrations"
            )
            raise ConfigError(msg)
    catalog = study_catalog(config.catalog)
    wcs = grid_of(config, config.reduction.pixel_scale)
    n_inside = int(np.count_nonzero(wcs.footprint_contains(catalog["sky"])))
    if n_inside < MIN_SOURCES:
        msg = (
            f"[pointing] at RA {config.pointing.ra}, Dec {config.pointing.dec} has {n_inside} of the "
            f"{len(catalog)} sources of {config.catalog.source!r} in its field; at least "
            f"{MIN_SOURCES} are needed"
        )
        raise ConfigError(msg)
    if config.highres == HighresSection():
        # known to have a PSF; the check below takes seconds where it has to be compiled first
        return
    from miricigale.psf import hst_psf

    try:
        hst_psf(config.highres.filter, pixel_scale=config.highres.pixel_scale * u.arcsec)
    except (KeyError, ValueError) as err:
        msg = f"[highres] filter: {err.args[0]}"
        raise ConfigError(msg) from err


def run_study(
    config, folder, *, executor=None, redo=False, until=None, again=None, progress_bar=False
):
    """
    Run all stages of a study in a folder; what stands there and is current is kept.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration; see `~miricigale.workflow.load_config`.
    folder : path-like
        Folder of the products: new, empty, or that of an earlier run.
    executor : `concurrent.futures.Executor`, optional
        Does exposures, bands and fits side by side; an executor of processes is best
        (`~miricigale.utils.parallel.process_pool`). The products are the same bytes.
    redo : bool, optional
        Whether what another configuration made in this folder is done again.
    until, again : str, optional
        A stage or a pattern of units (``"mosaics"``, ``"fits:agn20/*"``): only these and what they need
        are done; these are done again.
    progress_bar : bool, optional
        Whether progress is shown.

    Returns
    -------
    report : `pathlib.Path`
        The HTML report; with ``until`` it may not be there yet.

    Raises
    ------
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder holds what another configuration made, and ``redo`` is False.
    `~miricigale.utils.exceptions.DataError`
        If the folder is another's, in use, or on a disk that is too full.
    `~miricigale.utils.exceptions.ConfigError`, KeyError, ValueError
        If the configuration names what does not exist or leaves nothing to do.
    """
    check_study(config)
    runner = StudyRunner(
        config,
        folder,
        study_stages,
        executor=executor,
        redo=redo,
        until=until,
        again=again,
        disk=disk_use(config),
        progress_bar=progress_bar,
    )
    return runner.run().path("report/index.html")
