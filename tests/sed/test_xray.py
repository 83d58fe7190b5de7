"""X-rays against closed forms and published numbers."""

import astropy.units as u
import numpy as np
import pytest
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose
from scipy.integrate import quad

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.sed import COSMOLOGY
from miricigale.sed.components import XRay
from miricigale.sed.xray import band_luminosity, stern2015, stern2015_6um, xray_flux

ERG = u.erg / u.s
CGS = u.erg / u.s / u.cm**2
FULL, HARD = [0.5, 7] * u.keV, [2, 10] * u.keV


# ----------------------------------------------------------------------------- Stern 2015


def test_stern_by_hand():
    # 40.981 + 1.024 x - 0.047 x^2
    got = stern2015([1e41, 1e42, 1e44, 1e46, 1e47] * ERG).to_value(ERG)
    assert_allclose(np.log10(got), [40.981, 41.958, 43.630, 44.926, 45.433], rtol=0, atol=1e-9)


def test_stern_takes_any_shape_and_no_light_is_no_x_ray():
    got = stern2015([[0.0, 1e44], [1e45, 0.0]] * ERG)
    assert got.shape == (2, 2)
    assert got[0, 0] == 0 == got[1, 1]
    assert np.all(np.isfinite(got))


def test_stern_there_and_back():
    l_6um = np.append(0.0, np.geomspace(1e38, 1e49, 34)) * ERG
    assert_allclose(stern2015_6um(stern2015(l_6um)).to_value(ERG), l_6um.value, rtol=1e-9, atol=0)
    # the relation has its maximum at 40.981 + 1.024^2 / (4 x 0.047)
    assert np.isnan(stern2015_6um(10**46.56 * ERG))
    assert np.isfinite(stern2015_6um(10**46.55 * ERG))
    refuses("'l_x' must be >= 0", stern2015_6um, -1 * ERG)


def test_stern_refuses():
    refuses(r"'l_6um' must be >= 0, got -1", stern2015, [1.0, -1.0] * u.W)
    refuses("'l_6um' must be", stern2015, 1e44, error=u.UnitsError)
    refuses("'l_6um' must be convertible", stern2015, 1 * u.Jy, error=u.UnitsError)


# ---------------------------------------------------------------------------------- bands


@pytest.mark.parametrize("index", [0.5, 1.4, 1.8, 1.999999, 2.0, 2.000001, 2.5, 3.0])
def test_bands_by_integration(index):
    ends = [quad(lambda e: e ** (1 - index), *band)[0] for band in ((0.5, 7), (2, 10))]
    bands = {"from_band": HARD, "to_band": [500, 7000] * u.eV}
    got = band_luminosity(1 * u.W, **bands, photon_index=index)
    assert_quantity_allclose(got, ends[0] / ends[1] * u.W, rtol=1e-10)


@pytest.mark.parametrize("band", [[7, 0.5] * u.keV, [0, 2] * u.keV, [1, 2, 3] * u.keV])
def test_bands_are_checked(band):
    refuses("'to_band' must be", band_luminosity, 1 * u.W, from_band=HARD, to_band=band)
    refuses("'band' must be", xray_flux, 1 * u.W, 1.0, band=band)


# ----------------------------------------------------------------------------------- flux


@pytest.mark.parametrize("index", [1.4, 1.8, 2.0, 2.3])
@pytest.mark.parametrize("z", [0.1, 1.0, 4.0])
def test_flux_is_the_power_of_the_rest_frame_band(index, z):
    """What is seen in 0.5-7 keV left in 0.5 (1 + z) to 7 (1 + z) keV."""
    rest = band_luminosity(1e43 * ERG, from_band=HARD, to_band=(1 + z) * FULL, photon_index=index)
    far = COSMOLOGY.luminosity_distance(z)
    got = xray_flux(1e43 * ERG, z, photon_index=index)
    assert_quantity_allclose(got, rest / (4 * np.pi * far**2), rtol=1e-10)


def test_flux_limit_of_yang_2021():
    """
    MIRI is 50 % complete near 1e-16 erg/s/cm2, L_X 10^42.5 at z = 2 (Gamma 1.8, flux halved).

    0.91e-16 by the closed form: 10^42.5 / (4 pi d^2) x 1.387 x 3^0.2 / 2.
    """
    flux = xray_flux(10**42.5 * ERG, 2.0, transmission=0.5)
    assert np.log10(flux.to_value(CGS)) == pytest.approx(-16.0, abs=0.1)


def test_flux_at_redshift_zero_is_at_ten_parsec():
    got = xray_flux(1 * u.W, 0.0, band=HARD)
    assert_quantity_allclose(got, 1 * u.W / (4 * np.pi * (10 * u.pc) ** 2))


def test_flux_takes_arrays_and_transmission():
    z, power = np.array([0.5, 1.0, 3.0]), [1e42, 1e43, 1e44] * ERG
    got = xray_flux(power, z, transmission=0.3)
    each = [xray_flux(p, float(s)) for p, s in zip(power, z, strict=True)]
    assert_quantity_allclose(got, 0.3 * u.Quantity(each))


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"redshift": -0.1}, "'redshift' must be >= 0"),
        ({"transmission": 1.5}, "'transmission' must be from 0 to 1"),
        ({"photon_index": np.nan}, "'photon_index' must be finite"),
    ],
)
def test_flux_refuses(changes, match):
    arguments = {"redshift": 1.0} | changes
    refuses(match, xray_flux, 1 * u.W, **arguments)


# ------------------------------------------------------------------------------ component


def test_component_equals_the_functions_for_any_array():
    part = XRay(xray_transmission=0.5)
    z = np.array([0.3, 1.0, 2.0, 5.0])
    six = np.array([0.0, 1e36, 3e37, 1e39])
    far = COSMOLOGY.luminosity_distance(z).to_value(u.m)
    got = part.derived(six, z, far, values_of(part))
    power = stern2015(six * u.W)
    assert_quantity_allclose(got["l_2_10kev"] * part.columns["l_2_10kev"][0], power)
    flux = xray_flux(power, z, transmission=0.5)
    assert_quantity_allclose(got["xray_flux"] * part.columns["xray_flux"][0], flux)
    assert got["xray_flux"][0] == 0.0
    assert set(got) == set(part.columns)
    one = part.derived(six[2], z[2], far[2], values_of(part))
    assert one["xray_flux"] == pytest.approx(got["xray_flux"][2], rel=1e-9, abs=0)


def test_empty_band_is_invalid():
    part = XRay()
    assert part.invalid(values_of(part)) is None
    why = part.invalid(values_of(part, xray_low=8.0))
    assert why == "'xray_high' must be above 'xray_low', got 8 to 7 keV"
