"""
Intergalactic absorption against published formulae, measurements and direct integration.

The distribution of absorbers behind Inoue et al. 2014 (their table 1 and eq. 4 to 7): per unit
redshift and column density, f(z) g(N), g normalized to one above 1e12 cm-2 and of shape
N^-beta exp(-N / 1e21); Doppler parameter 28 km/s.
"""

import itertools
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import gamma

from helpers.errors import refuses
from miricigale.sed import _core
from miricigale.sed._core import igm
from miricigale.sed.components import Inoue2014, Madau1995, Meiksin2006
from miricigale.sed.components.igm import load_lines
from miricigale.utils.exceptions import DataError

MODELS = [Meiksin2006, Madau1995, Inoue2014]
COLUMNS = ("wavelength", "laf1", "laf2", "laf3", "dla1", "dla2")
SHORT = "".join(f"{column} = [1.0, 2.0]\n" for column in COLUMNS)
LYMAN_ALPHA = 0.121567

N_LEAST, N_CUT, DOPPLER, SIGMA = 1e12, 1e21, 28.0, 6.30e-18
BETA = {"forest": 1.7, "damped": 0.9}


def number(kind, y):
    """Absorbers per unit redshift at 1 + z = y."""
    if kind == "forest":
        if y < 2.2:
            return 500.0 * (y / 2.2) ** 0.2
        if y < 5.7:
            return 500.0 * (y / 2.2) ** 2.7
        return 500.0 * (5.7 / 2.2) ** 2.7 * (y / 5.7) ** 4.5
    return 1.1 * (y / 3.0) if y < 3.0 else 1.1 * (y / 3.0) ** 2


def mean_over_columns(kind, absorbed):
    """Mean of a function of column density over g(N)."""
    s = np.linspace(np.log(N_LEAST), np.log(N_CUT * 50), 4001)
    n = np.exp(s)
    weight = n ** (1 - BETA[kind]) * np.exp(-n / N_CUT)
    return np.trapezoid(weight * absorbed(n), s) / np.trapezoid(weight, s)


def line_table():
    """Table 2 itself: n, wavelength (um), three and two amplitudes."""
    columns = tomllib.loads(Path(Inoue2014().path).read_text())
    return np.array([columns[name] for name in ("n", *COLUMNS)]).T


def depth(part, wave, redshift):
    return -np.log(part.transmission(np.atleast_1d(wave), redshift))


# ---------------------------------------------------------------------------- all three


@pytest.mark.parametrize("cls", MODELS)
def test_between_nothing_and_all_and_clear_longward_of_lyman_alpha(cls):
    part = cls()
    for z in (0.0, 0.01, 0.7, 1.9, 2.1, 4.0, 4.8, 6.5, 10.0, 20.0):
        wave = np.geomspace(1e-3, 10.0, 5000)
        got = part.transmission(wave, z)
        assert np.all((got >= 0.0) & (got <= 1.0))
        assert_array_equal(got[wave > (LYMAN_ALPHA * (1 + z) * 1.001 if z > 0 else 0)], 1.0)


@pytest.mark.parametrize("cls", MODELS)
def test_little_absorbs_in_front_of_a_near_source(cls):
    wave = np.geomspace(0.0701, 1.0, 500)
    assert_allclose(cls().transmission(wave, 1e-3), 1.0, atol=5e-3)


@pytest.mark.parametrize("cls", MODELS)
def test_order_of_wavelengths_does_not_matter(cls):
    wave = np.geomspace(0.05, 1.0, 300)
    mixed = np.random.default_rng(3).permutation(300)
    got = cls().transmission(wave[mixed], 3.2)
    assert_array_equal(got, cls().transmission(wave, 3.2)[mixed])


