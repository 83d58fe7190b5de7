"""
Arrays-only kernels of forced photometry: sampling of templates, normal equations, covariances.

Stamps of all shapes lie one after the other in a flat array; ``start[k]`` is where stamp ``k``
begins and ``box[k] = (y0, x0, ny, nx)`` where it lies on the target image. Sums run in float64
in a fixed order, so that answers do not depend on the machine's number of cores.
"""

import numpy as np
import scipy.fft
import scipy.linalg
import scipy.sparse
from numba import njit
from scipy.sparse.linalg import splu

__all__ = [
    "add_model",
    "autocorrelation",
    "block_covariance",
    "box_response",
    "convolve_batch",
    "convolve_stamps",
    "factorize",
    "find_pairs",
    "pair_products",
    "projections",
    "sample_stamps",
    "scale_stamps",
    "spline_response",
    "stamp_sums",
]


# -- templates --------------------------------------------------------------------------------


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


# -- normal equations -------------------------------------------------------------------------


@njit(cache=True)
def _sweep(box, grow, pairs):
    # boxes sorted by y0: candidates of i end where y0[j] passes i's last row
    n = box.shape[0]
    count = 0
    for i in range(n):
        y1 = box[i, 0] + box[i, 2] + grow
        x0 = box[i, 1] - grow
        x1 = box[i, 1] + box[i, 3] + grow
        for j in range(i + 1, n):
            if box[j, 0] >= y1:
                break
            if box[j, 1] < x1 and box[j, 1] + box[j, 3] > x0 and box[j, 2] > 0 and box[i, 2] > 0:
                if pairs.shape[0] > 0:
                    pairs[count, 0] = i
                    pairs[count, 1] = j
                count += 1
    return count


def find_pairs(box, grow=0):
    """
    List the pairs i < j whose boxes overlap after one of them is grown.

    Parameters
    ----------
    box : int array, shape (n, 4)
        Boxes (y0, x0, ny, nx) sorted by y0.
    grow : int, optional
        Pixels by which a box is grown on each side.

    Returns
    -------
    pairs : int array, shape (n_pairs, 2)
    """
    n = _sweep(box, grow, np.empty((0, 2), np.int32))
    pairs = np.empty((n, 2), np.int32)
    if n:
        _sweep(box, grow, pairs)
    return pairs


@njit(cache=True)
def pair_products(a, a_box, a_start, b, b_box, b_start, pairs, out):
    """
    Sum products of two sets of stamps over the pixels they share.

    Parameters
    ----------
    a, b : `~numpy.ndarray`
        Flat stamps with their boxes and starts.
    pairs : int array, shape (n, 2)
        Rows of ``a`` and ``b``.
    out : float array, shape (n,)
        Filled with the sums.
    """
    for k in range(pairs.shape[0]):
        i, j = pairs[k, 0], pairs[k, 1]
        y0 = max(a_box[i, 0], b_box[j, 0])
        y1 = min(a_box[i, 0] + a_box[i, 2], b_box[j, 0] + b_box[j, 2])
        x0 = max(a_box[i, 1], b_box[j, 1])
        x1 = min(a_box[i, 1] + a_box[i, 3], b_box[j, 1] + b_box[j, 3])
        total = 0.0
        for y in range(y0, y1):
            na = a_start[i] + (y - a_box[i, 0]) * a_box[i, 3] - a_box[i, 1]
            nb = b_start[j] + (y - b_box[j, 0]) * b_box[j, 3] - b_box[j, 1]
            part = 0.0
            for x in range(x0, x1):
                part += a[na + x] * b[nb + x]
            total += part
        out[k] = total


@njit(cache=True)
def projections(values, box, start, image, out):
    """Sum each stamp times the image below it: ``out[k] = sum(stamp_k * image)``."""
    for k in range(box.shape[0]):
        n = start[k]
        total = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                total += values[n] * image[y, x]
                n += 1
        out[k] = total


@njit(cache=True)
def scale_stamps(values, box, start, image, out):
    """Multiply each stamp by the image below it into ``out``."""
    for k in range(box.shape[0]):
        n = start[k]
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                out[n] = values[n] * image[y, x]
                n += 1


@njit(cache=True)
def add_model(image, values, box, start, flux):
    """Add stamps times their fluxes to an image, in the order of the stamps."""
    for k in range(box.shape[0]):
        f = flux[k]
        if f == 0.0:
            continue
        n = start[k]
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                image[y, x] += f * values[n]
                n += 1


