"""Errors of the bands of a catalog, measured on the catalog itself, with or without known redshifts."""

import dataclasses
import itertools

import numpy as np
from astropy.table import vstack

from miricigale.filters.catalog_files import MappedRows
from miricigale.fitting.catalogs.streaming import row_pieces
from miricigale.fitting.data.likelihood import PhotometryReader, flux_columns, table_of_fluxes
from miricigale.fitting.data.template_error import TemplateError, pivots
from miricigale.fitting.grid.node_fluxes import flux_moments
from miricigale.fitting.posterior.priors import known_redshifts
from miricigale.fitting.results.pulls import without_warnings
from miricigale.fitting.survey.band_errors import (
    MIN_PREDICTING_BANDS,
    MIN_SIGNAL,
    long_instruments,
    measure_bands,
)
from miricigale.fitting.survey.survey import (
    SurveyCalibration,
    bands_in_catalog,
    calibrate,
    on_nodes,
    with_calibration,
)
from miricigale.utils.arrays import nans
from miricigale.utils.content_hash import content_sha256
from miricigale.utils.exceptions import OtherResultsError
from miricigale.utils.files import make_folder
from miricigale.utils.named_values import places, rows_of
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.random import check_seed, stream
from miricigale.utils.units import WAVE

#: Largest number of sources that are fitted to measure the bands.
MAX_SOURCES = 500
#: Largest number of them chosen because long bands such as MIRI's should detect them.
_MAX_LONG_SOURCES = 250
#: Sources below which nothing is measured.
MIN_SOURCES = 100
#: Bands of S/N above 5 that a source is to have.
_MIN_BANDS = 5
#: File of what was measured, in the folder of the results.
FILE_NAME = "calibration.ecsv"
#: Turns: zero points change what the other bands predict, by 1 to 2.5 % in the second turn and little after.
_TURNS = 2


