"""Zodiacal light by level, latitude and day."""

import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import BarycentricMeanEcliptic, SkyCoord

from helpers.errors import refuses
from miricigale.depth import sky_background, zodiacal_factor, zodiacal_levels
from miricigale.instrument import background_level, imager_filters


def at(latitude):
    return SkyCoord(40.0, latitude, unit="deg", frame=BarycentricMeanEcliptic)


@pytest.mark.parametrize("name", imager_filters())
def test_the_low_level_is_the_darkest_tenth_of_the_sky(name):
    # two sources that know nothing of each other: the dust model of Kelsall et al. 1998, and the
    # low background that the package takes from published figures
    assert zodiacal_factor(name, "low") == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("name", ["miri.f770w", "miri.f2100w"])
def test_the_light_rises_to_the_ecliptic_and_with_the_level(name):
    latitudes = (90, 60, 45, 30, 15, 0)
    medium = [zodiacal_factor(name, "medium", position=at(b)) for b in latitudes]
    # poleward of 45 degrees the differences are those between days
    assert np.all(np.diff(medium[2:]) > 0)
    assert medium[-1] > 1.7
    for b in latitudes:
        low, middle, high = (zodiacal_factor(name, k, position=at(b)) for k in zodiacal_levels())
        assert low < middle < high
        assert zodiacal_factor(name, "high", position=at(-b)) == pytest.approx(high, rel=1e-6)


def test_the_light_of_a_day_lies_within_its_levels():
    pytest.importorskip("zodipy")
    # 100 degrees from the Sun
    position = SkyCoord(80.0, 10.0, unit="deg", frame=BarycentricMeanEcliptic)
    day = zodiacal_factor("miri.f1000w", position=position, date="2027-03-01")
    low, high = (zodiacal_factor("miri.f1000w", k, position=position) for k in ("low", "high"))
    assert 0.9 * low < day < 1.1 * high


def test_without_the_package_the_error_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "zodipy", None)
    position = SkyCoord(80.0, 10.0, unit="deg", frame=BarycentricMeanEcliptic)
    with pytest.raises(ImportError, match=r"miricigale\[background\]"):
        zodiacal_factor("miri.f1000w", position=position, date="2027-03-01")


def test_the_background_is_that_of_the_telescope_and_of_the_light():
    position = at(10)
    for name in ("miri.f770w", "miri.f2100w"):
        assert sky_background(name) == background_level(name)
        for level in zodiacal_levels():
            for where in (None, position) if level != "low" else (position,):
                factor = zodiacal_factor(name, level, position=where)
                own = sky_background(name, level, position=where)
                assert own == background_level(name, zodi=factor)
        assert sky_background(name, 3e-3 * u.GJy / u.sr).to_value(u.MJy / u.sr) == pytest.approx(3)


LEVEL, DAY = 3 * u.MJy / u.sr, "2027-03-01"
#: Longitude of the Sun on that day.
SUN = SkyCoord(340.0, 0.0, unit="deg", frame=BarycentricMeanEcliptic)


@pytest.mark.parametrize(
    ("function", "arguments", "options", "error", "message"),
    [
        (zodiacal_factor, (), {"date": DAY}, ValueError, "'date' must be given with a position"),
        (zodiacal_factor, (), {"position": SUN, "date": DAY}, ValueError, f"Sun, got {DAY}"),
        (zodiacal_factor, ("mid",), {}, KeyError, "no level .* 'mid'; known: high, low"),
        (sky_background, (LEVEL,), {"position": at(0)}, ValueError, "'position' must be left out"),
        (sky_background, (-LEVEL,), {}, ValueError, "'level' must be at least 0"),
        (sky_background, (3 * u.uJy,), {}, u.UnitsError, "'level' must be convertible"),
    ],
)
def test_what_has_no_light_is_refused(function, arguments, options, error, message):
    refuses(message, function, "miri.f770w", *arguments, error=error, **options)
    refuses("no imaging filter 'f707w'", function, "f707w", error=KeyError)
