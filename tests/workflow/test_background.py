"""The background by name, level, position and day: one idea of studies and plans."""

import sys

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData

from helpers.errors import refuses
from helpers.runs import one_band
from helpers.scenes import catalog_at
from miricigale.depth import zodiacal_factor
from miricigale.instrument import background_level
from miricigale.planning import load_plan
from miricigale.planning.exposures import band_plans
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow.background import background_text
from miricigale.workflow.config import StudyConfig, load_config
from miricigale.workflow.stages.exposures import (
    background_options,
    study_background,
    study_exposures,
)
from miricigale.workflow.stages.images import (
    expose_and_reduce,
    expose_image,
    imager_of,
    mosaics_of,
    reducer_of,
)
from miricigale.workflow.study import check_study

BANDS = ["miri.f770w", "miri.f2100w"]
COSMOS = {"ra": 150.1, "dec": 2.2}


def study(**scene):
    sections = {"exposures": {"filters": BANDS}, "pointing": COSMOS}
    return StudyConfig.from_dict({**sections, "scene": scene})


def plan(**background):
    exposures = {"bands": BANDS, "time": 900.0, "dithers": 4}
    config = load_plan(overrides={"exposures": exposures, "background": background})
    return {name: one.background for name, one in band_plans(config).items()}


@pytest.mark.parametrize(
    ("scene", "background"),
    [
        ({}, {}),
        ({"background": "high"}, {"level": "high"}),
        ({"background": ["low", "medium"]}, {"level": ["low", "medium"]}),
        ({"background": "low", "background_of": "pointing"}, {"level": "low", **COSMOS}),
        ({"background": "medium", "background_of": "pointing"}, {"level": "medium", **COSMOS}),
        ({"background": ["6 MJy/sr", "high"]}, {"level": ["6 MJy/sr", "high"]}),
    ],
)
def test_a_study_has_the_background_of_a_plan(scene, background):
    config = study(**scene)
    for name, level in plan(**background).items():
        assert study_background(config, name) == level
        assert study_background(study(**scene, background_scale=2.0), name) == 2 * level


def test_only_the_zodiacal_part_grows_with_the_name():
    cosmos = SkyCoord(**COSMOS, unit="deg")
    for name in BANDS:
        telescope = background_level(name, zodi="none")
        low = study_background(study(), name) - telescope
        for level in ("medium", "high"):
            for of, position in (("sky", None), ("pointing", cosmos)):
                own = study_background(study(background=level, background_of=of), name) - telescope
                factor = zodiacal_factor(name, level, position=position)
                assert (own / low).value == pytest.approx(factor)
                assert factor > 1.2


def test_a_level_is_what_it_says_in_any_unit():
    config = study(background=["12.5 MJy/sr", "0.3 GJy / sr"])
    assert study_background(config, BANDS[0]).value == pytest.approx(12.5)
    assert study_background(config, BANDS[1]).value == pytest.approx(300.0)
    told = background_text(**background_options(config))
    assert told == "F770W: 12.5 MJy / sr, as given; F2100W: 300 MJy / sr, as given"


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"background": "dark"}, r"or a surface brightness such as '12\.5 MJy/sr', got 'dark'"),
        ({"background": "12.5"}, "got '12.5'"),
        ({"background": "-1 MJy/sr"}, "got '-1 MJy/sr'"),
        ({"background": "inf MJy/sr"}, "got 'inf MJy/sr'"),
        ({"background": "3 uJy"}, "got '3 uJy'"),
        ({"background": []}, r"must have one level, or one for each band \(2\), got 0"),
        ({"background": ["low"] * 3}, r"one for each band \(2\), got 3"),
        ({"background": "high", "background_date": "2027-05-01"}, "must be left out with a date"),
        ({"background_of": "moon"}, r"background_of must be one of \['sky', 'pointing'\]"),
    ],
)  # fmt: skip
def test_what_is_no_background_is_refused(scene, message):
    refuses(rf"\[scene\] .*{message}", study, error=ConfigError, **scene)


def test_a_plan_refuses_the_same():
    text = r"\[background\] level must have one level"
    refuses(text, plan, error=ConfigError, level=["low"] * 3)
    day = {"date": "2027-05-01", **COSMOS}
    refuses("must be left out with a date", plan, error=ConfigError, level="high", **day)


