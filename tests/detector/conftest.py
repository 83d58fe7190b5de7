import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData

from miricigale.instrument import Exposure


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
