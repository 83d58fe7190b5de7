import sys

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData, StdDevUncertainty
from numpy.testing import assert_array_equal
from scipy.ndimage import convolve

from helpers.errors import refuses
from helpers.exposures import exposure_of, sky_of
from helpers.mosaics import render
from miricigale.detector import BadPixels, CosmicRays, Detector, Ramp
from miricigale.instrument import (
    DQ,
    DetectorProperties,
    background_level,
    field_mask,
    flat_field,
    miri_detector,
    photmjsr,
    pixel_area_map,
)
from miricigale.reduction import (
    MosaicSettings,
    RampSettings,
    Reducer,
    ReductionResult,
    reference_channels,
    reference_drift,
)
from miricigale.utils.exceptions import DataError

FILTER = "miri.f1000w"
SKY = background_level(FILTER).value


def exposure(dither=0, *, filt=FILTER, subarray="SUB256", **options):
    x, y = [(0, 0), (2.13, 1.27), (-1.71, 2.42), (1.1, -2.2)][dither]
    pointing = SkyCoord(53.1344 + x / 3600, -27.8344 + y / 3600, unit="deg")
    options = {"n_groups": 40, "subarray": subarray, "pointing": pointing, **options}
    return exposure_of(filt, dither=dither, **options)


def expose(light, exp, *, seed=1, without=()):
    detector = Detector.miri_imager().without(*without)
    return detector.expose(sky_of(exp, light), exp, seed=seed, n_threads=1)


def expected_rate(exp, sky, *, ipc=True):
    flat = flat_field(exp.filter, subarray=exp.subarray)
    if ipc:
        flat = convolve(flat, miri_detector().ipc_kernel, mode="nearest")
    return sky / photmjsr(exp.filter) * flat


@pytest.mark.parametrize(
    ("filt", "n_groups", "n_integrations", "sky"),
    [
        ("miri.f560w", 2, 1, 1.0),
        ("miri.f560w", 40, 1, 0.01),
    ],
)
def test_pulls_of_simulated_exposures(filt, n_groups, n_integrations, sky):
    exp = exposure(filt=filt, n_groups=n_groups, n_integrations=n_integrations)
    rate = Reducer().fit_ramp(expose(sky, exp))
    # where light is coupled in from outside the frame there is no truth
    good = ~rate.mask
    good[[0, -1]] = good[:, [0, -1]] = False
    truth = expected_rate(exp, sky)
    pull = ((rate.data - truth) / rate.uncertainty.array)[good]
    assert 0.95 < pull.std() < 1.05
    mean_error = rate.uncertainty.array[good].mean() / np.sqrt(good.sum())
    bias = (rate.data - truth)[good].mean()
    assert abs(bias) < max(1e-3 * truth.mean(), 5 * mean_error)


def test_flags_tell_why(tmp_path):
    exp = exposure(subarray="FULL", n_groups=3)
    ramp = expose(SKY, exp)
    reducer = Reducer()
    rate = reducer.fit_ramp(ramp)
    cal = reducer.calibrate(rate)
    for image in (rate, cal):
        why = image.flags
        assert np.all(why[:, :4] & DQ.REFERENCE_PIXEL)
        bad = (why & (DQ.DEAD | DQ.HOT)) != 0
        assert 5e-4 < bad.mean() < 2e-3
        assert np.all(np.isnan(rate.data[bad]))
        # nothing is masked without a reason
        assert_array_equal(image.mask, (why & DQ.DO_NOT_USE) != 0)
        assert np.all(why[image.mask] != DQ.DO_NOT_USE)
    assert np.all(cal.mask[~field_mask()])
    # a pixel that was not read has counts of 0, and no slope
    counts = ramp.data.copy()
    counts[:, :, 300, 400] = 0
    told = {name: getattr(ramp, name) for name in ("pixel_dq", "effects", "properties")}
    unread = reducer.fit_ramp(Ramp(counts, exp, **told))
    assert np.isnan(unread.data[300, 400])
    assert unread.flags[300, 400] & DQ.DEAD
    assert np.count_nonzero(unread.mask != rate.mask) == 1
    assert rate.unit == "adu / s"
    assert cal.unit == "MJy / sr"
    assert rate.wcs is not None
    assert rate.meta["filter"] == FILTER
    assert rate.meta["pa_aper"] == pytest.approx(exp.pa_aper.value)
    assert rate.meta["exposure_time"] == pytest.approx(exp.exposure_time.value)
    good = ~cal.mask
    assert np.median(cal.data[good]) == pytest.approx(SKY, rel=5e-3)


