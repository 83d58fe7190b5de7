"""Input SEDs: whose errors are used, which bands are fitted, and what is drawn."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.runs import STAGES, do_stage
from helpers.scenes import catalog_at
from miricigale.fitting import FitResults
from miricigale.scene import CatalogFlags, check_catalog
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import ConfigError, MiricigaleWarning
from miricigale.workflow import StudyRunner
from miricigale.workflow.analysis_sections import FitSection
from miricigale.workflow.config import StudyConfig
from miricigale.workflow.page.provenance import catalog_facts
from miricigale.workflow.stage_list import study_stages
from miricigale.workflow.stages.fits import mock_photometry
from miricigale.workflow.stages.inputs import existing_bands
from miricigale.workflow.stages.sample import SampleFlags, add_selection, cut_flags, good_redshifts

SHORT, LONG = ["nircam.f090w", "nircam.f150w", "nircam.f200w"], ["mips.24"]
ALPHA = [1.5, 2.5]


@pytest.fixture(scope="module")
def galaxies():
    """Two galaxies of the model, alike but for the dust's alpha."""
    rows = {"redshift": [0.8, 0.8], "mass": [1e10, 1e10], "tau": [1.0, 1.0], "age": [1.0, 1.0]}
    rows |= {"ebv": [0.4, 0.4], "alpha": ALPHA}
    fluxes = SEDModel.yang2021(agn=False).fluxes(QTable(rows), [*SHORT, *LONG])
    sky = SkyCoord([53.1, 53.101] * u.deg, [-27.8, -27.8] * u.deg)
    light = {name: fluxes[name] for name in (*SHORT, *LONG)}
    return catalog_at(sky, redshift=0.8, mag_f160w=20.0, **light)


def do_inputs(config, folder, *first):
    """The stages up to the truth."""
    for name, unit in (*first, ("seds", ""), ("truth", "agn00")):
        do_stage(config, folder, name, unit)
    return QTable.read(folder / "agn00" / "truth.ecsv")


def run(folder, table, **sed):
    """The first stages; returns the fit of the inputs, their truth and what the report says."""
    table.write(folder / "mine.ecsv")
    sections = {"catalog": {"source": str(folder / "mine.ecsv")}, "fit": {"model_error": 0.02}}
    config = StudyConfig.from_dict({**sections, "sed": sed})
    truth = do_inputs(config, folder, ("catalog", ""))
    facts = dict(catalog_facts(config, check_catalog(table)))
    told = f"{facts['input SEDs fitted to']}; {facts['fitted in the end']}"
    return FitResults.read(folder / "input_seds.fits"), truth, told


def test_without_errors_short_bands_get_five_percent(galaxies, tmp_path):
    results, truth, told = run(tmp_path, galaxies.copy())
    assert list(results.filters) == SHORT
    assert_allclose(results.flux_err, 0.05 * results.flux)
    assert "mips.24" not in told.split(";")[0]
    assert "5 % error each, for the catalog gives none" in told
    # drawn, each its own
    assert np.all((truth["alpha"] >= 1.5) & (truth["alpha"] <= 2.5))
    assert truth["alpha"][0] != truth["alpha"][1]


def test_a_long_catalog_is_fitted_in_pieces_to_the_same_truth(galaxies, tmp_path, monkeypatch):
    table = galaxies[[0, 1, 0]]
    table["id"], table["redshift"] = [1, 2, 3], [0.8, 0.3, 1.7]
    table.write(tmp_path / "mine.ecsv")
    config = StudyConfig.from_dict({"catalog": {"source": str(tmp_path / "mine.ecsv")}})
    seds, truths = STAGES["seds"], {}
    for size, pieces in ((3, [""]), (2, ["0000", "0001"])):
        folder = tmp_path / str(size)
        monkeypatch.setattr("miricigale.workflow.stages.inputs.LONG", size)
        monkeypatch.setattr("miricigale.workflow.engine.stage.LONG", size)
        StudyRunner(config, folder, study_stages, until="truth").run()
        assert list(seds.unit_names(config)) == pieces
        truths[size] = QTable.read(next(folder.glob("agn00/truth.*")))
    assert sorted(folder.glob("input_seds*")) == [
        folder / "input_seds_0000.fits",
        folder / "input_seds_0001.fits",
    ]
    for name in ("id", "redshift", "mass", "age", "tau", "ebv", "alpha", "miri.f770w"):
        assert_array_equal(truths[2][name], truths[3][name])


def test_the_catalogs_own_errors_are_used_beyond_three_micron_too(galaxies, tmp_path):
    table = galaxies.copy()
    for k, name in enumerate((*SHORT[:2], *LONG)):
        table[f"{name}_err"] = (0.01 + 0.01 * k) * table[name]
    results, truth, told = run(tmp_path, table)
    assert list(results.filters) == [*SHORT, *LONG]
    wanted = np.array([0.01, 0.02, 0.05, 0.03])
    assert_allclose(results.flux_err / results.flux, [wanted, wanted], rtol=1e-6)
    assert "the catalog's errors in nircam.f090w, nircam.f150w, mips.24; 5 % error each" in told
    assert "alpha is fitted too" in told
    # 24 um shows the dust: alpha is that of the fit, and the flux comes back
    assert_array_equal(truth["alpha"], ALPHA)


