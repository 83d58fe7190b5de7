"""Exposures of a plan: times, depths, noise, the clock, against closed forms and other subpackages."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest

from helpers.cases import cases_of
from helpers.errors import refuses
from helpers.references import write_photom
from miricigale.depth import etc_limit, saturation_forecast, sensitivity
from miricigale.instrument import background_level, imager_filters, subarrays
from miricigale.planning import load_plan, wall_clock
from miricigale.planning.config import OverheadSection
from miricigale.planning.exposures import band_plans
from miricigale.utils.exceptions import ConfigError

BAND = "miri.f1000w"


def plan_of(time=2000.0, **sections):
    exposures = {"bands": [BAND], "time": time, "dithers": 4} | sections.pop("exposures", {})
    return band_plans(load_plan(overrides={"exposures": exposures, **sections}))[BAND]


def test_the_depth_quoted_is_that_of_the_sensitivity():
    plan = plan_of()
    assert plan.background == background_level(BAND)
    form = {"n_groups": plan.exposure.n_groups, "n_dithers": 4}
    own = sensitivity(BAND, plan.time, **form)
    assert plan.limit.value == pytest.approx(own.to_value(u.ABmag), abs=1e-9)
    # which is the limit of the errors that the plan draws, but for the fraction of the flux
    errors = plan_of(noise={"fractional": 0.0}).errors()
    assert plan.limit.value == pytest.approx(errors.limiting_magnitude(BAND).value, abs=1e-6)
    # noise is by the name or by the number
    for excess, name in ((1.0, "ideal"), (1.4, "flight"), ("ideal", "ideal")):
        named = plan_of(noise={"excess": excess}).limit
        other = sensitivity(BAND, plan.time, excess=name, **form)
        assert named.value == pytest.approx(other.to_value(u.ABmag), abs=1e-9)
    # and the calculator's is the published 10 sigma in 10 ks, as the root of the time
    scaled = etc_limit(BAND) / 2 * np.sqrt(1e4 * u.s / plan.time)
    calculator = plan.numbers()["limit_etc"].value
    assert calculator == pytest.approx(scaled.to(u.uJy).to_value(u.ABmag), abs=0.0051)


def test_noise_falls_as_the_root_of_the_time():
    noise = {"noise": {"fractional": 0.0}}
    # the same integrations, four times as many: only photons and read noise count
    short = plan_of(1000.0, exposures={"dithers": 2}, **noise)
    long = plan_of(4000.0, exposures={"dithers": 8}, **noise)
    assert long.exposure.n_groups == short.exposure.n_groups
    first, second = (plan.errors().sigma(0 * u.uJy, BAND).value for plan in (short, long))
    assert first / second == pytest.approx(2.0, rel=1e-6)


def test_a_depth_gives_the_time_that_reaches_it():
    times = plan_of()
    depth = float(times.errors().limiting_magnitude(BAND).value)
    config = load_plan(overrides={"exposures": {"bands": [BAND], "depth": depth, "dithers": 4}})
    found = band_plans(config)[BAND]
    assert found.time.value == pytest.approx(times.time.value, rel=0.02)
    too_deep = load_plan(overrides={"exposures": {"bands": [BAND], "depth": 35.0, "dithers": 4}})
    refuses(r"35\.0 is not reached in miri\.f1000w", band_plans, too_deep, error=ConfigError)


@pytest.mark.parametrize(("band", "time", "dithers", "published"), cases_of(__file__, "in_flight"))
def test_limits_are_those_of_surveys_in_flight(band, time, dithers, published):
    """One factor for all bands, within 0.15 mag; docs/accuracy/planning.rst has the residuals."""
    exposures = {"bands": [band], "time": time, "dithers": dithers}
    plan = band_plans(load_plan(overrides={"exposures": exposures}))[band]
    assert plan.errors().limiting_magnitude(band).value == pytest.approx(published, abs=0.15)


def test_the_excess_multiplies_the_noise_of_the_sky():
    first, second = (plan_of(noise={"excess": f, "fractional": 0.0}).errors() for f in (1.0, 2.0))
    for flux, power in ((0.0, 2.0), (1e7, 1.0)):
        one, two = (errors.sigma(flux * u.uJy, BAND).value for errors in (first, second))
        assert two / one == pytest.approx(power, rel=1e-3)


def test_integrations_are_short_enough_for_the_sky():
    for level in ("low", "high"):
        limits = {"max_fill": 0.5, "max_groups": 1000}
        plan = plan_of(8000.0, background={"level": level}, exposures=limits)
        own = saturation_forecast(plan.exposure, background=plan.background)
        assert plan.sky_fraction == own
        assert own < 0.52
    # a brighter sky is shorter integrations and more noise
    low = plan_of(8000.0, exposures={"max_groups": 1000})
    assert plan.exposure.n_integrations > low.exposure.n_integrations
    assert plan.limit < low.limit
    assert plan_of(8000.0).exposure.n_groups <= 100


def test_a_later_day_is_a_shallower_limit(tmp_path):
    rows = [(f[5:].upper(), part, 1.0) for f in imager_filters() for part in subarrays()]
    loss = {"TIMECOEFF_LINEAR": {"t0": 59000.0, "lossperyear": 0.1}}
    photom = str(write_photom(tmp_path / "photom.fits", rows, times=loss))
    # two years of 365 days after the first
    aged = plan_of(exposures={"photom": photom, "date": "2022-05-31"})
    same = dataclasses.replace(plan_of(), background=0.8 * background_level(BAND))
    assert aged.saturation.value == pytest.approx(same.saturation.value + 2.5 * np.log10(0.8))
    assert aged.limit.value == pytest.approx(same.limit.value + 2.5 * np.log10(0.8))
    sigma, dim = (plan.errors().sigma(0 * u.uJy, BAND).value for plan in (aged, same))
    assert sigma == pytest.approx(dim / 0.8, rel=1e-6)
    refuses("photom, date", plan_of, exposures={"date": "2026-01-01"}, error=ConfigError)


def test_the_clock_counts_every_overhead_once():
    names = ("slew", "next_slew", "guide_star", "visit", "filter", "script", "exposure", "dither")
    free = OverheadSection(**dict.fromkeys(names, 0.0), observatory=0.0)
    plan = plan_of(2000.0, exposures={"dithers": 4})
    light = 4 * plan.exposure.duration
    assert wall_clock([plan], free).to_value(u.s) == pytest.approx(light.value)
    # two bands, four dithers each, three pointings
    for name, count in zip(names, (1, 2, 3, 3, 6, 6, 24, 18), strict=True):
        options = OverheadSection(**{**dict.fromkeys(names, 0.0), name: 10.0}, observatory=0.0)
        time = wall_clock([plan, plan], options, pointings=3).to_value(u.s)
        assert time - 6 * light.value == pytest.approx(10 * count), name
    assert wall_clock([plan], OverheadSection()) > 1.16 * light
