"""What is collected without groups against the ramps, counts and closed forms."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.detector import (
    ADConversion,
    BadPixels,
    CosmicRays,
    Dark,
    Detector,
    Effect,
    InterpixelCapacitance,
    Latent,
    Persistence,
    Photons,
    ReadNoise,
    ReferencePixels,
    Residual,
)
from miricigale.instrument import electrons_per_brightness, flat_field, miri_detector

SHAPE = {"n_groups": 12, "n_integrations": 3}


@pytest.fixture
def collect(make_exposure, make_sky):
    def run(detector, *, level=10.0, seed=1, includes=("pixel", "ipc"), previous=None, **options):
        exposure = make_exposure(**(SHAPE | options))
        sky = make_sky(exposure, level, includes=includes)
        return detector.collect(sky, exposure, seed=seed, previous=previous)

    return run


def test_electrons_are_poisson_numbers_of_the_mean(collect):
    charge = collect(Detector((Photons(), Dark(), ADConversion())), subarray="SUB256")
    flat = flat_field("miri.f770w", subarray="SUB256")
    rate = 10.0 * electrons_per_brightness("miri.f770w") * flat + miri_detector().dark_current
    assert_allclose(charge.mean, rate, rtol=1e-6)
    expected = rate * charge.total_time
    chi = (charge.electrons - expected) / np.sqrt(expected)
    assert abs(chi.mean()) < 5 / 256
    assert abs(chi.var() - 1) < 5 * np.sqrt(2) / 256
    step = charge.exposure.group_time.to_value("s")
    assert charge.total_time == pytest.approx(36 * step, rel=1e-12)
    assert len(charge.hit_electrons) == 0


def test_coupled_neighbors_share_the_noise_and_keep_the_mean(collect):
    detector = Detector((Photons(flat=False), InterpixelCapacitance(), ADConversion()))
    charge = collect(detector, includes=(), subarray="SUB256")
    assert_allclose(charge.mean, 10.0 * electrons_per_brightness("miri.f770w"), rtol=1e-12)
    noise = (charge.electrons - charge.mean * charge.total_time)[1:-1, 1:-1]
    noise /= np.sqrt(charge.mean * charge.total_time)[1:-1, 1:-1]
    kernel = miri_detector().ipc_kernel
    assert noise.var() == pytest.approx(np.sum(kernel**2), rel=0.03)
    beside = np.sum(kernel[:, 1:] * kernel[:, :-1])
    assert np.mean(noise[:, 1:] * noise[:, :-1]) == pytest.approx(beside, abs=0.02)


def test_flags_are_those_of_the_ramp_and_unusable_pixels_have_no_mean(
    collect, make_exposure, make_sky
):
    detector = Detector.miri_imager()
    charge = collect(detector, subarray="FULL", n_groups=2, n_integrations=1)
    exposure = make_exposure(subarray="FULL", n_groups=2)
    ramp = detector.expose(make_sky(exposure, 10.0), exposure, seed=1)
    assert_array_equal(charge.pixel_dq, ramp.pixel_dq)
    assert_array_equal(np.isnan(charge.mean), ramp.pixel_dq != 0)
    assert charge.effects == ramp.effects
    assert charge.shows(Dark)
    assert not charge.shows(Residual)


def test_hits_are_those_of_the_ramp(make_block):
    rays = CosmicRays(flux=2e-5, shower_fraction=0.01)
    block = make_block(subarray="SUB64", **SHAPE)
    ramp = rays.apply(np.zeros(block.ramp_shape, np.float32), block)
    where, electrons = rays.hits(block)
    assert np.all(np.diff(where[0]) >= 0)
    came = np.zeros((36, *ramp.shape[2:]))
    np.add.at(came, tuple(where), electrons)
    kept = came.reshape(ramp.shape).cumsum(axis=1)
    assert came.sum() > 1e6
    assert_allclose(kept, ramp, rtol=1e-5, atol=1e-2)


def test_hits_of_the_detector_do_not_depend_on_its_blocks(collect, monkeypatch):
    detector = Detector.miri_imager(CosmicRays(flux=2e-6))
    charge = collect(detector)
    monkeypatch.setattr("miricigale.detector.work._ROWS", 7)
    other = collect(detector)
    assert_array_equal(charge.electrons, other.electrons)
    assert_array_equal(charge.mean, other.mean)
    order, same = (np.lexsort((c.hit_electrons, *c.hits)) for c in (charge, other))
    assert_array_equal(charge.hits[:, order], other.hits[:, same])
    assert_array_equal(charge.hit_electrons[order], other.hit_electrons[same])


def test_residual_pattern_is_that_of_the_ramp(collect):
    smooth = Detector.miri_imager().without(BadPixels, ReferencePixels)
    uneven = smooth.replace(Residual(0.01))
    plain, rough, again = collect(smooth), collect(uneven), collect(uneven, seed=7)
    share = (rough.mean - 0.2) / (plain.mean - 0.2) - 1
    assert share.std() == pytest.approx(0.01, rel=0.2)
    assert_array_equal(again.mean, rough.mean)


def test_latent_images_are_collected(collect, make_exposure):
    shape = make_exposure().shape
    latent = Latent(np.full(shape, 5e4) * u.electron / u.s, 20 * u.s, "SUB64")
    detector = Detector((Photons(), Persistence(), ADConversion()))
    before, after = collect(detector), collect(detector, previous=latent)
    released = Persistence().released(after.exposure, latent.gap).sum() * 5e4
    assert_allclose((after.mean - before.mean) * after.total_time, released, rtol=1e-9)
    assert np.mean(after.electrons - before.electrons) == pytest.approx(released, rel=0.01)


def test_what_cannot_be_collected_is_refused(collect):
    class Glow(Effect):
        pass

    wanted = "'effects' must be the package's own, without 1/f noise"
    refuses(wanted, collect, Detector.miri_imager(ReadNoise(pink=2.0)))
    refuses(f"{wanted}.*Glow", collect, Detector((Photons(), Glow(), ADConversion())))
