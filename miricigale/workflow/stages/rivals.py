"""Rival photometry of the first sky: the other forced photometry, and Source Extractor's."""

import astropy.units as u
import numpy as np
from astropy.table import QTable, vstack

from miricigale import photometry
from miricigale.evaluation import Estimate, bootstrap, match_truth, recovery_metrics
from miricigale.evaluation.estimates import median
from miricigale.utils.arrays import quiet_division
from miricigale.utils.missing_values import floats
from miricigale.utils.tables import described_rows, error_column
from miricigale.workflow.engine.stage import stage
from miricigale.workflow.labels import texts_of
from miricigale.workflow.stages.conditions import ConditionFlags, has_flag
from miricigale.workflow.stages.exposures import IMAGE_RESOURCES, KERNEL, band_names, exposure_plan
from miricigale.workflow.stages.measure import measure_band
from miricigale.workflow.stages.sample import SampleFlags, in_field
from miricigale.workflow.truths import reference

#: Methods that are compared: name of the columns, and what the page calls them.
RIVALS = texts_of("rivals")["methods"]
#: The band in which Yang et al. 2021 compare with Source Extractor.
SE_BAND = "miri.f1500w"
#: Ranges of the true signal-to-noise ratio.
SNR_RANGES = ((3.0, 5.0), (5.0, 10.0), (10.0, 20.0), (20.0, 50.0), (50.0, np.inf))
#: Ranges of the half-light radius (arcsec) of sources that are no points.
SIZE_RANGES = ((0.0, 0.2), (0.2, 0.4), (0.4, 0.8), (0.8, np.inf))


@stage(
    "rivals",
    "rival photometry",
    version=3,
    needs=("truth", "mosaics", "highres", "kernels", "templates", "matches"),
    within=reference,
    sections=KERNEL + ("photometry.method", "photometry.match_radius"),
    resources=IMAGE_RESOURCES,
    units=lambda config: band_names(config) if config.photometry.rivals else (),
    plan=lambda config, band: {
        "truth": reference(config),
        "exposures": exposure_plan(config, band),
    },
)
def measure_rivals(context, name):
    """Measure a band of the reference truth by the other method and as Source Extractor does."""
    config = context.config
    truth_name = context.plan["truth"]
    radius = config.photometry.match_radius * u.arcsec
    truth, matched = context.tables(truth_name, ("truth", "matched")).values()
    mosaic = context.image(f"{truth_name}/mosaic_{name}_fine.fits")
    own_method = config.photometry.method
    if own_method == "yang2021":
        other_method = "package"
        forced_mosaic = context.image(f"{truth_name}/mosaic_{name}.fits")
    else:
        other_method = "yang2021"
        forced_mosaic = mosaic
    forced = measure_band(context, forced_mosaic, name, other_method).to_table()
    # as the paper's, without a map of weights
    blind = photometry.source_extractor_photometry(mosaic, weighted=False)
    n_blind = 0
    if len(blind):
        n_blind = np.count_nonzero(in_field(blind["sky"], [mosaic]))
    inside = in_field(truth["sky"], [mosaic])
    table = rival_table(truth, matched, name, method=own_method, inside=inside)
    rivals = ((other_method, forced, "flux"), ("source_extractor", blind, "flux_best"))
    for method, measured, column in rivals:
        rows = QTable({"id": np.arange(len(measured)), "sky": measured["sky"]})
        rows[name] = measured[column]
        rows[error_column(name)] = measured[error_column(column)]
        rows["flags"] = np.zeros(len(rows), int)
        nearest = match_truth(truth, rows, [name], radius=radius)
        table[method] = nearest[name]
        table[error_column(method)] = nearest[error_column(name)]
    table.meta.update(method=own_method, n_source_extractor=int(n_blind))
    context.save_table(f"rivals/{name}.ecsv", table)


def rival_table(truth, matched, name, *, method, inside):
    """
    Return the sources of a truth in a band, with the fluxes of the study's ``method``.

    ``shape`` is ``"point"``, ``"n < 2"`` or ``"n >= 2"``, ``half_light_radius`` that of the truth; ``snr`` the
    true flux over the study's formal error; ``field`` marks the sources that were exposed (``inside``) and have
    a model.
    """
    index = floats(truth["sersic_index"])
    table = QTable({"id": truth["id"], "sky": truth["sky"]})
    table["flux_true"] = matched[f"{name}_true"]
    formal = matched[f"{name}_formal_err"]
    table["snr"] = (table["flux_true"] / formal).to_value(u.one)
    shapes = np.where(index < 2, "n < 2", "n >= 2")
    table["shape"] = np.where(np.asarray(truth["profile"]) == "point", "point", shapes)
    table["half_light_radius"] = truth["half_light_radius"].to(u.arcsec)
    condition = f"{name}_condition"
    table["crowded"] = has_flag(matched, condition, ConditionFlags.CROWDED)
    table["edge"] = has_flag(matched, condition, ConditionFlags.EDGE)
    table["field"] = inside & ~has_flag(matched, "selection", SampleFlags.NO_MODEL)
    table[method] = matched[name]
    table[error_column(method)] = formal
    return table


