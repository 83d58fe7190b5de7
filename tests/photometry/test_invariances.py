"""Fluxes do not depend on how sources are called and ordered, nor on how pixels are laid out and scaled."""

import types

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.testing import assert_allclose, assert_array_equal

from helpers.mosaics import flagged, kernel, lattice, measured, pair, picture, places
from miricigale.photometry import ForcedFlags, ForcedPhotometer, detect_sources

#: Parts of the errors: shifts of the grid by whole pixels, and sources that are detected anew.
SHIFTED, DETECTED = 1e-5, 1e-3


@pytest.fixture(scope="module")
def field():
    """Sixteen galaxies with noise, detected on their prior, and their fluxes."""
    rng = np.random.default_rng(11)
    sky = places(*lattice(rng, 4, 3.4, 0.4))
    size, flux = rng.uniform(0.05, 0.2, 16), np.geomspace(2.0, 30.0, 16)
    prior, image = pair(sky, flux, size, (300, 170), (0.01, 0.005), rng)
    segments, catalog = detect_sources(prior)
    made = types.SimpleNamespace(prior=prior, image=image, segments=segments, catalog=catalog)
    made.result = ForcedPhotometer(kernel).measure(image, prior, segments, catalog)
    return made


def fluxes(field, **changes):
    """Fluxes of the field with another image, prior, segmentation or catalog, by position of the source."""
    parts = {**vars(field), **changes}
    arguments = (parts[name] for name in ("image", "prior", "segments", "catalog"))
    result = ForcedPhotometer(kernel).measure(*arguments)
    index, apart, _ = field.catalog["sky"].match_to_catalog_sky(result.sky)
    assert apart.max() < 0.05 * u.arcsec
    return result.flux[index]


def assert_within(field, flux, sigmas):
    """Fluxes are those of the field to a part of their errors."""
    change = (flux - field.result.flux) / field.result.flux_err
    assert_allclose(change.to_value(u.one), 0.0, atol=sigmas)


def placed(image, shape, corner, fill=np.nan):
    """An image on a larger grid of the same pixels, of which those around it have no data."""
    y, x = corner
    inside = slice(y, y + image.shape[0]), slice(x, x + image.shape[1])
    data, error = np.full(shape, fill), np.full(shape, fill)
    data[inside], error[inside] = image.data, image.uncertainty.array
    wcs = image.wcs.deepcopy()
    wcs.wcs.crpix += [x, y]
    wcs.pixel_shape = shape[::-1]
    return CCDData(data, unit=image.unit, wcs=wcs, uncertainty=StdDevUncertainty(error))


def turned(image):
    """The same sky with its pixels counted from the opposite corner: both steps have the other sign."""
    wcs = image.wcs.deepcopy()
    wcs.wcs.crpix = np.array(image.shape[::-1]) + 1 - wcs.wcs.crpix
    wcs.wcs.cdelt = -wcs.wcs.cdelt
    wcs.wcs.set()
    error = StdDevUncertainty(image.uncertainty.array[::-1, ::-1].copy())
    data = image.data[::-1, ::-1].copy()
    return CCDData(data, unit=image.unit, wcs=wcs, uncertainty=error)


def test_names_and_order_of_sources(field):
    """Labels of any size and order, rows in another order: 2e-5 of the errors."""
    rng = np.random.default_rng(5)
    labels = rng.permutation(np.arange(100, 2000, 7))[: len(field.catalog)]
    data = np.asarray(field.segments.data)
    renamed, catalog = np.zeros_like(data), field.catalog.copy()
    for number, label in zip(field.catalog["id"], labels, strict=True):
        renamed[data == number] = label
    catalog["id"] = catalog["label"] = labels
    order = rng.permutation(len(catalog))
    assert_within(field, fluxes(field, segments=renamed, catalog=catalog[order]), 2e-5)


def test_pixels_counted_from_the_other_corner(field):
    """2e-5 of the errors for the image, 2e-3 for the prior with its segments."""
    assert_within(field, fluxes(field, image=turned(field.image)), 2e-5)
    segments = np.asarray(field.segments.data)[::-1, ::-1]
    flux = fluxes(field, prior=turned(field.prior), segments=segments)
    assert_within(field, flux, 2e-3)


def test_whole_pixels_around_the_image(field):
    """Rows and columns without data move every source to another pixel number."""
    larger = placed(field.image, (181, 183), (4, 7))
    assert_within(field, fluxes(field, image=larger), SHIFTED)


def test_whole_pixels_around_the_prior(field):
    """With the segments of the field, and with sources that are detected anew."""
    larger = placed(field.prior, (317, 323), (10, 13))
    segments = np.zeros(larger.shape, np.int32)
    segments[10:310, 13:313] = field.segments.data
    assert_within(field, fluxes(field, prior=larger, segments=segments), SHIFTED)
    again, catalog = detect_sources(larger)
    assert_within(field, fluxes(field, prior=larger, segments=again, catalog=catalog), DETECTED)


def test_light_and_noise_in_another_scale(field):
    """Image and errors times ten, in another unit, and the prior in any scale."""
    image, error = field.image, StdDevUncertainty(10.0 * field.image.uncertainty.array)
    bright = CCDData(10.0 * image.data, unit=image.unit, wcs=image.wcs, uncertainty=error)
    assert_within(field, fluxes(field, image=bright) / 10.0, 3e-5)
    mega = CCDData(
        image.data * 1e6, unit="Jy/sr", wcs=image.wcs,
        uncertainty=StdDevUncertainty(image.uncertainty.array * 1e6),
    )  # fmt: skip
    assert_within(field, fluxes(field, image=mega), 3e-5)


def test_a_source_that_is_given_twice():
    """The first row has the flux of the source; the second is flagged and has none."""
    sky = places([0.0, 3.0, 3.0], [0.0, 1.0, 1.0])
    image = picture(sky, np.array([10.0, 20.0, 0.0]), (110, 110))
    single, twice = measured(image, sky[:2]), measured(image, sky)
    assert_allclose(twice.flux.value[:2], single.flux.value, rtol=1e-6)
    assert np.isnan(twice.flux.value[2])
    assert flagged(twice.flags, ForcedFlags.DEGENERATE).tolist() == [False, False, True]


def test_results_of_every_format(field, tmp_path):
    from miricigale.utils.table_files import read_table, write_table

    table = field.result.to_table("miri.f770w")
    for name in ("a.fits", "a.ecsv"):
        write_table(table, tmp_path / name)
        again = read_table(tmp_path / name, wanted="a table")
        for column in ("id", "miri.f770w", "miri.f770w_err", "miri.f770w_flags"):
            assert_array_equal(np.asarray(again[column]), np.asarray(table[column]), name)
        assert again["miri.f770w"].unit == u.uJy
