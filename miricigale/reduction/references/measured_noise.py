"""Read noise and gain of a ramp, from the scatter of its groups."""

import dataclasses

import numpy as np

from miricigale.depth._core import shared_photons
from miricigale.instrument import DQ
from miricigale.reduction.references.reference_maps import read_variance
from miricigale.utils.arrays import centered
from miricigale.utils.options import check_that

# pixels that are looked at, at most
_PIXELS = 60_000

# pixels that are needed
_FEWEST = 100
# flags of those that are not looked at
_BAD_REFERENCE = DQ.DO_NOT_USE | DQ.DEAD
_BAD = _BAD_REFERENCE | DQ.NON_SCIENCE

# times the median signal above which pixels are left out: ramps that bend
_BRIGHT = 3.0
# classes of signal
_CLASSES = 10
# lags over which variances are averaged: patterns of the read-out repeat every few groups
_LAGS = 4
# sigma from which a noise that grows with the signal is seen
_SEEN = 5.0

# sigma at which second differences are clipped: hits of cosmic rays
_CLIP = 4.0
# variance of a normal distribution within +- 4 sigma over the whole
_KEPT = 0.998929


@dataclasses.dataclass(frozen=True)
class MeasuredNoise:
    """
    Noise of a ramp as its own groups show it.

    Parameters
    ----------
    read_noise : float
        Standard deviation of one read, DN (rounding not included).
    gain : float
        Electrons per DN; infinite if no photon noise is seen.
    gain_err : float
        Its error; NaN if the gain is infinite.
    effective : bool
        Whether the gain is that of all noise that grows with time, slow noise of the read-out too,
        because neither signals of the pixels nor reference pixels separate photons from it.
    slow_noise : float
        Standard deviation that the read-out adds from one group to the next, DN; zero where there are
        no reference pixels to show it.

    Examples
    --------
    >>> from miricigale.reduction import MeasuredNoise
    >>> noise = MeasuredNoise(read_noise=6.1, gain=4.2, gain_err=0.3)
    >>> noise.gain
    4.2
    """

    read_noise: float
    gain: float
    gain_err: float
    effective: bool = False
    slow_noise: float = 0.0

    def describe(self, name):
        """Return one of read noise and gain in words, for headers."""
        if name == "read_noise":
            return f"{self.read_noise:.4g} DN (measured on the ramp)"
        if np.isinf(self.gain):
            slow = ""
            if self.slow_noise:
                slow = f", {self.slow_noise:.3g} DN a group of the read-out"
            return f"no photon noise{slow} (measured on the ramp)"
        kind = ""
        if self.effective:
            kind = ", effective"
        return f"{self.gain:.4g} e-/DN{kind} (measured on the ramp)"