def test_the_fit_has_the_bands_errors_and_gaps_of_the_catalog(galaxies, tmp_path):
    """Source by source; what has no flux has none in the fit, and other draws have the same errors."""
    table = galaxies[[0, 1, 0, 1] * 50]
    table["id"] = np.arange(200)
    offsets = 20 * np.array(np.divmod(np.arange(200), 20)) * u.arcsec
    table["sky"] = galaxies["sky"][0].spherical_offsets_by(*offsets)
    for name in (*SHORT, *LONG):
        table[name] = 0.1 * table[name]
    table["nircam.f090w_err"] = np.linspace(0.01, 0.2, 200) * table["nircam.f090w"]
    table["nircam.f150w_err"] = np.where(np.arange(200) % 4, 0.1, -1.0) * table["nircam.f150w"]
    table["nircam.f200w"][7] = np.nan
    _, truth, told = run(tmp_path, table)
    config = StudyConfig.from_dict({"catalog": {"source": str(tmp_path / "mine.ecsv")}})
    matched = QTable({"selection": np.zeros(200, int)})
    for name in (*config.exposures.filters,):
        matched[name] = matched[f"{name}_err"] = np.ones(200) * u.uJy
    mock = mock_photometry(config, truth, matched, seed=1)
    assert list(existing_bands(config)) == [*SHORT, *LONG]
    assert_allclose(mock["nircam.f090w_err"], table["nircam.f090w_err"])
    pull = (mock["nircam.f090w"] - truth["nircam.f090w"]) / table["nircam.f090w_err"]
    assert np.std(pull.value) == pytest.approx(1, abs=0.15)
    assert np.isnan(mock["nircam.f150w"]).nonzero()[0].tolist() == list(range(0, 200, 4))
    assert np.isnan(mock["nircam.f200w"]).nonzero()[0].tolist() == [7]
    assert_allclose(mock["mips.24_err"], 0.05 * table["mips.24"])
    assert "4 existing bands, with the errors of each source in the catalog" in told


def test_a_flux_whose_error_is_not_positive_is_left_out(galaxies, tmp_path):
    table = galaxies.copy()
    table["nircam.f200w_err"] = [-1, 0.01] * table["nircam.f200w"]
    assert run(tmp_path, table)[0].n_bands.tolist() == [2, 3]


def test_new_errors_make_other_inputs(galaxies, tmp_path):
    nothing = SimpleNamespace(checksums=lambda name: {})

    def digest(name, table):
        path = tmp_path / f"{name}.ecsv"
        table.write(path)
        config = StudyConfig.from_dict({"catalog": {"source": str(path)}})
        runner = StudyRunner(config, tmp_path, study_stages)
        return runner.digest("seds", nothing)

    table = galaxies.copy()
    table["nircam.f200w_err"] = 0.01 * table["nircam.f200w"]
    first, second = digest("plain", galaxies), digest("again", galaxies)
    assert first == second != digest("errors", table)


def test_no_band_is_refused(galaxies, tmp_path):
    text, options = "leaves none of the catalog's bands", {"max_wavelength": 0.5}
    refuses(text, run, tmp_path, galaxies.copy(), error=ConfigError, **options)
    # nor is a map without pairs
    for key in ("columns", "units"):
        text, values = rf"\[catalog\] {key} must have the form 'name=value'", {key: ["redshift"]}
        refuses(text, StudyConfig.from_dict, {"catalog": values}, error=ConfigError)


def test_a_catalog_of_ones_own_by_a_map_of_columns(galaxies, tmp_path):
    # the prior's band alone, in mJy and under other names; -99 stands for what is missing
    rows = ["ID,ra,dec,zphot,F_H,profile,half_light_radius,sersic_index,axis_ratio,position_angle"]
    flux = [0.01, 0.02, 0.03, -99.0]
    rest = "point,0,1,1,0"
    rows += [f"{k},53.1{k},-27.8,0.8,{value},{rest}" for k, value in enumerate(flux, start=1)]
    path = tmp_path / "mine.csv"
    path.write_text("\n".join(rows) + "\n")
    columns = ["id=ID", "redshift=zphot", "wfc3.f160w=F_H"]
    options = {"source": str(path), "columns": columns, "mag_limit": 21.0}
    options["units"] = ["flux=mJy", "half_light_radius=arcsec"]
    config = StudyConfig.from_dict({"catalog": options, "sed": {"axes": "quick"}})
    with (
        pytest.warns(MiricigaleWarning, match="1 of 4 sources have no usable flux"),
        pytest.warns(MiricigaleWarning, match=r"taken as missing, .* 1 of 4 \(-99\)"),
    ):
        do_stage(config, tmp_path, "catalog")
    truth = do_inputs(config, tmp_path)
    # 23.9 - 2.5 log(10) = 21.4 is below the limit; the source without a flux stays, and has none
    assert list(truth["id"]) == [2, 3, 4]
    assert_allclose(truth["wfc3.f160w"].value[:2], [20, 30], rtol=1e-6)
    assert np.isnan(truth["wfc3.f160w"][2])
    assert np.isnan(truth["miri.f770w"][2])
    # one band gives every galaxy light in all others
    assert np.all(truth["miri.f770w"][:2] > 0)


