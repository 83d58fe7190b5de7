"""Fits of a catalog of photometry in a file, with the models of Yang et al. 2021 or of surveys."""

import dataclasses
import logging
from pathlib import Path

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


def fit_catalog(
    path,
    output,
    *,
    axes="fit",
    models=None,
    model_error=None,
    outliers=None,
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
        `miricigale.fitting.TemplateError.survey`, which is then the default.
    outliers : float or dict of str to float, optional
        Prior fraction of wrong fluxes; see `miricigale.fitting.BayesFitter`.
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names and units of the catalog; the name of a survey, or a file: TOML, or a translate file of EAZY.
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
        raise argument_error("photometry", f"a table with {wanted}", f"columns {list(names)}")
    # heavy imports only after the file was checked
    from miricigale.fitting import BayesFitter, TemplateError, fit_file
    from miricigale.sed import SEDModel
    from miricigale.sed.components import GalacticExtinction

    unused = unused_bands(rows.chunk(0), bands)
    if unused:
        why = "as their names ('miricigale filters') or errors are missing"
        msg = f"bands of the photometry are not fitted, {why}: {', '.join(unused)}"
        warn(msg, FitWarning)
    error, least = None, 0.1
    if axes == "survey":
        model, nodes = SEDModel.survey(), SEDModel.survey_axes()
        if model_error is None:
            error, least = TemplateError.survey(), 0.0
    elif axes == "far-infrared":
        model, nodes = SEDModel.survey(), SEDModel.survey_axes(axes)
    else:
        model, nodes = SEDModel.yang2021(), SEDModel.yang2021_axes(axes)
    if models is not None:
        model, nodes = models(bands)
    elif error is not None:
        part = 100 * error.error.min(), 100 * error.error.max()
        text = "errors of the models: %.0f to %.0f %% of the flux by rest wavelength, measured on sources"
        log.warning(f"{text} of CEERS (TemplateError.survey)", *part)
    if ebv and isinstance(model, SEDModel):
        dust = GalacticExtinction(ebv_galactic=ebv, beyond="transparent")
        model = SEDModel([*model.components, dust])
    part = least if model_error is None else model_error
    fitter = BayesFitter(
        model, bands, axes=nodes, template_error=error, model_error=part, outliers=outliers
    )
    options |= {"catalog_map": catalog_map, "hdu": hdu, "chunk_rows": chunk_rows}
    return fit_file(fitter, path, output, **options)
