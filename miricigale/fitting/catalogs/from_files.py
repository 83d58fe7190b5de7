"""Fits of a catalog of photometry in a file, by default with models of real galaxies and their calibration."""

import logging
from pathlib import Path

from miricigale.fitting.catalogs.catalog_rows import open_catalog
from miricigale.fitting.data.fitted_bands import bands_with_errors, warn_of_unfitted
from miricigale.fitting.data.likelihood import unused_bands
from miricigale.fitting.data.nuclei import nucleus_columns
from miricigale.utils.files import is_path
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords

log = logging.getLogger(__name__)


@takes_other_keywords
def fit_catalog(
    path,
    output,
    *,
    axes="survey",
    models=None,
    priors=None,
    model_error=None,
    outliers=None,
    calibration="default",
    calibrate=True,
    catalog_map=None,
    ebv=0.0,
    interpolate=600,
    agn_error=0.0,
    agn_bins=None,
    nuclei=False,
    nuclear_stars=0.1,
    hdu=None,
    chunk_rows=1000,
    **options,
):
    """
    Fit a catalog of photometry of any length, by default with models of real galaxies and their calibration.

    The fits are those of ``BayesFitter(bands, axes=axes, calibration=...)`` for the same catalog, with what
    `miricigale.fitting.calibrate_bands` measures on it, number for number. What is fitted is logged: errors of
    bands, models, bands, and errors with priors.

    Parameters
    ----------
    path : path-like
        FITS, ECSV, CSV, VOTable or plain text with ``id`` and, for each band, ``<filter>`` and
        ``<filter>_err`` by any usual name of the filter, or with columns that ``catalog_map`` gives these names.
    output : path-like
        Folder of the results.
    axes : {"survey", "far-infrared", "yang2021", "yang2021-quick"}, optional
        Model grid: of real galaxies, without or with far-infrared bands (`miricigale.sed.survey_axes`), or that of
        the simulations of Yang et al. 2021, or a thinner one (`miricigale.sed.yang2021_axes`), which have no lines
        and no galaxies without dust.
    models : callable, optional
        Function of the bands (a list of str) that returns the `~miricigale.sed.SEDModel` and its axes in place of
        those of ``axes``, or a `~miricigale.sed.ModelGrid` and None; ``axes`` says whose errors are taken then.
    priors : dict, optional
        Priors of parameters and redshift, as for `miricigale.fitting.BayesFitter`, in place of those of the
        calibration.
    model_error : float, optional
        Relative model error, in place of the calibration by default; 0.1 where there is no calibration.
    outliers : float or dict of str to float, optional
        Prior fraction of wrong fluxes; see `miricigale.fitting.BayesFitter`.
    calibration : `~miricigale.fitting.SurveyCalibration`, path-like or None, optional
        Zero points, errors and priors, or the file of them; None: none. By default
        `miricigale.fitting.SurveyCalibration.survey` with ``axes="survey"`` and none with others. With ``models``
        its priors are left out.
    calibrate : bool or str, optional
        Whether errors, zero points and shares of wrong fluxes of the bands are measured on the catalog first,
        without known redshifts: see `miricigale.fitting.calibrate_bands`. Not where ``calibration``,
        ``model_error`` or ``models`` is given, and not with the grids of simulations. A column of known redshifts:
        with these all of the calibration is measured, see `miricigale.fitting.calibrate`. False or None: errors of
        bands are those of the catalog. What was measured is logged and written to ``calibration.ecsv`` in
        ``output``, from where a resumed fit takes it.
    catalog_map : `~miricigale.filters.CatalogMap`, str or path-like, optional
        Names and units of the catalog; the name of a survey, or a file: TOML, or a translate file of EAZY.
    ebv : float, optional
        Color excess E(B-V) of the Milky Way, in mag, behind which all models but given grids are put
        (`~miricigale.sed.components.GalacticExtinction`, law of Gordon et al. 2023, none beyond 32 um). For one
        that differs from source to source see `~miricigale.sed.foreground.deredden`.
    interpolate, agn_error, agn_bins : optional
        Models between the nodes for each object (0: nodes alone), the error of the light of AGN, and bins in
        which posteriors of AGN are kept, as in `miricigale.fitting.GridSettings`.
    nuclei : bool or "whole", optional
        Whether fluxes of the point in the center of galaxies (columns ``<filter>_flux_point`` or
        ``<filter>_nucleus``) are fitted as those of AGN, or ``"whole"``: of all of the light, as with
        `~miricigale.fitting.BayesFitter`.
    nuclear_stars : float, optional
        With these: part of the light of hosts that may be such a point, as in `miricigale.fitting.GridSettings`.
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
    >>> results = fit_catalog("catalog.fits", "fits")  # doctest: +SKIP
    >>> results.to_table(["id", "redshift_p50", "mass_p50"])  # doctest: +SKIP
    """
    unit = options.get("flux_unit")
    rows = open_catalog(path, chunk_rows, hdu=hdu, catalog_map=catalog_map, flux_unit=unit)
    bands = bands_with_errors(rows.colnames, "path")
    wanted = "a catalog with columns <filter>_flux_point and <filter>_flux_point_err for 'nuclei'"
    check_that(not nuclei or nucleus_columns(rows.colnames), "path", wanted, f"{rows.colnames}")
    # heavy imports only after the file was checked
    from miricigale.fitting import BayesFitter, GridSettings, fit_file
    from miricigale.fitting.fitter_text import statement
    from miricigale.sed import SEDModel
    from miricigale.sed.components import GalacticExtinction
    from miricigale.sed.presets import grid_name

    unused = unused_bands(rows.chunk(0), bands)
    warn_of_unfitted(unused)
    axes = grid_name(axes)
    if models is None:
        model = SEDModel.for_axes(axes)
        nodes = axes
    else:
        model, nodes = models(bands)
    if ebv and isinstance(model, SEDModel):
        model = model.with_components(GalacticExtinction(ebv_galactic=ebv, beyond="transparent"))
    given_calibration = first_calibration(calibration, axes, model_error)
    if models is not None and given_calibration is not None:
        given_calibration = given_calibration.without_priors()
    fitter = BayesFitter(
        model,
        bands,
        priors=priors,
        axes=nodes,
        model_error=model_error,
        outliers=outliers,
        calibration=given_calibration,
        nuclei=nuclei,
        settings=GridSettings(
            interpolate=interpolate,
            agn_error=agn_error,
            agn_bins=agn_bins,
            nuclear_stars=nuclear_stars,
        ),
    )
    calibrate = calibrates_itself(calibrate, calibration, axes, models, model_error)
    fitter = calibrated(fitter, rows, calibrate, Path(output), options | {"hdu": hdu})
    if models is None:
        for line in statement(fitter, unused):
            log.info(line)
    options |= {"catalog_map": catalog_map, "hdu": hdu, "chunk_rows": chunk_rows}
    return fit_file(fitter, path, output, **options)


