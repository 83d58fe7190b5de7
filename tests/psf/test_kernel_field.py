import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.psf import KernelField, MatchingKernel, gaussian_psf, psf_grid

CENTER = SkyCoord(53.1, -27.8, unit="deg")
KIND = {"pixel_scale": 0.06 * u.arcsec, "fov": 3 * u.arcsec}
OPTIONS = {"pixel_scale": 0.06 * u.arcsec, "regularization": 1e-4}


def kernel(fwhm):
    psfs = (gaussian_psf(width * u.arcsec, **KIND) for width in (0.2, fwhm))
    return MatchingKernel.from_psfs(*psfs, **OPTIONS)


def places(*offsets):
    east, north = np.array(offsets, float).T
    return CENTER.spherical_offsets_by(east * u.arcmin, north * u.arcmin)


KERNELS = [kernel(fwhm) for fwhm in (0.45, 0.5, 0.55, 0.6, 0.65)]


@pytest.mark.parametrize(
    "offsets",
    [[(0, 0), (2, 0), (0, 2), (2, 2), (1, 0.7)], [(0, 0), (1, 1), (2, 2), (3, 3), (5, 5)]],
)
def test_linear_weights_reproduce_the_position(offsets):
    field = KernelField(KERNELS, places(*offsets))
    rng = np.random.default_rng(1)
    # inside, or on the line
    inside = rng.uniform(0, 2, (30, 2))
    if offsets[1] == (1, 1):
        inside[:, 1] = inside[:, 0]
    weights = field.weights(places(*inside))
    assert_allclose(weights.sum(axis=1), 1)
    assert (weights >= 0).all()
    assert_allclose(weights @ np.array(offsets, float), inside, atol=2e-5)
    # beyond, it is the nearest point of the rim
    weights = field.weights(places((-3, -3), (-10, -10.1)))
    assert_allclose(weights[0], [1, 0, 0, 0, 0], atol=1e-6)
    assert_allclose(weights[1], [1, 0, 0, 0, 0], atol=1e-6)


def test_nearest_and_ends():
    offsets = [(0, 0), (2, 0), (0, 2), (2, 2), (1, 0.7)]
    field = KernelField(KERNELS, places(*offsets), method="nearest")
    weights = field.weights(places((0.3, 0.1), (1.9, 5), (1, 1)))
    assert weights.tolist() == [[1, 0, 0, 0, 0], [0, 0, 0, 1, 0], [0, 0, 0, 0, 1]]
    assert field.at(places((1, 1))[0]).array == pytest.approx(KERNELS[4].array)
    alone = KernelField(KERNELS[:1], places((0, 0)))
    assert alone.weights(places((4, 4), (0, 0))).tolist() == [[1], [1]]
    assert field.weights(places((4, 4))[:0]).shape == (0, 5)


def test_from_a_gridded_psf():
    wcs = north_up_wcs(CENTER, 0.11 * u.arcsec, (1000, 1200))
    xy = [(x, y) for x in (100, 1100) for y in (50, 950)]
    fwhm = {100: 0.45, 1100: 0.55}
    grid = psf_grid([gaussian_psf(fwhm[x] * u.arcsec, **KIND) for x, _ in xy], xy)
    sharp = gaussian_psf(0.2 * u.arcsec, **KIND)
    field = KernelField.from_psfs(sharp, grid, wcs=wcs, **OPTIONS)
    assert len(field) == 4
    assert field.pixel_scale == 0.06 * u.arcsec
    for x, width in fwhm.items():
        made = field.at(wcs.pixel_to_world(x, 500.0))
        assert_allclose(made.array, kernel(width).array, atol=1e-8)
    middle = field.at(wcs.pixel_to_world(600.0, 300.0))
    assert_allclose(middle.array, (kernel(0.45).array + kernel(0.55).array) / 2, atol=1e-6)


BARE = MatchingKernel(np.eye(3), 0.06 * u.arcsec)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"kernels": []}, "'kernels' must be MatchingKernels, at least one"),
        ({"sky": CENTER}, "'sky' must be a SkyCoord of shape"),
        ({"sky": places((0, 0), (0, 0))}, "'sky' must be different places"),
        ({"method": "cubic"}, "'method' must be 'linear' or 'nearest'"),
        ({"kernels": [KERNELS[0], KERNELS[1].array]}, "'kernels' must be Matching"),
        ({"kernels": [KERNELS[0], BARE]}, "'kernels' must be with their source"),
    ],
)
def test_what_is_refused(change, text):
    refuses(text, KernelField, **{"kernels": KERNELS[:2], "sky": places((0, 0), (1, 0)), **change})
    psf, wanted = gaussian_psf(0.5 * u.arcsec, **KIND), "'lo' must be a PSFGrid"
    refuses(wanted, KernelField.from_psfs, None, psf, wcs=None, error=TypeError)
