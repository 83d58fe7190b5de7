import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.detector import (
    ADConversion,
    Bias,
    CosmicRays,
    Dark,
    Detector,
    Effect,
    InterpixelCapacitance,
    LastFrame,
    Nonlinearity,
    Persistence,
    Photons,
    Ramp,
    ReadNoise,
    Residual,
)
from miricigale.instrument import DQ, miri_detector, photmjsr
from miricigale.scene import Scene
from miricigale.utils.exceptions import MiricigaleWarning

PLAIN = (Photons(flat=False), Nonlinearity(linear=True), Bias(), ReadNoise(), ADConversion())


@pytest.fixture(scope="module")
def detector():
    return Detector.miri_imager()


def test_mean_variance_and_covariance_of_a_ramp(make_exposure, make_sky):
    exposure = make_exposure(n_groups=8, subarray="SUB256")
    level, gain, noise = 200.0, miri_detector().gain, miri_detector().read_noise
    ramp = Detector(PLAIN).expose(make_sky(exposure, level), exposure, seed=3)
    counts = ramp.data[0].reshape(8, -1).astype(float) - miri_detector().bias
    n = counts.shape[1]
    step = level / photmjsr("miri.f770w") * exposure.group_time.to_value("s")
    order = np.arange(1, 9)
    # signal in DN grows evenly; groups share the photons of the earlier one
    expected = np.minimum.outer(order, order) * step / gain
    expected += np.eye(8) * (noise**2 + 1 / 12)
    assert_allclose(counts.mean(axis=1), order * step, atol=5 * np.sqrt(expected.max() / n))
    scale = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert_allclose((np.cov(counts) - expected) / scale, 0, atol=5 * np.sqrt(2 / n))
    differences = np.diff(counts, axis=0)
    variance = step / gain + 2 * (noise**2 + 1 / 12)
    assert differences.var() == pytest.approx(variance, rel=5 * np.sqrt(3 / differences.size))


def test_same_seed_same_counts_on_any_threads_and_blocks(
    make_exposure, make_sky, detector, set_block_size
):
    exposure = make_exposure(n_groups=5, n_integrations=2, subarray="SUB128")
    effects = CosmicRays(shower_fraction=0.2), Residual(0.01), ReadNoise(pink=2.0)
    detector = Detector.miri_imager(*effects)
    # without 'ipc' in the image, neighbors across blocks are coupled
    sky = make_sky(exposure, 30.0, includes=())
    one = detector.expose(sky, exposure, seed=5, n_threads=1)
    for samples in (1, 136 * 10 * 7, 10**9):
        set_block_size(samples)
        other = detector.expose(sky, exposure, seed=5, n_threads=3)
        assert_array_equal(other.data, one.data)
        assert_array_equal(other.pixel_dq, one.pixel_dq)
        assert_array_equal(other.group_dq, one.group_dq)


def test_seeds_filters_and_dithers_differ(make_exposure, make_sky):
    exposure = make_exposure(n_groups=2)
    sky = make_sky(exposure, 100.0)
    noise = Detector((Photons(), Nonlinearity(), Bias(), ReadNoise(), ADConversion()))
    first = noise.expose(sky, exposure, seed=1).data
    assert_array_equal(noise.expose(sky, exposure, seed=1).data, first)
    assert np.mean(noise.expose(sky, exposure, seed=2).data != first) > 0.8
    assert np.mean(noise.expose(sky, exposure.replace(dither=1), seed=1).data != first) > 0.8
    red = make_exposure("miri.f1000w", n_groups=2)
    assert np.mean(noise.expose(sky, red, seed=1).data != first) > 0.8


def test_an_effect_keeps_its_numbers_when_another_goes(make_exposure, make_sky):
    exposure = make_exposure(n_groups=3)
    sky = make_sky(exposure, 0.0)
    tail = (Nonlinearity(linear=True), Bias(), ReadNoise(), ADConversion())
    rays = CosmicRays(flux=1e-4)
    quiet = Detector((Photons(), *tail)).expose(sky, exposure, seed=4).data.astype(int)
    hit = Detector((Photons(), rays, *tail)).expose(sky, exposure, seed=4).data.astype(int)
    assert np.all(hit >= quiet)
    assert 0.1 < np.mean(hit == quiet) < 0.999


