"""Statistics of the noise of an image."""

import numpy as np
import scipy.fft


def autocorrelation(rows, strips, lag, map_parts=map):
    """
    Mean product of pixel pairs by separation, over usable pixels, and its statistical error.

    Both of shape (2 lag + 1, 2 lag + 1), lag (0, 0) in the middle; symmetric through the center.
    ``rows(slice)`` are rows of the whitened residual (data minus model, over sigma), and which pixels are usable;
    of the image the ``strips``, slices of rows, are taken. ``map_parts`` is called as `map` to work in threads.
    """
    wanted = np.ix_(np.arange(lag + 1), np.arange(-lag, lag + 1))

    def products(image):
        shape = [
            scipy.fft.next_fast_len(n + more, True)
            for n, more in zip(image.shape, (2 * lag, lag), strict=True)
        ]
        spectrum = scipy.fft.rfft2(image, s=shape)
        power = spectrum.real**2
        power += spectrum.imag**2
        return scipy.fft.irfft2(power, s=shape, overwrite_x=True)[wanted].astype(float)

    def of_strip(strip):
        # products of the rows of a strip with those up to lag below: those of all these rows,
        # without those among the rows below
        z, member = rows(slice(strip.start, strip.stop + lag))
        size = strip.stop - strip.start
        kind = np.result_type(z, np.float32)
        z = np.where(member, z, kind.type(0))
        found = np.array([products(z), products(member.astype(kind))])
        if len(member) > size:
            found -= [products(z[size:]), products(member[size:].astype(kind))]
        return found

    sums = np.zeros((2, lag + 1, 2 * lag + 1))
    for found in map_parts(of_strip, strips):
        sums += found
    # the half plane of negative separations is the mirror of the other
    full = np.concatenate([sums[:, :0:-1, ::-1], sums], axis=1)
    pairs = np.maximum(np.rint(full[1]), 1.0)
    covariance = full[0] / pairs
    covariance = 0.5 * (covariance + covariance[::-1, ::-1])
    variance = covariance[lag, lag]
    # sum of squared correlations: what correlated noise does to the error of a lag
    rho = covariance / variance if variance > 0 else covariance
    spread = np.sqrt(max(1.0, float(np.sum(np.where(np.abs(rho) > 0.02, rho, 0.0) ** 2))))
    return covariance, variance * spread / np.sqrt(pairs)
