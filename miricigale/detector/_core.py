"""
Numerical core of the detector: random numbers and what happens to charge, on arrays only.

Every kernel that draws gives each detector row (of each integration) its own
xoshiro256++ stream, seeded from four key words, the integration and the row. What a row
gets depends on nothing else, so blocks of any height on any number of threads give the
same numbers, and a kernel may draw a neighbouring row again where it needs it.

All kernels release the interpreter lock. Ramps have shape (n_int, n_group, n_row, n_col),
float32; ``first_row`` is the detector row of the block's first row.
"""

import math

import numpy as np
from numba import njit, uint64

__all__ = [
    "add_cosmic_rays",
    "add_noise",
    "add_pink_noise",
    "add_poisson",
    "clip_well",
    "couple_neighbours",
    "digitize",
    "interpolate_response",
    "standard_normals",
]

# -- random numbers ---------------------------------------------------------------------
#
# xoshiro256++: Blackman & Vigna 2021, ACM Trans. Math. Softw. 47, 36; seeding by
# splitmix64 as they advise. Ziggurat: Marsaglia & Tsang 2000, J. Stat. Softw. 5, 8, with
# 256 layers and 53 bits. Poisson: inversion below, transformed rejection PTRS above
# (Hoermann 1993, Insur. Math. Econ. 12, 39); both exact.

_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_1 = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2 = np.uint64(0x94D049BB133111EB)
_U11 = np.uint64(11)
_U17 = np.uint64(17)
_U23 = np.uint64(23)
_U19 = np.uint64(19)
_U27 = np.uint64(27)
_U30 = np.uint64(30)
_U31 = np.uint64(31)
_U41 = np.uint64(41)
_U45 = np.uint64(45)
_U255 = np.uint64(255)
_TO_UNIT = 2.0**-53

#: Means from which PTRS is used (it needs at least 10).
_PTRS_FROM = 10.0

#: Greatest mean for which a draw is done; beyond it a pixel is saturated a thousandfold.
_MEAN_MAX = 1e9

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

# log(k!) for small k; Stirling's series beyond
_LOG_FACTORIAL = np.array([math.lgamma(k + 1.0) for k in range(128)])


@njit(cache=True, nogil=True, inline="always")
def _mix(z):
    z = (z ^ (z >> _U30)) * _MIX_1
    z = (z ^ (z >> _U27)) * _MIX_2
    return z ^ (z >> _U31)


@njit(cache=True, nogil=True)
def _seed(state, key, a, b):
    """Set the four words of a stream from the key (4 words) and two integers."""
    z = uint64(a) * _GAMMA + uint64(b)
    for i in range(4):
        z = _mix(z + _GAMMA)
        state[i] = _mix(key[i] ^ z)
        z = z ^ _mix(key[i] + _GAMMA)
    if state[0] | state[1] | state[2] | state[3] == 0:
        state[0] = _GAMMA


@njit(cache=True, nogil=True, inline="always")
def _step(s0, s1, s2, s3):
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


@njit(cache=True, nogil=True, inline="always")
def _unit(bits):
    """Uniform in the open interval (0, 1)."""
    return (float(bits >> _U11) + 0.5) * _TO_UNIT


@njit(cache=True, nogil=True)
def _uniform(s):
    """Uniform in the open interval (0, 1), for draws outside the inner loops."""
    s[0], s[1], s[2], s[3], bits = _step(s[0], s[1], s[2], s[3])
    return _unit(bits)


@njit(cache=True, nogil=True)
def _normal_edge(s, layer, x):
    """What remains of the ziggurat: the wedges and the tail; NaN if x is rejected."""
    if layer == 0:
        while True:
            tail = -math.log(_uniform(s)) / _ZIGGURAT_R
            if -2.0 * math.log(_uniform(s)) > tail * tail:
                tail += _ZIGGURAT_R
                return tail if x > 0.0 else -tail
    density = _ZIG_F[layer] + _uniform(s) * (_ZIG_F[layer + 1] - _ZIG_F[layer])
    if density < math.exp(-0.5 * x * x):
        return x
    return math.nan


