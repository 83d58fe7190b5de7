"""
A first look at the posterior of objects on the nodes of a grid: where sampling between the nodes begins.

Every galaxy is met with every AGN model once, in single precision, at the best AGN fraction within the range of
the grid. Fluxes of several objects are compared with the galaxies of a redshift while these are in the cache.
"""

from typing import NamedTuple

import numpy as np

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.batched_pairs import best_mixture
from miricigale.fitting._core.structs import BLOCK
from miricigale.fitting._core.workspace import aligned
from miricigale.utils._core.functions import exponential, log10_single
from miricigale.utils.compilation import KERNEL, PART, njit

#: Value of a model that may not be used, and ln of a prior below which there is none.
_NOWHERE = np.float32(-1e30)
_NONE = -1e200
_TINY = np.float32(1e-30)
#: Largest power of an AGN over that of its unit, so that its square is a number in single precision.
_MOST_POWER = 1e15
#: Bands that are taken at a time: their number is padded to a multiple.
TOGETHER = 4
#: Largest exponent in single precision.
_MOST_POWER_OF_E = np.float32(80.0)
# Vectors of ``ScanWork.rows``, which lets the compiler see that they do not overlap: products with the data and
# with themselves, best scale, R and 2 ln(posterior) of the best, products with AGN, ln(prior), and work space.
_P, _Q, _SCALE, _BEST, _SCORE, _CROSS, _PRIOR, _PLACE = (i * BLOCK for i in range(8))
#: Values so far below the best have no weight.
_FAR = 60.0


class ScannedObjects(NamedTuple):
    """The data of n objects at nz redshifts; see `Target`."""

    first: np.ndarray  # int64 (n,): first redshift of the grid
    root: np.ndarray  # float32 (n, nz, n_padded): roots of the weights, the largest being 1
    data: np.ndarray  # float32 (n, nz, n_padded): flux over sigma, of norm 1
    norm: np.ndarray  # float64 (n, nz): |F|^2_w
    unit: np.ndarray  # float64 (n, nz): |F| over the largest root
    log_prior: np.ndarray  # float64 (n, nz): 2 ln(prior) of redshifts; -1e300 if it is 0
    level: np.ndarray  # float64 (n, nz): R + level is a constant less chi2


class ScannedGalaxies(NamedTuple):
    """Priors of the galaxies of a grid in single precision."""

    log_prior: np.ndarray  # float32 (nz, n_padded): 2 ln(prior), -1e30 of what may not be used
    prior: np.ndarray  # float32 (nz, n_padded): priors
    log_stars: (
        np.ndarray
    )  # float32 (nz, n_padded): log10 of the stellar mass of a galaxy of unit flux
    dust: (
        np.ndarray
    )  # float32 (nz, n_padded): the AGN power for c = 1 and unit flux, the largest being 1
    most_dust: np.ndarray  # float64 (nz,): these largest
    mass: np.ndarray  # float32 (nz, n): ln of the prior of mass, at most 0; see `Masses`
    most_mass: np.ndarray  # float64 (nz,): the largest of it
    per_dex: float  # values of it for a factor of ten


class ScanWork(NamedTuple):
    """Scratch of `scan_nodes`."""

    weighted: np.ndarray  # float32 (n_padded, BLOCK): of bands, padded
    rows: np.ndarray  # float32 (8 * BLOCK,)
    agn: np.ndarray  # float32 (nA, n_padded)
    agn_pq: np.ndarray  # float32 (nA, 2)


@njit(**PART)
def _weigh_agn(tables, objects, o, z, z_grid, work):
    """Put AGN models in units of the errors of an object, with their products."""
    root = objects.root[o, z]
    data = objects.data[o, z]
    for k in range(work.agn.shape[0]):
        a = np.float32(0)
        b = np.float32(0)
        for j in range(tables.agn32.shape[2]):
            t = tables.agn32[z_grid, k, j] * root[j]
            work.agn[k, j] = t
            a += t * data[j]
            b += t * t
        work.agn_pq[k, 0] = a
        work.agn_pq[k, 1] = b