@pytest.mark.parametrize(("cls", "last"), [(Madau1995, 9.0), (Inoue2014, 9.0), (Meiksin2006, 4.0)])
def test_more_path_absorbs_more(cls, last):
    """
    At a fixed observed wavelength a farther source has all absorbers of a nearer one.

    Meiksin's law of Lyman alpha changes for the whole path where the source passes z = 4, as
    CIGALE has it: there it is not so.
    """
    wave = np.geomspace(0.0912, 1.2, 800)
    previous = np.ones(wave.size)
    for z in np.arange(0.25, last + 0.1, 0.25):
        now = cls().transmission(wave, z)
        assert np.all(now <= previous + 1e-3), z
        previous = now


@pytest.mark.parametrize("cls", MODELS)
@pytest.mark.parametrize("z", [2.0, 3.7, 5.2])
def test_bands_from_nodes_are_those_of_a_dense_grid(cls, z):
    """A power law through wide boxes; the nodes are those of stars at R = 50 to 200, and ours."""
    part = cls()
    stars = [np.geomspace(0.0091, 0.0911, 116), np.geomspace(0.09125, 0.9, 458)]
    nodes = _core.merge_nodes([*stars, part.nodes()])
    dense = np.unique(np.concatenate([nodes, np.geomspace(0.06, 0.13, 200_000)]))

    def box(rest, low, high):
        value = rest**-2.0 * part.transmission(rest * (1 + z), z)
        inside = np.append(rest[(rest > low) & (rest < high)], [low, high])
        inside.sort()
        return np.trapezoid(np.interp(inside, rest, value), inside)

    # in a box that the light fades in, an error matters against the light longward of it
    bright = box(dense, 0.105, 0.125)
    for low, high in ((0.078, 0.098), (0.088, 0.102), (0.095, 0.115), (0.105, 0.125)):
        assert box(nodes, low, high) == pytest.approx(
            box(dense, low, high), rel=3e-3, abs=3e-4 * bright
        )


# ------------------------------------------------------------------- against measurements


@pytest.mark.parametrize(
    ("cls", "tolerance"), [(Inoue2014, 0.10), (Meiksin2006, 0.12), (Madau1995, 0.25)]
)
def test_forest_has_the_depth_that_quasars_show(cls, tolerance):
    """
    Within 10 % (Inoue et al. 2014), 12 % (Meiksin 2006) and 25 % (Madau 1995) of the depth.

    The effective depth is that of Becker et al. 2013, eq. 5: 2.2 < z < 4.8.
    """
    part = cls()
    for z in (2.4, 3.0, 3.5, 4.0, 4.5):
        # a source a little farther, seen between Lyman beta and alpha
        tau = depth(part, LYMAN_ALPHA * (1 + z), (1 + z) / 0.96 - 1)[0]
        assert tau == pytest.approx(0.751 * ((1 + z) / 4.5) ** 2.90 - 0.132, rel=tolerance), z


# ----------------------------------------------------------------------- formulae by hand


MADAU = {2: 0.0036, 3: 1.7e-3, 4: 1.2e-3, 5: 9.3e-4}


def madau_lines(wave, z):
    """Madau 1995, eq. 15: sum of A (l / l_line)^3.46 of lines between us and the source."""
    at = [(a, wave / 0.0912 * (1 - n**-2.0)) for n, a in MADAU.items()]
    return sum(a * absorber**3.46 for a, absorber in at if 1 < absorber < 1 + z)


@pytest.mark.parametrize(
    ("wave", "z"),
    # Lyman alpha alone, alpha and beta, then gamma and delta; none, and those from beta on
    [(0.44, 3.0), (0.3, 2.0), (0.432, 3.5), (0.322, 2.5), (0.11, 0.05), (0.11, 0.14)],
)
def test_madau_lines(wave, z):
    assert depth(Madau1995(), wave, z)[0] == pytest.approx(madau_lines(wave, z), rel=1e-9)


