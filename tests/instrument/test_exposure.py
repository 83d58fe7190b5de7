"""Exposures, dithers and their times against the survey's published plan."""

import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.tests.helper import assert_quantity_allclose
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.depth import saturation_forecast
from miricigale.filters import Filter
from miricigale.instrument import (
    CEERS_FILTERS,
    Exposure,
    ceers_exposures,
    dither_offsets,
    dither_patterns,
    frame_time,
)

FIELD = SkyCoord(214.9533, 52.95101, unit="deg")
ROLL = 120 * u.deg
SLOW_SUBARRAY = {"subarray": "SUB256", "readout": "SLOWR1"}


def exposure(**options):
    options = {"filter": "F770W", "n_groups": 10, "pointing": FIELD, "roll": ROLL, **options}
    return Exposure(**options)


def test_times_follow_from_the_frames():
    one = exposure(n_groups=100, n_integrations=2)
    assert_quantity_allclose(one.frame_time, 2.775 * u.s)
    assert_quantity_allclose(one.integration_time, 277.5 * u.s)
    assert_quantity_allclose(one.exposure_time, 555 * u.s)
    # one reset frame between two integrations
    assert_quantity_allclose(one.duration, 557.775 * u.s)
    assert_quantity_allclose(frame_time("SLOWR1"), 23.89 * u.s)
    assert frame_time(subarray="SUB64") < frame_time(subarray="SUB256") < frame_time()


def test_the_survey_lasts_as_long_as_published():
    exposures = ceers_exposures(FIELD, ROLL)
    assert len(exposures) == 5 * 3 + 6
    for name in CEERS_FILTERS:
        mine = [e for e in exposures if e.filter == name]
        expected = 4662 if name == "miri.f2100w" else 1665
        assert_allclose(sum(e.exposure_time.value for e in mine), expected, rtol=1e-12)
        assert [e.dither for e in mine] == list(range(len(mine)))


def test_the_trial_keeps_every_band():
    exposures = ceers_exposures(FIELD, ROLL, quick=True)
    assert {e.filter for e in exposures} == set(CEERS_FILTERS)
    assert len(exposures) == 12
    full = sum(e.exposure_time for e in ceers_exposures(FIELD, ROLL))
    assert sum(e.exposure_time for e in exposures) < 0.3 * full
    one = ceers_exposures(FIELD, ROLL, filters=["miri.f770w"])
    assert {e.filter for e in one} == {"miri.f770w"}
    match, bands = "no band of the survey 'miri.f560w'", ["miri.f560w"]
    refuses(match, ceers_exposures, FIELD, ROLL, error=KeyError, filters=bands)


def test_no_integration_of_the_survey_saturates_on_the_sky():
    for one in ceers_exposures(FIELD, ROLL):
        assert saturation_forecast(one) < 0.9


def test_exposure_of_a_given_time_keeps_the_wells_open():
    for name, time in (("miri.f770w", 555), ("miri.f2100w", 777), ("miri.f2550w", 300)):
        one = Exposure.from_time(name, time * u.s, pointing=FIELD, roll=ROLL)
        assert_allclose(one.exposure_time.value, time, rtol=0.05)
        assert saturation_forecast(one) < 0.63
    slow = Exposure.from_time("miri.f560w", 500 * u.s, readout="SLOWR1", pointing=FIELD, roll=ROLL)
    assert (slow.n_groups, slow.n_integrations) == (21, 1)


def test_long_exposures_are_ramps_as_observers_take_them():
    two_hours = Exposure("F770W", time=2 * u.h)
    nearest = min(abs(g * n - 2595) for g in range(2, 101) for n in (26, 27, 28))
    assert (two_hours.n_groups, two_hours.n_integrations) == (96, 27)
    assert abs(two_hours.exposure_time.value / 2.775 - 2595) == pytest.approx(nearest)
    # a reset between two integrations
    assert two_hours.duration.value == pytest.approx(2.775 * (27 * 96 + 26))
    long = Exposure.from_time("F770W", 555 * u.s, max_groups=200)
    assert (long.n_groups, long.n_integrations) == (200, 1)
    refuses("'max_groups'", Exposure.from_time, "F770W", 1 * u.h, max_groups=1)