@pytest.fixture(scope="module")
def field():
    exps = [exposure(d) for d in range(4)]
    grid = np.mgrid[60:200:44, 60:200:44].reshape(2, -1).astype(float)
    grid += np.random.default_rng(2).uniform(-4, 4, grid.shape)
    positions = exps[0].wcs.pixel_to_world(*grid)
    fluxes = np.full(grid.shape[1], 30.0)
    ramps = [expose(SKY + render(positions, fluxes, 0.132, e.wcs, e.shape), e) for e in exps]
    return exps, positions, fluxes, ramps


def test_the_whole_way_keeps_fluxes_and_errors(field):
    exps, positions, fluxes, ramps = field
    result = Reducer().run(iter(ramps))
    assert isinstance(result, ReductionResult)
    assert result.filter == FILTER
    mosaic = result.mosaic
    assert mosaic.unit == "MJy / sr"
    assert mosaic.meta["n_exposures"] == 4
    assert mosaic.meta["exposure_time"] == pytest.approx(sum(e.exposure_time.value for e in exps))
    assert mosaic.meta["pa_aper"] == [e.pa_aper.value for e in exps]
    assert_array_equal(mosaic.mask, (result.weight == 0) | np.isnan(mosaic.data))
    for background in result.backgrounds:
        assert np.median(background.level) == pytest.approx(SKY, rel=2e-3)

    area = pixel_area_map(mosaic.wcs, mosaic.shape)
    yy, xx = np.mgrid[: mosaic.shape[0], : mosaic.shape[1]]
    measured, error = [], []
    for x, y in zip(*mosaic.wcs.world_to_pixel(positions), strict=True):
        inside = np.hypot(xx - x, yy - y) < 8
        assert not mosaic.mask[inside].any()
        measured.append((mosaic.data * area)[inside].sum() * 1e12)
        sigma = np.sqrt(((mosaic.uncertainty.array * area)[inside] ** 2).sum()) * 1e12
        error.append(sigma * mosaic.meta["noise_correction"])
    pull = (np.array(measured) - fluxes) / error
    # also no star has lost its core to the search for cosmic rays
    assert np.abs(pull).max() < 4
    assert np.mean(measured) == pytest.approx(30.0, abs=4 * np.mean(error) / np.sqrt(len(error)))
    assert np.mean(error) < 0.03 * 30

    blank = (result.n_images == 4) & ~mosaic.mask & ~result.mosaic_background.source_mask
    for x, y in zip(*mosaic.wcs.world_to_pixel(positions), strict=True):
        blank &= np.hypot(xx - x, yy - y) > 10
    pull = (mosaic.data / mosaic.uncertainty.array)[blank]
    # neighbors share charge, and drizzle puts them together
    assert 0.97 < pull.std() < 1.1


def test_subarrays_beside_the_field_are_not_masked_away():
    exp = exposure(subarray="SUB64", n_groups=5)
    reducer = Reducer()
    cal = reducer.calibrate(reducer.fit_ramp(expose(SKY, exp)))
    assert cal.mask.mean() < 0.2
    assert np.median(cal.data[~cal.mask]) == pytest.approx(SKY, rel=0.1)


def test_charge_sharing_is_as_the_ramp_says():
    exp = exposure()
    sky = sky_of(exp, SKY, psf_includes=["ipc"])
    ramp = Detector.miri_imager().expose(sky, exp, seed=1, n_threads=1)
    rate = Reducer().fit_ramp(ramp)
    assert rate.meta["ipc"] is False
    assert rate.meta["noise_correction"] == 1.0
    good = ~rate.mask
    pull = ((rate.data - expected_rate(exp, SKY, ipc=False)) / rate.uncertainty.array)[good]
    assert 0.97 < pull.std() < 1.03
    assert Reducer(ramps=RampSettings(ipc=True)).fit_ramp(ramp).meta["ipc"] is True


def test_saturated_stars_are_used_or_masked_with_the_reason():
    exp = exposure(n_groups=20)
    light = np.full(exp.shape, SKY)
    light[100, 100] = 1e4
    light[150, 150] = 1e5
    rate = Reducer().fit_ramp(expose(light, exp, without=(CosmicRays, BadPixels)))
    assert rate.flags[100, 100] & DQ.SATURATED
    assert not rate.mask[100, 100]
    assert rate.flags[150, 150] == DQ.SATURATED | DQ.NO_SLOPE | DQ.DO_NOT_USE
    assert rate.mask[150, 150]
    kernel = miri_detector().ipc_kernel
    spread = convolve(light * flat_field(FILTER, subarray="SUB256"), kernel, mode="nearest")
    truth = spread / photmjsr(FILTER) + 0.05
    error = rate.uncertainty.array[100, 100]
    # a core has the full photon noise of its own light, less what its neighbors share
    assert abs(rate.data[100, 100] - truth[100, 100]) < 5 * error


