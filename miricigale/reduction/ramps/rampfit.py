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

import numpy as np

from miricigale.depth._core import shared_photons
from miricigale.instrument import DQ
from miricigale.reduction._core.batched_pixels import fit_pixels
from miricigale.reduction._core.pixel import own_charge
from miricigale.reduction.ramps.showers import find_showers
from miricigale.reduction.references.reference_maps import read_variance
from miricigale.utils.arrays import is_inside
from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing_values import floats, without_mask
from miricigale.utils.options import check_positive, check_shape, check_that
from miricigale.utils.parallel import chunks, parallel_map, threads
from miricigale.utils.units import check_count
from miricigale.utils.values import value_class

# rows that one call of the kernel fits; the events come out in this order
_ROWS = 32

# pixels that are fitted again in one call
_PIXELS = 4096


@value_class
class RampFit:
    """
    Slopes of the ramps of one exposure.

    Parameters
    ----------
    rate : `~numpy.ndarray` of float32, shape (ny, nx)
        Slope in DN/s; NaN where there is none.
    var_poisson, var_read : `~numpy.ndarray` of float32, shape (ny, nx)
        The two parts of its variance, (DN/s)^2: of photons, and of the read-out.
    n_used : `~numpy.ndarray` of int16, shape (ny, nx)
        Differences of groups that the slope stands on, all integrations.
    n_jump : `~numpy.ndarray` of int16, shape (ny, nx)
        Jumps found in the pixel.
    flags : `~numpy.ndarray` of int64, shape (ny, nx)
        `~miricigale.instrument.DQ`.
    jumps : `~numpy.ndarray`, shape (n_jumps,)
        Every jump found: structured array with ``y``, ``x``, ``integration``, ``group`` (the
        first after the jump) and signed ``significance`` in sigma.
    settling : int or None, optional
        First groups that had not settled after the reset (`settling_groups`); None if they were not looked at.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure, Reducer
    >>> exposure = Exposure("F770W", n_groups=20, subarray="SUB64", pointing="53 -27")
    >>> sky = np.full(exposure.shape, 5.0) * u.MJy / u.sr
    >>> ramp = Detector.miri_imager().expose(sky, exposure, seed=1)
    >>> fit = Reducer().fit_groups(ramp)
    >>> print(f"{np.nanmedian(fit.rate):.1f} +- {np.nanmedian(fit.error):.1f} DN/s")
    14.2 +- 3.0 DN/s
    """

    rate: np.ndarray
    var_poisson: np.ndarray
    var_read: np.ndarray
    n_used: np.ndarray
    n_jump: np.ndarray
    flags: np.ndarray
    jumps: np.ndarray
    settling: int | None = None

    @property
    def error(self):
        """Standard deviation of the slope, DN/s."""
        return np.sqrt(self.var_poisson + self.var_read)

    def noise_correction(self, kernel):
        """
        Return the noise of large areas over that of single pixels in quadrature.

        Parameters
        ----------
        kernel : `~numpy.ndarray`
            How pixels share their charge; its sum is 1.

        Returns
        -------
        factor : float
            Of the medians of the two parts of the variance; 1 without any slope.
        """
        good = np.isfinite(self.rate)
        if not good.any():
            return 1.0
        photon = float(np.median(self.var_poisson[good]))
        read = float(np.median(self.var_read[good]))
        shared = float(np.sum(kernel**2))
        return float(np.sqrt((photon / shared + read) / (photon + read)))

    def __repr__(self):
        ny, nx = self.rate.shape
        return f"<RampFit {ny} x {nx} pixels, {len(self.jumps)} jumps>"


_JUMP_TYPE = np.dtype(
    [("y", "i4"), ("x", "i4"), ("integration", "i4"), ("group", "i4"), ("significance", "f8")]
)


