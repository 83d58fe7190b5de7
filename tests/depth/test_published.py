"""Published limits, and the exposure time calculator's set-up against its public description."""

import astropy.units as u
import numpy as np
import pytest
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.depth import (
    etc_limit,
    etc_setup,
    proposal_limit,
    residual_amplitude,
    residual_presets,
    saturation_time,
    scaled_limit,
)
from miricigale.instrument import CEERS_FILTERS, imager_filters

# JWST user documentation, MIRI Sensitivity, 10 sigma in 10 ks (uJy): tables of ETC 2.0 and 4.0,
# the latter's digits cut off
PUBLISHED = cases_of(__file__, "published")


@pytest.mark.parametrize("version", PUBLISHED)
def test_limits_are_the_published_ones(version):
    for name, published in zip(imager_filters(), PUBLISHED[version], strict=True):
        limit = etc_limit(name, version).value
        step = 0.01 if published < 10 else 0.1
        assert abs(limit - published) <= 1.01 * step


@pytest.mark.parametrize("name", imager_filters())
def test_setup(name):
    setup = etc_setup(name)
    assert setup.filter == name
    # ten thousand seconds, in integrations that the sky does not fill
    assert_quantity_allclose(setup.time, 1e4 * u.s, rtol=0.002)
    assert setup.n_groups * 2.775 * u.s < 0.6 * saturation_time(name)
    # 1.3 lambda / D: a little within the first dark ring
    wave = int(name[6:-1]) / 100 * u.um
    diffraction = (wave / (6.5 * u.m)).to(u.arcsec, u.dimensionless_angles())
    assert_quantity_allclose(setup.radius, 1.32 * diffraction, rtol=0.01)
    inner, outer = setup.annulus
    assert_quantity_allclose(inner, 2 * setup.radius)
    assert_quantity_allclose(outer**2 - inner**2, setup.radius**2)
    assert not setup.subtract_annulus


def test_residuals_are_small_and_named():
    values = [residual_amplitude(name) for name in imager_filters()]
    # of the light: below what any flat field is known to, and above nothing
    assert np.all(np.array(values) > 1e-5)
    assert np.all(np.array(values) < 3e-3)
    assert residual_presets() == ("etc",)
    assert_allclose(residual_amplitude("f770w"), residual_amplitude("miri.f770w"))


def test_scaled_limits_of_the_survey():
    # exposure time calculator 4.0 scaled to the survey's exposures, AB at 5 sigma
    times = [1665] * 5 + [4662]
    expected = [25.20, 24.50, 23.87, 23.49, 22.72, 22.56]
    for name, time, magnitude in zip(CEERS_FILTERS, times, expected, strict=True):
        limit = scaled_limit(name, time * u.s).to_value(u.ABmag)
        assert_allclose(limit, magnitude, atol=0.012)
        assert abs(proposal_limit(name).value - limit) < 0.45
    scaled = scaled_limit("miri.f770w", 1e4 * u.s, n_sigma=10)
    assert_quantity_allclose(scaled, etc_limit("miri.f770w"))


def test_versions_of_the_calculator():
    with pytest.raises(KeyError, match=r"version of the exposure time calculator '3.0'"):
        etc_limit("miri.f770w", "3.0")
    refuses(r"no band of the survey 'miri.f560w'", proposal_limit, "miri.f560w", error=KeyError)
