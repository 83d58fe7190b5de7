"""What the kernels take: accumulators and work space of one worker, data of one object."""

import math

import numpy as np
from scipy.special import log_ndtr

from miricigale.fitting._core import structs as at
from miricigale.fitting._core.histogram import KERNEL_SIZE, N_BINS, N_SHARE, clear_rows
from miricigale.fitting._core.limits import LIMITED_SIZE
from miricigale.fitting._core.mixture import Few
from miricigale.fitting._core.pairs import GROUP, ROWS
from miricigale.fitting._core.single import single_size
from miricigale.fitting._core.structs import (
    BLOCK,
    Draws,
    Histograms,
    Joint,
    Lanes,
    Limits,
    Pairs,
    Sums,
    Target,
)

#: Joint sums that can be asked for: of redshift, galaxy, AGN model and fraction.
JOINT = Joint._fields
# Bytes of a cache line, and numbers in it.
_LINE = 64
_PER_LINE = 8


def make_sums(n_z, n_galaxy, n_agn, n_frac, n_bands, n_draws=0, joint=()):
    """Make the accumulators of one object for a grid of the given size."""
    size = {"z": n_z, "g": n_galaxy, "k": n_agn, "f": n_frac}
    rows = n_galaxy + max(n_agn, 1) + 1
    flat, parts = _cut(
        zf=(n_z, n_frac),
        galaxy=(n_galaxy, 3),
        agn=(max(n_agn, 1), 3),
        alone=(n_galaxy,),
        band=(2, n_bands),
        total=(7,),
        **{name: (size[name[0]], size[name[1]]) if name in joint else (0, 0) for name in JOINT},
    )
    _, hist = _cut(table=(rows, N_BINS), share=(N_SHARE + 2,), work=(5, N_BINS + KERNEL_SIZE))
    return Sums(
        flat=flat,
        joint=Joint(**{name: parts.pop(name) for name in JOINT}),
        **parts,
        best=np.zeros(3),
        index=np.full(4, -1),
        hist=Histograms(
            **hist,
            span=np.tile(np.array([[N_BINS, -1]]), (rows, 1)),
            origin=np.zeros(3),
        ),
        draws=Draws(
            next=np.zeros(n_draws),
            index=np.full((n_draws, 4), -1),
            scale=np.zeros((n_draws, 2)),
            state=np.zeros(1, np.uint64),
        ),
    )


