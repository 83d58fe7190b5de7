"""
Slopes drawn instead of fitted: what the fit makes of a rate, of its noise and of hits.

Units are those of the fit: DN for the variances ``s`` of a read and v of a difference, whose ratio
sets the weights (see `miricigale.depth._core`); images are in DN/s, ``mean`` and ``limit`` in
electrons per second and electrons.
"""

import math

import numpy as np

from miricigale.depth._core import difference_weight, weight_sums
from miricigale.reduction._core.pixel import JUMP, JUMP_NEIGHBOR, SATURATED, own_charge
from miricigale.utils.compilation import njit

# what is done to an entry of a pixel
_OWN = 1
_NEIGHBOR = 2


@njit(error_model="numpy")
def tabulate(levels, slopes, n_int, s, true_s, inv_gain, step):
    """
    What the fit makes of ramps without hits: its slope, and how noise enters it.

    ``levels`` (n, n_group) are linear DN of the groups of n ramps, ``slopes`` (n, n_group) the
    derivative of linear by read DN there. Returns the slopes in DN/s, the time in s over which
    photons are counted in all integrations, and the standard deviation that reads of variance
    ``true_s`` give the slope, (3, n).
    """
    n, n_group = levels.shape
    out = np.empty((3, n))
    n_diff = n_group - 1
    w = np.empty(n_diff + 2)
    for k in range(n):
        slope = (levels[k, n_diff] - levels[k, 0]) / n_diff
        total = 1.0
        squares = 1.0
        for _ in range(2):
            v = slope * inv_gain
            total, squares = weight_sums(n_diff, v, s)
            w[0] = w[n_diff + 1] = 0.0
            num = 0.0
            for i in range(1, n_diff + 1):
                w[i], _ = difference_weight(i, n_diff, v, s)
                num += w[i] * (levels[k, i] - levels[k, i - 1])
            slope = num / total
        noise = 0.0
        for g in range(n_group):
            noise += ((w[g] - w[g + 1]) * slopes[k, g]) ** 2
        out[0, k] = slope / step
        out[1, k] = total * total / squares * step * n_int
        out[2, k] = math.sqrt(true_s * noise / n_int) / (total * step)
    return out


@njit(error_model="numpy")
def variances(values, n_int, n_diff, s, inv_gain, step):
    """Poisson and read variance, (DN/s)^2, that the fit quotes for slopes in DN/s, (2, n)."""
    out = np.empty((2, values.size))
    for k in range(values.size):
        v = max(values[k] * step * inv_gain, 1e-8 * s)
        total, squares = weight_sums(n_diff, v, s)
        out[0, k] = v * squares / (total * total * n_int * step * step)
        out[1, k] = max(1.0 / (total * n_int * step * step) - out[0, k], 0.0)
    return out


@njit(error_model="numpy", inline="always")
def _place(value, scale, last):
    """Node of a table, even in the fourth root of the value, and the place behind it."""
    place = math.sqrt(math.sqrt(max(value, 0.0))) * scale
    k = min(int(place), last)
    return k, min(place - k, 1.0)


@njit(error_model="numpy")
def draw_slopes(mean, electrons, time, normals, table, offset, scale, quoted, quoted_scale, out):
    """
    Slopes of pixels without hits, and their quoted variances.

    ``table`` (3, n) has DN/s per electron per second, the time of `tabulate` and the deviation by
    reads at rates (k / ``scale``)^4; ``quoted`` (2, n) the variances at slopes
    (k / ``quoted_scale``)^4. ``out`` are three images to be filled.
    """
    rate, var_poisson, var_read = out
    n_row, n_col = mean.shape
    last = table.shape[1] - 2
    end = quoted.shape[1] - 2
    for y, x in np.ndindex(n_row, n_col):
        m = mean[y, x]
        if m != m:
            rate[y, x] = var_poisson[y, x] = var_read[y, x] = np.nan
            continue
        k, part = _place(m, scale, last)
        response = table[0, k] + part * (table[0, k + 1] - table[0, k])
        counted = table[1, k] + part * (table[1, k + 1] - table[1, k])
        read = table[2, k] + part * (table[2, k + 1] - table[2, k])
        noise = (electrons[y, x] / time - m) * math.sqrt(time / counted)
        slope = offset + response * (m + noise) + read * normals[y, x]
        k, part = _place(slope, quoted_scale, end)
        rate[y, x] = slope
        var_poisson[y, x] = quoted[0, k] + part * (quoted[0, k + 1] - quoted[0, k])
        var_read[y, x] = quoted[1, k] + part * (quoted[1, k + 1] - quoted[1, k])


