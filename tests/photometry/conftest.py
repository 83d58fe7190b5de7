import types

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers import mosaics
from miricigale.instrument import north_up_wcs


@pytest.fixture(scope="session")
def tools():
    return mosaics


@pytest.fixture(scope="session")
def field():
    """Sixty point sources on a mosaic of 0.11 arcsec, without noise."""
    rng = np.random.default_rng(4)
    sky = mosaics.positions(rng, 60, 12.0)
    flux = 10 ** rng.uniform(0, 2, 60)
    wcs = north_up_wcs(mosaics.CENTER, 0.11 * u.arcsec, (260, 260))
    light = mosaics.render(sky, flux, mosaics.LO, wcs, (260, 260))
    image = mosaics.as_ccd(light, wcs, 0.01)
    catalog = QTable({"id": np.arange(100, 160), "sky": sky})
    return types.SimpleNamespace(image=image, catalog=catalog, flux=flux, wcs=wcs, sky=sky)
