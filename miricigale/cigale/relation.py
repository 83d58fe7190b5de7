"""Posteriors within a distance of the relation of alpha_ox and L_nu(2500 A), from draws."""

import dataclasses
import warnings

import astropy.units as u
import numpy as np

from miricigale.fitting import FitFlags
from miricigale.fitting.posterior.quantities import draws_summary, node_shares, put_draws
from miricigale.fitting.samplers.run import chi2_at
from miricigale.utils.arrays import nans
from miricigale.utils.exceptions import FitWarning
from miricigale.utils.parallel import chunks

#: Just et al. 2007, ApJ 665, 1004, equation 3: slope and offset, for erg/s/Hz.
_JUST = (-0.137, 2.638)
#: Draws of each object, and objects whose draws are in memory at once.
N_DRAWS = 2000
_OBJECTS = 64
#: Part of the draws below which nothing can be said of those that are left.
_LEAST = 0.01


def near_relation(fitter, photometry, results, max_deviation, *, redshift, seed):
    """
    Leave out models whose corona is too far from what their disk should have, as X-CIGALE does.

    The disk of a model has the luminosity that its scale gives it, so that the bound is none on the models of a
    grid: models are drawn from the posterior, and those that keep it are the posterior under the bound.

    Parameters
    ----------
    fitter : `~miricigale.fitting.BayesFitter`
        The fitter, with a grid that `~miricigale.sed.with_xray_bands` made.
    photometry : `~astropy.table.QTable`
        What was fitted.
    results : `~miricigale.fitting.FitResults`
        What ``fitter.fit(photometry, redshift=redshift)`` returned.
    max_deviation : float
        Largest distance of alpha_ox from -0.137 log L_nu(2500 A) + 2.638 (Just et al. 2007).
    redshift : array_like or None
        Known redshifts.
    seed : int
        Seed of the draws, `N_DRAWS` of each object.

    Returns
    -------
    results : `~miricigale.fitting.FitResults`
        With posteriors, moments, quantiles, fluxes and evidence of the models that are left; the best model is the
        best of them that was drawn, where the best of all is none of them. Objects of which less than 1 % of the
        posterior keeps the bound are flagged ``OFF_RELATION``, and left as they are.
    """
    new = results._mapped(np.array)
    for rows in chunks(len(results), _OBJECTS):
        z = None
        if redshift is not None:
            z = np.asarray(redshift)[rows]
        with warnings.catch_warnings():
            # the fit has given this warning
            warnings.simplefilter("ignore", FitWarning)
            samples = fitter.sample(photometry[rows], N_DRAWS, seed=seed, redshift=z)
        is_near = _is_near(samples, max_deviation)
        values = {name: samples.values(name).value for name in results.parameters}
        fluxes = samples.fluxes().value
        for j in np.flatnonzero(samples.fitted & results.fitted[rows]):
            i = range(len(results))[rows][j]
            draws_near = is_near[j]
            if np.mean(draws_near) < _LEAST:
                new["flags"][i] |= FitFlags.OFF_RELATION
                continue
            index = samples.index[j][draws_near]
            scale = samples.scale[j][draws_near]
            flux = fluxes[j][draws_near]
            mine = {name: array[j][draws_near] for name, array in values.items()}
            _summarize(results, new, i, index, mine)
            new["log_evidence"][i] += np.log(np.mean(draws_near))
            new["model_flux"][i] = flux.mean(axis=0)
            new["model_flux_std"][i] = flux.std(axis=0)
            if not _best_is_near(results, i, max_deviation):
                _take_best(results, new, i, index, scale, flux, mine)
    return dataclasses.replace(results, **new)


def _is_near(samples, max_deviation):
    """Tell which draws are near the relation, or have no AGN: shape (n, n_draws)."""
    if "alpha_ox" in samples.axes:
        slope = samples.values("alpha_ox").value
    else:
        slope = samples.grid.agn_parameters["alpha_ox"].value[0]
    return ~(_distance(slope, samples.values("l_2500")) > max_deviation)


def _distance(slope, light):
    """Tell how far a slope is from the relation; NaN without a disk."""
    light = light.to_value(u.erg / u.s / u.Hz)
    log_light = np.log10(light, where=light > 0, out=nans(np.shape(light)))
    return np.abs(slope - (_JUST[0] * log_light + _JUST[1]))


def _best_is_near(results, i, max_deviation):
    best = results.best.get("alpha_ox")
    if best is None:
        slope = results.constants.get("alpha_ox")
    else:
        slope = best.value[i]
    return not _distance(slope, results.best["l_2500"][i]) > max_deviation


def _summarize(results, new, i, index, values):
    """Posteriors of parameters, moments and quantiles of derived quantities of one object."""
    new["pdf_2d"][i] = node_shares((index[:, 0], index[:, 3]), new["pdf_2d"].shape[1:])
    for name, axis in results.axes.items():
        finite = values[name][np.isfinite(values[name])]
        node = axis.cell_of(finite)
        # of parameters of an AGN that is not there the posterior is the prior
        n_lost = (len(index) - finite.size) * axis.weights
        new["pdf"][name][i] = (np.bincount(node, minlength=axis.values.size) + n_lost) / len(index)
    put_draws(results, new, i, values)
    if results.axis_moments is None:
        return
    for j, name in enumerate(results.axes):
        # between nodes parameters have moments and quantiles of their own
        moments, quantiles = draws_summary(values[name])
        new["axis_moments"][i, j] = moments[:2]
        new["axis_quantiles"][i, j] = quantiles


def _take_best(results, new, i, index, scale, flux, values):
    """The draw of the least chi2 as the best model."""
    sigma = results.sigma[i]
    limit = results.limit[i]
    has_data = np.isfinite(sigma)
    chi2 = chi2_at(
        np.ones(len(flux)),
        flux[:, has_data],
        results.flux[i][has_data],
        sigma[has_data],
        limit[has_data],
    )
    k = int(np.argmin(chi2))
    new["chi2"][i] = chi2[k]
    new["best_flux"][i] = flux[k]
    new["best_index"][i] = index[k]
    new["best_scale"][i] = scale[k]
    for name in new["best"].keys() & values.keys():
        new["best"][name][i] = values[name][k]
