"""Perturbed truths: the accuracy that unknown properties of the sky cost, a section of the report."""

import numpy as np
from astropy.table import Table

from miricigale.evaluation import bootstrap
from miricigale.evaluation.estimates import median, outlier_share, scatter
from miricigale.workflow.labels import by_wavelength
from miricigale.workflow.stages.conditions import bright_isolated

#: Name of what no effect has changed.
NONE = "none"


def _quantities(bands):
    """Return the quantities of the table: kind of the values, band and statistic by name."""
    quantities = {}
    order = by_wavelength(bands)
    for band in (order[0], order[-1]):
        quantities[f"{band} offset"] = ("flux", band, median)
        quantities[f"{band} scatter"] = ("flux", band, scatter)
    quantities["photo-z sigma_MAD"] = ("redshift", None, scatter)
    quantities["photo-z outliers"] = ("redshift", None, outlier_share)
    quantities["fracAGN offset"] = ("frac_agn", None, median)
    quantities["fracAGN scatter"] = ("frac_agn", None, scatter)
    return quantities


def _errors(tables, kind, band):
    """
    Return ids of sources, and measured minus true values; ``tables`` are ``StudyTables`` of a truth.

    Relative to the true ones for the fluxes, of bright isolated sources; of redshifts relative to
    1 + z.
    """
    scale = 1.0
    if kind == "flux":
        table = tables.matched[bright_isolated(tables.matched, band)]
        true = table[f"{band}_true"].value
        measured = table[band].value
        scale = true
    else:
        table = tables.sample
        true = np.asarray(table[kind])
        measured = np.asarray(tables.fits["all"][f"{kind}_mean"])
    if kind == "redshift":
        scale = 1 + true
    errors = (measured - true) / scale
    good = np.isfinite(errors)
    return np.asarray(table["id"])[good], errors[good]


def perturbation_costs(truths, tables, bands, *, seed):
    """
    Measure the accuracy of perturbed truths, and its change against those without perturbations.

    Parameters
    ----------
    truths : dict of str to `~miricigale.workflow.truths.Truth`
        All truths.
    tables : dict of str to `~miricigale.workflow.page.numbers.StudyTables`
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

    def add(base, label, name, value, change=None):
        row = {"truth": base, "perturbation": label, "quantity": name}
        row |= {"n": value.n, "value": value.value, "value_err": value.error}
        row |= {"change": np.nan, "change_err": np.nan}
        if change is not None:
            row |= {"change": change.value, "change_err": change.error}
        rows.append(row)

    perturbed = [truth for truth in truths.values() if truth.perturbations]
    for base in dict.fromkeys(truth.base for truth in perturbed):
        skies = {t.name.removeprefix(f"{base}+"): t.name for t in perturbed if t.base == base}
        for name, (kind, band, statistic) in _quantities(bands).items():
            ids, errors = _errors(tables[base], kind, band)
            value = bootstrap(statistic, errors, seed=seed)
            add(base, NONE, name, value)
            for label, sky in skies.items():
                ids_perturbed, errors_perturbed = _errors(tables[sky], kind, band)
                _, first, second = np.intersect1d(ids, ids_perturbed, return_indices=True)
                before = errors[first]
                after = errors_perturbed[second]
                value = bootstrap(statistic, after, seed=seed)
                change = bootstrap(
                    lambda a, b, of=statistic: of(b) - of(a), before, after, seed=seed
                )
                add(base, label, name, value, change)
    return Table(rows)
