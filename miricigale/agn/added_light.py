"""Light of AGN of known luminosity, added to the photometry of galaxies."""

import numpy as np
from astropy.table import QTable

from miricigale.evaluation import agn_fraction
from miricigale.utils.column_units import quantity_table
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_that
from miricigale.utils.random import check_seed, stream
from miricigale.utils.tables import error_column, read_ids, require_columns
from miricigale.utils.units import FNU, LUMINOSITY, are_not_negative, to_array
from miricigale.utils.values import value_class

#: Most bins of flux in which errors of a band are looked at, and least number of fluxes in each.
_MOST_BINS = 20
_LEAST_FLUXES = 20


@value_class
class NoiseCurve:
    """
    Error of a band as a function of flux, as a catalog has it.

    Parameters
    ----------
    flux, error : `~numpy.ndarray`, shape (n,)
        Ascending fluxes and their errors in uJy, which do not fall. They are joined by straight lines and constant
        beyond the ends.
    """

    flux: np.ndarray
    error: np.ndarray

    @classmethod
    def of_band(cls, flux, error):
        """
        Measure the curve by medians in bins of equal numbers of fluxes.

        Parameters
        ----------
        flux, error : `~numpy.ndarray`, shape (n,)
            Fluxes and errors in uJy; those that are not finite, or whose error is not positive, are left out.

        Returns
        -------
        curve : `NoiseCurve` or None
            None without any flux.
        """
        flux = floats(flux)
        error = floats(error)
        good = np.isfinite(flux) & np.isfinite(error) & (error > 0)
        if not good.any():
            return None
        order = np.argsort(flux[good], kind="stable")
        flux = flux[good][order]
        error = error[good][order]
        n_bins = int(np.clip(flux.size // _LEAST_FLUXES, 1, _MOST_BINS))
        flux = [np.median(part) for part in np.array_split(flux, n_bins)]
        error = [np.median(part) for part in np.array_split(error, n_bins)]
        # more light has no less noise
        return cls(np.array(flux), np.maximum.accumulate(error))

    def ratio(self, flux, light):
        """Error of fluxes, shape (n,), with more light over that without."""
        before = np.interp(flux, self.flux, self.error)
        return np.interp(flux + light, self.flux, self.error) / before


def add_light(photometry, light, *, curves, seed):
    """
    Add light to the photometry of objects, with the noise that it has.

    The error of a flux becomes that of the catalog's other objects as bright (`NoiseCurve`), and noise is added by
    which the variance grows. Without light a flux and its error stay as they are, and so do upper limits and
    missing fluxes.

    Parameters
    ----------
    photometry : `~astropy.table.QTable`
        ``id``, and for each band flux and error ``<band>_err``; where ``<band>_limit`` is true it is a limit.
    light : dict of str to `~astropy.units.Quantity`, shape (n,)
        Light of each object by band.
    curves : dict of str to `NoiseCurve`
        By band; see `NoiseCurve.of_band`.
    seed : int or `~numpy.random.Generator`
        Every object has its own stream, by its id.

    Returns
    -------
    photometry : `~astropy.table.QTable`
        A copy.

    Raises
    ------
    ValueError
        If a column is missing, or light is negative or not finite.
    """
    columns = []
    for band in light:
        columns += [band, error_column(band)]
    require_columns(photometry, ["id"] + columns, "photometry", units=dict.fromkeys(columns, FNU))
    seed = check_seed(seed)
    table = quantity_table(photometry, copy=True)
    ids = read_ids(table)
    for band, agn_flux in light.items():
        agn_flux = to_array(agn_flux, FNU, "light", ndim=1)
        wanted = f"finite and 0 or more in {band}"
        check_that(are_not_negative(agn_flux), "light", wanted, "others")
        flux = to_array(table[band], FNU, band)
        error = to_array(table[error_column(band)], FNU, error_column(band))
        changed = np.isfinite(flux) & np.isfinite(error) & (error > 0) & (agn_flux > 0)
        if f"{band}_limit" in table.colnames:
            changed &= ~np.asarray(table[f"{band}_limit"], bool)
        ratio = np.ones(len(table))
        if changed.any():
            ratio[changed] = curves[band].ratio(flux[changed], agn_flux[changed])
        noise = [stream(seed, "agn", "noise", band, str(key)).standard_normal() for key in ids]
        wider = error * np.sqrt(np.maximum(ratio**2 - 1.0, 0.0))
        table[band] = np.where(changed, flux + agn_flux + wider * np.array(noise), flux) * FNU
        table[error_column(band)] = np.where(changed, error * ratio, error) * FNU
    return table


def draw_agn_parameters(axes, n, rng):
    """
    Draw parameters of AGN models from the prior of a fit.

    Parameters
    ----------
    axes : dict of str to `~miricigale.fitting.posterior.priors.GridAxis`
        Parameters of the fit, of which those of AGN are drawn.
    n : int
        Number of models.
    rng : `~numpy.random.Generator`
        Generator.

    Returns
    -------
    values : dict of str to `~numpy.ndarray`, shape (n,)
        By name: labels at nodes, others anywhere in the cells of these.
    """
    values = {}
    for name, axis in axes.items():
        if axis.kind != "agn":
            continue
        low, high = np.clip(axis.cells(axis.bounds), axis.values[0], axis.values[-1])
        node = rng.choice(axis.values.size, n, p=axis.weights)
        values[name] = (low[node] + rng.random(n) * (high[node] - low[node])) * axis.unit
    return values


def agn_light(model, hosts, luminosity, parameters, bands, *, quantity="accretion_power"):
    """
    Fluxes of AGN of given luminosities in the galaxies of best fits.

    Parameters
    ----------
    model : `~miricigale.sed.SEDModel`
        The model that was fitted.
    hosts : `~miricigale.fitting.FitResults`
        Fits of the n galaxies, of whose best models the AGN are, without that model's own AGN.
    luminosity : `~astropy.units.Quantity`, shape (n,)
        Luminosities of the AGN; 0 is none, and masked or NaN is not known.
    parameters : dict of str to `~numpy.ndarray`, shape (n,)
        Parameters of the AGN models.
    bands : list of str
        Bands of the fluxes.
    quantity : str, optional
        Which luminosity is meant: a derived quantity of the models.

    Returns
    -------
    light : dict of str to `~astropy.units.Quantity`, shape (n,)
        Fluxes by band; NaN where the luminosity is not known or there is no such model, as in a galaxy whose dust
        has no luminosity, on which the AGN fraction is based.
    frac_agn : `~numpy.ndarray`, shape (n,)
        AGN fractions.

    Raises
    ------
    ValueError
        If the model has no AGN, or there are other numbers of luminosities and galaxies.
    """
    wanted = to_array(luminosity, LUMINOSITY, "luminosity", ndim=1)
    check_that(wanted.size == len(hosts), "luminosity", f"{len(hosts)} values", wanted.size)
    table = QTable({"redshift": hosts.best["redshift"], "mass": hosts.best["mass"]})
    for name, value in hosts.constants.items():
        table[name] = np.full(len(hosts), value)
    for name, axis in hosts.axes.items():
        if axis.kind == "galaxy":
            table[name] = hosts.best[name]
    for name, values in parameters.items():
        if not hasattr(values, "unit"):
            values = floats(values)
        table[name] = values
    table["frac_agn"] = np.zeros(len(hosts))
    without = model.fluxes(table, bands)
    table["frac_agn"] = np.full(len(hosts), 0.5)
    half = model.fluxes(table, bands)
    check_that(
        quantity in half.colnames, "model", f"one with AGN, whose {quantity} is known", model
    )
    fraction = agn_fraction(wanted * LUMINOSITY, half[quantity])
    # the power of an AGN goes as this, which is 1 of that with a half
    with np.errstate(invalid="ignore", divide="ignore"):
        power = np.where(wanted > 0, fraction / (1.0 - fraction), 0.0)
    power[np.isnan(wanted)] = np.nan
    light = {}
    for band in bands:
        flux = (half[band] - without[band]).to_value(FNU)
        # rounding may make a little less than nothing of it
        light[band] = np.maximum(flux, 0.0) * power * FNU
    return light, fraction
