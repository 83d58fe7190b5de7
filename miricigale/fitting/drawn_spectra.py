"""Spectra of models drawn from posteriors: methods of `~miricigale.fitting.Samples`."""

import astropy.units as u
import numpy as np

from miricigale.fitting.posterior import check_levels
from miricigale.sed import grid_spectra
from miricigale.utils.tables import described_table
from miricigale.utils.units import FNU, WAVE

#: Levels of percentiles.
LEVELS = (0.16, 0.5, 0.84)


def suffix(level):
    """Name of the percentile of a level, in columns."""
    return f"p{100 * level:g}"


def spectra(samples, key, *, rest=True):
    """
    Spectra of the draws of one object; different galaxies and AGN models are evaluated once.

    Parameters
    ----------
    key : object
        Id of the object.
    rest : bool, optional
        Whether in the rest frame (L_nu as it leaves the galaxy, without absorption between
        the galaxies and in the Milky Way) or as observed (F_nu, with both).

    Returns
    -------
    wave : `~astropy.units.Quantity`, shape (n_wave,)
        Wavelengths in um; of the observed spectra those that all draws cover, in the steps
        of the median redshift.
    spectra : `~astropy.units.Quantity`, shape (n_draws, n_wave)
        In W / Hz or uJy.
    """
    one = samples.loc[key]._fitted_one()
    function = grid_spectra.rest_spectra if rest else grid_spectra.observed_spectra
    wave, values = function(samples._model(), samples.grid, one.index, one.scale)
    return wave * WAVE, values * (u.W / u.Hz if rest else FNU)


def sed_band(samples, key, levels=LEVELS, *, rest=True):
    """
    Percentiles of the spectrum of one object.

    Parameters
    ----------
    key, rest : optional
        See `spectra`.
    levels : tuple of float, optional
        Levels of the percentiles, in (0, 1).

    Returns
    -------
    table : `~astropy.table.QTable`
        ``wave`` and a column for each level (``p16``, ``p50``, ``p84``), taken at every
        wavelength by itself: L_nu in W / Hz, or F_nu in uJy as observed.
    """
    levels = check_levels(levels)
    wave, values = spectra(samples, key, rest=rest)
    columns = {"wave": (wave, f"{'rest' if rest else 'observed'} wavelength")}
    for level, row in zip(levels, np.quantile(values.value, levels, axis=0), strict=True):
        text = f"quantile {level:g} of {'L_nu' if rest else 'F_nu'}"
        columns[suffix(level)] = (row * values.unit, text)
    return described_table(columns, dict(samples.meta) | {"id": str(key), "rest": bool(rest)})


def plot_sed_band(samples, key, ax=None, *, levels=LEVELS, rest=True, **kwargs):
    """Draw `sed_band`; returns the axes."""
    from miricigale.plotting.posteriors import plot_sed_band

    table = sed_band(samples, key, levels, rest=rest)
    bands = [table[name] for name in table.colnames[1:]]
    return plot_sed_band(table["wave"], bands, ax=ax, rest=rest, **kwargs)
