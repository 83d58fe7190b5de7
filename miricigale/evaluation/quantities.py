"""Numbers of a study, each with its bootstrap error."""

import functools

import astropy.units as u
import numpy as np

from miricigale.evaluation.classes import classify
from miricigale.evaluation.estimates import Estimate, bootstrap, outlier_share
from miricigale.evaluation.estimates import median as _median
from miricigale.evaluation.estimates import scatter as _scatter
from miricigale.evaluation.infrared import feature_magnitude
from miricigale.evaluation.metrics import OUTLIER
from miricigale.evaluation.study import TruthResults
from miricigale.evaluation.xray import half_complete, xray_luminosity_at, yang2021_xray_flux
from miricigale.filters import Filter
from miricigale.utils.arrays import finite_values, nans
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_names
from miricigale.utils.tables import error_column
from miricigale.utils.units import ab_magnitude

#: Bins of redshift.
REDSHIFT_BINS = ((0.0, 0.2), (0.2, 1.0), (1.0, 2.0), (2.0, 3.0), (3.0, np.inf))
#: Fewest draws of statistics that are fits themselves, and sources of a bin of the paper's error function.
_FEW_DRAWS = 100
_FEW = 30


def _share(is_detected, n_all=None):
    """Share of sources that were found, of an array of bool; ``n_all`` is their number by default."""
    if n_all is None:
        n_all = is_detected.size
    return Estimate.of_fraction(np.count_nonzero(is_detected), is_detected.size, n_all=n_all)


# Each takes the study, one truth (or None for those of all), the band set, an option and `bootstrap` with
# the seed and the number of draws of one number.


def _in_bin(sky, option):
    """Return the rows of the sample in a bin of true redshift (all without), and sources of the field in it."""
    low, high = option or (0.0, np.inf)
    z = floats(sky.truth["redshift"])
    rows = (z >= low) & (z < high)
    return rows[sky.sample], int(np.count_nonzero(rows & sky.field))


def _of_sample(values, statistic):
    """Return the quantity that is a statistic of values of the sample, by bin of redshift."""

    def measure(_, sky, band_set, option, draws):
        rows, n_all = _in_bin(sky, option)
        columns = values(sky, band_set)
        if not isinstance(columns, tuple):
            columns = (columns,)
        return draws(statistic, *(column[rows] for column in columns), n_all=n_all)

    return measure


def _ratio(values, statistic):
    """Return the ratio of a statistic of values of the sample without MIRI to that with a band set."""

    def paired_columns(sky, band_set):
        return values(sky, "none"), values(sky, band_set)

    return _of_sample(
        paired_columns, lambda without, within: statistic(without) / statistic(within)
    )


def _width(sky, band_set):
    return sky.fitted(band_set, "frac_agn_std")


def _size(values):
    return np.abs(_median(values))


def _high(values):
    return np.nanpercentile(values, 84, axis=-1)


def _trend(values, statistic):
    """Return the ratio of a statistic at one AGN fraction to that at another, of the same sources."""

    def measure(study, _, band_set, option, draws):
        ends = [study.at(frac) for frac in option]
        if None in ends or any(band_set not in sky.fits for sky in ends):
            return Estimate(np.nan)
        columns = [sky.of_catalog(values(sky, band_set)) for sky in ends]

        # a source has its two values side by side
        def ratio(pairs):
            return statistic(pairs[..., ::2]) / statistic(pairs[..., 1::2])

        return draws(ratio, np.stack(columns, axis=1))

    return measure


_DZ = TruthResults.redshift_error
_DF = TruthResults.fraction_error


def _detected_share(study, sky, _, limit, draws):
    """Share of the field brighter than a magnitude that is detected in two or more bands."""
    is_detected = np.asarray(sky.matched["n_detected"]) >= min(2, len(study.bands))
    return _share(is_detected[sky.field & (study.prior_magnitude(sky) < limit)])


def _mips_share(study, sky, _, option, draws):
    """Share of the field brighter than a magnitude that is above a limit in another band."""
    limit, band, depth = option
    if band not in sky.truth.colnames:
        return Estimate(np.nan)
    is_detected = ab_magnitude(sky.truth[band]) < depth
    return _share(is_detected[sky.field & (study.prior_magnitude(sky) < limit)])