def test_dithers_move_a_source_the_other_way():
    base = exposure()
    offsets = dither_offsets("ceers", 6).value
    places = [one.wcs.world_to_pixel(FIELD) for one in base.dithered("ceers", 6)]
    moved = np.array(places) - [692.5, 511.5]
    assert_allclose(moved, -offsets / [0.1105, 0.1113], atol=0.25)


def test_dithers_sample_the_pixel_evenly():
    pixels = dither_offsets("ceers", 6).value / [0.110497, 0.111336]
    for axis in pixels.T:
        assert_allclose(np.sort(np.round(axis % 1, 6) % 1), np.arange(6) / 6, atol=1e-5)
        assert_allclose(np.sort(np.round(axis[:3] % 1, 6) % 1), np.arange(3) / 3, atol=1e-5)
    four = dither_offsets("4-point", 4).value / [0.110497, 0.111336]
    assert len({tuple(np.round(point % 1, 6) % 1) for point in four}) == 4
    assert_allclose(four.mean(axis=0), 0, atol=1e-9)


def test_patterns_go_on():
    for name in dither_patterns():
        offsets = dither_offsets(name, 13)
        assert offsets.shape == (13, 2)
        assert len(np.unique(offsets.value.round(6), axis=0)) == 13


def test_keywords_of_the_pointing():
    words = exposure(subarray="SUB256").pointing_keywords()
    assert (words["SUBSTRT1"], words["SUBSTRT2"]) == (413, 51)
    assert_allclose([words["RA_REF"], words["DEC_REF"]], [FIELD.ra.deg, FIELD.dec.deg])
    assert_allclose(words["PA_APER"], 120 + 4.83544897)
    # V1 lies at the distance of the aperture, and +V3 turns by the convergence of meridians
    boresight = SkyCoord(words["RA_V1"], words["DEC_V1"], unit="deg")
    assert_allclose(boresight.separation(FIELD).arcsec, np.hypot(439.64, 411.948), rtol=1e-5)
    turn = (words["RA_V1"] - words["RA_REF"]) * np.sin(FIELD.dec.rad)
    assert_allclose(words["PA_V3"] - 120, turn, atol=2e-3)


def test_normalizes_and_freezes():
    one = Exposure("f770w", n_groups=10, pointing=FIELD.galactic, roll=-10 * u.deg)
    assert one.filter == "miri.f770w"
    assert one.pointing.separation(FIELD) < 1e-6 * u.arcsec
    assert_quantity_allclose(one.roll, 350 * u.deg)
    assert one.shape == (1024, 1032)
    with pytest.raises(AttributeError):
        one.n_groups = 3
    assert one.replace(n_groups=3).n_groups == 3
    again = pickle.loads(pickle.dumps(one))
    assert_allclose(again.wcs.all_pix2world(3, 4, 0), one.wcs.all_pix2world(3, 4, 0))


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"n_groups": 1}, ValueError, "'n_groups' must be an integer >= 2, got 1"),
        ({"readout": "FAST"}, KeyError, "no readout pattern 'FAST'; known: FASTGRPAVG, FASTG"),
        ({"subarray": "SUB1"}, KeyError, "no sub-array 'SUB1'"),
        (SLOW_SUBARRAY, KeyError, "no sub-array of SLOWR1 'SUB256'; known: FULL"),
        ({"filter": "wfc3.f160w"}, KeyError, "no imaging filter 'wfc3.f160w'; known: miri.f1000w"),
        ({"n_groups": None}, ValueError, "'n_groups, time' must be one of them given, got neither"),
        ({"time": 1 * u.h}, ValueError, "'n_groups, time' must be one of them given, got both"),
        ({"time": 3 * u.s, "n_groups": None}, ValueError, "'time' must be at least two groups"),
        ({"pointing": 3}, ValueError, "'pointing' must be one SkyCoord"),
    ],
)
def test_rejects_what_cannot_be_exposed(options, error, message):
    refuses(message, exposure, **options, error=error)


