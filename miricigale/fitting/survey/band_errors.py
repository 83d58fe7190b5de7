"""Errors, zero points and shares of wrong fluxes of bands, from what the other bands predict."""

import itertools
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, logit

from miricigale.fitting.data.template_error import pivots
from miricigale.utils.named_values import subset
from miricigale.utils.parallel import single_threaded
from miricigale.utils.units import WAVE
from miricigale.utils.values import value_class

#: How many times their errors wrong fluxes scatter by.
WRONG_WIDTH = 5.0
#: S/N of the predicted flux, by the error in the catalog, above which a flux counts.
MIN_SIGNAL = 5.0
#: Rest wavelengths in um at which fluxes count: hydrogen absorbs below, dust emits above.
SHORTEST_REST = 0.1
LONGEST_REST = 2.5
#: Reduced chi2 of fits that predict, or this many times its median over the catalog if that is more.
MAX_REDUCED_CHI2 = 4.0
#: Pivot wavelength in um beyond which all bands of an instrument are for it to be predicted by the others.
_LONG_PIVOT = 5.0
#: Least number of other bands for that.
MIN_PREDICTING_BANDS = 4
#: Largest standard deviation of the model flux over the error of the flux: beyond, the others say nothing.
_MAX_SPREAD = 0.97
#: Bounds of ln factor, ln part, logit of the wrong share and ln zero point.
_BOUNDS = ((-2.0, 3.5), (-8.0, 1.0), (-9.0, 1.0), (-0.7, 0.7))
#: Step of the finite differences of the curvature at the maximum.
_STEP = 1e-3


@dataclass(frozen=True)
class BandErrorPrior:
    """
    Prior of the errors of a band: log-normal factor, part and zero point, and a beta prior of the wrong share.

    Parameters
    ----------
    factor, part : float
        Medians of what errors are multiplied by, and of the part of the flux that is added in quadrature.
    factor_scatter, part_scatter : float
        Standard deviations of their natural logarithms.
    zero_point_scatter : float
        That of the natural logarithm of the zero point; 0 leaves zero points at 1.
    n_wrong, n_right : float
        Numbers of wrong and right fluxes that the prior of the wrong share counts as.
    allows_wrong : bool, optional
        Whether fits allow for the share of wrong fluxes: where every band may be wrong they lose breaks, and
        redshifts.

    Examples
    --------
    >>> from miricigale.fitting.survey.band_errors import MIRI_PRIOR
    >>> MIRI_PRIOR.factor
    3.3
    """

    factor: float
    factor_scatter: float
    part: float
    part_scatter: float
    zero_point_scatter: float
    n_wrong: float
    n_right: float
    allows_wrong: bool = False

    @property
    def wrong(self):
        """Most likely share of wrong fluxes without data."""
        return self.n_wrong / (self.n_wrong + self.n_right)


#: Forced photometry in MIRI images scatters by more than its errors, about what HST and NIRCam predict of
#: starlight: numbers of CEERS, whose catalog of Lisiecki et al. 2025 has no correction for correlated noise. Zero
#: points stay at 1, for at rest 2.5 to 4 um errors of the models look like them.
MIRI_PRIOR = BandErrorPrior(3.3, 0.4, 0.15, 0.5, 0.0, 2.0, 40.0, allows_wrong=True)
#: Other bands: errors are right within a third, zero points within 4 %.
DEFAULT_PRIOR = BandErrorPrior(1.0, 0.3, 0.02, 0.7, 0.04, 2.0, 60.0)


@dataclass(frozen=True)
class BandErrors:
    """
    Errors of a band, as `estimate_band_errors` found them.

    Parameters
    ----------
    n : int
        Fluxes that were compared with predictions; 0: all values are those of the prior.
    zero_point, zero_point_err : float
        What fluxes and errors are to be multiplied by, and its 1-sigma error.
    factor, part : float
        What errors are to be multiplied by, and part of the flux that is to be added in quadrature.
    wrong : float
        Share of fluxes with errors five times as large.
    """

    n: int
    zero_point: float
    zero_point_err: float
    factor: float
    part: float
    wrong: float


def instrument_of(band):
    """Return the instrument of a band: ``miri`` of ``miri.f770w`` and of ``sedpy.jwst_f770w``."""
    library, _, name = band.partition(".")
    if library != "sedpy":
        return library
    instrument = name.split("_")[0]
    if instrument == "jwst":
        long = pivots([band]).to_value(WAVE)[0] > _LONG_PIVOT
        if long:
            return "miri"
        return "nircam"
    return instrument


