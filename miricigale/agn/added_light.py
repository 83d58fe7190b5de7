"""Light of AGN of known luminosity, added to the photometry of galaxies."""

import numpy as np
from astropy.table import QTable

from miricigale.evaluation import agn_fraction
from miricigale.fitting.data.nuclei import CORRELATION, IS_LIMIT, NUCLEUS
from miricigale.utils.arrays import quiet_division
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
        Ascending fluxes and their errors in uJy, which do not fall. They are joined by straight lines, and are
        constant before the first. Beyond the last the variance grows with flux as photon noise does, as much as on
        average in the upper half of the curve.
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

    def at(self, flux):
        """Errors in uJy at fluxes in uJy, shape (n,)."""
        flux = floats(flux)
        error = np.interp(flux, self.flux, self.error)
        middle = len(self.flux) // 2
        width = self.flux[-1] - self.flux[middle]
        if not width > 0:
            return error
        slope = (self.error[-1] ** 2 - self.error[middle] ** 2) / width
        further = np.maximum(flux - self.flux[-1], 0.0)
        return np.sqrt(error**2 + slope * further)

    def ratio(self, flux, light):
        """Error of fluxes, shape (n,), with more light over that without."""
        return self.at(flux + light) / self.at(flux)


def nucleus_noise_curves(nuclei):
    """Make the `NoiseCurve` of each column ``<band>_nucleus`` of the nuclei of a catalog: dict by column."""
    curves = {}
    for name in nuclei.colnames:
        if not name.endswith(NUCLEUS):
            continue
        measured = _Measured.of_column(nuclei, name)
        curves[name] = NoiseCurve.of_band(
            np.where(measured.is_flux, measured.flux, np.nan), measured.error
        )
    return curves


def add_light(photometry, light, *, curves, seed):
    """
    Add light to the photometry of objects, with the noise that it has.

    The error of a flux becomes that of the catalog's other objects as bright (`NoiseCurve`), and noise is added by
    which the variance grows. Without light a flux and its error stay as they are, and so do upper limits and
    missing fluxes.

    The light is a point in the center. Where the nucleus of an object was measured beside its smooth light, all of
    the light is in the nucleus too, and the noise of both fluxes has their correlation.

    Parameters
    ----------
    photometry : `~astropy.table.QTable`
        ``id``, and for each band flux and error ``<band>_err``; where ``<band>_limit`` is true it is a limit.
        Of bands with fluxes of nuclei ``<band>_nucleus``, ``..._err``, ``..._corr`` and ``..._limit``.
    light : dict of str to `~astropy.units.Quantity`, shape (n,)
        Light of each object by band.
    curves : dict of str to `NoiseCurve`
        By band, and by the column ``<band>_nucleus`` of nuclei; see `NoiseCurve.of_band`.
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
        total = _Measured.of_column(table, band)
        noise = [stream(seed, "agn", "noise", band, str(key)).standard_normal() for key in ids]
        noise = np.array(noise)
        total_ratio = total.error_ratio(agn_flux, curves.get(band))
        total.add(table, band, agn_flux, total_ratio, noise)
        name = band + NUCLEUS
        if name not in table.colnames:
            continue
        nucleus = _Measured.of_column(table, name)
        correlation = np.nan_to_num(np.asarray(table[name + CORRELATION], float))
        own = [stream(seed, "agn", "noise", name, str(key)).standard_normal() for key in ids]
        noise = correlation * noise + np.sqrt(1.0 - correlation**2) * np.array(own)
        ratio = nucleus.error_ratio(agn_flux, curves.get(name))
        nucleus.add(table, name, agn_flux, ratio, noise)
        # covariances add up: that of the measurement and that of the added noise
        added = np.sqrt((total_ratio**2 - 1.0) * (ratio**2 - 1.0))
        table[name + CORRELATION] = correlation * (1.0 + added) / (total_ratio * ratio)
    return table


@value_class
class _Measured:
    """Fluxes of a column in uJy with their errors; ``is_flux`` where there is one that is no upper limit."""

    flux: np.ndarray
    error: np.ndarray
    is_flux: np.ndarray

    @classmethod
    def of_column(cls, table, name):
        """Of the column of this name, its errors and limits."""
        flux = to_array(table[name], FNU, name)
        error = to_array(table[error_column(name)], FNU, error_column(name))
        is_flux = np.isfinite(flux) & np.isfinite(error) & (error > 0)
        if name + IS_LIMIT in table.colnames:
            is_flux &= ~np.asarray(table[name + IS_LIMIT], bool)
        return cls(flux, error, is_flux)

    def error_ratio(self, light, curve):
        """Errors with light, (n,), over those without, by the `NoiseCurve`: 1 where nothing changes."""
        ratio = np.ones(light.size)
        changed = self.is_flux & (light > 0)
        if changed.any():
            ratio[changed] = curve.ratio(self.flux[changed], light[changed])
        return ratio

    def add(self, table, name, light, ratio, noise):
        """Put fluxes with light and noise, whose standard deviation is 1 in ``noise``, into the column."""
        changed = self.is_flux & (light > 0)
        wider = self.error * np.sqrt(ratio**2 - 1.0)
        table[name] = np.where(changed, self.flux + light + wider * noise, self.flux) * FNU
        table[error_column(name)] = np.where(changed, self.error * ratio, self.error) * FNU


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
    with quiet_division():
        power = np.where(wanted > 0, fraction / (1.0 - fraction), 0.0)
    power[np.isnan(wanted)] = np.nan
    light = {}
    for band in bands:
        flux = (half[band] - without[band]).to_value(FNU)
        # rounding may make a little less than nothing of it
        light[band] = np.maximum(flux, 0.0) * power * FNU
    return light, fraction
