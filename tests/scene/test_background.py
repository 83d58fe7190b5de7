import astropy.units as u
import numpy as np
import pytest

from helpers import scenes
from helpers.errors import refuses
from miricigale.instrument import background_level
from miricigale.scene import Background

LEVEL = 10 * u.MJy / u.sr


def test_grows_along_the_position_angle(wcs):
    def image_at(angle):
        background = Background(LEVEL, gradient=0.6 / u.arcmin, position_angle=angle * u.deg)
        return background.image(wcs, (90, 100))

    image, east = image_at(0), image_at(90)
    # north is up: 0.6 per arcmin over 0.11 arcsec pixels, nothing along x
    np.testing.assert_allclose(np.diff(image, axis=0), 10 * 0.6 * 0.11 / 60, rtol=1e-6)
    np.testing.assert_allclose(np.diff(image, axis=1), 0, atol=1e-9)
    assert image.mean() == pytest.approx(10, rel=1e-9)
    np.testing.assert_allclose(np.diff(east, axis=1), -10 * 0.6 * 0.11 / 60, rtol=1e-6)


def test_stands_on_the_sky_whatever_the_roll(wcs):
    background = Background(LEVEL, gradient=0.6 / u.arcmin, center=scenes.CENTER)
    north_up = background.image(wcs, (90, 100))
    turned_wcs = scenes.tan_wcs(pa=70.0)
    turned = background.image(turned_wcs, (90, 100))
    x, y = turned_wcs.world_to_pixel(wcs.pixel_to_world(60, 30))
    inverse = turned[round(float(y)), round(float(x))]
    assert inverse == pytest.approx(north_up[30, 60], abs=10 * 0.6 * 0.11 / 60)


def test_low_zodi_is_five_percent_per_arcmin():
    background = Background.low_zodi("miri.f1500w")
    assert background.level == background_level("miri.f1500w")
    assert background.gradient == 0.05 / u.arcmin
    assert background.position_angle == 45 * u.deg


def test_refuses(wcs):
    refuses("'level' must be finite and not negative", Background, -1 * u.MJy / u.sr)
    assert not np.any(Background(0 * u.MJy / u.sr).image(wcs, (90, 100)))
    with pytest.raises(ValueError, match="makes it negative within the image"):
        Background(LEVEL, gradient=20 / u.arcmin).image(wcs, (90, 100))
