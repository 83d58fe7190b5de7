"""Exposures that go to disk block by block are those that were held in memory."""

import tracemalloc

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time
from numpy.testing import assert_array_equal

from miricigale.detector import (
    BrighterFatter,
    CosmicRays,
    Detector,
    FirstFrame,
    LastFrame,
    Latent,
    Persistence,
    Ramp,
    ReadNoise,
    ResetAnomaly,
    ResetDecay,
    Residual,
)

LATENT = Persistence((0.01,), (np.float32(20),), deficit=0.02)
RESETS = LATENT, BrighterFatter(0.2), ResetAnomaly(), ResetDecay()
FRAMES = FirstFrame(), LastFrame()
EVERYTHING = CosmicRays(shower_fraction=0.2), Residual(0.01), ReadNoise(pink=2.0), *RESETS, *FRAMES


def test_the_file_is_the_same_with_every_effect(make_exposure, make_sky, tmp_path, set_block_size):
    exposure = make_exposure(n_groups=5, n_integrations=2, subarray="SUB128")
    detector = Detector.miri_imager(*EVERYTHING)
    sky = make_sky(exposure, 300.0, includes=())
    before = detector.expose(make_sky(exposure, 2e4), exposure.replace(dither=1), seed=1)
    options = {"seed": 5, "previous": Latent.from_ramp(before, before.exposure.frame_time)}
    start = Time("2023-01-02T03:04:05")
    held = detector.expose(sky, exposure, **options)
    one = held.write(tmp_path / "a_uncal.fits", start=start)
    # an odd number of rows, so that pairs that are reset together are in two blocks
    set_block_size(136 * 10 * 7)
    two = detector.expose_to(
        tmp_path / "b_uncal.fits", sky, exposure, start=start, n_threads=3, **options
    )
    back = Ramp.read(two)
    assert_array_equal(back.data, held.data)
    assert_array_equal(back.pixel_dq, held.pixel_dq)
    assert back.effects == held.effects == detector.effects
    assert back.meta == {**held.meta, "created": back.meta["created"]}
    # card by card, but for the moments at which they were made
    with fits.open(one) as first, fits.open(two) as second:
        first.verify("exception")
        second.verify("exception")
        ignored = ["DATE", "FILENAME"]
        for a, b in zip(first[:3], second[:3], strict=True):
            assert fits.HeaderDiff(a.header, b.header, ignore_keywords=ignored).identical
    assert one.stat().st_size == two.stat().st_size


def test_memory_is_that_of_the_blocks(make_exposure, make_sky, tmp_path, set_block_size):
    exposure = make_exposure(n_groups=150, subarray="SUB256")
    detector = Detector.miri_imager()
    sky = make_sky(exposure, 5.0)
    detector.expose(sky, exposure.replace(n_groups=2), seed=0)
    set_block_size(2**18)
    tracemalloc.start()
    try:
        detector.expose_to(tmp_path / "a_uncal.fits", sky, exposure, seed=0, n_threads=2)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    n_counts = 150 * exposure.shape[0] * exposure.shape[1]
    # two threads, each with 2^18 samples as float32, flags, counts and what is being written;
    # the image, its copies and the flags of pixels; far below the 2 bytes of all counts
    assert peak < 0.75 * 2 * n_counts
    assert (tmp_path / "a_uncal.fits").stat().st_size > 2 * n_counts


def test_nothing_is_left_of_a_failure(make_exposure, make_sky, tmp_path, monkeypatch):
    exposure = make_exposure(n_groups=2)
    detector, sky = Detector.miri_imager(), make_sky(exposure, 1.0)
    path = tmp_path / "a_uncal.fits"

    def fail(self, array, block):
        msg = "no"
        raise RuntimeError(msg)

    with monkeypatch.context() as patch:
        patch.setattr(ReadNoise, "apply", fail)
        with pytest.raises(RuntimeError):
            detector.expose_to(path, sky, exposure, seed=0)
    assert not list(tmp_path.iterdir())
    detector.expose_to(path, sky, exposure, seed=0)
    with pytest.raises(OSError, match="exists; overwrite=True"):
        detector.expose_to(path, sky, exposure, seed=0)
    detector.expose_to(path, sky, exposure, seed=0, overwrite=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a_uncal.fits"]
