"""What fits of sources of known redshift say of models and catalogs: errors, zero points and priors."""

import itertools

import astropy.units as u
import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from miricigale.fitting.data.likelihood import flux_columns, per_band
from miricigale.fitting.data.template_error import TemplateError, pivots
from miricigale.fitting.survey.band_errors import (
    LONGEST_REST,
    PredictedFluxes,
    estimate_band_errors,
    prior_of_band,
    select_fluxes,
)
from miricigale.utils.arrays import nans
from miricigale.utils.column_units import quantity_table
from miricigale.utils.exceptions import argument_error
from miricigale.utils.named_values import places
from miricigale.utils.options import check_names, check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.tables import described_columns, require_columns
from miricigale.utils.units import FNU, WAVE, is_ascending, to_array

_COLUMNS = column_texts("miricigale.fitting", "zero_points")
#: Fluxes of lower S/N say more of their noise than of the models.
_MIN_SIGNAL = 5.0
#: Smallest number of such fluxes for what is measured by band.
_N_BAND = 30
#: Smallest number of such fluxes in a bin of rest wavelength.
_N_BIN = 10
#: Median of the absolute value of a normal deviate.
_MEDIAN = 0.6744897501960817
#: Largest template error that is looked for, as a part of the flux.
_MAX_ERROR = 10.0
#: Edges in um of the bins of rest wavelength; wider where few bands fall.
_EDGES = (0.09, 0.17, 0.22, 0.28, 0.36, 0.45, 0.6, 0.8, 1.1, 1.5, 2.0, 2.6, 3.6, 5.5, 12.0)


def _check_known(results):
    wanted = "of fits at known redshifts (redshift=...)"
    check_that(results.redshift_fixed, "results", wanted, "redshifts that were free")


def _residuals(results):
    """Return fluxes, errors and best models of fits at known redshifts, in uJy, and which fluxes count."""
    _check_known(results)
    flux = results.flux
    error = results.flux_err
    model = results.best_flux
    good = results.fitted[:, None] & np.isfinite(results.sigma) & ~results.limit & (model > 0)
    good &= flux > _MIN_SIGNAL * error
    return flux, error, model, good


def _rest_wavelengths(results):
    """Compute the rest wavelengths in um of the bands of all objects, shape (n, nb)."""
    return pivots(results.filters).value / (1.0 + results.best["redshift"].value[:, None])


def _excess(flux, error, model, scatter):
    """
    Solve for the part of the flux to add to errors for residuals to have a normal median.

    Residuals of models drawn from the posteriors, Gaussians about their means: half of these draws are to be
    within the median of abs(flux - model) of the errors.
    """
    residual = np.abs(flux - model)
    scatter = np.maximum(scatter, 1e-9 * flux)

    def excess(part):
        # half-width that half of normal residuals lie within
        within = _MEDIAN * np.hypot(error, part * flux)
        return 0.5 - np.mean(
            ndtr((within - residual) / scatter) - ndtr((-within - residual) / scatter)
        )

    check_that(not excess(_MAX_ERROR) > 0, "results", "with models near most fluxes", "others")
    if excess(0.0) > 0:
        return brentq(excess, 0.0, _MAX_ERROR, xtol=1e-4)
    return 0.0


