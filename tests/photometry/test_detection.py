import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi, kstest

from helpers.errors import refuses
from miricigale.instrument import north_up_wcs
from miricigale.photometry import (
    DETECTION_PRESETS,
    DetectionPreset,
    DilationRule,
    chi_image,
    detect_sources,
    detection_purity,
    dilate_segments,
)
from miricigale.utils.exceptions import PhotometryWarning


@pytest.fixture(scope="module")
def deep(tools):
    rng, at = np.random.default_rng(3), np.meshgrid(*[np.linspace(-11, 11, 5)] * 2)
    sky, flux = tools.places(*(one.ravel() for one in at)), np.geomspace(2, 200, 25)
    form = {"scale": tools.FINE, "sigma": 0.01 / (tools.FINE**2 * tools.SR * 1e12), "rng": rng}
    return sky, flux, tools.picture(sky, flux, (500, 500), width=0.15, **form)


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
    assert_allclose(matched["semimajor_axis"].to_value(u.arcsec)[10:], 0.15, rtol=0.15)
    x, y = (np.rint(matched[f"{axis}_centroid"]).astype(int) for axis in "xy")
    assert list(segmentation.data[y, x]) == list(matched["label"])


def test_threshold_is_source_extractors(deep):
    # 'conv': 0.25 sigma of a pixel after a 5-pixel Gaussian; 'matched' would cover a third of the sky
    _, _, image = deep
    segmentation, catalog = detect_sources(image, preset="yang2021")
    covered = np.mean(segmentation.data > 0)
    assert covered < 0.15
    assert 25 <= len(catalog) < 120
    assert catalog.meta["threshold"] == 0.25
    assert catalog.meta["n_pixels"] == 60
    assert DETECTION_PRESETS["yang2021"].n_pixels == 60


def test_a_bright_pixel_is_spread_by_a_gaussian_of_the_width_of_the_preset():
    """All pixels within the radius at which the Gaussian crosses the threshold, and none beyond."""
    wcs = north_up_wcs(SkyCoord(53.1, -27.8, unit="deg"), 0.1 * u.arcsec, (41, 41))
    data = np.zeros((41, 41))
    data[20, 18] = 100.0
    image = CCDData(data, uncertainty=StdDevUncertainty(np.ones((41, 41))), unit="uJy", wcs=wcs)
    y, x = np.indices(data.shape)
    square = (y - 20) ** 2 + (x - 18) ** 2
    sigma = 4.0 / np.sqrt(8 * np.log(2))
    # between two squares of distances from one pixel to another
    for limit in (3.0, 6.5):
        threshold = 100 * np.exp(-limit / (2 * sigma**2)) / (2 * np.pi * sigma**2)
        preset = DetectionPreset(threshold=threshold, n_pixels=3, fwhm=4.0)
        segmentation, _ = detect_sources(image, preset=preset)
        assert_array_equal(segmentation.data > 0, square < limit)


def test_mask_background_and_missing_uncertainty(deep):
    _, _, image = deep
    masked = CCDData(image.data + 5 * image.uncertainty.array[0, 0], unit=image.unit, wcs=image.wcs)
    masked.mask = np.zeros(image.shape, bool)
    masked.mask[:, :250] = True
    segmentation, catalog = detect_sources(masked, preset="default", subtract_background=True)
    assert 10 <= len(catalog) <= 16
    assert segmentation.data[:, :245].max() == 0
    assert np.all(np.isfinite(catalog["flux_err"].value))


def test_sky_left_in_the_image_is_one_sentence(deep):
    *_, image = deep
    raised = image.data + 8 * image.uncertainty.array
    lit = CCDData(raised, unit=image.unit, wcs=image.wcs, uncertainty=image.uncertainty)
    refuses("its sky may not be subtracted .*--highres-background-box", detect_sources, lit)
    _, catalog = detect_sources(lit, preset="default", subtract_background=True)
    _, plain = detect_sources(image, preset="default")
    assert len(catalog) == len(plain)


@pytest.mark.filterwarnings("ignore:one segment has")
def test_a_crowded_field_is_no_sky_and_has_no_limit_of_sources(deep):
    # 1600 stars that touch, of 10 to 1000 sigma
    _, _, image = deep
    line = np.sum([np.exp(-0.5 * ((np.arange(336) - 8 * k) / 2) ** 2) for k in range(1, 41)], 0)
    data = 1000 * image.uncertainty.array[0, 0] * np.outer(line, line)
    field = CCDData(data, unit=image.unit, wcs=image.wcs, uncertainty=image.uncertainty[:336, :336])
    preset = DetectionPreset(threshold=0.25, n_pixels=5, contrast=1e-5)
    _, catalog = detect_sources(field, preset=preset)
    assert len(catalog) == 1600