class SourceSample:
    """
    Sources of a catalog that say how large the errors of its bands are, chosen from pieces of it.

    They have S/N above 5 in five of the bands that predict the others (in all if these are four). Of 500, half are
    sources that bands of `~miricigale.fitting.survey.band_errors.long_instruments` should detect: a flux above
    five times their error in the longest of the other bands. The choice is random by the number of the row, so
    that neither pieces nor workers change it.

    Parameters
    ----------
    bands : list of str
        Bands of the catalog that are fitted.
    redshift_range : tuple of float
        Least and largest known redshift that is of use.
    seed : int
        Of the choice.
    """

    def __init__(self, bands, redshift_range, seed):
        self.bands = list(bands)
        long = list(itertools.chain.from_iterable(long_instruments(bands)))
        wave = dict(zip(self.bands, pivots(self.bands).to_value(WAVE), strict=True))
        predicting = [band for band in self.bands if band not in long]
        #: Bands that predict the others, by wavelength.
        self.predicting = sorted(predicting, key=wave.get)
        self._long = places(long, self.bands)
        self._short = places(self.predicting, self.bands)
        self._range = redshift_range
        self._random = stream(seed, "calibration of bands")
        zero = dict.fromkeys(self.bands, 0.0)
        self._reader = PhotometryReader(tuple(self.bands), tuple(self.bands), zero, zero, 1)
        self._columns = None
        self._nodes = None
        self._n_rows = 0

    def add(self, table, *, redshift=None, redshift_prior=None):
        """
        Add the next rows of the catalog.

        Parameters
        ----------
        table : `~astropy.table.QTable`
            Photometry under our names.
        redshift : str or array_like, optional
            Known redshifts; sources without one are left out.
        redshift_prior : tuple of array_like, optional
            Redshifts, and densities at each: of all of these rows, or row by row.
        """
        n = len(table)
        data = self._reader.read(table)
        key = self._random.random(n)
        row = np.arange(self._n_rows, self._n_rows + n)
        self._n_rows += n
        in_use = data.used
        signal = data.measured & (data.flux > MIN_SIGNAL * data.flux_err)
        n_signal = signal[:, self._short].sum(axis=1)
        eligible = n_signal >= min(_MIN_BANDS, len(self._short))
        columns = {
            "row": row,
            "key": key,
            "flux": np.where(in_use, data.flux, np.nan),
            "flux_err": np.where(in_use, data.flux_err, np.nan),
            "limit": data.limit,
            "long": self._seen_by_long_bands(data),
        }
        if redshift is not None:
            known_z = known_redshifts(table, redshift)
            eligible &= (known_z >= self._range[0]) & (known_z <= self._range[1])
            columns["redshift"] = known_z
        if redshift_prior is not None:
            self._nodes, density = redshift_prior
            density = np.asarray(density, dtype=float)
            columns["density"] = np.broadcast_to(density, (n, density.shape[-1]))
        columns = rows_of(columns, eligible)
        if self._columns is not None:
            columns = {k: np.concatenate([self._columns[k], v]) for k, v in columns.items()}
        # all others may be needed, if long bands detect no more sources
        long, short_only = self._by_key(columns)
        rows_to_keep = np.sort(np.concatenate([long, short_only[:MAX_SOURCES]]))
        self._columns = rows_of(columns, rows_to_keep)

    def _seen_by_long_bands(self, data):
        """Find rows whose flux in the longest of the other bands is above five times the error of a long band."""
        flux = nans(len(data))
        for i in self._short:
            flux = np.where(data.measured[:, i], data.flux[:, i], flux)
        is_detectable = flux[:, None] > MIN_SIGNAL * data.flux_err[:, self._long]
        return np.any(is_detectable & data.measured[:, self._long], axis=1)

    @staticmethod
    def _by_key(columns):
        """Sort rows by key: those that long bands detect, at most 250, and all others, two arrays of int."""
        order = np.argsort(columns["key"], kind="stable")
        long = order[columns["long"][order]][:_MAX_LONG_SOURCES]
        return long, order[~np.isin(order, long)]

    def _chosen(self, name):
        """Select a column for the sources of the sample, in the order of the catalog."""
        long, short_only = self._by_key(self._columns)
        rows = np.concatenate([long, short_only])[:MAX_SOURCES]
        return self._columns[name][np.sort(rows)]

    def __len__(self):
        if self._columns is None:
            return 0
        return min(self._columns["row"].size, MAX_SOURCES)

    @property
    def rows(self):
        """Numbers of the rows in the catalog, ascending: `~numpy.ndarray` of int."""
        return self._chosen("row")

    @property
    def table(self):
        """Photometry of the sources: `~astropy.table.QTable`, with the row numbers as ids."""
        return table_of_fluxes(
            self.rows,
            self.bands,
            self._chosen("flux"),
            self._chosen("flux_err"),
            self._chosen("limit"),
        )

    @property
    def redshift(self):
        """Known redshifts of the sources, or None."""
        if "redshift" in self._columns:
            return self._chosen("redshift")
        return None

    @property
    def redshift_prior(self):
        """Redshifts, and their densities for each source, or None."""
        if "density" in self._columns:
            return self._nodes, self._chosen("density")
        return None

    def photometry(self):
        """Read fluxes and errors as in the catalog: `~miricigale.fitting.data.likelihood.FitData`."""
        return self._reader.read(self.table)


