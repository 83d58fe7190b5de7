"""Painted Sersic profiles are the integrals over the pixels, through a PSF, to 0.1 %."""

import itertools

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from helpers import scenes
from miricigale.profiles import sersic_image
from miricigale.scene import Painter

#: Arcsec of the imager's pixel.
PIXEL = 0.11


def painted(n, radius, ratio, x, y, theta, *, size, sigma, oversampling=4):
    """One galaxy of unit light, painted as far as double precision goes."""
    painter = Painter((size, size), scenes.gaussian_psf(sigma, oversampling), enclosed=0.999999)
    galaxy = {"x": x, "y": y, "r_eff": radius, "n": n, "axis_ratio": ratio, "theta": theta}
    columns = {name: np.array([value]) for name, value in galaxy.items()}
    image, in_image, _ = painter.paint(flux=np.ones(1), is_sersic=np.ones(1, bool), **columns)
    assert in_image[0] == pytest.approx(image.sum(), rel=1e-5)
    return image


def on_cells(value, fine):
    """The middle of the cell of 1 / ``fine`` pixel that a place is in."""
    return (np.floor((value + 0.5) * fine) + 0.5) / fine - 0.5


def by_small_cells(n, radius, ratio, x, y, theta, *, size, sigma, fine=16, pad=7):
    """
    Closed-form light of small cells (tested by quadrature on their own), times a Gaussian.

    The center must be in the middle of a cell, where a cusp's light is as well. A cell's own
    width, and the sum over points in place of the pixel's integral, change the variance by the
    same small amount with opposite signs.
    """
    cells = (size + 2 * pad) * fine
    at = [(v + pad + 0.5) * fine - 0.5 for v in (x, y)]
    image = sersic_image(
        (cells, cells), x=at[0], y=at[1], r_eff=radius * fine, n=n, axis_ratio=ratio, theta=theta
    )
    for axis in (0, 1):
        image = gaussian_filter1d(image, sigma * fine, axis=axis, truncate=6.0)
    image = image.reshape(size + 2 * pad, fine, size + 2 * pad, fine).sum(axis=(1, 3))
    return image[pad:-pad, pad:-pad]


def check(galaxy, *, size, sigma=1.0):
    got = painted(*galaxy, size=size, sigma=sigma)
    want = by_small_cells(*galaxy, size=size, sigma=sigma)
    # the spline through the PSF's nodes is good to 1e-4 of the peak
    np.testing.assert_allclose(got, want, rtol=1e-3, atol=1e-4 * want.max())


@pytest.mark.parametrize(
    ("n", "arcsec", "ratio"),
    list(itertools.product([0.3, 1.0, 4.0, 8.0], [0.02, 0.5, 5.0], [0.1, 1.0]))
    + [(2.0, 1.0, 0.4), (0.7, 2.0, 0.6), (6.0, 0.2, 0.3)],
)
def test_corners_of_the_catalog(n, arcsec, ratio):
    """Indices, radii and axis ratios at their limits, at a place within the pixel of their own."""
    rng = np.random.default_rng(int(1000 * n + 100 * arcsec + 10 * ratio))
    x, y = on_cells(20 + rng.uniform(-0.5, 0.5, 2), 16)
    check((n, arcsec / PIXEL, ratio, x, y, rng.uniform(0, np.pi)), size=41)


@pytest.mark.parametrize("x", [20.03125, 20.21875, 20.46875])
@pytest.mark.parametrize("y", [20.03125, 20.34375, 20.53125])
def test_any_place_within_the_pixel(x, y):
    check((4.0, 0.1 / PIXEL, 0.3, x, y, 0.6), size=41)


@pytest.mark.parametrize("theta", [0.0, np.pi / 2, 0.4])
@pytest.mark.parametrize(
    ("n", "ratio"), [(0.8, 0.9), (1.0, 0.5), (2.5, 0.3), (4.0, 0.8), (8.0, 0.2)]
)
def test_wide_outskirts(n, ratio, theta):
    """Far from the center, where only one node in four is computed: every pixel to 1e-4."""
    galaxy = (n, 40.0, ratio, 20.3, 25.8, theta)
    got = painted(*galaxy, size=150, sigma=1.0)
    want = by_small_cells(*galaxy, size=150, sigma=1.0, fine=4)
    y, x = np.mgrid[:150, :150]
    used = (np.hypot(x - 20.3, y - 25.8) > 12) & (want > 1e-6 * want.max())
    assert used.sum() > 2000
    np.testing.assert_allclose(got[used], want[used], rtol=1e-4)
