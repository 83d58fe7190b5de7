"""Why an object was not fitted, or what to know of its fit."""

import numpy as np

from miricigale.utils.tables import Flags

__all__ = ["FitFlags", "flags_of_fits"]

#: S/N of the best model in all bands together below which an object is flagged.
LOW_SIGNAL = 3.0


class FitFlags(Flags):
    """Flags of a fitted catalog; `FitFlags.UNFITTED` is the sum of those that prevent a fit."""

    NO_BAND = 1
    """No usable band."""
    FEW_BANDS = 2
    """Fewer usable bands, upper limits among them, than asked for."""
    BAD_ERROR = 4
    """A flux whose error is zero, negative, not finite or beyond 1e-60 to 1e60 uJy; the band is left
    out."""
    NO_REDSHIFT = 8
    """A fixed redshift was asked for and is missing, not finite or not positive."""
    REDSHIFT_OUTSIDE = 16
    """The fixed redshift has no redshift of the grid within the tolerance."""
    DUPLICATE_ID = 32
    """The id occurred before; only its first row is fitted."""
    HIGH_CHI2 = 64
    """No model fits: the reduced chi2 of the best is above the limit."""
    NO_SIGNAL = 128
    """No model has a positive scale, the fluxes being zero or negative: the posterior is the prior."""
    REDSHIFT_EDGE = 256
    """More than one per cent of the posterior lies on the first or last redshift."""
    NO_MODEL = 512
    """No model is left by the age of the universe and the priors."""

    BAD_FLUX = 1024
    """A flux that is infinite or beyond 1e60 uJy; the band is left out."""

    FEW_FOR_PARAMETERS = 2048
    """Fewer fluxes than free parameters, the mass among them; limits are not counted."""
    ALL_LIMITS = 4096
    """Upper limits and no flux: any model that is faint enough fits."""

    NO_LIKELIHOOD = 8192
    """With ``compat="cigale"``: the best chi2 is so high that every likelihood vanishes."""

    LOW_SIGNAL = 16384
    """The best model has S/N below 3 over all bands: take masses and luminosities from samples."""

    UNFITTED = 1 | 2 | 8 | 16 | 32 | 512 | 4096 | 8192
    """Bits with which a row has no result."""


def flags_of_fits(results, measured, max_reduced_chi2, edge_weight):
    """
    Flags of results, with those that the fits show.

    ``measured`` are the bands with a flux, shape (n, nb); ``edge_weight`` is the weight of the first
    or last redshift above which an object is flagged, None where redshifts were fixed.
    """
    flags, fitted, pdf = np.array(results.flags), results.fitted, results.pdf["redshift"]
    signal = np.where(measured, results.best_flux / results.sigma, 0.0)
    with np.errstate(invalid="ignore"):
        flags[fitted & (results.reduced_chi2 > max_reduced_chi2)] |= FitFlags.HIGH_CHI2
        flags[fitted & ~(results.best_scale > 0)] |= FitFlags.NO_SIGNAL
        faint = np.sqrt(np.sum(signal * signal, axis=1)) < LOW_SIGNAL
        flags[fitted & faint] |= FitFlags.LOW_SIGNAL
        if edge_weight is not None and pdf.shape[1] > 2:
            edge = np.maximum(pdf[:, 0], pdf[:, -1]) > edge_weight
            flags[fitted & edge] |= FitFlags.REDSHIFT_EDGE
    flags[~fitted & ((flags & FitFlags.UNFITTED) == 0)] |= FitFlags.NO_SIGNAL
    return flags
