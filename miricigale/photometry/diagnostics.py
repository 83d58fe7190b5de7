"""What the residual of a fit says about it: noise, goodness of fit and flags."""

import dataclasses

import numpy as np

from miricigale.photometry.flags import POOR_CHI2, POOR_STRAIN, ForcedFlags
from miricigale.photometry.residual_sources import ResidualPeaks, residual_peaks

__all__ = ["Diagnostics", "diagnose", "source_flags"]


@dataclasses.dataclass(frozen=True, eq=False)
class Diagnostics:
    """
    A fit held against its image.

    Attributes
    ----------
    model, residual : `~numpy.ndarray`, shape (ny, nx)
        uJy per pixel; the residual is zero where the image is not usable.
    correlation : `~numpy.ndarray` or None
        Of the noise; None where it is taken as white.
    chi2, residual_fraction : `~numpy.ndarray`, shape (n,)
        Of each row of the bank; NaN where not fitted, and for second components.
    poor : bool `~numpy.ndarray`, shape (n,)
        Whether chi2 is too large for noise.
    peaks : `~miricigale.photometry.residual_sources.ResidualPeaks`
        Light that no template explains.
    """

    model: np.ndarray
    residual: np.ndarray
    correlation: np.ndarray | None
    chi2: np.ndarray
    residual_fraction: np.ndarray
    poor: np.ndarray
    peaks: ResidualPeaks


def diagnose(fit, xy):
    """
    Compare a fit with its image.

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
        The fit.
    xy : `~numpy.ndarray`, shape (n, 2)
        Positions of all known sources by the catalogue, NaN for those far outside.

    Returns
    -------
    diagnostics : `Diagnostics`
    """
    model = fit.model()
    residual = fit.residual(model)
    correlation = None
    if fit.settings.correlated_noise and len(fit.rows):
        correlation = fit.correlation(residual, model)
    chi2, left, core = fit.statistics(residual).T
    with np.errstate(divide="ignore", invalid="ignore"):
        left = left / (fit.total * core)
    out = np.ones(len(chi2), bool)
    out[fit.rows] = False
    out |= ~fit.main
    chi2, left = np.where(out, np.nan, chi2), np.where(out, np.nan, left)
    # where the measured noise is above that of the uncertainty, it is the measure
    lag = 0 if correlation is None else correlation.shape[0] // 2
    variance = 1.0 if correlation is None else max(1.0, correlation[lag, lag])
    peaks = residual_peaks(
        residual,
        model,
        fit.inverse_sigma,
        fit.psf_width,
        xy + fit.displacement(xy),
        new=fit.arrays.new,
        executor=fit.bank.executor,
    )
    poor = chi2 > POOR_CHI2 * variance
    if fit.free is not None:
        # what the high-resolution image shows is not what is fitted here
        poor[fit.rows] |= fit.free.strain > POOR_STRAIN
    return Diagnostics(model, residual, correlation, chi2, left, poor, peaks)


def source_flags(fit, diagnostics, place, flux, blending):
    """
    Flags that follow from the fit.

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
        The fit.
    diagnostics : `Diagnostics`
        What `diagnose` says of it.
    place : int `~numpy.ndarray`, shape (k,)
        Which source each row of the bank belongs to.
    flux : `~numpy.ndarray`, shape (n,)
        Fluxes of all sources, NaN where not measured.
    blending : `~numpy.ndarray`, shape (k,)
        Formal error over that of the source alone; NaN where not fitted.

    Returns
    -------
    flags : int `~numpy.ndarray`, shape (n,)
    coverage : `~numpy.ndarray`, shape (n,)
        Fraction of each template's light on usable pixels.
    """
    flags, inside, coverage = np.zeros(len(flux), int), np.zeros(len(flux)), np.zeros(len(flux))
    inside[place[fit.main]] = fit.light[fit.main, 0]
    coverage[place[fit.main]] = np.clip(fit.light[fit.main, 1], 0.0, 1.0)
    for rows, flag in (
        (inside < 0.9, ForcedFlags.EDGE),
        (coverage < 0.9 * np.minimum(inside, 1.0), ForcedFlags.MASKED),
        (place[fit.degenerate], ForcedFlags.DEGENERATE),
        (place[fit.inseparable], ForcedFlags.ONE_COMPONENT),
        (place[fit.noisy], ForcedFlags.NOISY_SEGMENT),
        (place[blending > 2], ForcedFlags.BLENDED),
        (place[diagnostics.poor], ForcedFlags.POOR_FIT),
    ):
        flags[rows] |= int(flag)
    flags[np.isnan(flux) & (flags & int(ForcedFlags.DEGENERATE) == 0)] |= int(ForcedFlags.NO_DATA)
    return flags, coverage
