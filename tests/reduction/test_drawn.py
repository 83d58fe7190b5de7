"""Drawn slopes against those that are fitted to the ramps of the same exposures."""

import dataclasses
import functools

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.exposures import FIELD, exposure_of, sky_of
from miricigale.detector import CosmicRays, Detector, FirstFrame, LastFrame, ResetAnomaly, Residual
from miricigale.instrument import DQ, background_level, miri_detector
from miricigale.reduction import RampSettings, Reducer

STORM = CosmicRays(flux=8e-7)  # ten times as many as there are
F770W = ("miri.f770w", 200, 1)
F2100W = ("miri.f2100w", 10, 28)


def mode_of(band, n_groups, n_integrations, dither=0):
    pointing = FIELD.directional_offset_by(1 * u.rad, dither * 1.37 * u.arcsec)
    options = {"n_groups": n_groups, "n_integrations": n_integrations, "dither": dither}
    return exposure_of(band, pointing=pointing, **options)


def both(exposure, light, *effects, seed=1, without=(), reducer=None, properties=None):
    """Fits to the ramp, and to what was collected, of one exposure; and the true slope."""
    reducer = Reducer() if reducer is None else reducer
    detector = Detector.miri_imager(*effects, properties=properties).without(*without)
    image = sky_of(exposure, light)
    ramp, charge = (
        make(image, exposure, seed=seed) for make in (detector.expose, detector.collect)
    )
    fits = [reducer.fit_groups(exposed) for exposed in (ramp, charge)]
    return fits, (charge.mean - miri_detector().dark_current) / miri_detector().gain


@functools.cache
def stormy(mode, neighbor_threshold=5.0):
    """Both fits in a storm of cosmic rays."""
    reducer = Reducer(ramps=RampSettings(neighbor_threshold=neighbor_threshold))
    return both(mode_of(*mode), background_level(mode[0]).value, STORM, reducer=reducer)


def inside(array):
    """Without the rim, whose neighbors are not on the image, and without unusable pixels."""
    return array[1:-1, 1:-1]


def pulls(fit, truth):
    return inside((fit.rate - truth) / fit.error)


@pytest.mark.parametrize(
    ("mode", "effects", "without"),
    [
        (F770W, (STORM, Residual("etc")), ()),
        (F770W, (), (CosmicRays,)),
        (F2100W, None, ()),
        (F2100W, (Residual("etc"),), (CosmicRays,)),
        (("miri.f560w", 6, 2), (CosmicRays(flux=1e-5),), ()),
        (("miri.f1000w", 3, 1), (STORM,), ()),
    ],
)
def test_slopes_have_the_noise_of_the_fit(mode, effects, without):
    level = background_level(mode[0]).value
    if effects is None:
        (fitted, drawn), truth = stormy(mode)
    else:
        (fitted, drawn), truth = both(mode_of(*mode), level, *effects, without=without)
    assert_array_equal(np.isnan(inside(drawn.rate)), np.isnan(inside(fitted.rate)))
    good = np.isfinite(inside(drawn.rate))
    n = good.sum()
    for fit in (fitted, drawn):
        pull = pulls(fit, truth)[good]
        assert 0.98 < pull.std() < 1.03
        # errors follow the slopes, which lowers the mean pull of short exposures
        assert abs(pull.mean()) < 0.02
        off, error = (inside(one)[good].mean() for one in (fit.rate - truth, fit.error))
        assert abs(off) < max(5 * error / np.sqrt(n), 1e-3 * np.nanmedian(truth))
        assert np.mean(np.abs(pull) > 5) < 1e-3
    ratio = inside(drawn.error)[good] / inside(fitted.error)[good]
    assert_allclose(np.median(ratio), 1, atol=2e-3)
    assert_allclose(np.mean(ratio), 1, atol=2e-3)
    clean = inside((fitted.flags | drawn.flags) == 0)
    for part in ("var_poisson", "var_read"):
        a, b = (inside(getattr(fit, part))[clean] for fit in (fitted, drawn))
        noise = np.hypot(a.std(), b.std()) / np.sqrt(clean.sum())
        assert_allclose(b.mean(), a.mean(), rtol=1e-3, atol=5 * noise)
    used = (inside(fit.n_used)[good].mean() for fit in (drawn, fitted))
    assert_allclose(*used, rtol=1e-3)


