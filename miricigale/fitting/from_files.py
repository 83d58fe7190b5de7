"""Fits of a catalog of photometry in a file, with the models of Yang et al. 2021 or of surveys."""

import dataclasses
import logging
from pathlib import Path

import numpy as np
from astropy.table import vstack

from miricigale.filters.catalog_files import MappedRows, as_catalog_map
from miricigale.filters.photometry_table import band_columns
from miricigale.fitting.likelihood import is_filter, unused_bands
from miricigale.utils.exceptions import FitWarning, argument_error, warn
from miricigale.utils.row_files import open_rows
from miricigale.utils.tables import error_column

log = logging.getLogger(__name__)


def open_catalog(path, chunk_rows, *, hdu=None, catalog_map=None, flux_unit=None):
    """Open a catalog by rows (`~miricigale.utils.row_files.RowFile`), under our names or those of a map."""
    rows = open_rows(path, chunk_rows, hdu=hdu)
    if catalog_map is not None:
        known = as_catalog_map(catalog_map)
        if flux_unit is not None:
            known = dataclasses.replace(known, units={"flux": flux_unit, **known.units})
        return MappedRows(rows, known)
    rows.rename(band_columns(rows.colnames, Path(path).name))
    return rows


def give_units(table, fluxes, unit):
    """Give flux columns that have no unit one; None gives none."""
    for name in fluxes.intersection(table.colnames) if unit is not None else ():
        if table[name].unit is None:
            table[name].unit = unit


