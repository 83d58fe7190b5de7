"""AGN of many skies without images: what is measured of them, and what is counted."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.figures import no_pictures
from helpers.runs import do_stage, make_run, small_config
from miricigale.photometry import ErrorModel
from miricigale.workflow.stages.skies import sky_photometry
from miricigale.workflow.truths import FIELD

pytestmark = pytest.mark.slow

BANDS = ["miri.f770w", "miri.f1500w"]


def test_fluxes_are_off_by_the_errors_of_a_measured_source():
    """All measured sources are two sigma too bright, so that each drawn one is, by its own noise."""
    errors = ErrorModel.from_depths(dict.fromkeys(BANDS, 23.9), fractional=0.1)
    true, noise = np.geomspace(0.5, 50, 12), np.where(np.arange(12) < 6, 1.0, 2.0)
    matched = QTable()
    for name in BANDS:
        sigma = noise * np.hypot(0.2, 0.1 * true)
        matched[f"{name}_true"], matched[name] = true * u.uJy, (true + 2 * sigma) * u.uJy
        measured = np.hypot(0.2, 0.1 * matched[name].value)
        matched[f"{name}_err"] = noise * measured * u.uJy
    # without a flux in a band a source lends no errors
    matched[BANDS[1]][3] = matched[f"{BANDS[1]}_err"][3] = np.nan * u.uJy
    rows, own = np.array([0, 1, 11, 11]), np.array([0.3, 3.0, 3.0, 30.0])
    light = QTable({"id": np.arange(4), **dict.fromkeys(BANDS, own * u.uJy)})
    table = sky_photometry(matched, rows, light, BANDS, errors, seed=3)
    for name in BANDS:
        found = own + 2 * noise[rows] * np.hypot(0.2, 0.1 * own)
        assert_allclose(table[name].value, found)
        assert_allclose(table[f"{name}_err"].value, noise[rows] * np.hypot(0.2, 0.1 * found))
    # 0.7 of 0.21, 3.72 of 0.42, 4.44 of 0.97, 42 of 8.5 uJy
    assert table["n_detected"].tolist() == [0, 2, 0, 0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("skies")
    with no_pictures():
        make_run(folder, BANDS, frac_agn=(0.0, FIELD), skies=40)
    return folder


def test_completeness_and_purity_are_those_of_all_skies(folder):
    """Counted source by source: an AGN is one of 40 skies, another galaxy one of two."""
    numbers = QTable.read(folder / "report" / "skies.ecsv")
    assert len(numbers) == 4
    for row in numbers:
        table = QTable.read(folder / FIELD / f"skies_{row['band_set']}.ecsv")
        limit, n_agn, found, all_agn, selected = row["limit"], 0, 0.0, 0.0, 0.0
        for one in table:
            agn = one["frac_agn"] >= limit
            weight = 1 / 40 if one["frac_agn"] >= 0.1 else 1 / 2
            n_agn += agn
            all_agn += agn * weight
            if one["selection"] == 0 and one["frac_agn_p50"] >= limit:
                selected += weight
                found += agn * weight
        assert (row["n_skies"], row["n_wanted"]) == (40, n_agn)
        assert_allclose([row["wanted"], row["selected"]], [all_agn, selected])
        assert_allclose([row["completeness"], row["purity"]], [found / all_agn, found / selected])
        assert row["completeness_low"] < row["completeness"] <= row["completeness_high"]
        # two whole skies of the 24 galaxies, and AGN of the others
        assert np.count_nonzero(table["sky"] <= 2) == 48
        assert np.all(table["frac_agn"][table["sky"] > 2] >= 0.1)
        assert np.all(np.isfinite(table["frac_agn_p50"]) == (table["selection"] == 0))


def test_skies_are_the_same_again_and_can_be_left_out(folder):
    config = small_config(BANDS, frac_agn=(0.0, FIELD), skies=40)
    path = folder / FIELD / "skies_all.ecsv"
    known = path.read_bytes()
    path.unlink()
    do_stage(config, folder, "skies", f"{FIELD}/all")
    assert path.read_bytes() == known
    page = (folder / "report" / "index.html").read_text()
    assert "40, forecast" in page
    assert "sources-field.html#?frac_agn=0.1.." in page