@pytest.mark.parametrize("mode", [F770W, F2100W])
@pytest.mark.parametrize(("neighbor_threshold", "within"), [(10.0, 0.02), (5.0, 0.04)])
def test_the_same_hits_are_found_and_cost_the_same(mode, neighbor_threshold, within):
    """A jump of 5 sigma is decided by the noise and cuts four neighbors, so that those differ more by default."""
    (fitted, drawn), truth = stormy(mode, neighbor_threshold)
    hit = (fitted.flags & DQ.JUMP_DET) != 0
    assert 0.2 < hit.mean() < 0.6
    assert len(drawn.jumps) == pytest.approx(len(fitted.jumps), rel=0.02)
    for flag in (DQ.JUMP_DET, DQ.JUMP_NEIGHBOR, DQ.SATURATED):
        a, b = ((fit.flags & flag) != 0 for fit in (fitted, drawn))
        part = 0.02 if flag == DQ.SATURATED else within
        assert b.sum() == pytest.approx(a.sum(), rel=part, abs=3 * np.sqrt(a.sum()))
        # those about the threshold are told by the noise
        assert np.mean(a != b) < 0.02 + 0.03 * a.mean()
    hit &= (drawn.flags & DQ.JUMP_DET) != 0
    assert_allclose(np.nanmean(drawn.error[hit] / fitted.error[hit]), 1, atol=2e-3)
    widths = [np.nanstd(((fit.rate - truth) / fit.error)[hit]) for fit in (fitted, drawn)]
    assert_allclose(widths, 1, atol=0.03)
    # significances of jumps that both know
    sure = [np.abs(fit.jumps["significance"]) > 20 for fit in (fitted, drawn)]
    assert np.sum(sure[1]) == pytest.approx(np.sum(sure[0]), rel=0.02)


def test_hits_that_are_not_cut_stay_where_they_are():
    reducer = Reducer(jump_threshold=None)
    level = background_level("miri.f770w").value
    (fitted, drawn), truth = both(mode_of(*F770W), level, STORM, reducer=reducer)
    assert len(drawn.jumps) == 0
    one, other = pulls(fitted, truth), pulls(drawn, truth)
    assert np.nanmean(one > 5) > 0.1
    # pixel by pixel the same shift, so that the difference has the noise of two fits
    usual = np.abs(one) < 100
    assert np.nanstd((other - one)[usual]) == pytest.approx(np.sqrt(2), rel=0.03)
    assert np.nanmean((other - one)[usual]) == pytest.approx(0, abs=0.03)


@pytest.mark.slow
def test_one_hit_costs_one_difference_of_its_pixel():
    """Two in one integration, neither of which fills the well, cost one and what follows the second."""
    exposure = exposure_of("miri.f770w", n_groups=30, subarray="SUB64")
    detector, image = Detector.miri_imager().without(CosmicRays), sky_of(exposure, 5.0)
    charge = detector.collect(image, exposure, seed=1)
    full = charge.limit(65535.0 - miri_detector().bias)
    # of the type that cosmic rays have, for which the kernel is compiled
    places = np.array([[10, 5, 20], [30, 20, 20], [40, 50, 50]], np.int32)
    electrons = np.array([2e4, 0.7 * full, 0.7 * full])
    reducer = Reducer(ramps=RampSettings(neighbor_threshold=None))
    for n, used in ((1, (28, 29)), (3, (28, 18))):
        hits = {"hits": places[:, :n].copy(), "hit_electrons": electrons[:n]}
        fit = reducer.fit_groups(dataclasses.replace(charge, **hits))
        assert (fit.n_used[30, 40], fit.n_used[20, 50]) == used


@pytest.mark.slow
def test_hits_below_the_threshold_make_the_same_tails():
    reducer = Reducer(jump_threshold=20, ramps=RampSettings(neighbor_threshold=None))
    level = background_level("miri.f770w").value
    tails = []
    for seed in range(5):
        fits, truth = both(mode_of(*F770W), level, STORM, reducer=reducer, seed=seed)
        tails.append([np.sum(pulls(fit, truth) > 5) for fit in fits])
    fitted, drawn = np.sum(tails, axis=0)
    assert fitted > 1500
    assert drawn == pytest.approx(fitted, rel=0.05)


def test_errors_follow_the_light_up_to_saturation():
    exposure = mode_of("miri.f770w", 40, 2)
    light = np.broadcast_to(np.geomspace(1, 2e6, exposure.shape[1]), exposure.shape)
    (fitted, drawn), truth = both(exposure, light, STORM)
    first = np.isnan(fitted.rate).mean(axis=0)
    assert 0.05 < np.mean(first > 0.9) < 0.9
    assert_allclose(np.isnan(drawn.rate).mean(axis=0), first, atol=0.03)
    for flag in (DQ.SATURATED, DQ.NO_SLOPE | DQ.DO_NOT_USE):
        a, b = ((fit.flags & flag) != 0 for fit in (fitted, drawn))
        assert np.mean(a != b) < 2e-3
    bins = np.array_split(np.arange(1, exposure.shape[1] - 1), 16)
    for columns in bins:
        ratio = (drawn.error / fitted.error)[1:-1, columns]
        if np.isfinite(ratio).mean() < 0.5:
            continue
        assert_allclose(np.nanmedian(ratio), 1, atol=0.01)
        assert_allclose(np.nanmean(ratio), 1, atol=0.02)
        # slopes that stand on one or two groups judge their own error
        widths = [np.nanstd(((f.rate - truth) / f.error)[1:-1, columns]) for f in (fitted, drawn)]
        assert_allclose(widths[1], widths[0], rtol=0.05)
        assert_allclose(widths[1], 1, atol=0.05)


