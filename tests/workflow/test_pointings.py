"""Fields of several pointings: exposures, exposure times, and errors that follow them."""

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.runs import do_stage, make_run, sky_image, small_config, thicker_half
from miricigale.detector.effects.base import stream_key
from miricigale.instrument import imager_columns
from miricigale.photometry import ErrorModel
from miricigale.utils.exceptions import ConfigError
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.stages.exposures import (
    exposure_plan,
    pointing_of,
    pointing_time,
    study_exposures,
    study_pointings,
)
from miricigale.workflow.stages.grids import grid_of, mosaic_memory
from miricigale.workflow.stages.sample import mean_coverage

BAND = "miri.f770w"


def field(**pointing):
    exposures = {"filters": [BAND, "miri.f2100w"]}
    return StudyConfig.from_dict({"pointing": pointing, "exposures": exposures})


@pytest.mark.parametrize("pointing", [{"tiles": [2, 3]}, {"centers": [f"{k} 5" for k in range(6)]}])
def test_every_exposure_of_a_field_is_its_own(pointing):
    config, single = field(**pointing), study_exposures(field())
    centers, exposures = study_pointings(config), study_exposures(config)
    assert len(centers) == 6
    assert len(exposures) == 6 * len(single)
    assert all(name == f"{e.filter}-{e.dither}" for name, e in exposures.items())
    # so that neither names nor random numbers are shared
    keys = {stream_key(1, e, "read noise").tobytes() for e in exposures.values()}
    assert len(keys) == len(exposures)
    assert len({str(one) for one in exposure_plan(config).values()}) == len(exposures)
    for name in config.exposures.filters:
        own = [e for e in exposures.values() if e.filter == name]
        found = [pointing_of(config, e) for e in own]
        assert found == [center for center in centers for _ in range(len(own) // 6)]
        # the time of one pointing, not of the field
        one = sum(e.exposure_time for e in single.values() if e.filter == name)
        assert_allclose(pointing_time(config, name).to_value(u.s), one.to_value(u.s))


def test_tiles_make_one_field_about_the_center():
    config = field(tiles=[3, 2], overlap=0.15, ra=0.001)
    sides = np.array(grid_of(config, 0.11).pixel_shape)
    single = np.array(grid_of(field(ra=0.001), 0.11).pixel_shape)
    first, last = imager_columns()
    steps = sides - single
    # north-up boxes about fields that are turned: the sum of both sides' projections
    angle = np.radians(next(iter(study_exposures(config).values())).pa_aper.value)
    wide, high = 2 * 0.85 * (last - first), 0.85 * 1024
    cos, sin = abs(np.cos(angle)), abs(np.sin(angle))
    expected = [abs(wide) * cos + high * sin, abs(wide) * sin + high * cos]
    assert_allclose(steps, expected, rtol=0.02)
    middle = grid_of(config, 0.11).pixel_to_world(*(0.5 * (sides - 1)))
    alone = grid_of(field(ra=0.001), 0.11).pixel_to_world(*(0.5 * (single - 1)))
    assert middle.separation(alone) < 0.5 * u.arcsec


def test_memory_follows_the_field():
    """Fields of which some would not fit beside each other: by the area, not the number of bands."""
    one, nine = (mosaic_memory(field(tiles=tiles), f"agn00/{BAND}") for tiles in ([1, 1], [3, 3]))
    # of one pointing what the runner takes for a stage that says nothing
    assert one == pytest.approx(1.2e9, rel=0.05)
    pixels = [np.prod(grid_of(field(tiles=tiles), 0.06).pixel_shape) for tiles in ([1, 1], [3, 3])]
    assert nine - one == 120 * (pixels[1] - pixels[0]) + 24 * 60_000_000


def test_coverage_is_the_mean_about_a_source():
    n_images = np.full((101, 101), 2, np.uint8)
    n_images[:, 51:] = 4
    # a pixel that a cosmic ray took, and a source off the image
    n_images[20, 20] = 1
    image = sky_image(0.1, n_images.shape, np.zeros(n_images.shape))
    sky = image.wcs.pixel_to_world([20, 80, 20, 500], [50, 50, 20, 50])
    found = mean_coverage(SkyCoord(sky), image, n_images)
    assert_allclose(found[[0, 1, 3]], [2.0, 4.0, 0.0])
    assert 1.98 < found[2] < 2.0


@pytest.mark.slow
def test_errors_of_a_run_follow_the_exposure_time(tmp_path):
    """Half of the field exposed four times: the same fluxes have half of the errors there."""
    make_run(tmp_path, [BAND], report=False)
    n_images = thicker_half(tmp_path, BAND, 4)
    for coverage, share in ((True, 0.5), (False, 1.0)):
        values = {"errors": {"bin_size": 8, "coverage": coverage}}
        config = StudyConfig.from_dict(values, base=small_config([BAND]))
        do_stage(config, tmp_path, "errors")
        do_stage(config, tmp_path, "matches", "agn00")
        matched = QTable.read(tmp_path / "agn00" / "matched.ecsv")
        matched = matched[np.isfinite(matched[BAND])]
        shares = (matched[f"{BAND}_time"] / pointing_time(config, BAND)).to_value(u.one)
        deep, shallow = shares == 4, shares == 1
        assert n_images.max() == 4
        assert np.count_nonzero(deep) > 5
        assert np.count_nonzero(shallow) > 5
        errors = ErrorModel.read(tmp_path / "errors.ecsv")
        ratio = (matched[f"{BAND}_err"] / errors.sigma(matched[BAND], BAND)).to_value(u.one)
        assert_allclose(ratio[deep], share)
        assert_allclose(ratio[shallow], 1.0)


def test_pointings_of_a_table(tmp_path):
    path = tmp_path / "plan.ecsv"
    rows = QTable({"ra": [53.1, 53.2, 53.3] * u.deg, "dec": [-27.8, -27.8, -27.7] * u.deg})
    rows["roll"] = [0.0, np.pi / 2, 0.3] * u.rad
    rows["bands"] = ["F770W", "", "F770W, miri.f2100w"]
    rows["time"] = [1000.0, 2000.0, 500.0] * u.s
    rows.write(path)
    config = field(centers=[str(path)], roll=45.0)
    exposures = study_exposures(config)
    centers = study_pointings(config)
    assert [round(one.ra.deg, 6) for one in centers] == [53.1, 53.2, 53.3]
    for name, seen in (("miri.f770w", (0, 1, 2)), ("miri.f2100w", (1, 2))):
        own = [e for e in exposures.values() if e.filter == name]
        n = len(own) // len(seen)
        for k, row in enumerate(seen):
            some = own[k * n : (k + 1) * n]
            assert {pointing_of(config, e).ra.deg for e in some} == {centers[row].ra.deg}
            assert_allclose([e.roll.to_value(u.rad) for e in some], rows["roll"][row].value)
            time = sum(e.exposure_time for e in some)
            assert_allclose(time.to_value(u.s), rows["time"][row].value, rtol=0.02)
        assert len(exposure_plan(config, name)) == len(own)
    time = pointing_time(config, "miri.f2100w")
    assert_allclose(time.to_value(u.s), 2000, rtol=0.02)
    # one that has changed is read again
    rows[:2].write(path, overwrite=True)
    assert len(study_pointings(config)) == 2
    # without columns all is as elsewhere
    rows["ra", "dec"].write(path, overwrite=True)
    assert {e.roll.to_value(u.deg) for e in study_exposures(config).values()} == {45.0}
    rows["bands"] = "F1000W"
    rows.write(path, overwrite=True)
    match = r"\[pointing\] centers: plan.ecsv: 'bands' must be of \[exposures\] filters .*'F1000W'"
    refuses(match, study_exposures, config, error=ConfigError)


def test_pointings_of_a_list_of_apt(tmp_path, caplog):
    line = "1 1 1 1 {} 1 FIELD +53.1 -27.8 +0.0 +0.0 +0.0 +0.0 -453.6 -373.8 +0.0 +0.0 TARGET SCIENCE 0 0"
    path = tmp_path / "plan.pointing"
    path.write_text("\n".join(["* (Obs 1)", *map(line.format, ("MIRIM_FULL", "NRCALL_FULL"))]))
    config = field(centers=[str(path)], roll=45.0)
    assert [center.to_string(precision=3) for center in study_pointings(config)] == [
        "53.100 -27.800"
    ]
    assert {e.roll.to_value(u.deg) for e in study_exposures(config).values()} == {45.0}
    assert (
        "plan.pointing: exposures that are not of the full imager are not used: NRCALL_FULL (SCIENCE)"
        in caplog.text
    )
