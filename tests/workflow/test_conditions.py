"""Conditions of sources and detections: each code by itself, none dropped."""

import astropy.units as u
import numpy as np
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from miricigale.evaluation import associate, match_truth
from miricigale.photometry import ForcedFlags
from miricigale.workflow.stages.conditions import (
    CONDITIONS,
    ConditionFlags,
    add_conditions,
    band_conditions,
    detection_counts,
)

BAND = "miri.f770w"


def make():
    """Six sources in a row: crowded, its bright neighbor, at the edge, ambiguous, alone, not found."""
    x = np.array([0.0, 1.5, 10.0, 20.0, 30.0, 40.0])
    truth = QTable({"id": np.arange(6), "sky": SkyCoord(x * u.arcsec, 0 * x * u.arcsec)})
    # 0.9 mag fainter than its neighbor, which is not 1 mag brighter than itself
    truth[BAND] = [10.0, 30.0, 10.0, 10.0, 10.0, 10.0] * u.uJy
    y = np.array([0.0, 1.5, 10.0, 20.0, 20.4, 30.0, 50.0])
    found = QTable({"id": np.arange(7) + 100, "sky": SkyCoord(y * u.arcsec, 0 * y * u.arcsec)})
    found[BAND] = [10.0, 30.0, 10.0, 10.0, 9.0, np.nan, 8.0] * u.uJy
    found[f"{BAND}_err"] = np.ones(7) * u.uJy
    found[f"{BAND}_flags"] = [0, 0, ForcedFlags.EDGE | ForcedFlags.BLENDED, 0, 0, 4, 0]
    return truth, found, match_truth(truth, found, [BAND], radius=0.5 * u.arcsec)


def test_each_condition_has_its_own_code():
    truth, found, matched = make()
    add_conditions(matched, [BAND], suffix="_true")
    flags = ConditionFlags
    assert list(matched[f"{BAND}_condition"]) == [
        flags.CROWDED, 0, flags.EDGE, flags.AMBIGUOUS, flags.NOT_MEASURED, flags.NOT_MEASURED,
    ]  # fmt: skip
    table = associate(truth, found, radius=0.5 * u.arcsec)
    table = table[table["second"] >= 0]
    found["association"] = np.zeros(7, int)
    found["association"][table["second"]] = table["reasons"]
    add_conditions(found, [BAND], detections=True)
    assert list(found[f"{BAND}_condition"]) == [
        flags.CROWDED, 0, flags.EDGE, flags.AMBIGUOUS | flags.CROWDED,
        flags.AMBIGUOUS | flags.CROWDED, flags.NOT_MEASURED, flags.SPURIOUS,
    ]  # fmt: skip


def test_counts_add_up_to_the_sources_of_the_field():
    _, found, matched = make()
    matched[f"{BAND}_formal_err"] = matched[f"{BAND}_err"]
    matched["selection"] = [0, 0, 0, 0, 16, 8]
    add_conditions(matched, [BAND], suffix="_true")
    counts = band_conditions(matched, BAND)
    assert counts["n_field"] == 6
    assert counts["n_not_measured"] == 2
    # here no source has two conditions
    assert {name: counts[name]["n"] for name in CONDITIONS} == dict.fromkeys(CONDITIONS, 1)
    assert counts["isolated"]["median"] == 0
    matched["selection"][0] = 1
    assert band_conditions(matched, BAND)["crowded"]["n"] == 0
    found["association"] = [0, 0, 0, 1, 4, 0, 8]
    found["in_field"] = np.ones(7, bool)
    add_conditions(found, [BAND], detections=True)
    assert detection_counts(found, [BAND]) == {
        "n": 7, "n_field": 7, "n_spurious": 1, "n_ambiguous": 2, "n_spurious_bright": {BAND: 1},
    }  # fmt: skip