@njit(cache=True, nogil=True)
def _fill_normals(s, out):
    """Fill a vector with standard normal numbers."""
    s0, s1, s2, s3 = s[0], s[1], s[2], s[3]
    for i in range(out.size):
        while True:
            s0, s1, s2, s3, bits = _step(s0, s1, s2, s3)
            # the low 8 bits choose the layer, the high 53 sign and place
            layer = int(bits & _U255)
            x = (float(bits >> _U11) * (2.0 * _TO_UNIT) - 1.0) * _ZIG_X[layer]
            if abs(x) < _ZIG_X[layer + 1]:
                break
            s[0], s[1], s[2], s[3] = s0, s1, s2, s3
            x = _normal_edge(s, layer, x)
            s0, s1, s2, s3 = s[0], s[1], s[2], s[3]
            if x == x:
                break
        out[i] = x
    s[0], s[1], s[2], s[3] = s0, s1, s2, s3


@njit(cache=True, nogil=True, inline="always")
def _log_factorial(k):
    if k < 128.0:
        return _LOG_FACTORIAL[int(k)]
    n = k + 1.0
    return (
        (n - 0.5) * math.log(n) - n + 0.9189385332046727 + (1.0 - 1.0 / (30.0 * n * n)) / (12.0 * n)
    )


@njit(cache=True, nogil=True, inline="always")
def _poisson_inversion(u, mean, p0):
    """Inversion by sequential search; p0 = exp(-mean), mean below about 10."""
    k = 0.0
    p = p0
    # the bound keeps rounding (the sum of p ends a little below 1) from looping
    while u > p and k < 200.0:
        u -= p
        k += 1.0
        p *= mean / k
    return k


@njit(cache=True, nogil=True)
def _poisson_ptrs_rest(mean, a, b, v, k, us):
    """The slow part of PTRS; negative if the pair is rejected."""
    if k < 0.0 or (us < 0.013 and v > us):
        return -1.0
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    left = math.log(v * inverse_alpha / (a / (us * us) + b))
    if left <= k * math.log(mean) - mean - _log_factorial(k):
        return k
    return -1.0


@njit(cache=True, nogil=True, inline="always")
def _ptrs_constants(mean):
    b = 0.931 + 2.53 * math.sqrt(mean)
    return -0.059 + 0.02483 * b, b, 0.9277 - 3.6224 / (b - 2.0)


@njit(cache=True, nogil=True)
def _poisson(s, mean):
    """One Poisson number of any mean, for draws outside the inner loops."""
    if mean <= 0.0:
        return 0.0
    if mean < _PTRS_FROM:
        return _poisson_inversion(_uniform(s), mean, math.exp(-mean))
    a, b, v_r = _ptrs_constants(mean)
    k = -1.0
    while k < 0.0:
        u = _uniform(s) - 0.5
        v = _uniform(s)
        us = 0.5 - abs(u)
        k = math.floor((2.0 * a / us + b) * u + mean + 0.43)
        if us < 0.07 or v > v_r:
            k = _poisson_ptrs_rest(mean, a, b, v, k, us)
    return k


@njit(cache=True, nogil=True)
def standard_normals(key, first_row, out):
    """
    Fill rows with standard normal numbers.

    Parameters
    ----------
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the streams.
    first_row : int
        Detector row of the first row of ``out``.
    out : `~numpy.ndarray`, shape (n_row, n_col)
        Overwritten.
    """
    state = np.empty(4, np.uint64)
    for r in range(out.shape[0]):
        _seed(state, key, 0, first_row + r)
        _fill_normals(state, out[r])


