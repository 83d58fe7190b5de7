"""
Which (galaxy, AGN model) pairs can matter at all: bounds in single precision.

With whitened data d = F sqrt(w) and unit vectors g, t of a galaxy and an AGN model in the used
bands, p = <g, d>, a = <t, d>, X = <g, t>, the best chi2 of any non-negative mixture of the
two is |d|^2 - R with ::

    R = p^2 + (a - p X)^2 / (1 - X^2)    where a > p X and p > a X,
    R = max(p, a, 0)^2                   elsewhere.

No AGN fraction can do better, so a pair whose R lies far below the best is skipped. The
test is done without division, and leans to keeping a pair by more than the rounding of
single precision can amount to.
"""

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.batched_pairs import best_scale
from miricigale.fitting._core.structs import BLOCK, DONE, KEY_BITS
from miricigale.utils.compilation import KERNEL, PART, njit

#: Tori handled side by side; arrays of unit vectors are padded with zeros to a multiple.
GROUP = 4

# Rounding of 64 products of unit vectors in float32, generously.
_ETA = np.float32(3e-6)
_EPS = np.float32(6e-6)
_TINY = np.float32(1e-28)
_ALWAYS = np.float32(4.0)
_NEVER = np.float32(1e30)
_NOWHERE = np.float32(-1e3)
_SLACK = np.float32(1e-6)
# Vectors of Pairs.rows: <g, t> of GROUP AGN models; of the galaxies the least R / |d|^2 to keep, 2 ln(prior)
# with that of their best partner, <g, d>, their largest bound, and work space.
_LEAST, _BASE, _P, _TOP, _ALONE, _REST, _PASS, _SCORE = (i * BLOCK for i in range(GROUP, GROUP + 8))
ROWS = GROUP + 8


@njit(**KERNEL)
def project(tables, target, pairs):
    """
    Look at galaxies without AGN, for each redshift.

    Filled are ``pairs.p32`` and ``inverse_norm`` (4 and 0 for a galaxy too faint for single
    precision: no bound can drop it), ``promise`` (the best they reach, -1e30 where there is none)
    and ``galaxy_of`` (the one that does).
    """
    zero = np.float32(0)
    unity = np.float32(1)
    for z in range(target.log_prior.size):
        pairs.promise[z] = -1e30
        pairs.galaxy_of[z] = -1
        if target.log_prior[z] < -1e200:
            continue
        p = pairs.p32[z]
        norm = pairs.inverse_norm[z]
        p[:] = 0.0
        norm[:] = 0.0
        for j in range(target.bands.size):
            row = tables.galaxy32[z, target.bands[j]]
            s = target.root32[z, j]
            d = target.data32[z, j]
            for i in range(p.size):
                t = row[i] * s
                norm[i] += t * t
                p[i] += t * d
        for i in range(p.size):
            q = norm[i]
            r = unity / np.sqrt(max(q, _TINY))
            norm[i] = zero if q < _TINY else r
            p[i] = _ALWAYS if q < _TINY else p[i] * r
        top = np.float32(-2)
        row_top = np.float32(-2)
        best = np.int64(-1)
        for g in range(tables.galaxy.shape[1]):
            if tables.log_usable[z, g] < -1e200:
                continue
            top = max(top, p[g])
            # one too faint for single precision has 4, and may have no light at all
            if best < 0 or (p[g] < 2.0 and p[g] > row_top):
                best = g
                row_top = p[g] if p[g] < 2.0 else row_top
        pairs.galaxy_of[z] = best
        if best >= 0:
            value = np.float64(max(top, zero))
            pairs.promise[z] = value * value * target.norm[z] + target.log_prior[z]


@njit(**PART)
def agn_products(agn, target, z, agn_pq, agn_weighted):
    """Fill agn_pq[k] = <A, wF>, <A, wA> and agn_weighted[k] = w A for all AGN models of one redshift."""
    weight = target.weight[z]
    flux = target.flux
    for k in range(agn_pq.shape[0]):
        for b in range(agn.shape[1]):
            agn_weighted[k, b] = agn[k, b] * weight[b]
        # apart from the loop above: a sum next to a store is taken in an order that depends on
        # where the arrays lie, and results shall not
        p = 0.0
        q = 0.0
        for b in range(agn.shape[1]):
            p += agn_weighted[k, b] * flux[b]
            q += agn_weighted[k, b] * agn[k, b]
        agn_pq[k, 0] = p
        agn_pq[k, 1] = q