@njit(cache=True)
def stamp_sums(values, box, start, usable, out):
    """
    Sum each stamp's light: all of it inside the image, and that on usable pixels.

    ``out`` has the shape (n, 2).
    """
    for k in range(box.shape[0]):
        n = start[k]
        inside = 0.0
        good = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                inside += values[n]
                if usable[y, x]:
                    good += values[n]
                n += 1
        out[k, 0] = inside
        out[k, 1] = good


@njit(cache=True)
def residual_statistics(values, box, start, residual, inverse_sigma, out):
    """
    Template-weighted mean of (residual / sigma)^2, and the residual below the core.

    ``out`` has the shape (n, 3): mean square, sum of residuals over pixels where the
    template exceeds a tenth of its peak, and the template's own sum there.
    """
    for k in range(box.shape[0]):
        peak = 0.0
        for n in range(start[k], start[k + 1]):
            peak = max(peak, values[n])
        n = start[k]
        square = 0.0
        weight = 0.0
        left = 0.0
        core = 0.0
        for y in range(box[k, 0], box[k, 0] + box[k, 2]):
            for x in range(box[k, 1], box[k, 1] + box[k, 3]):
                t = values[n]
                if t > 0.0 and inverse_sigma[y, x] > 0.0:
                    r = residual[y, x]
                    z = r * inverse_sigma[y, x]
                    square += t * z * z
                    weight += t
                    if t > 0.1 * peak:
                        left += r
                        core += t
                n += 1
        out[k, 0] = square / weight if weight > 0.0 else np.nan
        out[k, 1] = left
        out[k, 2] = core


@njit(cache=True)
def convolve_stamps(values, box, start, kernel, out_box, out_start, out):
    """
    Convolve stamps with a small symmetric kernel; the results are larger by its half-width.

    Parameters
    ----------
    kernel : float array, shape (2 m + 1, 2 m + 1)
        Symmetric under reflection through its centre.
    out_box, out_start, out
        Boxes grown by m on each side, their starts, and the flat result (zeroed here).
    """
    size = kernel.shape[0]
    out[:] = 0.0
    for k in range(box.shape[0]):
        ny, nx = box[k, 2], box[k, 3]
        width = out_box[k, 3]
        for a in range(size):
            for b in range(size):
                c = kernel[a, b]
                if c == 0.0:
                    continue
                for y in range(ny):
                    n = start[k] + y * nx
                    m = out_start[k] + (y + a) * width + b
                    for x in range(nx):
                        out[m + x] += c * values[n + x]