@pytest.mark.parametrize(("x", "z"), [(1.2, 0.5), (2.5, 3.0), (4.6, 4.0)])
def test_madau_continuum_by_hand(x, z):
    """Footnote 3, x = 1 + z of an absorber at the limit."""
    y, wave = 1 + z, 0.0912 * x
    want = 0.25 * x**3 * (y**0.46 - x**0.46) + 9.4 * x**1.5 * (y**0.18 - x**0.18)
    want -= 0.7 * x**3 * (x**-1.32 - y**-1.32) + 0.023 * (y**1.68 - x**1.68)
    got = depth(Madau1995(), wave, z)[0] - madau_lines(wave, z)
    assert got == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(
    ("n", "z", "factor"),
    [
        (3, 2.0, 0.348),
        (3, 3.5, 0.348),
        (4, 2.5, 0.179),
        (5, 2.5, 0.109),
        (6, 3.5, 0.0722),
        (12, 2.5, 0.0283 * 720 / (12 * (12**2 - 1))),
    ],
)
def test_meiksin_higher_lines(n, z, factor):
    """
    Table 1: the step at a line is its share of Lyman alpha, (1 + z)/4 to 1/3 or, above 3, 1/6.

    Lines above n = 9 go with the depth of n = 9 at the wavelength (equation 4), of another absorber.
    """
    line = 0.0912 / (1 - 1 / n**2)
    inside, outside = line * (1 + z) * np.array([1 - 1e-9, 1 + 1e-9])
    step = depth(Meiksin2006(), inside, z)[0] - depth(Meiksin2006(), outside, z)[0]
    power = 1 / 6 if n <= 5 and z > 3 else 1 / 3
    absorber = inside / 0.0912 * (1 - min(n, 9) ** -2)
    want = factor * 0.00211 * (1 + z) ** 3.7 * (absorber / 4) ** power
    assert step == pytest.approx(want, rel=1e-5)


# -------------------------------------------------------------------------------- Inoue


def oscillator_strength(n):
    """Lyman line n of hydrogen (Menzel & Pekeris 1935)."""
    return 256 / 3 * n**5.0 * (n - 1.0) ** (2 * n - 4) / (n + 1.0) ** (2 * n + 4)


def relative_width(columns, n, wave):
    """Equivalent width over wavelength of a line broadened by motion alone."""
    cm, b = wave * 1e-4, DOPPLER * 1e5
    peak = 0.026540 * oscillator_strength(n) * cm / (b * np.sqrt(np.pi))
    x = np.linspace(0, 8, 1500)
    depth = np.multiply.outer(columns * peak, np.exp(-(x**2)))
    return 2 * np.trapezoid(-np.expm1(-depth), x, axis=-1) * b / 2.99792458e10


def test_lines_are_those_of_hydrogen():
    table = line_table()
    n = table[:, 0]
    assert_array_equal(n, np.arange(2, 41))
    # Rydberg's formula for hydrogen, in vacuum
    assert_allclose(table[:, 1], 0.0911763 / (1 - 1 / n**2), rtol=2e-5)


def test_table_two_scales_as_the_forest_does_and_is_continuous_in_redshift():
    """A distribution N^-1.7 makes depths in proportion to (f wavelength)^0.7."""
    n, wave, *laf, dla1, dla2 = line_table().T
    strength = (oscillator_strength(n) * wave) ** 0.7
    assert_allclose(laf[0] / laf[0][0], strength / strength[0], rtol=1e-3)
    assert_allclose(laf[1], laf[0] * 2.2 ** (1.2 - 3.7), rtol=1e-3)
    assert_allclose(laf[2], laf[1] * 5.7 ** (3.7 - 5.5), rtol=1e-3)
    assert_allclose(dla2, dla1 / 3.0, rtol=1e-3)


