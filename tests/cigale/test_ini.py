import dataclasses
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable, Table
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from helpers.cases import cases_of
from helpers.errors import refuses
from miricigale.cigale import CigaleSetup, fit_cigale, read_cigale_results, write_best_models
from miricigale.cigale import read_pcigale_ini as read
from miricigale.cigale.ini import parse_ini, parse_values
from miricigale.fitting import FitFlags
from miricigale.sed.cosmology import COSMOLOGY
from miricigale.sed.spectrum import SED
from miricigale.utils.exceptions import ConfigError, DataError, MiricigaleWarning

H_KEV = 4.135667696e-18  # h in keV s

INI = Path(__file__).with_name("pcigale.ini").read_text()


def write(folder, *changes, name="pcigale.ini"):
    """Write the configuration with replacements, which must have a place."""
    text = INI
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / name
    path.write_text(text)
    return path


def quiet(path, **options):
    """Read without the warning."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MiricigaleWarning)
        return read(path, libraries="bundled", **options)


# ----------------------------------------------------------------------- the dialect


def test_the_dialect_is_that_of_configobj(tmp_path):
    dialect = cases_of(__file__, "dialect")
    path = tmp_path / "a.ini"
    path.write_text(dialect["text"])
    found = parse_ini(path)
    assert {name: found[name] for name in dialect["wanted"]} == dialect["wanted"]


def test_settings_have_their_types(tmp_path):
    found = parse_ini(write(tmp_path))
    assert found["additionalerror"] == 0.05
    assert found["bands"][:2] == ["hst.wfc3.F160W", "hst.wfc3.F160W_err"]
    assert found["properties"] == []
    analysis = found["analysis_params"]
    assert (analysis["mock_flag"], analysis["redshift_decimals"]) == (True, 1)
    assert analysis["bands"] == ["jwst.miri.F2100W"]


def test_an_expression_needs_no_quotes():
    parted = ["eval np.append(np.linspace(0", "0.8", "3)", "0.99)"]
    assert_allclose(parse_values(parted, "x"), [0, 0.4, 0.8, 0.99])


@pytest.mark.parametrize(("text", "wanted"), cases_of(__file__, "values"))
def test_values(text, wanted):
    assert_allclose(parse_values(text, "x"), wanted, rtol=1e-12)


@pytest.mark.parametrize("text", [*cases_of(__file__, "no_values"), "eval " + "(" * 5000])
def test_nothing_else_is_evaluated(text):
    refuses(r"^'?fracAGN'? ", parse_values, text, "fracAGN")


@pytest.mark.parametrize(("content", "wanted"), cases_of(__file__, "foreign"))
def test_foreign_files_are_refused(tmp_path, content, wanted):
    path = tmp_path / "pcigale.ini"
    path.write_text(content)
    refuses(wanted, read, path, error=DataError)
    refuses("no such file", read, tmp_path / "none.ini", error=DataError)


# --------------------------------------------------------------------------- modules


def test_axes_in_our_units(tmp_path):
    axes = quiet(write(tmp_path)).axes([0.52, 0.48, 1.26, np.nan, -1])
    wanted = {"tau": [0.5, 5.0], "age": [1.0, 5.0], "ebv_lines": [0.5, 1.0], "tau97": [3.0, 7.0]}
    wanted |= {"inclination": [30.0, 70.0], "frac_agn": [0.0, 0.5, 0.9], "redshift": [0.5, 1.3]}
    assert set(axes) == set(wanted)
    for name, values in wanted.items():
        assert_allclose(axes[name], values, rtol=1e-12)


def test_parameters_and_options_of_the_chain(tmp_path):
    setup = quiet(write(tmp_path))
    model = setup.model()
    names = "delayed bc03 nebular modified_starburst dl07 parametric_torus meiksin2006"
    assert [c.name for c in model.components] == names.split()
    defaults = {name: p.default for name, p in model.parameters.items()}
    wanted = {
        "f_burst": 0, "age_burst": 0.02, "tau_burst": 0.05, "separation_age": 10, "log_u": -3,
        "slope": -0.2, "ebv_factor_stars": 0.44, "r_v_gas": 3.1, "uv_bump_wavelength": 0.2175,
        "uv_bump_width": 0.035, "q_pah": 2.5, "u_min": 1, "gamma": 0.1, "q": 0.5,
        "disk_slope": -0.36, "ebv_polar": 0.03, "emissivity_polar": 1.6,
    }  # fmt: skip
    assert {name: defaults[name] for name in wanted} == pytest.approx(wanted, rel=1e-12)
    agn, gas = model.component("agn"), model.component("nebular")
    assert (agn.polar_law, agn.disk) == ("gaskell", "schartmann2005")
    # as the stars have it
    assert (gas.gas, gas.line_width) == ("stellar", 400.0)
    dust = model.component("attenuation")
    assert (dust.gas_law, dust.ebv_scaling) == ("lmc", "cigale")
    assert setup.additional_error == 0.05
    assert (setup.limits, setup.mock, setup.redshift_decimals) == (True, True, 1)
    assert list(setup.bands.items())[2] == ("miri.f770w", "F770W")
    assert setup.predicted == {"miri.f2100w": "jwst.miri.F2100W"}


def test_definition_of_the_fraction_and_flag_of_limits(tmp_path):
    known = {"0/0": "dust", "3/1000": "3-1000um", "3.0 / 1000.": "3-1000um", "5/20": "5-20um"}
    for text, definition in (known | {"0.01/20": "dust"}).items():
        setup = quiet(write(tmp_path, ("lambda_fracAGN = 0/0", f"lambda_fracAGN = {text}")))
        assert setup.model().frac_agn_definition == definition
        replaced = any(f"lambda_fracAGN = {text}" in x for x in setup.replaced)
        assert replaced == (text not in known)
    for flag, wanted in {"True": True, "full": True, "False": False, "none": False}.items():
        path = write(tmp_path, ("lim_flag = noscaling", f"lim_flag = {flag}"))
        assert quiet(path).limits is wanted


def test_other_modules(tmp_path):
    modules = "sed_modules = sfh2exp, bc03, dustatt_modified_CF00, casey2012, redshifting"
    old = next(line for line in INI.splitlines() if line.startswith("sed_modules"))
    path = write(
        tmp_path,
        (old, modules),
        ("[analysis_params]\n", cases_of(__file__, "other_modules")),
        ("redshift =\n", 'redshift = "eval np.linspace(0.5, 1, 3)"\n'),
        ("agn.fracAGN, ", ""),
        ("sfh.age_main", "sfh.age"),
    )
    # nothing is left out or replaced
    with pytest.warns(MiricigaleWarning, match="differs: Chabrier IMF: Kroupa"):
        setup = read(path, strict=True)
    names = [c.name for c in setup.components]
    assert names == ["double_exponential", "bc03", "charlot_fall", "casey2012", "meiksin2006"]
    axes = setup.axes()
    assert_allclose(axes["age_burst"], [0.02, 0.04])
    assert_allclose(axes["f_burst"], [0.01, 0.1])
    assert_allclose(axes["av_ism"], [0.5, 1.0])
    assert_allclose(axes["alpha_mir"], [2.0, 2.5])
    assert_allclose(axes["redshift"], [0.5, 0.75, 1.0])
    assert not setup.model().has_agn
    assert setup.variables == ("stellar.m_star", "sfh.sfr10Myrs", "sfh.age", "dust.luminosity")


def test_history_from_a_file(tmp_path):
    rows = "\n".join(f"{t} {2.0 if t < 50 else 0.0} 1.0" for t in range(100))
    (tmp_path / "history.txt").write_text(f"# time burst steady\n{rows}\n")
    modules = "sed_modules = sfhdelayed", "sed_modules = sfhfromfile"
    section = "[analysis_params]\n", cases_of(__file__, "history_from_a_file")
    setup = quiet(write(tmp_path, section, modules))
    assert_array_equal(setup.parameters["sfh_index"], [0, 1])
    sfh = setup.components[0]
    rate = sfh.history({"age": 0.1, "sfh_index": 0})
    # one solar mass in the first 50 Myr
    assert_allclose(rate[:50], 1 / 50e6)
    assert_allclose(rate[50:], 0.0)


def test_an_age_of_older_versions_is_that_of_the_main_population(tmp_path):
    path = write(tmp_path, ("age_main = 5000, 1000", "age = 5000, 1000"))
    assert_allclose(quiet(path).parameters["age"], [1.0, 5.0])


def test_defaults_and_parameters_without_a_part_are_reported(tmp_path):
    more = write(tmp_path, ("normalise = True", "normalise = True\n    color = 3"))
    assert "sfhdelayed.color" in quiet(more).left_out
    without = write(tmp_path, ("    delta = -0.36\n", ""))
    assert "skirtor2016: not in the file, the defaults here: delta = 0" in quiet(without).differs
    # the nearest bound is taken, and named
    beyond = write(tmp_path, ("metallicity = 0.02", "metallicity = -1 , -2"))
    assert any("metallicity" in x for x in quiet(beyond).replaced)


def test_a_run_with_a_filter_of_the_user(tmp_path):
    curve = tmp_path / "mine.dat"
    curve.write_text("70000 0\n71000 1\n82000 1\n83000 0\n")
    path = write(tmp_path, ("F770W, F770W_err", "AKARI_S7, AKARI_S7_err"))
    with pytest.warns(MiricigaleWarning, match=r"band AKARI_S7 \(no filter here: names="):
        read(path, libraries="bundled")
    setup = quiet(path, names={"AKARI_S7": str(curve)})
    assert setup.bands["AKARI_S7"] == "AKARI_S7"
    refuses(r"none\.dat", quiet, path, error=DataError, names={"AKARI_S7": "none.dat"})
    table = QTable(ROWS)
    fluxes = setup.model().fluxes(table, setup.filters())
    values = {band: fluxes[name].to_value(u.mJy) for name, band in setup.bands.items()}
    write_catalog(tmp_path / "galaxies.txt", ROWS["redshift"], values, values)
    results = fit_cigale(setup, output=tmp_path / "results.fits")
    assert_allclose(results.chi2, 0.0, atol=1e-6)
    written = read_cigale_results(tmp_path / "results.fits")
    assert_allclose(written["best.AKARI_S7"].to(u.uJy), fluxes["AKARI_S7"].to(u.uJy), rtol=1e-5)


def test_one_message_names_all_that_is_left_out(tmp_path):
    path = write(
        tmp_path,
        ("skirtor2016, redshifting", "skirtor2016, radio, restframe_parameters, redshifting"),
        ("IRAC1, IRAC1_err", "IRAC1, IRAC1_err, VLA_L, VLA_L_err, line.OII, line.OII_err"),
        ("variables = ", "variables = radio.qir, "),
        ("fracAGN = 0.0, 0.5, 0.9", "fracAGN = 0.5, 1.0"),
        ("law = 2", "law = 0, 2"),
        ("zgas = 0.02", "zgas = 0.014"),
    )
    with pytest.warns(MiricigaleWarning) as record:
        setup = read(path, libraries="bundled")
    assert len(record) == 1
    left, replaced, differs = str(record[0].message).splitlines()[1:]
    names = ("module radio", "module restframe_parameters", "band VLA_L", "band line.OII")
    for text in (*names, "variable radio.qir", "skirtor2016.fracAGN = 1 (not", "law = 2"):
        assert text in left
    assert "nebular.zgas = 0.014 by 0.02" in replaced
    assert "skirtor2016 by parametric_torus" in replaced
    assert "Chabrier IMF: Kroupa" in differs
    # and the rest is there
    assert setup.model().has_agn
    assert list(setup.bands.values()) == ["hst.wfc3.F160W", "IRAC1", "F770W", "MIPS1"]
    assert "agn.fracAGN" in setup.variables
    strict = {"libraries": "bundled", "strict": True}
    refuses(r"(?s)module radio.*parametric_torus", read, path, error=ConfigError, **strict)


@pytest.mark.parametrize(("old", "new", "wanted"), cases_of(__file__, "refused"))
def test_refused(tmp_path, old, new, wanted):
    path = write(tmp_path, (old, new))
    with pytest.raises(ConfigError, match=wanted) as error:
        quiet(path)
    assert str(path) in str(error.value)


def test_rounding_of_redshifts(tmp_path):
    setup = quiet(write(tmp_path))
    z = setup.rounded([0.04, 0.06, 1.25, 1.251, 0.0, -1.0, np.nan])
    assert_allclose(z, [0.04, 0.1, 1.2, 1.3, 0.0, np.nan, np.nan])
    exact = quiet(write(tmp_path, ("redshift_decimals = 1", "redshift_decimals = -1")))
    assert_array_equal(exact.rounded([0.1234, 2.5]), [0.1234, 2.5])
    refuses("redshifts", setup.axes)
    refuses("redshifts", setup.axes, [np.nan])


# ------------------------------------------------------------------------- whole runs


def models(setup, rows):
    """Photometry in mJy of models on nodes of the grid, by CIGALE's names."""
    table = QTable(rows)
    every = setup.bands | setup.predicted
    fluxes = setup.model().fluxes(table, list(every))
    return {band: fluxes[name].to_value(u.mJy) for name, band in every.items()}, fluxes