# -- charge -----------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def add_poisson(ramp, mean, key, first_row):
    """
    Add charge that arrives at random, accumulating over the groups of an integration.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Accumulated charge (electrons); added to in place.
    mean : `~numpy.ndarray` of float64, shape (n_row, n_col)
        Expected electrons per group; at most 1e9 is drawn.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the streams.
    first_row : int
        Detector row of the first row.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    mu = np.empty(n_col)
    a = np.empty(n_col)
    b = np.empty(n_col)
    c = np.empty(n_col)
    total = np.empty(n_col)
    for r in range(n_row):
        for x in range(n_col):
            mu[x] = min(mean[r, x], _MEAN_MAX)
            if mu[x] < _PTRS_FROM:
                c[x] = math.exp(-mu[x])
            else:
                a[x], b[x], c[x] = _ptrs_constants(mu[x])
        for i in range(n_int):
            _seed(state, key, i, first_row + r)
            s0, s1, s2, s3 = state[0], state[1], state[2], state[3]
            total[:] = 0.0
            for g in range(n_group):
                for x in range(n_col):
                    if mu[x] <= 0.0:
                        k = 0.0
                    elif mu[x] < _PTRS_FROM:
                        s0, s1, s2, s3, bits = _step(s0, s1, s2, s3)
                        k = _poisson_inversion(_unit(bits), mu[x], c[x])
                    else:
                        k = -1.0
                        while k < 0.0:
                            s0, s1, s2, s3, bits = _step(s0, s1, s2, s3)
                            u = _unit(bits) - 0.5
                            s0, s1, s2, s3, bits = _step(s0, s1, s2, s3)
                            v = _unit(bits)
                            us = 0.5 - abs(u)
                            k = math.floor((2.0 * a[x] / us + b[x]) * u + mu[x] + 0.43)
                            if us < 0.07 or v > c[x]:
                                k = _poisson_ptrs_rest(mu[x], a[x], b[x], v, k, us)
                    total[x] += k
                    ramp[i, g, r, x] += np.float32(total[x])


@njit(cache=True, nogil=True)
def _push(deposits, n, slot, head, row, col, charge):
    """Append one deposit to the list of its group; returns the (grown) list and its length."""
    if n == deposits.shape[0]:
        grown = np.empty((2 * n, 4))
        grown[:n] = deposits
        deposits = grown
    deposits[n, 0] = head[slot]
    deposits[n, 1] = row
    deposits[n, 2] = col
    deposits[n, 3] = charge
    head[slot] = n
    return deposits, n + 1


@njit(cache=True, nogil=True)
def add_cosmic_rays(
    ramp,
    key,
    first_row,
    n_detector_rows,
    hits_per_row,
    thickness,
    yield_median,
    yield_sigma,
    track_max,
    leakage,
    shower_fraction,
    shower_charge,
    shower_sigma,
):
    """
    Add the charge of cosmic-ray hits.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Accumulated charge (electrons); added to in place.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the streams.
    first_row, n_detector_rows : int
        Detector row of the first row, and how many there are.
    hits_per_row : float
        Expected hits in one row during all integrations.
    thickness : float
        Thickness of the layer in pixels.
    yield_median : float
        Median electrons set free per pixel length of path.
    yield_sigma : float
        Standard deviation of the natural logarithm of that yield.
    track_max : float
        Longest track in pixels.
    leakage : float
        Share of a pixel's deposit that goes to each of its four neighbours.
    shower_fraction, shower_charge, shower_sigma : float
        Share of hits that make a shower, its charge (electrons) and Gaussian width
        (pixels).
    """
    n_int, n_group, n_row, n_col = ramp.shape
    reach = math.ceil(track_max) + 2
    if shower_fraction > 0.0:
        reach = max(reach, math.ceil(3.0 * shower_sigma) + 1)
    deposits = np.empty((1024, 4))
    head = np.full(n_int * n_group, -1, np.int64)
    n = 0
    state = np.empty(4, np.uint64)
    normal = np.empty(1)
    last_row = first_row + n_row
    for row in range(max(0, first_row - reach), min(n_detector_rows, last_row + reach)):
        _seed(state, key, 0, row)
        for _hit in range(int(_poisson(state, hits_per_row))):
            # every hit uses the same draws up to here, shower or not
            slot = min(int(_uniform(state) * (n_int * n_group)), n_int * n_group - 1)
            x = _uniform(state) * n_col
            y = row + _uniform(state)
            # isotropic flux through a plane: p(cos) = 2 cos
            cos2 = _uniform(state)
            azimuth = 2.0 * math.pi * _uniform(state)
            _fill_normals(state, normal)
            strength = math.exp(yield_sigma * normal[0])
            shower = _uniform(state) < shower_fraction
            length = min(thickness * math.sqrt((1.0 - cos2) / cos2), track_max)
            dx = length * math.cos(azimuth)
            dy = length * math.sin(azimuth)
            charge = yield_median * strength * math.sqrt(thickness**2 + length**2)
            # walk through the pixels that the track crosses (Amanatides & Woo 1987)
            px, py = math.floor(x), math.floor(y)
            step_x = 1 if dx > 0.0 else -1
            step_y = 1 if dy > 0.0 else -1
            next_x = ((px + (step_x > 0)) - x) / dx if dx != 0.0 else math.inf
            next_y = ((py + (step_y > 0)) - y) / dy if dy != 0.0 else math.inf
            done = 0.0
            while done < 1.0:
                to = min(next_x, next_y, 1.0)
                q = charge * (to - done)
                done = to
                if abs(py - first_row) <= n_row + 1 and q > 0.0:
                    for k in range(5):
                        cx = px + (k == 1) - (k == 2)
                        cy = py + (k == 3) - (k == 4)
                        share = 1.0 - 4.0 * leakage if k == 0 else leakage
                        if 0 <= cx < n_col and first_row <= cy < last_row and share > 0.0:
                            deposits, n = _push(
                                deposits, n, slot, head, cy - first_row, cx, q * share
                            )
                if next_x <= next_y:
                    px += step_x
                    next_x += abs(1.0 / dx) if dx != 0.0 else math.inf
                else:
                    py += step_y
                    next_y += abs(1.0 / dy) if dy != 0.0 else math.inf
            if shower:
                peak = shower_charge * strength / (2.0 * math.pi * shower_sigma**2)
                r = math.ceil(3.0 * shower_sigma)
                iy, ix = math.floor(y), math.floor(x)
                for cy in range(max(iy - r, first_row), min(iy + r + 1, last_row)):
                    for cx in range(max(ix - r, 0), min(ix + r + 1, n_col)):
                        d2 = (cy + 0.5 - y) ** 2 + (cx + 0.5 - x) ** 2
                        q = peak * math.exp(-0.5 * d2 / shower_sigma**2)
                        deposits, n = _push(deposits, n, slot, head, cy - first_row, cx, q)
    plane = np.zeros((n_row, n_col), np.float32)
    for i in range(n_int):
        plane[:] = 0.0
        for g in range(n_group):
            k = head[i * n_group + g]
            while k >= 0:
                plane[int(deposits[k, 1]), int(deposits[k, 2])] += np.float32(deposits[k, 3])
                k = int(deposits[k, 0])
            for r in range(n_row):
                for x in range(n_col):
                    ramp[i, g, r, x] += plane[r, x]


@njit(cache=True, nogil=True)
def couple_neighbours(ramp, kernel):
    """
    Replace each pixel by the sum of its 3 x 3 neighbours, weighted by a kernel.

    At an edge the missing neighbour is the pixel nearest to it, so that a symmetric
    kernel of sum 1 keeps a uniform field.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Changed in place.
    kernel : `~numpy.ndarray` of float32, shape (3, 3)
    """
    n_int, n_group, n_row, n_col = ramp.shape
    padded = np.empty((n_row + 2, n_col + 2), np.float32)
    for i in range(n_int):
        for g in range(n_group):
            padded[1:-1, 1:-1] = ramp[i, g]
            padded[0, 1:-1] = ramp[i, g, 0]
            padded[-1, 1:-1] = ramp[i, g, -1]
            padded[:, 0] = padded[:, 1]
            padded[:, -1] = padded[:, -2]
            for r in range(n_row):
                for x in range(n_col):
                    total = np.float32(0.0)
                    for dy in range(3):
                        for dx in range(3):
                            total += kernel[dy, dx] * padded[r + dy, x + dx]
                    ramp[i, g, r, x] = total


# -- read-out ---------------------------------------------------------------------------


@njit(cache=True, nogil=True)
def clip_well(ramp, well, group_dq, flag):
    """
    Stop charge at the full well, flagging the groups in which it was reached.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Electrons; changed in place.
    well : float
        Full well (electrons).
    group_dq : `~numpy.ndarray` of uint8, like ``ramp``
        Flags; changed in place.
    flag : uint8
        The bit to set.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    limit = np.float32(well)
    for i in range(n_int):
        for g in range(n_group):
            for r in range(n_row):
                # most rows hold no such pixel: a quick look first, which vectorises
                highest = np.float32(0.0)
                for x in range(n_col):
                    highest = max(highest, ramp[i, g, r, x])
                if highest < limit:
                    continue
                for x in range(n_col):
                    if ramp[i, g, r, x] >= limit:
                        ramp[i, g, r, x] = limit
                        group_dq[i, g, r, x] |= flag


