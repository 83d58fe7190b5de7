"""What the pairs in the lanes add to the sums over all models."""

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.lanes import (
    DUST,
    F1,
    F2,
    LANES,
    PRIOR,
    U2,
    V1,
    V2,
    W0,
    W1,
    W2,
    WR,
    WZ,
)
from miricigale.fitting._core.light import pair_weight
from miricigale.fitting._core.options import INNER, ONCE
from miricigale.utils.compilation import njit

__all__ = ["add_all", "add_block", "add_gathered", "add_joint", "finish_redshift"]


@njit(**INNER)
def finish_redshift(tiles, fluxes, galaxy_z, agn_z, galaxy, agn, band, zg, zk, z):
    """
    Add what was summed up over one redshift to the sums over all.

    ``tiles`` and ``fluxes`` are those of galaxies and tori, ``galaxy_z`` and ``agn_z`` are emptied,
    the others are filled; see `miricigale.fitting._core.structs`.
    """
    n_bands = band.shape[1]
    n_galaxy = galaxy.shape[0]
    for block in range(galaxy_z.shape[1]):
        used = 0.0
        for i in range(BLOCK):
            used = max(used, galaxy_z[0, block, i])
        if not used > 0.0:
            continue
        for i in range(min(BLOCK, n_galaxy - block * BLOCK)):
            g = block * BLOCK + i
            galaxy[g, 0] += galaxy_z[0, block, i]
            galaxy[g, 1] += galaxy_z[1, block, i]
            galaxy[g, 2] += galaxy_z[2, block, i]
            if zg.size > 0:
                zg[z, g] += galaxy_z[0, block, i]
        for b in range(n_bands):
            first = 0.0
            second = 0.0
            for i in range(BLOCK):
                t = tiles[z, block, b, i]
                first += galaxy_z[1, block, i] * t
                second += galaxy_z[2, block, i] * t * t
            band[0, b] += first
            band[1, b] += second
    for k in range(agn_z.shape[0]):
        if not agn_z[k, 0] > 0.0:
            continue
        for m in range(3):
            agn[k, m] += agn_z[k, m]
        if zk.size > 0:
            zk[z, k] += agn_z[k, 0]
        for b in range(n_bands):
            t = fluxes[z, k, b]
            band[0, b] += agn_z[k, 1] * t
            band[1, b] += agn_z[k, 2] * t * t
    for block in range(galaxy_z.shape[1]):
        for m in range(3):
            for i in range(BLOCK):
                galaxy_z[m, block, i] = 0.0
    for k in range(agn_z.shape[0]):
        for m in range(3):
            agn_z[k, m] = 0.0


@njit(**ONCE)
def add_all(buffer, frac_sum, zf, z, first, total, best):
    """Add what needs no index; returns the weight of all pairs in the lanes."""
    for j in range(frac_sum.size):
        zf[z, j + first] += frac_sum[j]
    weight = 0.0
    total_r = 0.0
    total_zero = 0.0
    share_1 = 0.0
    share_2 = 0.0
    n_alive = 0.0
    for i in range(LANES):
        weight += buffer[W0 + i]
        total_r += buffer[WR + i]
        total_zero += buffer[WZ + i]
        share_1 += buffer[F1 + i]
        share_2 += buffer[F2 + i]
        n_alive += 1.0 if buffer[PRIOR + i] > -1e200 else 0.0
    total[0] += weight
    total[1] += total_r
    total[2] += total_zero
    total[4] += share_1
    total[5] += share_2
    best[3] += n_alive * frac_sum.size
    return weight


@njit(**ONCE)
def add_block(buffer, tiles, blocks, agn, mixed_agn, z, block, k, galaxy_z, agn_z, band, total):
    """Add a block of galaxies with one torus."""
    for i in range(LANES):
        galaxy_z[0, block, i] += buffer[W0 + i]
        galaxy_z[1, block, i] += buffer[W1 + i]
        galaxy_z[2, block, i] += buffer[W2 + i]
        # from here on the correlation of galaxy and AGN
        buffer[U2 + i] *= buffer[DUST + i]
    # sums apart from stores: see `agn_products`
    y0 = 0.0
    y1 = 0.0
    y2 = 0.0
    total_cross = 0.0
    for i in range(LANES):
        dust = buffer[DUST + i]
        y0 += buffer[W0 + i]
        y1 += buffer[V1 + i] * dust
        y2 += buffer[V2 + i] * dust * dust
        total_cross += buffer[U2 + i] * blocks[3, block, i]
    total[3] += total_cross * mixed_agn[k]
    agn_z[k, 0] += y0
    agn_z[k, 1] += y1
    agn_z[k, 2] += y2
    n = band.shape[1]
    m = 0
    while m + 3 <= n:
        t0 = 0.0
        t1 = 0.0
        t2 = 0.0
        for i in range(LANES):
            u = buffer[U2 + i]
            t0 += u * tiles[z, block, m, i]
            t1 += u * tiles[z, block, m + 1, i]
            t2 += u * tiles[z, block, m + 2, i]
        band[1, m] += 2.0 * t0 * agn[z, k, m]
        band[1, m + 1] += 2.0 * t1 * agn[z, k, m + 1]
        band[1, m + 2] += 2.0 * t2 * agn[z, k, m + 2]
        m += 3
    while m < n:
        t0 = 0.0
        for i in range(LANES):
            t0 += buffer[U2 + i] * tiles[z, block, m, i]
        band[1, m] += 2.0 * t0 * agn[z, k, m]
        m += 1


@njit(**ONCE)
def add_gathered(
    buffer, index, galaxy, agn, mixed_galaxy, mixed_agn, z, galaxy_z, agn_z, band, total, least
):
    """
    Add gathered pairs.

    Those of a weight below ``least`` are left out of the correlation of galaxy and AGN in model
    fluxes, and of nothing else.
    """
    total_cross = 0.0
    for i in range(LANES):
        w = buffer[W0 + i]
        if not w > 0.0 or buffer[PRIOR + i] < -1e200:
            continue
        g, k = index[0, i], index[1, i]
        block = g // BLOCK
        slot = g % BLOCK
        dust = buffer[DUST + i]
        cross = buffer[U2 + i] * dust
        total_cross += cross * mixed_galaxy[g] * mixed_agn[k]
        galaxy_z[0, block, slot] += w
        galaxy_z[1, block, slot] += buffer[W1 + i]
        galaxy_z[2, block, slot] += buffer[W2 + i]
        agn_z[k, 0] += w
        agn_z[k, 1] += buffer[V1 + i] * dust
        agn_z[k, 2] += buffer[V2 + i] * dust * dust
        if w > least:
            cross *= 2.0
            for m in range(band.shape[1]):
                band[1, m] += cross * galaxy[z, g, m] * agn[z, k, m]
    total[3] += total_cross


@njit(**ONCE)
def add_joint(gk, fg, fk, lanes, single, first, n_ratio):
    """Add to the joint sums that were asked for."""
    buffer, index = lanes.buffer, lanes.index
    for i in range(LANES):
        w = buffer[W0 + i]
        if not w > 0.0 or buffer[PRIOR + i] < -1e200:
            continue
        g, k = index[0, i], index[1, i]
        if gk.size > 0:
            gk[g, k] += w
        for j in range(n_ratio):
            if fg.size > 0:
                fg[j + first, g] += pair_weight(lanes, single, j, i)
            if fk.size > 0:
                fk[j + first, k] += pair_weight(lanes, single, j, i)