def write_catalog(path, redshift, fluxes, bands, error=0.01, **more):
    """Write fluxes with errors of 1 %, and more columns."""
    columns = {"id": [f"g{i}" for i in range(len(redshift))], "redshift": redshift} | more
    for band in bands:
        columns[band], columns[f"{band}_err"] = fluxes[band], error * np.asarray(fluxes[band])
    Table(columns).write(path, format="ascii.commented_header", overwrite=True)


ROWS = cases_of(__file__, "rows")


def nearer(redshift, node):
    """Luminosity at a redshift over that at a node, for the same flux: (d / d_node)^2 (1 + z_node) / (1 + z)."""
    d = [COSMOLOGY.luminosity_distance(z).value for z in (redshift, node)]
    return (d[0] / d[1]) ** 2 * (1 + np.array(node)) / (1 + np.array(redshift))


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    """Photometry of three models, and all that is known of them."""
    return models(quiet(write(tmp_path_factory.mktemp("three"))), ROWS)


@pytest.fixture
def run(three, tmp_path):
    """Three models, written as CIGALE's files."""
    path, near = write(tmp_path), [0.52, 1.26, 0.5]
    # redshifts that round to the models'
    write_catalog(tmp_path / "galaxies.txt", near, three[0], quiet(path).bands.values())
    return path, *three