@njit(**PART)
def best_of_galaxy(tables, target, limits, pairs, z, g):
    """
    Best model of one galaxy at one redshift, f = 0 included; with limits, a good one.

    ``pairs.agn_pq`` must hold that redshift's. Returned are the largest R + 2 ln(prior) and the scale
    of the model that has it.
    """
    galaxy = tables.galaxy[z, g]
    agn = tables.agn[z]
    of_frac = tables.of_frac
    weight = target.weight[z]
    bands = target.bands
    agn_pq = pairs.agn_pq
    log_prior = target.log_prior[z] + tables.log_usable[z, g]
    p = 0.0
    q = 0.0
    for b in bands:
        t = galaxy[b] * weight[b]
        p += t * target.flux[b]
        q += t * galaxy[b]
    best_value = -1e300
    best_s = 0.0
    without = -1e300
    if tables.zero_frac == 1 and q > 0.0 and tables.log_zero > -1e200:
        best_s, r, _ = best_scale(limits, p, q, galaxy, galaxy, 0.0, 0.0)
        best_value = r + tables.log_zero
    for k in range(agn_pq.shape[0]):
        if tables.of_agn[at.LOG_AGN, k] < -1e200:
            continue
        cross = 0.0
        for b in bands:
            cross += galaxy[b] * weight[b] * agn[k, b]
        a = agn_pq[k, 0]
        b2 = agn_pq[k, 1]
        for j in range(of_frac.shape[1]):
            x = of_frac[at.RATIO, j] * tables.of_galaxy[at.DUST, g]
            num = max(p + x * a, 0.0)
            den = q + x * (2.0 * cross + x * b2)
            if not den > 0.0:
                continue
            s = num / den
            log_pair = tables.of_agn[at.LOG_AGN, k] + of_frac[at.LOG_FRAC, j]
            value = num * s + log_pair
            # with limits, only at what would be better without them than all before
            if limits is not None:
                if value <= without:
                    continue
                without = value
                s, r, _ = best_scale(limits, num, den, galaxy, agn[k], x, 0.0)
                value = r + log_pair
            if value > best_value:
                best_value = value
                best_s = s
    return best_value + log_prior, best_s


@njit(**PART)
def _project_tori(agn, target, z, unit, of_torus):
    """
    Fill unit vectors t of the AGN models of one redshift, <t, d>, and the square of its positive part.

    The latter has the rounding added, and is 4 for AGN models too faint for single precision.
    """
    zero = np.float32(0)
    n_used = target.bands.size
    for k in range(agn.shape[0]):
        for j in range(n_used):
            unit[k, j] = agn[k, target.bands[j]] * target.root32[z, j]
        # sums apart from stores: see `agn_products`
        norm = zero
        s = zero
        for j in range(n_used):
            norm += unit[k, j] * unit[k, j]
            s += unit[k, j] * target.data32[z, j]
        faint = norm < _TINY
        r = zero if faint else np.float32(1) / np.sqrt(norm)
        a = s * r
        m = max(a, zero) + _ETA
        of_torus[0, k] = a
        of_torus[1, k] = m * m if not faint else (_ALWAYS if norm > zero else zero)
        for j in range(n_used):
            unit[k, j] *= r


@njit(**PART)
def _products(unit_galaxy, unit_agn, k, n_used, rows):
    """Fill rows[m * BLOCK + i] = <galaxy i, AGN model k + m> for GROUP AGN models (register blocking)."""
    rows[: GROUP * BLOCK] = 0.0
    t0 = unit_agn[k]
    t1 = unit_agn[k + 1]
    t2 = unit_agn[k + 2]
    t3 = unit_agn[k + 3]
    # what is beyond the used bands is 0
    for j in range(0, n_used, 3):
        g0 = unit_galaxy[j]
        g1 = unit_galaxy[j + 1]
        g2 = unit_galaxy[j + 2]
        u00 = t0[j]
        u01 = t0[j + 1]
        u02 = t0[j + 2]
        u10 = t1[j]
        u11 = t1[j + 1]
        u12 = t1[j + 2]
        u20 = t2[j]
        u21 = t2[j + 1]
        u22 = t2[j + 2]
        u30 = t3[j]
        u31 = t3[j + 1]
        u32 = t3[j + 2]
        for i in range(BLOCK):
            h0 = g0[i]
            h1 = g1[i]
            h2 = g2[i]
            rows[i] += h0 * u00 + h1 * u01 + h2 * u02
            rows[BLOCK + i] += h0 * u10 + h1 * u11 + h2 * u12
            rows[2 * BLOCK + i] += h0 * u20 + h1 * u21 + h2 * u22
            rows[3 * BLOCK + i] += h0 * u30 + h1 * u31 + h2 * u32


