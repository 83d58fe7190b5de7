"""Statistics of the noise of an image."""

import numpy as np
import scipy.fft


def autocorrelation(rows, strips, lag, map_parts=map):
    """
    Measure the mean product of pixel pairs by separation, over usable pixels, and its statistical error.

    Parameters
    ----------
    rows : callable
        ``rows(slice)`` are rows of the whitened residual (data minus model, over sigma), and which of their
        pixels are usable.
    strips : sequence of slice
        Rows of the image that are used.
    lag : int
        Largest separation along each axis, in pixels.
    map_parts : callable, optional
        Called as `map`, to work in threads.

    Returns
    -------
    covariance, error : `~numpy.ndarray`, shape (2 lag + 1, 2 lag + 1)
        Separation (0, 0) is in the middle; symmetric through it.
    """
    # by symmetry the separations of one half plane are enough
    half_plane = np.ix_(np.arange(lag + 1), np.arange(-lag, lag + 1))

    def products(image):
        # sum of products by separation, by the power spectrum of the padded image
        ny, nx = image.shape
        shape = [
            scipy.fft.next_fast_len(ny + 2 * lag, True),
            scipy.fft.next_fast_len(nx + lag, True),
        ]
        spectrum = scipy.fft.rfft2(image, s=shape)
        # the autocorrelation is the transform of the power spectrum
        power = spectrum.real**2
        power += spectrum.imag**2
        return scipy.fft.irfft2(power, s=shape, overwrite_x=True)[half_plane].astype(float)

    def of_strip(strip):
        # products of the rows of a strip with those up to lag below: those of all these rows,
        # without those among the rows below
        z, member = rows(slice(strip.start, strip.stop + lag))
        size = strip.stop - strip.start
        kind = np.result_type(z, np.float32)
        z = np.where(member, z, kind.type(0))
        strip_sums = np.array([products(z), products(member.astype(kind))])
        if len(member) > size:
            strip_sums -= [products(z[size:]), products(member[size:].astype(kind))]
        return strip_sums

    sums = np.zeros((2, lag + 1, 2 * lag + 1))
    for strip_sums in map_parts(of_strip, strips):
        sums += strip_sums
    # the half plane of negative separations is the mirror of the other
    full = np.concatenate([sums[:, :0:-1, ::-1], sums], axis=1)
    pairs = np.maximum(np.rint(full[1]), 1.0)
    # mean product of a pair, and its error by the number of pairs
    covariance = full[0] / pairs
    covariance = 0.5 * (covariance + covariance[::-1, ::-1])
    variance = covariance[lag, lag]
    # sum of squared correlations: what correlated noise does to the error of a lag
    rho = covariance
    if variance > 0:
        rho = covariance / variance
    spread = np.sqrt(max(1.0, float(np.sum(np.where(np.abs(rho) > 0.02, rho, 0.0) ** 2))))
    return covariance, variance * spread / np.sqrt(pairs)
