"""Perturbed truths: the accuracy that unknown properties of the sky cost, a section of the report."""

from pathlib import Path

import numpy as np
from astropy.table import Table

from miricigale.evaluation import bootstrap
from miricigale.evaluation.estimates import median, outlier_share, scatter
from miricigale.filters import Filter
from miricigale.pages import Missing
from miricigale.workflow.page.labels import band_label
from miricigale.workflow.page.numbers import bright_isolated
from miricigale.workflow.truths import ALL, CUTOUTS, EFFECTS

#: Samples drawn for an error.
N_DRAWS = 1000

#: Name of what no effect has changed.
NONE = "none"
#: Sizes of effects that the page gives in percent.
_SHARES = ("psf_width", "flat", "gain", "linearity", "zero_point", "zero_point_existing")
_LABELS = {NONE: "none", **EFFECTS, ALL: "all together"}


def _quantities(bands):
    """Columns of the table: name to the kind of the values, the band, and their statistic."""
    by_wave = sorted(bands, key=lambda name: Filter.from_name(name).pivot)
    found = {}
    for band in (by_wave[0], by_wave[-1]):
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
            plain = bootstrap(statistic, known, seed=seed, n_draws=N_DRAWS)
            rows.append((base, NONE, name, plain.n, plain.value, plain.error, np.nan, np.nan))
            for which, sky in skies.items():
                own_ids, own = _errors(every[sky], kind, band)
                _, first, second = np.intersect1d(ids, own_ids, return_indices=True)
                cost = _cost(statistic, known[first], own[second], seed)
                rows.append((base, which, name, *cost))
    names = ["truth", "perturbation", "quantity", "n", "value", "value_err", "change", "change_err"]
    return Table(rows=rows, names=names) if rows else Table(names=names)


def _cost(statistic, known, own, seed):
    """Number of pairs, statistic of the second, its error, its change and the change's error."""
    value = bootstrap(statistic, own, seed=seed, n_draws=N_DRAWS)
    change = bootstrap(
        lambda first, second: statistic(second) - statistic(first),
        known,
        own,
        seed=seed,
        n_draws=N_DRAWS,
    )
    return value.n, value.value, value.error, change.value, change.error


def write_perturbed(page, truths, every):
    """Write the section with one table, if there are perturbed truths."""
    config, options = page.config, page.config.perturb
    table = perturbation_costs(truths, every, config.exposures.filters, seed=page.context.seed)
    if len(table) == 0:
        return
    sizes = {name: 100 * getattr(options, name) for name in _SHARES}
    sizes["astrometry"] = 1000 * options.astrometry
    page.numbers("perturbations", table, shapes=_shapes(config, truths), **sizes)
    rows = {}
    for row in table:
        known = {"sky": row["truth"], "perturbation": _LABELS[row["perturbation"]]}
        cells = rows.setdefault((row["truth"], row["perturbation"]), known)
        cells[_header(row["quantity"])] = _cell(row)
    page.table("table", rows.values())


def _shapes(config, truths):
    """Which shapes: clumps are made up, and stamps are those of an image."""
    effects = {name for truth in truths.values() for name, _ in truth.perturbations}
    options, parts = config.perturb, []
    if "clumps" in effects:
        parts.append(f"{100 * options.clumps:g} % of the light of disks in made-up clumps")
    if CUTOUTS in effects:
        name = Path(options.cutouts).name
        whose = (
            "their own light" if options.cutouts_of == "own" else "light of galaxies of their size"
        )
        parts.append(f"{whose} on {name} in place of Sersic profiles")
    return f" ({'; '.join(parts)})" if parts else ""


def _header(quantity):
    first, _, rest = quantity.partition(" ")
    return f"{band_label(first)} {rest}" if "." in first else quantity


def _cell(row):
    """Text of a value and its change; per cent but for scatter of redshifts and fracAGN."""
    if not np.isfinite(row["value"]):
        return Missing("no source")
    share = "." in row["quantity"] or row["quantity"].endswith("outliers")
    scale, digits, unit = (100, 1, " %") if share else (1, 4, "")
    signed = "+" if row["quantity"].endswith("offset") else ""
    text = f"{scale * row['value']:{signed}.{digits}f}"
    if row["perturbation"] == NONE:
        return f"{text} ± {scale * row['value_err']:.{digits}f}{unit}"
    change = f"{scale * row['change']:+.{digits}f} ± {scale * row['change_err']:.{digits}f}"
    return f"{text} ({change}){unit}"