def test_groups_can_be_left_out():
    exp = exposure(n_groups=8)
    ramp = expose(SKY, exp, without=[CosmicRays])
    fit = Reducer(skip_first=2, skip_last=1).fit_groups(ramp)
    assert fit.n_used.max() == 4
    wanted = "'skip_first, skip_last' must be at most 6 groups"
    refuses(wanted, Reducer(skip_first=4, skip_last=3).fit_groups, ramp)


@pytest.mark.parametrize(
    ("kind", "options", "match"),
    [
        (Reducer, {"backend": "magic"}, "'backend' must be 'native' or 'jwst', got 'magic'"),
        (Reducer, {"jump_threshold": 0}, "'jump_threshold' must be positive or None"),
        (MosaicSettings, {"pixfrac": 1.5}, "'pixfrac' must be above 0 and at most 1"),
        (Reducer, {"skip_first": -1}, "'skip_first' must be at least 0, an integer, got -1"),
        (Reducer, {"properties": 3}, "'properties' must be a DetectorProperties"),
        (Reducer, {"background": 3}, "'background' must be a BackgroundSettings, got 3"),
    ],
)
def test_bad_settings_are_named(kind, options, match):
    refuses(match, kind, **options)


def test_refuses_what_does_not_belong_together():
    reducer = Reducer(properties=DetectorProperties())
    refuses("'images' must be at least one image, got none", Reducer().combine, [], [])
    refuses("'ramps' must be at least one ramp", reducer.run, [])
    wanted = "'ramp' must be a Ramp or a Charge, got ndarray"
    refuses(wanted, reducer.fit_ramp, np.zeros((1, 5, 8, 8)))
    exposures = [exposure(n_groups=2, filt=filt) for filt in ("miri.f770w", FILTER)]
    ramps = [expose(5.0, one, without=[CosmicRays]) for one in exposures]
    refuses(r"'ramps' must be of one filter \(miri.f770w\)", reducer.run, ramps)
    bare = CCDData(np.ones((4, 4)), unit="adu / s", uncertainty=StdDevUncertainty(np.ones((4, 4))))
    refuses("'rate' must be an image whose meta has 'filter'", reducer.calibrate, bare)


def test_the_official_pipeline_is_asked_for_by_name(monkeypatch):
    monkeypatch.setitem(sys.modules, "jwst", None)
    ramp = expose(SKY, exposure(n_groups=4, subarray="SUB64"))
    wanted = r"pip install 'miricigale\[jwst\]'"
    refuses(wanted, Reducer(backend="jwst").fit_ramp, ramp, error=ImportError)


def test_drift_is_measured_after_the_dark():
    # a dark that rises by 3 DN a group, in the reference columns as elsewhere, and a drift of the read-out
    rng = np.random.default_rng(1)
    reference = np.zeros((8, 24), bool)
    reference[:, :4] = reference[:, -4:] = True
    dark = np.broadcast_to(3.0 * np.arange(6)[:, None, None], (1, 6, 8, 24))
    wander = rng.normal(0, 5, (2, 6))
    data = (1000 + dark + wander[:, :, None, None]).astype(np.float32)
    expected = wander - wander.mean()
    np.testing.assert_allclose(reference_drift(data, reference, [dark]), expected, atol=1e-3)
    channels = reference_channels(data, reference, offsets=[dark])
    change = np.broadcast_to((wander - wander[:, :1])[:, :, None, None], channels.shape)
    np.testing.assert_allclose(channels, change, atol=1e-3)


def test_reference_columns_that_are_not_finite_are_named_with_their_file():
    exposure = exposure_of(n_groups=6, subarray="SUB64")
    ramp = Detector.miri_imager().expose(sky_of(exposure, 5.0), exposure, seed=1)
    data = ramp.data.astype(np.float32)
    data[0, 2, 5, :4] = np.nan
    meta = {**ramp.meta, "filename": "a_ramp.fits"}
    bad = Ramp(data, exposure, pixel_dq=ramp.pixel_dq, effects=ramp.effects, meta=meta)
    with pytest.raises(DataError, match=r"a_ramp\.fits has values .* reference columns of SCI"):
        Reducer().fit_ramp(bad)


def test_an_exposure_twice_is_refused():
    exposure = exposure_of(n_groups=6, subarray="SUB64")
    ramps = [
        Detector.miri_imager().expose(sky_of(exposure, 5.0), exposure, seed=seed) for seed in (1, 2)
    ]
    refuses("exposure 3, the same as exposure 1", Reducer().run, [*ramps, ramps[0]])
    rates = [Reducer().fit_ramp(ramp) for ramp in ramps]
    refuses("exposure 2, the same as exposure 1", Reducer().run, [rates[1]] * 2)
    # of one pointing, with other noise
    assert len(Reducer().run(rates).images) == 2
