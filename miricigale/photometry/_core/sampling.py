"""Templates on the image: splines, the response of the pixel, and their sampling."""

import numpy as np
import scipy.fft
from numba import njit

__all__ = ["box_response", "convolve_batch", "sample_stamps", "spline_response"]


def spline_response(shape):
    """
    Transform of the quintic B-spline at the nodes, for `scipy.fft.rfft2` of ``shape``.

    Dividing by it turns an image into the coefficients of its interpolating spline.
    """
    return _spline_1d(np.fft.fftfreq(shape[0]))[:, None] * _spline_1d(np.fft.rfftfreq(shape[1]))


def _spline_1d(f):
    return (66.0 + 52.0 * np.cos(2 * np.pi * f) + 2.0 * np.cos(4 * np.pi * f)) / 120.0


def box_response(shape, sides):
    """
    Transform of the mean over a parallelogram, for `scipy.fft.rfft2` of ``shape``.

    Parameters
    ----------
    shape : (int, int)
        Shape of the image.
    sides : array_like, shape (2, 2)
        The two sides of the parallelogram as vectors (x, y) in pixels.

    Returns
    -------
    response : `~numpy.ndarray`, shape (ny, nx // 2 + 1)
    """
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None]
    response = np.ones((shape[0], shape[1] // 2 + 1))
    for sx, sy in np.asarray(sides, float):
        response *= np.sinc(fx * sx + fy * sy)
    return response


def convolve_batch(stamps, transfer, shape):
    """
    Convolve stamps with one kernel given by its transform.

    Parameters
    ----------
    stamps : `~numpy.ndarray`, shape (n, ny, nx)
        Images, zero-padded to ``shape`` at their far ends.
    transfer : `~numpy.ndarray`, shape (shape[0], shape[1] // 2 + 1)
        Transform of the kernel, its centre where the caller put it.
    shape : (int, int)
        Shape of the transform; the result is periodic on it.

    Returns
    -------
    convolved : `~numpy.ndarray`, shape (n, shape[0], shape[1])
    """
    spectrum = scipy.fft.rfft2(stamps, s=shape, axes=(1, 2))
    spectrum *= transfer
    return scipy.fft.irfft2(spectrum, s=shape, axes=(1, 2), overwrite_x=True)


@njit(cache=True)
def _quintic(t, w):
    s = 1.0 - t
    w[0] = s**5 / 120.0
    w[5] = t**5 / 120.0
    for k in range(4):
        x = abs(t - (k - 1.0))
        if x < 1.0:
            w[k + 1] = 0.55 - 0.5 * x**2 + 0.25 * x**4 - x**5 / 12.0
        else:
            w[k + 1] = 0.425 + 0.625 * x - 1.75 * x**2 + 1.25 * x**3 - 0.375 * x**4 + x**5 / 24.0


@njit(cache=True)
def sample_stamps(coefficients, which, amplitude, center, poly, box, start, out):
    """
    Add splines evaluated at the centres of target pixels, as fractions per target pixel.

    Parameters
    ----------
    coefficients : `~numpy.ndarray`, shape (m, h, w)
        Quintic spline coefficients of fine-grid stamps (fraction per fine pixel).
    which : int array, shape (n,)
        Which of them each template uses.
    amplitude : float array, shape (n,)
        Factor of each; a template of amplitude zero is skipped.
    center : float array, shape (n, 2)
        Target position (x, y) about which ``poly`` expands.
    poly : float array, shape (n, 2, 6)
        Fine coordinates X, Y in the frame of the stamp as quadratics
        c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2 of the offset (u, v) in target pixels.
    box, start : int arrays, shape (n, 4) and (n + 1,)
        Where the target stamps lie on the image and in ``out``.
    out : `~numpy.ndarray`, shape (start[-1],)
        Amplitude times spline value times Jacobian is added to it.
    """
    h, w = coefficients.shape[1], coefficients.shape[2]
    wy = np.empty(6)
    wx = np.empty(6)
    for k in range(box.shape[0]):
        if amplitude[k] == 0.0:
            continue
        image = coefficients[which[k]]
        px = poly[k, 0]
        py = poly[k, 1]
        n = start[k]
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            v = y - center[k, 1]
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                u = x - center[k, 0]
                fx = px[0] + px[1] * u + px[2] * v + px[3] * u * u + px[4] * u * v + px[5] * v * v
                fy = py[0] + py[1] * u + py[2] * v + py[3] * u * u + py[4] * u * v + py[5] * v * v
                ix = int(np.floor(fx))
                iy = int(np.floor(fy))
                value = 0.0
                if iy > -4 and ix > -4 and iy < h + 3 and ix < w + 3:
                    _quintic(fx - ix, wx)
                    _quintic(fy - iy, wy)
                    for j in range(6):
                        row = iy - 2 + j
                        if row < 0 or row >= h:
                            continue
                        part = 0.0
                        for i in range(6):
                            col = ix - 2 + i
                            if col >= 0 and col < w:
                                part += wx[i] * image[row, col]
                        value += wy[j] * part
                    jac = (px[1] + 2 * px[3] * u + px[4] * v) * (
                        py[2] + py[4] * u + 2 * py[5] * v
                    ) - (px[2] + px[4] * u + 2 * px[5] * v) * (py[1] + 2 * py[3] * u + py[4] * v)
                    out[n] += amplitude[k] * value * abs(jac)
                n += 1
