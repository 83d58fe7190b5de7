"""Read noise and gain of a ramp, from the scatter of its groups."""

import dataclasses

import numpy as np

from miricigale.instrument import DQ
from miricigale.utils.exceptions import argument_error

__all__ = ["MeasuredNoise", "measure_noise"]

# pixels that are looked at, at most
_PIXELS = 60_000

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
    read_noise, read_noise_err : float
        Standard deviation of one read, DN (rounding not included), and its error.
    gain : float
        Electrons per DN; infinite if no noise grows with time.
    gain_err : float
        Its error; NaN if the gain is infinite.
    effective : bool
        Whether the gain is that of all noise that grows with time, slow noise of the read-out too,
        because the signals of the pixels are too much alike to tell photons from it.
    """

    read_noise: float
    read_noise_err: float
    gain: float
    gain_err: float
    effective: bool = False

    def describe(self, name):
        """One of the two in words, for headers."""
        if name == "read_noise":
            return f"{self.read_noise:.4g} DN (measured on the ramp)"
        if np.isinf(self.gain):
            return "no photon noise (measured on the ramp)"
        kind = ", effective" if self.effective else ""
        return f"{self.gain:.4g} e-/DN{kind} (measured on the ramp)"


def measure_noise(ramp):
    """
    Measure read noise and gain on the groups of a ramp.

    Parameters
    ----------
    ramp : `~miricigale.detector.Ramp`
        At least seven groups.

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
    their variance is 6 s + 2 L v, with s the variance of a read and v that of the photons in one
    group. It is measured with L of 1 and of a third of the ramp, clipped at 4 sigma, for pixels in ten
    classes of their signal m in one group. The gain is the inverse of the slope of v against m
    (photon transfer): what is left at m = 0 is slow noise of the read-out, and no photons. Where
    the classes are too much alike for that, it is the mean of m over that of v.
    The mean of each group over the pixels of a class is taken off first: drifts of the read-out,
    reset anomaly and non-linearity that all have are no noise. First and last groups are left out.
    The gain is that of measured, not of linear DN, where the ramp was not made linear. It is biased,
    beyond its error: stars whose curved ramps differ within a class make it too low (by 29 %, stars of
    a fifth of the well on a faint sky), and classes made by noise too high (by 22 %, the same sky
    without stars, photon noise of 1 DN^2 a group beside a read noise of 8 DN): means of six draws of
    SUB256, 30 groups x 2, of a gain of 5.5.
    """
    n_int, n_group = ramp.shape[:2]
    if n_group < 9:
        raise argument_error("ramp", "one of nine groups at least, to measure its noise", n_group)
    bad = DQ.DO_NOT_USE | DQ.NON_SCIENCE | DQ.REFERENCE_PIXEL | DQ.DEAD
    ys, xs = np.nonzero((ramp.pixel_dq.astype(np.int64) & bad) == 0)
    if ys.size < 100:
        raise argument_error("ramp", "one with 100 usable pixels, to measure its noise", ys.size)
    chosen = slice(None, None, max(1, ys.size // _PIXELS))
    ys, xs = ys[chosen], xs[chosen]
    long = (n_group - 3) // 3
    rows = []
    # the later integrations have less of what follows a reset
    for k in range(1 if n_int > 1 else 0, n_int):
        data = ramp.data[k][:, ys, xs][1:-1].astype(float)
        # a median over five parts of the time: a hit must not move a pixel to another class
        ends = np.linspace(0, len(data) - 1, 6).astype(int)
        signal = np.median(np.diff(data[ends], axis=0) / np.diff(ends)[:, None], axis=0)
        for part in np.array_split(np.argsort(signal), 10):
            near = data[:, part]
            near = near - np.median(near, axis=1)[:, None]
            short_var, n_short = _scatter(near, 1)
            long_var, n_long = _scatter(near, long)
            v = (long_var - short_var) / (2 * (long - 1))
            v_err = np.hypot(long_var / np.sqrt(n_long / 2), short_var / np.sqrt(n_short / 6))
            v_err /= 2 * (long - 1)
            s = (short_var - 2 * v) / 6
            s_err = np.hypot(short_var / np.sqrt(n_short / 6), 2 * v_err) / 6
            rows.append((signal[part].mean(), v, v_err, s, s_err))
    m, v, v_err, s, s_err = np.array(rows).T
    weight = 1 / s_err**2
    read = (weight * s).sum() / weight.sum()
    rounding = 1 / 12 if ramp.data.dtype.kind == "u" else 0.0
    read_noise = np.sqrt(max(read - rounding, 0.0))
    read_err = 1 / np.sqrt(weight.sum()) / (2 * max(read_noise, 1e-3))
    # v = m / gain and what slow noise of the read-out adds, which does not go with the signal
    weight = 1 / v_err**2
    middle = (weight * m).sum() / weight.sum()
    squares = (weight * (m - middle) ** 2).sum()
    inverse = (weight * (m - middle) * v).sum() / squares
    inverse_err = 1 / np.sqrt(squares)
    effective = not inverse > 5 * inverse_err
    if effective:
        # all of it, a line through zero
        total = np.sum(weight * m * m)
        inverse, inverse_err = np.sum(weight * m * v) / total, 1 / np.sqrt(total)
    gain, gain_err = np.inf, np.nan
    if inverse > 5 * inverse_err:
        gain, gain_err = 1 / inverse, inverse_err / inverse**2
    effective &= bool(np.isfinite(gain))
    return MeasuredNoise(
        float(read_noise), float(read_err), float(gain), float(gain_err), bool(effective)
    )


def _scatter(data, lag):
    """Clipped variance of second differences over ``lag`` groups, and their number."""
    second = (data[2 * lag :] - 2 * data[lag:-lag] + data[: -2 * lag]).ravel()
    spread = 1.4826 * np.median(np.abs(second - np.median(second)))
    for _ in range(20):
        kept = second[np.abs(second) <= _CLIP * spread]
        new = np.sqrt(np.mean(np.square(kept)) / _KEPT)
        if abs(new - spread) < 1e-6 * spread:
            break
        spread = new
    return spread**2, second.size