def test_two_effects_of_a_kind_draw_apart(make_exposure, make_sky):
    exposure = make_exposure(n_groups=20, subarray="SUB256")
    end = (Nonlinearity(linear=True), ADConversion())
    two = (Photons(), Dark(current=400.0), Dark(current=400.0), *end)
    counts = Detector(two).expose(make_sky(exposure, 0.0), exposure, seed=0).data[0, -1]
    variance = 2 * 400 * 20 * 0.3 / 16 + 1 / 12
    assert counts.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / counts.size))


def test_what_the_psf_holds_is_left_out(make_exposure, make_sky, detector):
    exposure = make_exposure(n_groups=2)
    image = make_sky(exposure, 0.0, includes=())
    image.data[30, 40] = 5e4
    chain = Photons(flat=False), InterpixelCapacitance(), Nonlinearity(linear=True), ADConversion()
    spread = Detector(chain).expose(image, exposure, seed=0).data[0, -1].astype(float)
    assert spread[30, 41] / spread.sum() == pytest.approx(0.033, rel=0.05)
    # a list, and the text that a header makes of it; the last without it
    for includes in (["pixel", "ipc"], "pixel, ipc", "ipc", ("PIXEL", "IPC"), "pixel"):
        image.meta["psf_includes"] = includes
        ramp = Detector(chain).expose(image, exposure, seed=0)
        assert (ramp.data[0, -1, 30, 41] > 0) == (includes == "pixel")
        assert (InterpixelCapacitance() in ramp.effects) == (includes == "pixel")
    assert InterpixelCapacitance() in detector.effects


@pytest.mark.parametrize(("level", "count"), [(-100, 0), (70000, 65535)])
def test_out_of_range_counts_are_flagged(make_exposure, make_sky, level, count):
    exposure = make_exposure(n_groups=2)
    effects = (Photons(), Nonlinearity(), Bias(level=level), ADConversion())
    ramp = Detector(effects).expose(make_sky(exposure, 0), exposure, seed=0)
    assert np.all(ramp.data == count)
    assert np.all(ramp.group_dq == (DQ.AD_FLOOR if level < 0 else DQ.SATURATED))


def test_warns_of_a_saturating_sky(make_exposure, make_sky, detector, caplog):
    exposure = make_exposure(n_groups=10)
    well = 210e3 / 10 / exposure.group_time.to_value("s") / 4 * photmjsr("miri.f770w")
    with pytest.warns(MiricigaleWarning, match="fills 120 % of the full well"):
        detector.expose(make_sky(exposure, 1.2 * well), exposure, seed=0)
    ramp = detector.expose(make_sky(exposure, 0.7 * well), exposure, seed=0)
    assert "fills 70 % of the full well" in caplog.text
    assert ramp.meta["sky_well_fraction"] == pytest.approx(0.7, abs=0.01)


def test_refuses_wrong_images(make_exposure, make_sky, detector):
    exposure = make_exposure()

    def refused(match, image, **options):
        refuses(match, detector.expose, image, options.pop("exposure", exposure), **options)

    plain = make_sky(exposure, 1.0)
    refused("'exposure' must be an Exposure", plain, exposure=None)
    refused("'image' must be a Scene or a CCDData", plain.data, error=TypeError)
    counts = CCDData(plain.data, unit="adu")
    refused("'image' must be convertible to MJy / sr", counts, error=u.UnitsError)
    small = CCDData(np.zeros((3, 4)), unit="MJy/sr")
    refused("'image' must be of the exposure's shape", small)
    for value, match in (
        (np.nan, "'image' must be finite values, got 1 that"),
        (-0.5, "'image' must be surface brightness that is nowhere"),
    ):
        image = make_sky(exposure, 1.0)
        image.data[3, 4] = value
        refused(match, image)
    image.data[3, 4], image.mask = 5.0, image.data < 0
    refused(r"'image' must be without masked pixels.* got 1 of them", image)