def fit_catalog(
    path,
    output,
    *,
    axes="fit",
    models=None,
    model_error=None,
    outliers=None,
    calibration=None,
    calibrate=None,
    catalog_map=None,
    ebv=0.0,
    interpolate=200,
    agn_error=0.0,
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
        ``<filter>_err`` by any usual name of the filter, or with columns that ``catalog_map`` gives these names.
    output : path-like
        Folder of the results.
    axes : {"fit", "quick", "survey", "far-infrared"}, optional
        Model grid; see `miricigale.sed.yang2021_axes` and `miricigale.sed.survey_axes`.
    models : callable, optional
        Function of the bands (a list of str) that returns the `~miricigale.sed.SEDModel` and its axes in place of
        those of ``axes``, or a `~miricigale.sed.ModelGrid` and None; ``axes`` says whose errors are taken then.
    model_error : float, optional
        Relative model error: 0.1 by default; with ``axes="survey"`` it takes the place of
        `miricigale.fitting.SurveyCalibration.survey`, which is then the default.
    outliers : float or dict of str to float, optional
        Prior fraction of wrong fluxes; see `miricigale.fitting.BayesFitter`.
    calibration : `~miricigale.fitting.SurveyCalibration` or path-like, optional
        Zero points, errors and priors, or the file of them. With ``models`` its priors are left out.
    calibrate : str, optional
        Column of known redshifts, with which all of that is measured first: see `miricigale.fitting.calibrate`.
        It is written to ``calibration.ecsv`` in ``output``, from where a resumed fit takes it.
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names and units of the catalog; the name of a survey, or a file: TOML, or a translate file of EAZY.
    ebv : float, optional
        Color excess E(B-V) of the Milky Way, in mag, behind which all models but given grids are put
        (`~miricigale.sed.components.GalacticExtinction`, law of Gordon et al. 2023, none beyond 32 um). For one
        that differs from source to source see `~miricigale.sed.foreground.deredden`.
    interpolate, agn_error : optional
        Models between the nodes for each object (0: nodes alone), and the error of the light of AGN, as in
        `miricigale.fitting.GridSettings`.
    hdu, chunk_rows, **options
        As for `miricigale.fitting.fit_file`, such as ``redshift``, a column of known redshifts, and
        ``resume``.

    Returns
    -------
    results : `~miricigale.fitting.FitResultsFiles`

    Warns
    -----
    `~miricigale.utils.exceptions.FitWarning`
        If the catalog has bands under names that no filter has, or without errors.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no such file, or it cannot be read by rows.
    ValueError
        If no column is a flux in a known filter that has an error.

    Examples
    --------
    >>> from miricigale.fitting import fit_catalog
    >>> results = fit_catalog("catalog.fits", "fits", axes="survey")  # doctest: +SKIP
    >>> results.to_table(["id", "redshift_p50", "mass_p50"])  # doctest: +SKIP
    """
    unit = options.get("flux_unit")
    rows = open_catalog(path, chunk_rows, hdu=hdu, catalog_map=catalog_map, flux_unit=unit)
    names = rows.colnames
    bands = [name for name in names if is_filter(name) and error_column(name) in names]
    if not bands:
        wanted = "columns <filter> and <filter>_err ('miricigale filters' lists the names)"
        raise argument_error("path", f"a table with {wanted}", f"columns {list(names)}")
    # heavy imports only after the file was checked
    from miricigale.fitting import BayesFitter, GridSettings, SurveyCalibration, fit_file
    from miricigale.sed import SEDModel
    from miricigale.sed.components import GalacticExtinction

    unused = unused_bands(rows.chunk(0), bands)
    if unused:
        why = "as their names ('miricigale filters') or errors are missing"
        warn(f"bands of the photometry are not fitted, {why}: {', '.join(unused)}", FitWarning)
    if axes in ("survey", "far-infrared"):
        model, nodes = SEDModel.survey(), SEDModel.survey_axes(axes)
    else:
        model, nodes = SEDModel.yang2021(), SEDModel.yang2021_axes(axes)
    if calibration is None and axes == "survey" and model_error is None:
        calibration = SurveyCalibration.survey()
    elif calibration is not None and not isinstance(calibration, SurveyCalibration):
        calibration = SurveyCalibration.read(calibration)
    if models is not None:
        model, nodes = models(bands)
        calibration = calibration and calibration.without_priors()
    if ebv and isinstance(model, SEDModel):
        dust = GalacticExtinction(ebv_galactic=ebv, beyond="transparent")
        model = SEDModel([*model.components, dust])
    given = {"model_error": model_error, "outliers": outliers, "calibration": calibration}
    given["settings"] = GridSettings(interpolate=interpolate, agn_error=agn_error)
    fitter = BayesFitter(model, bands, axes=nodes, **given)
    if calibrate is not None:
        fitter = _calibrated(fitter, rows, calibrate, Path(output), options)
    if models is None and fitter.calibration is not None:
        error = 100 * fitter.calibration.template_error.error
        text = "calibration of %s: errors of the models %.0f to %.0f %% of the flux, priors of %s"
        named = ", ".join(fitter.calibration.priors) or "nothing"
        log.warning(text, fitter.calibration.name, error.min(), error.max(), named)
    options |= {"catalog_map": catalog_map, "hdu": hdu, "chunk_rows": chunk_rows}
    return fit_file(fitter, path, output, **options)


def _calibrated(fitter, rows, column, output, options):
    """Fitter with the calibration by known redshifts of a catalog, measured unless it is there."""
    from miricigale.fitting.priors import known_redshifts
    from miricigale.fitting.pulls import without_warnings
    from miricigale.fitting.survey import SurveyCalibration, calibrate, with_calibration

    resume, executor = options.get("resume", True), options.get("executor")
    path, name = output / "calibration.ecsv", f"{rows.path.name} by {column} ({rows.sha256[:8]})"
    found = SurveyCalibration.read(path) if resume and path.exists() else None
    if found is None or found.name != name:
        known = []
        for table in map(rows.chunk, range(rows.n_chunks)):
            fluxes = {c for b in fitter.bands for c in (b, error_column(b))}
            give_units(table, fluxes, options.get("flux_unit"))
            known.append(table[np.isfinite(known_redshifts(table, column))])
        table = vstack(known, metadata_conflicts="silent")
        with without_warnings():
            # the fit of the catalog warns of it
            found = calibrate(fitter, table, redshift=column, name=name, executor=executor)
        output.mkdir(parents=True, exist_ok=True)
        found.write(path, overwrite=True)
    return with_calibration(fitter, found)