@njit(**PART)
def _mass_priors(galaxies, z, start, log_unit, rows):
    """Put 2 ln(prior) of galaxies, with that of their masses without AGN; returned is the sum of the priors."""
    values = galaxies.mass[z]
    n_last = np.int32(len(values) - 2)
    last = np.float32(n_last + 1)
    zero = np.float32(0)
    one = np.float32(1)
    two = np.float32(2)
    per_dex = np.float32(galaxies.per_dex)
    log_stars = galaxies.log_stars[z, start : start + BLOCK]
    given = galaxies.log_prior[z, start : start + BLOCK]
    weight = galaxies.prior[z, start : start + BLOCK]
    for i in range(BLOCK):
        log_mass = log10_single(max(rows[_SCALE + i], _TINY)) + (log_unit + log_stars[i])
        rows[_PLACE + i] = min(max(log_mass * per_dex, zero), last)
    for i in range(BLOCK):
        k = min(np.int32(rows[_PLACE + i]), n_last)
        part = rows[_PLACE + i] - np.float32(k)
        rows[_PRIOR + i] = (one - part) * values[k] + part * values[k + 1]
    after = zero
    for i in range(BLOCK):
        after += weight[i] * exponential(max(rows[_PRIOR + i], -_MOST_POWER_OF_E))
    for i in range(BLOCK):
        rows[_PRIOR + i] = given[i] + two * rows[_PRIOR + i]
    return np.float64(after)


@njit(**PART)
def _products(tables, z, start, root, data, weighted, rows):
    """Products of galaxies with data and with themselves, and their fluxes over errors."""
    for i in range(BLOCK):
        rows[_P + i] = np.float32(0)
        rows[_Q + i] = np.float32(0)
    for j in range(tables.galaxy32.shape[1]):
        flux = tables.galaxy32[z, j, start : start + BLOCK]
        out = weighted[j]
        size = root[j]
        d = data[j]
        for i in range(BLOCK):
            t = flux[i] * size
            out[i] = t
            rows[_P + i] += t * d
            rows[_Q + i] += t * t


@njit(**PART)
def _cross_products(agn, weighted, rows):
    """Products of an AGN model with galaxies, `TOGETHER` bands at a time."""
    for i in range(BLOCK):
        rows[_CROSS + i] = np.float32(0)
    for j in range(0, agn.size, TOGETHER):
        row_0 = weighted[j]
        row_1 = weighted[j + 1]
        row_2 = weighted[j + 2]
        row_3 = weighted[j + 3]
        t_0 = agn[j]
        t_1 = agn[j + 1]
        t_2 = agn[j + 2]
        t_3 = agn[j + 3]
        for i in range(BLOCK):
            rows[_CROSS + i] += t_0 * row_0[i] + t_1 * row_1[i] + t_2 * row_2[i] + t_3 * row_3[i]


@njit(**PART)
def _log_prior_above(tables):
    """2 ln(prior) of all AGN fractions above 0, of which there is one at least."""
    total = 0.0
    for f in range(tables.of_frac.shape[1]):
        total += tables.of_frac[at.PRIOR_FRAC, f]
    return 2.0 * np.log(max(total, 1e-300))


