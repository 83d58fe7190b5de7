"""The Wiener filter from one PSF to another, and the choice of its parameter."""

import logging
import math

import numpy as np
from astropy.stats import gaussian_fwhm_to_sigma
from scipy.fft import fftshift, ifftshift, irfft2, next_fast_len, rfft2

from miricigale.psf import _core
from miricigale.utils.exceptions import PSFWarning, argument_error, warn
from miricigale.utils.missing_values import floats
from miricigale.utils.options import check_positive, check_that

_log = logging.getLogger(__name__)

#: Regularization parameters that have a name; they belong to pixels of 0.06 arcsec.
REGULARIZATIONS = {"yang2021": 0.03}

# what is rough: the second derivative
_LAPLACIAN = np.array([[0, -1, 0], [-1, 4, -1], [0, -1, 0]])

# from smooth to sharp: two steps per decade
_SEQUENCE = tuple(10.0 ** (-0.5 * k) for k in range(2, 17))

# what an automatic kernel may have: noise gain relative to that of the Gaussian between two
# Gaussians as wide as the PSFs' cores (MIRI from F160W: 0.4-1.0; striped kernels: 1.4-5), and sum
# of its negative pixels (-0.03 to -0.95; striped kernels: -0.9 to -6.6)
_GAIN = 1.25
_NEGATIVE = -1.5
# largest error of the encircled energy that goes without a warning
_ERROR = 0.02


def checked_square(value, name, *, odd=True):
    """Return an array as floats, checked: square, odd, finite; ``name`` is the argument's."""
    value = floats(value)
    if value.ndim != 2 or value.shape[0] != value.shape[1] or (odd and value.shape[0] % 2 == 0):
        wanted = "square"
        if odd:
            wanted = "square with an odd number of pixels"
        raise argument_error(name, wanted, f"shape {value.shape}")
    check_that(np.all(np.isfinite(value)), name, "finite", "NaN or infinite pixels")
    return value


def wiener(source, target):
    """
    Return the matching kernel, (n, n), of the sum of the wide PSF, as a function of the Wiener parameter.

    That of `photutils.psf_matching.make_wiener_kernel`; but what does not depend on the parameter
    is computed once for all that are tried.
    """
    shape = source.shape
    source_transform = rfft2(ifftshift(source))
    power = np.abs(source_transform) ** 2
    product = rfft2(ifftshift(target)) * source_transform.conj()
    rough = np.abs(rfft2(_LAPLACIAN, shape)) ** 2

    def make(mu):
        kernel = fftshift(irfft2(product / (power + mu * rough), shape))
        return kernel * (target.sum() / kernel.sum())

    return make


def energy_radii(image):
    """Return the radii in pixels at which encircled energies are compared."""
    return np.arange(1.0, image.shape[0] // 2 + 0.25, 0.5)


def energy_error(image, target, radii):
    """Return the encircled energy of an image minus that of another, both centered, at radii in pixels."""
    c = target.shape[0] // 2
    return _core.radial_sums(image - target, c, c, radii)


def gaussian_gain(source, target, names="hi, lo"):
    """
    Return the noise gain of the Gaussian kernel between two Gaussians as wide as the PSFs' cores, at most 1.

    Raises
    ------
    ValueError
        If the sharp PSF is the wider one by its core and at half maximum; ``names`` are the caller's for the two.
    """
    c = len(source) // 2
    halves = [_core.half_maximum_width(image, c, c) for image in (source, target)]
    cores = []
    for image, half in zip((source, target), halves, strict=True):
        _, _, width = _core.core_moments(image)
        # cores narrower than their pixels have no moments
        cores.append(width if math.isfinite(width) else half * gaussian_fwhm_to_sigma)
    # one alone misleads: a blurred core has no wings, a pattern of resampling may be narrow
    if cores[0] > 1.05 * cores[1] and halves[0] > 1.1 * halves[1]:
        wanted = "the sharp and the wide PSF, in this order"
        raise argument_error(names, wanted, f"FWHM of {halves[0]:.4g} and {halves[1]:.4g} pixels")
    return 1 / math.sqrt(max(4 * math.pi * (cores[1] ** 2 - cores[0] ** 2), 1.0))


def choose(regularization, make, source, target, tolerance):
    """
    Choose the Wiener parameter.

    Parameters
    ----------
    regularization : float or str
        The parameter, its name in `REGULARIZATIONS`, or ``"auto"``.
    make : callable
        The kernel as a function of it (`wiener`).
    source, target : `~numpy.ndarray`, shape (n, n)
        The two PSFs.
    tolerance : float
        The error of the encircled energy that the smoothest kernel may have beyond the smallest.

    Returns
    -------
    mu, kernel
    figures : dict
        ``max_error`` (of the encircled energy at any radius), ``noise_gain`` (factor on the rms
        of white noise), ``gaussian_gain`` (see `gaussian_gain`), ``negative_sum`` and
        ``residual`` (largest deviation from the wide PSF over its peak); where several were tried
        also ``smallest_error`` (of those within the limits) and ``within_limits``.

    Raises
    ------
    ValueError
        If it is neither positive nor a known name, or the PSFs are the wrong way round.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        If no kernel keeps the limits, or the one that was chosen misses the wide PSF's
        encircled energy by more than 0.02.
    """
    n = len(source)
    half = len(source) // 2
    size = (next_fast_len(2 * n - 1, real=True),) * 2
    spectrum = rfft2(source, size)

    reference = gaussian_gain(source, target)

    def figures(mu):
        kernel = make(mu)
        matched = irfft2(spectrum * rfft2(kernel, size), size)[half : half + n, half : half + n]
        return {
            "max_error": float(np.abs(energy_error(matched, target, energy_radii(target))).max()),
            "noise_gain": float(np.sqrt(np.sum(kernel**2))),
            "gaussian_gain": reference,
            "negative_sum": float(kernel[kernel < 0].sum()),
            "residual": float(np.abs(matched - target).max() / target.max()),
        }

    if isinstance(regularization, str):
        if regularization in REGULARIZATIONS:
            regularization = REGULARIZATIONS[regularization]
        elif regularization != "auto":
            names = ["auto"] + list(REGULARIZATIONS)
            raise argument_error("regularization", f"positive or one of {names}", regularization)
    if regularization != "auto":
        check_positive(regularization, "regularization")
        mu = float(regularization)
        return mu, make(mu), figures(mu)
    candidates = [(mu, figures(mu)) for mu in _SEQUENCE]
    total = float(target.sum())
    limits = _GAIN * reference * total, _NEGATIVE * total
    allowed = [
        candidate for candidate in candidates
        if candidate[1]["noise_gain"] <= limits[0] and candidate[1]["negative_sum"] >= limits[1]
    ]  # fmt: skip
    choices = bool(allowed) or [min(candidates, key=lambda candidate: candidate[1]["noise_gain"])]
    smallest = min(candidate["max_error"] for _, candidate in allowed or choices)
    mu, best = next(t for t in allowed or choices if t[1]["max_error"] <= smallest + tolerance)
    best |= {"smallest_error": smallest, "within_limits": bool(allowed)}
    text = f"matching kernel with regularization {mu:.2g}: noise gain {best['noise_gain']:.4f} "
    text += f"(limit {limits[0]:.4f}), negative pixels {best['negative_sum']:.3f} (limit "
    text += f"{limits[1]:.3f}), error of the encircled energy {best['max_error']:.4f}"
    if not allowed or best["max_error"] > _ERROR:
        warn(text, PSFWarning)
    _log.info(text)
    return mu, make(mu), best
