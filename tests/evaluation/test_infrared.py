import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.evaluation import (
    feature_magnitude,
    feature_redshifts,
    feature_residuals,
    light_share,
    mid_infrared_fractions,
)
from miricigale.filters import Filter
from miricigale.sed import SED, SEDModel

WAVE = np.geomspace(1, 100, 4000) * u.um


def test_share_of_power_laws_by_hand():
    """F_nu ~ lambda: integral of F_nu dnu between a and b is log(b / a), of F_nu constant 1/a - 1/b."""
    first, second = WAVE.value, np.ones(WAVE.size)
    got = light_share(WAVE, first + second, first)
    own = np.log(3)
    assert got == pytest.approx(own / (own + 1 / 5 - 1 / 15), rel=1e-5)

    # of many spectra and of none
    total = np.stack([second, 2 * second, 0 * second])
    assert_allclose(light_share(WAVE, total, 0.5 * total), [0.5, 0.5, np.nan])
    text = "'band' must be two ascending wavelengths in 1-100 um"
    refuses(text, light_share, WAVE, WAVE.value, WAVE.value, band=[5, 150] * u.um)


def test_mid_infrared_fractions_rise_with_the_fraction_and_are_shares_of_the_spectra():
    model = SEDModel.yang2021(libraries="bundled")
    table = QTable({"id": [1, 2, 3, 4], "redshift": [1.0] * 4, "frac_agn": [0, 0.2, 0.6, 0.99]})
    table["age"] = [1, 1, 1, 50] * u.Gyr
    got = mid_infrared_fractions(model, table)
    assert got[0] == 0
    assert 0 < got[1] < got[2] < 1
    # older than the universe
    assert np.isnan(got[3])
    # power from F_nu of the parts, by another way
    parts = model.evaluate(redshift=1.0, frac_agn=0.6, age=1 * u.Gyr)
    nu = parts.wave.to_value(u.Hz, u.spectral())
    use = (parts.wave >= 10 * u.um) & (parts.wave <= 30 * u.um)
    galaxy = parts.components["stellar"].fnu + parts.components["dust"].fnu
    light = [abs(np.trapezoid(fnu[use].value, nu[use])) for fnu in (parts.fnu, galaxy)]
    assert got[2] == pytest.approx(1 - light[1] / light[0], abs=0.01)


def test_feature_in_f1500w_is_that_of_the_paper():
    """Yang et al. 2021: a 6.2 um feature of 0.5 um makes 0.4 mag in F1500W at z = 1.5."""
    width = Filter.from_name("miri.f1500w").width
    assert feature_magnitude(0.5 * u.um, 1.5, width) == pytest.approx(0.4, abs=0.03)


def test_feature_magnitude_is_that_of_a_spectrum_through_a_filter():
    """A box within a flat filter."""
    wave = np.linspace(12, 19, 7001) * u.um
    box = Filter(wave, np.where(abs(wave.value - 15.5) < 1.5, 1.0, 0.0), name="box")
    flat = np.ones(wave.size)
    feature = flat + np.where(abs(wave.value - 15.5) < 0.5, 1.0, 0.0)
    flux = [box.synthetic_flux(SED(wave, f * u.uJy)).value for f in (flat, feature)]
    want = 2.5 * np.log10(flux[1] / flux[0])
    # a rest-frame width of 0.4 um at redshift 1.5 is observed as 1 um
    assert feature_magnitude(0.4 * u.um, 1.5, box.width) == pytest.approx(want, abs=0.01)


def test_redshifts_of_a_feature():
    low, high = feature_redshifts(6.2 * u.um, 15.5 * u.um, 3.1 * u.um)
    assert (low, high) == pytest.approx((13.95 / 6.2 - 1, 17.05 / 6.2 - 1))
    assert feature_redshifts(12.7 * u.um, 7.7 * u.um, 2 * u.um) == (0.0, 0.0)


def test_residuals_where_the_feature_is_in_the_band():
    rng = np.random.default_rng(1)
    z = rng.uniform(0, 3, 2000)
    residual = rng.normal(0, 0.1, z.size)
    residual[(z > 1.25) & (z < 1.75)] -= 0.3
    kind = {"feature": 6.2 * u.um, "pivot": 15.5 * u.um, "filter_width": 3.1 * u.um}
    inside, outside = feature_residuals(residual, z, **kind, seed=1)
    assert inside.value == pytest.approx(-0.3, abs=4 * inside.error)
    assert outside.value == pytest.approx(0, abs=4 * outside.error)
    assert inside.n + outside.n == 2000