def read_rivals(context):
    """Read the tables of the stage by band; empty where the stage is switched off."""
    if not context.config.photometry.rivals:
        return {}
    return context.tables("rivals", band_names(context.config))


def _groups(table):
    """Yield kind and name of each group of sources in a table of a band, and which rows these are."""
    usable = np.asarray(table["field"]) & ~np.asarray(table["edge"])
    snr = floats(table["snr"])
    crowded = np.asarray(table["crowded"])
    size = table["half_light_radius"].value
    shape = np.asarray(table["shape"])
    bright = usable & (snr > 5)
    yield "all", "above 5 sigma", bright
    for low, high in SNR_RANGES:
        yield "true S/N", _range_name(low, high), usable & (snr > low) & (snr <= high)
    for name in ("point", "n < 2", "n >= 2"):
        yield "shape", name, bright & (shape == name)
    for low, high in SIZE_RANGES:
        inside = (shape != "point") & (size >= low) & (size < high)
        yield "half-light radius", f"{_range_name(low, high)} arcsec", bright & inside
    yield "neighbors", "isolated", bright & ~crowded
    yield "neighbors", "crowded", bright & crowded


def _range_name(low, high):
    if np.isfinite(high):
        return f"{low:g} to {high:g}"
    return f"above {low:g}"


def rival_numbers(tables):
    """
    Compare the fluxes of each method with the truth, by signal-to-noise, shape and crowding.

    Parameters
    ----------
    tables : dict of str to `~astropy.table.QTable`
        Of `read_rivals`.

    Returns
    -------
    numbers : `~astropy.table.QTable`
        A row for each band (and ``"all"`` of them together), group and method: ``n_group`` sources, of
        which ``n`` have a flux; ``median`` and ``scatter`` of measured over true flux minus one, and of
        the differences in units of the error (``pull_median``, ``pull_scatter``).
    """
    together = vstack(list(tables.values()), metadata_conflicts="silent")
    numbers = []
    for band, table in (tables | {"all": together}).items():
        for kind, group, rows in _groups(table):
            true = table["flux_true"].value[rows]
            for method in RIVALS:
                flux = table[method].value[rows]
                error = table[error_column(method)].value[rows]
                ratio = recovery_metrics(true, flux, relative=True)
                with quiet_division():
                    pulls = recovery_metrics(np.zeros(true.size), (flux - true) / error)
                row = {
                    "band": band,
                    "kind": kind,
                    "group": group,
                    "method": method,
                    "n_group": true.size,
                    "n": ratio.n,
                    "median": ratio.median,
                    "median_err": ratio.median_err,
                    "scatter": ratio.sigma_mad,
                    "pull_median": pulls.median,
                    "pull_scatter": pulls.sigma_mad,
                }
                numbers.append(row)
    return described_rows(numbers, texts_of("rivals")["numbers"])


def rival_counts(table):
    """
    Count the detections of Source Extractor in a band, as `~miricigale.evaluation.Estimate` objects.

    ``detected`` sources in the field, ``matched`` ones of the catalog, and the share ``missed`` of the sources
    of the field that the template fit has measured. Intervals of the counts are Poisson's.
    """
    field = np.asarray(table["field"])
    forced = field & np.isfinite(table[table.meta["method"]].value)
    blind = np.isfinite(table["source_extractor"].value)
    matched = int(np.count_nonzero(field & blind))
    missed = int(np.count_nonzero(forced & ~blind))
    return {
        "detected": Estimate.of_count(int(table.meta["n_source_extractor"])),
        "matched": Estimate.of_count(matched),
        "missed": Estimate.of_fraction(missed, np.count_nonzero(forced)),
    }


def blind_offset(table, seed):
    """Estimate Source Extractor minus template fit (mag) of sources above 5 sigma: an `Estimate`."""
    blind = table["source_extractor"].value
    forced = table["yang2021"].value
    good = np.asarray(table["field"]) & (floats(table["snr"]) > 5)
    good &= (blind > 0) & (forced > 0)
    delta = -2.5 * np.log10(blind[good] / forced[good])
    return bootstrap(median, delta, seed=seed)


def source_extractor_numbers(tables, seed):
    """
    Estimate the numbers of the comparison of Yang et al. 2021 with Source Extractor, in F1500W.

    Parameters
    ----------
    tables : dict of str to `~astropy.table.QTable`
        Of `read_rivals`.
    seed : int
        Of the bootstrap.

    Returns
    -------
    numbers : dict of str to `~miricigale.evaluation.Estimate`
        By key of `~miricigale.evaluation.PUBLISHED`, for ``StudyResults.extra``; empty without
        the band.
    """
    if SE_BAND not in tables:
        return {}
    table = tables[SE_BAND]
    numbers = {f"source_extractor.{key}": number for key, number in rival_counts(table).items()}
    numbers["source_extractor.offset"] = blind_offset(table, seed)
    # errors of white noise in the paper's steps, as T-PHOT has them
    flux = table["yang2021"].value
    error = table[error_column("yang2021")].value
    bright = np.asarray(table["field"]) & (floats(table["snr"]) > 5)
    pulls = np.abs((flux - table["flux_true"].value) / error)[bright]
    white = bootstrap(lambda values: np.percentile(values, 99, axis=-1), pulls, seed=seed)
    numbers["errors.white"] = white
    return numbers
