"""The study as one call."""

import math

from miricigale.workflow.runner import check_disk, run_stages
from miricigale.workflow.stages import study_stages
from miricigale.workflow.stages.images import grid_of, study_exposures

__all__ = ["disk_use", "run_study"]


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
    total = 20_000_000  # tables, fits, report
    for exposure in exposures.values():
        pixels = math.prod(exposure.shape)
        # rate and cal: data, error, flags (32 bits each) and mask
        total += 2 * 13 * pixels
        if config.run.keep_level1b:
            # counts, and the planes that only a simulation knows
            total += 2 * pixels * exposure.n_groups * exposure.n_integrations + 8 * pixels
    native = math.prod(grid_of(config, config.reduction.pixel_scale).pixel_shape)
    fine = math.prod(grid_of(config, config.highres.pixel_scale).pixel_shape)
    # mosaic, model and residual; mosaic on the fine grid
    total += len(config.exposures.filters) * 9 * (3 * native + fine)
    return total + 9 * fine + 13 * fine


def run_study(config, folder, *, progress_bar=False):
    """
    Run all stages of a study in a folder; what stands there and is current is kept.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration; see `~miricigale.workflow.load_config`.
    folder : path-like
        Folder of the products: new, empty, or that of an earlier run.
    progress_bar : bool, optional
        Whether progress bars are shown.

    Returns
    -------
    report : `pathlib.Path`
        The HTML report.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the folder is another's, in use, or on a disk that is too full.
    `~miricigale.utils.exceptions.ConfigError`, KeyError, ValueError
        If the configuration names what does not exist or leaves nothing to do.
    """
    check_disk(folder, disk_use(config))
    store = run_stages(config, folder, study_stages(), progress_bar=progress_bar)
    return store.path("report/index.html")