@pytest.mark.parametrize("n", [2, 3, 4, 10, 30])
def test_table_two_by_curve_of_growth(n):
    """
    Mean equivalent width of lines of the distribution, b = 28 km/s.

    The table approximates it: 17 % at worst for the forest, 29 % for damped systems, whose damping
    wings it leaves out (with them Lyman alpha would be 8 times as deep).
    """
    row = line_table()[n - 2]
    columns = np.geomspace(N_LEAST, N_CUT * 50, 220)
    widths = relative_width(columns, n, row[1])
    for kind, got, tolerance in (("forest", row[2], 0.18), ("damped", row[5], 0.30)):
        mean = mean_over_columns(kind, lambda c, w=widths: np.interp(np.log(c), np.log(columns), w))
        assert number(kind, 1.0) * mean / got == pytest.approx(1.0, abs=tolerance), kind


@pytest.mark.parametrize(
    ("rest", "z", "want"),
    [
        # forest and damped systems of Lyman alpha, digits of table 2
        (0.11, 0.5, 1.690e-2 * (0.165 / 0.121567) ** 1.2 + 1.617e-4 * (0.165 / 0.121567) ** 2),
        (0.11, 2.0, 2.354e-3 * (0.33 / 0.121567) ** 3.7 + 1.617e-4 * (0.33 / 0.121567) ** 2),
        (0.11, 3.0, 2.354e-3 * (0.44 / 0.121567) ** 3.7 + 5.390e-5 * (0.44 / 0.121567) ** 3),
        # a little beyond the step of damped systems at 3
        (0.115, 2.2, 2.354e-3 * (0.368 / 0.121567) ** 3.7 + 5.390e-5 * (0.368 / 0.121567) ** 3),
        (0.11, 6.0, 1.026e-4 * (0.77 / 0.121567) ** 5.5 + 5.390e-5 * (0.77 / 0.121567) ** 3),
    ],
)
def test_inoue_lyman_alpha_by_hand(rest, z, want):
    assert depth(Inoue2014(), rest * (1 + z), z)[0] == pytest.approx(want, rel=1e-12)


def series_depth(wave, z):
    """Lyman series at a wavelength below the limit, by the definition of table 2."""
    tau = 0.0
    for _, line, *laf, dla1, dla2 in line_table():
        x = wave / line
        if 1 < x < 1 + z:
            tau += laf[0] * x**1.2 if x < 2.2 else laf[1] * x**3.7 if x < 5.7 else laf[2] * x**5.5
            tau += dla1 * x**2 if x < 3 else dla2 * x**3
    return tau


def continuum_depth(wave, z):
    """
    Integral over the absorbers, with their approximations.

    They are: the forest without limits of column density, and damped systems without the lower one
    and optically thick up to the cut.
    """
    x = wave / 0.09118
    low, high = max(x, 1.0), 1 + z

    def forest(y):
        t = SIGMA * (x / y) ** 3
        return gamma(0.3) * (N_LEAST * t) ** 0.7

    norm = gamma(0.1) * N_CUT**0.1 - N_LEAST**0.1 / 0.1

    def damped(y):
        t = SIGMA * (x / y) ** 3
        return gamma(0.1) * (N_CUT**0.1 - t**-0.1) / norm

    knots = [low, *(k for k in (2.2, 3.0, 5.7) if low < k < high), high]
    total = 0.0
    node, weight = np.polynomial.legendre.leggauss(12)
    for a, b in itertools.pairwise(knots):
        for s, w in zip(node, weight, strict=True):
            y = 0.5 * (a + b) + 0.5 * (b - a) * s
            each = number("forest", y) * forest(y) + number("damped", y) * damped(y)
            total += 0.5 * (b - a) * w * each
    return total


CASES = [(0.090, z) for z in (0.6, 1.1, 1.6, 2.5, 3.3, 4.5, 5.0, 6.5)]
CASES += [(0.075, z) for z in (0.6, 1.6, 2.5, 3.3, 5.0)]
CASES += [(0.050, z) for z in (1.1, 2.5, 3.3, 5.0)] + [(0.030, 5.0)]