def measure_band_errors(left, template_error, *, longest=LONGEST_REST * u.um, prior=None):
    """
    Measure errors of bands that are not those of models: noise, and other apertures, PSFs and blends.

    By the greatest posterior of what was measured in bands that were left out of a fit, given what the other bands
    predict, where starlight makes the flux: errors are those of the catalog times a factor, and a part of the
    flux, added to the template error and that of the prediction. (Residuals of a fit that has the bands would be
    too small, as models follow them.) Some fluxes may be wrong, with errors five times as large. Fluxes count
    whose prediction is above five times their error. Errors of drizzled images may be too small by such a factor,
    for their noise is correlated. `calibrate_bands` does this for all bands of a catalog with fewer fits.

    Parameters
    ----------
    left : `LeaveOutResult`
        Of `leave_out`, at known or free redshifts, of bands that are alike, such as those of MIRI.
    template_error : `TemplateError`
        That of the fit.
    longest : `~astropy.units.Quantity`, optional
        Longest rest wavelength that is looked at.
    prior : `~miricigale.fitting.survey.band_errors.BandErrorPrior`, optional
        What is likely before anything was measured, and holds where no flux says more: for bands of MIRI by
        default 3.3 times the errors and 15 % of the flux, for others 1 and 2 %.

    Returns
    -------
    factor : float
        What the errors in the catalog are to be multiplied by.
    part : float
        Part of the flux, for ``model_error`` of `BayesFitter`.

    Raises
    ------
    ValueError
        If no prior is given, and bands of MIRI and others were left out.

    References
    ----------
    Hogg, Bovy & Lang 2010, arXiv:1008.4686, section 3.

    Examples
    --------
    >>> from miricigale.fitting import leave_out, measure_band_errors
    >>> miri = ["miri.f560w", "miri.f770w"]
    >>> left = leave_out(fitter, photometry, miri, redshift="z_spec")  # doctest: +SKIP
    >>> factor, part = measure_band_errors(left, template_error)  # doctest: +SKIP
    """
    longest = to_array(longest, WAVE, "longest", ndim=0)
    if prior is None:
        priors = set(map(prior_of_band, left.bands))
        check_that(len(priors) == 1, "left", "of bands of MIRI, or of others", list(left.bands))
        prior = priors.pop()
    samples = []
    for i, band in enumerate(left.bands):
        redshift = left.results[band].mean("redshift").value
        fluxes = select_fluxes(
            left.flux[:, i],
            left.flux_err[:, i],
            left.predicted[:, i],
            left.predicted_std[:, i],
            pivots([band]).to_value(WAVE) / (1.0 + redshift),
            template_error,
            longest,
        )
        samples.append(fluxes)
    errors = estimate_band_errors(PredictedFluxes.concatenate(samples), prior)
    return errors.factor, errors.part


def measure_template_error(results, *, model_error=0.0, edges=None):
    """
    Measure the template error from fits of real sources at known redshifts.

    In each bin of rest wavelength it is what has to be added to the errors of fluxes for the median of
    abs(flux - model) over the error to be that of a normal distribution, of models drawn from the posteriors.
    Those of the best model are smaller, by the parameters that were fitted. Draws scatter by just the errors
    if the fit has the right ones (Talts et al. 2018, arXiv:1804.06788): start with model errors of some 10 %
    and repeat with what was found, a step of expectation maximization each. Bands that hardly anything but
    themselves predicts need many. A function that is tested on the sources it was measured on looks better
    than it is: measure it on one half.

    Parameters
    ----------
    results : `FitResults`
        Of a fit at known redshifts.
    model_error : float or dict of str to float, optional
        Errors of bands that the fit had and that are not those of models (`measure_band_errors`), as parts of
        the flux: the result is added to them in quadrature.
    edges : `~astropy.units.Quantity`, shape (n + 1,), optional
        Edges of the bins.

    Returns
    -------
    error : `TemplateError`

    Raises
    ------
    ValueError
        If redshifts were free, no bin has 10 fluxes of S/N above 5, or ``model_error`` names an
        unknown band.

    Examples
    --------
    >>> from miricigale.fitting import measure_template_error
    >>> import numpy as np
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"redshift": np.full(40, 0.5), "age": np.linspace(1, 5, 40), "mass": np.full(40, 1e10)}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0), fractional=0.05)
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.5], "age": [1.0, 2.0, 3.0, 4.0, 5.0], "ebv": [0.1, 0.3, 0.5]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.0)
    >>> results = fitter.fit(photometry, redshift=np.full(40, 0.5))
    >>> measure_template_error(results).error.max().round(2)
    np.float64(0.0)
    """
    if edges is None:
        edges = _EDGES * WAVE
    edges = to_array(edges, WAVE, "edges", ndim=1)
    check_that(
        is_ascending(edges, min_size=2), "edges", "two wavelengths or more that increase", edges
    )
    band_error = per_band(model_error, results.filters, "model_error")
    flux, error, _, good = _residuals(results)
    # errors of bands are part of those that models leave unexplained
    error = np.hypot(error, np.array([band_error[name] for name in results.filters]) * flux)
    rest_wave = _rest_wavelengths(results)
    wave = []
    bin_errors = []
    for low, high in itertools.pairwise(edges):
        in_bin = good & (rest_wave >= low) & (rest_wave < high)
        if np.count_nonzero(in_bin) >= _N_BIN:
            wave.append(np.sqrt(low * high))
            excess = _excess(
                flux[in_bin],
                error[in_bin],
                results.model_flux[in_bin],
                results.model_flux_std[in_bin],
            )
            bin_errors.append(excess)
    check_that(wave, "results", f"with {_N_BIN} fluxes of S/N above 5 in a bin", "fewer")
    return TemplateError(wave * WAVE, bin_errors)


