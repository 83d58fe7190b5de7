"""Galaxies that the segmentation divides: each piece has its own light, and their sum is the galaxy."""

import types

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.results import assert_equal_values
from miricigale.photometry import ErrorSettings, ForcedFlags, ForcedPhotometer, SourceTemplates
from miricigale.photometry.fit.diagnostics import canceling
from miricigale.photometry.shapes.divided_galaxies import divided, joined_groups, padded

#: A large galaxy, two small ones and two points: arcsec from the center, rms widths in arcsec, uJy.
EAST = np.array([0.0, 2.2, -2.6, -2.4, 2.4])
NORTH = np.array([0.0, 1.3, 1.9, -2.2, -2.1])
SIZE = np.array([0.45, 0.15, 0.2, 0.0, 0.0])
FLUX = np.array([40.0, 10.0, 8.0, 6.0, 4.0])


def drawn(tools, seed):
    """Prior and image, each with noise of a seed."""
    sky = tools.places(EAST, NORTH)
    pixel = tools.SR * 1e12
    sigmas = 0.01 / (tools.FINE**2 * pixel), 0.01 / (0.11**2 * pixel)
    rng = np.random.default_rng(seed)
    return sky, *tools.pair(sky, FLUX, SIZE, (131, 71), sigmas, rng)


@pytest.fixture(scope="module")
def scene(tools):
    """Templates of the sources as they are, and of the large galaxy in five pieces."""
    sky, high, image = drawn(tools, 1)
    labels = tools.disks(sky, high.wcs, high.shape, 7)
    x, y = high.wcs.world_to_pixel(sky[0])
    rows, columns = np.indices(high.shape)
    inside = np.hypot(columns - x, rows - y) < 18
    labels[inside] = 1
    whole = QTable({"sky": sky, "label": np.arange(1, 6)})
    # a bar across, and what is left of it in four parts
    pieces = labels.copy()
    pieces[inside & (rows < y - 5)] = 6
    pieces[inside & (rows > y + 5)] = 7
    pieces[inside & (np.abs(rows - y) <= 5) & (columns > x + 6)] = 8
    pieces[inside & (rows < y - 5) & (columns > x)] = 9
    own = [np.argwhere(pieces == k).mean(axis=0)[::-1] for k in (1, 6, 7, 8, 9)]
    places = high.wcs.pixel_to_world(*np.array(own).T)
    ra = np.concatenate([places.ra.deg, sky.ra.deg[1:]])
    dec = np.concatenate([places.dec.deg, sky.dec.deg[1:]])
    divided_catalog = QTable({"sky": SkyCoord(ra, dec, unit="deg")})
    divided_catalog["label"] = [1, 6, 7, 8, 9, 2, 3, 4, 5]
    options = {"psf": tools.kernel.source, "n_threads": 1}
    return types.SimpleNamespace(
        high=high,
        image=image,
        labels=pieces,
        whole=SourceTemplates.from_images(high, labels, whole, **options),
        pieces=SourceTemplates.from_images(high, pieces, divided_catalog, **options),
    )


def test_sum_of_pieces_is_the_galaxy(tools, scene):
    photometer = ForcedPhotometer(tools.kernel, n_threads=1)
    result = photometer.measure(scene.image, templates=scene.pieces)
    alone = photometer.measure(scene.image, templates=scene.whole)
    shredded = tools.flagged(result.flags, ForcedFlags.SHREDDED)
    assert_array_equal(shredded, [True] * 5 + [False] * 4)
    assert not tools.flagged(alone.flags, ForcedFlags.SHREDDED).any()
    total, error = result.flux.value[:5].sum(), np.sqrt(result.covariance[:5, :5].sum())
    assert_allclose(total, FLUX[0], atol=3 * error)
    assert_allclose(total, alone.flux.value[0], rtol=0.005)
    assert_allclose(error, alone.flux_err.value[0], rtol=0.1)
    # the others do not notice
    assert_allclose(result.flux.value[5:], alone.flux.value[1:], rtol=0.01)
    assert not tools.flagged(result.flags, ForcedFlags.CANCELING).any()


