"""Diagnostics of a fit from its residual: noise, goodness of fit and flags."""

import numpy as np

from miricigale.photometry._core.stamps import residual_statistics
from miricigale.photometry.detection.residual_sources import ResidualPeaks, residual_peaks
from miricigale.photometry.fit.pixel_scatter import pixel_scatter
from miricigale.photometry.images.flags import POOR_CHI2, POOR_STRAIN, ForcedFlags
from miricigale.photometry.templates.normal_equations import noise_correlation, stated_correlation
from miricigale.utils.arrays import nans, quiet_division
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import chunks
from miricigale.utils.values import value_class

#: Part of a template's light on pixels at the rim of the data from which its flux may be off by some per cent.
_RIM_LIGHT = 0.1
#: Errors by which a flux is above twice the image's light, or negative, where templates cancel.
_ABOVE_LIGHT = 3.0
_NEGATIVE = 5.0


@value_class
class Diagnostics:
    """A fit compared with its image."""

    #: (ny, nx): uJy per pixel; the residual is zero where the image is not usable.
    model: np.ndarray
    residual: np.ndarray
    correlation: np.ndarray | None  # Of the noise; None where it is taken as white.
    pixel_scatter: float  # Of `pixel_scatter`.
    #: (n,): Of each row of the bank; NaN where not fitted, and for second components.
    chi2: np.ndarray
    residual_fraction: np.ndarray
    rim: np.ndarray  # (n,): Fraction of each row's light on pixels at the rim of the image's data.
    # (n,): The flux with which each row would have all of the image's light below its core, uJy; NaN where not
    # fitted, and for second components.
    core_flux: np.ndarray
    poor: np.ndarray  # (n,): Whether chi2 is too large for noise.
    peaks: ResidualPeaks  # Light that no template explains.


def diagnose(fit, xy, scatter=None):
    """
    Compare a `TemplateFit` with its image.

    ``xy``, (n, 2), are all known sources, NaN far outside; ``scatter`` is the scatter of pixels over their light,
    which is measured by default.
    """
    # what the fit has freed
    return_freed_memory()
    model = fit.model()
    residual = fit.residual(model)
    correlation = None
    if fit.settings.errors.correlated_noise and len(fit.rows):
        correlation = _correlation(fit, residual, model)
    return_freed_memory()
    if scatter is None:
        scatter = pixel_scatter(fit, residual, model)
    inverse_sigma = fit.inverse_sigma
    if scatter > 0:
        # noise, and what resampling does to the light of sources
        inverse_sigma = inverse_sigma / np.hypot(1.0, scatter * model * inverse_sigma)
    # the image is its model and the residual
    chi2, residual_light, core_light, core, rim = _statistics(
        fit, residual, residual + fit.arrays.usable * model, inverse_sigma
    ).T
    return_freed_memory()
    with quiet_division():
        residual_light = residual_light / (fit.total * core)
        core_flux = core_light / core
    is_out = np.ones(len(chi2), bool)
    is_out[fit.rows] = False
    is_out |= ~fit.main
    core_flux = np.where(is_out, np.nan, core_flux)
    chi2 = np.where(is_out, np.nan, chi2)
    residual_light = np.where(is_out, np.nan, residual_light)
    # where the measured noise is above that of the uncertainty, it is the measure
    variance = 1.0
    if correlation is not None:
        lag = correlation.shape[0] // 2
        variance = max(1.0, correlation[lag, lag])
    peaks = residual_peaks(fit, residual, model, xy + fit.displacement(xy))
    # in units of the noise that was measured
    poor = chi2 > POOR_CHI2 * variance
    if fit.free is not None:
        # what the high-resolution image shows is not what is fitted here
        poor[fit.rows] |= fit.free.strain > POOR_STRAIN
    return Diagnostics(
        model, residual, correlation, scatter, chi2, residual_light, rim, core_flux, poor, peaks
    )


