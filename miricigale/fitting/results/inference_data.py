"""Draws from posteriors as the data of ArviZ."""

import numpy as np

from miricigale.utils.named_values import first_value
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_names, check_that

#: Unit of the fluxes in the groups of data.
FLUX_UNIT = "uJy"


def inference_data(rows, draws, describe, photometry=None):
    """
    Make the data of ArviZ from draws of equal weight.

    Parameters
    ----------
    rows : `~miricigale.fitting.posterior.posterior.FitRows`
        The objects, with their ids, flags and meta.
    draws : dict of str to `~numpy.ndarray`, shape (n, n_draws) or (n_draws,)
        Values by parameter; without the axis of objects if ``rows`` is a single object.
    describe : callable
        Meaning of a parameter by its name.
    photometry : `~miricigale.fitting.FitResults`, optional
        Where the fluxes that were fitted are taken from, with the same objects.

    Returns
    -------
    data : `arviz.InferenceData` or `xarray.DataTree`
        Groups ``posterior`` (dimensions ``chain``, of length 1, ``draw`` and, of several objects, ``object``),
        ``constant_data`` and, with ``photometry``, ``observed_data``.
    """
    arviz = require("arviz", extra="arviz")
    xarray = require("xarray", extra="arviz")
    objects = {"object": np.asarray(rows.ids)}
    along = ("object",)
    if rows.isscalar:
        # a coordinate without dimension: whose draws these are
        along = ()
    posterior = {}
    for name, values in draws.items():
        # a chain of draws, then objects
        columns = np.moveaxis(np.asarray(values, float), -1, 0)[None]
        attributes = {"units": rows.unit(name).to_string(), "long_name": describe(name)}
        posterior[name] = (("chain", "draw", *along), columns, attributes)
    n_draws = first_value(posterior)[1].shape[1]
    coords = objects | {"chain": [0], "draw": np.arange(n_draws)}
    attributes = {"inference_library": "miricigale"}
    if version := rows.meta.get("version"):
        attributes["inference_library_version"] = str(version)
    groups = {"posterior": xarray.Dataset(posterior, coords, attributes)}
    constants = {"flags": (along, rows.flags, {"long_name": "FitFlags of the fit"})}
    if photometry is not None:
        bands = objects | {"band": list(photometry.filters)}
        unit = {"units": FLUX_UNIT}
        shape = (*along, "band")
        fluxes = {"flux": (shape, photometry.flux, unit | {"long_name": "measured flux"})}
        groups["observed_data"] = xarray.Dataset(fluxes, bands)
        errors = {
            "flux_err": (photometry.flux_err, "error of the measured flux"),
            "sigma": (photometry.sigma, "error used, infinite in bands that were not"),
        }
        for name, (values, text) in errors.items():
            constants[name] = (shape, values, unit | {"long_name": text})
        objects = bands
    groups["constant_data"] = xarray.Dataset(constants, objects)
    # releases since 1.0 keep the groups in a tree, and warn of the name of the class before
    if "InferenceData" in vars(arviz):
        return arviz.InferenceData(**groups)
    return xarray.DataTree.from_dict(groups)


def of_samples(samples, names=None, *, results=None):
    """
    Return the draws as ArviZ holds posteriors, for its statistics and plots.

    Parameters
    ----------
    names : list of str, optional
        Parameters and derived quantities; all by default.
    results : `~miricigale.fitting.FitResults`, optional
        The fit of the same objects, whose photometry then is with the draws.

    Returns
    -------
    data : `arviz.InferenceData` or `xarray.DataTree`
        What the installed ArviZ works with: its own class before 1.0, a tree of xarray from then on. The group
        ``posterior`` has a variable for each parameter with the dimensions ``chain`` (one, as all draws are
        independent and have the same weight), ``draw`` and, of several objects, ``object``. Values of objects that
        could not be fitted are NaN, and so are parameters of an AGN in draws without one. ``constant_data`` has
        the flags. With ``results``, ``observed_data`` has the fluxes in uJy and ``constant_data`` their errors.

    Raises
    ------
    ImportError
        If ArviZ is not installed.
    KeyError
        If a name is not one of `parameters`.
    ValueError
        If ``results`` are of other objects.
    """
    if results is not None:
        check_that(hasattr(results, "flux_err"), "results", "FitResults", repr(results))
        same = np.array_equal(np.asarray(samples.ids), np.asarray(results.ids))
        check_that(same, "results", "of the objects of the draws, in their order", "others")
    draws = {name: samples.values(name).value for name in _checked(samples, names)}
    return inference_data(samples, draws, samples.description, results)


def of_results(results, names=None, *, samples=None):
    """
    Return draws from the posteriors, with the photometry, as ArviZ holds them.

    Parameters
    ----------
    names : list of str, optional
        As for `Samples.to_arviz`.
    samples : `~miricigale.fitting.Samples`, optional
        Draws of the same objects, ``fitter.sample(photometry, 1000, seed=1)``. The results of a sampler have
        their own; those of a grid need them.

    Returns
    -------
    data : `arviz.InferenceData` or `xarray.DataTree`
        See `Samples.to_arviz`; of a single object without the dimension ``object``.

    Raises
    ------
    ImportError, KeyError
        As `Samples.to_arviz`.
    ValueError
        If these are results of a grid and there are no ``samples``, or they are of other objects.
    """
    if samples is not None:
        return samples.to_arviz(names, results=results)
    if results.draws is None:
        msg = "results of a grid hold no draws: to_arviz(samples=fitter.sample(photometry, 1000, seed=1))"
        raise ValueError(msg)
    columns = {}
    for name in _checked(results, names):
        columns[name] = results.draws[..., results.parameters.index(name)]
    return inference_data(results, columns, results._meaning, results)


def _checked(rows, names):
    """Return our names of parameters, all by default."""
    if names is None:
        return rows.parameters
    if isinstance(names, str):
        names = [names]
    names = [rows._named(name) for name in names]
    check_names(names, "parameter", rows.parameters)
    return names