def test_a_run_gives_the_models_back(run, tmp_path):
    path, fluxes, truth = run
    out = tmp_path / "results.fits"
    setup = quiet(path)
    results = fit_cigale(setup, output=out)
    assert isinstance(setup, CigaleSetup)
    assert results.meta["cigale"]["modules"]["agn"] == "skirtor2016"
    assert_allclose(results.chi2, 0.0, atol=1e-6)
    table = read_cigale_results(out)
    assert table["id"].tolist() == ["g0", "g1", "g2"]
    factor = nearer([0.52, 1.26, 0.5], [0.5, 1.3, 0.5])
    best = {
        "sfh.tau_main": ([500, 5000, 500], "Myr"),
        "sfh.age_main": ([5000, 1000, 1000], "Myr"),
        "sfh.integrated": (factor * [1e10, 3e10, 1e11], "Msun"),
        "sfh.age_burst": ([20] * 3, "Myr"),
        "stellar.old_young_separation_age": ([10] * 3, "Myr"),
        "attenuation.E_BV_lines": ([0.5, 1.0, 0.5], "mag"),
        "attenuation.uv_bump_wavelength": ([217.5] * 3, "nm"),
        # the models are at 0.5, 1.3 and 0.5
        "universe.redshift": ([0.52, 1.26, 0.5], ""),
        "agn.fracAGN": ([0.5, 0.0, 0.9], ""),
        "agn.t": ([7, np.nan, 7], ""),
        "agn.i": ([30, np.nan, 70], "deg"),
        "dust.umin": ([1] * 3, ""),
    }
    for name, unit, theirs in (
        ("stellar_mass", "Msun", "stellar.m_star"),
        ("dust_luminosity", "W", "dust.luminosity"),
        ("sfr_10myr", "Msun/yr", "sfh.sfr10Myrs"),
        ("accretion_power", "W", "agn.accretion_power"),
    ):
        best[theirs] = (factor * truth[name].to_value(unit), unit)
    best |= {band: (values, "mJy") for band, values in fluxes.items()}
    for name, (values, unit) in best.items():
        got = u.Quantity(table[f"best.{name}"])
        assert got.unit == u.Unit(unit), name
        assert_allclose(got.value, values, rtol=1e-5, err_msg=name)
    # the quantities asked for have means and errors, others have not
    wanted = {"agn.fracAGN", "stellar.m_star", "sfh.sfr10Myrs", "sfh.age_main", "dust.luminosity"}
    have = {c[6:] for c in table.colnames if c.startswith("bayes.") and not c.endswith("_err")}
    assert have - set(fluxes) == wanted
    for name in wanted:
        assert np.all(u.Quantity(table[f"bayes.{name}_err"]).value >= 0)
    assert_allclose(table["best.reduced_chi_square"], table["best.chi_square"] / 3, atol=1e-12)


