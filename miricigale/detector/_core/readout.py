"""What the read-out makes of charge: saturation, response, noise and counts."""

import math

import numpy as np
from numba import uint64

from miricigale.detector._core.random import fill_normals, mix, seed_stream
from miricigale.utils.compilation import njit


@njit()
def clip_well(ramp, well, group_dq, flag):
    """Stop charge at ``well`` electrons, setting ``flag`` in ``group_dq`` where it was reached."""
    n_int, n_group, n_row, n_col = ramp.shape
    limit = np.float32(well)
    for i, g, r in np.ndindex(n_int, n_group, n_row):
        # most rows hold no such pixel: a quick look first, which vectorizes
        highest = np.float32(0.0)
        for x in range(n_col):
            highest = max(highest, ramp[i, g, r, x])
        if highest < limit:
            continue
        for x in range(n_col):
            if ramp[i, g, r, x] >= limit:
                ramp[i, g, r, x] = limit
                group_dq[i, g, r, x] |= flag


@njit()
def interpolate_response(ramp, gain, response, step):
    """
    Turn electrons into DN through a table of the response, linear between its nodes.

    ``response`` is the measured DN at linear DN of 0, ``step``, 2 ``step`` ...; it is continued
    along its last (first) piece beyond.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    scale = np.float32(1.0 / (gain * step))
    last = response.size - 2
    for i, g, r in np.ndindex(n_int, n_group, n_row):
        for x in range(n_col):
            place = ramp[i, g, r, x] * scale
            k = min(max(np.int32(place), np.int32(0)), np.int32(last))
            low = response[k]
            ramp[i, g, r, x] = low + (place - np.float32(k)) * (response[k + 1] - low)


@njit()
def add_noise(ramp, sigma, key, first_row):
    """Add independent Gaussian noise of standard deviation ``sigma`` to every read."""
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    normals = np.empty(n_col)
    for r, i in np.ndindex(n_row, n_int):
        seed_stream(state, key, i, first_row + r)
        for g in range(n_group):
            fill_normals(state, normals)
            for x in range(n_col):
                ramp[i, g, r, x] += np.float32(sigma * normals[x])


@njit()
def add_pink_noise(ramp, sigma, n_octave, n_output, key, first_row, n_detector_rows):
    """
    Add 1/f noise of standard deviation ``sigma``: a drift of the pixels of one row and output.

    Sum of ``n_octave`` steps of equal variance, the k-th of which keeps its value over 2^k
    rows in read-out order (Voss & McCartney; Gardner 1978, Sci. Am. 238, 16). Columns belong to
    the ``n_output`` outputs in turn.
    """
    n_int, n_group, n_row, n_col = ramp.shape
    state = np.empty(4, np.uint64)
    normal = np.empty(1)
    drift = np.empty(n_output, np.float32)
    amplitude = sigma / math.sqrt(n_octave)
    for i, g, r in np.ndindex(n_int, n_group, n_row):
        when = (i * n_group + g) * n_detector_rows + first_row + r
        for output in range(n_output):
            total = 0.0
            for k in range(n_octave):
                index = output * n_octave + k
                # the steps of different octaves do not fall together
                shift = int(mix(key[0] + uint64(index)) & np.uint64(255)) << max(k - 8, 0)
                seed_stream(state, key, index, (when + shift) >> k)
                fill_normals(state, normal)
                total += normal[0]
            drift[output] = np.float32(amplitude * total)
        for x in range(n_col):
            ramp[i, g, r, x] += drift[x % n_output]


@njit()
def digitize(ramp, counts, group_dq, flag_floor, flag_ceiling):
    """Round DN to ``counts`` (uint16), setting flags in ``group_dq`` out of their range."""
    n_int, n_group, n_row, n_col = ramp.shape
    low = np.float32(-0.5)
    high = np.float32(65535.5)
    for i, g, r in np.ndindex(n_int, n_group, n_row):
        smallest = np.float32(0.0)
        largest = np.float32(0.0)
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