def test_a_day_that_cannot_be_is_refused_before_anything_is_made(monkeypatch):
    # the Sun is near to the field then
    def refused(text, date):
        overrides = {"pointing": COSMOS, "scene": {"background_date": date}}
        config = load_config("goodss", quick=True, overrides=overrides)
        refuses(rf"\[scene\] background: {text}", check_study, config, error=ConfigError)

    refused("'date' must be a day on which", "2027-08-20")
    monkeypatch.setitem(sys.modules, "zodipy", None)
    refused(r".*miricigale\[background\]", "2027-05-01")


def test_the_report_says_which_and_from_where():
    def told(**scene):
        return background_text(**background_options(study(**scene)))

    assert "telescope and low zodiacal light (Rigby et al. 2023, jwst_backgrounds)" in told()
    place, source = "RA 150.1000, Dec 2.2000", "(Kelsall et al. 1998 by ZodiPy)"
    assert told(background="medium", background_of="pointing") == (
        "telescope and medium zodiacal light, the 50th percentile over the days on which "
        f"{place} can be seen {source}"
    )
    assert "90th percentile over the sky" in told(background="high")
    day = told(background_date="2027-05-01")
    assert day == f"telescope and zodiacal light of 2027-05-01 at {place} {source}"


@pytest.mark.slow
def test_images_have_the_background_that_was_asked_for():
    scene = {"background": "20 MJy/sr", "background_gradient": 0.0}
    config = one_band(BANDS[0], kind="rates", n_groups=40, scene=scene)
    (exposure,) = study_exposures(config).values()
    sky = SkyCoord([exposure.pointing.ra], [exposure.pointing.dec])
    catalog = catalog_at(sky, **{BANDS[0]: 1.0 * u.uJy})
    forecasts = []
    _, cal = expose_and_reduce(config, exposure, catalog, seed=1, tell=forecasts.append)
    # through gain, non-linearity, flat field and conversion back to a surface brightness
    assert cal.meta["background"] == pytest.approx(20.0, rel=3e-3)
    assert np.isfinite(forecasts[0].sky_fraction)


@pytest.mark.slow
def test_backgrounds_of_dithers_are_those_of_the_detector():
    """Glow that lies still on the detector leaves mosaics; a mesh that is wider than it leaves it in them."""
    exposures = {
        "filters": BANDS[:1], "kind": "rates", "n_groups": [40], "n_integrations": [1],
        "n_dithers": [3], "dithers": "ceers",
    }  # fmt: skip
    images, left = [], {}
    for method in ("dithers", "masked"):
        values = {"fit": {"min_detected": 1}, "reduction": {"background": method}}
        config = StudyConfig.from_dict({"exposures": exposures, **values})
        if not images:
            for e in study_exposures(config).values():
                y, x = np.indices(e.shape)
                light = 20 + 0.4 * np.sin(2 * np.pi * x / 60) * np.sin(2 * np.pi * y / 60)
                sky = CCDData(light, unit="MJy/sr", wcs=e.wcs)
                images.append(expose_image(config, imager_of(config), sky, e, seed=2)[1])
            # the sky stays in them until all dithers are there
            assert np.median(images[0].data[~images[0].mask]) == pytest.approx(20.0, rel=3e-3)
            own = images
        else:
            reducer = reducer_of(config)
            own = [reducer.subtract_background(im)[0] for im in images]
        _, mosaic, planes = next(mosaics_of(config, own))
        ny, nx = (n // 12 * 12 for n in mosaic.shape)
        cells = np.ma.masked_array(mosaic.data, mosaic.mask | (planes["n_images"] < 3))[:ny, :nx]
        left[method] = cells.reshape(ny // 12, 12, nx // 12, 12).mean(axis=(1, 3)).std()
    # 0.2 rms, less what dithers of a few arcsec average out; and noise
    assert left["masked"] > 0.08
    assert left["dithers"] < 0.3 * left["masked"]


def test_backgrounds_of_dithers_take_three_of_them():
    exposures = {"filters": BANDS, "n_dithers": [3, 2]}
    values = {"exposures": exposures, "reduction": {"background": "dithers"}}
    text = r"^\[reduction\] background must have three .* \['miri.f2100w'\]"
    refuses(text, check_study, StudyConfig.from_dict(values), error=ConfigError)