def test_one_redshift_and_a_distance_of_its_own(run, tmp_path):
    """An object at 20 Mpc has (20 Mpc / d(z))^2 of the luminosity; its spectrum is drawn as it was fitted."""
    path, fluxes, _ = run
    setup = quiet(path)
    catalog = tmp_path / "galaxies.txt"
    first = {name: values[[0, 0]] for name, values in fluxes.items()}
    write_catalog(catalog, [0.52] * 2, first, setup.bands.values(), distance=[20, np.nan])
    results = fit_cigale(setup, output=tmp_path / "results.fits")
    far = COSMOLOGY.luminosity_distance(0.52).value
    mass = results.best["mass"].to_value(u.Msun)
    assert_allclose(mass, 1e10 * nearer(0.52, 0.5) * np.array([(20 / far) ** 2, 1]), rtol=1e-5)
    share = results.std("stellar_mass") / results.mean("stellar_mass")
    assert_allclose(share, share[::-1])
    table = read_cigale_results(tmp_path / "results.fits")
    assert_allclose(table["best.universe.redshift"], 0.52)
    assert_allclose(table["best.IRAC1"].value, fluxes["IRAC1"][0], rtol=1e-5)
    # the shape is that of z = 0.5: bands are the same to what 1.3 % in wavelength makes
    drawn = setup.filters().synthetic_fluxes(results[1].best_sed())
    assert_allclose(drawn.value, results[1].best_flux, rtol=0.06)
    # one photometry, one spectrum: the nearer object has the smaller mass, and the results as a file know it
    results.write(tmp_path / "fit.fits")
    near = type(results).read(tmp_path / "fit.fits")[0]
    assert_allclose(near.best_sed(results.model).fnu, results[1].best_sed().fnu, rtol=1e-6)
    paths = write_best_models(results, tmp_path / "best")
    # files that stand are replaced only if asked, and no id is a file elsewhere
    refuses("already exists", write_best_models, results, tmp_path / "best", error=OSError)
    text = "'output' must be a new file"
    refuses(text, fit_cigale, "absent.ini", output=tmp_path / "results.fits", error=ValueError)
    evil = dataclasses.replace(results, ids=np.array(["../evil", "b"]))
    refuses("of ids that name files .* got '../evil'", write_best_models, evil, tmp_path / "best")
    assert_allclose(*(Table.read(path)["Fnu"] for path in paths), rtol=1e-6)
    # at another redshift the object is at the distance of that
    there = near.best_sed(results.model, redshift=0.4)
    assert_allclose(there.fnu, results[1].best_sed(redshift=0.4, mass=mass[0]).fnu)


