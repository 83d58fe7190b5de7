"""What fits of sources of known redshift say of models and catalogs: template error and zero points."""

import itertools
from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable
from scipy.optimize import brentq

from miricigale.filters import FilterSet
from miricigale.fitting.likelihood import per_band
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.tables import described_table, error_column, require_columns
from miricigale.utils.units import FNU, WAVE, check_count, frozen_array, to_array

__all__ = [
    "TemplateError",
    "apply_zero_points",
    "calibrate_zero_points",
    "measure_band_errors",
    "measure_template_error",
]

#: Fluxes of lower S/N say more of their noise than of the models.
_LEAST_SIGNAL = 5.0
#: Median of the absolute value of a normal deviate.
_MEDIAN = 0.6744897501960817
#: Largest template error that is looked for.
_MOST = 10.0
#: Edges in um of the bins of rest wavelength; wider where few bands fall.
_EDGES = (
    0.09,
    0.17,
    0.22,
    0.28,
    0.36,
    0.45,
    0.6,
    0.8,
    1.1,
    1.5,
    2.0,
    2.6,
    3.1,
    3.6,
    4.5,
    5.5,
    7.0,
    9.0,
    12.0,
)
#: What `measure_template_error` found with `_EDGES`; see `TemplateError.survey`.
_SURVEY = (0.036, 0.053, 0.055, 0.073, 0.050, 0.063, 0.051, 0.054, 0.066, 0.056, 0.046)
_SURVEY += (0.097, 0.135, 0.156, 0.168, 0.208, 0.256, 0.279)


@dataclass(frozen=True, eq=False)
class TemplateError:
    """
    How well models represent real galaxies, by rest wavelength (Brammer et al. 2008, ApJ 686, 1503).

    At every redshift of a grid the flux of a band has this part of it added to its error in quadrature, at
    the band's pivot wavelength over 1 + z. The likelihood keeps its normalization: a redshift is not
    preferred for putting bands where errors are large.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Ascending rest wavelengths.
    error : array_like, shape (n,)
        Error as a part of the flux; linear between logarithms of wavelength, constant outside.

    Raises
    ------
    `~astropy.units.UnitsError`
        If wavelengths have no unit of length.
    ValueError
        If wavelengths do not ascend from above 0, or errors are negative, not finite or not as many.
    """

    wave: u.Quantity
    error: np.ndarray

    def __post_init__(self):
        wave, error = to_array(self.wave, WAVE, "wave", ndim=1), np.asarray(self.error, dtype=float)
        if wave.size == 0 or not (wave[0] > 0 and np.all(np.diff(wave) > 0)):
            raise argument_error("wave", "ascending values above 0", f"{wave}")
        if error.shape != wave.shape or not np.all(np.isfinite(error) & (error >= 0)):
            raise argument_error("error", f"{wave.size} finite values, 0 or more", f"{error}")
        object.__setattr__(self, "wave", frozen_array(wave) * WAVE)
        object.__setattr__(self, "error", frozen_array(error))

    def __call__(self, wave):
        """Error at rest wavelengths (`~astropy.units.Quantity`): `~numpy.ndarray` of their shape."""
        wave = to_array(wave, WAVE, "wave")
        return np.interp(np.log(wave), np.log(self.wave.to_value(WAVE)), self.error)

    @classmethod
    def survey(cls):
        """
        Template error of `~miricigale.sed.SEDModel.survey`.

        Measured by `measure_template_error` (``benchmarks/ceers.py``) on 386 sources of CEERS (Finkelstein et
        al. 2023, ApJL 946, L13) in HST, NIRCam and MIRI bands as published by Lisiecki et al. 2025, with S/N
        above 5 in two MIRI bands and five others, at the published redshifts, most of which are photometric:
        the mean of two halves of the sample. Errors of the MIRI bands of that catalog, which are not those of
        models (`measure_band_errors`), are not in it.
        """
        edges = np.array(_EDGES)
        return cls(np.sqrt(edges[1:] * edges[:-1]) * WAVE, _SURVEY)


