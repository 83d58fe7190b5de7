"""Calibration of a survey: priors, errors of models and bands, and zero points, from sources of known redshift."""

import dataclasses
import itertools

import numpy as np
from astropy.table import QTable

from miricigale.evaluation import photoz_metrics
from miricigale.fitting.data.template_error import TemplateError
from miricigale.fitting.posterior.populations import MassFunction, agn_fraction_prior
from miricigale.fitting.posterior.priors import known_redshifts
from miricigale.fitting.results.pulls import without_warnings
from miricigale.fitting.survey.band_errors import (
    long_instruments,
    measure_bands,
    prior_errors,
    prior_of_band,
    relative_zero_points,
)
from miricigale.fitting.survey.calibration import measure_priors, measure_template_error
from miricigale.refdata import locate
from miricigale.utils.arrays import nans, quotient
from miricigale.utils.caching import cached
from miricigale.utils.exceptions import DataError, FitWarning, warn
from miricigale.utils.files import replacing
from miricigale.utils.named_values import convert_values
from miricigale.utils.options import check_names, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import column_texts
from miricigale.utils.table_files import read_table
from miricigale.utils.tables import described_rows, described_table, require_columns
from miricigale.utils.values import value_class

#: Turns of the calibration, each a step of expectation maximization.
_N_TURNS = 6
#: Power by which steps of priors are lengthened (over-relaxation; Salakhutdinov & Roweis 2003).
_OVER_RELAXATION = 2.0
#: Errors of models before any were measured.
_FIRST_MODEL_ERROR = 0.1
#: Smallest number of sources of a half.
_MIN_SOURCES = 50
_NAME = "miricigale survey calibration"
_COLUMNS = column_texts("miricigale.fitting", "bands")
_SCORES = column_texts("miricigale.fitting", "scores")


