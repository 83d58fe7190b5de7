"""What is known of the redshifts of a catalogue: values, or a density for each object."""

import astropy.units as u
import numpy as np

from miricigale.fitting.flags import FitFlags
from miricigale.fitting.posterior import cell_edges
from miricigale.utils.exceptions import argument_error
from miricigale.utils.units import to_array

__all__ = ["density_log_prior", "fixed_log_prior", "known_redshifts", "read_density"]


def known_redshifts(photometry, redshift):
    """
    Redshifts of a catalogue as an array.

    Parameters
    ----------
    photometry : `~astropy.table.Table`
        The catalogue of n objects.
    redshift : str or array_like
        One of its columns, or values: one, or n.

    Returns
    -------
    values : `~numpy.ndarray`, shape (n,)
        NaN where one is missing, masked, not finite or not positive.

    Raises
    ------
    ValueError
        If there is no such column, or the shape is another.
    """
    n = len(photometry)
    if isinstance(redshift, str):
        if redshift not in photometry.colnames:
            wanted = f"a column among {photometry.colnames}"
            raise argument_error("redshift", wanted, repr(redshift))
        redshift = photometry[redshift]
    values = _unmasked(redshift, "redshift")
    if values.ndim == 0:
        values = np.full(n, float(values))
    if values.shape != (n,):
        raise argument_error("redshift", f"{n} values", f"shape {values.shape}")
    with np.errstate(invalid="ignore"):
        good = np.isfinite(values) & (values > 0)
    return np.where(good, values, np.nan)


def read_density(redshift_prior, n):
    """
    Check densities of redshift.

    Parameters
    ----------
    redshift_prior : tuple
        Redshifts, shape (n_z,), ascending, and densities in redshift, shape (n_z,) for all
        objects or (n, n_z); straight lines join them, and they are 0 outside.
    n : int
        Number of objects.

    Returns
    -------
    nodes, density : `~numpy.ndarray`
        As given; densities that are masked are NaN.

    Raises
    ------
    ValueError
        If shapes do not agree, redshifts do not ascend or are masked, or a density is negative or
        infinite.
    """
    wanted = "(redshifts of shape (n_z,), densities of shape (n_z,) or (n, n_z))"
    if not (isinstance(redshift_prior, tuple) and len(redshift_prior) == 2):
        raise argument_error("redshift_prior", wanted, type(redshift_prior).__name__)
    nodes = _unmasked(redshift_prior[0], "redshift_prior[0]")
    density = _unmasked(redshift_prior[1], "redshift_prior[1]")
    shapes = f"shapes {nodes.shape} and {density.shape}"
    if nodes.ndim != 1 or nodes.size < 2 or density.shape not in (nodes.shape, (n, nodes.size)):
        raise argument_error("redshift_prior", wanted, shapes)
    if not np.all(np.diff(nodes) > 0) or not nodes[0] >= 0:
        raise argument_error("redshift_prior[0]", ">= 0 and ascending", f"{nodes}")
    if np.any(density < 0) or np.any(np.isinf(density)):
        raise argument_error("redshift_prior[1]", "finite and not negative", "others")
    return nodes, density


def _unmasked(value, name):
    """Numbers as an array, NaN where they are masked."""
    mask = np.asarray(getattr(value, "mask", False))
    array = to_array(getattr(value, "unmasked", value), u.dimensionless_unscaled, name)
    return np.where(mask, np.nan, array)


def density_log_prior(redshift_prior, grid_redshift, allowed, flags):
    """
    ln(prior) of the redshifts of a grid, from a density for each object.

    The prior of a redshift is the integral of the density over its cell, as a share of the whole
    density: what lies outside the grid is missing from the evidence.

    Parameters
    ----------
    redshift_prior : tuple
        As for `read_density`.
    grid_redshift : `~numpy.ndarray`, shape (nz,)
        Redshifts of the grid.
    allowed : `~numpy.ndarray` of bool, shape (nz,)
        Whether there are models at that redshift.
    flags : `~numpy.ndarray` of int, shape (n,)
        Densities that are masked, hold NaN or sum to 0 are flagged here as ``NO_REDSHIFT``, those that leave
        nothing of the grid as ``NO_MODEL``.

    Returns
    -------
    log_prior : `~numpy.ndarray`, shape (n, nz)
    """
    n = flags.size
    nodes, density = read_density(redshift_prior, n)
    density = np.broadcast_to(density, (n, nodes.size))
    rise = 0.5 * (density[:, 1:] + density[:, :-1]) * np.diff(nodes)
    total = np.concatenate([np.zeros((n, 1)), np.cumsum(rise, axis=1)], axis=1)
    if grid_redshift.size == 1:
        edges = np.array([nodes[0], nodes[-1]])
    else:
        edges = np.clip(cell_edges(grid_redshift, (0.0, np.inf)), nodes[0], nodes[-1])
    cell = np.clip(np.searchsorted(nodes, edges, side="right") - 1, 0, nodes.size - 2)
    step = edges - nodes[cell]
    slope = (density[:, cell + 1] - density[:, cell]) / (nodes[cell + 1] - nodes[cell])
    upto = total[:, cell] + step * (density[:, cell] + 0.5 * slope * step)
    weights = np.maximum(np.diff(upto, axis=1), 0.0)
    whole = total[:, -1:]
    known = np.isfinite(whole[:, 0]) & (whole[:, 0] > 0)
    flags[~known] |= int(FitFlags.NO_REDSHIFT)
    with np.errstate(divide="ignore", invalid="ignore"):
        out = np.where(allowed & known[:, None], np.log(weights / whole), -np.inf)
    flags[known & ~np.isfinite(out).any(axis=1)] |= int(FitFlags.NO_MODEL)
    return out


def fixed_log_prior(values, grid_redshift, allowed, tolerance, flags):
    """
    ln(prior) of the redshifts of a grid where they are known: 0 at the nearest, else -inf.

    Parameters
    ----------
    values : `~numpy.ndarray`, shape (n,)
        From `known_redshifts`.
    grid_redshift, allowed : `~numpy.ndarray`, shape (nz,)
        As for `density_log_prior`.
    tolerance : float or None
        Largest abs(dz) / (1 + z) to the nearest redshift of the grid; None: half a cell.
    flags : `~numpy.ndarray` of int, shape (n,)
        Redshifts that are missing, too far from the grid, or without a model are flagged here.

    Returns
    -------
    log_prior : `~numpy.ndarray`, shape (n, nz)
    """
    n, z = values.size, grid_redshift
    missing = np.isnan(values)
    safe = np.where(missing, z[0], values)
    node = np.argmin(np.abs(np.log1p(safe)[:, None] - np.log1p(z)), axis=1)
    apart = np.abs(safe - z[node]) / (1.0 + safe)
    if tolerance is not None:
        limit = np.full(n, tolerance)
    else:
        edges = np.log1p(cell_edges(z, (0.0, np.inf)))
        limit = 1.001 * (edges[node + 1] - edges[node]) / 2.0 + 1e-6
        limit = np.maximum(limit, 1e-3 if z.size == 1 else 0.0)
    outside = ~missing & (apart > limit)
    flags[missing] |= int(FitFlags.NO_REDSHIFT)
    flags[outside] |= int(FitFlags.REDSHIFT_OUTSIDE)
    out = np.full((n, z.size), -np.inf)
    out[np.arange(n), node] = np.where(allowed[node], 0.0, -np.inf)
    out[missing | outside] = -np.inf
    flags[~missing & ~outside & ~np.isfinite(out).any(axis=1)] |= int(FitFlags.NO_MODEL)
    return out
