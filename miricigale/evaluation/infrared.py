"""Infrared light of galaxies and AGN: features seen in broad bands."""

import astropy.units as u
import numpy as np

from miricigale.evaluation.estimates import bootstrap, median
from miricigale.utils.missing_values import floats
from miricigale.utils.units import WAVE, positive, to_array

#: Rest wavelengths of the strong features of polycyclic aromatic hydrocarbons.
PAH_FEATURES = (3.3, 6.2, 7.7, 8.6, 11.3, 12.7) * u.um


def feature_magnitude(width, redshift, filter_width):
    """
    Return the magnitudes by which a feature within a broad band makes a source brighter.

    Parameters
    ----------
    width : `~astropy.units.Quantity`
        Rest-frame equivalent width of the feature, or its change between a galaxy and a template.
    redshift : float or `~numpy.ndarray`
        Redshifts at which the feature is within the band.
    filter_width : `~astropy.units.Quantity`
        Rectangular width of the band (`miricigale.filters.Filter.width`).

    Returns
    -------
    magnitudes : float or `~numpy.ndarray`
        Positive.

    Examples
    --------
    A feature at 6.2 um of 0.5 um in F1500W at redshift 1.5 (Yang et al. 2021: 0.4 mag):

    >>> import astropy.units as u
    >>> from miricigale.evaluation import feature_magnitude
    >>> round(float(feature_magnitude(0.5 * u.um, 1.5, 2.92 * u.um)), 2)
    0.39
    """
    width = to_array(width, WAVE, "width")
    band = positive(filter_width, WAVE, "filter_width")
    return 2.5 * np.log10(1.0 + width * (1.0 + floats(redshift)) / band)


def feature_redshifts(feature, pivot, filter_width):
    """
    Return the redshifts between which a feature is within a band.

    Parameters
    ----------
    feature : `~astropy.units.Quantity`
        Rest wavelength (`PAH_FEATURES`).
    pivot, filter_width : `~astropy.units.Quantity`
        Pivot wavelength and rectangular width of the band.

    Returns
    -------
    low, high : float
        Not below 0.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.evaluation import feature_redshifts
    >>> low, high = feature_redshifts(6.2 * u.um, 15.06 * u.um, 2.92 * u.um)
    >>> print(f"{low:.2f} to {high:.2f}")
    1.19 to 1.66
    """
    rest_wave = positive(feature, WAVE, "feature")
    middle = positive(pivot, WAVE, "pivot")
    half = 0.5 * positive(filter_width, WAVE, "filter_width")
    return max((middle - half) / rest_wave - 1.0, 0.0), max((middle + half) / rest_wave - 1.0, 0.0)


def feature_residuals(residual, redshift, *, feature, pivot, filter_width, seed):
    """
    Return the median residuals in a band of sources with a feature in it, and of the others.

    Their difference is what the templates lack or have too much of the feature, to be compared with
    `feature_magnitude`.

    Parameters
    ----------
    residual : array-like, shape (n,)
        Observed minus model magnitudes; NaN is left out.
    redshift : array-like, shape (n,)
        Redshifts.
    feature, pivot, filter_width : `~astropy.units.Quantity`
        As in `feature_redshifts`.
    seed : int
        Of the bootstrap.

    Returns
    -------
    inside, outside : `~miricigale.evaluation.Estimate`
        Medians of the sources at redshifts with and without the feature in the band.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.evaluation import feature_residuals
    >>> z = np.linspace(0.5, 3, 50)
    >>> residual = np.where((z > 1.2) & (z < 1.65), -0.2, 0.0)
    >>> band = {"pivot": 15.06 * u.um, "filter_width": 2.92 * u.um}
    >>> inside, outside = feature_residuals(residual, z, feature=6.2 * u.um, seed=1, **band)
    >>> inside.value, outside.value
    (-0.2, 0.0)
    """
    residual = floats(residual)
    redshift = floats(redshift)
    low, high = feature_redshifts(feature, pivot, filter_width)
    rows = (redshift >= low) & (redshift < high)
    return tuple(bootstrap(median, residual[keep], seed=seed) for keep in (rows, ~rows))
