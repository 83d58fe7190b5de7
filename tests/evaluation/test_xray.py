import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import ndtr, ndtri

from helpers.errors import refuses
from miricigale.evaluation import (
    completeness,
    half_complete,
    xray_luminosity_at,
    yang2021_xray_flux,
)
from miricigale.sed import COSMOLOGY

ERG = u.erg / u.s


def test_flux_by_hand():
    """Stern 2015 at 1e44 erg/s: log L = 43.630; Gamma 1.8: (7^.2 - .5^.2)/(10^.2 - 2^.2); half of it."""
    z = 1.5
    band = (7**0.2 - 0.5**0.2) / (10**0.2 - 2**0.2)
    far = COSMOLOGY.luminosity_distance(z).to_value(u.cm)
    want = 0.5 * 10**43.630 * band * (1 + z) ** 0.2 / (4 * np.pi * far**2)
    got = yang2021_xray_flux(1e44 * ERG, z).to_value(u.erg / u.s / u.cm**2)
    assert got == pytest.approx(want, rel=1e-6, abs=0)


def test_the_papers_limit_is_the_papers_luminosity():
    """50 % at about 1e-16 erg/s/cm2 is 10^42.5 erg/s at redshift 2."""
    got = xray_luminosity_at(1e-16 * u.erg / u.s / u.cm**2, 2.0)
    assert np.log10(got.to_value(ERG)) == pytest.approx(42.5, abs=0.1)


def test_completeness_of_a_table_by_hand():
    table = completeness([0.5, 0.6, 1.5, 1.6, 1.7, 5.0], [1, 0, 1, 1, 1, 1], [0, 1, 2, 3])
    assert table["n"].tolist() == [2, 3, 0]
    assert table["n_found"].tolist() == [1, 3, 0]
    assert_allclose(table["share"], [0.5, 1.0, np.nan])


@pytest.mark.parametrize(("width", "top"), [(0.05, 1.0), (0.3, 1.0), (0.3, 0.88)])
def test_half_of_the_sources_are_found_at_the_limit(width, top):
    """Where the share itself is one half, not half of that of the bright ones, of which some are lost."""
    rng = np.random.default_rng(1)
    x = rng.uniform(-18, -13.5, 4000)
    found = rng.uniform(size=x.size) < top * ndtr((x + 16.2) / width)
    wanted = -16.2 + width * ndtri(0.5 / top)
    assert half_complete(x, found) == pytest.approx(wanted, abs=0.05)


def test_a_limit_lies_between_the_last_lost_and_the_first_found_if_there_are_both():
    x = np.arange(20.0)
    assert 7 <= half_complete(x, x > 7.5) <= 8
    for found in (True, False):
        assert np.isnan(half_complete([1.0, 2.0], [found, found]))
    # none too where the share does not depend on it
    assert np.isnan(half_complete(np.arange(400.0), np.arange(400) % 4 > 0))


def test_refuses():
    refuses("'found' must be a 1-D array as long as 'values'", half_complete, [1.0], [True, False])
    refuses("'edges' must be ascending", completeness, [1.0], [True], [1.0, 0.0])
