"""
Random numbers of the detector: one stream for each row, and exact draws from it.

xoshiro256++: Blackman & Vigna 2021, ACM Trans. Math. Softw. 47, 36; seeding by
splitmix64 as they advise. Ziggurat: Marsaglia & Tsang 2000, J. Stat. Softw. 5, 8, with
256 layers and 53 bits. Poisson: inversion, from a table (Chen & Asau 1974, AIIE Trans. 6, 163) where one
mean is drawn often, by search below, and transformed rejection PTRS above (Hoermann 1993, Insur. Math.
Econ. 12, 39); all exact.
"""

import math

import numpy as np
from numba import uint64

from miricigale.utils.compilation import njit

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_U11, _U17, _U19, _U23, _U27, _U30 = (np.uint64(n) for n in (11, 17, 19, 23, 27, 30))
_U31, _U41, _U45, _U255 = (np.uint64(n) for n in (31, 41, 45, 255))
_TO_UNIT = 2.0**-53

#: Means from which PTRS is used (it needs at least 10).
PTRS_FROM = 10.0

#: Parts of the unit interval in which a table of inversions is entered.
GUIDE = 1024
_TO_GUIDE = np.int64(53 - 10)

_ZIGGURAT_R = 3.6541528853610088
_ZIGGURAT_V = 0.00492867323399


def _ziggurat_tables():
    """Edges x (257,) and densities exp(-x^2/2) of the 256-layer ziggurat."""
    x = np.zeros(257)
    x[0] = _ZIGGURAT_V / math.exp(-0.5 * _ZIGGURAT_R**2)
    x[1] = _ZIGGURAT_R
    for i in range(2, 256):
        x[i] = math.sqrt(
            -2.0 * math.log(_ZIGGURAT_V / x[i - 1] + math.exp(-0.5 * x[i - 1] * x[i - 1]))
        )
    x[256] = 0.0
    return x, np.exp(-0.5 * x * x)


_ZIG_X, _ZIG_F = _ziggurat_tables()


def _stirling(k):
    n = k + 1.0
    return (
        (n - 0.5) * math.log(n) - n + 0.9189385332046727 + (1.0 - 1.0 / (30.0 * n * n)) / (12.0 * n)
    )


# log(k!): exact for small k, Stirling's series beyond, tabulated as far as skies reach
_LOG_FACTORIAL = np.array(
    [math.lgamma(k + 1.0) if k < 128 else _stirling(float(k)) for k in range(8192)]
)
_stirling = njit()(_stirling)


@njit(inline="always")
def mix(z):
    z = (z ^ (z >> _U30)) * _MIX_1
    z = (z ^ (z >> _U27)) * _MIX_2
    return z ^ (z >> _U31)


@njit()
def seed_stream(state, key, a, b):
    """Set the four words of a stream from the key (4 words) and two integers."""
    z = uint64(a) * _GAMMA + uint64(b)
    for i in range(4):
        z = mix(z + _GAMMA)
        state[i] = mix(key[i] ^ z)
        z = z ^ mix(key[i] + _GAMMA)
    if state[0] | state[1] | state[2] | state[3] == 0:
        state[0] = _GAMMA


@njit(inline="always")
def advance(s0, s1, s2, s3):
    """
    Advance the four words of a stream and return them with 64 random bits.

    The inner loops keep the words in local variables: in an array they would go through
    memory at every draw, which makes a normal number seven times slower.
    """
    t = s0 + s3
    bits = ((t << _U23) | (t >> _U41)) + s0
    t = s1 << _U17
    s2 ^= s0
    s3 ^= s1
    s1 ^= s2
    s0 ^= s3
    s2 ^= t
    s3 = (s3 << _U45) | (s3 >> _U19)
    return s0, s1, s2, s3, bits


@njit(inline="always")
def unit(bits):
    """Uniform in the open interval (0, 1)."""
    return (float(bits >> _U11) + 0.5) * _TO_UNIT


@njit()
def uniform(s):
    """Uniform in the open interval (0, 1), for draws outside the inner loops."""
    s[0], s[1], s[2], s[3], bits = advance(s[0], s[1], s[2], s[3])
    return unit(bits)


@njit()
def _normal_edge(s, layer, x):
    """What remains of the ziggurat: the wedges and the tail; NaN if x is rejected."""
    if layer == 0:
        while True:
            tail = -math.log(uniform(s)) / _ZIGGURAT_R
            if -2.0 * math.log(uniform(s)) > tail * tail:
                tail += _ZIGGURAT_R
                return tail if x > 0.0 else -tail
    density = _ZIG_F[layer] + uniform(s) * (_ZIG_F[layer + 1] - _ZIG_F[layer])
    if density < math.exp(-0.5 * x * x):
        return x
    return math.nan