def _correlation(fit, residual, model):
    """Measure the correlation of the noise, or take that which the image states if there is too little sky."""
    usable = fit.arrays.usable
    is_free = usable.copy()
    for part in chunks(len(model), 256):
        is_free[part] &= np.abs(model[part]) * fit.inverse_sigma[part] < 0.3
    if np.count_nonzero(is_free) < max(400, 0.02 * np.count_nonzero(usable)):
        is_free = usable
    if np.count_nonzero(is_free) < 400:
        if fit.arrays.noise_correction <= 1:
            return None
        return stated_correlation(fit.arrays.noise_correction)
    executor = fit.bank.executor
    correlation = noise_correlation(residual, is_free, fit.inverse_sigma, executor=executor)
    if not correlation.any():
        return None
    return correlation


def _statistics(fit, residual, light, inverse_sigma):
    """
    Sum up the images where each template is, shape (n, 5).

    Chi2 with 1 over the deviations of pixels, residual, light and template of each template's core (see the
    kernel), and the part of the template that is on the rim.
    """
    n = len(fit.bank.order)
    statistics = nans((n, 4))
    rim_light = np.zeros(n)
    if len(fit.rows):
        rim = rim_pixels(fit.arrays.usable)
        has_rim = rim.any()
        for block in fit.bank.blocks():

            def measure(part, block=block):
                rows = slice(block.first + part.start, block.first + part.stop)
                values, box, start = block.stamps_of(part)
                residual_statistics(
                    values, box, start, residual, light, inverse_sigma, statistics[rows]
                )
                if has_rim:
                    rim_light[rows] = _light_on(rim, values, box, start)

            fit.bank.map(measure, block.parts())
    return np.column_stack([statistics, rim_light / fit.bank.full_light()])


def rim_pixels(usable):
    """
    Find pixels at the rim of the data: usable ones next to pixels beyond the first and last usable ones.

    Those of a drizzled mosaic are covered in part, and show the brightness of that part as if it were that of the
    whole pixel: the light of a star that falls there is too large.

    Parameters
    ----------
    usable : `~numpy.ndarray` of bool, shape (ny, nx)
        Pixels with data. The edge of the array is no rim.

    Returns
    -------
    rim : `~numpy.ndarray` of bool, shape (ny, nx)
    """
    if usable[[0, -1]].all() and usable[:, [0, -1]].all():
        # rows and columns begin and end with data
        return np.zeros_like(usable)
    rows, columns = np.ogrid[: usable.shape[0], : usable.shape[1]]
    is_beyond = _is_beyond(_ends(usable), rows, columns)
    rim = np.zeros_like(usable)
    rim[1:] |= is_beyond[:-1]
    rim[:-1] |= is_beyond[1:]
    rim[:, 1:] |= is_beyond[:, :-1]
    rim[:, :-1] |= is_beyond[:, 1:]
    return rim & usable


def _light_on(mask, values, boxes, starts):
    """Sum of each flat stamp over the pixels of a mask."""
    light = np.zeros(len(boxes))
    for k, (y, x, ny, nx) in enumerate(boxes):
        part = mask[y : y + ny, x : x + nx]
        if part.any():
            stamp = values[starts[k] : starts[k] + ny * nx].reshape(ny, nx)
            light[k] = stamp[part].sum()
    return light


def _ends(usable):
    """Return the first and last usable pixel of each row, and of each column (n and -1 without any)."""
    ends = []
    for image in (usable, usable.T):
        has_data = image.any(axis=1)
        n = image.shape[1]
        # the first True of each row, and of the mirrored row
        first = image.argmax(axis=1)
        last = n - 1 - image[:, ::-1].argmax(axis=1)
        ends.append((np.where(has_data, first, n), np.where(has_data, last, -1)))
    return ends


def _is_beyond(ends, rows, columns):
    """Return whether pixels are before the first or after the last usable pixel of their row or column."""
    (first, last), (lowest, highest) = ends
    is_beyond = (columns < first[rows]) | (columns > last[rows])
    return is_beyond | (rows < lowest[columns]) | (rows > highest[columns])


