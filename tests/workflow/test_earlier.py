"""Folders and files that an earlier version wrote are read, or refused with what to do, which works."""

import json
import tarfile
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.commands import command
from helpers.errors import refuses, warned
from miricigale import BayesFitter, SEDModel
from miricigale.fitting import fit_file, open_results
from miricigale.photometry import ErrorCalibration, ForcedPhotometryResult
from miricigale.planning import PlanConfig
from miricigale.psf import MatchingKernel
from miricigale.sed import yang2021_axes
from miricigale.utils.exceptions import ConfigError, DataError, OtherResultsError
from miricigale.utils.store import write_parts
from miricigale.workflow.config import StudyConfig, load_config

FILES = Path(__file__).parent / "earlier" / "files.tar.gz"
BANDS = ["wfc3.f160w", "miri.f770w", "miri.f1500w"]
#: Fluxes (uJy) of the points that were measured: the peak (MJy/sr) times the area of the Gaussian.
LIGHT = np.array([3.0, 5.0]) * 2 * np.pi * (0.45 / 2.3548 * u.arcsec.to(u.rad)) ** 2 * 1e12


@pytest.fixture
def earlier(tmp_path):
    """What earlier versions wrote."""
    with tarfile.open(FILES) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def test_files_of_photometry_are_read(earlier):
    kernel = MatchingKernel.read(earlier / "kernel.fits")
    assert kernel.array.sum() == pytest.approx(1.0, abs=1e-3)
    table = QTable.read(earlier / "photometry.ecsv")
    result = ForcedPhotometryResult.read(earlier / "photometry.fits")
    assert list(result.to_table()["id"]) == list(table["id"]) == [7, 11]
    for flux in (table["flux"], result.flux):
        assert_allclose(flux.to_value(u.uJy), LIGHT, rtol=0.02)
    calibration = ErrorCalibration.read(earlier / "calibration.ecsv")
    # noise of 0.45 uJy with errors of 0.3
    assert calibration.factor([10] * u.uJy, [0.3] * u.uJy).item() == pytest.approx(1.5, rel=0.3)


def test_a_folder_of_fits_is_read_and_another_fit_in_it_is_refused(earlier):
    results = open_results(earlier / "fit")
    assert [one.ids for one in results] == [7, 11]
    assert_allclose(results.to_table()["mass_p50"].to_value(u.Msun), [2e10, 5e10], rtol=0.5)
    axes = {name: np.atleast_1d(values)[:2] for name, values in yang2021_axes("quick").items()}
    axes["redshift"] = np.array([0.8, 1.4])
    fitter = BayesFitter(SEDModel.yang2021(), BANDS, axes=axes)
    catalog = earlier / "catalog.ecsv"
    text = r"fit holds results of another fit: .*give another folder, or resume=False"
    form = {"redshift": "redshift"}
    refuses(text, fit_file, fitter, catalog, earlier / "fit", error=OtherResultsError, **form)
    # both ways out work
    other = fit_file(fitter, catalog, earlier / "other", **form)
    again = fit_file(fitter, catalog, earlier / "fit", resume=False, **form)
    assert len(other) == len(again) == 2


def test_layouts_of_other_versions_are_named(earlier):
    path = earlier / "fit" / "manifest.json"
    for name in (path, path.with_name(".manifest.copy.json")):
        values = json.loads(name.read_text())
        values["format"] = "miricigale-fitparts-1"
        del values["sha256"]
        name.write_text(json.dumps(values))
    text = "layout 'miricigale-fitparts-1' of another version .* fit again in another folder"
    refuses(text, open_results, earlier / "fit", error=DataError)
    kept = earlier / "results.fits"
    write_parts(kept, "miricigale-fitresults-2", text={"filters": []})
    from miricigale.fitting import FitResults

    text = (
        "fit results in the layout 'miricigale-fitresults-2' of another version .* this one reads"
    )
    refuses(text, FitResults.read, kept, error=DataError)
    # another kind of file is no earlier version of this one
    write_parts(kept, "miricigale-library-1", text={}, overwrite=True)
    refuses("holds no fit results", FitResults.read, kept, error=DataError)


def test_a_run_goes_on_with_its_own_configuration(earlier, capsys, caplog):
    run = earlier / "run"
    before = (run / "catalog.ecsv").read_bytes()
    words = "run", "goodss", "--quick", "--until", "catalog", "-o", run
    said = command(capsys, *words, status=2).err
    assert "[catalog] mag_limit: 19.0 -> 26.0" in said
    own = "run", run / "config.toml", "--until", "catalog", "-o", run, "--no-progress"
    text = r"\[reduction\] residual_cosmic_rays, without effect, left out"
    warned(text, command, capsys, *own)
    # what the version did not have, and this one takes for it
    assert "made by a version without" in caplog.text
    assert "[fit] dust_excess = [0.25, 1.0, 2.5]" in caplog.text
    assert (run / "catalog.ecsv").read_bytes() == before
    # the record of the folder is that of this version now
    caplog.clear()
    warned(text, command, capsys, *own)
    assert caplog.text == ""


def test_a_configuration_that_asks_for_what_is_gone_says_what_to_do(earlier, capsys):
    path = earlier / "run" / "config.toml"
    text = path.read_text().replace("residual_cosmic_rays = false", "residual_cosmic_rays = true")
    path.write_text(text)
    gone = "[reduction] residual_cosmic_rays = True is gone"
    words = "--until", "catalog", "-o", earlier / "run", "--no-progress"
    said = command(capsys, "run", "goodss", "--quick", *words, status=2).err
    assert f"change it where it says {path}: {gone}" in said
    said = command(capsys, "run", path, *words, status=2).err
    assert gone in said
    assert "remove the line" in said
    path.write_text(text.replace("residual_cosmic_rays = true\n", ""))
    command(capsys, "run", path, *words)


def test_keys_that_had_other_names_are_read(earlier):
    path = earlier / "study-2026-11-22.toml"
    text = r"\[photometry\] min_area is called \[photometry\] n_pixels now"
    config = warned(text, load_config, path)
    assert config.photometry.n_pixels == 45
    # not both
    path.write_text(path.read_text().replace("min_area = 45", "min_area = 45\nn_pixels = 45"))
    refuses(f"{text}, and both are there", load_config, path, error=ConfigError)
    plan = earlier / "plan-2026-11-26.toml"
    texts = [(plan.name, plan.read_text())]
    text = r"\[agn\] field, \[agn\] select, .*\[images\] roll, without effect"
    warned(text, PlanConfig.from_texts, texts)
    values = {"agn": {"select": "mean", "field": True}, "sample": {"mag_limit": 25.0}}
    text = r"(?s)\[agn\] field = True is gone: .*; \[agn\] select = 'mean' is gone"
    refuses(text, PlanConfig.from_dict, values, error=ConfigError)
    values = {"sample": {"mag_limit": 25.0}}
    config = warned(r"\[catalog\] mag_limit", PlanConfig.from_dict, values)
    assert config.catalog.mag_limit == 25.0


@pytest.mark.parametrize("kind", [StudyConfig, PlanConfig])
def test_earlier_names_lead_to_keys_of_today(kind):
    config = kind()
    for old, entry in kind.earlier.items():
        section, _, key = old.partition(".")
        assert not hasattr(getattr(config, section, None), key)
        if entry.name:
            section, _, key = entry.name.partition(".")
            assert hasattr(getattr(config, section), key)
        elif entry.without_effect is not None:
            assert entry.instead