@njit(error_model="numpy", inline="always")
def _usable(charge, extra, first, limit, g0, g1):
    """
    Differences before the group in which a pixel is full.

    ``charge`` comes in each group; ``extra`` came in group ``first``, before which it was not full.
    """
    group = g1
    if extra >= limit:
        group = first
    elif charge * g1 + extra >= limit:
        group = max(math.ceil((limit - extra) / charge) - 1, first)
    return g1 - g0 - 1 if group >= g1 else max(group - g0 - 1, 0)


@njit(error_model="numpy")
def _list(rate, hits, electrons):
    """
    Lists of what comes into each pixel, one entry for a group.

    Returns the first entry of each pixel (-1: none), and of the entries (n,) the next one, the
    group and the electrons; in arrays with space for 64 more.
    """
    ny, nx = rate.shape
    head = np.full((ny, nx), -1, np.int32)
    tail = np.empty((ny, nx), np.int32)
    size = electrons.size + 64
    link = np.empty(size, np.int32)
    slot = np.empty(size, np.int32)
    charge = np.empty(size)
    n = 0
    for i in range(electrons.size):
        when = hits[0, i]
        y = hits[1, i]
        x = hits[2, i]
        if rate[y, x] != rate[y, x]:
            continue
        if head[y, x] >= 0 and slot[tail[y, x]] == when:
            charge[tail[y, x]] += electrons[i]
            continue
        if head[y, x] < 0:
            head[y, x] = n
        else:
            link[tail[y, x]] = n
        tail[y, x] = n
        link[n] = -1
        slot[n] = when
        charge[n] = electrons[i]
        n += 1
    return head, link, slot, charge, n


@njit(error_model="numpy")
def _find(rate, variance, mean, entries, n, groups, noise, truth, jump, rng):
    """
    Jumps that the fit finds, (n_jump, 5) as from `fit_pixels`, and which entries are cut by it.

    The statistic of a jump is its expected value plus a standard normal number, which is
    independent of the slope: the fit is the best linear one.
    """
    ny, nx = rate.shape
    head, link, slot, charge = entries
    _, n_group, g0, g1 = groups
    step, s, inv_gain = noise
    limit, dn = truth
    n_diff = g1 - g0 - 1
    cut = np.zeros(link.size, np.uint8)
    jumps = np.empty((n, 5))
    n_jump = 0
    for y, x in np.ndindex(ny, nx):
        i = head[y, x]
        while i >= 0:
            g = slot[i] % n_group
            j = g - g0
            full = mean[y, x] * step * (g + 1) + charge[i] >= limit
            if 1 <= j <= n_diff and not full:
                slope = rate[y, x] * step
                share = variance[y, x] * step * step
                q = charge[i] * dn
                v = slope * inv_gain
                t = 0.0
                for _ in range(2):
                    weight, leverage = difference_weight(j, n_diff, v, s)
                    t = q * math.sqrt(max(leverage - weight * weight * share, 0.0))
                    if not 0.5 * jump < t < 2.0 * jump:
                        break
                    # the fit takes its weights from a slope that the hit has raised
                    v = (slope + weight * share * q) * inv_gain
                t += rng.standard_normal()
                if abs(t) > jump:
                    cut[i] = _OWN
                    jumps[n_jump, 0] = y
                    jumps[n_jump, 1] = x
                    jumps[n_jump, 2] = slot[i] // n_group
                    jumps[n_jump, 3] = j - 1
                    jumps[n_jump, 4] = t
                    n_jump += 1
            i = link[i]
    return jumps[:n_jump].copy(), cut


