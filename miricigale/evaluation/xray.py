"""X-ray fluxes of AGN from their infrared light, and how complete a sample is along them."""

import dataclasses

import astropy.units as u
import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, ndtr, ndtri

from miricigale.evaluation.metrics import fraction_interval, one_by_one
from miricigale.sed.xray import stern2015, xray_flux
from miricigale.utils.arrays import finite_values
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts, declared
from miricigale.utils.tables import described_columns
from miricigale.utils.units import is_ascending, to_array

_CGS = u.erg / u.s / u.cm**2
#: Share of the X-rays that absorption leaves in Yang et al. 2021.
_TRANSMISSION = 0.5


@dataclasses.dataclass(frozen=True)
class XRayLimit:
    """
    A flux limit of an X-ray survey in 0.5-7 keV.

    Parameters
    ----------
    survey : str
        Name of the survey.
    flux : `~astropy.units.Quantity`
        The limit.
    kind : str
        What it is: that of the deepest part, or where half of the sources are found.
    reference : str
        Where it is from.
    checked : bool
        Whether the number itself was read in the reference; otherwise it is an estimate from what
        the reference says.

    Examples
    --------
    >>> from miricigale.evaluation import XRAY_LIMITS
    >>> for limit in XRAY_LIMITS:
    ...     print(limit.survey, limit.kind, limit.flux)
    CDF-S 7 Ms center 1.9e-17 erg / (s cm2)
    CDF-S 7 Ms 50 % 1.2e-16 erg / (s cm2)
    EGS 800 ks 50 % 3e-16 erg / (s cm2)
    """

    survey: str
    flux: u.Quantity
    kind: str
    reference: str
    checked: bool


#: The surveys that Yang et al. 2021 compare with. The two 50 % limits are estimates, for the abstracts of
#: Luo et al. 2017 (1.9e-17 in the central square arcmin) and of Nandra et al. 2015 have none: that of the
#: paper calls MIRI (50 % at about 1e-16) "slightly more sensitive" than the deepest survey, and Nandra et
#: al. call theirs a factor 2-3 shallower than the deep fields.
_XRAY_ROWS = declared("miricigale.evaluation", "population.toml")["xray"]["rows"]
XRAY_LIMITS = tuple(XRayLimit(row[0], row[1] * _CGS, *row[2:]) for row in _XRAY_ROWS)


def yang2021_xray_flux(l_6um, redshift):
    """
    Return the X-ray flux of an AGN as Yang et al. 2021 take it from the infrared.

    2-10 keV luminosity by `~miricigale.sed.stern2015`, a power law of Gamma 1.8, observed in 0.5-7 keV
    and halved for absorption.

    Parameters
    ----------
    l_6um : `~astropy.units.Quantity`
        nu L_nu of the AGN alone at rest 6 um.
    redshift : float or `~numpy.ndarray`
        Redshifts.

    Returns
    -------
    flux : `~astropy.units.Quantity`
        In erg / s / cm2.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import yang2021_xray_flux
    >>> flux = yang2021_xray_flux(10**42.6 * u.erg / u.s, 2.0)
    >>> print(f"{flux:.1e}")
    9.5e-17 erg / (s cm2)
    """
    return xray_flux(stern2015(l_6um), redshift, transmission=_TRANSMISSION)


def xray_luminosity_at(flux, redshift):
    """
    Return the rest-frame 2-10 keV luminosity, without absorption, of a source of a flux of `yang2021_xray_flux`.

    Parameters
    ----------
    flux : `~astropy.units.Quantity`
        In 0.5-7 keV.
    redshift : float or `~numpy.ndarray`
        Redshifts.

    Returns
    -------
    luminosity : `~astropy.units.Quantity`
        In erg / s.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import xray_luminosity_at
    >>> limit = 1e-16 * u.erg / u.s / u.cm**2
    >>> print(f"{xray_luminosity_at(limit, 2.0):.1e}")
    3.5e+42 erg / s
    """
    unit = u.erg / u.s
    received = unit / u.cm**2
    flux = to_array(flux, received, "flux") * received
    return (flux / xray_flux(1 * unit, redshift, transmission=_TRANSMISSION)).to(u.one) * unit


