"""The numbers of the report, from the products of a run."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from miricigale.evaluation import (
    fraction_interval,
    photoz_metrics,
    recovery_metrics,
    sigma_mad,
)
from miricigale.instrument import scaled_limit
from miricigale.photometry import ErrorModel, ForcedFlags
from miricigale.workflow.stages.exposures import band_exposures
from miricigale.workflow.stages.sample import SampleFlags, magnitude

__all__ = ["FITS", "study_metrics"]

FITS = ("with_miri", "without_miri")
#: Shares of sources detected in two or more bands, by H-band limit: Yang et al. 2021.
PAPER_DETECTED = ((26.0, 0.53), (25.0, 0.75))


def _point_metrics(table):
    good = np.asarray(table["in_field"], bool)
    return recovery_metrics(
        table["flux_true"][good].value, table["flux"][good].value, relative=True
    )


def _band_metrics(matched, truth, name):
    """Recovery of the isolated sources above 20 sigma, and pulls, in one band."""
    selection = np.asarray(matched["selection"])
    usable = (selection & (SampleFlags.OUTSIDE_FIELD | SampleFlags.NOT_MATCHED)) == 0
    flux, true = matched[name].value, matched[f"{name}_true"].value
    formal = matched[f"{name}_formal_err"].value
    whole = (np.asarray(matched[f"{name}_flags"]) & (ForcedFlags.EDGE | ForcedFlags.MASKED)) == 0
    with np.errstate(invalid="ignore"):
        bright = usable & whole & (true > 20 * formal) & ~_crowded(truth, name)
        faint = usable & whole & (true < 20 * formal) & np.isfinite(flux)
    pulls = (flux[faint] - true[faint]) / formal[faint]
    return {
        "bright_isolated": recovery_metrics(true[bright], flux[bright], relative=True),
        "n_measured": int(np.count_nonzero(usable & np.isfinite(flux))),
        "formal_limit": _magnitude_of(5 * np.nanmedian(formal[usable])) if usable.any() else np.nan,
        "pull_n": int(pulls.size),
        "pull_median": float(np.median(pulls)) if pulls.size else np.nan,
        "pull_scatter": sigma_mad(pulls),
    }


def _magnitude_of(flux):
    """AB magnitude of a flux in uJy."""
    return float(23.9 - 2.5 * np.log10(flux))


def _coverage(truth, table, name):
    """Share of the sources whose true value lies between the 16th and 84th percentile."""
    low, high = table[f"{name}_p16"], table[f"{name}_p84"]
    good = np.isfinite(low) & np.isfinite(high)
    inside = good & (truth >= low) & (truth <= high)
    return fraction_interval(int(np.count_nonzero(inside)), int(np.count_nonzero(good)))[0]


def _crowded(truth, name, radius=2 * u.arcsec):
    """Whether a neighbour within 2 arcsec is brighter than the source's magnitude plus one."""
    sky, mag = truth["sky"], magnitude(truth[name])
    here, there, _, _ = sky.search_around_sky(sky, radius)
    other = here != there
    with np.errstate(invalid="ignore"):
        near = other & (mag[there] < mag[here] + 1)
    crowded = np.zeros(len(truth), bool)
    crowded[here[near]] = True
    return crowded


def study_metrics(context):
    """
    All numbers of the report.

    Parameters
    ----------
    context : `~miricigale.workflow.stage.Context`
        Of a run whose other stages are done.

    Returns
    -------
    metrics : dict
        Plain values, as written to ``report/metrics.json``.
    """
    config = context.config
    bands = config.exposures.filters
    truth = QTable.read(context.path("truth.ecsv"))
    matched = QTable.read(context.path("matched.ecsv"))
    errors = ErrorModel.read(context.path("errors.ecsv"))
    selection = np.asarray(matched["selection"])
    field = (selection & (SampleFlags.OUTSIDE_FIELD | SampleFlags.STAR | SampleFlags.NO_MODEL)) == 0
    metrics = {
        "n_catalog": len(truth),
        "n_field": int(field.sum()),
        "n_matched": int((field & (np.asarray(matched["matched"]))).sum()),
        "n_sample": int((selection == 0).sum()),
        "n_left_out": {
            flag.name.lower(): int(np.count_nonzero(selection & flag)) for flag in SampleFlags
        },
        "bands": {},
        "detected": [],
        "fits": {},
    }
    prior = magnitude(truth[config.highres.filter])
    for limit, paper in PAPER_DETECTED:
        chosen = field & (prior < limit)
        n = int(np.count_nonzero(chosen & (matched["n_detected"] >= 2)))
        fraction, low, high = fraction_interval(n, int(chosen.sum()))
        metrics["detected"].append(
            {"limit": limit, "fraction": fraction, "low": low, "high": high, "paper": paper}
        )
    for name in bands:
        time = sum(e.exposure_time for e in band_exposures(config, name))
        entry = _band_metrics(matched, truth, name)
        bright = entry.pop("bright_isolated")
        entry |= {
            "limit": float(errors.limiting_magnitude(name).value),
            "etc_limit": float(scaled_limit(name, time).to_value(u.ABmag)),
            "bright_n": bright.n,
            "bright_median": bright.median,
            "bright_median_err": bright.median_err,
        }
        if config.point_sources.enabled:
            points = _point_metrics(QTable.read(context.path(f"points/{name}.ecsv")))
            entry |= {
                "points_n": points.n,
                "points_median": points.median,
                "points_scatter": points.sigma_mad,
            }
        metrics["bands"][name] = entry
    sample = truth[selection == 0]
    for unit in FITS:
        table = QTable.read(context.path(f"fits_{unit}.ecsv"))
        photoz = photoz_metrics(sample["redshift"], table["redshift_mean"])
        fraction = recovery_metrics(sample["frac_agn"], table["frac_agn_mean"])
        metrics["fits"][unit] = {
            "n": photoz.n,
            "photoz_bias": photoz.bias,
            "photoz_sigma_mad": photoz.sigma_mad,
            "photoz_n_outliers": photoz.n_outliers,
            "photoz_outliers": photoz.outlier_fraction,
            "photoz_outliers_low": photoz.outlier_low,
            "photoz_outliers_high": photoz.outlier_high,
            "frac_agn_bias": fraction.median,
            "frac_agn_sigma_mad": fraction.sigma_mad,
            "frac_agn_width": float(np.nanmedian(table["frac_agn_std"])) if len(table) else np.nan,
            "redshift_coverage": _coverage(sample["redshift"], table, "redshift"),
        }
    return metrics