def measure_noise(ramp):
    """
    Measure read noise and gain on the groups of a ramp.

    Parameters
    ----------
    ramp : `~miricigale.detector.Ramp`
        At least nine groups.

    Returns
    -------
    noise : `MeasuredNoise`

    Raises
    ------
    ValueError
        If there are too few groups or usable pixels.

    Notes
    -----
    Second differences over L groups, x(g + 2 L) - 2 x(g + L) + x(g), know neither level nor slope;
    their variance is 6 s + 2 L v, with s the variance of a read and v what a group adds: that of its
    photons, and slow noise of the read-out. They are taken with L of 1 to 4 and of about half the ramp,
    clipped at 4 sigma, less the median over the pixels in each group, for pixels in ten classes of
    their signal m in one group. A pattern of the read-out that repeats every few groups changes with L:
    v is that of means over four L, s that of the L which shows most.

    The gain is the inverse of the slope of v against m (photon transfer). Where the classes are too much alike, it
    is m over what v is above that of the reference pixels, which see no photons. Without them, in
    ``SUB256`` and ``BRIGHTSKY``, it is m over v, and ``effective``.

    Noise must not enter both what is compared and how it is sorted. Pixels are sorted by their least-squares
    slope in the integration before, which no second difference over the whole ramp shares noise with; those of one
    integration by that in its first third, which is left out then. The signal is that of the later half, when
    the anomaly after a reset has settled. Noise is that of differences of successive
    integrations, which are free of what bends ramps: non-linearity, settling. First and last groups are left
    out, and so are pixels above three times the median signal.

    The gain is that of measured, not of linear DN, where the ramp was not made linear.

    References
    ----------
    Janesick 2007, Photon Transfer, SPIE Press.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from miricigale import Detector, Exposure
    >>> from miricigale.reduction import measure_noise
    >>> exposure = Exposure(
    ...     "F1500W",
    ...     n_groups=60,
    ...     n_integrations=2,
    ...     subarray="SUB128",
    ...     pointing="53 -27",
    ... )
    >>> sky = np.full(exposure.shape, 400.0) * u.MJy / u.sr
    >>> noise = measure_noise(Detector.miri_imager().expose(sky, exposure, seed=1))
    >>> print(f"read noise {noise.read_noise:.1f} DN")
    read noise 6.0 DN
    """
    n_int, n_group = ramp.shape[:2]
    check_that(n_group >= 9, "ramp", "one of nine groups at least, to measure its noise", n_group)
    dq = ramp.pixel_dq.astype(np.int64)
    pixels = _sampled_pixels((dq & (_BAD | DQ.REFERENCE_PIXEL)) == 0)
    wanted = f"one with {_FEWEST} usable pixels, to measure its noise"
    check_that(pixels[0].size >= _FEWEST, "ramp", wanted, pixels[0].size)
    blind = _sampled_pixels((dq & (_BAD_REFERENCE | DQ.REFERENCE_PIXEL)) == DQ.REFERENCE_PIXEL)
    rows = []
    dark = []
    # the first integration settles, and is left out where there are others
    for k in range(min(n_int - 1, 2), n_int):
        before, data, signal = _parts(ramp, k, pixels)
        order = _slope(before)
        limit = _BRIGHT * np.median(order)
        accepted = np.flatnonzero((order < limit) | (limit <= 0))
        parts = np.array_split(accepted[np.argsort(order[accepted])], _CLASSES)
        rows += [(signal[part].mean(), *_noise(data[:, part])) for part in parts]
        if blind[0].size >= _FEWEST:
            dark.append(_noise(_parts(ramp, k, blind)[1])[:2])
    signal, added, added_err, single, single_err = np.array(rows).T
    read, _ = _mean(single, single_err)
    rounded = ramp.data.dtype.kind == "u"
    # of one read: the photons that neighbors share make the noise of averaged ones smaller
    n_frames = ramp.exposure.n_frames
    read += shared_photons(n_frames) * _mean(added, added_err)[0]
    read -= read_variance(0.0, n_frames, rounded=rounded)
    read_noise = np.sqrt(max(n_frames * read, 0.0))
    return MeasuredNoise(float(read_noise), **_photon_transfer(signal, added, added_err, dark))


def _photon_transfer(signal, added, added_err, dark):
    """
    Gain by how the variance that a group adds grows with its signal, and the slow noise of the read-out.

    The variance is signal / gain + slow, DN^2: photon noise, and noise that does not go with the signal. Where the
    signal is too even for a slope, the mean variance less that of ``dark`` pixels (variances and errors of
    integrations, of pixels without light) is taken for photon noise.

    Returns
    -------
    values : dict of str to float
        ``gain`` (infinite where no photon noise is seen), ``gain_err``, ``slow_noise`` and ``effective`` of
        `MeasuredNoise`.
    """
    mean, mean_err = _mean(added, added_err)
    slow = 0.0
    slow_err = 0.0
    if dark:
        slow, slow_err = _mean(*np.array(dark).T)
    # weighted least squares about the mean signal
    weight = 1 / added_err**2
    offset = signal - _mean(signal, added_err)[0]
    squares = (weight * offset**2).sum()
    inverse = (weight * offset * added).sum() / squares
    residual = weight * (added - mean - inverse * offset) ** 2
    inverse_err = max(np.sqrt(residual.sum() / (len(signal) - 2)), 1.0) / np.sqrt(squares)
    has_slope = inverse > _SEEN * inverse_err
    if not has_slope:
        middle = _mean(signal, added_err)[0]
        inverse = (mean - slow) / middle
        inverse_err = np.hypot(mean_err, slow_err) / abs(middle)
    gain = np.inf
    gain_err = np.nan
    if inverse > _SEEN * inverse_err:
        gain = 1 / inverse
        gain_err = inverse_err / inverse**2
    else:
        slow = mean
    return {
        "gain": float(gain),
        "gain_err": float(gain_err),
        "effective": bool(not has_slope and not dark and np.isfinite(gain)),
        "slow_noise": float(np.sqrt(max(slow, 0.0))),
    }


