"""Spectra and the photometry on them."""

import numpy as np

from miricigale.plotting.axes import resolve_axes

__all__ = ["plot_photometry", "plot_spectrum"]


def plot_spectrum(wave, fnu, ax=None, **kwargs):
    """
    Draw a spectrum on logarithmic axes.

    Parameters
    ----------
    wave : `~numpy.ndarray`, shape (n,)
        Observed wavelengths in um.
    fnu : `~numpy.ndarray`, shape (n,)
        Flux densities in uJy; values that are not positive are left out.
    ax : `~matplotlib.axes.Axes`, optional
        Where to; the current axes if not given.
    **kwargs
        Passed to `~matplotlib.axes.Axes.plot`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    fnu = np.where(np.asarray(fnu) > 0.0, fnu, np.nan)
    ax.plot(wave, fnu, **kwargs)
    _label(ax)
    return ax


def plot_photometry(wave, flux, error=None, ax=None, **kwargs):
    """
    Draw band fluxes with errors on logarithmic axes.

    Parameters
    ----------
    wave : `~numpy.ndarray`, shape (n,)
        Pivot wavelengths in um.
    flux, error : `~numpy.ndarray`, shape (n,)
        Fluxes and their 1-sigma errors in uJy; NaN is a missing band. A flux below its error is
        drawn as an upper limit of three errors.
    ax : `~matplotlib.axes.Axes`, optional
        Where to; the current axes if not given.
    **kwargs
        Passed to `~matplotlib.axes.Axes.errorbar`.

    Returns
    -------
    ax : `~matplotlib.axes.Axes`
    """
    ax = resolve_axes(ax)
    wave, flux = np.asarray(wave, dtype=float), np.asarray(flux, dtype=float)
    error = np.zeros(flux.shape) if error is None else np.asarray(error, dtype=float)
    style = {"fmt": "o", "markersize": 4, "color": "k", **kwargs}
    known = np.isfinite(flux) & np.isfinite(error)
    seen = known & (flux > error) & (flux > 0.0)
    limit = known & ~seen & (error > 0.0)
    ax.errorbar(wave[seen], flux[seen], yerr=error[seen], **style)
    style.pop("label", None)
    top = 3.0 * error[limit]
    ax.errorbar(wave[limit], top, yerr=0.3 * top, uplims=True, **style)
    _label(ax)
    return ax


def _label(ax):
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.set_xlabel("observed wavelength (µm)")
    ax.set_ylabel(r"$F_\nu$ (µJy)")
