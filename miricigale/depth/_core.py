"""
Sums over the optimal weights of a ramp's differences, in closed form.

Differences of consecutive groups have the covariance C = v I + s T, with v their Poisson
variance, s the variance of one read and T = tridiag(-1, 2, -1). With x = v / s, l = exp(-theta),
2 cosh(theta) = 2 + x, f_i = 1 - l^i and h_i = 1 - l^(2 i), for i = 1 ... n::

    w_i        = (C^-1 1)_i = f_i f_(n+1-i) / (v (1 + l^(n+1)))
    (C^-1)_ii  = h_i h_(n+1-i) / (s (1/l - l) h_(n+1))

The slope is sum(w d) / sum(w), and its variance 1 / sum(w).

References
----------
Brandt 2024, PASP 136, 045004; Hu & O'Connell 1996, J. Phys. A 29, 1511.
"""

import math

from miricigale.utils.compilation import njit

# least and greatest ratio of Poisson to read variance: the closed forms stay finite
_X_MIN = 1e-12
_X_MAX = 1e12
# decay over a ramp below which the sums cancel, so that they are done term by term
_SMALL = 0.3


@njit(error_model="numpy", inline="always")
def _decay(v, s):
    """Poisson and read variance within the range of the closed forms, 1 / l - 1, and theta."""
    v = max(v, _X_MIN * s)
    s = max(s, v / _X_MAX)
    x = v / s
    q = 0.5 * x + math.sqrt(x + 0.25 * x * x)
    return v, s, q, math.log1p(q)


@njit(error_model="numpy")
def weight_sums(n, v, s):
    """Sums of the weights, and of their squares, of ``n`` differences."""
    v, s, q, theta = _decay(v, s)
    mirrored = 1.0 + math.exp(-(n + 1) * theta)
    total = 0.0
    squares = 0.0
    if (n + 1) * theta < _SMALL:
        for i in range(1, n + 1):
            w = math.expm1(-i * theta) * math.expm1(-(n + 1 - i) * theta)
            total += w
            squares += w * w
        return total / (mirrored * v), squares / (mirrored * v) ** 2
    power = math.exp(-n * theta)
    # sums of l^i and of l^(2 i)
    first = (1.0 - power) / q
    second = (1.0 - power * power) / (q * (2.0 + q))
    total = n - 2.0 * first / mirrored
    squares = n - (4.0 * first - 2.0 * (second + n * (mirrored - 1.0)) / mirrored) / mirrored
    return total / v, squares / (v * v)


@njit(error_model="numpy")
def difference_weight(i, n, v, s):
    """Weight w_i of difference i (from 1) of ``n``, and (C^-1)_ii."""
    v, s, q, theta = _decay(v, s)
    f = -math.expm1(-i * theta)
    g = -math.expm1(-(n + 1 - i) * theta)
    end = -math.expm1(-2 * (n + 1) * theta)
    # 1 + l^(n+1), by l^i = 1 - f
    weight = f * g / (v * (1.0 + (1.0 - f) * (1.0 - g)))
    leverage = f * g * (2.0 - f) * (2.0 - g) * (1.0 + q)
    return weight, leverage / (s * q * (2.0 + q) * end)


def shared_photons(n_frames):
    """
    Covariance of neighboring differences over the Poisson variance of one, for means of ``n_frames`` frames.

    Frames of a group have the charge of those before. A difference of two means counts the charge that comes in
    frame i with weight min(i, 2 M - i) / M, i = 1 ... 2 M - 1, and shares M - 1 frames with the next. The sums of
    squares and products are (2 M^2 + 1) / (3 M^2) and (M^2 - 1) / (6 M^2) of the variance in the time of a group.
    """
    return (n_frames**2 - 1) / (6 * n_frames**2)
