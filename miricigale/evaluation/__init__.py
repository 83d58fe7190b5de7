"""Truth against result: matching, metrics, classes and the report; reads tables only."""

from miricigale.evaluation.classes import CLASS_NAMES, class_fractions, classify
from miricigale.evaluation.counts import (
    PUBLISHED_LIGHT,
    integrated_light,
    main_sequence_sfr,
    number_counts,
    sfr_to_infrared_luminosity,
)
from miricigale.evaluation.match import match_truth
from miricigale.evaluation.metrics import (
    PhotozMetrics,
    RecoveryMetrics,
    fraction_interval,
    photoz_metrics,
    recovery_metrics,
    running_median,
    sigma_mad,
)
from miricigale.evaluation.report import Report

__all__ = [
    "CLASS_NAMES",
    "PUBLISHED_LIGHT",
    "PhotozMetrics",
    "RecoveryMetrics",
    "Report",
    "class_fractions",
    "classify",
    "fraction_interval",
    "integrated_light",
    "main_sequence_sfr",
    "match_truth",
    "number_counts",
    "photoz_metrics",
    "recovery_metrics",
    "running_median",
    "sfr_to_infrared_luminosity",
    "sigma_mad",
]
