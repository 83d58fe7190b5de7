"""What the smaller commands of the command line do, for use in code too."""

import logging
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.filters import Filter
from miricigale.filters.catalog_files import MappedRows, as_catalog_map
from miricigale.utils.exceptions import MiricigaleWarning, argument_error
from miricigale.utils.row_files import open_rows
from miricigale.utils.tables import error_column

__all__ = ["filter_table", "fit_catalog", "plan_table", "write_plan"]

log = logging.getLogger(__name__)


def filter_table(pattern=""):
    """
    The filters whose name holds a text.

    Parameters
    ----------
    pattern : str, optional
        Part of the name; all if empty.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``name``, ``pivot`` and ``width`` (um).
    """
    names = [name for name in Filter.names() if pattern.lower() in name]
    filters = [Filter.from_name(name) for name in names]
    return QTable(
        {
            "name": np.array(names, dtype=str),
            "pivot": u.Quantity([f.pivot for f in filters], u.um) if names else [] * u.um,
            "width": u.Quantity([f.width for f in filters], u.um) if names else [] * u.um,
        }
    )


def plan_table(*, quick=False):
    """
    The CEERS exposures: time, filling of the well by the sky, limits (5 sigma, AB).

    Parameters
    ----------
    quick : bool, optional
        Whether of the quick exposures.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each band. Three limits of point sources: ``limit_etc``, the exposure time
        calculator's scaled by the root of the time; ``limit``, of these exposures by
        `~miricigale.photometry.sensitivity` with the residual pattern
        (``residual="etc"``); ``limit_proposal``, of the survey's proposal.
    """
    from astropy.coordinates import SkyCoord

    from miricigale.depth import proposal_limit, saturation_forecast, scaled_limit, sensitivity
    from miricigale.instrument import ceers_exposures, psf_fwhm

    exposures = ceers_exposures(SkyCoord(0 * u.deg, 0 * u.deg), 0 * u.deg, quick=quick)
    rows = []
    for name in dict.fromkeys(e.filter for e in exposures):
        mine = [e for e in exposures if e.filter == name]
        first, time = mine[0], u.Quantity([e.exposure_time for e in mine]).sum()
        limit = sensitivity(
            name,
            time,
            n_sigma=5,
            residual="etc",
            n_groups=first.n_groups,
            n_dithers=len(mine),
            readout=first.readout,
            subarray=first.subarray,
        )
        rows.append(
            {
                "filter": name,
                "groups": first.n_groups,
                "integrations": first.n_integrations,
                "dithers": len(mine),
                "time": np.round(time.to(u.s), 1),
                "sky_in_well": round(float(saturation_forecast(first)), 3),
                "limit_etc": np.round(scaled_limit(name, time).to(u.ABmag), 2),
                "limit": np.round(limit.to(u.ABmag), 2),
                "limit_proposal": np.round(proposal_limit(name), 2),
                "fwhm": psf_fwhm(name),
            }
        )
    return QTable(rows)


def write_plan(config, folder, *, executor=None, progress_bar=False):
    """
    Work out a plan and write it.

    Parameters
    ----------
    config : `~miricigale.workflow.planning.PlanConfig`
        The plan.
    folder : path-like
        Gets ``plan.html``, ``plan.toml``, ``comparison.ecsv``, ``areas.ecsv`` (with ``[survey] areas``),
        and ``bands-<n>.ecsv`` and ``sources-<n>.ecsv`` of each set of bands, in the order of the
        configuration (0: the existing ones); with ``[images] enabled`` the run in ``images``, its catalog
        ``images.ecsv``, ``images-numbers.ecsv`` and ``images-bands.ecsv``. Files of these names are replaced.
    executor : `concurrent.futures.Executor`, optional
        Threads to fit with; the answer is the same.
    progress_bar : bool, optional
        Whether the progress of the images is shown.

    Returns
    -------
    comparison : `~astropy.table.QTable`
        See `~miricigale.workflow.planning.comparison_table`.
    """
    from miricigale.workflow.planning import Planner, area_table, comparison_table, write_page

    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise argument_error("folder", "a folder, or nothing yet", f"the file {folder}")
    planner = Planner(config, executor=executor)
    plans = planner.compare()
    comparison = comparison_table(planner, plans)
    areas = area_table(planner, planner.divide()) if config.survey.areas else None
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "plan.toml").write_text(config.to_toml(), encoding="utf-8")
    tables = {"comparison": comparison}
    tables |= {} if areas is None else {"areas": areas}
    tables |= {f"sources-{k}": plan.sources for k, plan in enumerate(plans)}
    tables |= {f"bands-{k}": plan.band_table() for k, plan in enumerate(plans) if plan.bands}
    for name, table in tables.items():
        table.write(folder / f"{name}.ecsv", overwrite=True)
    pair = _write_images(planner, plans, folder, progress_bar) if config.images.enabled else None
    write_page(folder / "plan.html", planner, plans, comparison, areas, pair)
    return comparison


