"""Normal equations of forced photometry, and errors that are true for correlated noise."""

import dataclasses
import functools

import numpy as np
import scipy.fft
import scipy.sparse
from astropy.stats import mad_std

from miricigale.photometry._core.noise import autocorrelation
from miricigale.photometry._core.solve import block_covariance, factorize, symmetric_lu
from miricigale.photometry._core.stamps import (
    convolve_stamps,
    cross_pairs,
    find_pairs,
    pair_products,
    projections,
    scale_stamps,
    whiten_stamps,
)
from miricigale.photometry.images.arrays import stamp_starts
from miricigale.photometry.templates.templates import Block, batches
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import argument_error
from miricigale.utils.memory import return_freed_memory
from miricigale.utils.parallel import chunks, parallel_map
from miricigale.utils.random import stream
from miricigale.utils.values import value_class

#: What correlations are multiplied by until the matrix is positive.
_SHRINK = (1.0, 1 - 1e-9, 1 - 1e-6, 1 - 1e-4, 0.999, 0.99, 0.95, 0.9, 0.8, 0.5, 0.0)


def correlated_draws(covariance, keys, size, seed):
    """
    Draw from normal distributions of zero mean with a sparse covariance, shape (size, m).

    Parameters
    ----------
    covariance : sparse array, shape (m, m)
        Rows without variance give NaN.
    keys : sequence of tuple, length m
        What each row's random stream is for (see `~miricigale.utils.random.stream`): a row that
        is correlated with no other has the same draws whatever other rows there are.
    size, seed : int
        Number of draws, and their seed.

    Notes
    -----
    By the Cholesky factor of the correlation matrix, sparse. Of long chains of blends the covariance is
    known for pairs that overlap only, which need not be positive as a whole: correlations are then
    shrunk by the least factor of a few that makes it so; variances never change.
    """
    error = np.sqrt(covariance.diagonal())
    rows = np.flatnonzero(error > 0)
    draws = nans((size, len(error)))
    if not len(rows):
        return draws
    # correlations instead of covariances
    inverse = scipy.sparse.diags_array(1.0 / error[rows])
    unit = (inverse @ covariance[rows][:, rows] @ inverse).tocoo()
    lone = unit.row == unit.col
    normal = np.empty((len(rows), size))
    for deviates, k in zip(normal, rows, strict=True):
        deviates[:] = stream(seed, *keys[k]).standard_normal(size)
    for factor in _SHRINK:
        data = np.where(lone, 1.0, factor * unit.data)
        factorization = _cholesky(
            scipy.sparse.coo_array((data, (unit.row, unit.col)), shape=unit.shape)
        )
        if factorization is not None:
            break
    lower, order = factorization
    draws[:, rows] = ((lower @ normal[np.argsort(order)])[order]).T * error[rows]
    return draws


def _cholesky(matrix):
    """Factorize a sparse matrix: lower factor and the place of each row in it, None if it is not positive."""
    try:
        lu = symmetric_lu(matrix)
    except RuntimeError:
        return None
    diagonal = lu.U.diagonal()
    if not (diagonal > 0).all() or not np.array_equal(lu.perm_r, lu.perm_c):
        return None
    return lu.L @ scipy.sparse.diags_array(np.sqrt(diagonal)), lu.perm_r