def test_refuses_images_of_another_place_or_filter(make_exposure, make_sky, detector):
    exposure = make_exposure(n_groups=2)
    image = make_sky(exposure, 1.0)
    image.wcs = exposure.wcs
    for name in ("miri.f770w", "F770W"):
        image.meta["filter"] = name
        detector.expose(image, exposure, seed=0)
        detector.forecast(image, exposure)
    # the next dither, another roll, another sub-array's corner, the other side of the sky
    moved = exposure.dithered("ceers", 3)[1]
    rolled = exposure.replace(roll=exposure.roll + 1 * u.deg)
    away = exposure.replace(pointing=SkyCoord(233.1344, 27.83444, unit="deg"))
    for other in (moved, rolled, away):
        refuses("'image' must be where the exposure points", detector.expose, image, other)
    # 1" on the sky is nine pixels of 0.11"
    beside = exposure.pointing.directional_offset_by(40 * u.deg, 1 * u.arcsec)
    image.wcs = exposure.replace(pointing=beside).wcs
    refuses(r"got one 9\.\d+ pixels off", detector.forecast, image, exposure)
    image.wcs = exposure.wcs
    image.meta["filter"] = "miri.f1000w"
    wanted = r"'image' must be one of the filter miri\.f770w, got one"
    refuses(wanted, detector.expose, image, exposure)


def test_other_units_of_surface_brightness(make_exposure, make_sky):
    exposure = make_exposure(n_groups=2)
    sky = make_sky(exposure, 100.0)
    other = CCDData(sky.data * 1e6, unit="Jy/sr", meta=sky.meta)
    detector = Detector(PLAIN)
    ramps = (detector.expose(image, exposure, seed=1) for image in (other, sky))
    assert_array_equal(*(ramp.data for ramp in ramps))


def test_refuses_wrong_effects():
    # when it is made, not when it is used
    for effects, match in (
        ((Photons(), "noise"), "made of detector effects"),
        ((Dark(), Photons(), ADConversion()), "in their order, Photons before Dark"),
        ((Photons(), Dark()), "a tuple that ends with ADConversion, got"),
        ((Photons(), Photons(), ADConversion()), "a tuple with one Photons"),
        ((), "a tuple with one Photons"),
        (
            (Photons(), ReadNoise(), Nonlinearity(), ADConversion()),
            "in their order, Nonlinearity before ReadNoise, got Photons, ReadNoise",
        ),
    ):
        refuses(f"'effects' must be {match}", Detector, effects)
    refuses("'properties' must be", Detector, PLAIN, properties={"gain": 4})
    refuses("'effects' must be a tuple with one Photons", Detector.miri_imager().without, Photons)
    refuses("'kinds' must be classes of effects", Detector.miri_imager().without, Dark())
    refuses("'effects' must be of the package's kinds", Detector.miri_imager().replace, Dark)


def test_effects_of_other_kinds_act_where_they_are_put(make_exposure, make_sky):
    @dataclasses.dataclass(frozen=True)
    class Doubling(Effect):
        def apply(self, array, block):
            return 2 * array

    exposure, chain = make_exposure(n_groups=2), (Photons(flat=False), ADConversion())
    sky = make_sky(exposure, 100.0)
    plain = Detector(chain).expose(sky, exposure, seed=1)
    double = Detector((chain[0], Doubling(), chain[1])).expose(sky, exposure, seed=1)
    assert_array_equal(double.data, 2 * plain.data)
    assert double.shows(Doubling)
    assert not plain.shows(Doubling)