@njit(**KERNEL)
def scan_nodes(tables, galaxies, objects, work, value, like, change):
    """
    Evaluate all galaxies without AGN, and with each AGN model at its best fraction, for several objects.

    Parameters
    ----------
    tables, galaxies, objects, work : `Tables`, `ScannedGalaxies`, `ScannedObjects`, `ScanWork`
        The models and n objects.
    value, like : `~numpy.ndarray` of float32, shape (n, nz, n_padded)
        Get 2 ln(posterior) of the best model of each galaxy, and the 2 ln(likelihood) in it.
    change : `~numpy.ndarray`, shape (n, nz)
        Gets ln of the sum of the galaxies' priors with that of mass.
    """
    n_agn = work.agn.shape[0]
    low = np.float32(0)
    high = np.float32(0)
    log_above = 0.0
    if tables.of_frac.shape[1] > 0:
        low = np.float32(0.0 if tables.zero_frac == 1 else tables.of_frac[at.RATIO, 0])
        high = np.float32(min(tables.of_frac[at.RATIO, tables.of_frac.shape[1] - 1], 1e9))
        log_above = _log_prior_above(tables)
    none = np.float32(0)
    zero = np.float32(tables.log_zero if tables.zero_frac == 1 else -1e30)
    rows = work.rows
    for z in range(objects.root.shape[1]):
        for o in range(objects.root.shape[0]):
            z_grid = objects.first[o] + z
            if objects.log_prior[o, z] < _NONE:
                value[o, z, :] = _NOWHERE
                like[o, z, :] = 0.0
                change[o, z] = 0.0
                continue
            _weigh_agn(tables, objects, o, z, z_grid, work)
            norm = np.float32(objects.norm[o, z])
            level = np.float32(objects.level[o, z])
            log_unit = np.float32(np.log10(max(objects.unit[o, z], 1e-300)))
            of_z = np.float32(objects.log_prior[o, z] + 2.0 * galaxies.most_mass[z_grid])
            after = 0.0
            for block in range(tables.tiles.shape[1]):
                start = block * BLOCK
                of_object = objects.root[o, z], objects.data[o, z]
                _products(tables, z_grid, start, *of_object, work.weighted, rows)
                for i in range(BLOCK):
                    p = max(rows[_P + i], none)
                    q = max(rows[_Q + i], _TINY)
                    rows[_Q + i] = q
                    rows[_SCALE + i] = p / q
                    # R
                    rows[_BEST + i] = norm * (p / q) * p
                    rows[_SCORE + i] = rows[_BEST + i] + zero
                after += _mass_priors(galaxies, z_grid, start, log_unit, rows)
                dust = galaxies.dust[z_grid, start : start + BLOCK]
                for k in range(n_agn):
                    _cross_products(work.agn[k], work.weighted, rows)
                    a = work.agn_pq[k, 0]
                    b = work.agn_pq[k, 1]
                    log_agn = np.float32(tables.of_agn[at.LOG_AGN, k] + log_above)
                    power = tables.agn_unit[z_grid, k] * galaxies.most_dust[z_grid]
                    most = np.float32(min(power, _MOST_POWER))
                    for i in range(BLOCK):
                        least_x = dust[i] * (most * low)
                        most_x = min(dust[i] * most * high, np.float32(_MOST_POWER))
                        x, r = best_mixture(
                            rows[_P + i],
                            rows[_Q + i],
                            rows[_CROSS + i],
                            a,
                            b,
                            least_x,
                            most_x,
                            _TINY,
                        )
                        r = r * norm if x > none else none
                        better = r + log_agn > rows[_SCORE + i]
                        rows[_SCORE + i] = r + log_agn if better else rows[_SCORE + i]
                        rows[_BEST + i] = r if better else rows[_BEST + i]
                out = value[o, z, start : start + BLOCK]
                out_like = like[o, z, start : start + BLOCK]
                for i in range(BLOCK):
                    out[i] = (rows[_SCORE + i] + level) + (rows[_PRIOR + i] + of_z)
                    out_like[i] = rows[_BEST + i] + level
            change[o, z] = np.log(max(after, 1e-300)) + galaxies.most_mass[z_grid]


@njit(**KERNEL)
def draw_nodes(value, like, less, of_redshift, index):
    """
    Draw galaxies in proportion to the posterior of their best models.

    Parameters
    ----------
    value, like : `~numpy.ndarray` of float32, shape (nz, n_padded)
        What `scan_nodes` returned for an object.
    less : float
        Part of the 2 ln(likelihood) that is taken away: 0 for the posterior itself.
    of_redshift : `~numpy.ndarray`, shape (nz,)
        Gets the sums over the galaxies of each redshift, which sum to 1.
    index : `~numpy.ndarray` of int, shape (n, 2)
        Gets redshift and galaxy of n draws, one from each nth part of the posterior.

    Returns
    -------
    possible : bool
        Whether any model may be used.
    """
    n_z, n_galaxies = value.shape
    factor = np.float32(less)
    top = np.float32(-3e38)
    for z in range(n_z):
        for g in range(n_galaxies):
            top = max(top, value[z, g] - factor * like[z, g])
    if top < np.float32(-1e29):
        return False
    half = np.float32(0.5)
    far = np.float32(-_FAR)
    whole = 0.0
    for z in range(n_z):
        total = np.float32(0)
        for g in range(n_galaxies):
            v = half * (value[z, g] - factor * like[z, g] - top)
            total += exponential(max(v, far))
        of_redshift[z] = total
        whole += total
    n = len(index)
    step = whole / n
    upto = 0.0
    draw = 0
    for z in range(n_z):
        last = upto + of_redshift[z]
        if draw < n and (draw + 0.5) * step <= last:
            reached = upto
            index[draw, 0] = z
            for g in range(n_galaxies):
                v = half * (value[z, g] - factor * like[z, g] - top)
                if v > far:
                    reached += exponential(v)
                    while draw < n and (draw + 0.5) * step <= reached:
                        index[draw, 0] = z
                        index[draw, 1] = g
                        draw += 1
            # rounding of sums in single precision
            while draw < n and (draw + 0.5) * step <= last:
                index[draw, 0] = z
                index[draw, 1] = index[max(draw - 1, 0), 1]
                draw += 1
        upto = last
    while draw < n:
        index[draw, 0] = index[draw - 1, 0]
        index[draw, 1] = index[draw - 1, 1]
        draw += 1
    for z in range(n_z):
        of_redshift[z] /= whole
    return True


