"""The tables of the grid engine's kernels."""

import numpy as np

from miricigale.fitting import _core
from miricigale.fitting._core.bounds import BLOCK
from miricigale.fitting.posterior import cell_edges

__all__ = ["make_tables"]


def make_tables(engine):
    """
    Lay out a model grid and its priors for the kernels.

    Parameters
    ----------
    engine : `~miricigale.fitting.engines.grid.GridEngine`
        Fluxes, priors and scales.

    Returns
    -------
    tables : `~miricigale.fitting._core.Tables`
    """
    n_z, n_galaxy, n_bands = engine.galaxy.shape
    n_padded = -(-n_galaxy // BLOCK) * BLOCK
    galaxy32 = np.ones((n_z, n_bands, n_padded), np.float32)
    tiles = np.ones((n_z, n_padded // BLOCK, n_bands, BLOCK))
    unit = _unit(engine.galaxy)
    galaxy32[:, :, :n_galaxy] = (engine.galaxy / unit).transpose(0, 2, 1)
    for start in range(0, n_galaxy, BLOCK):
        part = engine.galaxy[:, start : start + BLOCK].transpose(0, 2, 1)
        tiles[:, start // BLOCK, :, : part.shape[2]] = part
    above = engine.frac > 0
    ratio = _ratio(engine.frac[above])
    edge = _ratio(cell_edges(engine.frac, (0.0, 1.0)))
    log_dust = np.log10(engine.dust, where=engine.dust > 0, out=np.full(n_galaxy, -400.0))
    prior_galaxy = engine.prior_galaxy / engine.prior_galaxy.sum()
    prior_frac = engine.prior_frac / engine.prior_frac.sum()
    prior_agn = engine.prior_agn / max(engine.prior_agn.sum(), 1e-300)
    share_galaxy, share_agn = engine.share_galaxy, engine.share_agn
    if share_galaxy is None or share_agn is None:
        share_galaxy, share_agn = np.zeros(n_galaxy), np.zeros(engine.agn.shape[1])
    rows = (engine.dust, _two_log(prior_galaxy), share_galaxy, engine.mixed_galaxy)
    blocks = np.zeros((4, n_padded))
    blocks[:, :n_galaxy] = rows
    blocks = blocks.reshape(4, n_padded // BLOCK, BLOCK)
    log_usable = np.full((n_z, n_padded), -1e300)
    log_usable[:, :n_galaxy] = np.where(engine.usable, _two_log(prior_galaxy), -1e300)
    # all writable, for the kernels are compiled once more for arrays that are not
    return _core.Tables(
        galaxy=_writable(engine.galaxy),
        agn=_writable(engine.agn),
        tiles=tiles,
        blocks=blocks,
        galaxy32=galaxy32,
        agn32=np.ascontiguousarray((engine.agn / _unit(engine.agn)).astype(np.float32)),
        galaxy_unit=_writable(unit[:, :, 0]),
        dust=_writable(engine.dust),
        ratio=ratio,
        zero_frac=int(engine.frac[0] == 0.0),
        usable=_writable(engine.usable),
        log_usable=log_usable,
        prior_agn=prior_agn,
        prior_frac=prior_frac,
        log_galaxy=_two_log(prior_galaxy),
        log_agn=_two_log(prior_agn),
        log_frac=_two_log(prior_frac),
        galaxy_scale=_writable(engine.galaxy_scale),
        agn_scale=_writable(engine.agn_scale),
        mixed_galaxy=_writable(engine.mixed_galaxy),
        mixed_agn=_writable(engine.mixed_agn),
        points=_core.PointTables(
            ratio=ratio,
            log_ratio=np.log10(ratio) * _core.PER_DEX,
            edge=_writable(np.column_stack([edge[:-1], edge[1:]])[above]),
            edge_zero=float(edge[1]),
            dust=_writable(engine.dust),
            log_dust=log_dust,
            mixed_galaxy=_writable(engine.mixed_galaxy),
            mixed_agn=_writable(engine.mixed_agn),
            share_galaxy=_writable(share_galaxy),
            share_agn=_writable(share_agn),
            share_mean=float(prior_agn @ share_agn),
        ),
    )


def _unit(table):
    """Largest flux of every model, shape (nz, n, 1); 1 where there is none."""
    top = table.max(axis=-1, keepdims=True, initial=0.0)
    return np.where(top > 0, top, 1.0)


def _ratio(frac):
    """Odds f / (1 - f), of 1 a large number."""
    return frac / np.maximum(1.0 - frac, 1e-12)


def _writable(array):
    """Copy an array to a contiguous one that may be written to."""
    return np.array(array, dtype=np.asarray(array).dtype, order="C", copy=True)


def _two_log(prior):
    """Return 2 ln(prior), -1e300 where it is zero."""
    return 2.0 * np.log(prior, where=prior > 0, out=np.full(prior.shape, -5e299))