def test_each_piece_has_the_light_of_its_segment(tools, scene):
    """Fluxes are those of the galaxy, a Gaussian, in the cells of the segments."""
    result = ForcedPhotometer(tools.kernel, n_threads=1).measure(
        scene.image, templates=scene.pieces
    )
    sky = tools.places(EAST[:1], NORTH[:1])
    width = np.hypot(SIZE[0], tools.HI)
    light = tools.render(sky, FLUX[:1], width, scene.high.wcs, scene.high.shape)
    light *= tools.FINE**2 * tools.SR * 1e12
    truth = np.array([light[scene.labels == k].sum() for k in (1, 6, 7, 8, 9)])
    # segments end at 1.08 arcsec, 2.3 widths: a few hundredths are beyond
    assert truth.sum() > 0.92 * FLUX[0]
    flux = result.flux.value[:5]
    assert np.all(flux > truth - 3 * result.flux_err.value[:5])
    assert np.all(flux < 1.25 * truth + 3 * result.flux_err.value[:5])
    assert_allclose(scene.pieces.fitted["share"][:5].sum(), 1.0)


def test_errors_are_those_of_the_degeneracy(tools, scene):
    """With exact templates T and white noise the covariance is that of least squares, the inverse of T^T W T."""
    errors = ErrorSettings(correlated_noise=False, size_scatter=None)
    photometer = ForcedPhotometer(tools.kernel, n_threads=1, errors=errors)
    result = photometer.measure(scene.image, templates=scene.pieces)
    columns = []
    for k in range(len(scene.pieces)):
        light = photometer.render(scene.image, scene.pieces[[k]], [1.0] * u.uJy)
        columns.append((light.value / scene.image.uncertainty.array).ravel())
    columns = np.array(columns)
    truth = np.linalg.inv(columns @ columns.T)
    pieces = result.covariance.toarray()[:5, :5]
    assert_allclose(pieces, truth[:5, :5], atol=0.01 * np.diag(truth)[:5].min())
    assert pieces[0, 1] < 0
    assert pieces.sum() < np.trace(pieces)


def test_pieces_on_exposures_are_those_on_one_image(tools, scene):
    """What is not known of a galaxy is the same for all of its pieces there too."""
    errors = ErrorSettings(correlated_noise=False)
    photometer = ForcedPhotometer(tools.kernel, background_order=0, errors=errors, n_threads=1)
    one = photometer.measure(scene.image, templates=scene.pieces)
    joint = photometer.measure([scene.image], templates=scene.pieces)
    assert_allclose(joint.flux, one.flux, rtol=1e-6)
    assert_allclose(joint.flux_err_template, one.flux_err_template, rtol=1e-6)
    assert_allclose(joint.covariance.toarray(), one.covariance.toarray(), rtol=1e-6, atol=1e-9)
    assert_array_equal(joint.flags, one.flags)


def test_pieces_without_the_largest_stay_what_they_are(tools, scene):
    """The template of the whole is kept with its largest piece: without it a point would be put in its place."""
    image = scene.image.copy()
    rows, columns = np.indices(image.shape)
    x, y = image.wcs.world_to_pixel(scene.pieces.sky[0])
    image.mask = (np.abs(rows - y) < 12) & (np.abs(columns - x) < 9)
    results = []
    for scatter in (None, 0.1):
        errors = ErrorSettings(correlated_noise=False, size_scatter=scatter)
        photometer = ForcedPhotometer(tools.kernel, errors=errors, n_threads=1)
        results.append(photometer.measure(image, templates=scene.pieces))
    fixed, free = results
    assert_array_equal(np.isnan(free.flux[:5]), [True, True, False, False, False])
    assert_allclose(free.flux[2:5], fixed.flux[2:5], rtol=0.01)
    assert np.all(free.flux_err[2:5] > fixed.flux_err[2:5])