def prior_of_band(band):
    """Return the prior of the errors of a band, a `BandErrorPrior`: that of MIRI, or of all others."""
    if instrument_of(band) == "miri":
        return MIRI_PRIOR
    return DEFAULT_PRIOR


def long_instruments(bands):
    """
    Group the bands of instruments that have none below 5 um, such as MIRI.

    What the other bands predict of their starlight says how large their errors are.

    Parameters
    ----------
    bands : list of str
        All bands of a catalog.

    Returns
    -------
    groups : list of list of str
        One for each such instrument; none where fewer than four bands would be left.
    """
    by_instrument = {}
    for band in bands:
        by_instrument.setdefault(instrument_of(band), []).append(band)
    wave = {}
    if bands:
        wave = dict(zip(bands, pivots(bands).to_value(WAVE), strict=True))
    groups = []
    for group in by_instrument.values():
        if min(wave[band] for band in group) > _LONG_PIVOT:
            groups.append(group)
    n_long = sum(map(len, groups))
    if len(bands) - n_long >= MIN_PREDICTING_BANDS:
        return groups
    return []


def left_out_predictions(results):
    r"""
    Predict the flux of each band from the others, without further fits.

    With the flux d and its error :math:`\sigma` in the fit, and mean m and standard deviation s of the model flux
    over the posterior, the flux itself is taken out of the Gaussian: the prediction is
    :math:`(m \sigma^2 - d s^2) / (\sigma^2 - s^2)`, its variance :math:`s^2 \sigma^2 / (\sigma^2 - s^2)`. Of bands
    that were not fitted these are m and s.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults` or `~miricigale.fitting.grid.node_fluxes.FluxMoments`
        A fit.

    Returns
    -------
    predicted, predicted_std : `~numpy.ndarray`, shape (n, nb)
        Fluxes in uJy with the zero points of the fit; NaN where the others say nothing about a band, or the fit is
        bad.
    """
    mean = np.array(results.model_flux, dtype=float)
    std = np.array(results.model_flux_std, dtype=float)
    fitted = np.isfinite(results.sigma) & ~results.limit
    sigma = np.where(fitted, results.sigma, np.inf)
    flux = np.where(fitted, results.flux, 0.0)
    with np.errstate(all="ignore"):
        usable = results.fitted[:, None] & (mean > 0) & (std < _MAX_SPREAD * sigma)
        # s^2 over sigma^2 - s^2: 0 of bands that were not fitted
        leverage = 1.0 / (np.square(sigma / std) - 1.0)
        leverage = np.where(fitted, leverage, 0.0)
        predicted = mean + leverage * (mean - flux)
        predicted_std = std * np.sqrt(1.0 + leverage)
        usable &= (predicted > 0) & (
            _others_chi2(results, fitted, mean, std) < _largest_chi2(results)
        )
    return np.where(usable, predicted, np.nan), np.where(usable, predicted_std, np.nan)


def _others_chi2(results, fitted, mean, std):
    """
    Compute reduced chi2 without each band, (n, nb): a wrong flux says nothing against the fit of the others.

    Without a flux chi2 falls by the square of its pull about what the others predict (Cook & Weisberg 1982).
    """
    variance = np.square(results.sigma) - np.square(std)
    own_chi2 = np.where(fitted, np.square(results.flux - mean) / variance, 0.0)
    n_others = fitted.sum(axis=1)[:, None] - fitted
    chi2 = results.chi2[:, None] - own_chi2
    return np.maximum(chi2, 0.0) / np.maximum(n_others - 1, 1)


def _largest_chi2(results):
    """Compute the reduced chi2 above which a fit predicts nothing: 4, or 4 times the median of the catalog."""
    chi2 = np.asarray(results.reduced_chi2, dtype=float)
    chi2 = chi2[results.fitted & np.isfinite(chi2)]
    median = 0.0
    if chi2.size:
        median = np.median(chi2)
    return MAX_REDUCED_CHI2 * max(1.0, median)


@value_class
class PredictedFluxes:
    """
    Measured fluxes of a band, or of bands that have their errors in common, and what the others predict.

    Parameters
    ----------
    flux, flux_err : `~numpy.ndarray`, shape (n,)
        As in the catalog, in uJy.
    predicted, predicted_std : `~numpy.ndarray`, shape (n,)
        Predicted fluxes and their errors in uJy, without those of the models.
    model_error : `~numpy.ndarray`, shape (n,)
        Errors of the models, as parts of the flux.
    """

    flux: np.ndarray
    flux_err: np.ndarray
    predicted: np.ndarray
    predicted_std: np.ndarray
    model_error: np.ndarray

    @property
    def n(self):
        """Number of fluxes."""
        return self.flux.size

    @classmethod
    def concatenate(cls, samples):
        """Join the fluxes of several bands."""
        names = ("flux", "flux_err", "predicted", "predicted_std", "model_error")
        columns = {}
        for name in names:
            columns[name] = np.concatenate([getattr(sample, name) for sample in samples])
        return cls(**columns)


