"""Stars among the sources: black bodies through every band."""

import astropy.units as u
import numpy as np
from astropy.modeling.models import BlackBody
from astropy.table import QTable

from miricigale.filters import FilterSet
from miricigale.utils.arrays import quiet_division
from miricigale.utils.named_values import places

TEMPERATURES = np.geomspace(2000, 30000, 120) * u.K
WAVELENGTHS = np.geomspace(0.2, 40, 1500) * u.um


def star_fluxes(catalog, measured, wanted):
    """
    Predict fluxes (uJy) of stars in any band, from the black body that fits their measured ones best.

    ``catalog`` has fluxes in the ``measured`` bands, of which NaN is left out. The table has
    ``temperature`` and a column for each wanted band; beyond a few um any photosphere without dust is
    close to the Rayleigh-Jeans law.
    """
    measured = list(measured)
    wanted = list(wanted)
    filters = FilterSet.from_names(list(dict.fromkeys(measured + wanted)))
    fitted = places(measured, filters.names)
    predicted = places(wanted, filters.names)
    spectra = (BlackBody(TEMPERATURES[:, None])(WAVELENGTHS) * u.sr).to_value(u.uJy)
    weights = filters.weights(WAVELENGTHS)
    models = np.array([weights @ spectrum for spectrum in spectra])
    data = np.array([catalog[name].to_value(u.uJy) for name in measured]).T
    good = np.isfinite(data) & (data > 0)
    # least squares in the logarithm: equal relative errors, the scale is the mean ratio
    with quiet_division():
        ratio = np.where(good[:, None], np.log(data[:, None] / models[None][:, :, fitted]), 0.0)
    count = np.maximum(good.sum(axis=1), 1)[:, None]
    scale = ratio.sum(axis=2) / count
    scatter = np.where(good[:, None], (ratio - scale[..., None]) ** 2, 0.0).sum(axis=2)
    best = np.argmin(scatter, axis=1)
    rows = np.arange(len(catalog))
    fluxes = np.exp(scale[rows, best])[:, None] * models[np.ix_(best, predicted)]
    fluxes[~good.any(axis=1)] = np.nan
    table = QTable({"temperature": TEMPERATURES[best]})
    for k, name in enumerate(wanted):
        table[name] = fluxes[:, k] * u.uJy
    return table