def _cut(**shapes):
    """Make an array of zeros and name parts of it."""
    sizes = [math.prod(shape) for shape in shapes.values()]
    # each begins at a cache line
    ends = np.cumsum([-(-size // _PER_LINE) * _PER_LINE for size in sizes])
    flat = aligned(ends[-1])
    pieces = np.split(flat, ends[:-1])
    named = zip(shapes.items(), sizes, pieces, strict=True)
    return flat, {name: piece[:size].reshape(shape) for (name, shape), size, piece in named}


def aligned(*shape, dtype=np.float64):
    """Make an array of zeros that begins at a cache line, which doubles the speed of some loops."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    flat = np.zeros(size + _LINE, np.uint8)
    start = -flat.ctypes.data % _LINE
    return flat[start : start + size].view(dtype).reshape(shape)


def make_workspace(n_z, n_galaxy, n_agn, n_frac, n_bands, zero_frac, capacity):
    """Make the work space for a grid of the given size; ``capacity`` runs are listed at once."""
    n_blocks = -(-n_galaxy // BLOCK)
    n_padded = n_blocks * BLOCK
    # a list that can hold every run needs no more space
    capacity = max(min(int(capacity), n_z * n_blocks * n_agn), 2 * max(n_agn, 1))
    single = np.float32
    return Pairs(
        run_key=np.empty(capacity, np.int64),
        bound=aligned(capacity, BLOCK, dtype=single),
        top=aligned(capacity, dtype=single),
        promise=aligned(n_z),
        order=np.zeros(n_z, np.int64),
        galaxy_of=np.zeros(n_z, np.int64),
        p32=aligned(n_z, n_padded, dtype=single),
        inverse_norm=aligned(n_z, n_padded, dtype=single),
        tail_galaxy=aligned(n_padded, dtype=single),
        tail_agn=aligned(n_agn, dtype=single),
        agn_pq=aligned(n_agn, 2),
        agn_weighted=aligned(n_agn, n_bands),
        unit_agn=aligned(-(-n_agn // GROUP) * GROUP, n_bands + 2, dtype=single),
        agn32=aligned(2, n_agn, dtype=single),
        unit_galaxy=aligned(n_bands + 2, BLOCK, dtype=single),
        rows=aligned(ROWS * BLOCK, dtype=single),
    ), Lanes(
        buffer=aligned(at.SIZE),
        single=aligned(single_size(n_frac), dtype=single),
        index=np.zeros((2, BLOCK), np.int64),
        weight=aligned(n_frac * BLOCK),
        frac_sum=aligned(n_frac - zero_frac),
        pq=aligned(2, n_padded),
        products_at=np.zeros(n_blocks, np.int64),
        galaxy_z=aligned(3, n_padded),
        agn_z=aligned(3, n_agn),
        limited=aligned(LIMITED_SIZE),
        limited32=aligned(LIMITED_SIZE, dtype=single),
        limit_share=aligned(n_frac * BLOCK),
        limit=aligned(2 * n_bands, BLOCK),
        limit32=aligned(2 * n_bands, BLOCK, dtype=single),
    )


def clear(sums):
    """Empty the accumulators."""
    hist = sums.hist
    draws = sums.draws
    for array in (sums.flat, sums.best, hist.share, draws.next):
        array.fill(0.0)
    sums.index.fill(-1)
    draws.index[:, 0] = -1
    clear_rows(hist.table, hist.span)


def make_target(flux, sigma, log_prior, template_error):
    """Bundle the data of one object; ``template_error`` is a part of the flux, shape (nz, nb)."""
    square = np.square(sigma)
    model_square = np.square(template_error * flux)
    level = -np.log1p(model_square / square).sum(axis=1)
    bands = np.flatnonzero(np.isfinite(sigma))
    return weighed(flux, 1.0 / (square + model_square), level, log_prior, bands)


def weighed(flux, weight, level, log_prior, bands):
    """Bundle data with weights of their own, shape (nz, nb); ``level`` is added to -chi2 at each redshift."""
    # C order, also of several redshifts: kernels are compiled once
    used_weight = np.take(weight, bands, axis=1)
    norm = np.sum(weight * flux * flux, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        root32 = np.sqrt(used_weight / used_weight.max(axis=1, keepdims=True, initial=0.0)).astype(
            np.float32
        )
        data32 = (flux[bands] * np.sqrt(used_weight / norm[:, None])).astype(np.float32)
    level = level - norm
    top = level.max()
    # at most 0: errors that are the same at all redshifts change nothing
    level -= top
    log_prior = np.where(log_prior > -1e200, log_prior + level, -1e300)
    return Target(flux, weight, log_prior, bands, root32, data32, norm, level, -float(top))


def make_limits(limit, inverse, wrong):
    """Bundle the upper limits of one object, wrong by these prior fractions; None if it has none."""
    bands = np.flatnonzero(inverse > 0)
    if bands.size == 0:
        return None
    level = limit[bands] * inverse[bands]
    log = log_ndtr(level)
    if wrong is None:
        # an array all the same: kernels are compiled once
        wrong = np.zeros(bands.size)
    else:
        wrong = wrong[bands]
        log = np.log((1.0 - wrong) * np.exp(log) + wrong, where=wrong > 0, out=log)
    dark = float(-2.0 * log.sum())
    return Limits(bands, level, inverse[bands], np.empty(bands.size), dark, wrong)


def make_few(index, flux, ratio):
    """Bundle galaxies with work space for `find_models`."""
    (n_bands, n) = flux.shape[1:]
    n_agn = ratio.shape[1]
    shapes = (n_bands, n), (n_agn, n_bands), (n_agn + 2, n), (4, n)
    work = [aligned(*shape, dtype=np.float32) for shape in shapes]
    return Few(index, flux, ratio, *work, aligned(n_bands), aligned(n_bands))