def test_a_source_that_fills_most_of_an_image_is_warned_of(deep):
    _, _, image = deep
    y, x = np.indices((81, 81)) - 40
    data = 30 * image.uncertainty.array[0, 0] * np.exp(-(x**2 + y**2) / 2 / 14**2)
    filled = CCDData(data, unit=image.unit, wcs=image.wcs, uncertainty=image.uncertainty[:81, :81])
    with pytest.warns(PhotometryWarning, match=r"one segment has \d\d% of the image"):
        _, catalog = detect_sources(filled, preset="default")
    assert len(catalog) == 1


def test_empty_image(tools):
    form = {"scale": 0.06, "sigma": 1.0, "rng": np.random.default_rng(0)}
    image = tools.picture(tools.places([0.0]), [0.0], (100, 100), **form)
    segmentation, catalog = detect_sources(image, threshold=5)
    assert len(catalog) == 0
    assert catalog["flux"].unit == u.uJy
    assert segmentation.data.max() == 0


def test_bad_settings(deep):
    _, _, image = deep
    message = "no detection preset 'deep'; known: default"
    refuses(message, detect_sources, image, preset="deep", error=KeyError)
    refuses("'threshold' must be positive", detect_sources, image, threshold=-1)
    plain = CCDData(np.ones((20, 20)), unit="MJy/sr")
    refuses("'image' must be an image with a celestial WCS", detect_sources, plain)


def disk(shape, x, y, radius):
    yy, xx = np.indices(shape)
    return np.hypot(xx - x, yy - y) <= radius


def test_a_disk_grows_to_a_disk_of_the_area_of_the_rule():
    labels = np.where(disk((121, 121), 60, 60, 15), 7, 0)
    rule = DilationRule(areas=(1.0, 100.0), factors=(4.0, 2.0))
    area = np.count_nonzero(labels) * 0.06**2
    # a power law between the nodes: slope log(1/2) / log(100)
    assert_allclose(rule.area(area), area * 4 * area ** (-np.log(2) / np.log(100)))
    assert_allclose(rule.area([0.5, 200.0]), [2.0, 400.0])
    grown = dilate_segments(labels, rule, pixel_scale=0.06).data
    radius = np.sqrt(rule.area(area) / np.pi) / 0.06
    assert_allclose(np.count_nonzero(grown == 7), np.pi * radius**2, rtol=0.03)
    assert np.all(grown[disk(labels.shape, 60, 60, radius - 1)] == 7)
    assert not grown[~disk(labels.shape, 60, 60, radius + 1)].any()


def test_segments_do_not_merge_nor_lose_pixels_nor_take_masked_ones():
    labels = np.where(disk((80, 100), 35, 40, 8), 1, 0)
    labels[disk((80, 100), 58, 40, 8)] = 2
    labels[disk((80, 100), 85, 10, 3)] = 5
    mask = np.zeros(labels.shape, bool)
    mask[:, :24] = True
    grown = dilate_segments(labels, DilationRule(factors=9.0), pixel_scale=1.0, mask=mask).data
    assert np.array_equal(grown[labels > 0], labels[labels > 0])
    assert set(np.unique(grown)) == {0, 1, 2, 5}
    assert not grown[mask].any()
    # the line half-way between equal disks divides them
    assert not np.any(grown[:, :46] == 2)
    assert not np.any(grown[:, 47:] == 1)
    # the pair is hemmed in, by each other and by the mask; the third has its area
    assert np.count_nonzero(grown == 1) < 9 * np.count_nonzero(labels == 1)
    assert_allclose(np.count_nonzero(grown == 5), 9 * np.count_nonzero(labels == 5), rtol=0.15)
    large = DilationRule(factors=9.0, max_area=100.0)
    same = dilate_segments(labels, large, pixel_scale=1.0).data
    assert np.sum(same == 1) == np.sum(labels == 1)


def test_dilated_detections_hold_more_of_their_light(deep):
    sky, flux, image = deep
    _, bare = detect_sources(image, preset="default", threshold=5)
    segmentation, grown = detect_sources(image, preset="default", threshold=5, dilation="area")
    assert list(grown["label"]) == list(bare["label"])
    assert np.all(grown["n_detected"] == bare["n_pixels"])
    assert np.all(grown["n_pixels"] == np.bincount(segmentation.data.ravel())[1:])
    assert np.all(grown["n_pixels"] > bare["n_pixels"])
    for name in ("x_centroid", "y_centroid", "semimajor_axis", "flags"):
        assert np.array_equal(grown[name], bare[name])
    index = sky.match_to_catalog_sky(grown["sky"])[0]
    lost, left = (1 - table["flux"].to_value(u.uJy)[index] / flux for table in (bare, grown))
    # faint sources lose most where segments end at an isophote
    assert np.median(lost[:5]) > 0.15
    assert abs(np.median(left)) < 0.02
    message = "no dilation rule 'twice'; known: area"
    refuses(message, detect_sources, image, dilation="twice", error=KeyError)
    refuses("'factors' must be 1 numbers of at least 1", DilationRule, factors=0.5)


