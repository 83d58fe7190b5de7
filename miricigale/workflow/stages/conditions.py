"""Conditions of sources and detections that stay in the tables: edges, neighbors, doubtful matches."""

import numpy as np

from miricigale import photometry
from miricigale.evaluation import AssociationFlags, photoz_metrics, recovery_metrics
from miricigale.utils.tables import Flags, error_column
from miricigale.workflow.stages.sample import SampleFlags


class ConditionFlags(Flags):
    """Conditions of a source, or a detection, in a band; those of Yang et al. 2021 and doubtful matches."""

    EDGE = 1, "More than a tenth of its light falls off the image or its footprint."
    CROWDED = 2, "A neighbor within 2 arcsec is brighter than its magnitude plus one."
    AMBIGUOUS = 4, "More than one candidate is within the radius of the match, or it is not mutual."
    SPURIOUS = 8, "A detection that belongs to no source of the catalog."
    NOT_MEASURED = 16, "It has no flux: not detected on the high-resolution image, or no data."


#: Groups that are compared: the bits that are set, of those in question. Those of the first have none.
CONDITIONS = {
    "isolated": 0,
    "crowded": int(ConditionFlags.CROWDED),
    "edge": int(ConditionFlags.EDGE),
    "ambiguous": int(ConditionFlags.AMBIGUOUS),
}
_ANY = sum(CONDITIONS.values())
_DOUBTFUL = sum(AssociationFlags[key] for key in ("SEVERAL_FIRST", "SEVERAL_SECOND", "NOT_MUTUAL"))


def has_flag(table, column, flag):
    """Tell which rows have at least one of some flags in a column: array of bool."""
    return (np.asarray(table[column]) & flag) > 0


def add_conditions(table, bands, *, suffix="", detections=False):
    """
    Add ``<band>_condition`` (`ConditionFlags`) to sources, or to detections (``detections``).

    The table has ``sky``, ``association`` (`~miricigale.evaluation.AssociationFlags`) and, for each band,
    the flux and ``<band>_flags``; neighbors are compared by the fluxes ``<band><suffix>``, ``"_true"``
    for the truth. Detections without a source are spurious.
    """
    unmatched = has_flag(table, "association", AssociationFlags.NONE_NEAR)
    for name in bands:
        conditions = {
            ConditionFlags.EDGE: has_flag(table, f"{name}_flags", photometry.ForcedFlags.EDGE),
            ConditionFlags.CROWDED: photometry.crowded(table["sky"], table[f"{name}{suffix}"]),
            ConditionFlags.AMBIGUOUS: has_flag(table, "association", _DOUBTFUL),
            ConditionFlags.SPURIOUS: unmatched & detections,
            ConditionFlags.NOT_MEASURED: ~np.isfinite(table[name].value),
        }
        flags = sum(int(flag) * rows for flag, rows in conditions.items())
        table[f"{name}_condition"] = flags
        table[f"{name}_condition"].info.description = ConditionFlags.describe()


def any_condition(table, bands):
    """Return the conditions of each row in any of the bands."""
    return np.bitwise_or.reduce([np.asarray(table[f"{name}_condition"]) for name in bands])


def _groups(condition):
    """Return the rows of each group of `CONDITIONS`; a row may be in several but the first."""
    groups = {}
    for name, bit in CONDITIONS.items():
        groups[name] = (condition & bit) > 0
        if bit == 0:
            groups[name] = (condition & _ANY) == 0
    return groups


def band_conditions(matched, name):
    """
    Count the sources of the field by condition, with how well each kind is measured in a band.

    Of ``matched`` (stage 12): ``n_field`` (galaxies and stars with a model), ``n_not_measured`` of
    them, and for each of `CONDITIONS` ``n`` of the measured ones, and ``n_bright``, ``median`` and
    ``scatter`` of measured over true flux minus one of those above five formal errors.
    """
    column = f"{name}_condition"
    field = ~has_flag(matched, "selection", SampleFlags.OUTSIDE_FIELD | SampleFlags.NO_MODEL)
    lost = has_flag(matched, column, ConditionFlags.NOT_MEASURED)
    flux = matched[name].value
    true = matched[f"{name}_true"].value
    bright = true > 5 * matched[f"{name}_formal_err"].value
    counts = {"n_field": int(field.sum()), "n_not_measured": int((field & lost).sum())}
    for group, rows in _groups(np.asarray(matched[column])).items():
        rows = rows & field & ~lost
        recovery = recovery_metrics(true[rows & bright], flux[rows & bright], relative=True)
        counts[group] = {
            "n": int(rows.sum()),
            "n_bright": recovery.n,
            "median": recovery.median,
            "scatter": recovery.sigma_mad,
        }
    return counts


def detection_counts(detections, bands):
    """
    Count the detections of ``photometry.ecsv`` (stage 12).

    ``n``, ``n_field`` and of these ``n_spurious``, ``n_ambiguous``, and by band the spurious ones above
    five formal errors (``n_spurious_bright``).
    """
    field = np.asarray(detections["in_field"], bool)
    column = f"{bands[0]}_condition"
    spurious = field & has_flag(detections, column, ConditionFlags.SPURIOUS)
    ambiguous = field & has_flag(detections, column, ConditionFlags.AMBIGUOUS)
    n_spurious_bright = {}
    for band in bands:
        bright = detections[band] > 5 * detections[error_column(band)]
        n_spurious_bright[band] = int(np.sum(spurious & bright))
    return {
        "n": len(detections),
        "n_field": int(field.sum()),
        "n_spurious": int(spurious.sum()),
        "n_ambiguous": int(ambiguous.sum()),
        "n_spurious_bright": n_spurious_bright,
    }


def fit_conditions(sample, redshift, table, bands):
    """
    Measure photometric redshifts by condition: ``n``, ``photoz_sigma_mad``, ``photoz_n_outliers``.

    ``sample`` are the rows of ``matched`` that were fitted, ``redshift`` the true redshifts and
    ``table`` the fits of the same sources, row by row; a source has a condition if it has it in one of
    the bands.
    """
    groups = {}
    for name, rows in _groups(any_condition(sample, bands)).items():
        photoz = photoz_metrics(np.asarray(redshift)[rows], table["redshift_mean"][rows])
        groups[name] = {
            "n": photoz.n,
            "photoz_sigma_mad": photoz.sigma_mad,
            "photoz_n_outliers": photoz.n_outliers,
        }
    return groups


def is_matched(matched):
    """Tell which sources are in the field and matched with a detection."""
    return ~has_flag(matched, "selection", SampleFlags.OUTSIDE_FIELD | SampleFlags.NOT_MATCHED)


def is_complete(matched, name):
    """Tell which sources are whole on the image of a band."""
    incomplete = photometry.ForcedFlags.EDGE | photometry.ForcedFlags.MASKED
    return ~has_flag(matched, f"{name}_flags", incomplete)


def bright_isolated(matched, name):
    """Tell which sources are isolated and above 20 sigma in one band, whole and in the field."""
    usable = is_matched(matched) & is_complete(matched, name)
    crowded = has_flag(matched, f"{name}_condition", ConditionFlags.CROWDED)
    true = matched[f"{name}_true"].value
    formal = matched[f"{name}_formal_err"].value
    return usable & (true > 20 * formal) & ~crowded