@takes_other_keywords
def calibrate_bands(
    fitter,
    photometry,
    *,
    redshift=None,
    redshift_prior=None,
    name="calibration of bands",
    seed=0,
    executor=None,
):
    """
    Measure errors, zero points and shares of wrong fluxes of the bands of a catalog on the catalog itself.

    No redshifts have to be known. Up to 500 sources are fitted on the nodes of the grid, without bands of
    instruments that have none below 5 um, such as MIRI's. The fit predicts these bands, and each other band with
    its own flux taken out (`~miricigale.fitting.survey.band_errors.left_out_predictions`). What is measured at
    rest wavelengths of starlight is compared with that: the greatest posterior of a factor of the errors, a part
    of the flux, a share of wrong fluxes and a zero point
    (`~miricigale.fitting.survey.band_errors.estimate_band_errors`). A second turn has the zero points and
    errors of the first. The median of the zero points is 1, for masses take up a common factor; MIRI's stay at 1.

    Where a band has no such fluxes, or the catalog fewer than 100 such sources, the errors are those of the prior:
    for MIRI 3.3 times those of the catalog and 15 % of the flux, for others 1 and 2 %.

    Parameters
    ----------
    fitter : `BayesFitter`
        On a grid. Priors and errors of models are those of its calibration, if it has one.
    photometry : `~astropy.table.QTable`
        As for `BayesFitter.fit`.
    redshift, redshift_prior : optional
        As for `BayesFitter.fit`: known redshifts are used.
    name : str, optional
        What results call it.
    seed : int, optional
        Of the choice of sources.
    executor : `concurrent.futures.Executor`, optional
        As for `BayesFitter.fit`.

    Returns
    -------
    calibration : `SurveyCalibration`
        That of the fitter with the measured bands, for ``BayesFitter(..., calibration=calibration)``.

    Raises
    ------
    ValueError
        If the fitter has no grid, or errors of the models that differ between bands and no calibration.

    References
    ----------
    Hogg, Bovy & Lang 2010, arXiv:1008.4686.

    Cook & Weisberg 1982, Residuals and Influence in Regression, chapter 2.

    Examples
    --------
    >>> from miricigale.fitting import calibrate_bands
    >>> calibration = calibrate_bands(fitter, photometry)  # doctest: +SKIP
    >>> print(calibration.summary())  # doctest: +SKIP
    >>> results = fitter.replace(calibration=calibration).fit(photometry)  # doctest: +SKIP
    """
    check_that(fitter.grid is not None, "fitter", "one with a grid", fitter.engine)
    with without_warnings():
        # the fit of the catalog warns of it
        table = fitter._table_of(photometry)
    sample = sample_of(fitter, table.colnames, check_seed(seed))
    sample.add(table, redshift=redshift, redshift_prior=redshift_prior)
    return calibrate_sample(fitter, sample, name=name, executor=executor)


def sample_of(fitter, columns, seed):
    """Make an empty `SourceSample` for a fitter and a catalog with these columns."""
    bands = bands_in_catalog(fitter, columns)
    return SourceSample(bands, (fitter.grid.redshift[0], fitter.grid.redshift[-1]), seed)


def calibrate_sample(fitter, sample, *, name, executor):
    """Do what `calibrate_bands` does, with sources that were chosen."""
    # scores are of the sources that its errors of models and priors were measured on
    first = dataclasses.replace(_calibration_of(fitter), name=name, scores=None)
    calibration = first.with_prior_errors(sample.bands)
    if len(sample) < MIN_SOURCES or len(sample.predicting) < MIN_PREDICTING_BANDS:
        return calibration
    options = {"redshift": sample.redshift, "redshift_prior": sample.redshift_prior}
    predicting = on_nodes(fitter).replace(filters=sample.predicting, outliers=None)
    data = sample.photometry()
    table = sample.table
    for _ in range(_TURNS):
        with without_warnings():
            moments = flux_moments(
                with_errors_of(predicting, calibration), table, executor=executor, **options
            )
        error = calibration.template_error
        errors = measure_bands(moments, moments.redshift, data, sample.bands, error)
        calibration = first.with_band_errors(errors)
    return calibration


def with_errors_of(fitter, calibration):
    """Return a fitter with the errors of a calibration in place of its own."""
    return fitter.replace(calibration=calibration, model_error=None, template_error=None)


def _calibration_of(fitter):
    """Return the calibration of a fitter, or one without bands that has its errors of models."""
    if fitter.calibration is not None:
        return fitter.calibration
    error = fitter.backend.template_error
    if error is None:
        parts = set(fitter._reader.model_error.values())
        wanted = "with a calibration, a template error or one model error for all bands"
        check_that(len(parts) == 1, "fitter", wanted, f"model errors of {sorted(parts)}")
        error = TemplateError([1.0] * WAVE, list(parts))
    return SurveyCalibration.without_bands("", error)


