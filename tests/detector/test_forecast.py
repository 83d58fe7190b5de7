"""What is told before an exposure against closed forms, and against the exposure itself."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from miricigale.depth import forecast_table
from miricigale.depth.saturation import NEVER, saturation_group
from miricigale.detector import (
    ADConversion,
    BadPixels,
    CosmicRays,
    Detector,
    Nonlinearity,
    Photons,
    Saturation,
)
from miricigale.instrument import DQ, flat_field, miri_detector, photmjsr
from miricigale.utils.exceptions import MiricigaleWarning

FILTER = "miri.f770w"


def brightness(rate):
    """MJy/sr of a rate of charge."""
    return rate / miri_detector().gain * photmjsr(FILTER)


def sources_at(x, y):
    return QTable({"id": 100 + np.arange(len(x)), "x": np.asarray(x, float), "y": y})


@pytest.fixture
def plain():
    return Detector((Photons(flat=False), Saturation(), Nonlinearity(), ADConversion()))


def test_group_is_well_over_rate_and_time():
    # a well of 100: 10 a group fills it in the 10th, a little less in the 11th
    rates = [10.0, 9.99, 100.0, 500.0, 0.0, -1.0, np.nan, 1e-30]
    groups = saturation_group(rates, 100.0, 1.0)
    assert groups.tolist() == [10, 11, 1, 1, NEVER, NEVER, NEVER, NEVER]
    assert saturation_group(5.0, 100.0, 2.0) == 10


def test_it_is_the_closed_form(make_exposure, make_sky, plain):
    exposure = make_exposure(n_groups=30)
    step = exposure.group_time.to_value("s")
    well = miri_detector().full_well
    image = make_sky(exposure, brightness(0.2 * well / (30 * step)))
    # full after 4.5 and 20.2 groups, and never
    for x, groups in ((10, 4.5), (30, 20.2), (50, 31.0)):
        image.data[20, x] = brightness(well / (groups * step))
    told = plain.forecast(image, exposure, sources=sources_at([10, 30.4, 50], [20, 19.6, 20.0]))
    assert told.sky_fraction == pytest.approx(0.2)
    assert told.sky_rate.unit == u.electron / u.s
    assert told.sky_group == 150
    assert told.sources["group"].tolist() == [5, 21, 0]
    assert told.sources["saturated"].tolist() == [True, True, False]
    assert_allclose(told.sources["peak_fraction"], [30 / 4.5, 30 / 20.2, 30 / 31])
    assert told.saturated["id"].tolist() == [100, 101]
    assert told.n_pixels == 2
    assert "sky fills 20 % of the well; saturated: 2 pixel(s), 2 source(s)" in told.describe()
    assert "the first in group 5" in repr(told)


def test_the_exposure_saturates_as_told(make_exposure, make_sky):
    # everything on but the particles: flat field, dark, capacitance, noise, response
    detector = Detector.miri_imager().without(CosmicRays)
    exposure = make_exposure(n_groups=25, n_integrations=2, subarray="SUB256")
    step, well = exposure.group_time.to_value("s"), miri_detector().full_well
    image = make_sky(exposure, brightness(0.3 * well / (25 * step)), includes=())
    rng = np.random.default_rng(4)
    y, x = (g.ravel() for g in np.mgrid[15:250:15, 15:250:15])
    image.data[y, x] = brightness(well / (rng.uniform(0.5, 30, x.size) * step))
    told = detector.forecast(image, exposure, sources=sources_at(x, y))
    ramp = detector.expose(image, exposure, seed=1)
    full = (ramp.group_dq & DQ.SATURATED) != 0
    use = ramp.pixel_dq[y, x] == 0
    first = np.where(full.any(axis=1), full.argmax(axis=1) + 1, 0)[:, y, x]
    # one group's charge against the noise of a full well: those within 5 sigma of a read are
    # a matter of chance
    reads = told.sources["peak_rate"].to_value("electron / s") * step
    place = well / reads
    sigma = np.sqrt(well) / reads
    clear = use & (np.abs(place - np.rint(place)) > 5 * sigma)
    assert np.count_nonzero(clear) > 100
    assert 20 < np.count_nonzero(told.sources["saturated"][clear]) < np.count_nonzero(clear) - 20
    for integration in first:
        assert_array_equal(integration[clear], told.sources["group"][clear])
    assert np.any(first[0][use] > 1)
    # and all of the pixels that fill, not those of sources alone
    assert abs(np.count_nonzero(full[0, -1]) - told.n_pixels) <= np.count_nonzero(use & ~clear)


def test_the_well_is_that_of_the_effects(make_exposure, make_sky, plain):
    exposure = make_exposure(n_groups=10)
    step = exposure.group_time.to_value("s")
    sky = make_sky(exposure, brightness(1000 / step))
    assert plain.forecast(sky, exposure).sky_fraction == pytest.approx(1e4 / 210e3)
    small = plain.replace(Saturation(full_well=2e4))
    assert small.forecast(sky, exposure).sky_fraction == pytest.approx(0.5)
    # a converter that ends before the well: 65535.5 DN less the bias, made linear
    properties = miri_detector().replace(bias=45_000.0)
    high = Detector(plain.effects, properties=properties)
    reach = properties.gain * properties.linearize(20_535.5)
    assert reach < 210e3
    assert high.forecast(sky, exposure).sky_fraction == pytest.approx(1e4 / reach)


def test_flat_dark_and_bad_pixels(make_exposure, make_sky):
    exposure = make_exposure(n_groups=5, subarray="SUB256")
    detector = Detector.miri_imager()
    told = detector.forecast(make_sky(exposure, 100.0), exposure)
    dark, gain = miri_detector().dark_current, miri_detector().gain
    flat = np.median(flat_field(FILTER, subarray="SUB256"))
    expected = 100.0 / photmjsr(FILTER) * gain * flat + dark
    assert told.sky_rate.to_value("electron / s") == pytest.approx(expected, rel=1e-3)
    # light beyond all measure fills every pixel that counts
    told = warned("of the full well", detector.forecast, make_sky(exposure, 1e8), exposure)
    ramp = detector.expose(make_sky(exposure, 1.0), exposure, seed=0)
    assert told.n_pixels == np.count_nonzero(ramp.pixel_dq == 0)


def test_capacitance_is_taken_once(make_exposure, make_sky):
    exposure = make_exposure(n_groups=5)
    detector = Detector.miri_imager().without(BadPixels)
    image = make_sky(exposure, 0.0, includes=())
    image.data[30, 40] = 1e4
    there = sources_at([40], [30])
    apart = detector.forecast(image, exposure, sources=there)
    image.meta["psf_includes"] = ["ipc"]
    inside = detector.forecast(image, exposure, sources=there)
    ratio = apart.sources["peak_rate"].value[0] / inside.sources["peak_rate"].value[0]
    assert ratio == pytest.approx(miri_detector().ipc_kernel[1, 1], rel=1e-3)


def test_warns_above_sixty_percent(make_exposure, make_sky, plain):
    exposure = make_exposure(n_groups=10)
    full = brightness(miri_detector().full_well / exposure.integration_time.to_value("s"))
    with pytest.warns(MiricigaleWarning, match="fills 61 % of the full well"):
        told = plain.forecast(make_sky(exposure, 0.61 * full), exposure)
    assert told.sky_too_bright
    assert not plain.forecast(make_sky(exposure, 0.59 * full), exposure).sky_too_bright


def test_sources_off_the_image_and_without_a_place(make_exposure, make_sky, plain):
    exposure = make_exposure(n_groups=3)
    sky = make_sky(exposure, 1.0)
    nx = exposure.shape[1]
    there = sources_at([-0.6, -0.4, nx - 0.6, nx, np.nan], [1.0, 1, 1, 1, 1])
    told = plain.forecast(sky, exposure, sources=there)
    assert told.sources["id"].tolist() == [101, 102]
    assert len(plain.forecast(sky, exposure).sources) == 0
    refuses("'sources' must", plain.forecast, sky, exposure, sources=QTable({"id": [1]}))


def test_table_of_several_exposures(make_exposure, make_sky, plain):
    forecasts = []
    for n_groups in (5, 40):
        exposure = make_exposure(n_groups=n_groups, dither=1)
        image = make_sky(exposure, 1.0)
        for x, groups in ((10, 8.5), (30, 3.5)):
            rate = miri_detector().full_well / (groups * exposure.group_time.to_value("s"))
            image.data[20, x] = brightness(rate)
        forecasts.append(plain.forecast(image, exposure, sources=sources_at([10, 30], [20, 20])))
    table = forecast_table(forecasts)
    assert table["n_groups"].tolist() == [5, 40]
    assert table["n_sources"].tolist() == [1, 2]
    assert table["first_group"].tolist() == [4, 4]
    assert table["ids"].tolist() == ["101", "101 100"]
    assert table["group_time"].unit == u.s
    assert table["sky_fraction"][1] == pytest.approx(8 * table["sky_fraction"][0])
    refuses("'forecasts' must be at least one", forecast_table, [])
    refuses("'forecasts' must be made of SaturationForecast", forecast_table, [exposure])
