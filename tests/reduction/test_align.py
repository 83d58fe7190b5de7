import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.time import Time
from numpy.testing import assert_array_equal

from helpers.errors import refuses
from helpers.exposures import FIELD as CENTER
from helpers.exposures import gaussians, image_of, imager_part
from miricigale.reduction import BackgroundSettings, Reducer, align_images, align_to_catalog

SHAPE = (400, 420)


def cut(pointing, angle=30.0):
    return imager_part(pointing, (480, 320), SHAPE, angle)


def observed(true, told, sky, peaks, rng):
    """Image of Gaussian stars by one WCS that tells another."""
    data = rng.normal(size=SHAPE) + 20 + gaussians(SHAPE, *true.world_to_pixel(sky), peaks, 1.1)
    return image_of(data, told, filter="miri.f770w")


def off(wcs, true):
    """Largest distance of two WCS over the image, arcsec."""
    x, y = np.meshgrid(np.linspace(0, SHAPE[1], 5), np.linspace(0, SHAPE[0], 5))
    return wcs.pixel_to_world(x, y).separation(true.pixel_to_world(x, y)).arcsec.max()


@pytest.fixture
def stars():
    rng = np.random.default_rng(1)
    reference = cut(CENTER)
    sky = reference.pixel_to_world(rng.uniform(-60, 480, 60), rng.uniform(-60, 460, 60))
    return sky, 10 ** rng.uniform(1.3, 2.5, 60)


@pytest.mark.parametrize("turn", [0.0, 0.05])
def test_offsets_are_taken_off_to_ten_mas(stars, turn):
    sky, peaks = stars
    rng = np.random.default_rng(2)
    true = cut(CENTER)
    for east, north in ((0.3, 0.0), (-0.2, 0.25)):
        there = CENTER.spherical_offsets_by(east * u.arcsec, north * u.arcsec)
        image = observed(true, cut(there, 30.0 + turn), sky, peaks, rng)
        # a catalog with other sources, and errors of 5 mas
        extra = true.pixel_to_world(rng.uniform(0, 420, 100), rng.uniform(0, 400, 100))
        catalog = SkyCoord(np.append(sky.ra, extra.ra), np.append(sky.dec, extra.dec))
        errors = rng.normal(size=(2, 160)) * 5 * u.mas
        aligned, alignment = align_to_catalog(image, catalog.spherical_offsets_by(*errors))
        assert off(image.wcs, true) > 0.29
        assert off(aligned.wcs, true) < 0.01
        assert alignment.n_matched > 20
        assert alignment.rotation.value == pytest.approx(-turn, abs=0.006)
        assert 3 < alignment.scatter.to_value("mas") < 20
        if not turn:
            assert alignment.east.value == pytest.approx(-east, abs=0.01)
            assert alignment.north.value == pytest.approx(-north, abs=0.01)
        assert_array_equal(aligned.data, image.data)


def test_dithers_are_aligned_to_the_first(stars):
    sky, peaks = stars
    rng = np.random.default_rng(3)
    images, truths = [], []
    for k, (dx, dy) in enumerate(((0, 0), (6, 2), (-4, 7))):
        pointing = CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
        error = 0.3 * u.arcsec if k else 0 * u.arcsec
        told = pointing.spherical_offsets_by((-1) ** k * error, error / 2)
        truths.append(cut(pointing))
        images.append(observed(truths[-1], cut(told), sky, peaks, rng))
    aligned, alignments = align_images(images)
    assert alignments[0].east == 0
    for im, true in zip(aligned, truths, strict=True):
        assert off(im.wcs, true) < 0.01
    reducer = Reducer(background=BackgroundSettings("sep"))
    result = reducer.combine(images, [], align="dithers")
    # stars of images that lie 0.3 arcsec beside each other are outliers
    both = result, reducer.combine(images, [])
    count = [sum(im.meta["n_outliers"] for im in one.images) for one in both]
    assert count[0] < 0.1 * count[1]
    wanted = "'align' must be a SkyCoord, 'dithers' or None"
    refuses(wanted, reducer.combine, images, [], align="gaia")


