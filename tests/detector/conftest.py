import numpy as np
import pytest

from helpers.exposures import exposure_of, sky_of
from miricigale.detector import Block
from miricigale.detector.effects.base import stream_key
from miricigale.instrument import miri_detector


@pytest.fixture
def make_exposure():
    """Exposures of the smallest sub-array unless told otherwise."""

    def make(band="miri.f770w", **options):
        return exposure_of(band, **{"n_groups": 10, "subarray": "SUB64", **options})

    return make


@pytest.fixture
def make_sky():
    """Flat skies whose PSF-borne effects are in them already."""

    def make(exposure, level, *, includes=("pixel", "ipc")):
        return sky_of(exposure, level, psf_includes=list(includes))

    return make


@pytest.fixture
def set_block_size(monkeypatch):
    """Let a detector work on blocks of some number of samples, which changes no count."""

    def set_size(n_samples):
        monkeypatch.setattr("miricigale.detector.work._BLOCK_SAMPLES", n_samples)

    return set_size


@pytest.fixture
def make_block(make_exposure):
    """What an effect works on: all rows of an exposure before the first effect."""

    def make(band="miri.f770w", *, seed=1, **options):
        exposure = make_exposure(band, **options)
        shape = (exposure.n_integrations, exposure.n_groups, *exposure.shape)
        rows, key = slice(0, exposure.shape[0]), stream_key(seed, exposure, "test")
        flags = np.zeros(exposure.shape, np.uint32), np.zeros(shape, np.uint8)
        return Block(exposure, miri_detector(), rows, *flags, key)

    return make