def measure_priors(results):
    """
    Measure how often the values of each parameter occur among sources of known redshift.

    The means of their posteriors: one step of expectation maximization, which never lowers the likelihood of
    the sample. Fit again with these as ``priors`` and repeat: after some five steps little changes but that
    rare values become rarer still, down to 0 in the end, which is why to stop there. Priors that are flat in
    the nodes give young, dusty, bursting galaxies and bright AGN more weight than they have in any survey.

    Parameters
    ----------
    results : `FitResults`
        Of a fit at known redshifts.

    Returns
    -------
    priors : dict of str to `~numpy.ndarray`
        Weights of the values of ``results.axes``, without those of redshift, for ``priors`` of `BayesFitter`.

    Raises
    ------
    ValueError
        If redshifts were free, or nothing was fitted.

    References
    ----------
    Dempster, Laird & Rubin 1977, JRSS B 39, 1.

    Examples
    --------
    >>> from miricigale.fitting import measure_priors
    >>> import numpy as np
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"redshift": np.full(40, 0.5), "age": np.linspace(1, 5, 40), "mass": np.full(40, 1e10)}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0), fractional=0.05)
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.5], "age": [1.0, 2.0, 3.0, 4.0, 5.0], "ebv": [0.1, 0.3, 0.5]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.0)
    >>> results = fitter.fit(photometry, redshift=np.full(40, 0.5))
    >>> measure_priors(results)["ebv"].round(2)
    array([0., 1., 0.])
    """
    _check_known(results)
    check_that(results.fitted.any(), "results", "with fitted objects", "none")
    names = [name for name in results.axes if name != "redshift"]
    return {name: results.pdf[name][results.fitted].mean(axis=0) for name in names}


