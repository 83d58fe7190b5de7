"""Conditions of sources and detections that stay in the tables: edges, neighbors, doubtful matches."""

import numpy as np

from miricigale import photometry
from miricigale.evaluation import AssociationFlags, photoz_metrics, recovery_metrics
from miricigale.utils.tables import Flags, error_column
from miricigale.workflow.stages.sample import SampleFlags

__all__ = [
    "CONDITIONS",
    "ConditionFlags",
    "add_conditions",
    "any_condition",
    "band_conditions",
    "detection_counts",
    "fit_conditions",
]


class ConditionFlags(Flags):
    """Conditions of a source, or a detection, in a band; those of Yang et al. 2021 and doubtful matches."""

    #: More than a tenth of its light falls off the image.
    EDGE = 1
    #: A neighbor within 2 arcsec is brighter than its magnitude plus one.
    CROWDED = 2
    #: More than one candidate is within the radius of the match, or it is not mutual.
    AMBIGUOUS = 4
    #: A detection that belongs to no source of the catalog.
    SPURIOUS = 8
    #: It has no flux: not detected on the high-resolution image, or no data.
    NOT_MEASURED = 16


#: Groups that are compared: the bits that are set, of those in question. Those of the first have none.
CONDITIONS = {
    "isolated": 0,
    "crowded": int(ConditionFlags.CROWDED),
    "edge": int(ConditionFlags.EDGE),
    "ambiguous": int(ConditionFlags.AMBIGUOUS),
}
_ANY = sum(CONDITIONS.values())
_DOUBTFUL = int(
    AssociationFlags.SEVERAL_FIRST | AssociationFlags.SEVERAL_SECOND | AssociationFlags.NOT_MUTUAL
)


def add_conditions(table, bands, *, suffix="", detections=False):
    """
    Add ``<band>_condition`` (`ConditionFlags`) to sources, or to detections (``detections``).

    The table has ``sky``, ``association`` (`~miricigale.evaluation.AssociationFlags`) and, for each band,
    the flux and ``<band>_flags``; neighbors are compared by the fluxes ``<band><suffix>``, ``"_true"``
    for the truth. Detections without a source are spurious.
    """
    association = np.asarray(table["association"])
    for name in bands:
        condition = np.zeros(len(table), int)
        at_edge = (np.asarray(table[f"{name}_flags"]) & photometry.ForcedFlags.EDGE) > 0
        condition[at_edge] |= int(ConditionFlags.EDGE)
        near = photometry.crowded(table["sky"], table[f"{name}{suffix}"])
        condition[near] |= int(ConditionFlags.CROWDED)
        condition[(association & _DOUBTFUL) > 0] |= int(ConditionFlags.AMBIGUOUS)
        if detections:
            alone = (association & AssociationFlags.NONE_NEAR) > 0
            condition[alone] |= int(ConditionFlags.SPURIOUS)
        condition[~np.isfinite(table[name].value)] |= int(ConditionFlags.NOT_MEASURED)
        table[f"{name}_condition"] = condition
        table[f"{name}_condition"].info.description = ConditionFlags.describe()


def any_condition(table, bands):
    """The conditions of each row in any of the bands."""
    return np.bitwise_or.reduce([np.asarray(table[f"{name}_condition"]) for name in bands])


def _groups(condition):
    """Rows of each group of `CONDITIONS`; a row may be in several but the first."""
    return {
        name: (condition & _ANY) == 0 if bit == 0 else (condition & bit) > 0
        for name, bit in CONDITIONS.items()
    }


def band_conditions(matched, name):
    """
    Count the sources of the field by condition, with how well each kind is measured in a band.

    Of ``matched`` (stage 12): ``n_field`` (galaxies and stars with a model), ``n_not_measured`` of
    them, and for each of `CONDITIONS` ``n`` of the measured ones, and ``n_bright``, ``median`` and
    ``scatter`` of measured over true flux minus one of those above five formal errors.
    """
    selection = np.asarray(matched["selection"])
    field = (selection & (SampleFlags.OUTSIDE_FIELD | SampleFlags.NO_MODEL)) == 0
    condition = np.asarray(matched[f"{name}_condition"])
    lost = (condition & ConditionFlags.NOT_MEASURED) > 0
    flux, true = matched[name].value, matched[f"{name}_true"].value
    with np.errstate(invalid="ignore"):
        bright = true > 5 * matched[f"{name}_formal_err"].value
    counts = {
        "n_field": int(np.count_nonzero(field)),
        "n_not_measured": int(np.count_nonzero(field & lost)),
    }
    for group, rows in _groups(condition).items():
        rows = rows & field & ~lost
        found = recovery_metrics(true[rows & bright], flux[rows & bright], relative=True)
        counts[group] = {
            "n": int(np.count_nonzero(rows)),
            "n_bright": found.n,
            "median": found.median,
            "scatter": found.sigma_mad,
        }
    return counts


def detection_counts(detections, bands):
    """
    Count the detections of ``photometry.ecsv`` (stage 12).

    ``n``, ``n_field`` and of these ``n_spurious``, ``n_ambiguous``, and by band the spurious ones above
    five formal errors (``n_spurious_bright``).
    """
    bands = list(bands)
    field = np.asarray(detections["in_field"], bool)
    condition = np.asarray(detections[f"{bands[0]}_condition"])
    spurious = field & ((condition & ConditionFlags.SPURIOUS) > 0)
    bright = {}
    for name in bands:
        with np.errstate(invalid="ignore"):
            seen = detections[name] > 5 * detections[error_column(name)]
        bright[name] = int(np.count_nonzero(spurious & seen))
    return {
        "n": len(detections),
        "n_field": int(field.sum()),
        "n_spurious": int(spurious.sum()),
        "n_ambiguous": int(np.count_nonzero(field & ((condition & ConditionFlags.AMBIGUOUS) > 0))),
        "n_spurious_bright": bright,
    }


def fit_conditions(sample, redshift, table, bands):
    """
    Quality of photometric redshifts by condition: ``n``, ``photoz_sigma_mad``, ``photoz_n_outliers``.

    ``sample`` are the rows of ``matched`` that were fitted, ``redshift`` the true redshifts and
    ``table`` the fits of the same sources, row by row; a source has a condition if it has it in one of
    the bands.
    """
    condition = any_condition(sample, bands)
    groups = {}
    for name, rows in _groups(condition).items():
        found = photoz_metrics(np.asarray(redshift)[rows], table["redshift_mean"][rows])
        groups[name] = {
            "n": found.n,
            "photoz_sigma_mad": found.sigma_mad,
            "photoz_n_outliers": found.n_outliers,
        }
    return groups
