import numpy as np
import pytest
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.evaluation import CLASS_NAMES, classify, confusion, selection_quality
from miricigale.evaluation.classes import sky_quality

TRUE = ["galaxy"] * 4 + ["composite"] * 2 + ["agn"] * 4
FOUND = ["galaxy"] * 3 + ["agn", "composite", "unknown"] + ["agn"] * 3 + ["composite"]


def test_confusion_of_a_table_by_hand():
    table = confusion(TRUE, FOUND)
    assert table["class"].tolist() == list(CLASS_NAMES)
    assert table["n"].tolist() == [4, 2, 4]
    counts = [table[name].tolist() for name in (*CLASS_NAMES, "unknown")]
    assert counts == [[3, 0, 0], [0, 1, 1], [1, 0, 3], [0, 1, 0]]
    assert_allclose(table["completeness"], [3 / 4, 1 / 2, 3 / 4])
    assert_allclose(table["purity"], [1, 1 / 2, 3 / 4])
    assert np.all(table["completeness_low"] <= table["completeness"])
    assert np.all(table["completeness_high"] >= table["completeness"])


def test_classes_have_the_published_limits():
    got = classify([0.0, 0.0999, 0.1, 0.39, 0.4, 1.0, np.nan]).tolist()
    assert got == ["galaxy"] * 2 + ["composite"] * 2 + ["agn"] * 2 + ["unknown"]
    got = classify([0.2, 0.5, 0.8], limits=(0.3, 0.7))
    assert got.tolist() == ["galaxy", "composite", "agn"]
    refuses("'frac_agn' must be between 0 and 1", classify, [1.2])


def test_purity_falls_with_the_share_of_wanted_sources_and_completeness_does_not():
    """Bayes: 90 % of AGN and 10 % of galaxies selected; AGN are half, or 1 of 10."""
    for n_agn, purity in ((1000, 0.9), (100, 0.09 / (0.09 + 0.09))):
        n_galaxies = 1000 if n_agn == 1000 else 900
        wanted = np.r_[np.ones(n_agn, bool), np.zeros(n_galaxies, bool)]
        selected = np.r_[np.arange(n_agn) < 0.9 * n_agn, np.arange(n_galaxies) < 0.1 * n_galaxies]
        quality = selection_quality(wanted, selected)
        assert quality.completeness.value == pytest.approx(0.9)
        assert quality.purity.value == pytest.approx(purity)

    # nothing selected has no purity
    quality = selection_quality([True, False], [False, False])
    assert np.isnan(quality.purity.value)
    assert quality.completeness.value == 0


def test_more_skies_of_the_same_galaxies_know_no_more_than_the_galaxies():
    """Half of 100 galaxies are found, alone or each in ten skies: the error is binomial, of 100."""
    galaxies, found = np.arange(100), np.arange(100) < 50
    one = sky_quality(galaxies, np.ones(100, bool), found, np.ones(100)).completeness
    assert one.error == pytest.approx(np.sqrt(0.25 / 100), rel=0.02)
    many = (np.repeat(array, 10) for array in (galaxies, np.ones(100, bool), found))
    ten = sky_quality(*many, np.full(1000, 0.1)).completeness
    assert (ten.value, ten.low, ten.high) == pytest.approx((one.value, one.low, one.high))
    assert (one.n, ten.n) == (100, 1000)
