"""Stripes and sky flats of simulated deep fields: what they cost, and what their removal leaves."""

import numpy as np
import pytest
import sep
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.exposures import FIELD, gaussians, image_of
from miricigale.instrument import ExposureHistory, north_up_wcs
from miricigale.reduction import (
    BackgroundSettings,
    MosaicSettings,
    Reducer,
    remove_stripes,
    sky_flats,
)
from miricigale.utils.units import ANGLE

SHAPE = (400, 420)
WCS = north_up_wcs(FIELD, 0.11 * ANGLE, SHAPE)


def field(seed, n=60):
    """Sky of 30 with noise of 1, and sources of fluxes from 30 up."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(15, 400, n), rng.uniform(15, 385, n)
    fluxes = np.minimum(30 * rng.random(n) ** -0.8, 3000)
    fluxes[:5] = 2000
    data = 30 + rng.normal(size=SHAPE) + gaussians(SHAPE, x, y, fluxes, 1.4)
    return data, x, y, fluxes


def photometry(image, x, y, radius):
    flat, _ = Reducer().subtract_background(image)
    return sep.sum_circle(np.where(flat.mask, 0, flat.data).astype(float), x, y, radius)[0]


@pytest.mark.parametrize("width", [1, 5])
def test_stripes_cost_no_depth_and_change_no_flux(width):
    data, x, y, fluxes = field(1)
    rng = np.random.default_rng(2)

    def stripes(n):
        return np.convolve(rng.normal(size=n + 40), np.ones(width) / width**0.5, "same")[20:-20]

    pattern = 0.3 * (stripes(SHAPE[0])[:, None] + stripes(SHAPE[1]))
    mask = np.zeros(SHAPE, bool)
    mask[:, :8] = True
    options = {"error": 1.0, "mask": mask, "filter": "miri.f770w"}
    plain = image_of(data, WCS, **options)
    striped = image_of(data + pattern, WCS, **options)
    clean = remove_stripes(striped)
    assert clean.meta["stripes_unknown"] == 0
    left = (striped.data - clean.data - pattern)[~mask]
    assert np.std(left) < 0.35 * np.std(pattern[~mask])
    empty = rng.uniform(20, 380, (2, 3000))
    free = np.hypot(empty[0] - x[:, None], empty[1] - y[:, None]).min(axis=0) > 15
    scatter = [
        1.4826 * np.median(np.abs(f - np.median(f)))
        for f in (photometry(im, *empty[:, free], 3.0) for im in (plain, striped, clean))
    ]
    assert 2.5 * np.log10(scatter[1] / scatter[0]) > 0.2
    assert 2.5 * np.log10(scatter[2] / scatter[0]) < 0.05
    # of what is bright enough for noise of the stripes not to matter
    bright = fluxes > 1000
    before, after = (photometry(im, x[bright], y[bright], 5.0) for im in (plain, clean))
    assert bright.sum() >= 2
    assert_allclose(after, before, rtol=3e-3)


def test_what_sources_cover_is_left_and_counted():
    data, *_ = field(3)
    data[:, 100:104] += np.where(np.arange(SHAPE[0]) % 9 < 8, 50, 0)[:, None]
    image = image_of(data, WCS, error=1.0, filter="miri.f770w")
    clean = remove_stripes(image)
    assert clean.meta["stripes_unknown"] >= 4
    assert abs(np.median((image.data - clean.data)[:, 100:104])) < 0.3


def exposures(days, change=0.02):
    """Dithered sky with sources under a response that changes smoothly; truth of the response."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] / 400
    shape = np.sin(5 * x + 2) * np.cos(4 * y)
    images, catalogs = [], []
    for k, day in enumerate(days):
        data, x, y, _ = field(10 + k)
        true = sep.sum_circle(data - 30, x[:5], y[:5], 5.0)[0]
        # the noise is that of the light
        flat = 1 + change * shape * (1 if day < 100 else -1)
        meta = ExposureHistory(origin="other", day=60000.0 + day).meta()
        image = image_of(data * flat, WCS, error=1.0, filter="miri.f770w")
        image.meta.update(meta)
        images.append(image)
        catalogs.append((x[:5], y[:5], true, flat))
    return images, catalogs


@pytest.mark.slow
def test_sky_flats_are_those_of_their_days():
    images, catalogs = exposures([0, 1, 2, 300, 301, 302])
    flats = sky_flats(images, window=30)
    for flat, (*_, true) in zip(flats, catalogs, strict=True):
        pull = (flat.data - true / np.median(true)) / flat.uncertainty.array
        assert 0.7 < np.std(pull) < 1.5
        assert np.std(flat.data - true) < 0.006
    # all of them together have no response left
    assert np.std(sky_flats(images)[0].data) < 0.007
    wanted = "'images' must be three or more within the window, got 6 images"
    refuses(wanted, sky_flats, images, window=0.5)
    dark = [image_of(im.data - 40, WCS, error=1.0, filter="miri.f770w") for im in images]
    refuses("'images' must be of positive sky levels", sky_flats, dark)


# before they are divided the response looks like sources
@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the background of .* cannot be trusted")
def test_the_reducer_divides_by_the_flat_of_the_sky():
    images, catalogs = exposures(range(5))
    # the fields differ: all of their sources would be outliers
    mosaics = MosaicSettings(outlier_threshold=None)
    plain = Reducer(background=BackgroundSettings(stripes=True), mosaics=mosaics)
    even = plain.replace(background=BackgroundSettings(stripes=True, sky_flat=30))
    pairs = [even.reduce(im)[1:] for im in images]
    assert all("stripes" in im.meta for im, _ in pairs)
    results = [r.combine(*map(list, zip(*pairs, strict=True))) for r in (plain, even)]
    off = []
    for result in results:
        ratios = [
            sep.sum_circle(np.where(im.mask, 0, im.data).astype(float), x, y, 5.0)[0] / true
            for im, (x, y, true, _) in zip(result.images, catalogs, strict=True)
        ]
        off.append(np.std(ratios))
    assert off[0] > 0.008
    assert off[1] < 0.5 * off[0]
    # the error of the flat is in that of the background
    background = results[1].backgrounds[0]
    share = results[1].images[0].meta["sky_flat_error"]
    assert np.median(background.error) >= share * np.median(background.level)
    assert results[1].images[0].meta["sky_flat_error"] < 0.005
    refuses("'sky_flat' must be positive or None", BackgroundSettings, sky_flat=0)