@njit(cache=True, nogil=True)
def interpolate_response(ramp, gain, response, step):
    """
    Turn electrons into DN through a table of the response, linear between its nodes.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Electrons; changed in place to DN.
    gain : float
        Electrons per DN.
    response : `~numpy.ndarray` of float32, shape (n_node,)
        Measured DN at linear DN of 0, ``step``, 2 ``step`` ...; continued along its last
        (first) piece beyond.
    step : float
        Distance of the nodes in linear DN.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    scale = np.float32(1.0 / (gain * step))
    last = response.size - 2
    for i in range(n_int):
        for g in range(n_group):
            for r in range(n_row):
                for x in range(n_col):
                    place = ramp[i, g, r, x] * scale
                    k = min(max(np.int32(place), np.int32(0)), np.int32(last))
                    low = response[k]
                    ramp[i, g, r, x] = low + (place - np.float32(k)) * (response[k + 1] - low)


@njit(cache=True, nogil=True)
def add_noise(ramp, sigma, key, first_row):
    """
    Add independent Gaussian noise to every read.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Changed in place.
    sigma : float
        Standard deviation.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the streams.
    first_row : int
        Detector row of the first row.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    normals = np.empty(n_col)
    for r in range(n_row):
        for i in range(n_int):
            _seed(state, key, i, first_row + r)
            for g in range(n_group):
                _fill_normals(state, normals)
                for x in range(n_col):
                    ramp[i, g, r, x] += np.float32(sigma * normals[x])