def test_effects_take_the_place_of_their_kind():
    detector = Detector.miri_imager()
    other = detector.replace(Dark(current=2.0), Residual(0.01), Persistence(), LastFrame())
    assert other.effects[:2] == (Residual(0.01), Photons())
    assert other.effects[other.effects.index(Dark(current=2.0)) - 1] == Photons()
    assert other.effects[other.effects.index(Persistence()) - 1] == CosmicRays()
    assert other.effects[other.effects.index(LastFrame()) + 1] == Bias()
    assert len(other.effects) == len(detector.effects) + 3
    back = other.without(Residual, Persistence, LastFrame).replace(Dark())
    assert back.effects == detector.effects
    assert Detector("flight").effects == Detector.miri_imager("flight").effects
    assert Detector.miri_imager(Dark(current=2.0)).effects == detector.replace(Dark(2.0)).effects
    for name in ("CosmicRays", "cosmic_rays", "cosmic rays"):
        assert detector.without(name).effects == detector.without(CosmicRays).effects
    refuses("no effect 'rays'; ", detector.without, "rays", error=KeyError)
    # settings of the detector stay
    properties = miri_detector().replace(gain=2.0)
    assert Detector.miri_imager(properties=properties).without(Dark).properties is properties
    quiet = detector.replace(Dark(current=2.0), read_noise=3.0)
    assert quiet.read_noise == 3.0
    assert quiet.gain == detector.gain
    assert Dark(current=2.0) in quiet.effects
    refuses("no property 'noise'", detector.replace, noise=3.0, error=KeyError)


def test_scenes_of_several_exposures_make_as_many_ramps(make_exposure, detector):
    star = {"ra": [53.0], "dec": [-27.0], "flux": [20] * u.uJy, "profile": "point"}
    dithers = make_exposure(n_groups=3, pointing="53 -27").dithered(2)
    scenes = [Scene(star, dither, background="low") for dither in dithers]
    ramps = detector.expose(scenes, seed=3)
    for ramp, scene in zip(ramps, scenes, strict=True):
        assert_array_equal(ramp.data, detector.expose(scene, seed=3).data)
    refuses("'exposure' must be left out", detector.expose, scenes, dithers[0])
    # a ramp has the settings of its exposure, a detector the numbers of its properties
    assert ramps[0].exposure_time == dithers[0].exposure_time
    assert_allclose(np.diff(ramps[0].times.to_value(u.s)), ramps[0].group_time)
    assert ramps[0].times[-1] == dithers[0].integration_time
    assert ramps[0].nints == scenes[0].n_integrations == dithers[0].n_integrations
    assert detector.gain == detector.properties.gain
    refuses("Ramp", getattr, ramps[0], "dithered", error=AttributeError)


def test_ramps_do_not_change(make_exposure, make_sky, detector):
    exposure = make_exposure(n_groups=2)
    ramp = detector.expose(make_sky(exposure, 1.0), exposure, seed=0)
    assert ramp.unit == u.adu
    assert ramp.wcs is exposure.wcs
    assert ramp.meta["seed"] == 0
    assert "1 integration(s) x 2 groups" in repr(ramp)
    for name in ("data", "pixel_dq", "group_dq"):
        assert not getattr(ramp, name).flags.writeable
    for name in ("mask", "uncertainty", "wcs", "exposure"):
        refuses("a ramp does not change", setattr, ramp, name, None, error=AttributeError)


def test_ramp_checks_its_arrays(make_exposure):
    exposure = make_exposure(n_groups=2)
    good = np.zeros((1, 2, 64, 72), np.uint16)
    assert Ramp(good, exposure).group_dq is None
    refuses("'data' must be of the exposure's shape", Ramp, good[0], exposure)
    refuses("'data' must be of dtype", Ramp, good.astype(float), exposure)
    refuses("'pixel_dq' must be", Ramp, good, exposure, pixel_dq=np.zeros((64, 72)))
    refuses("'group_dq' must be", Ramp, good, exposure, group_dq=np.zeros((64, 72), np.uint8))


def test_groups_of_a_ramp_are_subtracted_as_floats(make_exposure):
    exposure = make_exposure(n_groups=2)
    counts = np.full((1, 2, *exposure.shape), 100, np.uint16)
    # a hit in the first group: the integers themselves would wrap to 65436
    counts[0, 1, 3, 4] = 0
    ramp = Ramp(counts, exposure)
    difference = ramp[0, 1] - ramp[0, 0]
    assert difference[3, 4] == -100 * u.DN
    assert difference.sum() == -100 * u.DN
    assert_array_equal(ramp[0, :, 3, 4].value, [100, 0])
    refuses(r"ramp\[0, -1\] is a group", ramp.__getitem__, "first")