def test_what_the_reduction_assumes_need_not_be_true():
    known = miri_detector()
    curve = (0.0, 1.0, *(1.3 * c for c in known.nonlinearity[2:]))
    noise = {"gain": 1.01 * known.gain, "read_noise": 1.3 * known.read_noise}
    options = {"properties": known.replace(**noise, nonlinearity=curve), "without": (CosmicRays,)}
    exposure = mode_of("miri.f770w", 60, 1)
    light = np.broadcast_to(np.geomspace(1, 200, exposure.shape[1]), exposure.shape)
    reducer = Reducer(references="simulated")
    (fitted, drawn), truth = both(exposure, light, reducer=reducer, **options)
    for columns in np.array_split(np.arange(1, exposure.shape[1] - 1), 8):
        off = [(fit.rate - truth)[1:-1, columns] for fit in (fitted, drawn)]
        mean = [np.nanmean(o / truth[1:-1, columns]) for o in off]
        error = np.nanstd(off[0] / truth[1:-1, columns]) / np.sqrt(off[0].size)
        assert_allclose(mean[1], mean[0], atol=6 * error)
        scatter = [np.nanstd(o / fitted.error[1:-1, columns]) for o in off]
        assert_allclose(scatter[1], scatter[0], rtol=0.05)
    assert abs(mean[0] + 0.01) > 5 * error


def test_what_resets_do_is_undone_or_stays_as_in_the_ramps():
    exposure = mode_of("miri.f1500w", 12, 3)
    resets = (ResetAnomaly(), FirstFrame(), LastFrame())
    level = background_level("miri.f1500w").value
    for reducer, low in (
        (Reducer(reset_anomaly=ResetAnomaly()), False),
        (Reducer(skip_first=2, skip_last=1), True),
    ):
        options = {"without": (CosmicRays,), "reducer": reducer}
        (fitted, drawn), truth = both(exposure, level, *resets, **options)
        means = [np.nanmean(inside(fit.rate - truth)) for fit in (fitted, drawn)]
        sigma = np.nanmean(inside(fitted.error)) / 256
        assert_allclose(means[1], means[0], atol=6 * sigma)
        assert (means[1] > 5 * sigma) == low
        assert_allclose(np.nanmedian(drawn.error), np.nanmedian(fitted.error), rtol=2e-3)


def test_images_of_both_go_on_alike():
    exposure = mode_of("miri.f1000w", 20, 1)
    detector, reducer = Detector.miri_imager(), Reducer()
    image = sky_of(exposure, 11.5)
    fitted = reducer.fit_ramp(detector.expose(image, exposure, seed=1))
    drawn = reducer.fit_ramp(detector.collect(image, exposure, seed=1))
    assert drawn.unit == fitted.unit
    assert set(drawn.meta) == set(fitted.meta)
    changing = {"created", "n_jumps", "noise_correction"}
    for key in set(drawn.meta) - changing:
        assert drawn.meta[key] == fitted.meta[key]
    corrections = [image.meta["noise_correction"] for image in (drawn, fitted)]
    assert_allclose(*corrections, rtol=1e-3)
    assert drawn.data.dtype == fitted.data.dtype
    assert drawn.flags.dtype == fitted.flags.dtype
    assert_array_equal(drawn.mask, (drawn.flags & DQ.DO_NOT_USE) != 0)
    cal, background = reducer.subtract_background(reducer.calibrate(drawn))
    assert cal.unit == "MJy / sr"
    assert np.median(background.level) == pytest.approx(11.5, rel=0.01)


def test_same_seed_same_slopes_on_any_number_of_threads():
    exposure = mode_of("miri.f1000w", 20, 1)
    image = sky_of(exposure, 11.5)
    detector, reducer = Detector.miri_imager(STORM), Reducer()
    one, two, other = (
        reducer.replace(n_threads=n).fit_groups(
            detector.collect(image, exposure, seed=seed, n_threads=n)
        )
        for seed, n in ((3, 1), (3, 3), (4, 2))
    )
    for name in ("rate", "var_poisson", "var_read", "n_used", "n_jump", "flags", "jumps"):
        assert_array_equal(getattr(one, name), getattr(two, name))
    assert np.nanmean(one.rate == other.rate) < 0.01
