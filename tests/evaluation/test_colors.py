import itertools

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.studies import mock_study
from miricigale.evaluation import (
    COLOR_WINDOWS,
    KIRKPATRICK_LIMITS,
    ColorCircles,
    ColorWindow,
    classify,
    color_classes,
    color_estimates,
    mid_infrared_fractions,
)
from miricigale.sed import SEDModel

NAMES = np.array(["agn", "composite", "galaxy"])


def rings(n, seed=1, *, edges=(0.0, 0.1, 0.2, 0.3, 0.5, 0.8), center=(0.2, 0.1), side=1.0):
    """AGN, composites and galaxies between radii about a point; AGN on a part of the circle only."""
    rng = np.random.default_rng(seed)
    kind = np.repeat([0, 1, 2], n)
    low, high = np.reshape(edges, (3, 2))[kind].T
    radius = rng.uniform(low, high)
    reach = np.where(kind == 0, side, 1.0) * np.pi
    angle = rng.uniform(-reach, reach)
    return center + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1), NAMES[kind]


def fluxes_of(colors):
    """Fluxes in the bands a, b and c of colors log a / b and log c / b."""
    a, c = 10 ** np.transpose(colors) * u.uJy
    return QTable({"a": a, "b": np.ones(a.size) * u.uJy, "c": c})


def test_circles_find_rings():
    colors, classes = rings(300)
    circles = ColorCircles.fit(colors, classes)
    assert circles.center == pytest.approx((0.2, 0.1), abs=0.02)
    assert 0.08 < circles.inner < 0.22
    assert 0.28 < circles.outer < 0.52
    fresh, truth = rings(300, seed=2)
    assert np.mean(circles.classify(fresh) == truth) > 0.95
    assert circles.classify([[np.nan, 0.0]]).tolist() == ["unknown"]


def test_center_is_found_where_it_is_not_the_median_of_the_agn():
    """AGN fill one side of the inner circle only, as those with silicate absorption do."""

    kind = {"edges": (0.2, 0.3, 0.38, 0.48, 0.6, 0.9), "center": (0, 0), "side": 0.5}
    colors, classes = rings(300, 1, **kind)
    circles = ColorCircles.fit(colors, classes)
    assert np.median(colors[classes == "agn"][:, 0]) > 0.15
    assert circles.center == pytest.approx((0.0, 0.0), abs=0.12)
    fresh, truth = rings(300, 2, **kind)
    assert np.mean(circles.classify(fresh) == truth) > 0.9
    # those about the median of the AGN do not
    near = np.hypot(*(fresh - np.median(colors[classes == "agn"], axis=0)).T)
    about = np.where(near <= 0.35, "agn", np.where(near <= 0.55, "composite", "galaxy"))
    assert np.mean(about == truth) < 0.85


def test_colors_are_logs_of_ratios():
    window = ColorWindow(0, 1, ("a", "b"), ("c", "b"))
    assert window.bands == ("a", "b", "c")
    fluxes = QTable({"a": [10.0, 1] * u.uJy, "b": [1.0, -1] * u.uJy, "c": [1e-3, 1] * u.mJy})
    assert_allclose(window.colors(fluxes), [[1, 0], [np.nan, np.nan]])


def test_sources_are_classified_by_circles_of_others():
    colors, classes = rings(200)
    window = ColorWindow(0.75, 1.25, ("a", "b"), ("c", "b"))
    fluxes, z = fluxes_of(colors), np.full(600, 1.0)
    z[:5] = 3.0
    found = color_classes(fluxes, z, classes, windows=[window], seed=1)
    assert found[:5].tolist() == ["unknown"] * 5
    assert np.mean(found[5:] == classes[5:]) > 0.95
    # classes without relation to colors are not found
    shuffled = np.random.default_rng(1).permutation(classes)
    found = color_classes(fluxes, z, shuffled, windows=[window], seed=1)
    assert np.mean(found[5:] == shuffled[5:]) < 0.5