@njit(error_model="numpy")
def _cut_neighbors(rate, entries, cut, n, jumps, own_jumps, groups, neighbor):
    """Cut the entries beside large jumps (``own``), or new ones without charge; returns what may grow."""
    ny, nx = rate.shape
    head, link, slot, charge = entries
    _, n_group, g0, _ = groups
    for m in range(jumps.shape[0]):
        if own_jumps[m] < neighbor:
            continue
        when = int(jumps[m, 2]) * n_group + g0 + 1 + int(jumps[m, 3])
        for side in range(4):
            y = int(jumps[m, 0]) + (side == 0) - (side == 1)
            x = int(jumps[m, 1]) + (side == 2) - (side == 3)
            if not (0 <= y < ny and 0 <= x < nx and rate[y, x] == rate[y, x]):
                continue
            before = -1
            i = head[y, x]
            while i >= 0 and slot[i] < when:
                before = i
                i = link[i]
            if i < 0 or slot[i] != when:
                if n == link.size:
                    link = np.append(link, link)
                    slot = np.append(slot, slot)
                    charge = np.append(charge, charge)
                    cut = np.append(cut, cut)
                link[n] = i
                slot[n] = when
                charge[n] = 0.0
                cut[n] = 0
                i = n
                n = n + 1
                if before < 0:
                    head[y, x] = i
                else:
                    link[before] = i
            cut[i] |= _NEIGHBOR
    return link, slot, charge, cut


@njit(error_model="numpy")
def _sums(lengths, n, v, s, n_differences, n_whole):
    """Sums of the weights and of their squares over the segments of a pixel."""
    total, squares = weight_sums(n_differences, v, s)
    total *= n_whole
    squares *= n_whole
    for i in range(n):
        weight, square = weight_sums(lengths[i], v, s)
        total += weight
        squares += square
    return total, squares


@njit(error_model="numpy")
def _divide(i, entries, charge_per_group, n_usable, groups, limit, lengths, kept_hits):
    """
    Divide the integrations of a pixel where it is cut or full, from its first entry ``i`` on.

    Filled are ``lengths`` of the segments that are not whole integrations, and the hits that stay: segment,
    difference in it and charge. Returns the numbers of whole integrations, segments, hits that stay and jumps,
    and whether a neighbor has a jump and the pixel is full.
    """
    link, slot, charge, cut = entries
    n_whole, n_group, g0, g1 = groups
    n_diff = g1 - g0 - 1
    n_seg = 0
    n_kept = 0
    n_cut = 0
    near_jump = False
    full = n_usable < n_diff
    while i >= 0:
        k = slot[i] // n_group
        n_whole -= 1
        begin = 1
        last = n_usable
        extra = 0.0
        while i >= 0 and slot[i] // n_group == k:
            g = slot[i] % n_group
            j = g - g0
            near_jump = near_jump or (cut[i] & _NEIGHBOR) > 0
            if j <= last:
                extra += charge[i]
                last = min(last, _usable(charge_per_group, extra, g, limit, g0, g1))
                if 1 <= j <= last and cut[i]:
                    n_cut += cut[i] & _OWN
                    if j > begin:
                        lengths[n_seg] = j - begin
                        n_seg += 1
                    begin = j + 1
                elif 1 <= j <= last:
                    kept_hits[n_kept, 0] = n_seg
                    kept_hits[n_kept, 1] = j - begin + 1
                    kept_hits[n_kept, 2] = charge[i]
                    n_kept += 1
            i = link[i]
        full = full or last < n_diff
        if last >= begin:
            lengths[n_seg] = last - begin + 1
            n_seg += 1
    return n_whole, n_seg, n_kept, n_cut, near_jump, full


