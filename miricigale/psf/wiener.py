"""The Wiener filter from one PSF to another, and the choice of its parameter."""

import numpy as np
from scipy.fft import fftshift, ifftshift, irfft2, next_fast_len, rfft2
from scipy.signal import convolve2d

from miricigale.psf import _core
from miricigale.utils.exceptions import argument_error

__all__ = ["REGULARIZATIONS", "choose", "energy_error", "energy_radii", "odd_square", "wiener"]

#: Regularisation parameters that have a name; they belong to pixels of 0.06 arcsec.
REGULARIZATIONS = {"yang2021": 0.03}

# the second and fourth derivatives
_PENALTIES = {"laplacian": np.array([[0, -1, 0], [-1, 4, -1], [0, -1, 0]])}
_PENALTIES["biharmonic"] = convolve2d(_PENALTIES["laplacian"], _PENALTIES["laplacian"])

# from smooth to sharp: two steps per decade
_SEQUENCE = tuple(10.0 ** (-0.5 * k) for k in range(2, 17))


def odd_square(value, name):
    """An array as floats, checked: square, odd, finite; ``name`` is the argument's."""
    value = np.asarray(value, dtype=float)
    if value.ndim != 2 or value.shape[0] != value.shape[1] or value.shape[0] % 2 == 0:
        raise argument_error(name, "square with an odd number of pixels", f"shape {value.shape}")
    if not np.all(np.isfinite(value)):
        raise argument_error(name, "finite", "NaN or infinite pixels")
    return value


def _penalty_power(penalty, shape):
    """Squared transfer function of a penalty."""
    if isinstance(penalty, str):
        if penalty not in _PENALTIES:
            raise argument_error("penalty", f"None or one of {sorted(_PENALTIES)}", repr(penalty))
        penalty = _PENALTIES[penalty]
    penalty = odd_square(penalty, "penalty")
    if penalty.shape[0] > shape[0]:
        wanted = f"at most as large as the PSFs, {shape[0]} pixels"
        raise argument_error("penalty", wanted, f"{penalty.shape[0]}")
    return np.abs(rfft2(penalty, shape)) ** 2


def wiener(source, target, penalty):
    """
    The matching kernel as a function of the Wiener parameter.

    That of `photutils.psf_matching.make_wiener_kernel`; but what does not depend on the parameter
    is worked out once for all that are tried.

    Parameters
    ----------
    source, target : `~numpy.ndarray`, shape (n, n), n odd
        The sharp and the wide PSF.
    penalty : str, `~numpy.ndarray` or None
        As for `~miricigale.psf.MatchingKernel.from_psfs`.

    Returns
    -------
    make : callable
        ``make(mu)`` is the kernel, shape (n, n), of the sum of ``target``.

    Raises
    ------
    ValueError
        If the penalty is unknown, not square and odd, or larger than the PSFs.
    """
    shape = source.shape
    own = rfft2(ifftshift(source))
    power, product = np.abs(own) ** 2, rfft2(ifftshift(target)) * own.conj()
    rough = power.max() if penalty is None else _penalty_power(penalty, shape)

    def make(mu):
        kernel = fftshift(irfft2(product / (power + mu * rough), shape))
        return kernel * (target.sum() / kernel.sum())

    return make


def energy_radii(image):
    """Radii in pixels at which encircled energies are compared."""
    return np.arange(1.0, image.shape[0] // 2 + 0.25, 0.5)


def energy_error(image, target, radii):
    """Encircled energy of an image minus that of another, both centred, at radii in pixels."""
    c = target.shape[0] // 2
    return _core.radial_sums(image - target, c, c, radii)


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
    mu : float
    errors : dict
        ``max_error``, and ``smallest_error`` where several were tried.

    Raises
    ------
    ValueError
        If it is neither positive nor a known name.
    """
    n, half = len(source), len(source) // 2
    size = (next_fast_len(2 * n - 1, real=True),) * 2
    spectrum = rfft2(source, size)

    def error(mu):
        matched = irfft2(spectrum * rfft2(make(mu), size), size)[half : half + n, half : half + n]
        return float(np.abs(energy_error(matched, target, energy_radii(target))).max())

    if isinstance(regularization, str):
        if regularization in REGULARIZATIONS:
            regularization = REGULARIZATIONS[regularization]
        elif regularization != "auto":
            known = ["auto", *REGULARIZATIONS]
            raise argument_error("regularization", f"positive or one of {known}", regularization)
    if regularization != "auto":
        if not regularization > 0:
            raise argument_error("regularization", "positive", regularization)
        return float(regularization), {"max_error": error(regularization)}
    errors = [error(mu) for mu in _SEQUENCE]
    allowed = min(errors) + tolerance
    best = next(k for k, value in enumerate(errors) if value <= allowed)
    return _SEQUENCE[best], {"max_error": errors[best], "smallest_error": min(errors)}
