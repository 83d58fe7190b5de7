import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import CCDData
from numpy.testing import assert_allclose

from miricigale.instrument import north_up_wcs
from miricigale.photometry import DETECTION_PRESETS, detect_sources


@pytest.fixture(scope="module")
def deep(tools):
    rng = np.random.default_rng(3)
    shape = (500, 500)
    wcs = north_up_wcs(tools.CENTER, 0.06 * u.arcsec, shape)
    grid = np.linspace(-11, 11, 5)
    dx, dy = (a.ravel() for a in np.meshgrid(grid, grid))
    sky = tools.CENTER.spherical_offsets_by(dx * u.arcsec, dy * u.arcsec)
    flux = np.geomspace(2, 200, 25)
    sigma = 0.01 / (tools.FINE**2 * tools.SR * 1e12)
    clean = tools.render(sky, flux, 0.15, wcs, shape)
    noisy = tools.as_ccd(clean + rng.normal(0, sigma, shape), wcs, sigma)
    return sky, flux, noisy


def test_all_sources_are_found_where_they_are(deep):
    sky, flux, image = deep
    segmentation, catalog = detect_sources(image, preset="default")
    assert len(catalog) == segmentation.n_labels == 25
    index, separation, _ = sky.match_to_catalog_sky(catalog["sky"])
    assert len(set(index)) == 25
    # error of a centroid: width over signal-to-noise
    assert separation.to_value(u.arcsec).max() < 0.03
    matched = catalog[index]
    assert_allclose(matched["flux"].to_value(u.uJy), flux, rtol=0.15)
    assert np.all(matched["flux"][5:] > 0.9 * flux[5:] * u.uJy)
    assert_allclose(matched["a"].to_value(u.arcsec)[10:], 0.15, rtol=0.15)
    labels = segmentation.data[np.rint(matched["y"]).astype(int), np.rint(matched["x"]).astype(int)]
    assert list(labels) == list(matched["label"])


def test_threshold_is_source_extractors(deep):
    # 'conv': 0.25 sigma of a pixel after a 5-pixel Gaussian; 'matched' would cover a third of the sky
    _, _, image = deep
    segmentation, catalog = detect_sources(image, preset="yang2021")
    covered = np.mean(segmentation.data > 0)
    assert covered < 0.15
    assert 25 <= len(catalog) < 120
    assert catalog.meta["threshold"] == 0.25
    assert catalog.meta["min_area"] == 60
    assert DETECTION_PRESETS["yang2021"].min_area == 60


def test_mask_background_and_missing_uncertainty(deep):
    _, _, image = deep
    masked = CCDData(image.data + 5 * image.uncertainty.array[0, 0], unit=image.unit, wcs=image.wcs)
    masked.mask = np.zeros(image.shape, bool)
    masked.mask[:, :250] = True
    segmentation, catalog = detect_sources(masked, preset="default", subtract_background=True)
    assert 10 <= len(catalog) <= 16
    assert segmentation.data[:, :245].max() == 0
    assert np.all(np.isfinite(catalog["flux_err"].value))


def test_empty_image(tools):
    rng = np.random.default_rng(0)
    wcs = north_up_wcs(tools.CENTER, 0.06 * u.arcsec, (100, 100))
    segmentation, catalog = detect_sources(
        tools.as_ccd(rng.normal(size=(100, 100)), wcs, 1.0), threshold=5
    )
    assert len(catalog) == 0
    assert catalog["flux"].unit == u.uJy
    assert segmentation.data.max() == 0


def test_bad_settings(deep):
    _, _, image = deep
    with pytest.raises(KeyError, match="no detection preset 'deep'; known: default"):
        detect_sources(image, preset="deep")
    with pytest.raises(ValueError, match="'threshold' must be positive"):
        detect_sources(image, threshold=-1)
    with pytest.raises(ValueError, match="'image' must be an image with a celestial WCS"):
        detect_sources(CCDData(np.ones((20, 20)), unit="MJy/sr"))
