import itertools

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import erfc, gamma

from helpers.errors import refuses
from miricigale.profiles import (
    _core,
    sersic_bn,
    sersic_enclosed_fraction,
    sersic_image,
    sersic_radius,
    sersic_stamp,
)
from miricigale.profiles.sersic import light_table, parameter_rows

INDICES = (0.3, 0.5, 1.0, 2.5, 4.0, 8.0)


def test_bn_is_what_ciotti_and_bertin_give():
    n = np.array([1.0, 2.0, 4.0, 8.0])
    series = 2 * n - 1 / 3 + 4 / (405 * n) + 46 / (25515 * n**2) + 131 / (1148175 * n**3)
    assert_allclose(sersic_bn(n), series, rtol=1e-4)


def test_light_beyond_ten_radii():
    # 3.9 % at n = 4 and 11.5 % at n = 8
    assert_allclose(1 - sersic_enclosed_fraction(10.0, [4, 8]), [0.039, 0.115], atol=5e-4)


@pytest.mark.parametrize("n", INDICES)
def test_radius_inverts_the_enclosed_fraction(n):
    assert sersic_enclosed_fraction(1.0, n) == pytest.approx(0.5, abs=1e-12)
    assert sersic_enclosed_fraction(sersic_radius(0.93, n), n) == pytest.approx(0.93, rel=1e-10)


@pytest.mark.parametrize("ratio", [0.1, 0.6, 1.0])
@pytest.mark.parametrize("r_eff", [0.2, 2.0])
@pytest.mark.parametrize("n", INDICES)
def test_total_light_and_division_of_pixels(n, r_eff, ratio):
    rng = np.random.default_rng([int(10 * n), int(10 * r_eff), int(10 * ratio)])
    x, y = rng.uniform(99.5, 100.5, 2)
    theta = rng.uniform(0, np.pi)
    shape = {"n": n, "axis_ratio": ratio, "theta": theta, "total_flux": 7.0}
    image = sersic_image((201, 201), x=x, y=y, r_eff=r_eff, **shape)
    # everything within 100 pixels, up to what lies beyond
    beyond = 1 - sersic_enclosed_fraction(100 / r_eff, n)
    assert 7 * (1 - beyond) * (1 - 1e-4) <= image.sum() <= 7 * (1 + 1e-4)
    # pixels are sums of smaller pixels, the central one included
    fine = sersic_image((35, 35), x=5 * (x - 97) + 2, y=5 * (y - 97) + 2, r_eff=5 * r_eff, **shape)
    coarse = image[97:104, 97:104]
    sums = fine.reshape(7, 5, 7, 5).sum(axis=(1, 3))
    assert_allclose(sums, coarse, rtol=1e-3, atol=3e-4 * coarse.max())


NODES, WEIGHTS = np.polynomial.legendre.leggauss(10)


def pixel_integral(i, j, x, y, r_eff, n, ratio, theta):
    """
    Light of a pixel by adaptive quadrature of the brightness.

    Squares are divided in four until that changes their 10 x 10 points' sum by less than
    1e-5 of the light found so far; a pixel begins with the centre on an edge.
    """
    bn = sersic_bn(n)
    norm = bn ** (2 * n) / (2 * np.pi * n * r_eff**2 * ratio * gamma(2 * n))

    def sums(boxes):
        x0, x1, y0, y1 = boxes[:, :, None, None].transpose(1, 0, 2, 3)
        u = 0.5 * (x0 + x1) + 0.5 * (x1 - x0) * NODES[None, None, :]
        v = 0.5 * (y0 + y1) + 0.5 * (y1 - y0) * NODES[None, :, None]
        p = (u * np.cos(theta) + v * np.sin(theta)) / r_eff
        q = (v * np.cos(theta) - u * np.sin(theta)) / (ratio * r_eff)
        values = np.exp(-bn * np.hypot(p, q) ** (1 / n))
        area = 0.25 * ((x1 - x0) * (y1 - y0))[:, 0, 0]
        return norm * area * np.einsum("kij,i,j->k", values, WEIGHTS, WEIGHTS)

    def pieces(low):
        zero = [0.0] if low < 0 < low + 1 else []
        return itertools.pairwise(np.unique([*np.linspace(low, low + 1, 7), *zero]))

    columns, rows = pieces(j - 0.5 - x), pieces(i - 0.5 - y)
    boxes = np.array([(*a, *b) for a, b in itertools.product(columns, rows)])
    coarse, total = sums(boxes), 0.0
    for _ in range(40):
        a, b, c, d = boxes.T
        e, f = 0.5 * (a + b), 0.5 * (c + d)
        parts = np.array([(a, e, c, f), (e, b, c, f), (a, e, f, d), (e, b, f, d)])
        parts = parts.transpose(2, 0, 1)
        fine = sums(parts.reshape(-1, 4)).reshape(-1, 4)
        open_ = np.abs(fine.sum(axis=1) - coarse) > 1e-5 * (total + fine.sum()) / len(boxes)
        total += fine[~open_].sum()
        if not np.any(open_):
            return total
        boxes, coarse = parts[open_].reshape(-1, 4), fine[open_].ravel()
    return total + coarse.sum()