@njit(cache=True, nogil=True)
def add_pink_noise(ramp, sigma, n_octave, n_output, key, first_row, n_detector_rows):
    """
    Add 1/f noise: a drift common to the pixels of one row that share an output.

    Sum of ``n_octave`` steps of equal variance, the k-th of which keeps its value over 2^k
    rows in read-out order (Voss & McCartney; Gardner 1978, Sci. Am. 238, 16).

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        Changed in place.
    sigma : float
        Total standard deviation.
    n_octave, n_output : int
        Number of octaves; number of outputs, to which columns belong in turn.
    key : `~numpy.ndarray` of uint64, shape (4,)
        Key words of the streams.
    first_row, n_detector_rows : int
        Detector row of the first row, and how many there are.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    normal = np.empty(1)
    drift = np.empty(n_output, np.float32)
    amplitude = sigma / math.sqrt(n_octave)
    for i in range(n_int):
        for g in range(n_group):
            for r in range(n_row):
                when = (i * n_group + g) * n_detector_rows + first_row + r
                for output in range(n_output):
                    total = 0.0
                    for k in range(n_octave):
                        index = output * n_octave + k
                        # the steps of different octaves do not fall together
                        shift = int(_mix(key[0] + uint64(index)) & _U255) << max(k - 8, 0)
                        _seed(state, key, index, (when + shift) >> k)
                        _fill_normals(state, normal)
                        total += normal[0]
                    drift[output] = np.float32(amplitude * total)
                for x in range(n_col):
                    ramp[i, g, r, x] += drift[x % n_output]


@njit(cache=True, nogil=True)
def digitize(ramp, counts, group_dq, flag_floor, flag_ceiling):
    """
    Round DN to unsigned 16-bit numbers, flagging those out of range.

    Parameters
    ----------
    ramp : `~numpy.ndarray` of float32, shape (n_int, n_group, n_row, n_col)
        DN.
    counts : `~numpy.ndarray` of uint16, like ``ramp``
        Overwritten.
    group_dq : `~numpy.ndarray` of uint8, like ``ramp``
        Flags; changed in place.
    flag_floor, flag_ceiling : uint8
        Bits to set below 0 and above 65535.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    low, high = np.float32(-0.5), np.float32(65535.5)
    for i in range(n_int):
        for g in range(n_group):
            for r in range(n_row):
                smallest, largest = np.float32(0.0), np.float32(0.0)
                for x in range(n_col):
                    value = ramp[i, g, r, x]
                    smallest = min(smallest, value)
                    largest = max(largest, value)
                    value = min(max(value + np.float32(0.5), np.float32(0.0)), np.float32(65535.0))
                    counts[i, g, r, x] = np.uint16(np.int32(value))
                if smallest < low or largest >= high:
                    for x in range(n_col):
                        if ramp[i, g, r, x] < low:
                            group_dq[i, g, r, x] |= flag_floor
                        elif ramp[i, g, r, x] >= high:
                            group_dq[i, g, r, x] |= flag_ceiling