def test_magnitudes_and_text_ids_give_the_inputs_of_the_fluxes(galaxies, tmp_path):
    """A VOTable in AB magnitudes with ids of text: the same truth, and 99 is missing and flagged."""
    table = Table({"name": ["a-1", "a-2"], "z": galaxies["redshift"]})
    table["RA"], table["DEC"] = galaxies["sky"].ra.deg, galaxies["sky"].dec.deg
    columns = ["id=name", "redshift=z", "ra=RA", "dec=DEC"]
    for k, name in enumerate(SHORT):
        table[f"m{k}"] = galaxies[name].to_value(u.ABmag)
        table[f"dm{k}"] = np.full(2, 0.05)
        columns += [f"{name}=m{k}", f"{name}_err=dm{k}"]
    table["m2"][1], table["mag_f160w"] = 99.0, galaxies["mag_f160w"]
    table.write(tmp_path / "mine.xml", format="votable")
    options = {"source": str(tmp_path / "mine.xml"), "columns": columns, "units": ["flux=ABmag"]}
    config = StudyConfig.from_dict({"catalog": options, "sed": {"axes": "quick"}})
    with (
        pytest.warns(MiricigaleWarning, match=r"nircam\.f200w 1 of 2 \(99\)"),
        pytest.warns(MiricigaleWarning, match="2 of 2 sources are points"),
    ):
        do_stage(config, tmp_path, "catalog")
    truth = do_inputs(config, tmp_path)
    catalog = QTable.read(tmp_path / "catalog.ecsv")
    assert catalog["flags"].tolist() == [0, CatalogFlags.MISSING_CODE]
    assert_allclose(catalog[SHORT[0]].value, galaxies[SHORT[0]].value)
    results = FitResults.read(tmp_path / "input_seds.fits")
    assert results.ids.tolist() == ["a-1", "a-2"]
    assert results.n_bands.tolist() == [3, 2]
    wanted = 0.05 * np.log(10) / 2.5 * np.where(np.isnan(results.flux), np.nan, 1)
    assert_allclose(results.flux_err / results.flux, wanted)
    assert truth["id"].tolist() == ["a-1", "a-2"]


def test_sources_without_redshift_and_outside_of_the_grid_are_told_apart(galaxies):
    redshift, star = [1.0, np.nan, 0.0, 9.0, np.nan], [False] * 4 + [True]
    matched = QTable({"matched": np.ones(5, bool), "b_true": np.ones(5) * u.uJy})
    matched["b"], matched["b_err"] = matched["b_true"], 0.1 * matched["b_true"]
    truth = QTable({"redshift": redshift, "star": star})
    options = {"inside": np.ones(5, bool), "min_detected": 1, "redshifts": np.array([0.01, 6.0])}
    add_selection(matched, truth, ["b"], **options)
    none = SampleFlags.NO_REDSHIFT
    assert matched["selection"].tolist() == [
        0,
        none,
        none,
        SampleFlags.OUTSIDE_GRID,
        SampleFlags.STAR,
    ]
    table = galaxies.copy()
    table["redshift"] = [1.0, -99.0]
    facts = catalog_facts(StudyConfig(), check_catalog(table))
    assert facts["galaxies without redshift"].startswith("1: without a model SED")
    assert facts["dust colors"].startswith("drawn from CEERS' distribution, measured on")


def test_cuts_leave_out_galaxies_by_their_reasons():
    truth = QTable({"redshift": [0.1, 1.0, 1.0, 1.0, 0.1], "star": [False] * 4 + [True]})
    truth["stellar_mass"] = [1e9, 1e6, 1e9, np.nan, 1e6] * u.Msun
    catalog = QTable({"redshift_source": ["spec", "spec", "phot", "spec", "star"]})
    catalog["q_z"] = np.ma.masked_equal([1, 2, 3, -1, 9], -1)
    chi2, none = np.array([1.0, 9.0, 1.0, np.nan, 9.0]), FitSection()
    assert cut_flags(none, catalog, truth, chi2).tolist() == [0] * 5
    rules = ("redshift_source = spec", "q_z<=3")
    cuts = FitSection(min_redshift=0.2, min_mass=1e8, max_chi2=5.0, redshift_quality=rules)
    flags = cut_flags(cuts, catalog, truth, chi2)
    names = [SampleFlags.names(flag) for flag in flags]
    # without a quality a redshift is no good one; nothing is said of stars
    assert names == [
        ["min_redshift"], ["min_mass", "max_chi2"], ["redshift_quality"], ["redshift_quality"], [],
    ]  # fmt: skip
    assert good_redshifts(catalog, ["q_z=2"]).tolist() == [False, True, False, False, False]
    for rule in ("q_z", "nope=1", "redshift_source<3", "q_z<=low"):
        refuses("redshift_quality", good_redshifts, catalog, [rule], error=ConfigError)
