"""Accumulators and work space of one worker."""

import math

import numpy as np

from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting._core.floors import N_LEVELS
from miricigale.fitting._core.histogram import N_BINS, N_SHARE, POINTS, clear_rows
from miricigale.fitting._core.lanes import LANES, N_INPUT, SIZE
from miricigale.fitting._core.light import light_size
from miricigale.fitting._core.limited_scales import LIMITED_SIZE
from miricigale.fitting._core.options import EXACT
from miricigale.fitting._core.structs import Draws, Histograms, Lanes, Scratch, Sums
from miricigale.utils.compilation import njit

__all__ = ["JOINT", "clear", "make_scratch", "make_sums", "rescale"]

#: Joint sums that can be asked for: of redshift, galaxy, torus and fraction.
JOINT = ("zg", "zk", "gk", "fg", "fk")


def make_sums(n_z, n_galaxy, n_agn, n_frac, n_bands, n_draws=0, joint=()):
    """Make the accumulators of one object for a grid of the given size."""
    size = {"z": n_z, "g": n_galaxy, "k": n_agn, "f": n_frac}
    shapes = {
        "zf": (n_z, n_frac),
        "galaxy": (n_galaxy, 3),
        "agn": (max(n_agn, 1), 3),
        "alone": (n_galaxy,),
        "band": (2, n_bands),
    }
    for name in JOINT:
        shapes[name] = (size[name[0]], size[name[1]]) if name in joint else (0, 0)
    shapes["total"] = (6,)
    flat, parts = _cut(shapes)
    return Sums(
        flat=flat,
        **parts,
        best=np.zeros(4),
        index=np.full(4, -1),
        hist=_make_histograms(n_galaxy, max(n_agn, 1)),
        draws=Draws(
            next=np.zeros(n_draws),
            index=np.full((n_draws, 4), -1),
            scale=np.zeros((n_draws, 2)),
            state=np.zeros(1, np.uint64),
        ),
    )


def _make_histograms(n_galaxy, n_agn):
    shapes = {
        "galaxy": (n_galaxy, N_BINS),
        "agn": (n_agn, N_BINS),
        "mixed": (1, N_BINS),
        "share": (N_SHARE + 2,),
        "carry": (1,),
    }
    flat, parts = _cut(shapes)
    ranges = [np.tile(np.array([[N_BINS, -1]]), (n, 1)) for n in (n_galaxy, n_agn, 1)]
    return Histograms(
        flat=flat,
        **parts,
        range_galaxy=ranges[0],
        range_agn=ranges[1],
        range_mixed=ranges[2],
        origin=np.zeros(3),
        point=np.zeros((3, POINTS), np.int64),
        weight=np.zeros(POINTS),
        values=np.zeros(2 * POINTS),
        logs=np.zeros(2 * POINTS),
        power=np.zeros(2 * POINTS, np.int64),
    )


def _cut(shapes):
    """Make an array of zeros and name parts of it."""
    sizes = [math.prod(shape) for shape in shapes.values()]
    flat = np.zeros(sum(sizes))
    pieces = np.split(flat, np.cumsum(sizes)[:-1])
    named = zip(shapes.items(), pieces, strict=True)
    return flat, {name: piece.reshape(shape) for (name, shape), piece in named}


def make_scratch(n_z, n_galaxy, n_agn, n_frac, n_bands, n_quantities, zero_frac, capacity):
    """Make the work space for a grid of the given size; ``capacity`` runs are listed at once."""
    n_blocks = -(-n_galaxy // BLOCK)
    n_padded = n_blocks * BLOCK
    # a list that can hold every run needs no more room
    capacity = max(min(int(capacity), n_z * n_blocks * n_agn), 2 * max(n_agn, 1))
    return Scratch(
        run_key=np.empty(capacity, np.int64),
        bound=np.empty((capacity, BLOCK), np.float32),
        order=np.zeros(n_z, np.int64),
        promise=np.zeros(n_z),
        reference=np.zeros(1),
        count=np.zeros(N_LEVELS + 1),
        p32=np.empty((n_z, n_padded), np.float32),
        inverse_norm=np.empty((n_z, n_padded), np.float32),
        tail_galaxy=np.zeros((n_z, n_padded), np.float32),
        tail_agn=np.zeros((n_z, n_agn), np.float32),
        pq=np.zeros((2, n_blocks, BLOCK)),
        known=np.zeros(n_blocks, np.int64),
        agn_weighted=np.zeros((n_agn, n_bands)),
        agn_pq=np.zeros((n_agn, 2)),
        cross=np.zeros((2, BLOCK)),
        run=np.zeros(BLOCK, np.int64),
        galaxy_z=np.zeros((3, n_blocks, BLOCK)),
        agn_z=np.zeros((n_agn, 3)),
        mean=np.zeros(n_quantities),
        variance=np.zeros(n_quantities),
        widest_galaxy=np.zeros(n_galaxy),
        widest_agn=np.zeros(n_agn),
        lanes=Lanes(
            buffer=np.zeros(SIZE),
            light=np.zeros(light_size(n_frac), np.float32),
            limited=np.zeros(LIMITED_SIZE),
            left=np.ones(n_frac * LANES),
            pending=np.zeros(N_INPUT * LANES),
            power=np.zeros(LANES, np.int64),
            power32=np.zeros(LANES, np.int32),
            index=np.zeros((4, LANES), np.int64),
            limit=np.zeros((2 * n_bands, LANES)),
            limit_light=np.zeros((2 * n_bands, LANES), np.float32),
            pending_limit=np.zeros((2 * n_bands, LANES)),
            weight=np.zeros(n_frac * LANES),
            frac_sum=np.zeros(max(n_frac - zero_frac, 1)),
            slope=np.zeros(n_bands),
        ),
    )


def clear(sums):
    """Empty the accumulators."""
    hist, draws = sums.hist, sums.draws
    for array in (sums.flat, sums.best, hist.carry, hist.share, draws.next):
        array.fill(0.0)
    sums.index.fill(-1)
    draws.index[:, 0] = -1
    clear_rows(hist.galaxy, hist.range_galaxy)
    clear_rows(hist.agn, hist.range_agn)
    clear_rows(hist.mixed, hist.range_mixed)


@njit(**EXACT)
def _multiply(x, factor):
    for i in range(x.size):
        x[i] *= factor


@njit(**EXACT)
def rescale(flat, histograms, draws, galaxy_z, agn_z, factor):
    """Multiply all weights, when a better model becomes the reference."""
    _multiply(flat, factor)
    _multiply(histograms, factor)
    _multiply(draws, factor)
    _multiply(galaxy_z.reshape(galaxy_z.size), factor)
    _multiply(agn_z.reshape(agn_z.size), factor)
