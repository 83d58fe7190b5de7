import numpy as np
import pytest
from astropy import units as u

from helpers.errors import refuses
from miricigale import conf
from miricigale.refdata import resource
from miricigale.refdata.libraries import LibraryTable, add_library, write_library
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import DataError, ModelWarning


@pytest.fixture
def folder(tmp_path):
    with conf.set_temp("data_folder", str(tmp_path)):
        yield tmp_path


def names(model):
    return {c.role: c.name for c in model.components}


def test_bundled_tables_where_nothing_is_registered(folder):
    model = SEDModel.yang2021()
    assert names(model)["stellar"] == "bc03"
    assert names(model)["dust"] == "dl07_alpha"
    assert names(model)["agn"] == "parametric_torus"
    assert all("is not registered" in note for note in model.meta["libraries"])
    assert set(model.resources) == {"ssp.bc03", "dust.dl07", "torus.parametric"}


def test_registered_dust_is_taken_and_said(folder, data_file):
    add_library("dust.dale2014", data_file("dale2014"))
    model = SEDModel.yang2021()
    assert names(model)["dust"] == "dale2014"
    assert "dust: dust.dale2014" in model.meta["libraries"]
    assert any("Dale" in text for text in model.meta["citations"])
    assert "dust.dale2014" in model.resources
    assert names(SEDModel.yang2021(libraries="bundled"))["dust"] == "dl07_alpha"
    # the paper's grid can be made with it
    axes = SEDModel.yang2021_axes("galaxy") | {"redshift": [1.0]}
    assert model.grid(axes, ["miri.f770w"]).n_galaxies == 560


def test_a_library_without_the_papers_values_is_not_taken_and_why(folder, data_file):
    add_library("torus.skirtor2016", data_file("skirtor2016/SKIRTOR.fits.gz"))
    model = SEDModel.yang2021()
    assert names(model)["agn"] == "parametric_torus"
    (note,) = (text for text in model.meta["libraries"] if text.startswith("torus"))
    assert "torus.skirtor2016 lacks the paper's torus" in note
    assert "q" in note


def test_a_torus_library_with_the_papers_values_is_taken(folder):
    """A complete little library, of a made-up spectrum."""
    wave = np.geomspace(1e-3, 1e3, 132)
    axes = {"tau97": [3.0, 5.0, 7.0, 9.0, 11.0], "p": [1.0], "q": [1.0], "opening_angle": [40.0]}
    axes |= {"radius_ratio": [20.0], "inclination": [0.0, 70.0]}
    rows = np.array(np.meshgrid(*axes.values(), indexing="ij")).reshape(len(axes), -1)
    spectra = {n: np.tile(np.exp(-np.log(wave / x) ** 2) / wave, (rows.shape[1], 1))
               for n, x in (("disk", 0.2), ("dust", 20.0))}  # fmt: skip
    columns = dict(zip(axes, rows, strict=True))
    table = LibraryTable("torus.skirtor2016", wave, columns, spectra)
    write_library(table, folder / resource("torus.skirtor2016").file)
    model = SEDModel.yang2021()
    assert names(model)["agn"] == "skirtor2016"
    got = model.derived(frac_agn=0.5, age=1.0)
    assert got["frac_agn_dust"].value == pytest.approx(0.5)
    refuses(r"'tau97' must be one of 3, 5, 7, 9, 11", model.evaluate, frac_agn=0.5, tau97=4.0)


def test_unknown_choice_and_absent_library_are_refused(folder):
    refuses("'libraries' must be one of", SEDModel.yang2021, libraries="mine")
    parts = [{"name": n} for n in ("delayed", "bc03", "calzetti", "dale2014")]
    model = SEDModel.from_dict({"components": parts})
    refuses(r"data add dust\.dale2014", model.evaluate, error=DataError, age=1.0)


def test_xrays_of_the_paper():
    """L(2-10 keV) = 10^42.5 erg/s at z = 2 is about 1e-16 erg/s/cm2 in the paper's band, halved."""
    model = SEDModel.yang2021(xray=True)
    got = model.derived(frac_agn=0.5, age=1.0, redshift=2.0, mass=1e10)
    scale = 10**42.5 / got["l_2_10kev"].to_value("erg/s")
    assert 0.7e-16 < scale * got["xray_flux"].to_value("erg / (s cm2)") < 1.4e-16


def test_survey_axes_are_those_of_the_chain(folder):
    model, axes = SEDModel.survey(), SEDModel.survey_axes()
    assert names(model)["nebular"] == "nebular"
    assert axes["ebv"][0] == 0
    assert axes["frac_agn"][0] == 0
    assert np.all(np.diff(np.log1p(axes["redshift"])) <= 0.02 + 1e-9)
    few = axes | {"tau": [0.5], "q_pah": [2.0], "redshift": [1.4]}
    grid = model.grid(few, ["wfc3.f160w", "miri.f770w"])
    # seven ages, three bursts, two metallicities and slopes, eight color excesses; two tori of three depths
    assert (grid.n_galaxies, grid.n_agn) == (672, 6)
    assert np.all(grid.galaxy > 0)


@pytest.mark.parametrize("strength", [0.0, 0.2, 1.0])
def test_dust_of_a_survey_emits_what_was_absorbed(strength):
    """Whatever the feature at 3.3 um has: the difference of the starlight is the light of the dust."""
    model = SEDModel.survey(libraries="bundled", agn=False)
    sed = model.evaluate(age=1.0, ebv=0.4, q_pah=4.58, pah_33=strength, redshift=0.0)
    rest = sed.wave.to_value(u.um)
    power = {n: np.trapezoid(x.fnu.value / rest**2, rest) for n, x in sed.components.items()}
    absorbed = power["stellar_intrinsic"] - power["stellar"] - power["nebular"]
    assert power["dust"] == pytest.approx(absorbed, rel=1e-6)


def test_far_infrared_axes_follow_the_cold_dust(folder):
    """Its temperature goes as U^(1/6): a grid of one U_min warns."""
    model, bands = (
        SEDModel.survey(agn=False),
        ["sedpy.herschel_pacs_100", "sedpy.herschel_spire_250"],
    )
    few = {"redshift": [0.5], "ebv": [0.5], "gamma": [0.0], "q_pah": [2.0], "age": [0.5]}
    few = {name: few.get(name, axis) for name, axis in SEDModel.survey_axes("far-infrared").items()}
    few = {name: axis for name, axis in few.items() if name in model.parameters}
    grid = model.grid(few, bands, cache=False)
    ratio = (grid.galaxy[0, :, 0] / grid.galaxy[0, :, 1]).reshape(-1, 4)
    # grains of one temperature, 18 K U^(1/6) (U of 0.5 to 25), change more than a mixture with small ones
    short, long = (
        1.0 / np.expm1(14388 / (wave / 1.5 * 18.0 * np.array([0.5, 25.0]) ** (1 / 6)))
        for wave in (100.0, 250.0)
    )
    cold, warm = short / long
    change = ratio[:, 3] / ratio[:, 0]
    assert np.all(np.diff(ratio, axis=1) > 0)
    assert np.all((change > 5.0) & (change < warm / cold))
    with pytest.warns(ModelWarning, match="'u_min' .* one value, .*herschel_pacs_100"):
        model.grid(few | {"u_min": [1.0]}, bands, cache=False)
    with pytest.raises(ValueError, match="'kind' must be 'survey' or 'far-infrared'"):
        SEDModel.survey_axes("infrared")