@njit(**KERNEL)
def draw_agn(tables, target, part, first, pairs, uniform, weights, index, log_weight):
    """
    Draw AGN models and fractions of galaxies that were drawn.

    Parameters
    ----------
    tables, target : `Tables`, `Target`
        The models and the object.
    part : float
        Part of the 2 ln(likelihood) that counts.
    first : int
        First redshift of the grid.
    pairs : `~numpy.ndarray` of int, shape (n, 2)
        Redshift, from ``first`` on, and galaxy of each draw.
    uniform : `~numpy.ndarray`, shape (n,)
        Uniform numbers; where one is negative the best is taken.
    weights : `~numpy.ndarray`, shape (1 + nA * nf,)
        Scratch.
    index : `~numpy.ndarray` of int, shape (n, 4)
        Gets redshift, galaxy, AGN model (-1: none) and fraction.
    log_weight : `~numpy.ndarray`, shape (n,)
        Gets ln of the sum over AGN models and fractions, over the one value that `scan_nodes` has in its place.
    """
    n_frac = tables.of_frac.shape[1]
    log_above = 0.0
    least_ratio = 0.0
    most_ratio = 0.0
    if n_frac > 0:
        log_above = _log_prior_above(tables)
        least_ratio = 0.0 if tables.zero_frac == 1 else tables.of_frac[at.RATIO, 0]
        most_ratio = min(tables.of_frac[at.RATIO, n_frac - 1], 1e9)
    n_agn = tables.agn.shape[1] if n_frac > 0 else 0
    n_options = 1 + n_agn * n_frac
    for i in range(len(pairs)):
        z, g = pairs[i, 0], pairs[i, 1]
        galaxy = tables.galaxy[first + z, g]
        weight = target.weight[z]
        p = 0.0
        q = 0.0
        for j in range(weight.size):
            p += weight[j] * galaxy[j] * target.flux[j]
            q += weight[j] * galaxy[j] * galaxy[j]
        q = max(q, at.NO_LIGHT)
        weights[0] = -1e300
        if tables.zero_frac == 1:
            weights[0] = part * max(p, 0.0) ** 2 / q + tables.log_zero
        scanned = weights[0]
        dust = tables.of_galaxy[at.DUST, g]
        for k in range(n_agn):
            agn = tables.agn[first + z, k]
            a = 0.0
            b = 0.0
            t = 0.0
            for j in range(weight.size):
                wa = weight[j] * agn[j]
                a += wa * target.flux[j]
                b += wa * agn[j]
                t += wa * galaxy[j]
            least_x = least_ratio * dust
            most_x = most_ratio * dust
            x, r = best_mixture(p, q, t, a, b, least_x, most_x, at.NO_LIGHT)
            if x > 0.0:
                scanned = max(scanned, part * r + tables.of_agn[at.LOG_AGN, k] + log_above)
            for f in range(n_frac):
                x = tables.of_frac[at.RATIO, f] * dust
                r = max(p + x * a, 0.0) ** 2 / max(q + x * (2.0 * t + x * b), at.NO_LIGHT)
                prior = tables.of_agn[at.LOG_AGN, k] + tables.of_frac[at.LOG_FRAC, f]
                weights[1 + k * n_frac + f] = part * r + prior
        top = -1e300
        best = 0
        for m in range(n_options):
            if weights[m] > top:
                top = weights[m]
                best = m
        total = 0.0
        for m in range(n_options):
            weights[m] = exponential(max(0.5 * (weights[m] - top), -700.0))
            total += weights[m]
        log_weight[i] = 0.5 * (top - scanned) + np.log(total)
        chosen = 0
        reached = weights[0]
        while reached < uniform[i] * total and chosen + 1 < n_options:
            chosen += 1
            reached += weights[chosen]
        if uniform[i] < 0.0:
            chosen = best
        index[i, 0], index[i, 1] = z, g
        index[i, 2] = (chosen - 1) // n_frac if chosen > 0 else -1
        index[i, 3] = tables.zero_frac + (chosen - 1) % n_frac if chosen > 0 else 0


def make_scan_work(n_bands, n_agn):
    """Make the scratch of `scan_nodes`; the bands are padded."""
    return ScanWork(
        weighted=aligned(n_bands, BLOCK, dtype=np.float32),
        rows=aligned(8 * BLOCK, dtype=np.float32),
        agn=aligned(n_agn, n_bands, dtype=np.float32),
        agn_pq=aligned(n_agn, 2, dtype=np.float32),
    )