def test_purity_of_noise_and_of_sources(tools):
    rng, options = np.random.default_rng(7), {"preset": "yang2021", "n_pixels": 20}
    form = {"scale": tools.FINE, "width": 0.15, "sigma": 1.0}
    noise = tools.picture(tools.places([]), [], (600, 600), rng=rng, **form)
    table = detection_purity(noise, snr_edges=[0, 2.5, 3, 3.5, np.inf], **options)
    # noise alone: as many on either side, so the purity is zero within its error
    assert table["n_positive"].sum() == table.meta["n_positive"] > 150
    error = np.sqrt(1 / table["n_positive"] + 1 / np.maximum(table["n_negative"], 1))
    assert np.all(np.abs(table["purity"]) < 3.5 * error)
    # forty sources of a known place among it: what is not one of them is spurious
    sky = tools.positions(rng, 40, 16.0)
    flux = 10 ** rng.uniform(1.0, 2.0, 40) * 10 * tools.FINE**2 * tools.SR * 1e12
    image = tools.picture(sky, flux, (600, 600), **form)
    image.data += noise.data
    _, found = detect_sources(image, **options)
    table = detection_purity(image, snr_edges=[0, 2.5, 3, 4, 5, np.inf], **options)
    separation = found["sky"].match_to_catalog_sky(sky)[1].arcsec
    snr = np.asarray(found["snr"])
    true = [np.mean(separation[(snr >= a) & (snr < b)] < 0.3)
            for a, b in table.iterrows("snr_low", "snr_high")]  # fmt: skip
    assert true[-1] > 0.9
    whole = np.mean(separation < 0.3)
    assert abs(table["purity_above"][0] - whole) < 3 / np.sqrt(len(found))
    assert table["purity_above"][-1] == table["purity"][-1]
    assert table["purity_low"][-1] > 0.85
    error = np.hypot(table["purity_high"] - table["purity"], 1 / np.sqrt(table["n_positive"]))
    assert np.all(np.abs(table["purity"] - true) < 3 * error)
    message = "'snr_edges' must be two numbers or more that ascend"
    refuses(message, detection_purity, image, snr_edges=[3, 2])


def test_settings_stated_on_other_pixels_find_the_same(tools):
    # the same sky with white noise of the same depth, on pixels of 0.06 and 0.03 arcsec
    areas = []
    for scale, size in ((0.06, 300), (0.03, 600)):
        rng = np.random.default_rng(2)
        sky = tools.places(*tools.lattice(rng, 4, 4.0, 0.0))
        form = {"scale": scale, "sigma": 0.3 * 0.06 / scale, "rng": rng}
        image = tools.picture(sky, np.full(16, 10.0), (size, size), width=0.15, **form)
        _, found = detect_sources(image, threshold=1.5, n_pixels=16, stated_on=0.06 * u.arcsec)
        index, separation, _ = sky.match_to_catalog_sky(found["sky"])
        assert separation.arcsec.max() < 0.05
        assert len(found) == 16
        areas.append(np.median(found["n_pixels"][index]) * scale**2)
    assert_allclose(areas[1], areas[0], rtol=0.05)


def test_chi_images_of_empty_sky_follow_the_chi_distribution(tools):
    """Of three bands with skies and noise of their own, and two where one has no data; a source of one band."""
    rng, shape = np.random.default_rng(5), (300, 300)
    wcs, images = north_up_wcs(tools.CENTER, 0.1 * u.arcsec, shape), []
    for sky, noise in ((0.0, 0.1), (3.0, 0.4), (-1.0, 2.0)):
        images.append(tools.as_ccd(sky + noise * rng.normal(size=shape), wcs, 1.7 * noise))
    images[2].mask = np.arange(300) * np.ones(shape) < 100
    found = chi_image(images)
    for columns, k in ((np.s_[100:], 3), (np.s_[:100], 2)):
        # its own scale: the noise of the first band
        level = found.data[:, columns] / 0.17
        spread = found.uncertainty.array[:, columns] / 0.17
        assert_allclose(spread, chi(k).std(), rtol=1e-6)
        values = level + chi(k).mean()
        assert kstest(values[::3, ::3].ravel(), chi(k).cdf).pvalue > 1e-3
        assert np.mean(values) == pytest.approx(chi(k).mean(), abs=0.02)
    blue = tools.render(tools.places([2.0]), [60.0], 0.15, wcs, shape)
    images[0].data += blue
    _, sources = detect_sources(chi_image(images), preset="default", threshold=3.0)
    assert sources["sky"].separation(tools.places([2.0])[0]).min() < 0.1 * u.arcsec
    moved = tools.as_ccd(blue, north_up_wcs(tools.places([1.0])[0], 0.1 * u.arcsec, shape), 1)
    refuses("'images' must be at least one, all on the same pixels", chi_image, [images[0], moved])
