"""
Ramps to slopes: saturation, reference columns, linearity, jumps and the fit in one pass.

The slope is the exact generalized-least-squares one for Poisson and read noise (Brandt
2024a), and a jump is what raises the likelihood by more than a threshold (Brandt 2024b);
see `miricigale.reduction._core` for the closed forms.

Weights depend on the slope through the Poisson variance. That biases a fit whose variances
are taken from the differences themselves; here the variance comes from the pixel's own
optimal slope, common to all segments and integrations. Any change of the weights then adds
a contrast of differences that is uncorrelated with this slope (Gauss-Markov theorem), so
that there is no bias to first order.
"""

import dataclasses

import numpy as np

from miricigale.instrument import DQ
from miricigale.reduction import _core
from miricigale.utils.exceptions import argument_error
from miricigale.utils.parallel import chunks, parallel_map, threads

__all__ = ["RampFit", "fit_groups", "fit_result", "reference_drift", "threshold"]

# rows that one call of the kernel fits; the events come out in this order
_ROWS = 32


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class RampFit:
    """
    Slopes of the ramps of one exposure.

    Parameters
    ----------
    rate : `~numpy.ndarray` of float32, shape (ny, nx)
        Slope in DN/s; NaN where there is none.
    var_poisson, var_read : `~numpy.ndarray` of float32, shape (ny, nx)
        The two parts of its variance, (DN/s)^2.
    n_used : `~numpy.ndarray` of int16, shape (ny, nx)
        Differences of groups that the slope stands on, all integrations.
    n_jump : `~numpy.ndarray` of int16, shape (ny, nx)
        Jumps found in the pixel.
    flags : `~numpy.ndarray` of int64, shape (ny, nx)
        `~miricigale.instrument.DQ`.
    jumps : `~numpy.ndarray`, shape (n_jumps,)
        Every jump found: structured array with ``y``, ``x``, ``integration``, ``group`` (the
        first after the jump) and signed ``significance`` in sigma.
    """

    rate: np.ndarray
    var_poisson: np.ndarray
    var_read: np.ndarray
    n_used: np.ndarray
    n_jump: np.ndarray
    flags: np.ndarray
    jumps: np.ndarray

    @property
    def error(self):
        """Standard deviation of the slope, DN/s."""
        return np.sqrt(self.var_poisson + self.var_read)

    def __repr__(self):
        ny, nx = self.rate.shape
        return f"<RampFit {ny} x {nx} pixels, {len(self.jumps)} jumps>"


_JUMP_TYPE = np.dtype(
    [("y", "i4"), ("x", "i4"), ("integration", "i4"), ("group", "i4"), ("significance", "f8")]
)


def reference_drift(data, reference):
    """
    Mean level of the reference pixels in each group.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN.
    reference : `~numpy.ndarray` of bool, shape (ny, nx)
        Which pixels see no light.

    Returns
    -------
    drift : `~numpy.ndarray`, shape (n_int, n_group)
        Mean of each group's reference pixels minus the mean over all groups, DN; zeros if
        there is no reference pixel.
    """
    drift = np.zeros(data.shape[:2])
    columns = np.flatnonzero(reference.any(axis=0))
    if columns.size == 0:
        return drift
    chosen = reference[:, columns]
    for k, g in np.ndindex(*drift.shape):
        drift[k, g] = data[k, g][:, columns][chosen].mean(dtype=float)
    return drift - drift.mean()


