import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData

from miricigale.detector import Block
from miricigale.detector.effects.base import stream_key
from miricigale.instrument import Exposure, miri_detector


@pytest.fixture
def make_exposure():
    """Exposures of the smallest sub-array unless told otherwise."""

    def make(band="miri.f770w", **options):
        values = {
            "n_groups": 10,
            "subarray": "SUB64",
            "pointing": SkyCoord(53.13440, -27.83444, unit="deg"),
            "roll": 35 * u.deg,
        }
        return Exposure(band, **(values | options))

    return make


@pytest.fixture
def make_sky():
    """Flat skies whose PSF-borne effects are in them already."""

    def make(exposure, level, *, includes=("pixel", "ipc")):
        image = CCDData(np.full(exposure.shape, float(level)), unit="MJy/sr")
        image.meta["psf_includes"] = list(includes)
        return image

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

    def make(band="miri.f770w", *, seed=1, properties=None, **options):
        exposure = make_exposure(band, **options)
        shape = (exposure.n_integrations, exposure.n_groups, *exposure.shape)
        return Block(
            exposure,
            properties or miri_detector(),
            slice(0, exposure.shape[0]),
            np.zeros(exposure.shape, np.uint32),
            np.zeros(shape, np.uint8),
            stream_key(seed, exposure, "test"),
        )

    return make
