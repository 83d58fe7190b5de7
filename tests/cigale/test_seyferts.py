"""A real run of CIGALE, 117 Seyferts from the ultraviolet to 500 um, against its own results."""

import warnings

import numpy as np
import pytest
from astropy.io import fits
from numpy.testing import assert_allclose

from miricigale import conf
from miricigale.cigale import best_model_table, read_cigale_results, read_pcigale_ini
from miricigale.cigale.names import cigale_names
from miricigale.refdata.libraries import add_library
from miricigale.sed import SEDModel
from miricigale.sed import components as parts
from miricigale.utils.exceptions import MiricigaleWarning

RUN = "cigale_seyferts/group1_0a90"


def numbers(table, name):
    column = table[name]
    return np.ma.filled(np.ma.asarray(getattr(column, "value", column), float), np.nan)


@pytest.fixture(scope="module")
def libraries(data_file, tmp_path_factory):
    """A data folder with Dale 2014 and SKIRTOR."""
    folder = tmp_path_factory.mktemp("libraries")
    with conf.set_temp("data_folder", str(folder)):
        add_library("dust.dale2014", data_file("dale2014/dhcal.dat").parent)
        add_library("torus.skirtor2016", data_file("skirtor2016/SKIRTOR.fits.gz"))
    return folder


@pytest.fixture(scope="module", params=["bundled", "best"])
def tables(request, data_file, libraries, tmp_path_factory):
    """Ours and CIGALE's: with bundled libraries, and with others (q 0 for the run's q 1)."""
    tmp_path = tmp_path_factory.mktemp(request.param)
    text = data_file(f"{RUN}/pcigale.ini").read_text()
    folder = libraries if request.param == "best" else tmp_path / "data"
    with conf.set_temp("data_folder", str(folder)):
        if request.param == "best":
            text = text.replace("    q = 1.0\n", "    q = 0.0\n")
        ini = tmp_path / "pcigale.ini"
        ini.write_text(text)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MiricigaleWarning)
            setup = read_pcigale_ini(ini)
            photometry = setup.catalog(data_file(f"{RUN}/CIGPhot_EnergyBal_1.tbl"))
        stands_in = any("skirtor2016 by" in text for text in setup.replaced)
        assert stands_in == (request.param == "bundled")
        setup.write_results(setup.fit(photometry), tmp_path / "results.fits")
    ours = read_cigale_results(tmp_path / "results.fits")
    theirs = read_cigale_results(data_file(f"{RUN}/results.fits"))
    assert ours["id"].tolist() == theirs["id"].tolist()
    return ours, theirs


def test_medians_are_those_of_cigale(tables):
    """Without IRAS, whose curves are the user's to bring."""
    ours, theirs = tables
    for name in ("stellar.m_star", "sfh.sfr", "dust.luminosity"):
        dex = np.log10(numbers(ours, f"bayes.{name}") / numbers(theirs, f"bayes.{name}"))
        assert abs(np.nanmedian(dex)) < 0.05, name
    name = "bayes.agn.fracAGN"
    assert abs(np.nanmedian(numbers(ours, name) - numbers(theirs, name))) < 0.02
    chi2 = [np.nanmedian(numbers(table, "best.reduced_chi_square")) for table in tables]
    assert chi2[0] <= chi2[1]


def test_masses_are_at_the_distances_of_the_objects(tables):
    """Redshifts of 0.003 to 0.1 are rounded to 0.01; masses object by object are CIGALE's to 0.1 dex."""
    ours, theirs = tables
    name = "bayes.stellar.m_star"
    dex = np.log10(numbers(ours, name) / numbers(theirs, name))
    assert np.diff(np.nanpercentile(dex, [16, 84])) / 2 < 0.1
    known = np.isfinite(dex)
    z = [numbers(table, "best.universe.redshift")[known] for table in tables]
    assert_allclose(*z)


# ------------------------------------------------------- best models, part by part

NAMES = ("ESO_428-14", "Mrk_493", "Mrk_509", "NGC_3516", "NGC_4748")


@pytest.fixture(scope="module")
def model(libraries):
    """The run's chain with its libraries of dust and torus (q 0), and the bundled stars and gas."""
    with conf.set_temp("data_folder", str(libraries)):
        options = {"polar_law": "smc_wd01", "disk": "schartmann2005", "disk_slope": -0.36}
        torus = parts.Skirtor2016(q=0.0, **options)
        law = parts.ModifiedStarburst(gas_law="mw", ebv_scaling="cigale")
        chain = [parts.DelayedSFH(), parts.BC03(), parts.Nebular(), law, parts.Dale2014(), torus]
        yield SEDModel([*chain, parts.Meiksin2006()])


@pytest.fixture(scope="module", params=NAMES)
def pair(request, model, data_file):
    """Our table of a best model, CIGALE's columns, and its header as numbers."""
    path = data_file(f"cigale_seyferts/best_models/{request.param}_best_model.fits.gz")
    with fits.open(path) as hdus:
        columns = {name: np.array(hdus[1].data[name]) for name in hdus[1].data.names}
        header = {k: float(v) for k, v in hdus[1].header.items() if "." in k}
    names, values = cigale_names({"sfh": "sfhdelayed"}), {}
    for ours, (theirs, _, factor) in names.items():
        if ours in model.parameters and theirs in header:
            values[ours] = header[theirs] / factor
    # the libraries that are freely distributed have one torus
    values |= {"q": 0.0, "opening_angle": 40.0, "mass": header["sfh.integrated"]}
    return best_model_table(model, values), columns, header