def noise_correlation(residual, usable, weight, *, executor=None):
    """
    Measure the covariance of pixels' noise on a whitened residual image.

    Parameters
    ----------
    residual, usable : `~numpy.ndarray`, shape (ny, nx)
        Data minus model, and which pixels are free of sources and have data.
    weight : `~numpy.ndarray`, shape (ny, nx)
        1 / sigma.
    executor : `concurrent.futures.Executor`, optional
        Threads to work with.

    Returns
    -------
    correlation : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1), m <= 8
        Mean product at each separation, in units of sigma^2: the middle is 1 for true
        sigmas, and the whole a single number for noise that is not correlated (0 for a
        residual that is the same everywhere).

    Raises
    ------
    ValueError
        If fewer than 100 pixels are usable.
    """
    usable = np.asarray(usable, bool)
    if np.count_nonzero(usable) < 100:
        raise argument_error("usable", "100 pixels or more", np.count_nonzero(usable))

    # some millions of pixels are enough for the mean and the spread
    step = np.s_[:: max(1, np.count_nonzero(usable) // _SOME)]
    white = residual.reshape(-1)[step] * weight.reshape(-1)[step]
    white = white[usable.reshape(-1)[step]]
    # pixels far from the median are no noise
    middle = np.median(white)
    far = _CLIP * mad_std(white)
    level = residual.dtype.type(white[np.abs(white - middle) <= far].mean(dtype=float))

    def rows(part):
        z = residual[part] * weight[part]
        return z - level, usable[part] & (np.abs(z - middle) <= far)

    lag = min(_MAX_LAG, (min(residual.shape) - 1) // 2)
    strips = [strip for strip in chunks(len(usable), 256) if usable[strip].any()]
    # those of tens of millions of pixels are enough
    strips = strips[:: 1 + np.count_nonzero(usable) // 20_000_000]
    in_threads = functools.partial(parallel_map, executor=executor)
    covariance, error = autocorrelation(rows, strips, lag, in_threads)
    if not covariance[lag, lag] > 0:
        return np.zeros((1, 1))
    # rings of equal separation, from the outermost inward until one is significant
    index = np.arange(-lag, lag + 1)
    ring = np.maximum(np.abs(index)[:, None], np.abs(index)[None])
    for outer in range(lag, 0, -1):
        member = ring == outer
        # a ring holds each value twice
        mean = covariance[member].mean()
        mean_error = error[member].mean() * np.sqrt(2.0 / np.count_nonzero(member))
        peak = np.max(np.abs(covariance[member]) / error[member])
        if abs(mean) > _SIGNIFICANCE * mean_error or peak > _SIGNIFICANCE + 1.5:
            break
        lag = outer - 1
    keep = slice(len(index) // 2 - lag, len(index) // 2 + lag + 1)
    return covariance[keep, keep].copy()


def stated_correlation(factor):
    """
    Return the covariance of pixels' noise of a mosaic that is too small for it to be measured.

    Parameters
    ----------
    factor : float
        How much noisier sums over many pixels are than their errors in quadrature; above 1.

    Returns
    -------
    correlation : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1)
        As `noise_correlation` gives it: along each axis a triangle whose values have the sum ``factor``.

    Notes
    -----
    Of drizzled images, whose drops are as wide as the output's pixels, it is what many dithers make (lag 1: 1/4).

    References
    ----------
    Fruchter & Hook 2002, PASP 114, 144, sec. 7; Casertano et al. 2000, AJ 120, 2747, appendix A.
    """
    lag = max(1, int(np.ceil(factor - 1)))
    width = lag * (lag + 1) / (2 * lag + 1 - factor)
    triangle = 1 - np.abs(np.arange(-lag, lag + 1)) / width
    return np.outer(triangle, triangle)


#: Largest separation (pixels) of the noise correlation; pixels further from the median than this many robust
#: standard deviations do not take part; rings of separations whose mean is less significant than this are cut off.
_MAX_LAG = 8
_CLIP = 5.0
_SIGNIFICANCE = 3.0

#: Pairs of stamps that a thread works on at a time.
_PAIRS = 1024

#: Pixels of which the spread of the noise is taken, where there are more.
_SOME = 4_000_000


def _whitened(bank, block, inverse_sigma):
    """Divide a block's stamps by the noise, and return their sums as `whiten_stamps` makes them."""
    white = dataclasses.replace(block, values=np.empty_like(block.values))
    sums = np.empty((len(block.box), 4))

    def scale(part):
        values, box, start = block.stamps_of(part)
        whiten_stamps(values, box, start, inverse_sigma, white.values, sums[part])

    bank.map(scale, block.parts())
    return white, sums


def _weighted(bank, block, inverse_sigma):
    """Divide a block's stamps by the noise in place: products with stamps as they are then have all weights."""

    def scale(part):
        values, box, start = block.stamps_of(part)
        scale_stamps(values, box, start, inverse_sigma)

    bank.map(scale, block.parts())
    return block


def _projected(bank, block, images):
    """Sum a block's stamps times images, shape (n, len(images))."""
    out = np.empty((len(images), len(block.box)))

    def project_part(part):
        values, box, start = block.stamps_of(part)
        for image, sums in zip(images, out, strict=True):
            projections(values, box, start, image, sums[part])

    bank.map(project_part, block.parts())
    return out.T


def _products(bank, left_block, right_block, pairs):
    """Sum the products of pairs of stamps of two blocks."""
    out = np.empty(len(pairs))

    def multiply(part):
        pair_products(*left_block.stamps, *right_block.stamps, pairs[part], out[part])

    bank.map(multiply, chunks(len(pairs), _PAIRS))
    return out


def _walk(bank, inverse_sigma, images, spread=None, crossing=None, last=False):
    """
    Sum products of all pairs of the whitened stamps, and their projections on images.

    At most those blocks are in memory that can still overlap. The right-hand block of a pair has the weights of
    both, so that the left-hand ones are those of the bank. ``spread`` is what is done to it between these; stamps
    grow by its ``lag``. ``crossing`` (`_Crossing`) gets all right-hand blocks. ``last``: whether the bank's stamps
    are not needed after that. Returns the matrix, (n, n), the projection, and the stamps' sums.
    """
    n = len(bank.order)
    grow = 0 if spread is None else spread.lag
    pairs = find_pairs(bank.box, grow=grow)
    products = np.zeros(len(pairs))
    diagonal = np.empty(n)
    sums = np.empty((n, 4))
    projection = np.empty((n, len(images)))
    live = []
    for block in bank.blocks(last=last):
        rows = slice(block.first, block.last)
        # stamps over the noise, and their projections
        white, sums[rows] = _whitened(bank, block, inverse_sigma)
        projection[rows] = _projected(bank, white, images)
        diagonal[rows] = sums[rows, 3]
        if spread is not None:
            white = spread(white)
        mine = _weighted(bank, white, inverse_sigma)
        if spread is not None:
            diagonal_pairs = np.repeat(np.arange(len(block.box), dtype=np.int32), 2).reshape(-1, 2)
            diagonal[rows] = _products(bank, block, mine, diagonal_pairs)
        if crossing is not None:
            crossing.add(mine)
        live = [held for held in live if held.end + grow > block.box[0, 0]]
        live.append(block)
        for left_block in live:
            # pairs whose stamps are in these two blocks
            low, high = np.searchsorted(pairs[:, 0], [left_block.first, left_block.last])
            met = low + np.flatnonzero(
                (pairs[low:high, 1] >= block.first) & (pairs[low:high, 1] < block.last)
            )
            if len(met):
                local = pairs[met] - np.array([left_block.first, block.first], pairs.dtype)
                products[met] = _products(bank, left_block, mine, local)
        if last:
            # what was dropped on the way
            return_freed_memory()
    # the matrix is symmetric: each pair stands twice
    i, j = pairs.T.astype(np.int64)
    places = np.concatenate([np.arange(n), i, j]), np.concatenate([np.arange(n), j, i])
    data = np.concatenate([diagonal, products, products])
    return scipy.sparse.coo_array((data, places), shape=(n, n)).tocsr(), projection, sums


def normal_matrix(bank, inverse_sigma, images=()):
    """
    Build the whitened normal equations of the templates of a bank.

    Parameters
    ----------
    bank : `~miricigale.photometry.templates.templates.TemplateBank`
        n templates.
    inverse_sigma : `~numpy.ndarray`, shape (ny, nx)
        1 / sigma, zero where masked.
    images : list of `~numpy.ndarray`, shape (ny, nx)
        Whitened images onto which the whitened templates are projected.

    Returns
    -------
    matrix : `~scipy.sparse.csr_array`, shape (n, n)
        Products of the whitened templates.
    projection : `~numpy.ndarray`, shape (n, len(images))
    power, light : `~numpy.ndarray`, shape (n,) and (n, 2)
        Sums of squares of the templates without weights; their sums inside the image, and on usable pixels.
    """
    matrix, projection, sums = _walk(bank, inverse_sigma, images)
    return matrix, projection, sums[:, 2], sums[:, :2]


def sandwich_matrix(bank, inverse_sigma, correlation, images=(), *, last=False):
    """
    Build A^T W C W A, (n, n), and its projection: what correlated noise does to the right-hand side.

    ``correlation``, (2 m + 1, 2 m + 1), is the covariance of the whitened noise by separation, ``last`` whether
    the stamps are not needed after that; the rest is as in `normal_matrix`. Stamps are convolved with it by
    transforms in single precision, that of the correlation made once for each padded shape.
    """
    return _walk(bank, inverse_sigma, images, _Spread(correlation, bank), last=last)[:2]


class _Spread:
    """Convolves the whitened stamps of a block with the noise's correlation."""

    def __init__(self, correlation, bank):
        self.lag = correlation.shape[0] // 2
        self._map = bank.map
        self._kernel = np.asarray(correlation, np.float32)
        self._transfer = functools.lru_cache(maxsize=64)(
            lambda shape: scipy.fft.rfft2(self._kernel, s=shape)
        )

    def __call__(self, block):
        lag = self.lag
        if lag == 0:
            return dataclasses.replace(block, values=block.values * self._kernel[0, 0])
        # stamps grow by the lag on each side
        box = block.box + np.array([-lag, -lag, 2 * lag, 2 * lag])
        start = stamp_starts(box)
        values = np.empty(int(start[-1]), np.float32)

        def convolve(batch):
            shape, rows = batch
            transfer = self._transfer(shape)
            convolve_stamps(
                block.values, block.box, block.start, rows, transfer, shape, box, start, values
            )

        # rounded up so that many stamps share a shape
        sizes, index = np.unique(-(-box[:, 2:] // 8) * 8, return_inverse=True)
        fast = np.array([scipy.fft.next_fast_len(int(n), True) for n in sizes], int)
        shapes = fast[index].reshape(-1, 2).tolist()
        self._map(convolve, batches(map(tuple, shapes)))
        return Block(block.first, box, start, values)


def change_matrices(bank, change_bank, inverse_sigma, images, correlation=None, *, last=False):
    """
    Build the normal equations of changes of templates: their products with the templates, and with each other.

    Parameters
    ----------
    bank, change_bank : `~miricigale.photometry.templates.templates.TemplateBank`
        n templates and m changes on one image.
    inverse_sigma, images
        As for `normal_matrix`.
    correlation : `~numpy.ndarray`, optional
        As for `sandwich_matrix`: if given, the stamps of the changes are convolved with it.
    last : bool, optional
        Whether the changes' stamps are not needed after that: they are dropped on the way.

    Returns
    -------
    cross : `~scipy.sparse.csr_array`, shape (n, m)
        Products of the whitened templates and changes.
    matrix : `~scipy.sparse.csr_array`, shape (m, m)
        Products of the whitened changes.
    projection : `~numpy.ndarray`, shape (m, len(images))
        Of the changes.
    """
    spread = None
    if correlation is not None:
        spread = _Spread(correlation, change_bank)
    # both in one walk, in which each stamp is whitened and convolved once
    crossing = _Crossing(bank)
    matrix, projection, _ = _walk(change_bank, inverse_sigma, images, spread, crossing, last)
    return crossing.matrix(len(change_bank.order)), matrix, projection


class _Crossing:
    """Sums products of the stamps of a bank with weighted blocks of another one, as both go down the image."""

    def __init__(self, bank):
        self._bank = bank
        self._waiting = bank.blocks()
        self._live = []
        self._rows = []
        self._columns = []
        self._values = []

    def add(self, right_block):
        """Add the products with the stamps of a block, which follows those that were added before."""
        bank = self._bank
        # those blocks only that this one and those after it can overlap
        live = [held for held in self._live if held.end > right_block.box[0, 0]]
        while not live or live[-1].box[0, 0] < right_block.end:
            left_block = next(self._waiting, None)
            if left_block is None:
                break
            live.append(left_block)
        self._live = live
        for left_block in live:
            pairs = cross_pairs(left_block.box, right_block.box)
            if len(pairs):
                self._values.append(_products(bank, left_block, right_block, pairs))
                self._rows.append(pairs[:, 0] + left_block.first)
                self._columns.append(pairs[:, 1] + right_block.first)

    def matrix(self, n_columns):
        """Return the products, (n, n_columns), as a `~scipy.sparse.csr_array`."""
        shape = len(self._bank.order), n_columns
        if not self._values:
            return scipy.sparse.csr_array(shape)
        places = (np.concatenate(self._rows), np.concatenate(self._columns))
        values = np.concatenate(self._values)
        return scipy.sparse.coo_array((values, places), shape=shape).tocsr()


@value_class
class LinearFit:
    """
    Least squares for sparse sources plus a few parameters of the whole image.

    Notes
    -----
    The common parameters are eliminated by their Schur complement, so that the sparse
    factor is that of the sources alone.
    """

    matrix: object  # (n, n): Normal matrix of the sources.
    rhs: np.ndarray  # (n,)
    border: np.ndarray  # (n, g): Products of sources and common parameters.
    #: (g, g) and (g,): The common parameters' own part.
    corner: np.ndarray
    corner_rhs: np.ndarray

    def __post_init__(self):
        solve = factorize(self.matrix)
        z = self.border
        if self.border.shape[1]:
            z = solve(self.border)
        # the Schur complement of the sources, and its solution
        q = np.linalg.inv(self.corner - self.border.T @ z)
        # the common parameters first, then the sources
        common = q @ (self.corner_rhs - z.T @ self.rhs)
        results = {"solve": solve, "_z": z, "_q": q, "common": common}
        results["flux"] = solve(self.rhs) - z @ common
        # the class is frozen
        self.__dict__.update(results)

    @property
    def common_covariance(self):
        """Covariance of the common parameters for white noise, shape (g, g)."""
        return self._q

    def covariances(self, xy, fillings, *, core, halo, pattern=None):
        """
        Calculate covariances of sources that overlap, and of the common parameters.

        Parameters
        ----------
        xy : `~numpy.ndarray`, shape (n, 2)
            Positions in pixels.
        fillings : sequence of tuple or None
            Fillings of the sandwich, each its sparse matrix, border and corner; None for noise
            that is white with the given sigmas.
        core, halo, pattern
            See `~miricigale.photometry._core.solve.block_covariance`.

        Returns
        -------
        covariances : list of tuple
            For each filling the covariance of the sources (`~scipy.sparse.csr_array`, shape (n, n))
            and that of the common parameters, shape (g, g).
        blending : `~numpy.ndarray`, shape (n,)
            Formal error over that of the source alone.
        """
        z = self._z
        q = self._q
        middles = [None if filling is None else filling[0] for filling in fillings]
        x, y = xy.T
        local, inverse = block_covariance(
            self.matrix, y, x, core=core, halo=halo, pattern=pattern, middles=middles
        )
        # the inverse of the whole system adds Z Q Z^T to that of the sources alone
        inverse = inverse + np.einsum("kg,kg->k", z @ q, z)
        blending = np.sqrt(inverse * self.matrix.diagonal())
        covariances = list(map(self._with_common, local, fillings))
        return covariances, blending

    def _with_common(self, local, filling):
        """Add to the sources' covariance what the common parameters add, and return that of those."""
        z = self._z
        q = self._q
        if not len(q):
            return local, q
        if filling is None:
            return _add_low_rank(local, [(z @ q, z)]), q
        middle, border, corner = filling
        # theta = Q (b_g - Z^T b_s), x = S^-1 b_s - Z theta
        cross = (border - middle @ z) @ q
        common = corner - border.T @ z - z.T @ border + z.T @ (middle @ z)
        common = q @ common @ q
        e = self.solve(cross)
        return _add_low_rank(local, [(z @ common, z), (-e, z), (-z, e)]), common


def _add_low_rank(matrix, terms):
    """Add sums of outer products to the non-zeros of a sparse matrix."""
    coo = matrix.tocoo()
    data = coo.data.copy()
    for first, second in terms:
        data += np.einsum("kg,kg->k", first[coo.row], second[coo.col])
    return scipy.sparse.coo_array((data, (coo.row, coo.col)), shape=matrix.shape).tocsr()