def fit_groups(
    data,
    maps,
    *,
    group_time,
    drift=0.0,
    usable=None,
    group_dq=None,
    first_group=0,
    last_group=None,
    jump_threshold=5.0,
    neighbor_threshold=5.0,
    shower_threshold=None,
    poisson_factor=1.0,
    n_frames=1,
    n_threads=None,
    progress_bar=False,
):
    """
    Fit slopes to ramps, splitting them at jumps.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (n_int, n_group, ny, nx)
        Groups in DN (one read each). It is read row by row and never copied as a whole.
    maps : `DetectorMaps`
        What the detector is taken for. The variance of rounding, 1/12, is added to that of reads
        for integer data; the gain is infinite where photons make no noise. Of ``reset`` and
        ``dark`` the last integration stands for all further ones, and a dark has no fewer groups
        than are fitted.
    group_time : float
        Time between groups, s.
    drift : array_like, shape (n_int, n_group) or (n_int, n_group, 1 or ny, 4), optional
        What is added to the bias in each group, DN; of the four channels of the read-out, to which
        columns belong in turn, and of rows.
    usable : `~numpy.ndarray` of bool, shape (ny, nx), optional
        Pixels to fit; the others get NaN.
    group_dq : `~numpy.ndarray` of uint8, shape of the data, optional
        Flags of groups (lower bits of `~miricigale.instrument.DQ`): of one that is not to be used
        both differences are cut, of a jump that before it, and a saturated one ends its integration.
    first_group, last_group : int, optional
        Range of groups that take part (``last_group`` is not included).
    jump_threshold : float or None, optional
        A difference of groups is cut out if freeing it lowers chi squared by more than the
        square of this; None for no jump detection.
    neighbor_threshold : float or None, optional
        Where a jump is more significant than this, the four neighbors are cut at the same
        difference too. What leaked into it (0.05 of the jumps of its own four neighbors) does not count,
        so that the neighbors of pixels beside a hit are not cut for the leak of that hit.
    shower_threshold : float or None, optional
        Around tracks of jumps of 300 sigma together, differences are cut where the excess over the groups beside,
        smoothed over 4 pixels, is above so many sigma: showers. None for none.
    n_frames : int, optional
        Frames whose mean a group is. Then read noise is that of one frame, neighboring differences share photons,
        a jump takes the differences beside it too, and a group whose last frame is saturated ends the ramp.
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

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.reduction import DetectorMaps, fit_groups
    >>> groups = np.zeros((1, 20, 4, 4), np.uint16)
    >>> groups += np.arange(0, 200, 10, dtype=np.uint16)[:, None, None]
    >>> groups[:, 12:, 2, 3] += 500  # a hit
    >>> maps = DetectorMaps(gain=4.0, read_noise=6.0)
    >>> fit = fit_groups(groups, maps, group_time=2.0)
    >>> print(f"{fit.rate[2, 3]:.2f} DN/s, jump in group {fit.jumps['group'][0]}")
    5.00 DN/s, jump in group 12
    """
    data, is_rounded = _counts(data)
    ny, nx = data.shape[2:]
    last_group = _last_group(first_group, last_group, data.shape[1])
    for name, value in (("group_time", group_time), ("poisson_factor", poisson_factor)):
        check_that(np.isfinite(value) and value > 0, name, "positive", value)
    n_frames = check_count(n_frames, "n_frames")
    jump = threshold(jump_threshold, "jump_threshold")
    neighbor = threshold(neighbor_threshold, "neighbor_threshold")
    shower = threshold(shower_threshold, "shower_threshold")
    if usable is None:
        usable = np.ones((ny, nx), bool)
    else:
        usable = np.ascontiguousarray(usable, bool)
    check_shape(usable, (ny, nx), "usable")
    noise = _noise(maps, usable, n_frames, poisson_factor, rounded=is_rounded)
    ramp = (data, *_response(maps, usable, drift, data.shape, last_group, n_frames))
    group_dq = _group_dq(group_dq, data.shape)
    fit = (first_group, last_group, noise, 1 / group_time, jump)
    out = tuple(np.full((ny, nx), np.nan, np.float32) for _ in range(3))
    out += tuple(np.zeros((ny, nx), kind) for kind in (np.int16, np.int16, np.int64))

    def fit_part(part):
        ys, xs, start, cuts = part
        events = fit_pixels(ramp, group_dq, ys, xs, start, cuts, fit, out)
        return events[np.lexsort(events.T[3::-1])]

    def fit_rows(rows):
        ys, xs = np.nonzero(usable[rows])
        none = np.zeros(len(ys) + 1, np.int64)
        # a copy, as all others are contiguous: for another layout the kernel would be compiled again
        return fit_part((ys + rows.start, xs.copy(), none, none[:0]))

    with threads(n_threads) as executor:
        events = np.concatenate(
            parallel_map(
                fit_rows,
                chunks(ny, _ROWS),
                executor=executor,
                progress_bar=progress_bar,
                desc="slopes",
            )
        )
        showers = np.zeros((4, 0), np.int64)
        if np.isfinite(shower):
            showers = find_showers(
                data, events, usable, shower, first_group=first_group, last_group=last_group
            )
        parts = list(_cut_again(events, neighbor, usable, last_group - first_group - 1, showers))
        parallel_map(fit_part, parts, executor=executor)

    return fit_result(*out, events, first_group)


