"""Units that text files of spectra state: wavelengths and fluxes are what the file says."""

import astropy.units as u
import pytest
from astropy.table import Table
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.sed import read_spectra
from miricigale.utils.exceptions import DataError

#: 1 uJy at 1 um.
_ROWS = "1 1\n2 2\n3 3\n"


@pytest.mark.parametrize(
    ("head", "rows"),
    [
        ("# wave(um) flux(uJy)\n", _ROWS),
        ("# wavelength [micron]  Fnu [microJy]\n", _ROWS),
        ("# a model at 7.7 um\n# lambda (nm), f_nu (nJy)\n", "1000 1000\n2000 2000\n3000 3000\n"),
        ("wave(um),flux(uJy)\n", _ROWS.replace(" ", ",")),
        ("wave_um,flux_uJy\n", _ROWS.replace(" ", ",")),
    ],
)
def test_units_are_those_of_the_comments_or_names(tmp_path, head, rows):
    path = tmp_path / ("s.csv" if "," in rows else "s.txt")
    path.write_text(head + rows)
    (spectrum,) = read_spectra(path).values()
    assert_allclose(spectrum.wave.to_value(u.um), [1, 2, 3])
    assert_allclose(spectrum.fnu.to_value(u.uJy), [1, 2, 3])


@pytest.mark.parametrize("head", ["", "# a star\n", "# wave flux\n", "# wave(Angstrom) flux\n"])
def test_without_a_word_they_are_angstrom_and_flux_per_wavelength(tmp_path, head):
    path = tmp_path / "s.txt"
    path.write_text(head + "10000 1e-15\n20000 1e-15\n")
    (spectrum,) = read_spectra(path).values()
    assert_allclose(spectrum.wave.to_value(u.um), [1, 2])
    # F_nu = F_lambda lambda^2 / c
    assert_allclose(spectrum.fnu.to_value(u.uJy), [3335.64095, 13342.5638], rtol=1e-8)


def test_an_a_is_an_angstrom_and_units_of_fluxes_are_none_of_wavelengths(tmp_path):
    path = tmp_path / "s.txt"
    fluxes = []
    heads = ("# wave (Angstrom) flux (1e-15 erg/s/cm^2/A)", "# wave(Angstrom) flux(1e-11 W/m2/um)")
    for head, value in zip(heads, (1.0, 1e-3), strict=True):
        path.write_text(f"{head}\n10000 {value}\n20000 {value}\n")
        (spectrum,) = read_spectra(path).values()
        fluxes.append(spectrum.fnu.to_value(u.uJy))
    assert_allclose(fluxes[0], [3335.64095, 13342.5638], rtol=1e-8)
    # 1 erg/s/cm2/Angstrom are 10 W/m2/um
    assert_allclose(fluxes[1], fluxes[0], rtol=1e-8)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("# wave (um or nm) flux\n", "names um and nm as units"),
        ("# wave(um) flux(counts per bin)\n", "names 'counts per bin' as the unit of its fluxes"),
        ("# frequency (Hz) fnu (Jy)\n", "frequencies or energies in place of wavelengths"),
        ("# wave(AA) nuFnu(erg/s/cm2)\n", "fluxes times frequencies or wavelengths"),
        ("# wave fnu\n", "has fluxes per frequency without a unit"),
    ],
)
def test_what_is_not_sure_is_refused(tmp_path, head, message):
    path = tmp_path / "s.txt"
    path.write_text(head + _ROWS)
    refuses(message, read_spectra, path, error=DataError)


def test_units_of_columns_go_first(tmp_path):
    table = Table({"wave": [1.0, 2.0] * u.um, "fnu": [1.0, 2.0] * u.uJy})
    for name in ("s.ecsv", "s.fits"):
        table.write(tmp_path / name)
        (spectrum,) = read_spectra(tmp_path / name).values()
        assert_allclose(spectrum.fnu.to_value(u.uJy), [1, 2])
