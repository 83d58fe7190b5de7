import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.evaluation import (
    ceers_dust,
    dust_obscured_fraction,
    integrated_light,
    main_sequence_dust,
    main_sequence_sfr,
    number_counts,
    sfr_to_infrared_luminosity,
    uvj_quiescent,
)
from miricigale.sed import COSMOLOGY


def test_main_sequence_and_kennicutt_relation_at_published_values():
    # Speagle et al. 2014, equation 28, evaluated by hand at t = 5 Gyr and M = 10^10.5
    expected = 10 ** ((0.84 - 0.13) * 10.5 - (6.51 - 0.55))
    sfr = main_sequence_sfr(10**10.5 * u.Msun, 5 * u.Gyr)
    assert sfr.to_value(u.Msun / u.yr) == pytest.approx(expected)
    # Kennicutt 1998: 1 Msun/yr is 5.8e9 Lsun
    luminosity = sfr_to_infrared_luminosity(1 * u.Msun / u.yr).to_value(u.Lsun)
    assert luminosity == pytest.approx(5.8e9, rel=0.01)


def test_counts_conserve_sources():
    flux = ([23.2, 23.7, 25.1] * u.ABmag).to(u.uJy)
    flux = np.append(flux, -1 * u.uJy)
    counts, error = number_counts(flux, 2 * u.deg**2, [23, 24, 24.5, 26])
    assert counts.to_value(u.deg**-2) * [1, 0.5, 1.5] * 2 == pytest.approx([2, 0, 1])
    assert (error[0] / counts[0]).value == pytest.approx(1 / np.sqrt(2))
    refuses("'edges' must be ascending", number_counts, flux, 1 * u.deg**2, [24, 23])


def test_integrated_light_in_closed_form():
    # 1 MJy/sr at 15 um is 1e-20 W/m2/Hz/sr times 1.9986e13 Hz, or 199.86 nW/m2/sr
    light, error = integrated_light([4.0, 4.0] * u.Jy, 8e-6 * u.sr, 15 * u.um)
    assert light.to_value(u.nW / u.m**2 / u.sr) == pytest.approx(199.86, rel=1e-4)
    assert (error / light).to_value(u.one) == pytest.approx(1 / np.sqrt(2))
    text = "'flux' must be finite values, got 1 that are NaN"
    refuses(text, integrated_light, [np.nan, 1] * u.Jy, 1 * u.sr, 15 * u.um)


def test_hidden_star_formation_and_colors_at_published_values():
    # Whitaker et al. 2017, abstract: half at 10^9.4 Msun, more than 90 % above 10^10.5
    assert dust_obscured_fraction(10**9.4 * u.Msun) == pytest.approx(0.5, abs=0.01)
    assert dust_obscured_fraction(10**10.5 * u.Msun) > 0.9
    # an old population, a dusty one as red in U - V, a blue one; the lines of Whitaker et al. 2011
    u_v, v_j = [1.8, 1.8, 0.8] * u.mag, [1.0, 1.9, 0.6] * u.mag
    assert uvj_quiescent(u_v, v_j, 1.0).tolist() == [True, False, False]
    for u_v, v_j, z in ((1.25, 0.5, [1.0, 2.5]), (1.52, 1.0, [0.2, 0.6])):
        assert uvj_quiescent(u_v * u.mag, v_j * u.mag, z).tolist() == [False, True]
    assert not uvj_quiescent(np.nan * u.mag, 0.5 * u.mag, 1.0)
    # equation 15: U - V least, V - J most, and constant of the line, on both sides of each
    for z, least, most, line in (
        (0.4, 1.3, 1.6, 0.69),
        (1.4, 1.3, 1.6, 0.59),
        (1.9, 1.3, 1.5, 0.59),
        (2.1, 1.2, 1.4, 0.59),
    ):
        edge = np.array([-1e-9, 1e-9])
        for u_v, v_j in ((least + edge, 0.3), (3.0, most - edge), (0.88 * 1.3 + line + edge, 1.3)):
            assert uvj_quiescent(u_v * u.mag, v_j * u.mag, z).tolist() == [False, True], (z, v_j)