def test_parts_of_the_agn_have_posteriors(run, tmp_path):
    """Disk, torus and polar dust of one watt of dust emission: the disk is what the AGN has beyond it."""
    parts = [f"agn.{name}" for name in ("disk_luminosity", "torus_dust_luminosity", "luminosity")]
    parts += ["agn.polar_dust_luminosity", "agn.total_dust_luminosity"]
    setup = quiet(write(tmp_path, ("agn.fracAGN, stellar.m_star", ", ".join(parts))))
    assert not any("agn." in text for text in setup.left_out)
    fit_cigale(setup, output=tmp_path / "r.fits", best_models=tmp_path / "best")
    table = read_cigale_results(tmp_path / "r.fits")
    for kind in ("bayes", "best"):
        disk, torus, whole, polar, dust = (table[f"{kind}.{name}"].to_value(u.W) for name in parts)
        assert_allclose(torus + polar, dust, rtol=1e-6)
        assert_allclose(dust + disk, whole, rtol=1e-6)
    assert np.all(np.isfinite(table["bayes.agn.disk_luminosity_err"].value))
    # the files of the best models say the same, and their parts sum up
    names = sorted(path.name for path in (tmp_path / "best").iterdir())
    assert names == [f"g{i}_best_model.fits" for i in range(3)]
    with fits.open(tmp_path / "best" / "g0_best_model.fits") as hdus:
        header, rows = dict(hdus[1].header), hdus[1].data
    assert header["agn.disk_luminosity"] == pytest.approx(disk[0], rel=1e-3)
    assert header["universe.redshift"] == pytest.approx(0.52)
    total = rows["L_lambda_total"]
    assert_allclose(sum(rows[name] for name in rows.names[3:]), total, rtol=1e-9)
    # what the galaxy's dust sends out is what was taken from stars and gas
    taken = sum(rows[name] for name in rows.names if name.startswith("att"))
    sent, taken = (np.trapezoid(light, rows["wavelength"]) for light in (rows["dust"], taken))
    assert sent == pytest.approx(-taken, rel=1e-3)
    f160w = setup.filters()["wfc3.f160w"]
    sed = SED(rows["wavelength"] * u.nm, rows["Fnu"] * u.mJy)
    drawn = f160w.synthetic_flux(sed).to_value(u.mJy)
    assert drawn == pytest.approx(table["best.hst.wfc3.F160W"][0].value, rel=0.05)


def test_all_models_are_saved(tmp_path):
    fractions = "fracAGN = 0.0, 0.5, 0.9", "fracAGN = 0.0, 0.5"
    path = write(tmp_path, ("pdf_analysis", "savefluxes"), fractions)
    setup = quiet(path)
    refuses(r"savefluxes: CigaleSetup.save_models", fit_cigale, setup, error=ConfigError)
    table = setup.save_models(tmp_path / "models-block-0.fits", [0.5])
    # 2 tau x 2 ages x 2 E(B-V) x 2 tau97 x 2 inclinations x 2 fractions
    assert len(table) == 64
    again = QTable.read(tmp_path / "models-block-0.fits")
    values = {
        "tau": 5.0, "age": 1.0, "ebv_lines": 1.0, "tau97": 3.0, "inclination": 70.0, "frac_agn": 0.5,
    }  # fmt: skip
    names = ("sfh.tau_main", "sfh.age_main", "attenuation.E_BV_lines", "agn.t", "agn.i")
    theirs = dict(zip((*names, "agn.fracAGN"), (5000, 1000, 1.0, 3, 70, 0.5), strict=True))
    same = [again[name].value == value for name, value in theirs.items()]
    (row,) = np.flatnonzero(np.all(same, axis=0))
    sed = setup.model().evaluate(**values, redshift=0.5, mass=1.0)
    wanted = setup.filters()["irac.ch1"].synthetic_flux(sed).value
    assert_allclose(again["IRAC1"][row].to_value(u.uJy), wanted, rtol=1e-5)
    refuses("overwrite", setup.save_models, tmp_path / "models-block-0.fits", [0.5], error=OSError)


def test_text_and_fits_say_the_same(run, tmp_path):
    setup = quiet(run[0])
    results = fit_cigale(setup)
    for name in ("results.fits", "results.txt"):
        setup.write_results(results, tmp_path / name)
        refuses("overwrite", setup.write_results, results, tmp_path / name, error=OSError)
    one, two = (read_cigale_results(tmp_path / f"results.{x}") for x in ("fits", "txt"))
    assert one.colnames == two.colnames
    for name in one.colnames:
        if name != "id":
            assert u.Quantity(one[name]).unit == u.Quantity(two[name]).unit, name
            assert_allclose(u.Quantity(one[name]).value, u.Quantity(two[name]).value, rtol=1e-12)
    # what was replaced stands in both
    header = " ".join(fits.getheader(tmp_path / "results.fits", 1)["COMMENT"])
    head = (tmp_path / "results.txt").read_text().partition(" id ")[0]
    for text in (header, head):
        assert "skirtor2016 by parametric_torus" in text
        assert "1 no band" in text
    assert one["flags"].tolist() == results.flags.tolist()
    (tmp_path / "x.txt").write_text("id b\n1 2\n")
    refuses(r"no column best.chi_square", read_cigale_results, tmp_path / "x.txt", error=DataError)


def test_known_and_unknown_redshifts(run, tmp_path):
    path, fluxes, _ = run
    digits = "redshift_decimals = 1", "redshift_decimals = 2"
    path = write(tmp_path, ("redshift =\n", "redshift = 0.5, 0.9, 1.3\n"), digits)
    setup = quiet(path)
    # the first is known, to the nearest node; the second is not; the third is at a wrong one
    catalog = tmp_path / "galaxies.txt"
    write_catalog(catalog, [0.61, -1, 2.0], fluxes, setup.bands.values())
    results = fit_cigale(setup)
    # masses are those of the objects' own redshifts
    assert_allclose(results.best["redshift"], [0.61, 1.3, 2.0])
    assert_allclose(results.best["mass"][:2].value, [1e10 * nearer(0.61, 0.5), 3e10], rtol=1e-5)
    assert_allclose(results.chi2[:2], 0.0, atol=1e-6)
    assert results.chi2[2] > 1e-3
    assert_allclose(results.pdf["redshift"][0], [1, 0, 0])
    assert np.all(results.flags & int(FitFlags.NO_REDSHIFT) == 0)


