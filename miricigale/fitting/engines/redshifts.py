"""What is known of the redshifts of a catalogue, as parameters of its objects."""

import numpy as np

from miricigale.fitting.engines.space import Flat, Table
from miricigale.fitting.flags import FitFlags
from miricigale.fitting.redshifts import known_redshifts, read_density

__all__ = ["fixed_redshifts", "given_redshifts"]


def fixed_redshifts(space, limits, photometry, redshift, flags):
    """
    Fix the redshift of every object.

    Parameters
    ----------
    space : `~miricigale.fitting.engines.space.Space`
        Parameters of all objects.
    limits : tuple of float
        Least and largest redshift.
    photometry : `~astropy.table.Table`
        The catalogue of n objects.
    redshift : str or array_like
        One of its columns, or values.
    flags : `~numpy.ndarray` of int, shape (n,)
        Redshifts that cannot be used are flagged here.

    Returns
    -------
    spaces : list of `~miricigale.fitting.engines.space.Space`
    """
    values = known_redshifts(photometry, redshift)
    missing = np.isnan(values)
    low, high = limits
    with np.errstate(invalid="ignore"):
        outside = ~missing & ~((values >= low) & (values <= high))
    flags[missing] |= int(FitFlags.NO_REDSHIFT)
    flags[outside] |= int(FitFlags.REDSHIFT_OUTSIDE)
    good = np.where(missing | outside, 0.5 * (low + high), values)
    return [space.with_prior("redshift", float(z)) for z in good]


def given_redshifts(space, limits, n, redshift_prior, flags):
    """
    Give every object its own prior of redshift.

    Parameters
    ----------
    space, limits, flags : object
        As for `fixed_redshifts`; a prior that leaves nothing is flagged.
    n : int
        Number of objects.
    redshift_prior : tuple
        Redshifts, shape (n_z,), and densities, shape (n_z,) or (n, n_z).

    Returns
    -------
    spaces : list of `~miricigale.fitting.engines.space.Space`
    """
    nodes, pdf = read_density(redshift_prior, n)
    out = []
    for row in range(n):
        density = pdf if pdf.ndim == 1 else pdf[row]
        table = None
        if np.isfinite(density).all():
            table = Table(nodes, np.array(density)).cut(*limits)
        if table is None:
            flags[row] |= int(FitFlags.NO_MODEL)
            table = Flat(*limits)
        out.append(space.with_prior("redshift", table))
    return out
