"""Published constants of the science code, digit by digit, with their sources; constants of nature by astropy."""

import importlib

import astropy.units as u
import numpy as np
import pytest
from astropy import constants as const
from numpy.testing import assert_allclose

from helpers.cases import cases_of
from miricigale.sed import xray_bands
from miricigale.sed._core import LIGHT, attenuation, igm, nodes, thermal

#: Of 1 um, and the limit of hydrogen's Lyman series.
_PER_UM = 1 * u.um
NATURE = [
    ("speed of light (um/s)", LIGHT, const.c.to_value(u.um / u.s)),
    ("h c (J um)", nodes._HC, (const.h * const.c).to_value(u.J * u.um)),
    ("h c / k (um K)", thermal.PLANCK_K, (const.h * const.c / const.k_B).to_value(u.um * u.K)),
    (
        "2 keV over 1 Hz",
        xray_bands._PER_KEV,
        (_PER_UM.to(u.keV, u.spectral()) ** -1 * (const.c / _PER_UM)).to_value("Hz / keV"),
    ),
]


@pytest.mark.parametrize(
    ("source", "module", "constant", "wanted"), cases_of(__file__, "published")
)
def test_published_constants_are_literal(source, module, constant, wanted):
    names = vars(importlib.import_module(f"miricigale.{module}"))
    got = eval(constant, {**names, "np": np})
    assert np.shape(got) == np.shape(wanted), source
    assert_allclose(got, wanted, rtol=1e-12, err_msg=source)


@pytest.mark.parametrize(("name", "got", "wanted"), NATURE)
def test_constants_of_nature_are_those_of_codata(name, got, wanted):
    assert_allclose(got, wanted, rtol=1e-8, err_msg=name)


def test_the_limit_of_hydrogen():
    energy = 13.598434 * u.eV  # NIST
    wanted = energy.to_value(u.um, u.spectral())
    for limit, digits in ((igm.INOUE_LIMIT, 5), (igm.LYMAN_LIMIT, 4), (attenuation._BREAK, 4)):
        assert limit == pytest.approx(wanted, abs=10.0**-digits)