def first_calibration(calibration, axes, model_error):
    """
    Choose the calibration before a catalog is measured: given, read from a file, or that of the models.

    Parameters
    ----------
    calibration : `~miricigale.fitting.SurveyCalibration`, path-like, "default" or None
        As for `fit_catalog`.
    axes : str
        Name of the grid.
    model_error : float or None
        Errors that take the place of a calibration by default.

    Returns
    -------
    calibration : `~miricigale.fitting.SurveyCalibration` or None
    """
    from miricigale.fitting.survey.defaults import DEFAULT, chosen_calibration
    from miricigale.fitting.survey.survey import SurveyCalibration

    of_file = is_path(calibration) and calibration != DEFAULT
    if of_file:
        return SurveyCalibration.read(calibration)
    return chosen_calibration(calibration, axes, model_error)


def calibrated(fitter, rows, calibrate, output, options):
    """
    Calibrate a fitter on its catalog, unless `first_calibration` is to be kept.

    Parameters
    ----------
    fitter : `~miricigale.fitting.BayesFitter`
        With the calibration of `first_calibration`.
    rows : `~miricigale.utils.row_files.RowFile`
        The catalog.
    calibrate : str or bool
        Column of known redshifts, or whether the errors of the bands are measured without.
    output : `~pathlib.Path`
        Folder of the results, where what was measured is kept.
    options : dict
        Of `fit_catalog`: ``redshift``, ``redshift_prior``, ``resume``, ``executor``, ``flux_unit``, ``hdu``.

    Returns
    -------
    fitter : `~miricigale.fitting.BayesFitter`
    """
    if calibrate is False:
        return fitter
    from miricigale.fitting.catalogs.catalog_calibration import FILE_NAME, calibrate_file

    # which a long calibration should not come before
    fitter.backend.check_pairs(options.get("pairs"))
    column = None
    if isinstance(calibrate, str):
        column = calibrate
    path = output / FILE_NAME
    if not path.exists() or not options.get("resume", True):
        log.info("measuring the errors of the bands on the catalog")
    fitter = calibrate_file(fitter, rows, output, column=column, options=options)
    log.info("errors of the bands (%s):", path)
    for line in fitter.calibration.summary().splitlines():
        log.info(line)
    return fitter


def calibrates_itself(calibrate, calibration, axes, models, model_error):
    """
    Decide whether the errors of bands are measured on the catalog, or return the column of known redshifts.

    Parameters
    ----------
    calibrate : str, bool or None
        As for `fit_catalog`.
    calibration, axes, models, model_error : optional
        As for `fit_catalog`: errors that are given are taken as they are, and simulations have those of their
        makers.

    Returns
    -------
    calibrate : str or bool

    Raises
    ------
    ValueError
        If ``calibrate`` is something else.
    """
    from miricigale.fitting.survey.defaults import DEFAULT

    if isinstance(calibrate, str):
        return calibrate
    wanted = "True, False, None or a column of known redshifts"
    check_that(
        calibrate is None or isinstance(calibrate, bool), "calibrate", wanted, repr(calibrate)
    )
    is_default = isinstance(calibration, str) and calibration == DEFAULT
    is_default &= models is None and model_error is None
    return bool(calibrate) and is_default and axes in ("survey", "far-infrared")
