"""Fluxes in a band do not depend on the unit, order and scale in which its curve is given."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from miricigale import Filter

WAVE = np.linspace(6.0, 9.5, 200) * u.um


@pytest.fixture(scope="module")
def curve():
    """A curve with wings and two maxima, between 6.5 and 9 um."""
    wave = np.linspace(6.5, 9.0, 60)
    throughput = np.exp(-0.5 * ((wave - 7.4) / 0.3) ** 2) + 0.6 * np.exp(-30 * (wave - 8.1) ** 2)
    throughput[[0, -1]] = 0.0
    return wave * u.um, throughput


@pytest.mark.parametrize("form", ["nanometers", "percent", "file"])
def test_a_curve_in_another_form(curve, form, tmp_path):
    wave, throughput = curve
    flux = (1.0 + 0.2 * WAVE.value**2) * u.uJy
    wanted = Filter("own", wave, throughput).synthetic_flux(WAVE, flux)
    if form == "nanometers":
        band = Filter("own", wave.to(u.nm), throughput)
    elif form == "percent":
        band = Filter("own", wave, 0.37 * throughput)
    else:
        np.savetxt(tmp_path / "own.dat", np.column_stack([wave.to_value(u.AA), throughput])[::-1])
        band = Filter.read(tmp_path / "own.dat", unit="Angstrom")
    assert_allclose(band.synthetic_flux(WAVE, flux).value, wanted.value, rtol=1e-9)
    # and is linear in the spectrum
    assert_allclose(band.synthetic_flux(WAVE, 10 * flux).value, 10 * wanted.value, rtol=1e-9)