@value_class
class SurveyCalibration:
    """
    What sources of known redshift say of a survey and of models: for ``calibration`` of `BayesFitter`.

    Parameters
    ----------
    name : str
        What results call it.
    bands : `~astropy.table.QTable`
        A row for each band: ``band``, ``zero_point``, ``error_factor``, ``error_part``, ``outlier``, the share of
        wrong fluxes that fits allow for, and, where it was measured, ``wrong``, the share that was found. Other
        bands are taken as they are.
    template_error : `TemplateError`
        Errors of the models by rest wavelength.
    priors : dict of str to tuple
        Values of parameters of the grid, and their weights.
    mass_function : `MassFunction`, optional
        Prior of mass and redshift.
    scores : `~astropy.table.QTable`, optional
        Redshifts of each half of the sources with what was measured on the other: see `calibrate`.
    errors : dict of str to `~numpy.ndarray`, optional
        Errors of ``template_error`` and of the weights of ``priors``: half of the difference of two halves.

    Examples
    --------
    >>> from miricigale.fitting import SurveyCalibration
    >>> ceers = SurveyCalibration.survey()
    >>> ceers.name
    'CEERS'
    """

    name: str
    bands: QTable
    template_error: TemplateError
    priors: dict
    mass_function: MassFunction | None = None
    scores: QTable | None = None
    errors: dict = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        require_columns(
            self.bands, ("band", "zero_point", "error_factor", "error_part", "outlier"), "bands"
        )

    def __repr__(self):
        numbers = f"{len(self.bands)} bands, {len(self.priors)} priors"
        return f"<SurveyCalibration {self.name}: {numbers}>"

    def of_bands(self, column, filters, default):
        """Look up a column for bands: dict of str to float, ``default`` for bands that are not in the table."""
        values_by_band = dict(
            zip(map(str, self.bands["band"]), map(float, self.bands[column]), strict=True)
        )
        return {name: values_by_band.get(name, default) for name in filters}

    def grid_priors(self, axes):
        """Select the prior weights of the axes of a grid whose values are the same: dict by name."""
        grid_weights = {}
        for name, (values, weights) in self.priors.items():
            axis = axes.get(name)
            if axis is None or np.size(axis) < 2:
                continue
            if np.shape(axis) != np.shape(values) or not np.allclose(axis, values, rtol=1e-6):
                text = f"the calibration {self.name!r} has no prior for the values of {name!r}"
                warn(f"{text}: flat", FitWarning)
                continue
            grid_weights[name] = np.array(weights)
        return grid_weights

    def without_priors(self):
        """Return a calibration of the same bands and errors without priors, for other models."""
        return dataclasses.replace(self, priors={}, mass_function=None, errors={})

    @classmethod
    def without_bands(cls, name, template_error):
        """Make a calibration that has errors of models only."""
        return cls(name, described_rows([], _COLUMNS), template_error, {})

    def with_band_errors(self, errors):
        """
        Return a calibration with other errors of bands; fluxes of MIRI may be wrong.

        Parameters
        ----------
        errors : dict of str to `~miricigale.fitting.survey.band_errors.BandErrors`
            By band.

        Returns
        -------
        calibration : `SurveyCalibration`
            With these bands alone.
        """
        rows = [_band_row(band, band_errors) for band, band_errors in errors.items()]
        return dataclasses.replace(self, bands=described_rows(rows, _COLUMNS))

    def with_prior_errors(self, bands):
        """
        Return a calibration for a catalog of which nothing was measured.

        Parameters
        ----------
        bands : list of str
            Bands of the catalog.

        Returns
        -------
        calibration : `SurveyCalibration`
            Its bands have the errors of `~miricigale.fitting.survey.band_errors.prior_errors`: in MIRI 3.3 times
            those of the catalog, 15 % of the flux, and 5 % of wrong fluxes.
        """
        return self.with_band_errors({band: prior_errors(band) for band in bands})

    def summary(self):
        """
        Format what is done to the fluxes and errors of each band as a table in text.

        Returns
        -------
        text : str
            A line for each band: fluxes that were compared with what others predict, zero point, factor of the
            errors, part of the flux that is added, and share of wrong fluxes that was found. ``prior`` stands
            where no flux said anything.
        """
        lines = [f"{'band':20s} {'fluxes':>6s}  zero point      errors x  + flux, %  wrong, %"]
        for row in self.bands:
            measured = row["n"] > 0
            n_fluxes = "prior"
            if measured:
                n_fluxes = str(int(row["n"]))
            zero_point = f"{row['zero_point']:.3f}"
            if measured and row["zero_point_err"] > 0:
                zero_point += f" +- {row['zero_point_err']:.3f}"
            numbers = f"{row['error_factor']:8.2f}  {100 * row['error_part']:9.1f}"
            has_wrong = measured and np.isfinite(row["wrong"])
            wrong = ""
            if has_wrong:
                wrong = f"{100 * row['wrong']:8.1f}"
            line = f"{row['band']:20s} {n_fluxes:>6s}  {zero_point:14s} {numbers}  {wrong}"
            lines.append(line.rstrip())
        return "\n".join(lines)

    @classmethod
    @cached(copies=True)
    def survey(cls):
        """
        Load the calibration of `~miricigale.sed.SEDModel.survey`, measured on CEERS.

        ``tools/make_calibration.py`` makes the file.

        On sources of CEERS (Finkelstein et al. 2023, ApJL 946, L13) in HST, NIRCam and MIRI bands as published by
        Lisiecki et al. 2025, with S/N above 5 in seven bands, at published redshifts most of which are
        photometric. What is of that catalog alone (zero points, errors of its bands, wrong fluxes) is left out.
        Errors of models are those of `measure_template_error` times 1.22: with this factor posteriors predict the
        redshifts of 386 of the sources best.
        """
        return cls.read(locate("survey.ceers"))

    def write(self, path, *, overwrite=False):
        """Write an ECSV table of the bands, with the rest in its header."""
        error = self.template_error
        meta = {"kind": _NAME, "name": self.name}
        meta["template_error"] = {"um": error.wave.value.tolist(), "error": error.error.tolist()}
        meta["priors"] = {}
        for name, (values, weights) in self.priors.items():
            prior = {"values": np.asarray(values).tolist(), "weights": np.asarray(weights).tolist()}
            meta["priors"][name] = prior
        if self.mass_function is not None:
            meta["mass_function"] = dataclasses.asdict(self.mass_function)
        meta["errors"] = {name: np.asarray(e).tolist() for name, e in self.errors.items()}
        if self.scores is not None:
            meta["scores"] = {n: self.scores[n].tolist() for n in self.scores.colnames}
        table = described_table({n: (self.bands[n], t) for n, t in _COLUMNS.items()}, meta)
        with replacing(path, overwrite=overwrite) as partial:
            table.write(partial, format="ascii.ecsv")

    @classmethod
    def read(cls, path):
        """
        Read what `write` wrote.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If it is another file.
        """
        table = read_table(path, wanted="a calibration of a survey", form="ascii.ecsv")
        meta = table.meta
        msg = f"{path} is no calibration of a survey (SurveyCalibration.write)"
        if meta.get("kind") != _NAME:
            raise DataError(msg)
        try:
            mass_function = None
            if meta.get("mass_function") is not None:
                mass_function = MassFunction(**meta["mass_function"])
            scores = None
            if meta.get("scores") is not None:
                scores = QTable(meta["scores"])
            return cls(
                name=meta["name"],
                bands=_read_bands(table),
                template_error=TemplateError.from_meta(meta.get("template_error")),
                priors={
                    n: (np.array(p["values"]), np.array(p["weights"]))
                    for n, p in meta["priors"].items()
                },
                mass_function=mass_function,
                scores=scores,
                errors=convert_values(np.array, meta.get("errors", {})),
            )
        except (KeyError, TypeError, ValueError) as error:
            msg = f"{msg}, or a damaged one: {error!r}"
            raise DataError(msg) from error


