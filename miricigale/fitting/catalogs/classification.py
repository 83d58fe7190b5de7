"""Galaxy, quasar or star: evidences of fits of the same photometry with models of several classes."""

import numpy as np

from miricigale.fitting.data.likelihood import FitFlags
from miricigale.fitting.results.percentile_columns import LEVELS
from miricigale.fitting.results.table_columns import ODDS
from miricigale.utils.arrays import nans, quiet_division
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import first_value, places
from miricigale.utils.options import check_that
from miricigale.utils.package_tables import column_texts
from miricigale.utils.tables import described_table
from miricigale.utils.units import are_not_negative

#: Names of the percentiles of a class, and what the columns of a redshift are.
_PERCENTILES = ("p16", "p50", "p84")
_MEANINGS = column_texts("miricigale.fitting", "parameter")
#: Columns of a fit that go with its redshift, with their descriptions.
_OF_FIT = {
    "flags": f"of the fit of the class; {FitFlags.describe()}",
    "chi2_best": "chi2 of the best model of the class",
    "reduced_chi2": "chi2_best over the number of bands less one",
    "log_evidence": "ln of the evidence of the class, fluxes in uJy",
}


def compare_classes(results, *, prior=None):
    r"""
    Classify every object, from the evidences of fits of the same photometry.

    The evidence of a class is its posterior's normalization, ``log_evidence`` of `FitResults`: prior times
    likelihood summed over the models of the class, each at its best scale. The fits share fluxes, errors, limits
    and the prior of scales, so that ratios of evidences are those of the classes:

    .. math:: P_c = \frac{\pi_c Z_c}{\sum_k \pi_k Z_k}

    An object has one redshift, that of the fit of its class; those of the other classes stand beside it.

    Parameters
    ----------
    results : dict of str to `FitResults`
        Fits by class; ratios are to the first, such as ``"galaxy"``.
    prior : dict of str to float or array_like, shape (n,), optional
        Share :math:`\pi` of each class, in any normalization, for all objects or each (such as counts of stars and
        galaxies at its magnitude); the same for all classes by default.

    Returns
    -------
    table : `~astropy.table.QTable`
        ``id``; ``class``, the one of the highest probability, and ``class_probability``; where redshifts are free
        those of the class: ``redshift_mean``, ``_std``, ``_p16``, ``_p50``, ``_p84``, ``_best`` and ``_odds`` (see
        `FitResults.to_table`; of stars, at redshift 0, there are no odds); ``flags``, ``chi2_best``,
        ``reduced_chi2`` and ``log_evidence`` of its fit, with the flag ``OTHER_CLASS`` where it is not the first
        class. Then of each class ``probability_<class>``, ``reduced_chi2_<class>``, ``flags_<class>`` and, where
        its redshifts are free, ``redshift_p16_<class>``, ``_p50_<class>`` and ``_p84_<class>``. And of each but
        the first ``log_ratio_<class>``, ln of its evidence over that of the first. An object that was not fitted
        with all classes has the class ``""``, NaN as probabilities, and the redshift of the first class.

    Raises
    ------
    ValueError
        If there are fewer than two classes, they are fits of other objects, fluxes or bands, or a prior is
        negative, not finite, or 0 for all classes.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.modeling.models import BlackBody
    >>> from miricigale.fitting import compare_classes
    >>> from miricigale.sed import SED, template_grid
    >>> from miricigale import BayesFitter, ErrorModel, SEDModel
    >>> bands = ["acs.f814w", "wfc3.f160w", "irac.ch1", "miri.f770w"]
    >>> model = SEDModel.yang2021(agn=False)
    >>> truth = {"id": ["a", "b"], "redshift": [0.5, 1.0], "age": [1.0, 3.0], "mass": [1e10, 1e10]}
    >>> errors = ErrorModel.from_depths(dict.fromkeys(bands, 29.0))
    >>> photometry = errors.perturb(model.fluxes(truth, bands), seed=1)
    >>> axes = {"redshift": [0.4, 0.5, 0.9, 1.0, 1.1], "age": [1.0, 3.0], "ebv": [0.1, 0.3]}
    >>> fitter = BayesFitter(model, bands, axes=axes)
    >>> wave = np.geomspace(0.3, 30, 500) * u.um
    >>> stars = {"5000 K": SED(wave, BlackBody(5000 * u.K)(wave) * u.sr)}
    >>> star = BayesFitter(template_grid(stars, bands)).fit(photometry)
    >>> table = compare_classes({"galaxy": fitter.fit(photometry), "star": star})
    >>> table["class"].tolist()
    ['galaxy', 'galaxy']
    >>> bool(np.all(table["redshift_p50"] == table["redshift_p50_galaxy"]))
    True
    """
    columns = class_columns(results, prior=prior)
    first = first_value(results)
    return described_table({"id": (first.ids, "identifier"), **columns}, dict(first.meta))