def _etc_limit(study, sky, band_set, band, draws):
    """Limit of the exposure time calculator."""
    return Estimate(float(study.etc_limits.get(band, np.nan)))


def _limit_offset(study, sky, band_set, option, draws):
    """Limit of the error function minus another or the calculator's: negative where it is shallower."""
    if isinstance(option, tuple):
        band, reference = option
    else:
        band = option
        reference = None
    if reference is None:
        reference = study.etc_limits.get(band, np.nan)
    return Estimate(float(study.limits.get(band, np.nan) - reference))


def _types_known(study, sky, band, kinds):
    crowds = any("crowded" in kind for kind in kinds)
    return band in study.bands and (not crowds or band in sky.crowded)


def _of_kind(sky, band, kind):
    """Return the sources by shape or with a bright neighbor in a band; with "not " before it the others."""
    if kind.startswith("not "):
        return ~_of_kind(sky, band, kind.removeprefix("not "))
    if kind == "crowded":
        return sky.crowded[band]
    return sky.shapes[kind]


def _kind_share(study, sky, _, option, draws):
    """Share of a kind among the sources above 5 sigma in a band."""
    band, kind = option
    if not _types_known(study, sky, band, [kind]):
        return Estimate(np.nan)
    return _share(_of_kind(sky, band, kind)[sky.field & sky.is_bright(band)])


def _kind_errors(statistic):
    """Of measured minus true magnitude in a band of the sources above 5 sigma that are of all kinds."""

    def measure(study, sky, _, option, draws):
        band, *kinds = option
        if not _types_known(study, sky, band, kinds):
            return Estimate(np.nan)
        rows = np.logical_and.reduce([sky.field, *(_of_kind(sky, band, kind) for kind in kinds)])
        bright = rows & sky.is_bright(band)
        n_all = int(np.count_nonzero(rows))
        return draws(statistic, sky.magnitude_error(band)[bright], n_all=n_all)

    return measure


def _bright_error(study, sky, _, band, draws):
    """Return the median size of measured minus true magnitude of the 30 brightest of the field in a band."""
    rows = np.flatnonzero(sky.field & np.isfinite(sky.magnitude_error(band)))
    order = np.argsort(-sky.matched[f"{band}_true"][rows])
    return draws(_median, np.abs(sky.magnitude_error(band)[rows[order[:_FEW]]]))


def _signal_to_noise(study, sky, _, band, draws):
    """Return the median ratio of flux to error in a band, of the sample."""
    ratio = (sky.matched[band] / sky.matched[error_column(band)]).to_value(u.one)
    return draws(_median, ratio[sky.sample], n_all=int(np.count_nonzero(sky.field)))


def _outlier_share(study, sky, band_set, option, draws):
    """Share of outliers in redshift, with its Wilson interval."""
    rows, n_all = _in_bin(sky, option)
    delta = sky.redshift_error(band_set)[rows]
    return _share(np.abs(finite_values(delta)) > OUTLIER, n_all)


def _class_share(study, sky, band_set, option, draws):
    """Share of the sample that is found in its true class, by the AGN fraction."""
    rows, n_all = _in_bin(sky, option)
    mean = sky.fitted(band_set, "frac_agn_mean")[rows]
    good = np.isfinite(mean)
    is_right = classify(np.clip(mean[good], 0, 1)) == classify(sky.true("frac_agn")[rows][good])
    return _share(is_right, n_all)


def _truths(study, sky, column):
    """Return one truth, or all with an AGN if none is given, that have a column."""
    truths = (sky,)
    if sky is None:
        truths = study.with_agn
    return [t for t in truths if column in t.truth.colnames]


def _power(statistic):
    """Of the accretion power of one truth, or of all with an AGN together."""

    def measure(study, sky, band_set, option, draws):
        truths = _truths(study, sky, "accretion_power")
        if not truths:
            return Estimate(np.nan)
        # the truths of a source are drawn together
        columns = [t.of_catalog(t.power_error(band_set)) for t in truths]
        n_all = int(np.count_nonzero(truths[0].field))
        return draws(statistic, np.stack(columns, axis=1), n_all=n_all)

    return measure


