import astropy.units as u
import numpy as np
import pytest

from miricigale.evaluation import feature_magnitude, feature_redshifts, feature_residuals
from miricigale.filters import Filter
from miricigale.sed import SED


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
