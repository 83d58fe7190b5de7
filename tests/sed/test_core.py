import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from miricigale.sed import _core
from miricigale.sed._core import igm


def band_mean(wave, fnu, band, curve, tolerance):
    """Mean of a spectrum in one band."""
    tables = _core.band_tables(np.array([0, band.size]), band, curve)
    slope = np.append(np.diff(fnu) / np.diff(wave), 0.0)
    turn = np.diff(slope, prepend=0.0)
    got = np.empty(1)
    _core.band_means(wave, fnu, slope, turn, *tables, tolerance, got)
    return got[0]


@pytest.mark.parametrize("ends", [(1.0, 8.0), (1.8, 8.0), (1.0, 4.2), (1.8, 4.2)])
def test_band_means_over_the_part_that_a_spectrum_covers(ends):
    """Within the tolerance the mean is that of the part covered, beyond it there is none."""
    wave = np.array([ends[0], 2.0, 4.0, ends[1]])
    fnu = np.array([1.0, 5.0, 2.0, 7.0])
    band = np.array([1.5, 2.5, 3.0, 5.0])
    curve = np.array([0.0, 1.0, 0.4, 0.0])
    low, high = max(1.5, ends[0]), min(5.0, ends[1])
    t = lambda x: np.interp(x, band, curve)  # noqa: E731
    points = {"points": [2.0, 2.5, 3.0, 4.0], "epsabs": 1e-13}
    top = quad(lambda x: np.interp(x, wave, fnu) * t(x) / x, low, high, **points)[0]
    bottom = quad(lambda x: t(x) / x, low, high, **points)[0]
    whole = quad(lambda x: t(x) / x, 1.5, 5.0, **points)[0]

    def mean(wave, tolerance):
        return band_mean(wave, fnu, band, curve, tolerance)

    assert mean(wave, 1.01 - bottom / whole) == pytest.approx(top / bottom, rel=1e-10)
    assert np.isnan(mean(wave, 0.99 - bottom / whole))
    assert np.isnan(mean(wave + 10.0, 1.0))


@pytest.mark.parametrize("n_points", [2, 5, 300, 10_000])
def test_band_means_of_lines_in_curves_of_many_points_are_the_sums_of_straight_pieces(n_points):
    """Between the points of both, F T / lambda is a polynomial over lambda, whose integral is known."""
    rng = np.random.default_rng(n_points)
    band = np.sort(rng.uniform(1.0, 2.0, n_points))
    # rough, and with steps at both ends, as measured curves are
    curve = rng.uniform(0.9, 1.1, n_points) * (1.0 + np.sin(9.0 * band))
    wave = np.sort(rng.uniform(0.5, 3.0, 500))
    fnu = rng.uniform(0.5, 1.5, 500)
    lines = rng.choice(500, 25, replace=False)
    fnu[lines] *= 30.0
    edges = np.union1d(band, wave[(wave > band[0]) & (wave < band[-1])])
    middle = 0.5 * (edges[1:] + edges[:-1])
    pieces = []
    for x, y in ((wave, fnu), (band, curve)):
        i = np.searchsorted(x, middle) - 1
        rise = np.diff(y)[i] / np.diff(x)[i]
        pieces.append((y[i] - rise * x[i], rise))
    (a, b), (c, d) = pieces
    step = np.diff(edges)
    log_step = np.log(edges[1:] / edges[:-1])
    top = a * c * log_step + (a * d + b * c) * step + b * d * step * middle
    bottom = c * log_step + d * step
    got = band_mean(wave, fnu, band, curve, 0.0)
    assert got == pytest.approx(top.sum() / bottom.sum(), rel=1e-7)


def test_nodes_closer_than_1e_7_of_themselves_are_one_at_any_wavelength():
    near = np.outer([0.01, 1.0, 1000.0], [1.0, 1.0 + 0.5e-7, 1.0 + 3e-7])
    assert_array_equal(_core.merge_nodes(near), near[:, [0, 2]].ravel())


def test_sums_of_spectra_are_a_matrix_product_whatever_their_number():
    rng = np.random.default_rng(2)
    for n in range(1, 10):
        weights, spectra = rng.uniform(0.1, 1.0, (3, n)), rng.uniform(0.1, 1.0, (n, 600))
        weights[1, ::2] = 0.0
        assert_allclose(_core.weighted_sums(weights, spectra), weights @ spectra, rtol=1e-13)


# ------------------------------------------------------------------------------ IGM


@pytest.mark.parametrize(
    ("z", "law"), [(2.0, (0.00211, 3.7)), (3.9, (0.00211, 3.7)), (5.0, (0.00058, 4.5))]
)
def test_meiksin_lyman_alpha_is_the_published_power_law(z, law):
    """Between Lyman beta and alpha only tau_alpha acts (Meiksin 2006, eq. 2 and 3)."""
    rest = 0.1150
    absorber = rest * (1 + z) / (0.0912 / 0.75)
    got = _core.meiksin_transmission(np.array([rest * (1 + z)]), z)[0]
    assert got == pytest.approx(np.exp(-law[0] * absorber ** law[1]), rel=1e-12)


def test_meiksin_lyman_limit_systems_by_direct_integration():
    """Eq. 7: N0 Gamma-weighted systems; series against numerical integration."""
    z, wave = 3.0, 0.0912 * 3.2
    limit = wave / 0.0912

    # tau = int dz' int_1^inf dtau_L N0 (beta - 1) / ... tau_L^-1.5 (1 - exp(-tau_L (l/l_L)^3)),
    # Meiksin 2006: N0 = 0.25, beta = 1.5, gamma = 1.5
    def inner(zz):
        ratio = (limit / (1 + zz)) ** 3
        # int_1^inf x^-1.5 (1 - exp(-x r)) dx by substitution x = 1 / s^2
        value = quad(lambda s: 2 * -np.expm1(-ratio / s**2), 0, 1)[0]
        return 0.25 * 0.5 * (1 + zz) ** 1.5 * value

    direct = quad(inner, limit - 1, z)[0]
    first, series = igm._lls_terms()
    lls = first * ((1 + z) * limit**1.5 - limit**2.5)
    for n, term in enumerate(series, start=1):
        lls -= term * ((1 + z) ** (2.5 - 3 * n) * limit ** (3 * n) - limit**2.5)
    assert 0.25 * lls == pytest.approx(direct, rel=0.02)