def _read_bands(table):
    """Read the table of bands; files of earlier versions have no share of wrong fluxes."""
    columns = {}
    for name, text in _COLUMNS.items():
        if name in table.colnames:
            values = table[name]
        else:
            values = nans(len(table))
        columns[name] = (values, text)
    return described_table(columns)


def _band_row(band, errors):
    """Make a row of the table of bands from `BandErrors`: dict by column."""
    outlier = 0.0
    if prior_of_band(band).allows_wrong:
        outlier = errors.wrong
    return {
        "band": band,
        "n": errors.n,
        "zero_point": errors.zero_point,
        "zero_point_err": errors.zero_point_err,
        "error_factor": errors.factor,
        "error_part": errors.part,
        "outlier": outlier,
        "wrong": errors.wrong,
    }


@takes_other_keywords
def calibrate(
    fitter,
    photometry,
    *,
    redshift="redshift",
    name="calibration",
    reference=None,
    priors=None,
    executor=None,
):
    """
    Measure what sources of known redshift say of a survey and of the models.

    In turns, each a step of expectation maximization: priors of all parameters (`measure_priors`), errors of
    models by rest wavelength (`measure_template_error`), and zero points, errors and shares of wrong fluxes of
    bands as `calibrate_bands` measures them, from what the other bands predict. Each of two halves of the sources,
    every other one, is measured by itself, and fitted with free redshifts with what was found on the other: the
    scores. What is returned is the mean of both, with half of their difference as error. These are six fits of the
    sources at their redshifts, on nodes, five more if instruments without a band below 5 um, such as MIRI, are
    left out to be predicted by the others, and two with free redshifts.

    Where nothing is measured of a band, the prior of `calibrate_bands` counts, and ``n`` of the band is 0.

    Parameters
    ----------
    fitter : `BayesFitter`
        On a grid. Its priors, errors of models and outlier fractions are those of the first of the scores; what
        is measured comes in their place.
    photometry : `~astropy.table.QTable`
        As for `BayesFitter.fit`. Sources without redshift are left out.
    redshift : str or array_like, optional
        Column of known redshifts, or values.
    name : str, optional
        What results call it.
    reference : str, optional
        Band whose zero point is 1: by default their median is 1.
    priors : dict, optional
        Weights of the values of parameters that are not measured: by default those of `agn_fraction_prior`, for
        templates that do not fit make AGN where there are none. ``{}`` measures all.
    executor : `concurrent.futures.Executor`, optional
        As for `BayesFitter.fit`.

    Returns
    -------
    calibration : `SurveyCalibration`
        For ``BayesFitter(..., calibration=calibration)``.

    Raises
    ------
    ValueError
        If a half has fewer than 50 sources of known redshift.

    References
    ----------
    Dempster, Laird & Rubin 1977, JRSS B 39, 1. Brammer, van Dokkum & Coppi 2008, ApJ 686, 1503.

    Examples
    --------
    >>> from miricigale.fitting import calibrate
    >>> calibration = calibrate(fitter, photometry, redshift="z_spec")  # doctest: +SKIP
    >>> calibration.scores  # doctest: +SKIP
    >>> calibration.write("calibration.ecsv")  # doctest: +SKIP
    """
    check_that(fitter.grid is not None, "fitter", "one with a grid", fitter.engine)
    table = fitter._table_of(photometry)
    z = known_redshifts(table, redshift)
    # comparisons leave out missing redshifts, which are NaN
    rows = np.flatnonzero((z >= fitter.grid.redshift[0]) & (z <= fitter.grid.redshift[-1]))
    wanted = f"with {2 * _MIN_SOURCES} known redshifts or more"
    check_that(rows.size >= 2 * _MIN_SOURCES, "photometry", wanted, rows.size)
    if priors is None:
        axis = fitter.priors.axes.get("frac_agn")
        has_fractions = axis is not None and axis.values.size > 1 and axis.values[0] == 0
        priors = {}
        if has_fractions:
            priors = {"frac_agn": agn_fraction_prior(axis.values)}
    if reference is not None:
        check_names([reference], "band that is fitted", bands_in_catalog(fitter, table.colnames))
    options = {"executor": executor}
    half_tables = [table[rows[0::2]], table[rows[1::2]]]
    half_redshifts = [z[rows[0::2]], z[rows[1::2]]]
    before = []
    after = []
    # the warnings about the catalog were given for all of it
    with without_warnings():
        calibrations = []
        for sources, known_z in zip(half_tables, half_redshifts, strict=True):
            measured = _measure(fitter, sources, known_z, name, reference, priors, options)
            calibrations.append(measured)
        # each half is fitted with the calibration of the other half
        for sources, calibration in zip(half_tables, calibrations[::-1], strict=True):
            before.append(fitter.fit(sources, **options))
            after.append(with_calibration(fitter, calibration).fit(sources, **options))
    true = np.concatenate(half_redshifts)
    scores = [
        {"fit": "before"} | _score(before, true),
        {"fit": "after"} | _score(after, true),
    ]
    return dataclasses.replace(_mean(calibrations), scores=described_rows(scores, _SCORES))