@njit()
def fill_normals(s, out):
    """Fill a vector with standard normal numbers."""
    s0 = s[0]
    s1 = s[1]
    s2 = s[2]
    s3 = s[3]
    for i in range(out.size):
        while True:
            s0, s1, s2, s3, bits = advance(s0, s1, s2, s3)
            # the low 8 bits choose the layer, the high 53 sign and place
            layer = int(bits & _U255)
            x = (float(bits >> _U11) * (2.0 * _TO_UNIT) - 1.0) * _ZIG_X[layer]
            if abs(x) < _ZIG_X[layer + 1]:
                break
            s[0] = s0
            s[1] = s1
            s[2] = s2
            s[3] = s3
            x = _normal_edge(s, layer, x)
            s0 = s[0]
            s1 = s[1]
            s2 = s[2]
            s3 = s[3]
            if x == x:
                break
        out[i] = x
    s[0] = s0
    s[1] = s1
    s[2] = s2
    s[3] = s3


@njit(inline="always")
def log_factorial(k):
    return _LOG_FACTORIAL[int(k)] if k < 8192.0 else _stirling(k)


@njit(inline="always")
def poisson_inversion(u, mean, p0):
    """Inversion by sequential search; p0 = exp(-mean), mean below about 10."""
    k = 0.0
    p = p0
    # the bound keeps rounding (the sum of p ends a little below 1) from looping
    while u > p and k < 200.0:
        u -= p
        k += 1.0
        p *= mean / k
    return k


@njit()
def fill_table(mean, steps, guide):
    """
    Tabulate the inversion of a Poisson distribution, for many draws of one mean.

    ``steps`` gets, from some number of events on, the first of the 2^53 draws that gives more
    than that, more than one more, ... (the last is 2^53); ``guide`` the place in it of the number that
    the first draw of each of ``GUIDE`` equal parts gives. Returns the number and how many steps there are.
    """
    mode = int(mean)
    # relative to the mode; what is left out is below a part in 10^18
    smallest = mode
    p = 1.0
    while smallest > 0 and p > 1e-20:
        p *= smallest / mean
        smallest -= 1
    n = 0
    total = 0.0
    while n < steps.size and (p > 1e-20 or smallest + n <= mode):
        total += p
        n += 1
        p *= mean / (smallest + n)
    # back to the lowest, as the sum is needed first
    p = 1.0
    for k in range(mode, smallest, -1):
        p *= k / mean
    end = np.int64(1) << 53
    cumulative = 0.0
    for j in range(n):
        cumulative += p / total
        steps[j] = min(np.int64(cumulative * 2.0**53 + 0.5), end)
        p *= mean / (smallest + j + 1)
    steps[n - 1] = end
    j = 0
    for part in range(GUIDE):
        while part * (end // GUIDE) >= steps[j]:
            j += 1
        guide[part] = j
    return smallest, n


@njit(inline="always")
def table_lookup(bits, steps, guide):
    """Place in a table of `fill_table` of the number that a draw gives."""
    draw = np.int64(bits >> _U11)
    k = guide[draw >> _TO_GUIDE]
    while draw >= steps[k]:
        k += 1
    return k


@njit(inline="always")
def ptrs_constants(mean):
    """The constants a, b, v_r, 1 / alpha of PTRS, and the logarithm of the mean."""
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    return a, b, 0.9277 - 3.6224 / (b - 2.0), 1.1239 + 1.1328 / (b - 3.4), math.log(mean)


@njit(inline="always")
def ptrs_rest(mean, a, b, inverse_alpha, log_mean, v, k, us):
    """The slow part of PTRS; negative if the pair is rejected."""
    if k < 0.0 or (us < 0.013 and v > us):
        return -1.0
    log_ratio = math.log(v * inverse_alpha / (a / (us * us) + b))
    return k if log_ratio <= k * log_mean - mean - log_factorial(k) else -1.0


@njit()
def poisson(s, mean):
    """One Poisson number of any mean, for draws outside the inner loops."""
    if mean <= 0.0:
        return 0.0
    if mean < PTRS_FROM:
        return poisson_inversion(uniform(s), mean, math.exp(-mean))
    return ptrs(s, mean, ptrs_constants(mean))


@njit()
def ptrs(s, mean, constants):
    """One Poisson number of a mean of at least ``PTRS_FROM``."""
    a, b, v_r, inverse_alpha, log_mean = constants
    k = -1.0
    while k < 0.0:
        u = uniform(s) - 0.5
        v = uniform(s)
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us < 0.07 or v > v_r:
            k = ptrs_rest(mean, a, b, inverse_alpha, log_mean, v, k, us)
    return k


@njit()
def standard_normals(key, first_row, out):
    """Fill the rows of ``out`` (n_row, n_col) with standard normal numbers."""
    state = np.empty(4, np.uint64)
    for r in range(out.shape[0]):
        seed_stream(state, key, 0, first_row + r)
        fill_normals(state, out[r])
