"""What the residual of a fit says about it: noise, goodness of fit and flags."""

import dataclasses

import numpy as np

from miricigale.photometry.flags import POOR_CHI2, ForcedFlags, unexplained_neighbours

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
        Of each row of the bank; NaN where not fitted.
    poor : bool `~numpy.ndarray`, shape (n,)
        Whether chi2 is too large for noise.
    """

    model: np.ndarray
    residual: np.ndarray
    correlation: np.ndarray | None
    chi2: np.ndarray
    residual_fraction: np.ndarray
    poor: np.ndarray


def diagnose(fit):
    """
    Compare a fit with its image.

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`

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
        left = left / (fit.flux * core)
    out = np.ones(len(chi2), bool)
    out[fit.rows] = False
    chi2, left = np.where(out, np.nan, chi2), np.where(out, np.nan, left)
    # where the measured noise is above that of the uncertainty, it is the measure
    lag = 0 if correlation is None else correlation.shape[0] // 2
    variance = 1.0 if correlation is None else max(1.0, correlation[lag, lag])
    return Diagnostics(model, residual, correlation, chi2, left, chi2 > POOR_CHI2 * variance)


def source_flags(fit, diagnostics, catalog, flux, blending):
    """
    Flags of all sources of a catalogue.

    Parameters
    ----------
    fit : `~miricigale.photometry.template_fit.TemplateFit`
        The fit.
    diagnostics : `Diagnostics`
        What `diagnose` says of it.
    catalog : `~miricigale.photometry.packaging.CatalogRows`
        The catalogue.
    flux : `~numpy.ndarray`, shape (n,)
        Fluxes of its sources, NaN where not measured.
    blending : `~numpy.ndarray`, shape (k,)
        Formal error over that of the source alone, of each row of the bank; NaN where not fitted.

    Returns
    -------
    flags : int `~numpy.ndarray`, shape (n,)
    coverage : `~numpy.ndarray`, shape (n,)
        Fraction of each template's light on usable pixels.
    """
    n = len(flux)
    flags = np.array(catalog.flags)
    source = catalog.near[fit.bank.order]
    inside, coverage = np.zeros(n), np.zeros(n)
    inside[source] = fit.light[:, 0]
    coverage[source] = np.clip(fit.light[:, 1], 0.0, 1.0)
    for rows, flag in (
        (inside < 0.9, ForcedFlags.EDGE),
        (coverage < 0.9 * np.minimum(inside, 1.0), ForcedFlags.MASKED),
        (source[fit.degenerate], ForcedFlags.DEGENERATE),
        (source[fit.noisy], ForcedFlags.NOISY_SEGMENT),
        (source[blending > 2], ForcedFlags.BLENDED),
        (source[diagnostics.poor], ForcedFlags.POOR_FIT),
    ):
        flags[rows] |= int(flag)
    flags[np.isnan(flux) & (flags & int(ForcedFlags.DEGENERATE) == 0)] |= int(ForcedFlags.NO_DATA)
    near = unexplained_neighbours(
        diagnostics.residual, diagnostics.model, fit.inverse_sigma, fit.psf_width, catalog.xy, flux
    )
    flags[near & np.isfinite(flux)] |= int(ForcedFlags.UNEXPLAINED_NEIGHBOUR)
    return flags, coverage