def class_columns(results, *, prior=None):
    """Compute the columns of `compare_classes` but the id: dict of name to values and description."""
    check_that(len(results) >= 2, "results", "a dict of two classes at least", list(results))
    names = list(results)
    first = results[names[0]]
    for name in names[1:]:
        _check_same(names[0], first, name, results[name])
    weight = _prior(prior, names, len(first))
    evidence = np.array([results[name].log_evidence for name in names], dtype=float)
    in_all_fits = np.isfinite(evidence).all(axis=0)
    # P_c = pi_c Z_c / sum of pi_k Z_k, shifted by the largest exponent so that it cannot overflow
    with quiet_division():
        log_posterior = np.where(in_all_fits, evidence, np.nan) + np.log(weight)
        shifted = np.exp(log_posterior - log_posterior.max(axis=0))
        probability = shifted / shifted.sum(axis=0)
    class_number = np.where(in_all_fits, np.argmax(shifted, axis=0), -1)
    label = np.where(in_all_fits, np.array(names)[class_number], "")
    best_probability = np.where(in_all_fits, probability.max(axis=0), np.nan)
    out = {
        "class": (label, "class of the highest probability; none where a fit is missing"),
        "class_probability": (best_probability, "probability of the class"),
    }
    fits = list(results.values())
    # objects without a class get the columns of the first
    class_number = np.maximum(class_number, 0)
    out |= _redshifts_of_class(fits, class_number)
    for name, text in _OF_FIT.items():
        attribute = {"chi2_best": "chi2"}.get(name, name)
        values = np.array([np.asarray(getattr(fit, attribute)) for fit in fits])
        out[name] = (_of_class(values, class_number), text)
    class_flag = np.where(class_number > 0, int(FitFlags.OTHER_CLASS), 0)
    out["flags"] = (out["flags"][0] | class_flag, out["flags"][1])
    for name, values in zip(names, probability, strict=True):
        out[f"probability_{name}"] = (values, f"probability of the class {name}")
    for name, values in zip(names[1:], evidence[1:], strict=True):
        text = f"ln of the evidence of {name} over that of {names[0]}"
        out[f"log_ratio_{name}"] = (values - evidence[0], text)
    for name, fit in results.items():
        text = f"reduced chi2 of the best model of {name}"
        out[f"reduced_chi2_{name}"] = (np.asarray(fit.reduced_chi2), text)
        out[f"flags_{name}"] = (
            np.asarray(fit.flags),
            f"of the fit of {name}: {FitFlags.describe()}",
        )
        if _has_free_redshift(fit):
            percentiles = fit.percentile("redshift", LEVELS).value.T
            for suffix, values in zip(_PERCENTILES, percentiles, strict=True):
                text = f"{_MEANINGS[suffix]} of the redshift of {name}"
                out[f"redshift_{suffix}_{name}"] = (values, text)
    return out


def _has_free_redshift(fit):
    """Whether a fit has found redshifts."""
    axis = fit.axes.get("redshift")
    return axis is not None and axis.values.size > 1 and not fit.redshift_fixed


def _of_class(values, place):
    """Select the values of the class of each object: of shape (n,), from (n_classes, n)."""
    return np.take_along_axis(values, place[None], axis=0)[0]


def _redshifts_of_class(fits, place):
    """
    Select the redshift columns of the class of each object, by name: values and descriptions.

    There are none where the redshifts of the first class were given. Those of a class with a single redshift, such
    as stars, are that one, without odds.
    """
    if not _has_free_redshift(fits[0]):
        return {}
    of_fits = [_redshift_columns(fit) for fit in fits]
    out = {}
    texts = {name: f"{meaning} of the redshift of the class" for name, meaning in _MEANINGS.items()}
    texts["odds"] = f"{ODDS}, of the class"
    for name, text in texts.items():
        values = np.array([columns[name] for columns in of_fits])
        out[f"redshift_{name}"] = (_of_class(values, place), text)
    return out


def _redshift_columns(fit):
    """Compute the redshift columns of a fit, by the part of the name after ``redshift_``."""
    best = np.asarray(fit.best["redshift"].value, dtype=float)
    if not _has_free_redshift(fit):
        spread = np.where(np.isfinite(best), 0.0, np.nan)
        columns = dict.fromkeys(_MEANINGS, best)
        return columns | {"std": spread, "odds": nans(best.shape)}
    columns = {"mean": fit.mean("redshift").value, "std": fit.std("redshift").value, "best": best}
    columns |= zip(_PERCENTILES, fit.percentile("redshift", LEVELS).value.T, strict=True)
    return columns | {"odds": fit.redshift_odds}


def _check_same(whose, first, name, second):
    """Refuse fits of other objects or of other data."""
    bands = first.fitted_filters
    got = None
    if not np.array_equal(first.ids, second.ids):
        got = "other objects"
    elif set(bands) != set(second.fitted_filters):
        got = f"the bands {list(second.fitted_filters)}"
    elif _nuclei(first) != _nuclei(second):
        got = f"fluxes of nuclei in {_nuclei(second)}"
    else:
        first_columns = places(bands, first.filters)
        second_columns = places(bands, second.filters)
        for values in ("flux", "flux_err", "limit"):
            a = getattr(first, values)[:, first_columns]
            b = getattr(second, values)[:, second_columns]
            if not np.array_equal(a, b, equal_nan=values != "limit"):
                got = f"other values of {values!r}"
    check_that(got is None, "results", f"{name!r} of the same data as {whose!r}", got)


def _nuclei(fit):
    """List the bands whose fluxes of nuclei were fitted."""
    return list(fit.meta.get("fit", {}).get("nuclei", ()))


def _prior(prior, names, n):
    """Return the prior shares of the classes, shape (n_classes, n)."""
    if prior is None:
        return np.ones((len(names), n))
    check_that(set(prior) == set(names), "prior", f"of the classes {names}", sorted(prior))
    # one share for all objects, or one for each
    weight = np.array([np.broadcast_to(floats(prior[name]), (n,)) for name in names])
    good = are_not_negative(weight) and np.all(weight.sum(axis=0) > 0)
    check_that(good, "prior", "finite, >= 0 and not all 0", prior)
    return weight