@pytest.fixture
def galaxies():
    """Star-forming galaxies of one mass, one that is quiescent, and a star."""
    ones = np.ones(2000)
    table = QTable(
        {"id": np.arange(2000), "redshift": ones, "stellar_mass": 10**10.5 * ones * u.Msun}
    )
    table["dust_luminosity"] = 1e36 * ones * u.W
    table["u_v"], table["v_j"] = ones * u.mag, ones * u.mag
    table["u_v"][0] = 1.8 * u.mag
    table["redshift"][1] = 0.0
    return table


def test_dust_on_the_main_sequence(galaxies):
    dust = main_sequence_dust(galaxies, seed=5)
    assert dust["quiescent"].tolist() == [True] + [False] * (len(galaxies) - 1)
    assert dust["dust_excess"][:2].tolist() == [1, 1]
    assert np.all(dust["dust_luminosity"][:2] == galaxies["dust_luminosity"][:2])
    # by hand: Speagle et al. 2014, Whitaker et al. 2017, Kennicutt & Evans 2012
    age = COSMOLOGY.age(1.0).value
    sfr = (0.84 - 0.026 * age) * 10.5 - (6.51 - 0.11 * age)
    wanted = sfr + 43.41 + np.log10(1 / (1 + 1.96e9 * np.exp(-2.277 * 10.5)))
    got = np.log10(dust["dust_luminosity"][2:].to_value(u.erg / u.s))
    assert got.mean() == pytest.approx(wanted, abs=4 * 0.2 / np.sqrt(got.size))
    assert got.std() == pytest.approx(0.2, rel=0.07)
    exact = main_sequence_dust(galaxies, seed=5, scatter=0.0)["dust_luminosity"][-1]
    assert exact.to_value(u.erg / u.s) == pytest.approx(10**wanted)
    assert_allclose(dust["dust_excess"], dust["dust_luminosity"] / galaxies["dust_luminosity"])
    # a source's draw does not depend on the others
    few = main_sequence_dust(galaxies[100:103], seed=5)
    assert np.all(few["dust_luminosity"] == dust["dust_luminosity"][100:103])


def test_dust_emits_at_least_what_attenuation_took(galaxies):
    galaxies["dust_luminosity"] = np.full(len(galaxies), 1e40) * u.W
    assert np.all(main_sequence_dust(galaxies, seed=1)["dust_excess"] == 1)
    with pytest.raises(ValueError, match="'scatter' must be finite and >= 0, got -1"):
        main_sequence_dust(galaxies, seed=1, scatter=-1)
    galaxies.remove_column("u_v")
    refuses(r"'table' must be .* columns \['u_v'\]", main_sequence_dust, galaxies, seed=1)


def test_dust_of_ceers_follows_mass_and_star_formation(galaxies):
    galaxies["sfr_100myr"] = np.full(len(galaxies), 10.0) * u.Msun / u.yr
    # log10 L = 0.79 + log M at 10^10.3 Msun and 10^-9.3 / yr, whatever the attenuation takes
    for mass, wanted in (
        (1e8, 8.79 - 0.56 * 1.8 + 0.69 * 1.3),
        (1e9, 9.79 - 0.56 * 1.3 + 0.69 * 1.3),
        (1e11, 11.79 - 0.69 * 0.7),
    ):
        galaxies["stellar_mass"] = np.full(len(galaxies), mass) * u.Msun
        dust = ceers_dust(galaxies, "dl07_alpha", seed=5)
        drawn = np.log10(dust["dust_luminosity"].to_value(u.Lsun)[~dust["quiescent"]][1:])
        assert drawn.mean() == pytest.approx(wanted, abs=4 * 0.21 / np.sqrt(drawn.size))
        assert drawn.std() == pytest.approx(0.21, rel=0.1)
    assert_allclose(dust["dust_excess"], dust["dust_luminosity"] / galaxies["dust_luminosity"])
    galaxies["u_v"] = np.full(len(galaxies), 1.9) * u.mag
    dust = ceers_dust(galaxies, "dale2014", seed=5)
    assert np.median(np.log10(dust["dust_excess"])) == pytest.approx(-0.49, abs=0.1)
    refuses(
        r"columns \['sfr_100myr'\]",
        ceers_dust,
        galaxies[list(galaxies.colnames[:6])],
        "dale2014",
        seed=1,
    )
    refuses(
        "no dust component 'casey2012'", ceers_dust, galaxies, "casey2012", seed=1, error=KeyError
    )