def test_galaxies_side_by_side_stay_what_they_are(tools):
    """Two galaxies whose segments touch have peaks of their own."""
    sky = tools.places([-0.4, 0.4], [0.0, 0.1])
    size, pixel = np.array([0.12, 0.15]), tools.SR * 1e12
    sigmas = 0.01 / (tools.FINE**2 * pixel), 0.01 / (0.11**2 * pixel)
    flux, rng = np.array([20.0, 12.0]), np.random.default_rng(5)
    high, image = tools.pair(sky, flux, size, (91, 51), sigmas, rng)
    x, y = high.wcs.world_to_pixel(sky)
    rows, columns = np.indices(high.shape)
    distance = np.hypot(columns - x[:, None, None], rows - y[:, None, None])
    labels = np.where(distance.min(axis=0) < 9, 1 + np.argmin(distance, axis=0), 0)
    catalog = QTable({"sky": sky, "label": [1, 2]})
    result = ForcedPhotometer(tools.kernel, n_threads=1).measure(image, high, labels, catalog)
    assert not tools.flagged(result.flags, ForcedFlags.SHREDDED).any()
    assert np.all(np.abs(result.flux.value - flux) < 3 * result.flux_err.value)


def test_pieces_are_kept_in_files_and_joined(scene, tmp_path):
    assert sum(one is not None and one.galaxy is not None for one in scene.pieces.light) == 1
    scene.pieces.write(tmp_path / "templates.fits")
    assert_equal_values("pieces", scene.pieces, SourceTemplates.read(tmp_path / "templates.fits"))
    n = len(scene.pieces)
    parts = [scene.pieces[np.arange(5)], scene.pieces[np.arange(5, n)]]
    other = SourceTemplates(
        id=100 + parts[0].id, sky=parts[0].sky, light=parts[0].light, fitted=parts[0].fitted,
        wcs=parts[0].wcs, psf=parts[0].psf,
    )  # fmt: skip
    both = SourceTemplates.concatenate([*parts, other])
    assert_array_equal(both.fitted["galaxy"], [1] * 5 + [0] * (n - 5) + [3] * 5)


def test_divided_light_is_all_there_and_in_its_own_cells():
    image = np.arange(1.0, 37.0).reshape(6, 6)
    image /= image.sum()
    labels = np.zeros((6, 6), int)
    labels[2, 1], labels[2, 4], labels[4, 4] = 3, 5, 9
    core = labels == 3
    pieces, shares = divided(image, (10, 20), labels, [3, 5], core, np.full((6, 6), 0.01))
    again = np.zeros((6, 6))
    for piece, share in zip(pieces, shares, strict=True):
        y, x = np.subtract(piece.origin, (10, 20))
        again[y : y + piece.data.shape[0], x : x + piece.data.shape[1]] += share * piece.data
    assert_allclose(again, image, rtol=1e-6)
    # the middle between the two is between columns 2 and 3
    assert_allclose(shares, [image[:, :3].sum(), image[:, 3:].sum()])
    assert_allclose(pieces[0].noise, 0.01 / shares[0] ** 2)
    assert pieces[1].noise == 0.0


def test_groups_of_groups():
    assert joined_groups([[1, 4], [2, 3]], [[1, 7], [0, 5]]) == [[2, 3], [1, 4, 7], [0, 5]]


def test_padding():
    found = padded(np.arange(6).reshape(2, 3), (4, 5), (3, 6), (3, 4), -1)
    assert_array_equal(found, [[-1] * 4, [1, 2, -1, -1], [4, 5, -1, -1]])


def test_fluxes_that_cancel_are_flagged():
    """Above twice the light by three errors, or negative by five."""
    flux = np.array([10.0, 10.0, 3.0, -6.0, -4.0, np.nan])
    error = np.array([1.0, 3.0, 1.0, 1.0, 1.0, 1.0])
    seen = np.array([3.0, 3.0, -1.0, 2.0, 2.0, 2.0])
    assert_array_equal(canceling(flux, error, seen), [True, False, False, True, False, False])
