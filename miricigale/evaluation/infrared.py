"""Infrared light of galaxies and AGN: shares of a component, and features seen in broad bands."""

import astropy.units as u
import numpy as np

from miricigale.evaluation.estimates import bootstrap, median
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import WAVE, positive, to_array

#: Rest wavelengths of the strong features of polycyclic aromatic hydrocarbons.
PAH_FEATURES = (3.3, 6.2, 7.7, 8.6, 11.3, 12.7) * u.um
#: Components of a model that are the AGN's.
_AGN_PARTS = ("agn_disk", "agn_torus", "agn_polar")


def light_share(wave, total, part, *, band=(5.0, 15.0) * u.um):
    """
    Share of a component in the light between two wavelengths.

    Parameters
    ----------
    wave : `~astropy.units.Quantity`, shape (n,)
        Rest wavelengths, ascending.
    total, part : `~astropy.units.Quantity` or array-like, shape (..., n)
        F_nu or L_nu of the whole and of the component, in one unit.
    band : `~astropy.units.Quantity`, shape (2,), optional
        Ends; by default those of the AGN fraction of Kirkpatrick et al. 2017.

    Returns
    -------
    share : float or `~numpy.ndarray`, shape (...)
        NaN where there is no light.

    Raises
    ------
    ValueError
        If the band is not within the wavelengths.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from miricigale.evaluation import light_share
    >>> wave = np.linspace(3, 20, 100) * u.um
    >>> total = np.ones(100) * u.uJy
    >>> print(f"{light_share(wave, total, 0.3 * total):.2f}")
    0.30
    """
    x = to_array(wave, WAVE, "wave", ndim=1)
    low, high = to_array(band, WAVE, "band", ndim=1)
    if not x[0] <= low < high <= x[-1]:
        raise argument_error("band", f"two ascending wavelengths in {x[0]:g}-{x[-1]:g} um", band)
    unit = u.Quantity(total).unit
    inner = x[(x > low) & (x < high)]
    grid = np.concatenate([[low], inner, [high]])

    def light(fnu):
        values = u.Quantity(fnu).to_value(unit)
        rows = values.reshape(-1, x.size)
        at_grid = np.array([np.interp(grid, x, row) for row in rows])
        # dnu = c dlambda / lambda^2
        out = np.trapezoid(at_grid / grid**2, grid, axis=1)
        return out.reshape(values.shape[:-1])

    whole, own = light(total), light(part)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(whole > 0, own / whole, np.nan)[()]


def mid_infrared_fractions(model, parameters):
    """
    AGN shares of the rest 5-15 um light of models: the AGN fraction of Kirkpatrick et al. 2017.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model.
    parameters : `~astropy.table.Table`
        A row for each source, columns by parameter name; others are left alone. Of the table of a
        fit the columns ``<name>_best`` have to be renamed first.

    Returns
    -------
    fractions : `~numpy.ndarray`, shape (n,)
        NaN for rows that cannot be evaluated.

    Examples
    --------
    >>> from astropy.table import QTable
    >>> from miricigale.evaluation import mid_infrared_fractions
    >>> from miricigale.sed import SEDModel
    >>> model = SEDModel.yang2021(libraries="bundled")
    >>> table = QTable({"frac_agn": [0.0, 0.3], "redshift": [1.0, 1.0], "mass": [1e10, 1e10]})
    >>> print(mid_infrared_fractions(model, table).round(2))
    [0.  0.3]
    """
    names = [name for name in parameters.colnames if name in model.parameters]
    out = np.full(len(parameters), np.nan)
    for k, row in enumerate(parameters):
        try:
            spectra = model.evaluate(**{name: row[name] for name in names})
        except ValueError:
            # outside of the libraries, or without a mass
            continue
        total, parts = spectra, spectra.components
        agn = sum((parts[name].fnu for name in _AGN_PARTS if name in parts), start=0 * total.fnu)
        out[k] = light_share(total.wave / (1 + total.redshift), total.fnu, agn)
    return out


def feature_magnitude(width, redshift, filter_width):
    """
    Magnitudes by which a feature within a broad band makes a source brighter.

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
    return 2.5 * np.log10(1.0 + width * (1.0 + np.asarray(redshift)) / band)


def feature_redshifts(feature, pivot, filter_width):
    """
    Redshifts between which a feature is within a band.

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
    rest = positive(feature, WAVE, "feature")
    middle = positive(pivot, WAVE, "pivot")
    half = 0.5 * positive(filter_width, WAVE, "filter_width")
    return max((middle - half) / rest - 1.0, 0.0), max((middle + half) / rest - 1.0, 0.0)


def feature_residuals(residual, redshift, *, feature, pivot, filter_width, seed):
    """
    Median residuals in a band of sources with a feature in it, and of the others.

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
    residual, redshift = np.asarray(residual, float), np.asarray(redshift, float)
    low, high = feature_redshifts(feature, pivot, filter_width)
    rows = (redshift >= low) & (redshift < high)
    return tuple(bootstrap(median, residual[keep], seed=seed) for keep in (rows, ~rows))