def bands_in_catalog(fitter, columns):
    """List the bands of a fitter among the columns of a catalog: list of str."""
    return [band for band in fitter.filters or fitter.bands if band in columns]


def _score(fits, true):
    """Score redshifts: sources, bias, sigma_MAD, outliers, and part within the 68 % interval, by column."""
    percentiles = [fit.percentile("redshift", (0.16, 0.5, 0.84)).value for fit in fits]
    # 16th, 50th and 84th percentile of each source
    low, z, high = np.concatenate(percentiles).T
    good = np.isfinite(z)
    metrics = photoz_metrics(true[good], z[good])
    inside = np.mean((low <= true)[good] & (true <= high)[good])
    return {
        "n": int(good.sum()),
        "bias": metrics.bias,
        "sigma_mad": metrics.sigma_mad,
        "outliers": metrics.outlier_fraction,
        "inside": inside,
    }


def on_nodes(fitter):
    """Return a fitter of the nodes of the grid alone: errors and priors are of what these leave."""
    settings = dataclasses.replace(fitter.backend.given, interpolate=0, finer=None, agn_error=0.0)
    return fitter.replace(settings=settings, nuclei=False)


def _measure(fitter, table, z, name, reference, priors, options):
    """Measure the `SurveyCalibration` of sources at their redshifts, in turns of expectation maximization."""
    options = {"redshift": z, **options}
    fitter = on_nodes(fitter)
    bands = bands_in_catalog(fitter, table.colnames)
    long = list(itertools.chain.from_iterable(long_instruments(bands)))
    predicting = [band for band in bands if band not in long]
    data = fitter.replace(calibration=None)._read_bands(table, bands)
    errors = {band: prior_errors(band) for band in bands}
    weights = {}

    def current(template_error):
        measured_priors = {n: (fitter.priors.axes[n].values, w) for n, w in weights.items()}
        rows = [_band_row(band, band_errors) for band, band_errors in errors.items()]
        table = described_rows(rows, _COLUMNS)
        return SurveyCalibration(name, table, template_error, measured_priors, MassFunction())

    current_fitter = fitter.replace(
        model_error=_FIRST_MODEL_ERROR, template_error=None, calibration=None
    )
    for turn in range(_N_TURNS):
        fit = current_fitter.fit(table, **options)
        # the first turn only finds models that are near: errors of bands and long steps come after it
        part = dict.fromkeys(bands, 0.0)
        power = 1.0
        if turn > 0:
            part = {band: errors[band].part for band in bands}
            power = _OVER_RELAXATION
        error = measure_template_error(fit, model_error=part)
        weights = _longer(weights, measure_priors(fit), power) | priors
        if turn > 0:
            if long:
                fit = current_fitter.replace(filters=predicting).fit(table, **options)
            errors = measure_bands(fit, fit.mean("redshift").value, data, bands, error)
            if reference is not None:
                errors = relative_zero_points(errors, reference)
        current_fitter = with_calibration(fitter, current(error))
    return current_fitter.calibration