def fit_groups(
    data,
    *,
    group_time,
    gain,
    read_noise,
    bias=0.0,
    linearity=(0.0, 1.0),
    saturation=np.inf,
    usable=None,
    first_group=0,
    last_group=None,
    jump_threshold=5.0,
    neighbor_threshold=10.0,
    poisson_factor=1.0,
    n_threads=None,
    progress_bar=False,
):
    """
    Fit slopes to ramps, splitting them at jumps.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN (one read each). It is read row by row and never copied as a whole.
    group_time : float
        Time between groups, s.
    gain : float
        Electrons per DN.
    read_noise : float
        Standard deviation of one read, DN. The variance of rounding, 1/12, is added for
        integer data.
    bias : float or array_like, shape (n_int, n_group), optional
        Level of an empty pixel in each group, DN.
    linearity : sequence of float, optional
        Polynomial (lowest power first) from measured to linear DN above the bias.
    saturation : float, optional
        Raw DN from which a group and all later ones of the integration are left out.
    usable : `~numpy.ndarray` of bool, shape (ny, nx), optional
        Pixels to fit; the others get NaN.
    first_group, last_group : int, optional
        Range of groups that take part (``last_group`` is not included).
    jump_threshold : float or None, optional
        A difference of groups is cut out if freeing it lowers chi squared by more than the
        square of this; None for no jump detection.
    neighbor_threshold : float or None, optional
        Where a jump is more significant than this, the four neighbors are cut at the same
        difference too.
    poisson_factor : float, optional
        Variance of the photon noise of a pixel over that of independent electrons: below 1
        where neighbors share charge (interpixel capacitance), by the sum of the squared
        coupling kernel.
    n_threads : int, optional
        Number of threads; by default one for each processor. It changes nothing in the
        result.
    progress_bar : bool, optional
        Whether a progress bar is shown.

    Returns
    -------
    fit : `RampFit`

    Raises
    ------
    ValueError
        If there are fewer than two groups or an option is out of range.

    Notes
    -----
    All integrations share one slope, so that they are combined with the optimal weights
    and a jump is judged against all of them. A ramp of two differences cannot tell which
    of them jumped: the higher one is cut. A single difference is never cut.

    References
    ----------
    Brandt 2024a, PASP 136, 045004; 2024b, PASP 136, 045005; Hu & O'Connell 1996, J. Phys. A
    29, 1511 (inverse of a tridiagonal Toeplitz matrix).
    """
    data = np.asarray(data)
    if data.ndim != 4:
        raise argument_error("data", "of four dimensions", f"shape {data.shape}")
    n_int, n_group, ny, nx = data.shape
    last_group = n_group if last_group is None else last_group
    if not 0 <= first_group <= last_group - 2 <= n_group - 2:
        wanted = f"a range of at least two of the {n_group} groups"
        raise argument_error("first_group, last_group", wanted, f"{first_group}, {last_group}")
    for name, value in (
        ("group_time", group_time),
        ("gain", gain),
        ("poisson_factor", poisson_factor),
    ):
        if not (np.isfinite(value) and value > 0):
            raise argument_error(name, "positive", value)
    if not (np.isfinite(read_noise) and read_noise >= 0):
        raise argument_error("read_noise", "at least 0", read_noise)
    jump = threshold(jump_threshold, "jump_threshold")
    neighbor = threshold(neighbor_threshold, "neighbor_threshold")
    usable = np.ones((ny, nx), bool) if usable is None else np.ascontiguousarray(usable, bool)
    if usable.shape != (ny, nx):
        raise argument_error("usable", f"of shape {(ny, nx)}", usable.shape)

    # one type of array for the compiled kernels, also of arrays that own no memory
    data = data.view()
    data.flags.writeable = False
    offset = np.array(np.broadcast_to(np.asarray(bias, float), (n_int, n_group)), order="C")
    coef = np.array(linearity, float)
    variance = read_noise**2 + (1 / 12 if data.dtype.kind in "iu" else 0.0)
    out = (
        np.zeros((ny, nx), np.float32),
        np.zeros((ny, nx), np.float32),
        np.zeros((ny, nx), np.float32),
        np.zeros((ny, nx), np.int16),
        np.zeros((ny, nx), np.int16),
        np.zeros((ny, nx), np.int64),
    )
    ramp = (data, offset, coef, float(saturation))
    groups = (first_group, last_group)
    # a trace of read noise keeps the closed forms finite
    noise = (max(variance, 1e-6), poisson_factor / gain, 1 / group_time, jump)

    def fit_block(rows):
        return _core.fit_rows(*ramp, usable, rows.start, rows.stop, *groups, *noise, *out)

    def refit_block(part):
        ys, xs, start, cuts = part
        _core.refit(*ramp, ys, xs, start, cuts, *groups, *noise, *out)

    with threads(n_threads) as executor:
        events = parallel_map(
            fit_block,
            chunks(ny, _ROWS),
            executor=executor,
            progress_bar=progress_bar,
            desc="slopes",
        )
        events = np.concatenate(events)
        n_diff = last_group - first_group - 1
        parts = list(_neighbors(events, neighbor, usable, n_diff))
        parallel_map(refit_block, parts, executor=executor)

    return fit_result(*out, events, first_group)


def fit_result(rate, var_poisson, var_read, n_used, n_jump, flags, events, first_group):
    """Make a `RampFit` of what the kernels give; jumps are counted from ``first_group``."""
    flags[np.isnan(rate)] |= int(DQ.NO_SLOPE | DQ.DO_NOT_USE)
    jumps = np.empty(len(events), _JUMP_TYPE)
    for i, name in enumerate(("y", "x", "integration", "group", "significance")):
        jumps[name] = events[:, i]
    jumps["group"] += first_group + 1
    return RampFit(rate, var_poisson, var_read, n_used, n_jump, flags, jumps)


def threshold(value, name):
    """Return a threshold as a float, infinite for None."""
    if value is None:
        return np.inf
    if not value > 0:
        raise argument_error(name, "positive or None", value)
    return float(value)


def _neighbors(events, threshold, usable, n_diff):
    """
    Yield the pixels beside large jumps and where they are to be cut.

    Each part is the argument of one call of the kernel: rows, columns, start of each
    pixel's cuts, and the cuts. Pixels keep the cuts that they found themselves.
    """
    ny, nx = usable.shape
    large = events[np.abs(events[:, 4]) >= threshold].astype(np.int64)
    if len(large) == 0:
        return
    cut = large[:, 2] * n_diff + large[:, 3]
    pixels, cuts = [], []
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y, x = large[:, 0] + dy, large[:, 1] + dx
        inside = (y >= 0) & (y < ny) & (x >= 0) & (x < nx)
        inside[inside] = usable[y[inside], x[inside]]
        pixels.append(y[inside] * nx + x[inside])
        cuts.append(cut[inside])
    pixels, cuts = np.concatenate(pixels), np.concatenate(cuts)
    own = events[:, :4].astype(np.int64)
    own_pixels = own[:, 0] * nx + own[:, 1]
    again = np.isin(own_pixels, pixels)
    pixels = np.concatenate([pixels, own_pixels[again]])
    cuts = np.concatenate([cuts, own[again, 2] * n_diff + own[again, 3]])
    order = np.lexsort((cuts, pixels))
    pixels, cuts = pixels[order], cuts[order]
    unique, start = np.unique(pixels, return_index=True)
    start = np.append(start, len(pixels))
    for part in chunks(len(unique), 4096):
        first = start[part.start]
        yield (
            unique[part] // nx,
            unique[part] % nx,
            start[part.start : part.stop + 1] - first,
            cuts[first : start[part.stop]],
        )