def _write_images(planner, plans, folder, progress_bar):
    """Image a plan, and write its numbers beside those of the noise: tables by band and of all."""
    from miricigale.utils.parallel import process_pool, thread_count
    from miricigale.workflow.planning import image_sample, paired_bands, paired_numbers

    n_processes = thread_count(planner.config.plan.threads or None)
    with process_pool(n_processes) as pool:
        imaged = image_sample(planner, folder / "images", executor=pool, progress_bar=progress_bar)
    pair = (
        paired_bands(planner, imaged),
        paired_numbers(planner, plans, planner.compare(measured=imaged.measured), imaged),
    )
    for name, table in zip(("bands", "numbers"), pair, strict=True):
        table.write(folder / f"images-{name}.ecsv", overwrite=True)
    return pair


def fit_catalog(
    path,
    output,
    *,
    axes="fit",
    models=None,
    model_error=None,
    catalog_map=None,
    ebv=0.0,
    hdu=None,
    chunk_rows=10000,
    **options,
):
    """
    Fit a catalog of photometry of any length with the chain of Yang et al. 2021, or that of surveys.

    Parameters
    ----------
    path : path-like
        FITS, ECSV, CSV, VOTable or plain text with ``id`` and, for each band, ``<filter>`` and
        ``<filter>_err``, or with columns that ``catalog_map`` gives these names.
    output : path-like
        Folder of the results.
    axes : {"fit", "quick", "survey"}, optional
        Model grid; see `miricigale.sed.yang2021_axes` and `miricigale.sed.survey_axes`.
    models : callable, optional
        Function of the bands (a list of str) that returns the `~miricigale.sed.SEDModel` and its axes in place of
        those of ``axes``, or a `~miricigale.sed.ModelGrid` and None; ``axes`` says whose errors are taken then.
    model_error : float, optional
        Relative model error: 0.1 by default; with ``axes="survey"`` it takes the place of
        `miricigale.fitting.TemplateError.survey`, which is then the default.
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names and units of the catalog; the name of a survey, or a TOML file.
    ebv : float, optional
        Color excess E(B-V) of the Milky Way, in mag, behind which all models but given grids are put
        (`~miricigale.sed.components.GalacticExtinction`, law of Gordon et al. 2023, none beyond 32 um). For one
        that differs from source to source see `~miricigale.sed.foreground.deredden`.
    hdu, chunk_rows, **options
        As for `miricigale.fitting.fit_file`, such as ``redshift``, a column of known redshifts, and
        ``resume``.

    Returns
    -------
    results : `~miricigale.fitting.FitResultsFiles`

    Warns
    -----
    `~miricigale.utils.exceptions.MiricigaleWarning`
        If the catalog has bands under names that no filter has, or without errors.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or it cannot be read by rows.
    ValueError
        If no column is a flux in a known filter with an error beside it.
    """
    rows = open_rows(path, chunk_rows, hdu=hdu)
    if catalog_map is not None:
        catalog_map = as_catalog_map(catalog_map)
        rows = MappedRows(rows, catalog_map)
    names = rows.colnames
    known = set(Filter.names())
    bands = [
        name
        for name in names
        if (name in known or name.startswith("sedpy.")) and error_column(name) in names
    ]
    if not bands:
        raise argument_error(
            "photometry",
            "a table with columns <filter> and <filter>_err ('miricigale filters' lists the names)",
            f"columns {list(names)}",
        )
    # heavy imports only after the file was checked
    from miricigale.fitting import BayesFitter, TemplateError, fit_file
    from miricigale.fitting.likelihood import unused_bands
    from miricigale.sed import SEDModel
    from miricigale.sed.components import GalacticExtinction

    unused = unused_bands(rows.chunk(0), bands)
    if unused:
        msg = (
            f"bands of the photometry are not fitted, as their names ('miricigale filters') or "
            f"errors are missing: {', '.join(unused)}"
        )
        warnings.warn(msg, MiricigaleWarning, stacklevel=2)
    if axes == "survey":
        model, nodes = SEDModel.survey(), SEDModel.survey_axes()
        error = TemplateError.survey() if model_error is None else None
        errors = {"model_error": model_error or 0.0, "template_error": error}
        if error is not None and models is None:
            log.warning(
                "errors of the models: %.0f to %.0f %% of the flux by rest wavelength, measured on sources "
                "of CEERS (TemplateError.survey)",
                *(100 * np.array([error.error.min(), error.error.max()])),
            )
    else:
        model, nodes = SEDModel.yang2021(), SEDModel.yang2021_axes(axes)
        errors = {"model_error": 0.1 if model_error is None else model_error}
    if models is not None:
        model, nodes = models(bands)
    if ebv and isinstance(model, SEDModel):
        dust = GalacticExtinction(ebv_galactic=ebv, beyond="transparent")
        model = SEDModel([*model.components, dust])
    fitter = BayesFitter(model, bands, axes=nodes, **errors)
    options |= {"catalog_map": catalog_map, "hdu": hdu, "chunk_rows": chunk_rows}
    return fit_file(fitter, path, output, **options)
