import astropy.units as u
import numpy as np
from astropy.modeling.models import BlackBody
from astropy.table import QTable

from miricigale.workflow.stages.stars import star_fluxes


def test_a_black_body_is_found_again():
    wave = [0.9, 1.15, 2.0, 3.56, 4.44] * u.um
    names = ["nircam.f090w", "nircam.f115w", "nircam.f200w", "nircam.f356w", "nircam.f444w"]
    flux = (BlackBody(5000 * u.K)(wave) * 1e-15 * u.sr).to(u.uJy)
    flux[3] = np.nan
    rows = QTable({name: value[None] for name, value in zip(names, flux, strict=True)})
    table = star_fluxes(rows, names, ["miri.f1000w", "miri.f2100w"])
    assert abs(table["temperature"][0] / (5000 * u.K) - 1) < 0.03
    # Rayleigh-Jeans within its own correction: flux goes as frequency squared
    expected = (BlackBody(5000 * u.K)([9.953, 20.795] * u.um) * 1e-15 * u.sr).to(u.uJy)
    for name, value in zip(["miri.f1000w", "miri.f2100w"], expected, strict=True):
        assert abs(table[name][0] / value - 1) < 0.05


def test_a_star_without_fluxes_has_none():
    rows = QTable({"nircam.f200w": [np.nan] * u.uJy})
    table = star_fluxes(rows, ["nircam.f200w"], ["miri.f770w"])
    assert np.isnan(table["miri.f770w"][0])
