import types

import numpy as np
import pytest
from astropy.table import QTable

from helpers import mosaics


@pytest.fixture(scope="session")
def tools():
    return mosaics


@pytest.fixture(scope="session")
def field():
    """Sixty point sources on a mosaic of 0.11 arcsec, without noise."""
    rng = np.random.default_rng(4)
    sky = mosaics.positions(rng, 60, 12.0)
    flux = 10 ** rng.uniform(0, 2, 60)
    image = mosaics.picture(sky, flux, (260, 260))
    catalog = QTable({"id": np.arange(100, 160), "sky": sky})
    return types.SimpleNamespace(image=image, catalog=catalog, flux=flux, wcs=image.wcs, sky=sky)