def calibrate_zero_points(results, *, reference=None):
    """
    Measure what the fluxes of each band want to be multiplied by to agree with the best models.

    Nothing is changed by it: see `apply_zero_points`. Masses take up a factor common to all bands, so
    the factors are those over the reference's. Where bands and rest wavelengths go together, as for
    sources in a narrow range of redshifts, errors of models look like those of zero points.

    Parameters
    ----------
    results : `FitResults`
        Of a fit at known redshifts.
    reference : str, optional
        Band whose factor is 1; by default that of the most sources.

    Returns
    -------
    zero_points : `~astropy.table.QTable`
        A row for each band that was fitted: ``band``, ``n`` sources, ``factor``, one over the median of
        flux over best model, and ``factor_err``, from their scatter. Best models follow the fluxes: the scatter is
        divided by 1 - s^2 / sigma^2, with sigma the error of a flux and s the standard deviation of its model, the
        leverage of linear regression (Cook & Weisberg 1982, chapter 2). It is infinite for a band of which the
        others say nothing.

    Raises
    ------
    KeyError
        If the reference is no band that was fitted.
    ValueError
        If redshifts were free, or the reference has fewer than 30 sources of S/N above 5.

    Examples
    --------
    >>> from miricigale.fitting import calibrate_zero_points
    >>> import numpy as np
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"redshift": np.full(40, 0.5), "age": np.linspace(1, 5, 40), "mass": np.full(40, 1e10)}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0), fractional=0.05)
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.5], "age": [1.0, 2.0, 3.0, 4.0, 5.0], "ebv": [0.1, 0.3, 0.5]}
    >>> fitter = BayesFitter(model, bands, axes=axes, model_error=0.0)
    >>> photometry["irac.ch1"] *= 0.8
    >>> results = fitter.fit(photometry, redshift=np.full(40, 0.5))
    >>> points = calibrate_zero_points(results, reference="wfc3.f160w")
    >>> points.round(2)
    >>> print(points["band", "n", "factor"])
       band     n  factor
    ---------- --- ------
     acs.f814w  40   1.12
    wfc3.f160w  40    1.0
      irac.ch1  40    1.2
    miri.f770w  40   1.07
    """
    flux, _, model, good = _residuals(results)
    bands = list(results.fitted_filters)
    columns = places(bands, results.filters)
    n = good[:, columns].sum(axis=0)
    if reference is None:
        reference = bands[int(np.argmax(n))]
    check_names([reference], "band that was fitted", bands)
    if n[bands.index(reference)] < _N_BAND:
        wanted = f"a band with {_N_BAND} sources of S/N above 5"
        raise argument_error("reference", wanted, f"{reference} with {n[bands.index(reference)]}")
    factor = np.ones(len(bands))
    scatter = nans(len(bands))
    has_factor = n >= _N_BAND
    for i in np.flatnonzero(has_factor):
        rows = good[:, columns[i]]
        ratio = np.log(model[rows, columns[i]] / flux[rows, columns[i]])
        median = np.median(ratio)
        factor[i] = np.exp(median)
        # standard error of a median: sqrt(pi / 2n) sigma, with sigma from the median absolute deviation
        median_err = np.sqrt(np.pi / (2.0 * n[i])) * np.median(np.abs(ratio - median)) / _MEDIAN
        free_part = _free_part(results, columns[i], rows)
        if free_part > 0:
            scatter[i] = median_err / free_part
        else:
            scatter[i] = np.inf
    # masses take up a factor common to all bands
    factor[has_factor] /= factor[bands.index(reference)]
    columns = {
        "band": np.array(bands),
        "n": n,
        "factor": factor,
        "factor_err": factor * scatter,
    }
    return described_columns(columns, _COLUMNS, {"reference": reference})


def _free_part(results, column, rows):
    """Return the median part of the residuals of a band that models, which follow its fluxes, do not take up."""
    # leverage s^2 / sigma^2: the part of a residual that the model follows
    taken_up = np.square(results.model_flux_std[rows, column] / results.sigma[rows, column])
    return 1.0 - np.median(taken_up)


def apply_zero_points(photometry, zero_points):
    """
    Multiply fluxes and errors by factors.

    Parameters
    ----------
    photometry : `~astropy.table.QTable`
        Photometry as for `BayesFitter.fit`.
    zero_points : `~astropy.table.QTable`
        With ``band`` and ``factor``, as `calibrate_zero_points` gives it.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        A copy; ``meta["zero_points"]`` has the factors, with those that were applied before.

    Raises
    ------
    ValueError
        If a column is missing.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from miricigale.fitting import apply_zero_points
    >>> photometry = QTable({"id": [1], "miri.f770w": [2.0] * u.uJy, "miri.f770w_err": [0.1] * u.uJy})
    >>> points = QTable({"band": ["miri.f770w"], "factor": [1.05]})
    >>> print(apply_zero_points(photometry, points)["miri.f770w"])
    [2.1] uJy
    """
    require_columns(zero_points, ["band", "factor"], "zero_points")
    names = map(str, zero_points["band"])
    values = map(float, zero_points["factor"])
    factors = dict(zip(names, values, strict=True))
    columns = flux_columns(factors)
    require_columns(photometry, columns, "photometry", units=dict.fromkeys(columns, FNU))
    out = quantity_table(photometry, copy=True)
    for name, factor in factors.items():
        for column in flux_columns([name]):
            out[column] = out[column] * factor
    before = out.meta.get("zero_points", {})
    out.meta["zero_points"] = before | {b: f * before.get(b, 1.0) for b, f in factors.items()}
    return out
