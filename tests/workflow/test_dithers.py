"""Dithers of a study from files: exposures are where the files say."""

import os

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.instrument import ceers_exposures
from miricigale.utils.exceptions import ConfigError, DataError
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.exposures import dithers_text, study_exposures
from miricigale.workflow.study import check_study

BANDS = ["miri.f770w", "miri.f2100w"]
#: Dithers of the filters in exposures of their own, as APT's list has them.
FIRST = [(-1.446, 3.956), (3.771, -5.358), (1.035, 4.889)]
SECOND = [(2.983, -2.146), (1.08, -1.849)]
PATTERNS = {1: FIRST, 2: SECOND}
LINE = (
    "  1    1   {exp}    {dith} MIRIM_ILLUM               1 CEERS  +12.00000  +12.00000   +0.000   +0.000 "
    "  {x:+.3f}   {y:+.3f} -451.785 -369.994   {x:+.3f}   {y:+.3f} DITHER     SCIENCE        0      0  0.000"
)


def config_of(filters=BANDS, **exposures):
    exposures |= {"filters": filters}
    return StudyConfig.from_dict({"exposures": exposures, "fit": {"min_detected": 1}})


@pytest.fixture
def listed(tmp_path):
    lines = ["# APT Output Product", "* CEERS-MIRI5 (Obs 5)", "** Visit 5:1"]
    for exp, offsets in PATTERNS.items():
        for dith, (x, y) in enumerate(offsets, start=1):
            lines.append(LINE.format(exp=exp, dith=dith, x=x, y=y))
    lines += ["* CEERS-MIRI6 (Obs 6)", LINE.format(exp=1, dith=1, x=0.5, y=-0.5)]
    path = tmp_path / "ceers.pointing"
    path.write_text("\n".join(lines))
    return path


@pytest.fixture
def table(tmp_path):
    path = tmp_path / "dithers.ecsv"
    QTable({"x_offset": [0, 2.5] * u.arcsec, "y_offset": [0, 0.05] * u.arcmin}).write(path)
    return path


def offsets_of(config, band):
    """Where exposures look, as offsets along the ideal axes from the center of the field: arcsec."""
    field = SkyCoord(config.pointing.ra, config.pointing.dec, unit="deg")
    found = []
    for e in study_exposures(config).values():
        if e.filter == band:
            # +y is at the position angle of the aperture, +x 90 deg west of it
            angle = field.position_angle(e.pointing) - e.pa_aper
            distance = field.separation(e.pointing).to_value(u.arcsec)
            found.append((-distance * np.sin(angle).value, distance * np.cos(angle).value))
    return np.array(found)


def test_without_a_file_exposures_are_those_of_the_plan():
    config = config_of()
    field = SkyCoord(config.pointing.ra, config.pointing.dec, unit="deg")
    planned = ceers_exposures(field, 0 * u.deg, filters=BANDS)
    own = list(study_exposures(config).values())
    for one, plan in zip(own, planned, strict=True):
        assert (one.filter, one.dither, one.n_groups) == (plan.filter, plan.dither, plan.n_groups)
        assert one.pointing.to_string(precision=12) == plan.pointing.to_string(precision=12)

    assert "the package's pattern 'ceers'" in dithers_text(config)


def test_each_filter_is_at_the_dithers_of_its_exposure(listed):
    config = config_of(dithers=str(listed), dither_observation=5, dither_exposures=[1, 2])
    # where the list has the target when the imager looks at the middle of both
    middle = np.mean(FIRST + SECOND, axis=0)
    for band, places in zip(BANDS, PATTERNS.values(), strict=True):
        assert_allclose(offsets_of(config, band), middle - places, atol=1e-4)
    # groups and integrations stay those of the plan
    assert {e.n_groups for e in study_exposures(config).values()} == {200, 10}
    assert dithers_text(config) == (
        "F770W: offsets in the file ceers.pointing, observation 5, exposure 1; "
        "F2100W: offsets in the file ceers.pointing, observation 5, exposure 2"
    )
    other = config_of(dithers=str(listed), dither_observation=6)
    for band in BANDS:
        assert_allclose(offsets_of(other, band), [[0, 0]], atol=1e-4)


def test_files_patterns_and_numbers_of_each_filter(table):
    config = config_of(dithers=[str(table), "4-point"], n_dithers=[1, 3])
    assert_allclose(offsets_of(config, BANDS[0]), [[0, 0]], atol=1e-4)
    assert len(offsets_of(config, BANDS[1])) == 3
    config = config_of(dithers=str(table))
    for band in BANDS:
        assert_allclose(offsets_of(config, band), [[0, 0], [2.5, 3.0]], atol=1e-4)
    # a band without a plan needs its groups only
    config = config_of(["miri.f560w"], dithers=str(table), n_groups=[50])
    assert len(study_exposures(config)) == 2


def test_a_file_that_changed_makes_other_exposures(table):
    config = config_of(dithers=str(table))
    stage = {stage.name: stage for stage in study_stages()}["exposures"]
    before = {unit: stage.plan(config, unit) for unit in stage.unit_names(config)}
    other = QTable({"x_offset": [0, 9.5] * u.arcsec, "y_offset": [0, 0] * u.arcsec})
    other.write(table, overwrite=True)
    os.utime(table, ns=(1, 1))
    after = {unit: stage.plan(config, unit) for unit in stage.unit_names(config)}
    changed = {unit for unit in before if before[unit] != after[unit]}
    assert changed == {f"agn00/{band}-1" for band in BANDS}


def test_what_are_no_dithers_is_refused(listed, table, tmp_path):
    def refused(message, **exposures):
        # a configuration that cannot be, or a file that does not fit it
        with pytest.raises(ConfigError, match=rf"^\[exposures\] {message}"):
            check_study(config_of(**exposures))

    refused(r"dithers must be a file or one of \['ceers', .*got 'cears'", dithers="cears")
    refused(r"dithers must have one pattern, or one per filter \(2\), got 3", dithers=["none"] * 3)
    for text, options in (
        (r"dithers: ceers\.pointing: 'observation' must be one of \[5, 6\], got None", {}),
        (r"dithers: .*: 'exposure' must be one of \[1, 2\], got None", {"dither_observation": 5}),
        (r"dither_exposures must have one number per filter \(2\)", {"dither_exposures": [1]}),
    ):
        refused(text, dithers=str(listed), **options)
    for text, options in (
        ("n_dithers must be at most 2 for miri.f770w, .*got 3", {"n_dithers": [3, 3]}),
        ("dither_observation must come with a .pointing file", {"dither_observation": 2}),
    ):
        refused(text, dithers=str(table), **options)
    empty = tmp_path / "empty.pointing"
    empty.write_text("# APT Output Product\n")
    text = r"empty\.pointing has no exposures of MIRIM apertures"
    refuses(text, check_study, config_of(dithers=str(empty)), error=DataError)
    plain = tmp_path / "plain.ecsv"
    QTable({"x_offset": [1.0], "y_offset": [1.0]}).write(plain)
    text = r"dithers: .*'plain\.ecsv' columns 'x_offset', 'y_offset' must be convertible to arcsec, got no"
    refused(text, dithers=str(plain))
