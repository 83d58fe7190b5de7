"""The study as one call."""

import collections
from pathlib import Path

import numpy as np

from miricigale.depth import saturation_forecast
from miricigale.filters import Filter
from miricigale.utils.exceptions import ConfigError
from miricigale.utils.files import file_place
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.workflow.config import check_config
from miricigale.workflow.cost import disk_use
from miricigale.workflow.engine.runner import StudyRunner
from miricigale.workflow.options import of_option
from miricigale.workflow.sections import HighresSection
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.exposures import study_background, study_exposures
from miricigale.workflow.stages.grids import grid_of
from miricigale.workflow.stages.inputs import existing_bands, study_catalog
from miricigale.workflow.stages.sample import good_redshifts
from miricigale.workflow.truths import CATALOG
from miricigale.workflow.warmup import compile_missing

#: Sources that a field must have for an error function to be measured.
MIN_SOURCES = 3


@takes_other_keywords
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
        If a filter is unknown, a file is missing, the high-resolution image has no PSF, the sky fills the
        well, or fewer than `MIN_SOURCES` sources of the catalog fall in the field.

    Examples
    --------
    >>> from miricigale.workflow import check_study, load_config
    >>> check_study(load_config("goodss", quick=True))
    """
    check_config(config)
    for key in ("cutouts", "cutouts_psf"):
        path = getattr(config.perturb, key)
        good = not path or Path(file_place(path)[0]).expanduser().is_file()
        config.check(good, f"perturb.{key}", "must be a file")
    unknown = sorted(set(existing_bands(config)).difference(Filter.names()))
    config.check(
        not unknown, "fit.bands", "must be filters that 'miricigale filters' lists", unknown
    )
    with of_option("[exposures]", KeyError, ValueError):
        exposures = study_exposures(config)
    counts = collections.Counter(exposure.filter for exposure in exposures.values())
    sparse = [name for name, n in counts.items() if n < 3]
    good = config.reduction.background != "dithers" or not sparse
    wanted = "must have three exposures of each filter to be 'dithers'"
    config.check(good, "reduction.background", wanted, sparse)
    for exposure in exposures.values():
        with of_option("[scene] background:", KeyError, ValueError, ImportError):
            level = study_background(config, exposure.filter)
        fill = float(saturation_forecast(exposure, background=level))
        if fill >= 1:
            msg = (
                f"[exposures] {exposure.filter}: the sky fills {100 * fill:.0f} % of the well in "
                f"{exposure.n_groups} groups; take fewer groups and more integrations"
            )
            raise ConfigError(msg)
    catalog = study_catalog(config.catalog)
    good_redshifts(catalog, config.fit.redshift_quality)
    if CATALOG in config.sed.frac_agn:
        from miricigale.workflow.stages.truth import catalog_fractions

        catalog_fractions(catalog)
    wcs = grid_of(config, config.reduction.pixel_scale)
    n_inside = int(np.count_nonzero(wcs.footprint_contains(catalog["sky"])))
    if n_inside < MIN_SOURCES:
        msg = (
            f"[pointing] at RA {config.pointing.ra}, Dec {config.pointing.dec} has {n_inside} of the "
            f"{len(catalog)} sources of {config.catalog.source!r} in its field; at least {MIN_SOURCES} are needed"
        )
        raise ConfigError(msg)
    # that of the default is known to have a PSF; to make one may take seconds
    if config.highres != HighresSection():
        from miricigale.workflow.stages.images import prior_psf

        with of_option("[highres] filter:", KeyError, ValueError):
            prior_psf(config)


@takes_other_keywords(options_of=(StudyRunner,))
def run_study(config, folder, **options):
    """
    Run all stages of a study in a folder; what stands there and is current is kept.

    Parameters
    ----------
    config : `~miricigale.workflow.StudyConfig`
        The configuration; see `~miricigale.workflow.load_config`.
    folder : path-like
        Folder of the products: new, empty, or that of an earlier run.
    **options
        ``executor``, ``redo``, ``until``, ``again`` and ``progress_bar`` of `~miricigale.workflow.StudyRunner`; an
        executor of processes is best (`~miricigale.utils.parallel.process_pool`). The products are the
        same bytes.

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

    Examples
    --------
    >>> from miricigale.workflow import load_config, run_study  # doctest: +SKIP
    >>> config = load_config("goodss", quick=True)  # doctest: +SKIP
    >>> run_study(config, "goodss-quick", until="mosaics")  # doctest: +SKIP
    """
    check_study(config)
    options = {"disk": disk_use(config), "prepare": compile_missing, **options}
    return StudyRunner(config, folder, study_stages, **options).run().path("report/index.html")
