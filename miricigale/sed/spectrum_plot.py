"""Figures of spectra and of their parts."""

import astropy.units as u
import numpy as np

from miricigale.filters import FilterSet
from miricigale.plotting.axes import resolve_axes
from miricigale.plotting.curves import plot_spectrum
from miricigale.sed.flux_units import flux_density_unit
from miricigale.utils.options import check_that

#: Faintest flux density that is shown with the parts, in units of the highest: faint parts span many decades.
_FAINTEST = 1e-6
#: Wavelengths at the source in um that are shown, from the Lyman limit to the millimeter.
_SHOWN_REST = np.array([0.09, 1000.0])
#: How far beyond the bands a spectrum is shown with them.
_AROUND_BANDS = 3.0


def plot_sed(sed, ax, components, filters, rest_frame, unit, **kwargs):
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
    filters : `~miricigale.filters.FilterSet`, list or None
        Bands whose fluxes are drawn too.
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
    if components:
        check_that(sed.components, "components", "False for a spectrum without components", True)
        kwargs = {"color": "black", "lw": 1.5, "label": "sum"} | kwargs
    ax = resolve_axes(ax)
    is_first = not ax.has_data()
    plot_spectrum(wave, values, ax=ax, **axes, **kwargs)
    limits = _SHOWN_REST
    if not rest_frame:
        limits = limits * (1 + sed.redshift)
    if filters is not None:
        filters = FilterSet(filters)
        _plot_bands(sed, filters, ax, rest_frame, unit)
        pivots = filters.pivots.to_value(sed.wave.unit)
        if rest_frame:
            pivots = pivots / (1 + sed.redshift)
        limits = np.array([pivots.min() / _AROUND_BANDS, pivots.max() * _AROUND_BANDS])
    if is_first:
        # axes with other curves keep their limits
        _limit_to(ax, wave, values, limits)
    if not components:
        return ax
    low, high = ax.get_ylim()
    for name, part in sed.components.items():
        if np.any(part.fnu > 0):
            style = "--" if name.endswith("_intrinsic") else "-"
            label = name.replace("_", " ")
            options = {"label": label, "ls": style, "lw": 1}
            values = part.fnu.to_value(unit, density)
            plot_spectrum(wave, values, ax=ax, **axes, **options)
    # a decade below the sum for the parts
    ax.set_ylim(max(0.1 * low, _FAINTEST * high), high)
    ax.legend(fontsize="small")
    return ax


def _limit_to(ax, wave, values, limits):
    """Show a range of wavelengths, cut to those of a spectrum, and the flux densities in it."""
    low = max(limits[0], wave.min())
    high = min(limits[1], wave.max())
    shown = values[(wave >= low) & (wave <= high) & (values > 0)]
    if low >= high or not shown.size:
        return
    peak = shown.max()
    ax.set_xlim(low, high)
    ax.set_ylim(max(shown.min() / 1.5, _FAINTEST * peak), 1.5 * peak)


def _plot_bands(sed, filters, ax, rest_frame, unit):
    """Draw the fluxes of a spectrum in bands, over the widths of these."""
    pivot = u.Quantity([filter_.pivot for filter_ in filters])
    half_width = u.Quantity([filter_.width for filter_ in filters]) / 2
    flux = filters.synthetic_fluxes(sed).to_value(unit, u.spectral_density(pivot))
    if rest_frame:
        pivot = pivot / (1 + sed.redshift)
        half_width = half_width / (1 + sed.redshift)
    wave_unit = sed.wave.unit
    ax.errorbar(
        pivot.to_value(wave_unit), flux, xerr=half_width.to_value(wave_unit), fmt="o", ms=4, color="tab:red",
        label="in the bands", zorder=3,
    )  # fmt: skip