def _counts(data):
    """Return groups with NaN where they are masked, and whether the counts were whole numbers."""
    data, hidden = without_mask(data)
    data = np.asarray(data)
    is_rounded = data.dtype.kind in "iu"
    if hidden is not None:
        data = np.where(hidden, np.nan, data)
    check_that(data.ndim == 4, "data", "of four dimensions", f"shape {data.shape}")
    return _read_only(data), is_rounded


def _last_group(first_group, last_group, n_group):
    """Return the end of the range of groups that take part, two or more of ``n_group``."""
    if last_group is None:
        last_group = n_group
    if not 0 <= first_group <= last_group - 2 <= n_group - 2:
        wanted = f"a range of at least two of the {n_group} groups"
        raise argument_error("first_group, last_group", wanted, f"{first_group}, {last_group}")
    return last_group


def _noise(maps, usable, n_frames, poisson_factor, *, rounded):
    """Return the noise for the kernel: read variance, Poisson factor per DN, slow variance, shared photons."""
    gain = _map(maps.gain, "gain", usable, above=0.0, infinite=True)
    read_noise = _map(maps.read_noise, "read_noise", usable, floor=0.0)
    slow_noise = _map(maps.slow_noise, "slow_noise", usable, floor=0.0)
    # a trace of read noise keeps the closed forms finite
    variance = np.maximum(read_variance(read_noise, n_frames, rounded=rounded), 1e-6)
    return variance, poisson_factor / gain, np.square(slow_noise), shared_photons(n_frames)


def _response(maps, usable, drift, shape, last_group, n_frames):
    """Return offsets (drift, bias, reset) and response (linearity, saturation, dark, rise) for the kernel."""
    bias = _map(maps.bias, "bias", usable)
    saturation = _map(maps.saturation, "saturation", usable, infinite=True)
    coef = np.stack([_map(plane, "linearity", usable) for plane in maps.linearity])
    drift = _drift(drift, shape)
    if bias.size == 1:
        # one sum for all pixels
        drift = bias[0, 0] + drift
        bias = np.zeros((1, 1))
    reset = _groups(maps.reset, "reset", shape)
    dark = _groups(maps.dark, "dark", shape, n_least=last_group)
    # the last frame of a group is half a group of frames above its mean
    rise = (n_frames - 1) / (2 * n_frames)
    return (drift, bias, reset), (coef, saturation, dark, rise)


def _group_dq(group_dq, shape):
    """Return flags of groups, an empty array for none."""
    if group_dq is None:
        group_dq = np.zeros((1, 0, 1, 1), np.uint8)
    elif np.shape(group_dq) != shape or np.asarray(group_dq).dtype != np.uint8:
        got = f"{np.asarray(group_dq).dtype}, shape {np.shape(group_dq)}"
        raise argument_error("group_dq", f"uint8, of shape {shape}", got)
    return _read_only(group_dq)


def _read_only(array):
    """Return one type of array for the compiled kernels, also of arrays that own no memory."""
    array = np.ascontiguousarray(array).view()
    array.flags.writeable = False
    return array


