import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.integrate import quad

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.refdata.libraries.ised import read_ised
from miricigale.sed import _core
from miricigale.sed.components import BC03, ConstantSFH, DelayedSFH

HC = 6.62607015e-34 * 2.99792458e14  # J um


@pytest.fixture(scope="module")
def stars():
    return BC03()


# ------------------------------------------------------------------ weights of ages


@pytest.mark.parametrize("separation", [0.0, 1.0, 10.0, 37.0, 1000.0])
@pytest.mark.parametrize("age", [0.001, 0.009, 0.04, 3.3, 13.7])
def test_light_of_a_history_is_the_sum_of_its_steps(stars, age, separation):
    """CIGALE's rule, step by step: the mean of ten interpolations, at k + 0.1 ... k + 1.0 Myr."""
    part = DelayedSFH()
    history = part.history(values_of(part, age=age, tau=0.7, f_burst=0.1, age_burst=min(age, 0.02)))
    table_age, spectra, _ = stars.table(0.02)
    light = spectra[:, [60, 300, 500]]
    k = np.arange(history.size)
    ages = k[:, None] + np.arange(1, 11) / 10
    steps = np.array([np.interp(ages, table_age, column).mean(axis=1) for column in light.T])
    parts = 1e6 * history[::-1] * np.array([k < separation, k >= separation])
    got = stars.age_weights(history, values_of(stars, separation_age=separation))
    assert_allclose(got @ light, parts @ steps.T, rtol=1e-10)


def test_masses_are_parted_at_the_separation_age(stars):
    history = ConstantSFH().history({"age": 0.4})
    for separation in (0.0, 10.0, 100.0, 400.0, 1000.0):
        young, old = stars.age_weights(history, values_of(stars, separation_age=separation))
        assert young.sum() == pytest.approx(min(separation / 400, 1.0), abs=1e-12)
        assert young.sum() + old.sum() == pytest.approx(1.0, rel=1e-12)


def test_a_history_longer_than_the_universe_is_refused(stars):
    match = "'history' must be of at most 14000 steps, got 14001"
    refuses(match, stars.age_weights, np.ones(14001), values_of(stars))


# --------------------------------------------------------------- ionizing photons


def test_photon_weights_by_numerical_integration():
    rng = np.random.default_rng(5)
    wave = np.sort(rng.uniform(0.01, 0.2, 40))
    light = rng.uniform(0, 1, 40)
    for limit in (wave[20], 0.0912, 0.5 * (wave[3] + wave[4]), 1.0):
        edges = [*wave[wave < limit], min(limit, wave[-1])]
        want = sum(
            quad(lambda x: np.interp(x, wave, light) * x / HC, *ends)[0]
            for ends in itertools.pairwise(edges)
        )
        assert _core.photon_weights(wave, limit) @ light == pytest.approx(want, rel=1e-7)
    assert not np.any(_core.photon_weights(wave, 0.005))


def photons_per_sfr(stars, metallicity, age=0.1):
    history = ConstantSFH().history({"age": age})
    weights = sum(stars.age_weights(history, values_of(stars, metallicity=metallicity)))
    return weights @ stars.ionizing(metallicity) / history[-1]


def test_ionizing_photons_of_constant_star_formation(stars):
    """
    Murphy et al. 2011, eq. 2: 1 Msun/yr (Kroupa, solar) gives 1 / 7.29e-54 photons per second.

    Kennicutt 1998 has 9.26e52 for Salpeter's IMF, which is 1.59 times less with Kroupa's mass.
    """
    rate = np.log10(photons_per_sfr(stars, 0.02))
    assert rate == pytest.approx(-np.log10(7.29e-54), abs=0.2)
    assert rate == pytest.approx(np.log10(9.26e52 * 1.59), abs=0.2)


def test_metal_poor_stars_ionize_more(stars):
    rates = [photons_per_sfr(stars, z) for z in (0.0001, 0.0004, 0.004, 0.008, 0.02, 0.05)]
    assert rates == sorted(rates, reverse=True)
    # Raiter et al. 2010 and Schaerer 2003: 0.2-0.3 dex from solar to 1/50 solar
    assert 0.1 < np.log10(rates[1] / rates[4]) < 0.35