def completeness(values, found, edges):
    """
    Share of the sources that were found, in bins of a quantity.

    Parameters
    ----------
    values : array-like, shape (n,)
        The quantity; sources without a finite one are in no bin.
    found : array-like of bool, shape (n,)
        Whether each source was found.
    edges : array-like, shape (m + 1,)
        Ascending edges of the bins.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each bin: ``low``, ``high``, ``n``, ``n_found``, ``share`` and its 68 % (Wilson) interval
        ``share_low``, ``share_high``, NaN in bins without sources.

    Examples
    --------
    >>> from miricigale.evaluation import completeness
    >>> magnitude = [24.2, 24.4, 25.3, 25.6, 25.9]
    >>> table = completeness(magnitude, [True, True, True, False, False], [24, 25, 26])
    >>> table.round(2)
    >>> print(table["low", "high", "n", "n_found", "share"])
    low  high  n  n_found share
    ---- ---- --- ------- -----
    24.0 25.0   2       2   1.0
    25.0 26.0   3       1  0.33
    """
    values, detected = one_by_one(values=values, found=found)
    # of others it is not known
    values = values[np.isfinite(detected)]
    detected = finite_values(detected) > 0
    edges = floats(edges)
    check_that(is_ascending(edges, min_size=2), "edges", "ascending", edges)
    n, _ = np.histogram(values, edges)
    n_found, _ = np.histogram(values[detected], edges)
    shares = []
    for n_bin_found, n_bin in zip(n_found, n, strict=True):
        shares.append(fraction_interval(n_bin_found, n_bin))
    shares = np.array(shares)
    columns = {
        "low": edges[:-1],
        "high": edges[1:],
        "n": n,
        "n_found": n_found,
        "share": shares[:, 0],
        "share_low": shares[:, 1],
        "share_high": shares[:, 2],
    }
    return described_columns(columns, column_texts("miricigale.evaluation", "completeness"))


def half_complete(values, found):
    """
    Return the value above which sources are more likely found than not.

    The share found is taken as an error function of the value that rises to a share of the bright ones (some
    are lost whatever their value), with center, width and share of the highest likelihood.

    Parameters
    ----------
    values : array-like, shape (n,)
        A quantity on a scale on which completeness rises evenly: magnitudes with a minus, or the
        logarithm of a flux. Sources without a finite one are left out.
    found : array-like of bool, shape (n,)
        Whether each source was found; those of which it is masked are left out.

    Returns
    -------
    value : float
        NaN if all or none were found, or the curve passes one half nowhere within the values.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.evaluation import half_complete
    >>> rng = np.random.default_rng(1)
    >>> log_flux = rng.uniform(0, 2, 1000)
    >>> found = log_flux + rng.normal(0, 0.1, 1000) > 1
    >>> print(f"{half_complete(log_flux, found):.2f}")
    1.00
    """
    values, detected = one_by_one(values=values, found=found)
    good = np.isfinite(values) & np.isfinite(detected)
    values = values[good]
    detected = detected[good] > 0
    if not detected.any() or detected.all():
        return np.nan
    scale = max(float(values.std()), 1e-6)

    def curve(parameters):
        center, log_width, log_odds = parameters
        # a sharp limit has no finite width of the highest likelihood
        return center, np.exp(max(log_width, -20.0)), expit(log_odds)

    def unlikely(parameters):
        center, width, top = curve(parameters)
        chance = top * ndtr((values - center) / width)
        return -np.log(np.clip(np.where(detected, chance, 1.0 - chance), 1e-300, 1.0)).sum()

    start = 0.5 * (np.median(values[detected]) + np.median(values[~detected]))
    begin = [start, np.log(0.5 * scale), 3.0]
    best = minimize(unlikely, begin, method="Nelder-Mead", options={"maxiter": 1000}).x
    center, width, top = curve(best)
    if top <= 0.5:
        return np.nan
    half = center + width * ndtri(0.5 / top)
    if values.min() <= half <= values.max():
        return float(half)
    return np.nan
