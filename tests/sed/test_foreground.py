import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import MaskedColumn, QTable, Table
from astropy.tests.helper import assert_quantity_allclose
from astropy.utils.masked import Masked
from numpy.testing import assert_allclose, assert_array_equal

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.filters import Filter, FilterSet
from miricigale.sed import SED
from miricigale.sed.foreground import (
    LAWS,
    GalacticExtinction,
    band_extinction,
    color_excess,
    coverage,
    deredden,
    extinction_curve,
)

PAPER = [f"megacam.{band}" for band in "ugriz"] + ["acs.f606w", "acs.f814w", "mips.24"]
PAPER += [f"wfc3.{band}" for band in ("f125w", "f140w", "f160w")]
PAPER += [f"irac.ch{k}" for k in (1, 2, 3, 4)]
PAPER += [f"miri.f{k}w" for k in (770, 1000, 1280, 1500, 1800, 2100)]


# ------------------------------------------------------------------------------------ laws


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("r_v", [2.6, 3.1, 5.0])
def test_r_v_is_extinction_over_color_excess(law, r_v):
    """A(V) = R_V E(B-V). F99, F04 are scaled in the bands B, V: 3 % at 0.55 um, more at large R_V."""
    k = extinction_curve(np.array([0.44, 0.55]), law, r_v)
    assert k[1] == pytest.approx(r_v, rel=0.03)
    assert k[0] - k[1] == pytest.approx(1.0, abs=0.1)


# Cardelli, Clayton & Mathis 1989, table 3, R_V = 3.1: 1 / um and A(lambda) / A(V)
CCM89 = np.array([2.78, 2.27, 1.82, 1.43, 1.11, 0.80, 0.63, 0.46])
RATIOS = [1.569, 1.337, 1.000, 0.751, 0.479, 0.282, 0.190, 0.114]


def test_cardelli_table():
    """Their formula, with x of two digits, follows their table to 1.5 %."""
    assert_allclose(extinction_curve(1.0 / CCM89, "CCM89", 3.1) / 3.1, RATIOS, rtol=0.02)


@pytest.mark.parametrize("law", LAWS)
def test_curve_is_that_of_dust_extinction(law):
    """Between the steps of our table: 5e-5 mag for each mag of E(B-V), more where a law jumps."""
    from dust_extinction import parameter_averages

    low, high = coverage(law)
    wave = np.exp(np.random.default_rng(4).uniform(np.log(low), np.log(high), 5000))
    want = 3.3 * np.asarray(getattr(parameter_averages, law)(Rv=3.3)(1.0 / wave / u.um))
    error = np.abs(extinction_curve(wave, law, 3.3) - want)
    assert np.percentile(error, 99) < 5e-5
    assert error.max() < 5e-3


@pytest.mark.parametrize("law", LAWS)
def test_nothing_is_extrapolated(law):
    low, high = coverage(law)
    k = extinction_curve(np.array([low * 0.999, low, high, high * 1.001]), law)
    assert_array_equal(np.isnan(k), [True, False, False, True])
    part = GalacticExtinction(law=law)
    wave = np.array([low * 0.999, low * 1.001, high * 0.999, high * 1.001])
    got = part.transmission(wave, values_of(part, ebv_galactic=0.5))
    assert np.all(got[[0, 3]] == 1.0)
    assert np.all(got[[1, 2]] < 1.0)


# ------------------------------------------------------------------------------- component


def test_default_law_covers_the_bands_of_the_paper():
    GalacticExtinction().check_bands(FilterSet(PAPER))


def test_bands_beyond_a_law_are_refused_by_name():
    match = r"law F99 is defined from 0\.1 to 3\.333 um .* bands irac\.ch2 \(.*\), miri\.f770w \("
    check = GalacticExtinction(law="F99").check_bands
    refuses(match, check, ["wfc3.f160w", "irac.ch2", "miri.f770w"])
    check = GalacticExtinction().check_bands
    refuses(r"law G23 .* 32 um .* bands mips\.70 \(", check, ["mips.24", "mips.70"])


def test_bands_beyond_the_long_end_may_be_taken_as_transparent():
    part = GalacticExtinction(beyond="transparent")
    part.check_bands(["mips.24", "mips.70", "mips.160"])
    blue = Filter([0.05, 0.07, 0.08] * u.um, [0, 1, 0], name="blue")
    refuses("not over the bands blue", part.check_bands, [blue])
    got = band_extinction(["mips.70", "miri.f770w"], 0.1, beyond="transparent")
    assert got["mips.70"][0] == 0 * u.mag
    assert got["miri.f770w"][0] > 0 * u.mag