@njit(**PART)
def _list_block(pairs, norm, n_used, key, n):
    """
    List the pairs of one block of galaxies whose bound reaches a threshold.

    ``pairs.rows`` says what the galaxies are, and is filled with their largest bounds; bounds are of
    R + 2 ln(prior), `DONE` for pairs that are not kept. ``key`` is that of the first AGN model, ``n``
    runs are in the list, which must have space for one of every AGN model; returned is how many are now.
    """
    unity = np.float32(1)
    zero = np.float32(0)
    rows = pairs.rows
    of_torus = pairs.agn32
    for i in range(BLOCK):
        p2 = max(rows[_P + i], zero) + _ETA
        p2 = p2 * p2
        rows[_ALONE + i] = p2
        rows[_REST + i] = rows[_LEAST + i] - p2
        # a galaxy that passes alone passes with every AGN model
        rows[_PASS + i] = -unity if p2 >= rows[_LEAST + i] else rows[_LEAST + i]
        rows[_TOP + i] = DONE
    for k in range(of_torus.shape[1]):
        if k % GROUP == 0:
            _products(pairs.unit_galaxy, pairs.unit_agn, k, n_used, rows)
        a = of_torus[0, k]
        a2 = of_torus[1, k]
        x = (k % GROUP) * BLOCK
        for i in range(BLOCK):
            cross = rows[x + i]
            n1 = a - rows[_P + i] * cross + _ETA
            n2 = rows[_P + i] - a * cross + _ETA
            r = n1 * n1 - rows[_REST + i] * (unity - cross * cross - _EPS)
            rows[_SCORE + i] = max(min(r, min(n1, n2)), a2 - rows[_PASS + i])
        # counted, for the largest of them would not be found side by side
        n_kept = zero
        for i in range(BLOCK):
            n_kept += unity if rows[_SCORE + i] >= zero else zero
        if n_kept == zero:
            continue
        pairs.run_key[n] = key + k
        bound = pairs.bound[n]
        for i in range(BLOCK):
            cross = rows[x + i]
            n1 = a - rows[_P + i] * cross + _ETA
            n2 = rows[_P + i] - a * cross + _ETA
            joint_bound = rows[_ALONE + i] + n1 * n1 / max(unity - cross * cross - _EPS, _EPS)
            r = max(rows[_ALONE + i], a2)
            r = max(r, joint_bound) if min(n1, n2) >= zero else r
            r = min(r, unity) * norm
            # rounding of single precision is added
            value = r + rows[_BASE + i] + _SLACK * (r + abs(rows[_BASE + i]))
            value = value if rows[_SCORE + i] >= zero else DONE
            bound[i] = value
            rows[_TOP + i] = max(rows[_TOP + i], value)
        top = DONE
        for i in range(BLOCK):
            top = max(top, bound[i])
        pairs.top[n] = top
        n += 1
    return n


@njit(**KERNEL)
def list_runs(tables, target, limits, pairs, delta, reference, position):
    """
    List runs of pairs that can matter, until the list is full or all are seen.

    ``position`` is where to begin: place of the redshift in ``pairs.order`` times the number of
    blocks, plus the block. ``reference`` is R + 2 ln(prior) that some model reaches, pairs that are
    more than ``delta`` below it are left out.

    Returned are the number of runs in the list, where to resume, and the reference, raised when a better
    model is met.
    """
    n_z = tables.tiles.shape[0]
    n_blocks = tables.tiles.shape[1]
    n_agn = tables.agn.shape[1]
    rows = pairs.rows
    bands = target.bands
    # `_products` takes three bands at a time
    pairs.unit_galaxy[bands.size : bands.size + 2] = 0.0
    margin = 2.0
    n = np.int64(0)
    z_now = np.int64(-1)
    agn_known = False
    while position < n_z * n_blocks and n + n_agn <= pairs.run_key.size:
        z = pairs.order[position // n_blocks]
        block = position % n_blocks
        if pairs.promise[z] < -1e29:
            position = np.int64(n_z * n_blocks)
            break
        position += 1
        if z != z_now:
            z_now = z
            agn_known = False
            _project_tori(tables.agn32[z], target, z, pairs.unit_agn, pairs.agn32)
        start = block * BLOCK
        norm = target.norm[z]
        lowest = reference - delta - target.log_prior[z] - tables.log_top_pair
        top_prior = target.log_prior[z] + tables.log_top_pair
        log_usable = tables.log_usable[z, start : start + BLOCK]
        p32 = pairs.p32[z, start : start + BLOCK]
        inverse = pairs.inverse_norm[z, start : start + BLOCK]
        top_usable = -1e300
        for i in range(BLOCK):
            top_usable = max(top_usable, log_usable[i])
        if top_usable < -1e200:
            continue
        for i in range(BLOCK):
            # what may not be used is parallel to nothing and reaches nothing
            t = np.float32(max(min((lowest - log_usable[i]) / norm, 1.0), -1.0) - 1e-6)
            usable = log_usable[i] > -1e200
            rows[_LEAST + i] = t if usable else _NEVER
            rows[_P + i] = p32[i] if usable else _NOWHERE
            rows[_BASE + i] = max(log_usable[i] + top_prior, -1e30)
        for j in range(bands.size):
            row = tables.galaxy32[z, bands[j], start : start + BLOCK]
            s32 = target.root32[z, j]
            for i in range(BLOCK):
                pairs.unit_galaxy[j, i] = row[i] * s32 * inverse[i]
        key = ((z << KEY_BITS) + block) << KEY_BITS
        n = _list_block(pairs, np.float32(norm), bands.size, key, n)
        # galaxies that promise more than the reference are evaluated at once; when that does
        # not pay, only those that promise much more
        for i in range(BLOCK):
            if rows[_TOP + i] > reference + margin:
                if not agn_known:
                    agn_known = True
                    agn_products(tables.agn[z], target, z, pairs.agn_pq, pairs.agn_weighted)
                value, _ = best_of_galaxy(tables, target, limits, pairs, z, start + i)
                if value > reference:
                    reference = value
                    margin = 2.0
                else:
                    # exponents of models that are not looked at stay in range
                    margin = min(1.5 * margin, 400.0)
    return n, position, reference