@pytest.mark.parametrize("ratio", [0.1, 0.4, 1.0])
@pytest.mark.parametrize("r_eff", [0.18, 1.0, 10.0, 83.0])
@pytest.mark.parametrize("n", [0.3, 0.5, 1.0, 4.0, 8.0])
def test_every_pixel_is_the_integral_over_it(n, r_eff, ratio):
    """0.02 arcsec on the imager's pixels to 5 arcsec on those of a mosaic of 0.06."""
    rng = np.random.default_rng([int(10 * n), int(100 * r_eff), int(10 * ratio)])
    x, y = 15 + rng.uniform(-0.5, 0.5, 2)
    theta = rng.uniform(0, np.pi)
    image = sersic_image((31, 31), x=x, y=y, r_eff=r_eff, n=n, axis_ratio=ratio, theta=theta)
    # the centre, its neighbours, along the thin axis and across it
    pixels = {(15, 15), (15, 16), (14, 15), (16, 14)}
    for turn in (theta, theta + np.pi / 2):
        for r in (3, 12):
            pixels.add((round(15 + r * np.sin(turn)), round(15 + r * np.cos(turn))))
    checked = 0
    for i, j in pixels:
        if image[i, j] < 5e-7:
            continue
        truth = pixel_integral(i, j, x, y, r_eff, n, ratio, theta)
        assert image[i, j] == pytest.approx(truth, rel=1e-3), (i, j)
        checked += 1
    assert checked >= 1


def cell_of(dx, dy, size, r_eff, **shape):
    """Light of a cell of a source of unit light, and the offset of its centroid."""
    rows = parameter_rows(x=0, y=0, total_flux=1, r_eff=r_eff, **shape)
    out = np.empty(3)
    _core.cell(dx, dy, size, rows[0], light_table(shape["n"])[0], out)
    return out


@pytest.mark.parametrize(
    ("size", "dx", "dy"), [(0.8, 0.2, 0.3), (0.8, -0.7, 1.1), (0.8, 3.0, 4.0), (0.2, 3.0, 4.0)]
)
def test_light_and_centroid_of_a_cell_whatever_the_unit_of_length(size, dx, dy):
    """Sums of 1000 x 1000 points of an exponential disk (Graham & Driver 2005, eq. 1 and 2)."""
    r_eff, ratio, theta = 2.5, 0.6, 0.5
    shape = {"n": 1.0, "axis_ratio": ratio, "theta": theta}
    found = cell_of(dx, dy, size, r_eff, **shape)
    u, v = np.meshgrid(*[size * ((np.arange(1000) + 0.5) / 1000 - 0.5)] * 2)
    x, y, bn = dx + u, dy + v, sersic_bn(1.0)
    along, across = x * np.cos(theta) + y * np.sin(theta), y * np.cos(theta) - x * np.sin(theta)
    values = np.exp(-bn * np.hypot(along, across / ratio) / r_eff)
    light = bn**2 / (2 * np.pi * r_eff**2 * ratio) * values.mean() * size**2
    assert found[0] == pytest.approx(light, rel=1e-6)
    centroid = np.average(u, weights=values), np.average(v, weights=values)
    assert_allclose(found[1:], centroid, atol=2e-5 * size)
    smaller = cell_of(dx / 16, dy / 16, size / 16, r_eff / 16, **shape)
    assert_allclose(smaller * (1, 16, 16), found, rtol=1e-10)


def test_cells_of_a_gaussian_are_products_of_error_functions():
    """The index 0.5, from the middle to where the light is 1e-33 of the total."""
    sigma, side = 1.5, 41
    image = sersic_image((side, side), x=20, y=20, r_eff=sigma * np.sqrt(2 * np.log(2)), n=0.5)
    near = np.abs(np.arange(side) - 20)
    one = 0.5 * (erfc((near - 0.5) / sigma / 2**0.5) - erfc((near + 0.5) / sigma / 2**0.5))
    assert_allclose(image, one * one[:, None], rtol=1e-5, atol=1e-35)
    # and far below the half-light radius the light is the central brightness times the area
    light = cell_of(0, 0, 1e-9, 1.0, n=0.5, axis_ratio=1, theta=0)[0]
    assert light / 1e-18 == pytest.approx(np.log(2) / np.pi, rel=1e-6)


def test_stamp_is_a_cut_of_the_image():
    kwargs = {"r_eff": 2.5, "n": 2, "axis_ratio": 0.5, "theta": 1.0, "total_flux": 3.0}
    stamp, (y0, x0) = sersic_stamp(x=70.2, y=60.9, **kwargs)
    image = sersic_image((140, 140), x=70.2, y=60.9, **kwargs)
    ny, nx = stamp.shape
    assert_allclose(stamp, image[y0 : y0 + ny, x0 : x0 + nx], rtol=1e-9)
    assert 3 * 0.995 < stamp.sum() < 3
    small, _ = sersic_stamp(x=70.2, y=60.9, max_radius=4, **kwargs)
    assert max(small.shape) <= 9


@pytest.mark.parametrize(
    ("name", "value", "match"),
    [
        ("n", 0.1, "'n' must be within 0.2 and 10.0, got 0.1"),
        ("r_eff", 0.0, "'r_eff' must be positive, got 0.0"),
        ("axis_ratio", 1.5, "'axis_ratio' must be above 0 and at most 1"),
        ("total_flux", np.nan, "'total_flux' must be finite"),
    ],
)
def test_refuses(name, value, match):
    kwargs = {"x": 5, "y": 5, "r_eff": 2.0, "n": 1.0, name: value}
    refuses(match, sersic_image, (11, 11), **kwargs)
