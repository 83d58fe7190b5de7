"""Showers after large hits: what they leave in the slopes, and what cutting them costs."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.ndimage import gaussian_filter

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from miricigale.detector import CosmicRays, Detector
from miricigale.instrument import DQ, flat_field, photmjsr
from miricigale.reduction import RampSettings, Reducer

BAND, SKY, WIDTH = "miri.f770w", 5.1, 4.0


def expose(*, fraction, seed=2):
    exposure = exposure_of(BAND, n_groups=30, subarray="BRIGHTSKY")
    # charge is not shared: neighbors are independent
    light = np.full(exposure.shape, SKY)
    light[100:400:50, 100:400:50] = 4000.0
    sky = sky_of(exposure, light, psf_includes=["ipc"])
    rays = CosmicRays(shower_fraction=fraction, shower_above=5e4, shower_charge=1e5)
    ramp = Detector.miri_imager(rays).expose(sky, exposure, seed=seed, n_threads=1)
    return ramp, light * flat_field(BAND, subarray="BRIGHTSKY") / photmjsr(BAND)


def smoothed_pull(fit, truth):
    """Pulls, and their mean over some pixels in its own standard deviation."""
    pull = (fit.rate - truth) / fit.error
    good = np.isfinite(pull)
    weight = np.maximum(gaussian_filter(good.astype(float), WIDTH), 0.1)
    mean = gaussian_filter(np.where(good, pull, 0), WIDTH) / weight
    return pull[good], (mean * 2 * np.sqrt(np.pi) * WIDTH)[good]


@pytest.mark.slow
def test_showers_of_large_hits_are_cut():
    ramp, truth = expose(fraction=1.0)
    left = smoothed_pull(Reducer().fit_groups(ramp), truth)
    cut = smoothed_pull(Reducer(ramps=RampSettings(shower_threshold=5)).fit_groups(ramp), truth)
    # a tenth of the pixels lie in clouds that single pixels do not show
    assert np.mean(left[1] > 5) > 0.1
    assert np.mean(cut[1] > 5) < 0.005
    assert np.std(left[0]) > 1.05
    assert np.std(cut[0]) == pytest.approx(1, abs=0.01)
    assert abs(np.mean(cut[0])) < 0.02


@pytest.mark.slow
def test_without_showers_nothing_else_is_cut():
    ramp, truth = expose(fraction=0.0)
    plain = Reducer().fit_groups(ramp)
    fit = Reducer(ramps=RampSettings(shower_threshold=5)).fit_groups(ramp)
    changed = fit.flags != plain.flags
    assert np.mean(changed) < 1e-3
    assert not np.any((fit.flags ^ plain.flags) & int(DQ.DO_NOT_USE))
    same = ~changed & np.isfinite(plain.rate) & (fit.n_used == plain.n_used)
    assert_array_equal(fit.rate[same], plain.rate[same])
    assert np.std(smoothed_pull(fit, truth)[0]) == pytest.approx(1, abs=0.01)


def test_a_wrong_threshold_is_named():
    refuses("'shower_threshold' must be positive or None", RampSettings, shower_threshold=0)