def _map(values, name, usable, *, above=-np.inf, floor=-np.inf, infinite=False):
    """Return one value (1, 1), or one for each pixel, that is in range wherever it is used."""
    values = np.array(floats(values), ndmin=2, order="C")
    wanted = f"one number or of shape {usable.shape}"
    check_that(values.shape in ((1, 1), usable.shape), name, wanted, values.shape)
    good = (values > above) & (values >= floor) & (np.isfinite(values) | infinite)
    if values.size == 1:
        bad = ~good
    else:
        bad = ~good & usable
    if above == 0:
        wanted = "positive"
    elif floor == 0:
        wanted = "at least 0"
    else:
        wanted = "finite"
    if values.size == 1:
        got = values[0, 0]
    else:
        got = f"{np.count_nonzero(bad)} pixels with others"
    check_that(not bad.any(), name, wanted, got)
    # the value of pixels that are not used must not stop the others beside them
    return np.where(good, values, 1.0)


def _drift(values, shape):
    """Return the drift of the read-out as (n_int, n_group, rows, channels)."""
    values = floats(values)
    if values.ndim <= 2:
        values = np.broadcast_to(values, shape[:2])[:, :, None, None]
    fits = values.ndim == 4 and values.shape[:2] == shape[:2] and values.shape[2] in (1, shape[2])
    if not fits or values.shape[3] not in (1, 4) or not np.isfinite(values).all():
        wanted = f"finite, of shape {shape[:2]} or {shape[:2] + ('1 or ' + str(shape[2]), 4)}"
        raise argument_error("drift", wanted, f"shape {values.shape}")
    return np.array(values, order="C")


def _groups(values, name, shape, *, n_least=0):
    """Return the maps of groups and integrations, float32; what is not finite there is taken as zero."""
    if values is None:
        return _read_only(np.zeros((1, 0, 1, 1), np.float32))
    if hasattr(values, "mask"):
        values = floats(values)
    values = np.asarray(values, np.float32)
    if values.ndim != 4 or values.shape[2:] != shape[2:] or values.shape[1] < n_least:
        wanted = f"of shape (n, {n_least} or more, {shape[2]}, {shape[3]})"
        raise argument_error(name, wanted, f"shape {values.shape}")
    if not np.isfinite(values).all():
        values = np.nan_to_num(values, posinf=0.0, neginf=0.0)
    return _read_only(values)


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
    check_positive(value, name, optional=True)
    if value is None:
        return np.inf
    return float(value)


def _cut_again(events, threshold, usable, n_diff, showers):
    """
    Yield the pixels that are fitted once more, and where they are to be cut.

    They lie beside large jumps or in showers. Each part is the argument of
    one call of the kernel: rows, columns, start of each pixel's cuts, and the cuts. Pixels keep the cuts
    that they found themselves.
    """
    ny, nx = usable.shape
    large = events[own_charge(events, nx, n_diff) >= threshold].astype(np.int64)
    cut = large[:, 2] * n_diff + large[:, 3]
    pixels = [showers[0] * nx + showers[1]]
    cuts = [showers[2] * n_diff + showers[3]]
    for dy, dx in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        y = large[:, 0] + dy
        x = large[:, 1] + dx
        inside = is_inside(x, y, (ny, nx))
        inside[inside] = usable[y[inside], x[inside]]
        pixels.append(y[inside] * nx + x[inside])
        cuts.append(cut[inside])
    pixels = np.concatenate(pixels)
    cuts = np.concatenate(cuts)
    places = events[:, :4].astype(np.int64)
    own_pixels = places[:, 0] * nx + places[:, 1]
    is_refitted = np.isin(own_pixels, pixels)
    pixels = np.concatenate([pixels, own_pixels[is_refitted]])
    cuts = np.concatenate([cuts, places[is_refitted, 2] * n_diff + places[is_refitted, 3]])
    order = np.lexsort((cuts, pixels))
    pixels = pixels[order]
    cuts = cuts[order]
    unique = np.unique(pixels)
    start = np.append(np.searchsorted(pixels, unique), len(pixels))
    for part in chunks(len(unique), _PIXELS):
        first = start[part.start]
        last = start[part.stop]
        y, x = np.divmod(unique[part], nx)
        yield y, x, start[part.start : part.stop + 1] - first, cuts[first:last]