def with_calibration(fitter, calibration):
    """Return a fitter with a calibration in place of its own priors and errors."""
    none = dict.fromkeys(("priors", "template_error", "model_error"))
    return fitter.replace(calibration=calibration, **none)


def _longer(before, after, power):
    """Lengthen the step of weights in the logarithm: old * (new / old)^power, normalized, by name."""
    longer = {}
    for name, weights in after.items():
        old = before.get(name, np.full(weights.size, 1.0 / weights.size))
        # old (new / old)^power
        step = quotient(weights, old) ** power * old
        longer[name] = step / step.sum()
    return longer


def _mean(calibrations):
    """Average two calibrations, errors in quadrature, with half of the difference as error."""
    a, b = calibrations
    bands = a.bands.copy()
    wave = a.template_error.wave
    for name in ("zero_point", "outlier", "wrong"):
        bands[name] = 0.5 * (a.bands[name] + b.bands[name])
    # what is scatter in parts of the flux in one half may be in parts of its error in the other
    for name in ("error_factor", "error_part"):
        bands[name] = np.sqrt(0.5 * (a.bands[name] ** 2 + b.bands[name] ** 2))
    bands["zero_point_err"] = 0.5 * np.abs(a.bands["zero_point"] - b.bands["zero_point"])
    bands["n"] = a.bands["n"] + b.bands["n"]
    a_error = a.template_error.error
    b_error = b.template_error(wave)
    priors = {}
    errors = {}
    for name, (values, a_weights) in a.priors.items():
        _, b_weights = b.priors[name]
        priors[name] = (values, 0.5 * (a_weights + b_weights))
        errors[name] = 0.5 * np.abs(a_weights - b_weights)
    errors["template_error"] = 0.5 * np.abs(a_error - b_error)
    mean = TemplateError(wave, np.sqrt(0.5 * (a_error**2 + b_error**2)))
    return SurveyCalibration(a.name, bands, mean, priors, a.mass_function, errors=errors)
