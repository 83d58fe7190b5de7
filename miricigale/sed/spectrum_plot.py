"""Figures of spectra and of their parts."""

import astropy.units as u
import numpy as np

from miricigale.plotting.curves import plot_spectrum
from miricigale.sed.flux_units import flux_density_unit
from miricigale.utils.options import check_that

#: Faintest flux density that is shown with the parts, in units of the highest: faint parts span many decades.
_FAINTEST = 1e-6


def plot_sed(sed, ax, components, rest_frame, unit, **kwargs):
    """
    Draw a spectrum; see `miricigale.sed.SED.plot`.

    Parameters
    ----------
    sed : `~miricigale.sed.SED`
        The spectrum.
    ax : `~matplotlib.axes.Axes` or None
        Where to; the current axes if None.
    components : bool
        Whether the components are drawn too, with a legend.
    rest_frame : bool
        Whether the wavelengths are those at the source.
    unit : `~astropy.units.Unit` or str
        Unit of F_nu, F_lambda or nu F_nu.
    **kwargs
        Passed to `~matplotlib.axes.Axes.plot` for the spectrum itself.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    wave = sed.wave.value
    if rest_frame:
        wave = sed.rest_wavelength.value
    unit, symbol = flux_density_unit(unit)
    axes = {"rest_frame": rest_frame, "label_y": symbol}
    density = u.spectral_density(sed.wave)
    values = sed.fnu.to_value(unit, density)
    if not components:
        return plot_spectrum(wave, values, ax=ax, **axes, **kwargs)
    check_that(sed.components, "components", "False for a spectrum without components", True)
    kwargs = {"color": "black", "lw": 1.5, "label": "sum"} | kwargs
    ax = plot_spectrum(wave, values, ax=ax, **axes, **kwargs)
    low, high = ax.get_ylim()
    for name, part in sed.components.items():
        if np.any(part.fnu > 0):
            style = "--" if name.endswith("_intrinsic") else "-"
            label = name.replace("_", " ")
            options = {"label": label, "ls": style, "lw": 1}
            values = part.fnu.to_value(unit, density)
            plot_spectrum(wave, values, ax=ax, **axes, **options)
    ax.set_ylim(max(low, _FAINTEST * high), high)
    ax.legend(fontsize="small")
    return ax
