"""What tells sources and detections apart without leaving them out: edges, neighbors, doubtful matches."""

import numpy as np

from miricigale import photometry
from miricigale.evaluation import AssociationFlags, photoz_metrics, recovery_metrics
from miricigale.pages import number
from miricigale.utils.tables import Flags, error_column
from miricigale.workflow.stages.figures import SET_LABELS, band_label
from miricigale.workflow.stages.sample import SampleFlags

__all__ = [
    "CONDITIONS",
    "MARKS",
    "ConditionFlags",
    "add_conditions",
    "any_condition",
    "band_conditions",
    "detection_counts",
    "fit_conditions",
    "write_conditions",
    "write_fits",
    "write_left_out",
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
#: How sources are marked in figures: bit, marker and label.
MARKS = (
    (int(ConditionFlags.CROWDED), "o", "crowded"),
    (int(ConditionFlags.EDGE), "s", "at the edge"),
)
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
    Count the sources of the field by condition, and tell how well each kind is measured in a band.

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


def write_left_out(report, metrics):
    """Why sources of the catalog are not in the fit."""
    report.table(
        [(name.replace("_", " "), n) for name, n in metrics["n_left_out"].items()],
        header=("reason", "sources"),
        caption=f"Why sources of the catalog ({metrics['n_catalog']}) are not in the fit "
        f"({metrics['n_sample']}), each for one reason or more",
    )


def write_conditions(report, metrics):
    """Tables of the sources of the field and of the detections by condition."""
    rows = []
    for name, entry in metrics["bands"].items():
        counts = entry["conditions"]
        cells = [_told(counts[group]) for group in CONDITIONS]
        rows.append((band_label(name), counts["n_field"], counts["n_not_measured"], *cells))
    report.table(
        rows,
        header=("band", "in the field", "no flux", *CONDITIONS),
        caption="Sources of the field by condition: their number, and median and scatter of measured "
        "over true flux minus one of those above 5 sigma. Crowded: a neighbor within 2 arcsec is "
        "brighter than the magnitude plus one; edge: more than a tenth of the light falls off the "
        "image; ambiguous: the match to the detections is not the only one possible; isolated: "
        f"none of these. A source may be in several of the three; fewer than {_FEWEST} above 5 sigma are "
        "counted only",
    )
    found = metrics["detections"]
    bright = found["n_spurious_bright"]
    report.table(
        [
            ("detections in the field", found["n_field"]),
            ("of them spurious: no source of the catalog is near", found["n_spurious"]),
            ("of them ambiguous", found["n_ambiguous"]),
            *(
                (f"spurious above 5 sigma in {band_label(name)}", count)
                for name, count in bright.items()
            ),
        ],
        header=("high-resolution image", "number"),
        caption=f"Detections of the high-resolution image ({found['n']} in all)",
    )


#: Fewest sources whose offset and scatter are told.
_FEWEST = 5


def _told(found):
    """Number of a group, and offset and scatter of its bright ones, in one cell."""
    # a scatter of fewer says nothing
    if not np.isfinite(found["median"]) or found["n_bright"] < _FEWEST:
        return f"{found['n']}"
    return f"{found['n']}: {100 * found['median']:+.1f} ± {100 * found['scatter']:.1f} %"


def write_fits(report, metrics):
    """Photometric redshifts by condition."""
    none = "no such source in the fit"
    report.table(
        [
            (
                SET_LABELS[unit],
                group,
                found["n"],
                number(found["photoz_sigma_mad"], ".4f", none),
                found["photoz_n_outliers"],
            )
            for unit, entry in metrics["fits"].items()
            for group, found in entry["conditions"].items()
        ],
        header=("fit", "condition in any band", "sources", "sigma_MAD", "outliers"),
        caption="Photometric redshifts by condition",
        text=2,
    )
