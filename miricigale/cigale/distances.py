"""Results at the distances of the objects, where the models are at the next redshift of a grid."""

import dataclasses

import astropy.units as u
import numpy as np

from miricigale.sed.cosmology import distance
from miricigale.utils.units import to_array


def at_their_distances(results, redshift, distances, cosmology):
    """
    Scale masses and luminosities from the distance of the models to that of the objects.

    Fluxes were compared with models at a node of the grid near the object's redshift. What was found of
    the shape of the spectrum stays; all that scales with mass is multiplied by (d / d_node)^2 (1 + z_node) /
    (1 + z), as CIGALE does: 0.23 dex for z = 0.0153 at the node 0.02.

    Parameters
    ----------
    results : `~miricigale.fitting.FitResults`
        Results at nodes.
    redshift : `~numpy.ndarray`, shape (n,)
        Redshifts of the objects; NaN or 0 where the node is the redshift.
    distances : `~astropy.units.Quantity`, shape (n,), or None
        Distances that are used in place of those of the redshifts; NaN where there is none.
    cosmology : `~astropy.cosmology.Cosmology`
        For the distances of redshifts.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
        Their ``best["redshift"]`` is that of the object where it is known, and ``distance`` the given one.
    """
    node = np.full(len(results), results.constants.get("redshift", np.nan))
    node = np.asarray(results.best.get("redshift", node), dtype=float)
    node = np.where(results.fitted, node, np.nan)
    has_distance = np.isfinite(redshift) & (redshift > 0) & np.isfinite(node)
    z = np.where(has_distance, redshift, node)
    distance_of = distance(np.where(np.isfinite(z), z, 0.0), cosmology)
    distance_of_node = distance(np.where(np.isfinite(node), node, 0.0), cosmology)
    stated_distance = None
    if distances is not None:
        stated_distance = to_array(distances, u.Mpc, "distance")
        stated_distance = np.where(
            np.isfinite(stated_distance) & (stated_distance > 0), stated_distance, np.nan
        )
        distance_of = np.where(
            np.isfinite(stated_distance), stated_distance * u.Mpc.to(u.m), distance_of
        )
    factor = np.where(
        np.isfinite(node), (distance_of / distance_of_node) ** 2 * (1.0 + node) / (1.0 + z), 1.0
    )
    rows = [results.extensive(name) for name in results.quantities]
    new = results._mapped(np.array)
    new["moments"][:, rows, :2] *= factor[:, None, None]
    new["moments"][:, rows, 2] += np.log10(factor)[:, None]
    new["quantiles"][:, rows] *= factor[:, None, None]
    for name in filter(results.extensive, new["best"]):
        new["best"][name] *= factor
    new["best"]["redshift"] = np.where(np.isfinite(node), z, np.nan)
    new["best_scale"] *= factor
    return dataclasses.replace(results, **new | {"distance": stated_distance})