def test_a_pointing_has_any_form():
    sky = SkyCoord(53.1, -27.8, unit="deg")
    texts = ("53.1 -27.8", "3h32m24s -27d48m00s", "03:32:24 -27:48:00", "3 32 24 -27 48 0")
    pairs = ((53.1, -27.8), (53.1 * u.deg, -27.8 * u.deg))
    for pointing in (*texts, *pairs, sky.reshape(1), sky.galactic):
        made = Exposure("F770W", n_groups=10, pointing=pointing)
        assert made.pointing.separation(sky) < 1e-6 * u.arcsec, pointing
        assert made.roll == 0 * u.deg


@pytest.mark.parametrize(
    "name", ["F770W", "f770w", "MIRI/F770W", "JWST/MIRI.F770W", Filter("F770W")]
)
def test_a_filter_has_any_name(name):
    assert Exposure(name, n_groups=10).filter == "miri.f770w"


def test_time_in_place_of_groups():
    made = Exposure("F1500W", time=30 * u.min, pointing=FIELD)
    same = Exposure.from_time("F1500W", 30 * u.min, pointing=FIELD)
    assert (made.n_groups, made.n_integrations) == (same.n_groups, same.n_integrations)
    assert made.exposure_time.to_value(u.min) == pytest.approx(30, abs=0.1)
    split = Exposure("F1500W", time=30 * u.min, n_integrations=9)
    assert split.n_integrations == 9
    assert split.exposure_time.to_value(u.min) == pytest.approx(30, abs=0.3)
    # 111 frames of 2.775 s
    assert made.replace(time=308 * u.s).exposure_time.to_value(u.s) == pytest.approx(308, abs=3)
    small = {"readout": "fastr1", "subarray": "sub64", "max_groups": 1000}
    small = Exposure.from_time("F770W", 1 * u.min, **small)
    assert small.exposure_time.to_value(u.s) == pytest.approx(60, abs=0.1)


def test_the_footprint_is_the_field_of_the_array():
    made = Exposure("F770W", n_groups=10, pointing=FIELD)
    corners = made.footprint
    # half a pixel from the centers of the pixels at the corners
    ny, nx = made.shape
    x, y = made.wcs.world_to_pixel(corners)
    assert_allclose(x, [-0.5, nx - 0.5, nx - 0.5, -0.5], atol=1e-4)
    assert_allclose(y, [-0.5, -0.5, ny - 0.5, ny - 0.5], atol=1e-4)
    sides = corners.separation(np.roll(corners, -1)).to_value(u.arcsec)
    # 1032 x 1024 pixels of 0.1105 by 0.1113 arcsec
    np.testing.assert_allclose(sides, [114.0, 114.0, 114.0, 114.0], rtol=0.02)
    ax = made.plot()
    assert ax.xaxis_inverted()
    np.testing.assert_allclose(ax.patches[0].get_xy()[:4, 1], corners.dec.deg)


def test_positions_inside_the_footprint_are_on_the_array():
    made = exposure(subarray="SUB256")
    corners = made.footprint
    center = SkyCoord(corners.cartesian.mean()).spherical
    center = SkyCoord(center.lon, center.lat)
    assert made.contains(center)
    # 10 % inside and outside of each corner
    for share, wanted in ((0.9, True), (1.1, False)):
        east = center.ra + share * (corners.ra - center.ra)
        north = center.dec + share * (corners.dec - center.dec)
        assert np.all(made.contains(SkyCoord(east, north)) == wanted)
    refuses("one with a pointing", exposure(pointing=None, roll=None).contains, FIELD)