@njit(error_model="numpy")
def hit_slopes(mean, hits, electrons, groups, noise, truth, thresholds, rng, out):
    """
    Change the slopes of pixels that lose groups to hits or saturation, or keep a hit.

    ``hits`` (3, n) are group, row and column of deposits of ``electrons``, those of a pixel in the
    order of the groups. ``groups`` are the numbers of integrations and groups, the first group and the one
    behind the last; ``noise`` the group time, the variance of a read and the Poisson variance of a difference
    over the slope; ``truth`` the charge at which a pixel is full and the inverse of the true gain;
    ``thresholds`` those of jumps and of their neighbors; ``out`` the images of `RampFit` from ``rate`` to
    ``flags``.

    The fit to fewer groups is that to all of them plus independent noise of the difference of the
    variances. Returns the jumps that are found, as `fit_pixels`.
    """
    n_int, n_group, g0, g1 = groups
    step, s, inv_gain = noise
    limit, dn = truth
    jump, neighbor = thresholds
    rate, var_poisson, var_read, n_used, n_jump, dq = out
    ny, nx = rate.shape
    n_diff = g1 - g0 - 1
    head, link, slot, charge, n = _list(rate, hits, electrons)
    entries = head, link, slot, charge
    variance = var_poisson + var_read
    jumps, cut = _find(rate, variance, mean, entries, n, groups, noise, truth, jump, rng)
    own_jumps = own_charge(jumps, nx, n_diff)
    link, slot, charge, cut = _cut_neighbors(
        rate, entries, cut, n, jumps, own_jumps, groups, neighbor
    )
    entries = link, slot, charge, cut
    lengths = np.empty(n_int * (n_diff + 1) + 1, np.int64)
    kept_hits = np.empty((n_int * n_group, 3))
    for y, x in np.ndindex(ny, nx):
        charge_per_group = mean[y, x] * step
        n_usable = _usable(charge_per_group, 0.0, 0, limit, g0, g1)
        if rate[y, x] != rate[y, x] or (head[y, x] < 0 and n_usable == n_diff):
            continue
        n_whole, n_seg, n_kept, n_cut, near_jump, full = _divide(
            head[y, x], entries, charge_per_group, n_usable, groups, limit, lengths, kept_hits
        )
        n_differences = n_whole * n_usable
        for m in range(n_seg):
            n_differences += lengths[m]
        n_used[y, x] = n_differences
        n_jump[y, x] = n_cut
        dq[y, x] |= SATURATED * full + JUMP * (n_cut > 0 or near_jump) + JUMP_NEIGHBOR * near_jump
        if n_differences == 0:
            rate[y, x] = var_poisson[y, x] = var_read[y, x] = np.nan
            continue
        shift = 0.0
        # the fit's weights know the slope with the hits that it keeps
        for _ in range(1 if n_kept == 0 else 3):
            v = (rate[y, x] * step + shift) * inv_gain
            total, squares = _sums(lengths, n_seg, v, s, n_usable, n_whole)
            shift = 0.0
            for m in range(n_kept):
                weight, _ = difference_weight(kept_hits[m, 1], lengths[int(kept_hits[m, 0])], v, s)
                shift += weight * kept_hits[m, 2] * dn / total
        added_variance = max(1.0 / total - (var_poisson[y, x] + var_read[y, x]) * step * step, 0.0)
        rate[y, x] += (shift + math.sqrt(added_variance) * rng.standard_normal()) / step
        var_poisson[y, x] = max(v, 0.0) * squares / (total * step) ** 2
        var_read[y, x] = max(1.0 / (total * step * step) - var_poisson[y, x], 0.0)
    return jumps