@pytest.mark.slow
def test_visits_are_moved_as_a_whole(stars):
    """A dither of two stars alone has its place by the others of its visit."""
    sky, peaks = stars
    rng = np.random.default_rng(7)
    images, truths = [], []
    for k, (dx, dy) in enumerate(((0, 0), (6, 2), (-4, 7), (3, -6))):
        pointing = CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
        error = 0.4 * u.arcsec if k > 1 else 0 * u.arcsec
        told = cut(pointing.spherical_offsets_by(error, -error / 2), 30.03 if k > 1 else 30.0)
        truths.append(cut(pointing))
        x, y = truths[-1].world_to_pixel(sky)
        inside = (x > 30) & (x < 390) & (y > 30) & (y < 370)
        some = np.flatnonzero(inside)[:2] if k == 3 else np.arange(60)
        images.append(observed(truths[-1], told, sky[some], peaks[some] + 50, rng))
        images[-1].meta["keywords"] = {"VISIT_ID": [f"0134500100{k // 2}", ""]}
    refuses(r"'images\[3\]' must be one with at least 3 sources", align_images, images)
    aligned, alignments = align_images(images, groups=[0, 0, 1, 1])
    assert alignments[2] is alignments[3]
    for im, true, before in zip(aligned, truths, images, strict=True):
        assert off(im.wcs, true) < 0.012
        assert_array_equal(im.data, before.data)
    reducer = Reducer(background=BackgroundSettings("sep"))
    result = reducer.combine(images, [], align="visits")
    assert max(off(im.wcs, true) for im, true in zip(result.images, truths, strict=True)) < 0.012
    refuses("'groups' must be one for each of 4 images, got 1", align_images, images, groups=[0])
    images[0].meta["keywords"] = {}
    wanted = "'images' must be ones with the keyword VISIT_ID"
    refuses(wanted, reducer.combine, images, [], align="visits")


def test_of_two_shifts_that_are_as_frequent_one_is_taken(stars):
    """A catalog that holds each star twice, with and without an error of 0.5 arcsec."""
    sky, peaks = stars
    true = cut(CENTER)
    image = observed(true, true, sky, peaks, np.random.default_rng(6))
    twice = SkyCoord([sky, sky.spherical_offsets_by(0.5 * u.arcsec, 0 * u.arcsec)]).ravel()
    _, alignment = align_to_catalog(image, twice)
    assert min(abs(alignment.east.value - e) for e in (0, 0.5)) < 0.01
    assert alignment.scatter.to_value("mas") < 20


def test_what_cannot_be_aligned_is_named(stars):
    sky, peaks = stars
    image = observed(cut(CENTER), cut(CENTER), sky, peaks, np.random.default_rng(4))
    far = sky.spherical_offsets_by(60 * u.arcsec, 0 * u.arcsec)[:10]
    wanted = "'image' must be one with at least 3 sources"
    refuses(wanted, align_to_catalog, image, far, radius=0.05 * u.arcsec)
    lone = observed(cut(far[0]), cut(CENTER), far, peaks[:10], np.random.default_rng(5))
    wanted = r"'images\[1\]' must be one with at least 3 .* got 0 of \d+"
    refuses(wanted, align_images, [image, lone], radius=0.01 * u.arcsec)
    refuses("'catalog' must be a SkyCoord of several", align_to_catalog, image, sky[0])
    lost = SkyCoord(np.append(sky.ra, np.nan * u.deg), np.append(sky.dec, 0 * u.deg))
    refuses("'catalog' must be of finite positions, got 1 of 61", align_to_catalog, image, lost)
    galactic = image.copy()
    galactic.wcs = image.wcs.deepcopy()
    galactic.wcs.wcs.ctype = "GLON-TAN", "GLAT-TAN"
    wanted = "'image' must be one with right ascension .* got GLON-TAN"
    refuses(wanted, align_to_catalog, galactic, sky)
    image.meta = {}
    refuses("'image' must be one whose meta names its filter", align_to_catalog, image, sky)


def test_proper_motions_bring_a_catalog_to_the_time_of_the_image(stars):
    sky, peaks = stars
    rng = np.random.default_rng(5)
    motions = rng.normal([[12.0], [-9.0]], 2.0, (2, 60)) * u.mas / u.yr
    then, now = Time(2016.0, format="jyear"), Time(2024.5, format="jyear")
    start = sky.spherical_offsets_by(*(-motions * 8.5 * u.yr))
    gaia = SkyCoord(start.ra, start.dec, pm_ra_cosdec=motions[0], pm_dec=motions[1], obstime=then)
    image = observed(cut(CENTER), cut(CENTER), sky, peaks, rng)
    refuses("time of the image is not known", align_to_catalog, image, gaia)
    image.meta["keywords"] = {"MJD-AVG": [now.mjd, "middle"]}
    for solution in (align_to_catalog(image, gaia)[1], align_images([image], gaia)[1][0]):
        # 128 mas without them; the scatter of the motions alone would be 17
        assert abs(solution.east.to_value(u.mas)) < 3
        assert abs(solution.north.to_value(u.mas)) < 3
        assert solution.scatter.to_value(u.mas) < 12
    undated = SkyCoord(gaia.ra, gaia.dec, pm_ra_cosdec=motions[0], pm_dec=motions[1])
    refuses("no obstime", align_to_catalog, image, undated)