def test_r_v_outside_the_law():
    match = r"'r_v' must be from 2\.3 to 5\.6 for the law G23, got 2\.1"
    refuses(match, GalacticExtinction, r_v=2.1)
    part = GalacticExtinction()
    assert "from 2.3 to 5.6 for the law G23" in part.invalid(values_of(part, r_v=5.9))
    assert part.invalid(values_of(part)) is None
    assert GalacticExtinction(law="F99").invalid(values_of(part, r_v=5.9)) is None


def test_unknown_law():
    refuses("'law' must be one of G23, F99", band_extinction, ["wfc3.f160w"], 0.1, law="SFD")


# ---------------------------------------------------------------------------------- bands

# Schlafly & Finkbeiner 2011, table 6, R_V = 3.1: A_b / E(B-V)_SFD for F99 and a star of 7000 K
SCHLAFLY = {
    "acs.f435w": 3.610, "acs.f606w": 2.471, "acs.f775w": 1.629, "acs.f814w": 1.526,
    "acs.f850lp": 1.243, "wfc3.f105w": 0.969, "wfc3.f125w": 0.726, "wfc3.f140w": 0.613,
    "wfc3.f160w": 0.512,
}  # fmt: skip


def star(temperature=7000.0):
    wave = np.geomspace(0.1, 40.0, 4000)
    return SED(wave * u.um, wave**-3 / np.expm1(14387.77 / (wave * temperature)) * u.uJy)


def test_coefficients_of_schlafly_and_finkbeiner():
    """
    E(B-V) = 0.86 E(B-V)_SFD.

    Their scale is set at 1 um and the 0.86 is rounded: 4 % in all bands together, 1.5 % from band
    to band.
    """
    got = band_extinction(list(SCHLAFLY), 0.86e-2, law="F99", sed=star())
    ratio = np.array([got[name][0].value / 1e-2 / want for name, want in SCHLAFLY.items()])
    assert ratio.mean() == pytest.approx(1.0, abs=0.04)
    assert_allclose(ratio / ratio.mean(), 1.0, atol=0.015)


@pytest.mark.parametrize("ebv", [1e-3, 0.05, 2.0])
@pytest.mark.parametrize("name", ["acs.f606w", "wfc3.f160w", "miri.f1000w"])
def test_band_extinction_is_the_photon_mean(name, ebv):
    """Against the integral of T 10^(-0.4 A) / lambda over half a million steps."""
    band = Filter.from_name(name)
    wave = np.linspace(*band.wave.value[[0, -1]], 500_001)
    weight = np.interp(wave, band.wave.value, band.throughput) / wave
    seen = weight * 10 ** (-0.4 * ebv * extinction_curve(wave))
    want = -2.5 * np.log10(np.trapezoid(seen, wave) / np.trapezoid(weight, wave))
    assert band_extinction([name], ebv)[name][0].value == pytest.approx(want, rel=2e-5)


def test_red_sources_lose_less_in_a_wide_band():
    seds = (star(3000.0), None, star(20000.0))
    red, flat, blue = (band_extinction(["acs.f606w"], 0.1, sed=s)["acs.f606w"][0] for s in seds)
    assert red < flat < blue


def test_small_extinction_is_in_proportion():
    got = band_extinction(["acs.f814w"], [0.0, 1e-9, 2e-9, 1e-5])["acs.f814w"].value
    assert got[0] == 0.0
    assert got[2] / got[1] == pytest.approx(2.0, rel=1e-8)
    assert got[3] / got[1] == pytest.approx(1e4, rel=1e-4)


def test_rows_are_independent():
    ebv = np.random.default_rng(1).uniform(0, 0.3, 3000)
    many = band_extinction(["acs.f606w", "miri.f770w"], ebv * u.mag)
    for row in (0, 1500, 2999):
        one = band_extinction(["miri.f770w", "acs.f606w"], ebv[row])
        for name in ("acs.f606w", "miri.f770w"):
            assert_quantity_allclose(many[name][row], one[name][0], rtol=1e-12)
    assert_quantity_allclose(many["ebv"], ebv * u.mag)
    assert many.meta["galactic_extinction"]["law"] == "G23"


@pytest.mark.parametrize(
    ("ebv", "match"),
    [
        ([0.1, np.nan, 0.2, -0.1], "'ebv' must be finite and not negative, .* 2 of 4 rows: 1, 3"),
        (np.ma.array([0.1, 0.2], mask=[0, 1]), "in 1 of 2 rows: 1"),
        (MaskedColumn([0.1, 0.2], mask=[1, 0], unit="mag"), "in 1 of 2 rows: 0"),
        (Masked([0.1, 0.2] * u.mag, mask=[0, 1]), "in 1 of 2 rows: 1"),
        (np.full((2, 2), 0.1), "'ebv' must be of one dimension"),
        ("much", "'ebv' must be numbers, got values of type"),
        (0.1 * u.Jy, "'ebv' must be convertible to mag, got Jy"),
    ],
)
def test_bad_color_excess(ebv, match):
    refuses(match, band_extinction, ["wfc3.f160w"], ebv, error=(ValueError, u.UnitsError))


