"""Perturbed truths: the accuracy that unknown properties of the sky cost, a section of the report."""

import numpy as np
from astropy.table import Table

from miricigale.evaluation import bootstrap
from miricigale.evaluation.estimates import median, outlier_share, scatter
from miricigale.workflow.labels import by_wavelength, texts_of
from miricigale.workflow.stages.conditions import bright_isolated

#: Name of what no effect has changed.
NONE = "none"
EFFECT_LABELS = texts_of("perturbations")["labels"]


def _quantities(bands):
    """Columns of the table: name to the kind of the values, the band, and their statistic."""
    order, found = by_wavelength(bands), {}
    for band in (order[0], order[-1]):
        found[f"{band} offset"] = ("flux", band, median)
        found[f"{band} scatter"] = ("flux", band, scatter)
    return found | {
        "photo-z sigma_MAD": ("redshift", None, scatter),
        "photo-z outliers": ("redshift", None, outlier_share),
        "fracAGN offset": ("frac_agn", None, median),
        "fracAGN scatter": ("frac_agn", None, scatter),
    }


def _errors(tables, kind, band):
    """
    Ids of sources, and measured minus true values; ``tables`` are ``StudyTables`` of a truth.

    Relative to the true ones for the fluxes, of bright isolated sources; of redshifts relative to
    1 + z.
    """
    if kind == "flux":
        table = tables.matched[bright_isolated(tables.matched, band)]
        true, found = table[f"{band}_true"].value, table[band].value
        scale = true
    else:
        table, results = tables.sample, tables.fits["all"]
        true, found = np.asarray(table[kind]), np.asarray(results[f"{kind}_mean"])
        scale = 1 + true if kind == "redshift" else 1.0
    errors = (found - true) / scale
    good = np.isfinite(errors)
    return np.asarray(table["id"])[good], errors[good]


def perturbation_costs(truths, every, bands, *, seed):
    """
    Accuracy of perturbed truths, and its change against those without perturbations.

    Parameters
    ----------
    truths : dict of str to `~miricigale.workflow.truths.Truth`
        All truths.
    every : dict of str to `~miricigale.workflow.page.numbers.StudyTables`
        Their tables.
    bands : iterable of str
        MIRI bands; fluxes are those of the shortest and the longest.
    seed : int
        Seed of the bootstrap.

    Returns
    -------
    costs : `~astropy.table.Table`
        A row for each truth and quantity: ``truth`` (without perturbations), ``perturbation``
        (``"none"`` for that truth itself), ``quantity``, ``n`` sources, ``value``, ``value_err``, ``change`` and
        ``change_err``. Values are of the sources that both truths have, and the errors of the changes of
        draws of these sources, so that what both skies share does not count.
    """
    rows = []
    perturbed = [truth for truth in truths.values() if truth.perturbations]
    for base in dict.fromkeys(truth.base for truth in perturbed):
        skies = {t.name.removeprefix(f"{base}+"): t.name for t in perturbed if t.base == base}
        for name, (kind, band, statistic) in _quantities(bands).items():
            ids, known = _errors(every[base], kind, band)
            plain = bootstrap(statistic, known, seed=seed)
            rows.append((base, NONE, name, plain.n, plain.value, plain.error, np.nan, np.nan))
            for which, sky in skies.items():
                own_ids, own = _errors(every[sky], kind, band)
                _, first, second = np.intersect1d(ids, own_ids, return_indices=True)
                pair = known[first], own[second]
                value = bootstrap(statistic, pair[1], seed=seed)
                change = bootstrap(lambda a, b, of=statistic: of(b) - of(a), *pair, seed=seed)
                cost = value.n, value.value, value.error, change.value, change.error
                rows.append((base, which, name, *cost))
    names = ["truth", "perturbation", "quantity", "n", "value", "value_err", "change", "change_err"]
    return Table(rows=rows, names=names) if rows else Table(names=names)