def xray_fluxes(sky):
    """Log of the X-ray flux (erg/s/cm2) of all sources of a truth; NaN without an AGN, and of stars."""
    redshift = floats(sky.truth["redshift"])
    power = sky.truth["l_6um"]
    flux = nans(redshift.size)
    good = np.isfinite(redshift) & (power > 0)
    flux[good] = yang2021_xray_flux(power[good], redshift[good]).value
    return np.log10(flux)


def _xray_half(study, sky, band_set, option, draws):
    """Log of the X-ray flux above which more than half of the AGN of the field are in the sample."""
    truths = _truths(study, sky, "l_6um")
    if not truths:
        return Estimate(np.nan)
    columns = [np.where(t.field, xray_fluxes(t), np.nan) for t in truths]
    samples = [np.where(t.field, t.sample, np.nan) for t in truths]

    def statistic(flux, sample):
        rows = zip(np.atleast_2d(flux), np.atleast_2d(sample), strict=True)
        out = np.array([half_complete(x, np.nan_to_num(y) > 0) for x, y in rows])
        if np.ndim(flux) == 1:
            return out[0]
        return out

    n_draws = max(_FEW_DRAWS, draws.keywords["n_draws"] // 10)
    return draws(statistic, np.stack(columns, axis=1), np.stack(samples, axis=1), n_draws=n_draws)


def _xray_luminosity(study, sky, band_set, redshift, draws):
    """Log of the luminosity (2-10 keV, erg/s) at a redshift of that flux, before absorption."""
    half = _xray_half(study, sky, band_set, None, draws)
    flux = 10.0 ** np.array([half.value, half.low, half.high]) * u.erg / u.s / u.cm**2
    values = np.log10(xray_luminosity_at(flux, redshift).value)
    return Estimate(*map(float, values), half.n, half.n_all)


def _feature(study, sky, band_set, option, draws):
    """Return the magnitudes that a feature of given equivalent width (um) adds to a band at a redshift."""
    band, width, redshift = option
    value = feature_magnitude(width * u.um, redshift, Filter.from_name(band).width)
    return Estimate(float(value))


#: Quantities by name: what it is, and how it is taken from the tables.
_MEASURES = {
    "detected_share": ("share detected in two or more MIRI bands", _detected_share),
    "mips_share": ("share above the limit of MIPS 24", _mips_share),
    "etc_limit": ("5-sigma limit of the calculator (AB)", _etc_limit),
    "limit_offset": ("5-sigma limit minus another (mag)", _limit_offset),
    "kind_share": ("share of the sources above 5 sigma", _kind_share),
    "magnitude_offset": ("median measured - true magnitude", _kind_errors(_median)),
    "magnitude_high": ("84th percentile of measured - true magnitude", _kind_errors(_high)),
    "magnitude_scatter": ("sigma_MAD of measured - true magnitude", _kind_errors(_scatter)),
    "bright_error": ("median size of measured - true magnitude, brightest 30", _bright_error),
    "signal_to_noise": ("median S/N", _signal_to_noise),
    "z_outliers": ("photo-z outliers", _outlier_share),
    "z_bias": ("median dz/(1+z)", _of_sample(_DZ, _median)),
    "z_scatter": ("sigma_MAD of dz/(1+z)", _of_sample(_DZ, _scatter)),
    "z_outlier_ratio": ("photo-z outliers without over with MIRI", _ratio(_DZ, outlier_share)),
    "z_scatter_ratio": ("sigma_MAD of dz/(1+z) without over with MIRI", _ratio(_DZ, _scatter)),
    "z_scatter_trend": ("sigma_MAD of dz/(1+z), fracAGN over fracAGN", _trend(_DZ, _scatter)),
    "frac_offset": ("median fracAGN - true", _of_sample(_DF, _median)),
    "frac_scatter": ("sigma_MAD of fracAGN", _of_sample(_DF, _scatter)),
    "frac_offset_ratio": ("median fracAGN - true without over with MIRI", _ratio(_DF, _size)),
    "frac_scatter_ratio": ("sigma_MAD of fracAGN without over with MIRI", _ratio(_DF, _scatter)),
    "width": ("median posterior width of fracAGN", _of_sample(_width, _median)),
    "width_ratio": ("posterior width of fracAGN without over with MIRI", _ratio(_width, _median)),
    "power_offset": ("median log accretion power - true (dex)", _power(_median)),
    "power_scatter": ("sigma_MAD of log accretion power (dex)", _power(_scatter)),
    "power_scatter_trend": (
        "sigma_MAD of log accretion power, fracAGN over fracAGN",
        _trend(TruthResults.power_error, _scatter),
    ),
    "class_share": ("share found in its true class", _class_share),
    "feature": ("magnitudes that a feature adds to a band", _feature),
    "xray_half": ("log X-ray flux of 50 % completeness", _xray_half),
    "xray_luminosity": ("log X-ray luminosity of 50 % completeness", _xray_luminosity),
}
#: Names of the quantities that are taken from the tables, and what they are.
QUANTITIES = {name: text for name, (text, _) in _MEASURES.items()}
#: Those that are shares of sources.
SHARES = tuple(name for name in QUANTITIES if name.endswith("_share")) + ("z_outliers",)
#: Those that are of several truths together if none is named.
_OF_ALL = ("power_offset", "power_scatter", "xray_half", "xray_luminosity")
_TRENDS = ("z_scatter_trend", "power_scatter_trend")
#: Those of a fit, and those of a band.
OF_FITS = ("z_outliers", "z_bias", "z_scatter", "z_outlier_ratio", "z_scatter_ratio")
OF_FITS += ("frac_offset", "frac_offset_ratio", "frac_scatter", "frac_scatter_ratio")
OF_FITS += ("width", "width_ratio", "power_offset", "power_scatter", "class_share")
_OF_BANDS = ("etc_limit", "bright_error", "signal_to_noise")


def measure(study, quantity, *, truth=0.0, band_set="all", option=None, seed, n_draws=1000):
    """
    Return one quantity of a study.

    Parameters
    ----------
    study : `StudyResults`
        The tables.
    quantity : str
        A name of `QUANTITIES`.
    truth : float, `TruthResults` or None, optional
        The truth, or its AGN fraction; None for all with an AGN together, of quantities that know that.
    band_set : str, optional
        Which fit.
    option : optional
        What else it depends on: a band, a magnitude, a bin of redshift (low, high).
    seed : int or `~numpy.random.Generator`
        Of the bootstrap.
    n_draws : int, optional
        Its draws.

    Returns
    -------
    estimate : `Estimate`
        NaN if the study has no such truth, fit or band.

    Raises
    ------
    KeyError
        If there is no such quantity.

    Examples
    --------
    >>> import numpy as np
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import StudyResults, TruthResults
    >>> ids, zero = np.arange(4), np.zeros(4)
    >>> truth = QTable({"id": ids, "redshift": zero + 1, "frac_agn": zero})
    >>> matched = QTable({"id": ids, "selection": zero, "n_detected": zero + 2})
    >>> fit = QTable({"id": ids, "redshift_mean": [1.0, 1.02, 0.98, 1.8]})
    >>> fit["frac_agn_mean"] = [0.01, 0.03, 0.02, 0.3]
    >>> fit["frac_agn_std"] = 0.05
    >>> field = np.ones(4, bool)
    >>> one = TruthResults("agn00", 0.0, truth, matched, {"all": fit}, field)
    >>> study = StudyResults((one,), ("miri.f770w",))
    >>> from miricigale.evaluation import measure
    >>> measure(study, "z_outliers", seed=1).value
    0.25
    """
    check_names([quantity], "quantity", _MEASURES)
    sky = truth
    if isinstance(truth, (int, float)):
        sky = study.at(truth)
    if sky is None and not (truth is None and quantity in _OF_ALL + _TRENDS):
        return Estimate(np.nan)
    lacks_fit = sky is not None and quantity in OF_FITS and band_set not in sky.fits
    if lacks_fit or (quantity in _OF_BANDS and option not in study.bands):
        return Estimate(np.nan)
    draws = functools.partial(bootstrap, seed=seed, n_draws=n_draws)
    return _MEASURES[quantity][1](study, sky, band_set, option, draws)