def test_limits_take_part_only_if_asked(run, tmp_path):
    path = run[0]
    lines = (tmp_path / "galaxies.txt").read_text().splitlines()
    words = lines[1].split()
    # the last band of the first object is a limit
    words[-1] = f"-{words[-1]}"
    (tmp_path / "galaxies.txt").write_text("\n".join([lines[0], " ".join(words), *lines[2:]]))
    with pytest.warns(MiricigaleWarning, match="lim_flag noscaling: upper limits act on the scale"):
        setup = read(path, libraries="bundled")
    assert setup.catalog()["mips.24_limit"].tolist() == [True, False, False]
    results = fit_cigale(setup)
    assert results.n_bands.tolist() == [4, 4, 4]
    assert results.n_limits.tolist() == [1, 0, 0]
    # models of the true scale reach the limit, which is 2 ln 2; fainter ones are somewhat better
    assert 0.0 < results.chi2[0] < 2.0 * np.log(2.0)
    full = quiet(write(tmp_path, ("lim_flag = noscaling", "lim_flag = full")))
    assert "lim_flag" not in full.describe()
    assert_array_equal(fit_cigale(full).chi2, results.chi2)
    without = quiet(write(tmp_path, ("lim_flag = noscaling", "lim_flag = none")))
    assert "mips.24_limit" not in without.catalog().colnames
    assert fit_cigale(without).n_bands.tolist() == [3, 4, 4]


def test_the_example_of_cigale(data_file):
    path = data_file("cigale/sdss_qso/pcigale.ini")
    with pytest.warns(MiricigaleWarning) as record:
        setup = read(path, libraries="bundled")
    assert len(record) == 1
    text = str(record[0].message)
    known = "max_dev_alpha_ox: by 2000 draws", "dale2014 by", "skirtor2016 by", "-1.9 to -1.1"
    assert all(name in text for name in known)
    assert "boxcar" not in text
    assert_allclose(setup.parameters["age"], [0.1, 3.0, 5.0])
    assert_allclose(setup.parameters["ebv_polar"], [0, 0.05, 0.1, 0.15, 0.2, 0.3])
    catalog = setup.catalog()
    assert len(catalog) == 1986
    # the first row of the file: 1.673e-02 mJy
    assert_allclose(catalog["sedpy.sdss_u0"][0].value, 16.73)
    results = setup.fit(catalog[:300])
    assert np.all(results.fitted)
    # quasars: red ones are behind dust, and the models describe the most of them
    assert np.median(results.reduced_chi2) < 2
    color = np.log10(catalog["sedpy.sdss_i0"] / catalog["sedpy.sdss_g0"])[:300].value
    dust = results.mean("ebv_polar").value
    assert np.corrcoef(color, dust)[0, 1] > 0.7
    # the relation of Just et al. 2007 (scatter 0.14), above which quasars with X-ray detections lie
    bounded = [apart_from_just(one) for one in (results.mean, results.best.__getitem__)]
    free = dataclasses.replace(setup, max_dev_alpha_ox=0.0).fit(catalog[:300])
    apart = apart_from_just(free.mean)
    assert 0.0 < np.median(apart) < 0.15
    assert np.std(apart) < 0.2
    # the bound of 0.2 holds for every model, and takes evidence from those beyond it
    known = results.flags & FitFlags.OFF_RELATION == 0
    assert np.mean(known) > 0.9
    assert np.all(np.abs(bounded[1][known]) <= 0.2)
    assert np.all(np.abs(bounded[0][known]) < 0.25)
    assert np.all(results.log_evidence[known] <= free.log_evidence[known])
    # others are as they were, and far from it
    assert_array_equal(bounded[0][~known], apart[~known])
    assert np.all(np.abs(apart[~known]) > 0.2)


def posterior_near_just(grid, results, most):
    """Means and standard deviations over all models of a grid, one by one, that keep the bound."""
    shape = (grid.n_galaxies, grid.n_agn, grid.frac_agn.size)
    g, k, f = (x.ravel() for x in np.indices(shape))
    flux = grid.flux(0, g, k, f)
    data, error = np.nan_to_num(results.flux[0]), results.sigma[0]
    scale = (flux * data / error**2).sum(1) / ((flux / error) ** 2).sum(1)
    chi2 = (((data - scale[:, None] * flux) / error) ** 2).sum(1)
    fraction = grid.frac_agn[f]
    power = scale * fraction / (1 - fraction) * grid.dust_luminosity[g]
    light = power * grid.agn_properties["l_2500"].value[k]
    slope = grid.agn_parameters["alpha_ox"].value[k]
    with np.errstate(divide="ignore"):
        apart = np.abs(slope - (-0.137 * np.log10(light * 1e7) + 2.638))
    weight = np.exp(-0.5 * (chi2 - chi2.min())) * ((fraction == 0) | (apart <= most))
    # the fraction of CIGALE's file counts models, of which the AGN's rows may stand for several
    weight *= grid.agn_multiplicity[k] / weight.sum()
    weight /= weight.sum()
    out = {}
    for name, values in (("mass", scale), ("frac_agn", fraction), ("l_2500", light)):
        mean = (weight * values).sum()
        out[name] = mean, np.sqrt((weight * (values - mean) ** 2).sum())
    return out


