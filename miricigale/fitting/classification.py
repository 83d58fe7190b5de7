"""Galaxy, quasar or star: evidences of fits of the same photometry with models of several classes."""

import numpy as np

from miricigale.utils.exceptions import argument_error
from miricigale.utils.missing import floats
from miricigale.utils.options import check_that
from miricigale.utils.tables import described_table


def compare_classes(results, *, prior=None):
    r"""
    Class of every object, from the evidences of fits of the same photometry.

    The evidence of a class is its posterior's normalization, ``log_evidence`` of `FitResults`: prior times
    likelihood summed over the models of the class, each at its best scale. The fits share fluxes, errors, limits
    and the prior of scales, so that ratios of evidences are those of the classes:

    .. math:: P_c = \frac{\pi_c Z_c}{\sum_k \pi_k Z_k}

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
        ``id``; ``class``, the one of the highest probability; ``probability_<class>``; and of each class but the
        first ``log_ratio_<class>``, ln of its evidence over that of the first, and ``reduced_chi2_<class>`` of its
        best models. An object that was not fitted with all classes has the class ``""`` and NaN.

    Raises
    ------
    ValueError
        If there are fewer than two classes, they are fits of other objects, fluxes or bands, or a prior is
        negative, not finite, or 0 for all classes.

    Examples
    --------
    >>> import astropy.units as u
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
    """
    columns = class_columns(results, prior=prior)
    first = next(iter(results.values()))
    return described_table({"id": (first.ids, "identifier"), **columns}, dict(first.meta))


def class_columns(results, *, prior=None):
    """Columns of `compare_classes` but the id: dict of name to values and description."""
    check_that(len(results) >= 2, "results", "a dict of two classes at least", list(results))
    names = list(results)
    first = results[names[0]]
    for name in names[1:]:
        _check_same(names[0], first, name, results[name])
    weight = _prior(prior, names, len(first))
    evidence = np.array([results[name].log_evidence for name in names], dtype=float)
    known = np.isfinite(evidence).all(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_posterior = np.where(known, evidence, np.nan) + np.log(weight)
        shifted = np.exp(log_posterior - log_posterior.max(axis=0))
        probability = shifted / shifted.sum(axis=0)
    label = np.where(known, np.array(names)[np.argmax(shifted, axis=0)], "")
    out = {"class": (label, "class of the highest probability; none where a fit is missing")}
    for name, values in zip(names, probability, strict=True):
        out[f"probability_{name}"] = (values, f"probability of the class {name}")
    for name, values in zip(names[1:], evidence[1:], strict=True):
        text = f"ln of the evidence of {name} over that of {names[0]}"
        out[f"log_ratio_{name}"] = (values - evidence[0], text)
    for name in names[1:]:
        text = f"reduced chi2 of the best model of {name}"
        out[f"reduced_chi2_{name}"] = (np.asarray(results[name].reduced_chi2), text)
    return out


def _check_same(whose, first, name, other):
    """Refuse fits of other objects or of other data."""
    bands, got = first.fitted_filters, None
    if not np.array_equal(first.ids, other.ids):
        got = "other objects"
    elif set(bands) != set(other.fitted_filters):
        got = f"the bands {list(other.fitted_filters)}"
    else:
        mine, theirs = ([one.filters.index(band) for band in bands] for one in (first, other))
        for values in ("flux", "flux_err", "limit"):
            a, b = getattr(first, values)[:, mine], getattr(other, values)[:, theirs]
            if not np.array_equal(a, b, equal_nan=values != "limit"):
                got = f"other values of {values!r}"
    check_that(got is None, "results", f"{name!r} of the same data as {whose!r}", got)


def _prior(prior, names, n):
    """Shares of the classes, shape (n_classes, n)."""
    if prior is None:
        return np.ones((len(names), n))
    check_that(set(prior) == set(names), "prior", f"of the classes {names}", sorted(prior))
    weight = np.array([np.broadcast_to(floats(prior[name]), (n,)) for name in names])
    if not np.all(np.isfinite(weight) & (weight >= 0)) or not np.all(weight.sum(axis=0) > 0):
        raise argument_error("prior", "finite, >= 0 and not all 0", f"{prior}")
    return weight
