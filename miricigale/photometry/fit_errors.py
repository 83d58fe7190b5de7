"""Errors of a fit: by the noise, by what is not known of the templates, by the PSF."""

import numpy as np
import scipy.sparse
from scipy.signal import oaconvolve

from miricigale.photometry.errors import sandwich_matrix
from miricigale.photometry.template_fit import inner
from miricigale.utils.parallel import chunks
from miricigale.utils.units import ANGLE

#: Size of the covariance's blocks and of the margin around them, arcsec.
BLOCK_CORE = 18.0
BLOCK_HALO = 6.0


def fit_covariances(fit, correlation):
    """
    Covariances of a `TemplateFit`, with the correlation of the noise; None if that is white.

    Returns
    -------
    noise, template, psf : `~scipy.sparse.csr_array`, shape (n, n)
        Of the fitted rows: by the image's noise, by what is not known of the templates, and by the PSF, whose
        errors go together.
    common : `~numpy.ndarray`, shape (g, g)
        Of the common parameters.
    blending : `~numpy.ndarray`, shape (n,)
        Formal error over that of the source alone.
    """
    n, g, plain, free = len(fit.rows), len(fit.columns), fit.fit, fit.free
    solution, xy = plain, fit.bank.xy[fit.rows]
    fillings = [None if correlation is None else _sandwich(fit, correlation)]
    if free is not None:
        solution, xy = free.fit, np.concatenate([xy, free.xy])
        if correlation is None:
            white = (solution.matrix - scipy.sparse.diags_array(free.prior)).tocsr()
            fillings = [(white, solution.border, solution.corner)]
        nothing = np.zeros((len(solution.rhs), g)), np.zeros((g, g))
        fillings.append((free.filling(plain.matrix), *nothing))
    coo = plain.matrix.tocoo()
    pattern = scipy.sparse.coo_array((coo.data, (coo.row, coo.col)), shape=solution.matrix.shape)
    found, blending = solution.covariances(
        xy, fillings, core=BLOCK_CORE / fit.scale, halo=BLOCK_HALO / fit.scale, pattern=pattern
    )
    noise, common = found[0]
    noise, blending = noise[:n][:, :n], blending[:n]
    template = scipy.sparse.csr_array((n, n))
    if free is not None:
        blending = blending * np.sqrt(free.alone())
        template, more = found[1]
        template, common = template[:n][:, :n], common + more
    if len(fit.pairs):
        # that of the sum of two components
        first, second = np.searchsorted(fit.rows, fit.pairs.T)
        filling = plain.matrix if fillings[0] is None else fillings[0][0]
        alone = np.sqrt(filling.diagonal()[:n]) / plain.matrix.diagonal()
        both = np.array([noise[i, j] for i, j in zip(first, second, strict=True)])
        variance = noise.diagonal()
        blending[first] = np.sqrt(variance[first] + variance[second] + 2 * both) / alone[first]
        blending[second] = blending[first]
    parts = fit.bank.parts(np.arange(len(fit.flux)))
    image = np.array([one is not None and one.kind == "cutout" for one in parts], bool)
    coo, error = noise.tocoo(), psf_errors(fit, image)[fit.rows]
    data = error[coo.row] * error[coo.col]
    psf = scipy.sparse.coo_array((data, (coo.row, coo.col)), shape=noise.shape).tocsr()
    return noise, template, psf, common, blending


def psf_errors(fit, image):
    """Errors of the fluxes of all rows by that of the PSF; ``image``, (n,), says whose template is one."""
    settings, kernel = fit.settings.errors, fit.settings.mean_kernel
    fraction = settings.psf_error
    if fraction is None:
        if settings.size_scatter is None:
            return np.zeros(len(fit.flux))
        fraction = image * np.max(np.abs(kernel.encircled_energy_error()))
    point = np.sum(kernel.target**2) * (fit.scale / kernel.pixel_scale.to_value(ANGLE)) ** 2
    return fraction * np.minimum(fit.power / point, 1.0) * np.abs(fit.flux)


def _sandwich(fit, correlation):
    """What correlated noise does to the right-hand side: matrix, border and corner."""
    keep = fit.rows
    white = [fit.arrays.whitened(column) for column in fit.columns]
    spread = [_spread(fit, image, correlation) for image in white]
    middle, border = sandwich_matrix(fit.bank, fit.inverse_sigma, correlation, spread)
    middle, border = middle[keep][:, keep], border[keep]
    if fit.free is not None:
        middle, border = fit.free.sandwich(fit, correlation, middle, border, spread)
    corner = np.array([[inner(a, b) for b in spread] for a in white])
    return middle, border, corner.reshape(len(white), len(white))


def _spread(fit, image, correlation):
    """An image convolved with the noise correlation."""
    kernel, lag = correlation.astype(image.dtype), correlation.shape[0] // 2
    out = fit.arrays.new()

    def convolve(part):
        rows = slice(max(part.start - lag, 0), part.stop + lag)
        found = oaconvolve(image[rows], kernel, mode="same")
        out[part] = found[part.start - rows.start :][: part.stop - part.start]

    fit.bank.map(convolve, chunks(len(image), 512))
    return out