def calibrate_file(fitter, rows, output, *, column=None, options):
    """
    Return a fitter with the errors of the bands of a catalog on disk, measured on it or read from a file.

    They are kept in ``calibration.ecsv``, whose name has a checksum of the catalog, of its units and redshifts,
    and of the models.

    Parameters
    ----------
    fitter : `BayesFitter`
        On a grid.
    rows : `~miricigale.utils.row_files.RowFile`
        The catalog.
    output : `~pathlib.Path`
        Folder of the results.
    column : str, optional
        Column of known redshifts for `calibrate`; without it `calibrate_bands` is done.
    options : dict
        Of `miricigale.fitting.fit_file`: ``redshift``, ``redshift_prior``, ``flux_unit``, ``hdu``, ``resume`` and
        ``executor`` are used.

    Returns
    -------
    fitter : `BayesFitter`
        The same with the calibration in place of its errors, and of its priors with ``column``.

    Raises
    ------
    `~miricigale.utils.exceptions.OtherResultsError`
        If the folder has a calibration of another fit and ``resume`` is not False.
    """
    path = output / FILE_NAME
    name = _name_of(fitter, rows, column, options)
    if path.exists() and options.get("resume", True):
        calibration = SurveyCalibration.read(path)
        if calibration.name != name:
            msg = f"{output} holds a calibration of another fit: {calibration.name!r} in place of {name!r}"
            raise OtherResultsError(msg, "resume=False to replace it")
    else:
        if column is None:
            calibration = _bands_of_file(fitter, rows, name, options)
        else:
            calibration = _redshifts_of_file(fitter, rows, column, name, options)
        make_folder(output)
        calibration.write(path, overwrite=True)
    if column is None:
        return with_errors_of(fitter, calibration)
    return with_calibration(fitter, calibration)


def _name_of(fitter, rows, column, options):
    """Name a calibration: the file, how it was measured, and a checksum of all that it follows from."""
    map_settings = None
    if isinstance(rows, MappedRows):
        map_settings = rows.map.settings()
    content = {
        "catalog": rows.sha256,
        "map": map_settings,
        "hdu": options.get("hdu"),
        "unit": str(options.get("flux_unit")),
        "redshift": options.get("redshift"),
        "redshift_prior": options.get("redshift_prior"),
        "models": fitter.backend.content,
        "settings": fitter.settings(),
    }
    checksum = content_sha256(content)[:8]
    if column is not None:
        return f"{rows.path.name} by {column} ({checksum})"
    models = ""
    if fitter.calibration is not None:
        models = f"{fitter.calibration.name}, "
    return f"{models}bands of {rows.path.name} ({checksum})"


def _take_rows(fitter, rows, options):
    """Return a function of the number of a piece: its table, with units, and the redshift options of `fit`."""
    redshift_options = {name: options.get(name) for name in ("redshift", "redshift_prior")}
    fluxes = set(flux_columns(fitter.bands))
    return row_pieces(rows, redshift_options, options.get("flux_unit"), fluxes, fitter.bands)


def _bands_of_file(fitter, rows, name, options):
    """Calibrate the bands of a catalog on disk, of which one piece is in memory at a time."""
    take = _take_rows(fitter, rows, options)
    sample = sample_of(fitter, rows.colnames, seed=0)
    for i in range(rows.n_chunks):
        table, redshift_options = take(i)
        sample.add(table, **redshift_options)
    return calibrate_sample(fitter, sample, name=name, executor=options.get("executor"))


def _redshifts_of_file(fitter, rows, column, name, options):
    """Calibrate by the sources of known redshift of a catalog on disk."""
    take = _take_rows(fitter, rows, options | {"redshift": None, "redshift_prior": None})
    tables = []
    for i in range(rows.n_chunks):
        table, _ = take(i)
        tables.append(table[np.isfinite(known_redshifts(table, column))])
    table = vstack(tables, metadata_conflicts="silent")
    executor = options.get("executor")
    with without_warnings():
        # the fit of the catalog warns of it
        return calibrate(fitter, table, redshift=column, name=name, executor=executor)


def measured_calibration(results):
    """
    Find the calibration that was measured on a catalog and that its results have.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResultsFiles`
        Results in a folder.

    Returns
    -------
    calibration : `SurveyCalibration` or None
        None if they have another one, or none.
    """
    path = results.path / FILE_NAME
    name = results.job["settings"].get("calibration")
    if name is None or not path.exists():
        return None
    calibration = SurveyCalibration.read(path)
    if calibration.name == name:
        return calibration
    return None