def ratio(ours, theirs, name, low, high):
    """Ours over CIGALE's between two wavelengths in um, each for one watt of the part."""
    a, b = np.array(ours[name]), theirs[name]
    wave, at = np.array(ours["wavelength"]), theirs["wavelength"]
    inside = (at > low * 1e3) & (at < high * 1e3)
    power = np.trapezoid(a, wave) / np.trapezoid(b, at)
    return np.interp(at, wave, a)[inside] / b[inside] / power


def test_dust_polar_dust_and_disk_of_best_models(pair):
    ours, theirs, header = pair
    # below, where starlight was taken from the templates, up to 1.5 %
    assert_allclose(ratio(ours, theirs, "dust", 3.1, 100), 1.0, atol=0.01)
    assert_allclose(ratio(ours, theirs, "dust", 100, 900), 1.0, atol=0.01)
    name = "agn.SKIRTOR2016_polar_dust"
    # dust of 100 K is dark at shorter wavelengths
    assert_allclose(ratio(ours, theirs, name, 25, 100), 1.0, atol=0.01)
    assert_allclose(ratio(ours, theirs, name, 100, 900), 1.0, atol=0.02)
    if header["agn.i"] < 90 - header["agn.oa"] and header["agn.oa"] == 40:
        disk = ratio(ours, theirs, "agn.SKIRTOR2016_disk", 0.13, 5)
        assert_allclose(disk, 1.0, atol=0.01)


def test_attenuation_of_best_models(pair):
    """What passes the dust, of light that is there on both sides."""
    ours, theirs, _ = pair
    wave, at = np.array(ours["wavelength"]), theirs["wavelength"]
    inside = (at > 130) & (at < 2000)
    for age in ("old", "young"):
        through = []
        for table in (ours, theirs):
            light = np.array(table[f"stellar.{age}"]) + np.array(table[f"nebular.absorption_{age}"])
            taken = np.array(table[f"attenuation.stellar.{age}"])
            through.append(1 + np.divide(taken, light, out=np.zeros(light.size), where=light > 0))
        there = np.interp(at, wave, through[0])[inside]
        assert_allclose(there, through[1][inside], rtol=0.01)


def test_columns_and_quantities_of_best_models(pair):
    """Layout, distance and units; powers of the AGN hang together as CIGALE's do."""
    ours, theirs, header = pair
    assert ours.colnames == list(theirs)
    one, two = (
        t["Fnu"][some] / t["L_lambda_total"][some] / t["wavelength"][some] ** 2
        for t in ({name: np.array(t[name]) for name in theirs} for t in (ours, theirs))
        for some in [t["L_lambda_total"] > 0]
    )
    one, two = np.median(one), np.median(two)
    assert one == pytest.approx(two, rel=1e-4, abs=0)
    for name in ("sfh.sfr", "sfh.sfr10Myrs", "sfh.sfr100Myrs", "sfh.integrated"):
        assert ours.meta[name] == pytest.approx(header[name], rel=1e-4), name
    distance = header["universe.luminosity_distance"]
    assert ours.meta["universe.luminosity_distance"] == pytest.approx(distance, rel=1e-4)
    # seen at 30 deg for one watt of accretion, polar dust for one watt
    for name, wide in (("agn.intrin_Lnu_2500A_30deg", 5e-3), ("agn.polar_dust_luminosity", 3e-3)):
        there = [m[name] / m["agn.accretion_power"] for m in (ours.meta, header)]
        if header["agn.oa"] == 40:
            assert there[0] == pytest.approx(there[1], rel=wide, abs=0), name
    # stars of other libraries: mass and light to a few percent
    assert ours.meta["stellar.m_star"] == pytest.approx(header["stellar.m_star"], rel=0.06)
    assert ours.meta["stellar.lum"] == pytest.approx(header["stellar.lum"], rel=0.1)


def test_gas_of_a_best_model_for_each_ionizing_photon(model, data_file):
    """H-beta is case B on both sides; log U is on two scales, by what the guide says (log U -2, solar, steady)."""
    with fits.open(data_file("cigale_seyferts/best_models/Mrk_493_best_model.fits.gz")) as hdus:
        theirs, header = hdus[1].data, {k: v for k, v in hdus[1].header.items() if "." in k}
    z = float(header["universe.redshift"])
    ours = best_model_table(model, {"age": 6.0, "tau": 5.0, "log_u": -2.0, "redshift": z})
    photons = ours.meta["stellar.n_ly_young"], float(header["stellar.n_ly_young"])

    def line(low, high):
        light = []
        for table, rate in zip((ours, theirs), photons, strict=True):
            wave = np.array(table["wavelength"]) / (1 + z)
            inside = (wave > low) & (wave < high)
            power = np.trapezoid(np.array(table["nebular.lines_young"])[inside], wave[inside])
            light.append(power / rate)
        return light[0] / light[1]

    assert line(484, 488.5) == pytest.approx(1.0, abs=0.05)
    assert line(370.5, 375.5) == pytest.approx(4.3, abs=0.3)
    assert line(493.5, 503.5) == pytest.approx(1.4, abs=0.1)
