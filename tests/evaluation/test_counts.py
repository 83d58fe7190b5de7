import astropy.units as u
import numpy as np
import pytest

from miricigale.evaluation import (
    integrated_light,
    main_sequence_sfr,
    number_counts,
    sfr_to_infrared_luminosity,
)


def test_speagle_main_sequence_at_published_values():
    # Speagle et al. 2014, equation 28, evaluated by hand at t = 5 Gyr and M = 10^10.5
    expected = 10 ** ((0.84 - 0.13) * 10.5 - (6.51 - 0.55))
    sfr = main_sequence_sfr(10**10.5 * u.Msun, 5 * u.Gyr)
    assert sfr.to_value(u.Msun / u.yr) == pytest.approx(expected)


def test_kennicutt_relation_in_solar_units():
    # Kennicutt 1998: 1 Msun/yr is 5.8e9 Lsun
    assert sfr_to_infrared_luminosity(1 * u.Msun / u.yr).to_value(u.Lsun) == pytest.approx(
        5.8e9, rel=0.01
    )


def test_counts_conserve_sources():
    flux = ([23.2, 23.7, 25.1] * u.ABmag).to(u.uJy)
    flux = np.append(flux, -1 * u.uJy)
    counts, error = number_counts(flux, 2 * u.deg**2, [23, 24, 24.5, 26])
    assert counts.to_value(u.deg**-2) * [1, 0.5, 1.5] * 2 == pytest.approx([2, 0, 1])
    assert (error[0] / counts[0]).value == pytest.approx(1 / np.sqrt(2))
    with pytest.raises(ValueError, match="'edges' must be ascending magnitudes"):
        number_counts(flux, 1 * u.deg**2, [24, 23])


def test_integrated_light_in_closed_form():
    # 1 MJy/sr at 15 um is 1e-20 W/m2/Hz/sr times 1.9986e13 Hz, or 199.86 nW/m2/sr
    light, error = integrated_light([4.0, 4.0] * u.Jy, 8e-6 * u.sr, 15 * u.um)
    assert light.to_value(u.nW / u.m**2 / u.sr) == pytest.approx(199.86, rel=1e-4)
    assert (error / light).to_value(u.one) == pytest.approx(1 / np.sqrt(2))
    with pytest.raises(ValueError, match="'flux' must be finite values, got 1 that are NaN"):
        integrated_light([np.nan, 1] * u.Jy, 1 * u.sr, 15 * u.um)


def test_bare_numbers_are_refused_by_name():
    flux, area = [1.0, 2.0] * u.uJy, 1 * u.deg**2
    with pytest.raises(u.UnitsError, match=r"'area' must be a quantity convertible to deg2"):
        number_counts(flux, 1, [23, 24])
    with pytest.raises(ValueError, match="'area' must be finite and positive, got 0"):
        number_counts(flux, 0 * u.sr, [23, 24])
    with pytest.raises(ValueError, match="'area' must be convertible to deg2, got NoneType"):
        integrated_light(flux, None, 15 * u.um)
    with pytest.raises(u.UnitsError, match=r"'flux' must be convertible to uJy, got mag\(AB\)"):
        number_counts([23.0] * u.ABmag, area, [23, 24])
    with pytest.raises(u.UnitsError, match="'wavelength' must be a quantity convertible to Hz"):
        integrated_light(flux, area, 15)