def factorize(matrix):
    """
    Factorise a symmetric positive sparse matrix after scaling it to a unit diagonal.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Normal matrix; every diagonal element must be positive.

    Returns
    -------
    solve : callable
        Solves for a vector or a matrix of right-hand sides.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is singular.
    """
    scale = np.sqrt(matrix.diagonal())
    if not np.all(scale > 0):
        msg = "the normal matrix has a diagonal element that is not positive"
        raise np.linalg.LinAlgError(msg)
    unit = scipy.sparse.diags_array(1.0 / scale)
    try:
        lu = splu(
            (unit @ matrix @ unit).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as err:
        msg = f"the normal equations are singular ({err})"
        raise np.linalg.LinAlgError(msg) from None

    def solve(rhs):
        rhs = np.asarray(rhs, float)
        s = scale if rhs.ndim == 1 else scale[:, None]
        return lu.solve(rhs / s) / s

    return solve


def block_covariance(matrix, y, x, *, core, halo, middle=None, pattern=None, exact=1500):
    """
    Elements of the inverse of a normal matrix, by dense inversion of blocks on the sky.

    Parameters
    ----------
    matrix : sparse array, shape (n, n)
        Normal matrix H^-1.
    y, x : float arrays, shape (n,)
        Positions in pixels.
    core, halo : float
        Size of the blocks and of the margin around each, in pixels. The inverse decays
        exponentially away from a source, so that a margin of several PSF widths suffices.
    middle : sparse array, shape (n, n), optional
        If given, elements of H middle H are returned instead of H.
    pattern : sparse array, shape (n, n), optional
        Which elements are wanted (its non-zeros); those of ``matrix`` by default.
    exact : int, optional
        Up to this many sources are done in one block, without approximation.

    Returns
    -------
    covariance : `~scipy.sparse.csr_array`, shape (n, n)
        Symmetric, with the elements of ``pattern``.
    inverse_diagonal : `~numpy.ndarray`, shape (n,)
        Diagonal of H.
    """
    n = matrix.shape[0]
    scale = 1.0 / np.sqrt(matrix.diagonal())
    unit = scipy.sparse.diags_array(scale)
    matrix = (unit @ matrix @ unit).tocsr()
    if middle is not None:
        # H M H = D (S^-1 (D M D) S^-1) D with S = D H^-1 D
        middle = (unit @ middle @ unit).tocsr()
    pattern = (matrix if pattern is None else pattern).tocsr()
    rows, columns, values = [], [], []
    inverse_diagonal = np.empty(n)
    for near, inner in _blocks(n, y, x, core, halo, exact):
        inverse = _dense_inverse(matrix[near][:, near].toarray())
        inverse_diagonal[near[inner]] = np.diag(inverse)[inner]
        if middle is not None:
            inverse = inverse @ middle[near][:, near].toarray() @ inverse
        wanted = pattern[near[inner]][:, near].tocoo()
        i = np.flatnonzero(inner)[wanted.row]
        rows.append(near[i])
        columns.append(near[wanted.col])
        values.append(inverse[i, wanted.col])
    rows, columns = np.concatenate(rows), np.concatenate(columns)
    values = np.concatenate(values) * scale[rows] * scale[columns]
    found = scipy.sparse.coo_array((values, (rows, columns)), shape=(n, n)).tocsr()
    return ((found + found.T) * 0.5).tocsr(), inverse_diagonal * scale**2


def _blocks(n, y, x, core, halo, exact):
    """Yield the members of each block with its halo, and which of them are its own."""
    if n <= exact:
        yield np.arange(n), np.ones(n, bool)
        return
    iy, ix = np.floor(y / core).astype(int), np.floor(x / core).astype(int)
    order = np.argsort(y, kind="stable")
    ys = y[order]
    for row in np.unique(iy):
        low, high = np.searchsorted(ys, [row * core - halo, (row + 1) * core + halo])
        strip = order[low:high]
        for column in np.unique(ix[iy == row]):
            near = strip[
                (x[strip] >= column * core - halo) & (x[strip] < (column + 1) * core + halo)
            ]
            yield near, (iy[near] == row) & (ix[near] == column)


def _dense_inverse(block):
    factor, info = scipy.linalg.lapack.dpotrf(block, lower=1)
    if info == 0:
        inverse, info = scipy.linalg.lapack.dpotri(factor, lower=1)
        if info == 0:
            return np.tril(inverse) + np.tril(inverse, -1).T
    return scipy.linalg.pinvh(block)


# -- noise ------------------------------------------------------------------------------------


def autocorrelation(residual, usable, lag):
    """
    Mean product of pixel pairs by separation, over usable pixels.

    Parameters
    ----------
    residual : `~numpy.ndarray`, shape (ny, nx)
        Whitened residual (data minus model, over sigma).
    usable : bool array, shape (ny, nx)
        Pixels that count.
    lag : int
        Largest separation in pixels along each axis.

    Returns
    -------
    covariance : float array, shape (2 lag + 1, 2 lag + 1)
        Mean product, lag (0, 0) in the middle; symmetric through the centre.
    error : float array of the same shape
        Its statistical error, from the number of pairs.
    """
    good = np.asarray(usable, bool)
    ny, nx = good.shape
    size = 1024
    shape = (
        scipy.fft.next_fast_len(min(ny, size) + 2 * lag, True),
        scipy.fft.next_fast_len(nx + lag, True),
    )
    sums = np.zeros((2, lag + 1, 2 * lag + 1))
    for y0 in range(0, ny, size):
        # products of the rows of a strip with those up to lag below
        mine = good[y0 : y0 + size]
        more = good[y0 : y0 + size + lag]
        z = np.where(more, residual[y0 : y0 + size + lag], 0.0)
        for k, (a, b) in enumerate(((z[: len(mine)], z), (mine, more))):
            first = scipy.fft.rfft2(np.asarray(a, float), s=shape)
            second = scipy.fft.rfft2(np.asarray(b, float), s=shape)
            product = scipy.fft.irfft2(first.conj() * second, s=shape)
            sums[k] += product[np.ix_(np.arange(lag + 1), np.arange(-lag, lag + 1))]
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