def _pivots(filters):
    """Pivot wavelengths of a `FilterSet`, or of bands by name."""
    filters = filters if isinstance(filters, FilterSet) else FilterSet.from_names(filters)
    return u.Quantity([one.pivot for one in filters]).to(WAVE)


def grid_errors(template_error, filters, redshift):
    """Template errors of bands at the redshifts of a grid: shape (nz, nb); None if there are none."""
    if template_error is None:
        return None
    if not isinstance(template_error, TemplateError):
        raise argument_error("template_error", "a TemplateError or None", repr(template_error))
    return template_error(_pivots(filters) / (1.0 + np.asarray(redshift)[:, None]))


def _residuals(results):
    """Fluxes, errors, best models and pivots of fits at known redshifts, and which fluxes count."""
    if not results.redshift_fixed:
        wanted = "of fits at known redshifts (fitter.fit(photometry, redshift=...))"
        raise argument_error("results", wanted, "redshifts that were free")
    flux, error, model = results.flux, results.flux_err, results.best_flux
    with np.errstate(invalid="ignore"):
        good = results.fitted[:, None] & np.isfinite(results.sigma) & ~results.limit & (model > 0)
        good &= flux > _LEAST_SIGNAL * error
    return flux, error, model, good


def _excess(flux, error, model, some):
    """What has to be added to errors, as a part of the flux, for some pulls to have a normal median."""
    f, e, apart = flux[some], error[some], np.abs(flux - model)[some]

    def excess(part):
        return np.median(apart / np.hypot(e, part * f)) - _MEDIAN

    return brentq(excess, 0.0, _MOST, xtol=1e-4) if excess(0.0) > 0 > excess(_MOST) else 0.0


def _rest(results):
    """Rest wavelengths of all bands in um, shape (n, nb)."""
    return _pivots(results.filters).value / (1.0 + results.best["redshift"].value[:, None])


def measure_band_errors(results, template_error, bands, *, longest=2.5 * u.um, n_min=10):
    """
    Measure errors of bands that are not those of models: other apertures, PSFs and blends than the rest.

    What is left, in each band, of the scatter about the best models once the template error is taken off,
    at rest wavelengths where starlight makes the flux and other bands have measured it.

    Parameters
    ----------
    results : `FitResults`
        Of a fit at known redshifts.
    template_error : `TemplateError`
        That of the fit.
    bands : list of str
        The bands, such as those of MIRI in a catalog made for NIRCam.
    longest : `~astropy.units.Quantity`, optional
        Longest rest wavelength that is looked at.
    n_min : int, optional
        Fluxes of S/N above 5 without which a band gets the median of the others.

    Returns
    -------
    errors : dict of str to float
        Parts of the flux, for ``model_error`` of `BayesFitter`.

    Raises
    ------
    KeyError
        If a band was not fitted.
    ValueError
        If redshifts were free, or no band has as many fluxes.
    """
    flux, error, model, good = _residuals(results)
    rest, n_min = _rest(results), check_count(n_min, "n_min")
    good &= rest < to_array(longest, WAVE, "longest", ndim=0)
    error = np.hypot(error, template_error(rest * WAVE) * flux)
    out = {}
    for name in bands:
        if name not in results.fitted_filters:
            raise unknown_name("band that was fitted", name, results.fitted_filters)
        i = results.filters.index(name)
        if np.count_nonzero(good[:, i]) >= n_min:
            out[name] = _excess(*(array[:, i] for array in (flux, error, model, good)))
    if not out:
        raise argument_error("results", f"with {n_min} fluxes of S/N above 5 in a band", "fewer")
    return {name: float(out.get(name, np.median([*out.values()]))) for name in bands}