def select_fluxes(
    flux, flux_err, predicted, predicted_std, rest_wave, template_error, longest=None
):
    """
    Choose the fluxes of a band that say how large its errors are.

    These are fluxes at rest wavelengths of starlight whose *prediction* is above five times the error. A limit on
    the measured flux would choose those that noise has made brighter, and errors would seem larger than they are.

    Parameters
    ----------
    flux, flux_err : `~numpy.ndarray`, shape (n,)
        As in the catalog, in uJy; NaN where there is none.
    predicted, predicted_std : `~numpy.ndarray`, shape (n,)
        As of `left_out_predictions`.
    rest : `~numpy.ndarray`, shape (n,)
        Rest wavelengths in um.
    template_error : `~miricigale.fitting.TemplateError` or None
        Errors of the models.
    longest : float, optional
        Longest rest wavelength in um; 2.5 by default.

    Returns
    -------
    fluxes : `PredictedFluxes`
    """
    if longest is None:
        longest = LONGEST_REST
    good = np.isfinite(flux) & (flux_err > 0) & np.isfinite(flux_err)
    good &= (predicted > MIN_SIGNAL * flux_err) & np.isfinite(predicted_std)
    good &= (rest_wave > SHORTEST_REST) & (rest_wave < longest)
    if template_error is None:
        model_error = np.zeros(np.count_nonzero(good))
    else:
        model_error = template_error(rest_wave[good] * WAVE)
    return PredictedFluxes(
        flux[good], flux_err[good], predicted[good], predicted_std[good], model_error
    )


def estimate_band_errors(fluxes, prior):
    r"""
    Estimate factor and part of errors, share of wrong fluxes and zero point, by the greatest posterior.

    Of a flux d with error e, a prediction p with standard deviation s and an error t of the models as a part of
    the flux, zero point times flux less prediction, :math:`Z d - p`, is normal with the variance :math:`v = s^2 +
    (t p)^2 + (F Z e)^2 + (P p)^2`; a share q of the fluxes has errors five times as large (Hogg, Bovy & Lang 2010,
    arXiv:1008.4686, section 3). Each has the prior that is given, so that few fluxes change little and without any
    the prior remains.

    Parameters
    ----------
    fluxes : `PredictedFluxes`
        Fluxes that have these errors in common.
    prior : `BandErrorPrior`
        Their prior.

    Returns
    -------
    errors : `BandErrors`
    """
    has_zero_point = prior.zero_point_scatter > 0
    mean = np.array([np.log(prior.factor), np.log(prior.part), logit(prior.wrong), 0.0])
    scatter = np.array([prior.factor_scatter, prior.part_scatter, 1.0, 1.0])
    if has_zero_point:
        scatter[3] = prior.zero_point_scatter
    # ln factor, ln part, logit of the wrong share, and ln zero point if it is free
    n_free = 3
    if has_zero_point:
        n_free = 4

    def minus_log_posterior(free_values):
        values = np.array(list(free_values) + [0.0])[:4]
        ln_factor, ln_part, logit_wrong, ln_zero = values
        wrong = expit(logit_wrong)
        log_right = np.log1p(-wrong)
        log_wrong = np.log(wrong)
        zero = np.exp(ln_zero)
        variance = fluxes.predicted_std**2
        variance = variance + np.square(fluxes.model_error * fluxes.predicted)
        variance += np.square(np.exp(ln_factor) * zero * fluxes.flux_err)
        variance += np.square(np.exp(ln_part) * fluxes.predicted)
        square = np.square(zero * fluxes.flux - fluxes.predicted) / variance
        narrow = log_right - 0.5 * square
        broad = log_wrong - np.log(WRONG_WIDTH) - 0.5 * square / WRONG_WIDTH**2
        # a density of the flux as it was measured: its factor is the zero point
        log_like = np.logaddexp(narrow, broad) - 0.5 * np.log(variance) + ln_zero
        pull = (values - mean) / scatter
        log_prior = -0.5 * (pull[0] ** 2 + pull[1] ** 2 + pull[3] ** 2)
        log_prior += prior.n_wrong * log_wrong + prior.n_right * log_right
        return -(np.sum(log_like) + log_prior)

    # factor and part may each explain most of the scatter: a maximum near either
    starts = [
        mean + [0.0, 0.0, 0.0, 0.0],
        mean + [0.7, -1.0, 0.0, 0.0],
        mean + [-0.7, 1.0, 0.0, 0.0],
    ]
    fits = []
    for start in starts:
        fits.append(
            minimize(
                minus_log_posterior, start[:n_free], method="L-BFGS-B", bounds=_BOUNDS[:n_free]
            )
        )
    best = min(fits, key=lambda fit: fit.fun)
    zero_point = 1.0
    zero_point_err = 0.0
    if has_zero_point:
        zero_point = float(np.exp(best.x[3]))
        covariance = np.linalg.inv(_curvature(minus_log_posterior, best.x))
        zero_point_err = zero_point * float(np.sqrt(max(covariance[3, 3], 0.0)))
    return BandErrors(
        n=fluxes.n,
        zero_point=zero_point,
        zero_point_err=zero_point_err,
        factor=float(np.exp(best.x[0])),
        part=float(np.exp(best.x[1])),
        wrong=float(expit(best.x[2])),
    )