def apart_from_just(values):
    """How far alpha_ox is from -0.137 log L_nu(2500 A) + 2.638."""
    disk = np.log10(values("l_2500").to_value(u.erg / u.s / u.Hz))
    return values("alpha_ox").value - (-0.137 * disk + 2.638)


XRAY = cases_of(__file__, "xray")


BAND = "xray_boxcar_0p5to2keV"
WITH_BAND = "bands = hst", f"bands = {BAND}, {BAND}_err, hst"


def with_xrays(folder, *changes, module="xray"):
    """Write the configuration with an X-ray band, a module for it, and replacements."""
    more = ("\n  [[redshifting]]", XRAY.replace("xray", module))
    names = ("skirtor2016, redshifting", f"skirtor2016, {module}, redshifting")
    return write(folder, WITH_BAND, names, more, *changes)


def mean_fnu(power_of_energy, z, low=0.5, high=2.0):
    """Mean F_nu in mJy over observed keV of a source of L_E in W/keV."""
    far = COSMOLOGY.luminosity_distance(z).to_value(u.m)
    power = quad(power_of_energy, low * (1 + z), high * (1 + z))[0]
    return power / (4 * np.pi * far**2) / ((high - low) / H_KEV) * 1e29


def corona(alpha_ox, l_2500, inclination):
    """L_E in W/keV of the module's corona: alpha_ox at 30 deg, (1 + cos i) / 2 of that seen at 0 deg."""
    seen = (1 + np.cos(np.radians(inclination))) / (1 + np.cos(np.radians(30)))
    two = 10 ** (alpha_ox / 0.3838) * l_2500 * seen / H_KEV
    return lambda energy: two * (energy / 2) ** -0.7 * np.exp(-(energy - 2) / 200)


def test_x_ray_bands_of_any_name(tmp_path):
    """A band that a user added to CIGALE by a curve is given by its energies."""
    ini = with_xrays(tmp_path, (BAND, "xraybandpass1"))
    setup = quiet(ini, names={"xraybandpass1": BAND})
    assert setup.bands[BAND] == "xraybandpass1"
    assert_allclose(setup.xray_bands()[BAND].to_value(u.keV), [0.5, 2.0])
    with pytest.warns(MiricigaleWarning, match="xraybandpass1 .*'xray_boxcar_0p5to2keV', or"):
        read(ini)
    curve = tmp_path / "xraybandpass1.dat"
    curve.write_text("# xraybandpass1\n# energy\n# 0.5-2 keV\n6.2 1\n24.8 1\n")
    names = {"xraybandpass1": str(curve)}
    refuses("'xray_boxcar_.*, got a curve of X-rays for 'xraybandpass1'", read, ini, names=names)


def test_models_with_x_rays_are_saved(tmp_path):
    """By the name that the module has in later versions: the corona in closed form."""
    setup = quiet(with_xrays(tmp_path, module="yang20"))
    assert not any("yang20" in text for text in (*setup.left_out, *setup.replaced))
    table = setup.save_models(tmp_path / "m.fits", [0.5])
    # 2 tau x 2 ages x 2 E(B-V) x 2 tau97 x 2 inclinations x 3 fractions x 2 slopes
    assert len(table) == 192
    band = table[BAND].to_value(u.mJy)
    fraction = table["agn.fracAGN"].value
    # binaries and gas in closed form: tests/sed/test_xray_bands.py
    names = ("lmxb", "hmxb", "lmxb_index", "hmxb_index", "photon_index")
    assert [setup.xray[name] for name in names] == [0.2, 0.0, 1.56, 2.0, 1.7]
    # what AGN add to the same galaxy
    galaxy = ["sfh.tau_main", "sfh.age_main", "attenuation.E_BV_lines"]
    dim = np.flatnonzero(fraction == 0)
    dark = {tuple(table[name][i].value for name in galaxy): band[i] for i in dim}
    for i in np.flatnonzero(fraction == 0.5)[::7]:
        slope, disk = table["xray.alpha_ox"][i].value, table["agn.intrin_Lnu_2500A_30deg"][i].value
        shape = corona(slope, disk, table["agn.i"][i].value)
        added = band[i] - dark[tuple(table[name][i].value for name in galaxy)]
        assert added == pytest.approx(mean_fnu(shape, 0.5), rel=1e-6, abs=0)
        hard = table["xray.agn_Lx_2to10keV"][i].to_value(u.W)
        assert hard == pytest.approx(quad(shape, 2, 10)[0], rel=1e-6)