def test_rows_of_one_source_stay_together():
    """Each source twice, with classes that have nothing to do with colors: its copy must not help."""
    rng = np.random.default_rng(3)
    fluxes = fluxes_of(np.tile(rng.normal(0, 0.3, (300, 2)), (2, 1)))
    classes = np.tile(rng.choice(NAMES, 300), 2)
    window = ColorWindow(0, 2, ("a", "b"), ("c", "b"))
    groups = np.tile(np.arange(300), 2)
    found = color_classes(fluxes, np.ones(600), classes, windows=[window], groups=groups, seed=1)
    assert_array_equal(found[:300], found[300:])


def test_colors_of_a_study():
    study = mock_study((0.0, 0.6), n=900)
    # the second color of each window separates the truths, the second truth is AGN or composite
    rng = np.random.default_rng(1)
    shares = {}
    for one in study.truths:
        share = np.full(900, one.frac_agn) + 0.3 * (one.frac_agn > 0) * (np.arange(900) % 2)
        shares[one.name] = share
        for window in COLOR_WINDOWS:
            for name in window.bands:
                one.matched[name] = np.ones(900) * u.uJy
        ratio = 10 ** (1 - share + rng.normal(0, 0.01, 900))
        one.matched["miri.f1500w"], one.matched["miri.f1800w"] = ratio**2 * u.uJy, ratio * u.uJy
    got = color_estimates(study, shares, seed=1)
    assert set(got) == {"colors.galaxy", "colors.composite", "colors.agn"}
    for name in ("galaxy", "composite", "agn"):
        estimate = got[f"colors.{name}"]
        assert estimate.value > 0.9
        # redshifts from 0.75 to 2.25 of 0.1 to 4
        assert estimate.completeness == pytest.approx(1.5 / 3.9, abs=0.1)
    assert color_estimates(study, {}, seed=1) == {}


def test_windows_follow_each_other():
    for one, after in itertools.pairwise(COLOR_WINDOWS):
        assert one.z_high == after.z_low
    # those of Kirkpatrick et al. 2017 at redshifts 0.75 to 1.25
    known = {f"miri.f{n}w" for n in (770, 1000, 1500, 1800)}
    assert set(COLOR_WINDOWS[0].bands) == known


def test_colors_tell_models_apart():
    """Shares of each class that are found, 79, 76 and 87 % with templates of Kirkpatrick et al. 2017."""
    model, n = SEDModel.yang2021(), 120
    rng = np.random.default_rng(5)
    frac = np.tile([0.0, 0.2, 0.6, 0.99], n)
    table = QTable({
        "redshift": np.repeat(rng.uniform(0.75, 1.25, n), 4),
        "age": np.repeat(rng.choice([1.0, 3.0, 5.0], n), 4) * u.Gyr,
        "tau": np.repeat(rng.choice([0.5, 1.0, 5.0], n), 4) * u.Gyr,
        "ebv": np.repeat(rng.choice([0.2, 0.4, 0.7], n), 4),
        "alpha": np.repeat(rng.choice([1.5, 2.0, 2.5], n), 4),
        "inclination": np.repeat(rng.choice([60.0, 70.0, 80.0, 90.0], n), 4) * u.deg,
        "tau97": np.repeat(rng.choice([3.0, 5.0, 7.0, 9.0], n), 4),
        "frac_agn": frac,
    })  # fmt: skip
    fluxes = model.fluxes(table, COLOR_WINDOWS[0].bands)
    shares = np.where(frac > 0, mid_infrared_fractions(model, table), 0.0)
    true = classify(shares, limits=KIRKPATRICK_LIMITS)
    kind = {"windows": COLOR_WINDOWS[:1], "groups": np.repeat(np.arange(n), 4)}
    found = color_classes(fluxes, table["redshift"], true, seed=1, **kind)
    shares = [np.mean(found[true == name] == name) for name in NAMES]
    assert min(shares) > 0.65
    assert np.mean(shares) > 0.75


def test_circles_need_agn_and_are_by_distance():
    got = ColorCircles((0.0, 0.0), 1.0, 2.0).classify([[0.6, 0.6], [1.2, 1.2], [2.0, 2.0]])
    assert got.tolist() == ["agn", "composite", "galaxy"]
    refuses("'classes' must be with an AGN that has colors", ColorCircles.fit, [[0, 0]], ["galaxy"])
