"""Templates on the image: splines, the response of the pixel, and their sampling."""

import numpy as np
import scipy.fft

from miricigale.utils.compilation import njit


def spline_response(shape):
    """
    Return the transform of the quintic B-spline at the nodes, for `scipy.fft.rfft2` of ``shape``.

    Dividing by it turns an image into the coefficients of its interpolating spline.
    """
    return _spline_1d(np.fft.fftfreq(shape[0]))[:, None] * _spline_1d(np.fft.rfftfreq(shape[1]))


def _spline_1d(f):
    # values of the quintic B-spline at its nodes are 1, 26, 66, 26 and 1 over 120
    return (66.0 + 52.0 * np.cos(2 * np.pi * f) + 2.0 * np.cos(4 * np.pi * f)) / 120.0


def box_response(shape, sides):
    """
    Return the transform of the mean over a parallelogram, for `scipy.fft.rfft2` of ``shape``.

    ``sides``, (2, 2), are its two sides as vectors (x, y) in pixels.
    """
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None]
    response = np.ones((shape[0], shape[1] // 2 + 1))
    for sx, sy in np.asarray(sides, float):
        response *= np.sinc(fx * sx + fy * sy)
    return response


def convolve_batch(stamps, transfer, shape):
    """
    Convolve stamps, (n, ny, nx), with one kernel given by its transform, its center where that has it.

    Stamps are zero-padded at their far ends to ``shape``, on which the result, (n, *shape), is periodic.
    """
    # axis by axis, so that rows of padding are not transformed
    spectrum = scipy.fft.rfft(stamps, n=shape[1], axis=2)
    spectrum = scipy.fft.fft(spectrum, n=shape[0], axis=1, overwrite_x=True)
    spectrum *= transfer
    return scipy.fft.irfft2(spectrum, s=shape, axes=(1, 2), overwrite_x=True)


# the quintic B-spline is a polynomial for distances up to 1, from 1 to 2, and from 2 to 3, of a node
@njit()
def _inner(x):
    return 0.55 - 0.5 * x**2 + 0.25 * x**4 - x**5 / 12.0


@njit()
def _outer(x):
    return 0.425 + 0.625 * x - 1.75 * x**2 + 1.25 * x**3 - 0.375 * x**4 + x**5 / 24.0


@njit()
def _quintic(position, node, weight):
    # a row at once without branches, which the compiler turns into vector instructions
    for i in range(position.size):
        floor = np.floor(position[i])
        t = position[i] - floor
        s = 1.0 - t
        node[i] = int(floor)
        weight[0, i] = s**5 / 120.0
        weight[1, i] = _outer(t + 1.0)
        weight[2, i] = _inner(t) if t < 1.0 else _outer(t)
        weight[3, i] = _inner(s) if s < 1.0 else _outer(s)
        weight[4, i] = _outer(2.0 - t)
        weight[5, i] = t**5 / 120.0


#: Fine pixels by which rows and columns may be bent or turned and still count as those of the fine grid.
_STRAIGHT = 1e-6


@njit()
def _is_straight(px, py, center, box):
    """Return whether x on the fine grid follows from x on a stamp alone, and y from y."""
    u = max(abs(box[1] - center[0]), abs(box[1] + box[3] - center[0]))
    v = max(abs(box[0] - center[1]), abs(box[0] + box[2] - center[1]))
    bent_x = abs(px[2]) * v + abs(px[4]) * u * v + abs(px[5]) * v * v
    bent_y = abs(py[1]) * u + abs(py[4]) * u * v + abs(py[3]) * u * u
    return max(bent_x, bent_y) < _STRAIGHT


@njit(fastmath={"reassoc", "contract"})
def _sample_straight(image, amplitude, center, px, py, box, out):
    """Add what `sample_stamps` adds where the map is straight: sums over rows first, then over columns."""
    h, w = image.shape
    ny, nx = box[2:]
    fx = np.empty(nx)
    fy = np.empty(ny)
    for m in range(nx):
        u = box[1] + m - center[0]
        fx[m] = px[0] + px[1] * u + px[3] * u * u
    for k in range(ny):
        v = box[0] + k - center[1]
        fy[k] = py[0] + py[2] * v + py[5] * v * v
    ix = np.empty(nx, np.int64)
    iy = np.empty(ny, np.int64)
    wx = np.empty((6, nx))
    wy = np.empty((6, ny))
    _quintic(fx, ix, wx)
    _quintic(fy, iy, wy)
    area = np.empty(nx)
    for m in range(nx):
        area[m] = amplitude * (px[1] + 2 * px[3] * (box[1] + m - center[0]))
        # the first node of six, in a row with zeros beyond the rim as far as nodes may be
        ix[m] = min(max(ix[m] + 4, 0), w + 6)
    row = np.zeros(w + 12)
    for k in range(ny):
        row[:] = 0.0
        first_row = iy[k] - 2
        for j in range(max(-first_row, 0), min(h - first_row, 6)):
            weight = wy[j, k]
            nodes = image[first_row + j]
            for i in range(w):
                row[6 + i] += weight * nodes[i]
        slope_y = py[2] + 2 * py[5] * (box[0] + k - center[1])
        line = out[k * nx : k * nx + nx]
        for m in range(nx):
            first = ix[m]
            value = wx[0, m] * row[first] + wx[1, m] * row[first + 1] + wx[2, m] * row[first + 2]
            value += wx[3, m] * row[first + 3] + wx[4, m] * row[first + 4]
            value += wx[5, m] * row[first + 5]
            line[m] += value * abs(area[m] * slope_y)


@njit()
def sample_stamps(coefficients, fine_stamp, amplitude, center, poly, box, start, out):
    """
    Add splines evaluated at the centers of target pixels, as fractions per target pixel.

    Parameters
    ----------
    coefficients : `~numpy.ndarray`, shape (m, h, w)
        Quintic spline coefficients of fine-grid stamps (fraction per fine pixel).
    fine_stamp, amplitude : int and float arrays, shape (n,)
        Number of the stamp that each template uses, and its factor; a template of amplitude zero is skipped.
    center, poly : float arrays, shape (n, 2) and (n, 2, 6)
        Target positions (x, y), and about them fine coordinates X, Y in the frame of the stamp as quadratics
        c0 + c1 u + c2 v + c3 u^2 + c4 u v + c5 v^2 of the offset (u, v) in target pixels.
    box, start : int arrays, shape (n, 4) and (n + 1,)
        Where the target stamps lie on the image and in ``out``.
    out : `~numpy.ndarray`, shape (start[-1],)
        Amplitude times spline value times Jacobian is added to it.
    """
    h = coefficients.shape[1]
    w = coefficients.shape[2]
    width = 0
    for k in range(box.shape[0]):
        width = max(width, box[k, 3])
    fx = np.empty(width)
    fy = np.empty(width)
    ix = np.empty(width, np.int64)
    iy = np.empty(width, np.int64)
    wx = np.empty((6, width))
    wy = np.empty((6, width))
    for k in range(box.shape[0]):
        if amplitude[k] == 0.0:
            continue
        image = coefficients[fine_stamp[k]]
        px = poly[k, 0]
        py = poly[k, 1]
        nx = box[k, 3]
        n = start[k]
        if _is_straight(px, py, center[k], box[k]):
            # a grid along the fine one is a quarter of the work
            stamp = out[n : start[k + 1]]
            _sample_straight(image, amplitude[k], center[k], px, py, box[k], stamp)
            continue
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            v = y - center[k, 1]
            for m in range(nx):
                # offset of the pixel from the source
                u = box[k, 1] + m - center[k, 0]
                fx[m] = (
                    px[0] + px[1] * u + px[2] * v + px[3] * u * u + px[4] * u * v + px[5] * v * v
                )
                fy[m] = (
                    py[0] + py[1] * u + py[2] * v + py[3] * u * u + py[4] * u * v + py[5] * v * v
                )
            _quintic(fx[:nx], ix, wx)
            _quintic(fy[:nx], iy, wy)
            for m in range(nx):
                # nodes of the six by six that a quintic spline needs
                first_row = iy[m] - 2
                first_column = ix[m] - 2
                value = 0.0
                if (
                    first_row >= 0
                    and first_column >= 0
                    and first_row <= h - 6
                    and first_column <= w - 6
                ):
                    for j in range(6):
                        part = 0.0
                        for i in range(6):
                            part += wx[i, m] * image[first_row + j, first_column + i]
                        value += wy[j, m] * part
                else:
                    # nodes beyond the rim are zero
                    for j in range(max(-first_row, 0), min(h - first_row, 6)):
                        part = 0.0
                        for i in range(max(-first_column, 0), min(w - first_column, 6)):
                            part += wx[i, m] * image[first_row + j, first_column + i]
                        value += wy[j, m] * part
                u = box[k, 1] + m - center[k, 0]
                # area of a target pixel on the fine grid, by the determinant of the map's derivatives
                jac = (px[1] + 2 * px[3] * u + px[4] * v) * (py[2] + py[4] * u + 2 * py[5] * v) - (
                    px[2] + px[4] * u + 2 * px[5] * v
                ) * (py[1] + 2 * py[3] * u + py[4] * v)
                out[n] += amplitude[k] * value * abs(jac)
                n += 1