def test_best_models_have_x_rays(tmp_path):
    """The spectrum holds the fitted flux, and the corona stands above the disk as alpha_ox says."""
    setup = quiet(with_xrays(tmp_path))
    models = setup.save_models(tmp_path / "m.fits", [0.5])
    some = (models["agn.fracAGN"] == 0.5) & (models["xray.alpha_ox"] == -1.4)
    row = models[np.flatnonzero(some)[3]]
    fluxes = {name: [1e10 * row[name].to_value(u.mJy)] for name in setup.bands.values()}
    write_catalog(tmp_path / "galaxies.txt", [0.5], fluxes, fluxes)
    results = fit_cigale(setup, best_models=tmp_path / "best")
    assert results.chi2[0] < 1e-6
    with fits.open(tmp_path / "best" / "g0_best_model.fits") as hdus:
        header, rows = dict(hdus[1].header), hdus[1].data
    total = rows["L_lambda_total"]
    assert_allclose(sum(rows[name] for name in rows.names[3:]), total, rtol=1e-9)
    energy = 1.2398419843 / rows["wavelength"]  # keV
    inside = np.linspace(0.5, 2.0, 1001)
    drawn = np.trapezoid(np.interp(inside, energy[::-1], rows["Fnu"][::-1]), inside) / 1.5
    assert drawn == pytest.approx(1e10 * row[BAND].to_value(u.mJy), rel=1e-4)
    assert header["xray.alpha_ox"] == -1.4
    shape = corona(-1.4, header["agn.intrin_Lnu_2500A_30deg"], header["agn.i"])
    # per nm of observed wavelength: dE = E / lambda of rest
    rest = energy * 1.5
    wanted = shape(rest) * rest / rows["wavelength"]
    hard = (rest > 1) & (rest < 100)
    assert_allclose(rows["xray.agn"][hard], wanted[hard], rtol=1e-6)
    assert header["xray.agn_Lx_2to10keV"] == pytest.approx(quad(shape, 2, 10)[0], rel=1e-6)
    # nothing of it in the light of stars and dust
    assert np.all(rows["xray.galaxy"][energy < 0.1] == 0)


def test_x_ray_bands_are_fitted_where_there_is_a_module(three, tmp_path):
    setup = quiet(with_xrays(tmp_path))
    assert "xray" not in setup.describe()
    assert setup.xray["alpha_ox"].tolist() == [-1.7, -1.4]
    assert setup.xray["angle_coefficients"] == (0.5, 0.0)
    assert setup.bands[BAND] == BAND
    assert setup.filters().names[0] == BAND
    fluxes, _ = three
    # X-rays of the first model: the mean of the two slopes, -0.15 / 0.3838 dex from either
    catalog = QTable({"id": ["a"], "redshift": [0.5]})
    for name, theirs in setup.bands.items():
        value = fluxes[theirs][0] if theirs in fluxes else 1.0
        catalog[name], catalog[f"{name}_err"] = [value] * u.mJy, [0.01 * value] * u.mJy
    grid = setup.fitter(catalog).grid
    assert grid.filters[-1] == BAND
    assert grid.n_agn % 2 == 0
    bright, faint = (grid.agn[:, i::2, -1] for i in (1, 0))
    assert_allclose(bright / faint, 10 ** (0.3 / 0.3838), rtol=1e-12)
    path = with_xrays(tmp_path, ("0.5 & 0", "0.5"))
    refuses("one pair of numbers", quiet, path, error=ConfigError)
    path = with_xrays(tmp_path, ("= 200", "= 200, 300"))
    assert "xray.E_cut = 300 (one value at a time)" in quiet(path).describe()
    # the bound of the relation, against every model by itself
    path = with_xrays(tmp_path, ("max_dev_alpha_ox = 0", "max_dev_alpha_ox = 0.15"))
    setup = dataclasses.replace(quiet(path), limits=True)
    assert "max_dev_alpha_ox: by 2000 draws" in setup.describe()
    for name, theirs in setup.bands.items():
        value = fluxes[theirs][0] if theirs in fluxes else 1e-6
        catalog[name], catalog[f"{name}_err"] = [value] * u.mJy, [0.4 * value] * u.mJy
    setup = dataclasses.replace(setup, redshift=np.array([0.5]))
    fitter, results = setup.fitter(catalog), setup.fit(catalog)
    # 40 % of the catalog and 5 % of the configuration
    used = np.isfinite(results.sigma)
    assert_allclose(results.sigma[used], np.hypot(0.4, 0.05) * results.flux[used], rtol=1e-6)
    wanted = posterior_near_just(fitter.grid, results, 0.15)
    for name, (mean, std) in wanted.items():
        got = results.mean(name)[0]
        assert got.value == pytest.approx(mean, abs=5 * std / np.sqrt(500)), name
    assert results.log_evidence[0] < fitter.fit(catalog, redshift=[0.5]).log_evidence[0]
    # between nodes the numbers of parameters are those of the same draws as their distributions
    results = setup.fit(catalog, compat=None)
    for name in ("frac_agn", "ebv"):
        if name in results.axes:
            nodes = results.axes[name].values
            cell = np.max(np.diff(nodes))
            assert abs(results.mean(name)[0].value - results.pdf[name][0] @ nodes) < cell
    # without the module the band is left out, and reported
    setup = quiet(write(tmp_path, WITH_BAND))
    assert "band xray_boxcar_0p5to2keV (no module xray)" in setup.describe()
    assert BAND not in setup.bands