def test_ionizing_light_of_old_stars_is_gone(stars):
    age = stars.table(0.02)[0]
    rate = stars.ionizing(0.02)
    assert np.interp(30.0, age, rate) < 1e-3 * rate[0]


# -------------------------------------------------------- composites of the authors


@pytest.fixture(scope="module")
def composite(data_file):
    def read(name):
        return read_ised(data_file(f"bc03/bc2003_lr_m62_chab_{name}_dust00.ised.gz"))

    return read


def ssp_of(part, values):
    """
    Mean SSP between the ages of an exponential composite F: S = F + tau dF/dt.

    From F(t) = int_0^t exp(-(t - u) / tau) / tau S(u) du.
    """
    middle = 0.5 * (values[1:] + values[:-1])
    steps = np.diff(part.age).reshape(-1, *[1] * (values.ndim - 1))
    inside = middle + part.tau * np.diff(values, axis=0) / steps
    age = np.append(0.0, 0.5 * (part.age[1:] + part.age[:-1]) / 1e6)
    return age, np.concatenate([inside[:1], inside])


def with_ssp(part, row, age, table):
    """What our history code makes of a table at the age of a row of a delayed composite."""
    n, tau = round(part.age[row] / 1e6), part.tau / 1e6
    history = _core.delayed_history(n, tau)
    steps = _core.age_steps(age, n)
    weights = _core.split_by_age(history, np.array([n]), 10, age, *steps).sum(axis=0)[0]
    # the composites form 1 Msun in infinite time
    formed = 1 - (1 + n / tau) * np.exp(-n / tau)
    return weights @ table * formed


COMPOSITES = ("delayed0.1", "delayed0.5", "delayed1", "delayed3")
TIMES = (30, 100, 300, 500, 1000, 2000, 4000, 8000, 13000)


@pytest.mark.parametrize("name", COMPOSITES)
def test_delayed_composites_follow_from_the_exponential_ones(composite, name):
    """Two sets of the authors' files, tied by our integration of a delayed history."""
    source, part = composite("tau01"), composite(name)
    age, table = ssp_of(source, source.spectra.astype(float))
    for time in TIMES:
        row = int(np.argmin(np.abs(part.age / 1e6 - time)))
        mine = with_ssp(part, row, age, table)
        for center in (500, 730, 1300, 1600, 2000, 2500, 3500, 4400, 5500, 9000, 16000, 22000):
            band = (part.wave > 0.95 * center) & (part.wave < 1.05 * center)
            ratio = np.log10(mine[band].mean() / part.spectra[row][band].mean())
            # the composite itself is sampled coarsely where its young stars die out
            dying = name == "delayed0.1" and 500 <= time <= 1000 and center <= 2500
            assert abs(ratio) < (0.05 if dying else 0.01), (time, center)


@pytest.mark.parametrize("name", ["delayed0.5", "delayed1", "delayed3"])
def test_living_mass_against_the_composites(composite, stars, name):
    """Kroupa 2016 (ours) and Chabrier 2003 without remnants: 0.07 apart at most."""
    part = composite(name)
    living = part.quantities["mass"] - part.quantities["remnants"]
    age, _, table = stars.table(0.02)
    for time in TIMES[1:]:
        row = int(np.argmin(np.abs(part.age / 1e6 - time)))
        n, tau = part.age[row] / 1e6, part.tau / 1e6
        formed = 1 - (1 + n / tau) * np.exp(-n / tau)
        mine = with_ssp(part, row, age, table)
        assert mine / formed == pytest.approx(living[row] / formed, abs=0.08)


def test_ionizing_photons_of_the_composites(composite, stars):
    """The files of 2003 (Chabrier) have log Q = 53.17 for 1 Msun/yr; ours of 2016 0.12 more."""
    part = composite("tau3")
    weights = _core.photon_weights(part.wave / 1e4, 0.0912)
    row = int(np.argmin(np.abs(part.age - 1e8)))
    theirs = part.spectra[row] @ weights * 3.826e30 / part.quantities["sfr"][row]
    assert np.log10(theirs) == pytest.approx(-np.log10(7.29e-54), abs=0.05)
    assert np.log10(photons_per_sfr(stars, 0.02) / theirs) == pytest.approx(0.12, abs=0.02)
