"""Published constants of the science code, digit by digit, with their sources; constants of nature by astropy."""

import astropy.units as u
import numpy as np
import pytest
from astropy import constants as const
from numpy.testing import assert_allclose

from miricigale.evaluation import classes, counts, infrared, metrics, population
from miricigale.sed import chain, xray_bands
from miricigale.sed._core import LIGHT, attenuation, disk, igm, nebular, nodes, thermal, xray

_CALZETTI_1994 = [
    (0.1268, 0.1284), (0.1309, 0.1316), (0.1342, 0.1371), (0.1407, 0.1515), (0.1562, 0.1583),
    (0.1677, 0.1740), (0.1760, 0.1833), (0.1866, 0.1890), (0.1930, 0.1950), (0.2400, 0.2580),
]  # fmt: skip
#: Wavelength (um), limit (uJy), light (nW / m2 / sr) and its errors.
_LIGHT = [(15, 50, 2.4, 0.5, 0.5), (24, 60, 1.9, 0.6, 0.6), (24, 0, 2.7, 0.7, 1.1)]
PUBLISHED = [
    ("Calzetti et al. 1994, table 2 (um)", chain.UV_WINDOWS, _CALZETTI_1994),
    ("Madau 1995, Lyman alpha to delta", igm._MADAU, [0.0036, 0.0017, 0.0012, 0.00093]),
    (
        "Meiksin 2006, table 1, n = 3 to 9",
        igm._FACTORS[3:],
        [0.348, 0.179, 0.109, 0.0722, 0.0508, 0.0373, 0.0283],
    ),
    ("Inoue et al. 2014, section 4", igm.INOUE_LIMIT, 0.09118),
    (
        "Ferland 1980, 10^4 K: alpha_B and alpha_1 (m3/s)",
        (nebular.ALPHA_B, nebular.ALPHA_1),
        (2.58e-19, 1.54e-19),
    ),
    ("Stern 2015, equation 2", xray._STERN, (40.981, 1.024, -0.047)),
    (
        "Mezcua et al. 2018, equation 3, in W",
        xray_bands._LOW_MASS,
        (40.276 - 7, -1.503, -0.423, 0.425, 0.136),
    ),
    (
        "Mezcua et al. 2018, equation 4, in W",
        xray_bands._HIGH_MASS,
        (40.28 - 7, -62.12, 569.44, -1833.80, 1968.33),
    ),
    ("Mineo et al. 2012: 8.3e38 erg/s", xray_bands._GAS, 8.3e31),
    ("Yang et al. 2020, definition of alpha_ox", xray_bands._PER_DEX, 0.3838),
    (
        "Ueda et al. 2014, table 4",
        [population._LDDE[n] for n in ("A", "gamma1", "gamma2")],
        (2.91e-6, 0.96, 2.71),
    ),
    (
        "Ueda et al. 2014, table 4",
        [population._LDDE[n] for n in ("p1", "beta1", "p2", "p3")],
        (4.78, 0.84, -1.5, -6.2),
    ),
    (
        "Ueda et al. 2014, table 4",
        [population._LDDE[n] for n in ("z1", "alpha1", "z2", "alpha2")],
        (1.86, 0.29, 3, -0.1),
    ),
    (
        "Ueda et al. 2014, table 4",
        [population._LDDE[n] for n in ("break", "la1", "la2")],
        (43.97, 44.61, 44.0),
    ),
    (
        "Davidzon et al. 2017, table 1, first row",
        population._SMF[0],
        (10.78, -1.38, 1.187, -0.43, 1.92),
    ),
    ("Aird et al. 2013", population._SLOPES, (-0.65, -2.1)),
    (
        "Stalevski et al. 2016, breaks (um)",
        disk.DISKS["stalevski2016"][0],
        (0.001, 0.01, 0.1, 5.0, 1000.0),
    ),
    ("Stalevski et al. 2016, slopes", disk.DISKS["stalevski2016"][1], (0.2, -1.0, -1.5, -4.0)),
    ("Tielens 2008 (um)", infrared.PAH_FEATURES.to_value(u.um), (3.3, 6.2, 7.7, 8.6, 11.3, 12.7)),
    ("Yang et al. 2021, section 3.3.2", metrics.OUTLIER, 0.15),
    (
        "Kirkpatrick et al. 2017, as in Yang et al. 2021, section 5",
        classes.CLASS_LIMITS,
        (0.1, 0.4),
    ),
    ("Elbaz et al. 2002, Papovich et al. 2004", [r[1:6] for r in counts.PUBLISHED_LIGHT], _LIGHT),
]
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


@pytest.mark.parametrize(("source", "got", "wanted"), PUBLISHED)
def test_published_constants_are_literal(source, got, wanted):
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
