import astropy.units as u
import numpy as np
import pytest
from astropy.tests.helper import assert_quantity_allclose

from miricigale.sed import COSMOLOGY, SED

WAVE = np.geomspace(0.3, 40.0, 300) * u.um


@pytest.fixture
def flat():
    return SED(WAVE, np.full(WAVE.size, 3.0) * u.uJy)


def test_synphot_round_trip():
    wave = np.geomspace(0.3, 30.0, 50) * u.um
    sed = SED(wave, np.linspace(1, 9, 50) * u.uJy, redshift=0.5)
    back = SED.from_synphot(sed.to_synphot(), redshift=0.5)
    assert_quantity_allclose(back.wave, sed.wave, rtol=1e-12)
    assert_quantity_allclose(back.fnu, sed.fnu, rtol=1e-10)
    assert back.redshift == 0.5


def test_flux_density_by_wavelength_is_converted():
    wave = [1.0, 2.0] * u.um
    flam = [1.0, 1.0] * u.Unit("erg / (s cm2 AA)")
    want = flam.to(u.uJy, u.spectral_density(wave))
    assert_quantity_allclose(SED(wave, flam).fnu, want)


def test_redshifting_keeps_the_luminosity(flat):
    far = flat.replace(redshift=0.5).redshifted(2.0)
    near, away = (COSMOLOGY.luminosity_distance(z) for z in (0.5, 2.0))
    power = [
        -np.trapezoid(s.fnu, s.wave.to(u.Hz, u.spectral())) * d**2
        for s, d in ((flat, near), (far, away))
    ]
    assert_quantity_allclose(power[0], power[1], rtol=1e-10)
    assert_quantity_allclose(far.wave[0], WAVE[0] * 2.0)


def test_sed_never_changes(flat):
    with pytest.raises(ValueError, match="read-only"):
        flat.fnu.value[0] = 1.0
    with pytest.raises(AttributeError):
        flat.redshift = 2.0


@pytest.mark.parametrize(
    ("wave", "fnu", "error", "match"),
    [
        ([1, 2] * u.um, [1, 2] * u.K, u.UnitsError, "'fnu' must be convertible"),
        ([1, 2] * u.um, [1, 2], u.UnitsError, "'fnu' must be a quantity"),
        ([2, 1] * u.um, [1, 2] * u.uJy, ValueError, "'wave' must be positive and strictly"),
        ([1, 2] * u.um, [1, 2, 3] * u.uJy, ValueError, "'fnu' must be of the shape"),
        ([1, 2] * u.um, [1, np.nan] * u.uJy, ValueError, "'fnu' must be finite"),
    ],
)
def test_sed_refuses(wave, fnu, error, match):
    with pytest.raises(error, match=match):
        SED(wave, fnu)


def test_plot_returns_the_axes_it_was_given(flat):
    from matplotlib.figure import Figure

    ax = Figure().subplots()
    assert flat.plot(ax=ax) is ax
    assert ax.get_xscale() == "log"