def _cut_by_rim(usable, boxes):
    """
    Find boxes (row, column, height, width) whose unusable pixels are mostly beyond the image's data.

    That is before the first or after the last usable pixel of a row or column: of a mosaic whose footprint is
    turned against its pixels, what is not exposed.
    """
    is_cut = np.zeros(len(boxes), bool)
    if not len(boxes):
        return is_cut
    ends = _ends(usable)
    for k, (y, x, ny, nx) in enumerate(boxes):
        rows, columns = np.ogrid[y : y + ny, x : x + nx]
        is_beyond = _is_beyond(ends, rows, columns)
        is_cut[k] = np.sum(is_beyond) > 0.5 * np.sum(~usable[y : y + ny, x : x + nx])
    return is_cut


def canceling(flux, error, core_flux):
    """
    Find fluxes that are more than the image can hold, so that neighbors must be negative, or that are negative.

    Parameters
    ----------
    flux, error : `~numpy.ndarray`, shape (n,)
        Fluxes and their errors, uJy; NaN where not measured.
    seen : `~numpy.ndarray`, shape (n,)
        As of `Diagnostics`.

    Returns
    -------
    canceling : bool `~numpy.ndarray`, shape (n,)
        Those above twice the image's light by three errors, or negative by five.
    """
    # more than twice the light that is there
    is_above = flux - 2.0 * np.maximum(core_flux, 0.0) > _ABOVE_LIGHT * error
    return is_above | (flux < -_NEGATIVE * error)


def source_flags(fit, diagnostics, place, flux, blending):
    """
    Return the flags, (n,), that follow from a fit, and the fraction of each template on usable pixels.

    ``place`` is the source of each row of the bank, ``flux`` those of all sources (NaN where not
    measured), ``blending`` each row's formal error over that of the source alone (NaN where not fitted).
    """
    flags, coverage = flags_of_light(fit.light[fit.main], place[fit.main], len(flux))
    add_fit_flags(flags, fit, place, blending, diagnostics.poor)
    flags[place[fit.inseparable]] |= int(ForcedFlags.ONE_COMPONENT)
    cut = np.flatnonzero(fit.main & (flags[place] & ForcedFlags.MASKED > 0))
    cut = cut[_cut_by_rim(fit.arrays.usable, fit.bank.box[cut])]
    flags[place[cut]] |= ForcedFlags.EDGE
    flags[place[fit.main & (diagnostics.rim > _RIM_LIGHT)]] |= ForcedFlags.EDGE
    add_no_data(flags, flux)
    return flags, coverage


def flags_of_light(light, place, n):
    """
    Flag sources by the light of their templates that is seen.

    Parameters
    ----------
    light : `~numpy.ndarray`, shape (m, 2)
        Fractions of each template on the image and on usable pixels.
    place : `~numpy.ndarray` of int, shape (m,)
        Their sources, of ``n``.

    Returns
    -------
    flags : `~numpy.ndarray` of int, shape (n,)
        ``EDGE`` and ``MASKED``.
    coverage : `~numpy.ndarray`, shape (n,)
        Fraction on usable pixels.
    """
    flags = np.zeros(n, int)
    inside = np.zeros(n)
    coverage = np.zeros(n)
    inside[place] = light[:, 0]
    coverage[place] = np.clip(light[:, 1], 0.0, 1.0)
    flags[inside < 0.9] |= int(ForcedFlags.EDGE)
    flags[coverage < 0.9 * np.minimum(inside, 1.0)] |= int(ForcedFlags.MASKED)
    return flags, coverage


def add_fit_flags(flags, fit, place, blending, poor):
    """Add flags of the rows of a fit to those of their sources, ``place``, in place; see `source_flags`."""
    for rows, flag in (
        (fit.degenerate, ForcedFlags.DEGENERATE),
        (fit.noisy, ForcedFlags.NOISY_SEGMENT),
        (blending > 2, ForcedFlags.BLENDED),
        (poor, ForcedFlags.POOR_FIT),
    ):
        flags[place[rows]] |= int(flag)


def add_no_data(flags, flux):
    """Add the flag of sources that are not measured, though not for being degenerate, in place."""
    flags[np.isnan(flux) & (flags & ForcedFlags.DEGENERATE == 0)] |= int(ForcedFlags.NO_DATA)