def measure_template_error(results, *, edges=None, n_min=10, model_error=None):
    """
    Measure the template error from fits of real sources at known redshifts.

    In each bin of rest wavelength it is what has to be added to the errors of fluxes for the median of
    abs(flux - best model) over the error to be that of a normal distribution. Best models of fits with
    another template error weigh bands otherwise: repeat until it no longer changes, from model errors
    of some 10 %. Residuals are smaller than errors by the parameters that were fitted, and a function that
    is tested on the sources it was measured on looks better than it is: measure it on one half.

    Parameters
    ----------
    results : `FitResults`
        Of a fit at known redshifts.
    edges : `~astropy.units.Quantity`, shape (n + 1,), optional
        Edges of the bins.
    n_min : int, optional
        Fluxes of S/N above 5 without which a bin is left out.
    model_error : dict of str to float, optional
        Errors of bands that are not the models', as parts of the flux (`measure_band_errors`).

    Returns
    -------
    error : `TemplateError`

    Raises
    ------
    ValueError
        If redshifts were free, or no bin has as many fluxes.
    """
    edges = to_array(_EDGES * WAVE if edges is None else edges, WAVE, "edges", ndim=1)
    n_min = check_count(n_min, "n_min")
    flux, error, model, good = _residuals(results)
    rest = _rest(results)
    of_band = per_band(model_error or {}, results.filters, "model_error")
    error = np.hypot(error, np.array([*of_band.values()]) * flux)
    wave, found = [], []
    for low, high in itertools.pairwise(edges):
        some = good & (rest >= low) & (rest < high)
        if np.count_nonzero(some) < n_min:
            continue
        wave.append(np.sqrt(low * high))
        found.append(_excess(flux, error, model, some))
    if not wave:
        raise argument_error("results", f"with {n_min} fluxes of S/N above 5 in a bin", "fewer")
    return TemplateError(wave * WAVE, found)


def calibrate_zero_points(results, *, reference=None, n_min=30):
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
    n_min : int, optional
        Sources of S/N above 5 without which a band keeps a factor of 1.

    Returns
    -------
    zero_points : `~astropy.table.QTable`
        A row for each band that was fitted: ``band``, ``n`` sources, ``factor``, one over the median of
        flux over best model, and ``factor_err``, from their scatter.

    Raises
    ------
    KeyError
        If the reference is no band that was fitted.
    ValueError
        If redshifts were free, or the reference has fewer sources than ``n_min``.
    """
    n_min = check_count(n_min, "n_min")
    flux, _, model, good = _residuals(results)
    bands = list(results.fitted_filters)
    columns = [results.filters.index(name) for name in bands]
    n = good[:, columns].sum(axis=0)
    if reference is None:
        reference = bands[int(np.argmax(n))]
    elif reference not in bands:
        raise unknown_name("band that was fitted", reference, bands)
    if n[bands.index(reference)] < n_min:
        wanted = f"a band with {n_min} sources of S/N above 5"
        raise argument_error("reference", wanted, f"{reference} with {n[bands.index(reference)]}")
    factor, scatter = np.ones(len(bands)), np.full(len(bands), np.nan)
    for i in np.flatnonzero(n >= n_min):
        some = good[:, columns[i]]
        ratio = np.log(model[some, columns[i]] / flux[some, columns[i]])
        middle = np.median(ratio)
        factor[i] = np.exp(middle)
        # standard error of a median
        scatter[i] = np.sqrt(np.pi / (2.0 * n[i])) * np.median(np.abs(ratio - middle)) / _MEDIAN
    known = n >= n_min
    factor[known] /= factor[bands.index(reference)]
    texts = {
        "band": (np.array(bands), "band"),
        "n": (n, "sources of S/N above 5"),
        "factor": (factor, "what fluxes are to be multiplied by; 1 where sources are too few"),
        "factor_err": (factor * scatter, "its 1-sigma error"),
    }
    return described_table(texts, {"reference": reference})


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
        A copy; ``meta["zero_points"]`` has the factors.

    Raises
    ------
    ValueError
        If a column is missing.
    """
    require_columns(zero_points, ["band", "factor"], "zero_points")
    factors = {
        str(b): float(f) for b, f in zip(zero_points["band"], zero_points["factor"], strict=True)
    }
    columns = [c for name in factors for c in (name, error_column(name))]
    require_columns(photometry, columns, "photometry", units=dict.fromkeys(columns, FNU))
    out = QTable(photometry, copy=True)
    for name, factor in factors.items():
        for column in (name, error_column(name)):
            out[column] = out[column] * factor
    out.meta["zero_points"] = factors
    return out