@pytest.mark.parametrize(("rest", "z"), CASES)
def test_inoue_continuum_by_direct_integration(rest, z):
    """Eq. 25 to 29 are the integrals of the distribution, to the rounding of their coefficients."""
    wave = rest * (1 + z)
    got = depth(Inoue2014(), wave, z)[0] - series_depth(wave, z)
    assert got == pytest.approx(continuum_depth(wave, z), rel=0.01, abs=2e-3)


def test_inoue_continuum_by_hand_a_little_beyond_the_step_of_the_forest():
    """Equations 27 and 29, at 5.75 times the limit, from redshift 7."""
    x, y = 5.75, 8.0
    want = 5.22e-4 * (y**3.4 * x**2.1 - x**5.5)
    want += 0.04696 * y**3 - 0.01779 * y**3.3 * x**-0.3 - 0.02916 * x**3
    got = depth(Inoue2014(), 0.09118 * x, 7.0)[0] - series_depth(0.09118 * x, 7.0)
    assert got == pytest.approx(want, rel=1e-9)


@pytest.mark.parametrize(("wave", "z"), [(0.085, 0.5), (0.06, 0.5), (0.085, 1.5), (0.07, 3.5)])
def test_inoue_below_the_limit_as_seen_starts_at_redshift_zero(wave, z):
    """Not an equation of the paper: the same integrals with no absorber at z < 0."""
    got = depth(Inoue2014(), wave, z)[0]
    assert got == pytest.approx(continuum_depth(wave, z), rel=0.01, abs=3e-3)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("not a table", "is not table 2 of Inoue et al. 2014"),
        ("wavelength = [1.0, 2.0]\n", "is not table 2 of Inoue et al. 2014: 'laf1'"),
        (SHORT, "six columns of 39 positive numbers, from the longest wavelength on"),
    ],
)
def test_a_foreign_table_is_refused(tmp_path, text, match):
    path = tmp_path / "lines.toml"
    path.write_text(text)
    refuses(match, load_lines, str(path), error=DataError)


@pytest.mark.parametrize("z", [2.5, 3.6])
def test_lyman_limit_systems_of_meiksin_by_numerical_integration(z):
    """Meiksin 2006, sections 2.2 and 2.3: 0.25 y^1.5 systems per dz, of depth t as t^-1.5 / 2 from 1 upwards."""
    t = np.geomspace(1.0, 1e6, 20_001)
    # from 0.07 (1 + z) um on
    x = np.array([0.78, 0.85, 0.95]) * (1 + z)
    wave = x * _core.LYMAN_LIMIT

    def systems(y, x):
        return 0.25 * y**1.5 * np.trapezoid(0.5 * t**-1.5 * -np.expm1(-t * (x / y) ** 3), t)

    y = [np.linspace(one, 1 + z, 401) for one in x]
    hidden = [np.trapezoid([systems(a, b) for a in ys], ys) for b, ys in zip(x, y, strict=True)]
    lines, depths = igm._meiksin_lines()
    got = igm._meiksin(wave, z, *igm._lls_terms(), lines, np.zeros(depths.size))
    # between them, and in Lyman alpha of nearer gas
    thin = 0.805 * x**3 * (1 / x - 1 / (1 + z))
    forest = np.where(wave > lines[0], 0.00211 * (wave / lines[0]) ** 3.7, 0.0)
    assert_allclose(-np.log(got), thin + forest + hidden, rtol=2e-3)
    assert_allclose(-np.log(got) - thin - forest, hidden, rtol=3e-3)


@pytest.mark.parametrize("z", [1.0, 2.5, 4.0, 7.0])
def test_inoue_has_no_step_at_the_limit_as_seen(z):
    """There the lower limit of the integrals becomes redshift 0: both forms agree, digits of the paper apart."""
    sides = igm.INOUE_LIMIT * np.array([1 - 1e-7, 1 + 1e-7])
    below, above = (depth(Inoue2014(), wave, z)[0] for wave in sides)
    assert below == pytest.approx(above, abs=1e-4)