def test_sed_must_cover_the_bands():
    refuses("uncovered", band_extinction, ["irac.ch4"], 0.1, sed=SED([1, 7] * u.um, [1, 1] * u.uJy))


# ---------------------------------------------------------------------------------- tables


def catalog(cls=QTable):
    table = cls(meta={"field": "mine"})
    table["id"] = ["a", "b", "c"]
    table["acs.f606w"] = [1.0, 2.0, np.nan] * u.uJy
    table["acs.f606w_err"] = [0.1, -0.2, np.nan] * u.uJy
    table["miri.f770w"] = [3e-3, 4e-3, 5e-3] * u.mJy
    table["z"] = [0.1, 0.2, 0.3]
    table["acs.f606w"].info.description = "flux"
    return table


@pytest.mark.parametrize("cls", [QTable, Table])
def test_dereddening_undoes_the_extinction(cls):
    table, ebv = catalog(cls), np.array([0.02, 0.0, 0.3])
    bands = ["acs.f606w", "miri.f770w"]
    got = deredden(table, ebv, bands, law="G23")
    lost = band_extinction(bands, ebv)
    for band, columns in (("acs.f606w", ("", "_err")), ("miri.f770w", ("",))):
        for ending in columns:
            name = band + ending
            assert got[name].unit == table[name].unit
            ratio = np.asarray(got[name]) / np.asarray(table[name])
            known = np.isfinite(ratio)
            assert_allclose(2.5 * np.log10(ratio[known]), lost[band].value[known], atol=1e-12)
    assert np.isnan(np.asarray(got["acs.f606w"])[2])
    assert list(got["id"]) == ["a", "b", "c"]
    assert list(got["z"]) == [0.1, 0.2, 0.3]
    assert got["acs.f606w"].info.description == "flux"
    assert type(got) is cls
    assert got.meta["field"] == "mine"
    assert got.meta["galactic_extinction"]["r_v"] == 3.1
    # the table given is as it was
    assert "galactic_extinction" not in table.meta
    assert np.asarray(table["acs.f606w"])[0] == 1.0


def test_masked_fluxes_stay_masked():
    table = Table({"wfc3.f160w": MaskedColumn([1.0, 2.0], mask=[False, True], unit="uJy")})
    got = deredden(table, 0.1, ["wfc3.f160w"])
    assert list(got["wfc3.f160w"].mask) == [False, True]
    assert got["wfc3.f160w"].unit == u.uJy


def test_a_table_is_corrected_once():
    once = deredden(catalog(), 0.05, ["acs.f606w"])
    refuses("not corrected yet, got one whose meta say", deredden, once, 0.05, ["acs.f606w"])


@pytest.mark.parametrize(
    ("ebv", "bands", "match"),
    [
        ([0.1, 0.1], ["acs.f606w"], "one for each row, got 2 for 3 rows"),
        ([0.1, np.nan, 0.1], ["acs.f606w"], "in 1 of 3 rows: 1"),
        (0.1, ["wfc3.f160w"], r"a table with the columns \['wfc3.f160w'\]"),
    ],
)
def test_dereddening_refuses(ebv, bands, match):
    refuses(match, deredden, catalog(), ebv, bands)


def test_dereddening_refuses_magnitudes():
    for unit in (u.ABmag, u.mag, None):
        table = Table({"wfc3.f160w": [22.0, 23.0]})
        table["wfc3.f160w"].unit = unit
        with pytest.raises(u.UnitsError, match=r"'wfc3.f160w' must be in a linear unit of flux"):
            deredden(table, 0.1, ["wfc3.f160w"])
    refuses("'photometry' must be a table, got dict", deredden, {}, 0.1, ["wfc3.f160w"])


class Slope:
    """A map that is 0.1 mag at the north pole and 0 at the equator, and knows no south."""

    def query(self, sky):
        return np.where(sky.dec.deg >= 0, 0.1 * sky.dec.deg / 90, np.nan)


def test_a_map_gives_the_color_excess_of_positions():
    sky = SkyCoord([10.0, 20.0, 30.0], [0.0, 45.0, 90.0], unit="deg")
    ebv = color_excess(sky, Slope(), scale=0.86)
    assert_allclose(ebv.to_value(u.mag), [0.0, 0.043, 0.086])
    with pytest.raises(ValueError, match=r"'sky' must be positions with .* got 1 of 2 without"):
        color_excess(SkyCoord([1.0, 1.0], [5.0, -5.0], unit="deg"), Slope())
    refuses(r"'dust_map' must be a map with a method query", color_excess, sky, 0.01)
