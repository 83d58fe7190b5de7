"""A real run of CIGALE, 117 Seyferts from the ultraviolet to 500 um, against its own results."""

import warnings

import numpy as np
import pytest

from miricigale.cigale import read_cigale_results, read_pcigale_ini
from miricigale.refdata import conf
from miricigale.refdata.libraries import add_library
from miricigale.utils.exceptions import MiricigaleWarning

RUN = "cigale_seyferts/group1_0a90"


def numbers(table, name):
    column = table[name]
    return np.ma.filled(np.ma.asarray(getattr(column, "value", column), float), np.nan)


@pytest.fixture(scope="module", params=["bundled", "best"])
def tables(request, data_file, tmp_path_factory):
    """Ours and CIGALE's: with bundled libraries, and with Dale 2014 and SKIRTOR (q 0 for the run's q 1)."""
    tmp_path = tmp_path_factory.mktemp(request.param)
    text = data_file(f"{RUN}/pcigale.ini").read_text()
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        if request.param == "best":
            add_library("dust.dale2014", data_file("dale2014/dhcal.dat").parent)
            add_library("torus.skirtor2016", data_file("skirtor2016/SKIRTOR.fits.gz"))
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
    np.testing.assert_allclose(
        numbers(ours, "best.universe.redshift")[np.isfinite(dex)],
        numbers(theirs, "best.universe.redshift")[np.isfinite(dex)],
    )