def _curvature(function, x):
    """Compute the matrix of second derivatives at ``x``, by central differences."""
    # f(x + a + b) - f(x + a - b) - f(x - a + b) + f(x - a - b), over 4 h^2
    steps = _STEP * np.eye(x.size)
    out = np.empty((x.size, x.size))
    for i, a in enumerate(steps):
        for j, b in enumerate(steps):
            difference = function(x + a + b) - function(x + a - b)
            difference += function(x - a - b) - function(x - a + b)
            out[i, j] = difference / (4.0 * _STEP**2)
    return out


def prior_errors(band):
    """Return the errors of a band of which nothing is measured: `BandErrors` of its prior."""
    prior = prior_of_band(band)
    return BandErrors(
        n=0,
        zero_point=1.0,
        zero_point_err=prior.zero_point_scatter,
        factor=prior.factor,
        part=prior.part,
        wrong=prior.wrong,
    )


def measure_bands(results, redshift, data, bands, template_error):
    """
    Measure the errors of all bands from one fit without those of `long_instruments`.

    Bands of such an instrument have factor, part and wrong share in common.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults` or `~miricigale.fitting.grid.node_fluxes.FluxMoments`
        Fit of the catalog, or of a part of it, at known or free redshifts, without the bands of long instruments.
    redshift : `~numpy.ndarray`, shape (n,)
        Its redshifts, which rest wavelengths are of.
    data : `~miricigale.fitting.data.likelihood.FitData`
        The same objects, with the columns ``bands``, without zero points.
    bands : list of str
        Bands to measure.
    template_error : `~miricigale.fitting.TemplateError` or None
        That of the fit.

    Returns
    -------
    errors : dict of str to `BandErrors`
        By band.
    """
    # each band is compared with what the others predict, at the redshift of the fit
    predicted, predicted_std = left_out_predictions(results)
    measured = data.measured
    samples = {}
    for i, band in enumerate(bands):
        column = results.filters.index(band)
        samples[band] = select_fluxes(
            np.where(measured[:, i], data.flux[:, i], np.nan),
            np.where(measured[:, i], data.flux_err[:, i], np.nan),
            predicted[:, column],
            predicted_std[:, column],
            pivots([band]).to_value(WAVE) / (1.0 + redshift),
            template_error,
        )
    groups = long_instruments(bands)
    in_groups = list(itertools.chain.from_iterable(groups))
    groups += [[band] for band in bands if band not in in_groups]
    estimates = {}
    # matrices of 4 x 4: threads of the linear algebra wait for each other longer than they work
    with single_threaded():
        for group in groups:
            joined = PredictedFluxes.concatenate([samples[band] for band in group])
            common = estimate_band_errors(joined, prior_of_band(group[0]))
            estimates |= dict.fromkeys(group, common)
    return relative_zero_points(subset(estimates, bands))


def relative_zero_points(errors, reference=None):
    """
    Divide zero points by that of a reference, for masses take up a factor that is common to all.

    Parameters
    ----------
    errors : dict of str to `BandErrors`
        By band. Those without a measured zero point are left alone.
    reference : str, optional
        Band whose zero point becomes 1; by default it is the median of all that were measured.

    Returns
    -------
    errors : dict of str to `BandErrors`
    """
    measured = []
    for band, band_errors in errors.items():
        if band_errors.n > 0 and band_errors.zero_point_err > 0:
            measured.append(band)
    if not measured:
        return errors
    if reference is None:
        common = float(np.median([errors[band].zero_point for band in measured]))
    else:
        common = errors[reference].zero_point
    out = dict(errors)
    for band in measured:
        point = errors[band].zero_point / common
        point_err = errors[band].zero_point_err / common
        out[band] = replace(errors[band], zero_point=point, zero_point_err=point_err)
    return out