def _sampled_pixels(mask):
    """Return the rows and columns of at most so many pixels of a mask, evenly."""
    ys, xs = np.nonzero(mask)
    chosen = slice(None, None, max(1, ys.size // _PIXELS))
    return ys[chosen], xs[chosen]


def _parts(ramp, k, pixels):
    """Return the groups that sort pixels, groups whose noise is measured, and the signal, of integration k."""
    data = ramp.data[k][:, *pixels][1:-1].astype(float)
    signal = _signal(data[len(data) // 2 :])
    if k == 0:
        before, data = np.split(data, [len(data) // 3])
    else:
        before = ramp.data[k - 1][:, *pixels][1:-1].astype(float)
        data = (data - before) / np.sqrt(2)
    return before, data, signal


def _mean(values, errors):
    """Return the weighted mean and its error, wider where the values scatter by more than their errors."""
    weight = 1 / errors**2
    mean = (weight * values).sum() / weight.sum()
    chi2 = (weight * (values - mean) ** 2).sum() / max(values.size - 1, 1)
    return mean, max(np.sqrt(chi2), 1.0) / np.sqrt(weight.sum())


def _slope(data):
    """Return the least-squares slope of each pixel, DN in a group."""
    group = centered(len(data))
    return np.tensordot(group, data, 1) / np.sum(group**2)


def _signal(data):
    """Return the median of the slopes of five parts: a hit must not move the mean of a class."""
    ends = np.linspace(0, len(data) - 1, min(6, len(data))).astype(int)
    return np.median(np.diff(data[ends], axis=0) / np.diff(ends)[:, None], axis=0)


def _noise(data):
    """Return the variance that each group adds, and that of a read, each with its error."""
    longest = (len(data) - 1) // 2
    number = min(_LAGS, longest // 2)
    short = np.arange(1, number + 1)
    short_scatter, short_err = _scatter(data, short)
    far, far_err = _scatter(data, longest + 1 - short)
    n_between = 2 * (longest - number)
    v = (far.mean() - short_scatter.mean()) / n_between
    v_err = np.hypot(far_err.mean(), short_err.mean()) / n_between
    s = np.max(short_scatter - 2 * short * v) / 6
    s_err = np.hypot(short_err.mean(), (number + 1) * v_err) / 6
    return v, v_err, s, s_err


def _scatter(data, lags):
    """Return the clipped variance of second differences over each of the lags, and its error."""
    variances = []
    errors = []
    for lag in lags:
        second = data[2 * lag :] - 2 * data[lag:-lag] + data[: -2 * lag]
        # what all pixels have in common: drifts of the read-out, settling, non-linearity
        second = (second - np.median(second, axis=1)[:, None]).ravel()
        spread = 1.4826 * np.median(np.abs(second))
        for _ in range(20):
            clipped = second[np.abs(second) <= _CLIP * spread]
            new = np.sqrt(np.mean(np.square(clipped)) / _KEPT)
            if abs(new - spread) < 1e-6 * spread:
                break
            spread = new
        variances.append(spread**2)
        # successive ones share reads
        errors.append(spread**2 * np.sqrt((6 if lag == 1 else 2) / second.size))
    return np.array(variances), np.array(errors)
