"""Curves in files: units, detectors, blanks, edges, and what is written is read."""

import gzip

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.filters import Filter, FilterSet, as_filter
from miricigale.utils.exceptions import DataError

ANGSTROM = "70000 0\n71000 0.5\n76000 0.9\n82000 0.8\n88000 0\n"
MICRON = "7.0 0\n7.1 0.5\n7.6 0.9\n8.2 0.8\n8.8 0\n"
NANO = "7000 0\n7100 0.5\n7600 0.9\n8200 0.8\n8800 0\n"
PIVOT = 7.810728


def write(path, text):
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("head", "body"),
    [
        ("# MIRI F770W, pivot 7.7 um\n# wavelength (Angstrom)  throughput\n", ANGSTROM),
        ("# resampled to 1 nm\n# wave(um) T\n", MICRON),
        ("# wavelength [A], transmission\n", ANGSTROM),
        ("# lambda(nm) T\n# measured at 7 K, width 1.2 microns\n", NANO),
        ("# Å\n", ANGSTROM),
        ("# um\n", MICRON),
        ("# micrometers\n", MICRON),
        ("wavelength_um throughput\n".replace("_", " "), MICRON),
        ("# um\n 299  Z  7  (Z #846 WFI/2p2)\n", MICRON),
        ("# um\n5\n", MICRON),
        ("\ufeff# wave (µm)\n\n   \n", MICRON.replace("\n", "\n\n")),
        ("# um\n", MICRON.replace(" ", ", ")),
        ("# um\n", "\n".join(reversed(MICRON.splitlines()))),
        ("# wave(um)\n", "".join(f"{i + 1} {row} \n" for i, row in enumerate(MICRON.splitlines()))),
        ("# um, third column: error\n", MICRON.replace("\n", " 0.01\n")),
    ],
)
def test_the_unit_of_wavelengths_is_that_of_their_column(tmp_path, head, body):
    band = Filter.read(write(tmp_path / "f.dat", head + body))
    assert_allclose(band.pivot.value, PIVOT, rtol=1e-6)


@pytest.mark.parametrize(
    ("head", "message"),
    [
        ("# converted from nm to um\n", "names um and nm as units"),
        ("# pivot 7.7 um\n", "does not state the unit of its wavelengths"),
        ("# a filter\n", "does not state the unit of its wavelengths"),
    ],
)
def test_a_unit_that_is_not_sure_is_asked_for(tmp_path, head, message):
    path = write(tmp_path / "f.dat", head + MICRON)
    refuses(message, Filter.read, path, error=DataError)
    assert_allclose(Filter.read(path, unit="um").pivot.value, PIVOT, rtol=1e-6)


def _svo(kind):
    rows = "".join(f"<TR><TD>{a}</TD><TD>1</TD></TR>" for a in np.linspace(80000, 165000, 401))
    return f"""<?xml version="1.0"?><VOTABLE version="1.1" xmlns="http://www.ivoa.net/xml/VOTable/v1.1">
<RESOURCE type="results"><TABLE><PARAM name="filterID" value="Mine/W3" datatype="char" arraysize="*"/>
<PARAM name="DetectorType" value="{kind}" datatype="char" arraysize="*"/>
<FIELD name="Wavelength" unit="Angstrom" datatype="float"/><FIELD name="Transmission" unit="" datatype="float"/>
<DATA><TABLEDATA>{rows}</TABLEDATA></DATA></TABLE></RESOURCE></VOTABLE>"""


def test_energy_counters_of_the_svo_and_of_comments_weigh_by_wavelength(tmp_path):
    """For a box of an energy counter the pivot is the geometric mean of the edges (int dlam / int dlam/lam^2)."""
    low, high = 8.0, 16.5
    energy = Filter.read(write(tmp_path / "0.xml", _svo(0)))
    assert_allclose(energy.pivot.value, np.sqrt(low * high), rtol=2e-5)
    photon = Filter.read(write(tmp_path / "1.xml", _svo(1)))
    assert_allclose(
        photon.pivot.value, np.sqrt((high**2 - low**2) / 2 / np.log(high / low)), rtol=2e-5
    )
    rows = "".join(f"{a} 1\n" for a in np.linspace(8, 16.5, 401))
    for line in ("# DETECTOR energy\n", "# DetectorType: 0\n"):
        band = Filter.read(write(tmp_path / "c.dat", f"# um\n{line}{rows}"))
        assert_allclose(band.pivot.value, energy.pivot.value, rtol=1e-5)
    table = QTable(
        {"w": np.linspace(8, 16.5, 401) * u.um, "t": np.ones(401)}, meta={"DetectorType": 0}
    )
    table.write(tmp_path / "c.ecsv")
    assert_allclose(Filter.read(tmp_path / "c.ecsv").pivot.value, energy.pivot.value, rtol=1e-5)


@pytest.mark.parametrize("word", ["Energy counter", "energy", "0"])
def test_the_detector_may_be_said_in_words(tmp_path, word):
    """An energy counter by a word is one by the number."""
    number = Filter.read(write(tmp_path / "0.xml", _svo(0)))
    words = Filter.read(write(tmp_path / "w.xml", _svo(word)))
    assert words.pivot == number.pivot
    photon = Filter.read(write(tmp_path / "1.xml", _svo("Photon counter")))
    assert photon.pivot > number.pivot


@pytest.mark.parametrize(
    "names",
    [
        ("WAVELENGTH", "SEGMENT", "THROUGHPUT"),
        ("throughput", "wave", "thr_err"),
        ("id", "wave", "Transmission"),
        ("wave", "error", "t"),
    ],
)
@pytest.mark.parametrize("unit", ["ANGSTROMS", "A", "um", "MICRONS"])
def test_columns_of_a_curve_are_found_by_their_names(tmp_path, names, unit):
    """Files of STScI have further columns, and units that astropy does not know."""
    wave = np.array([7.0, 7.1, 7.6, 8.2, 8.8])
    throughput = np.array([0, 0.5, 0.9, 0.8, 0])
    if unit.startswith("A"):
        wave = wave * 1e4
    columns = []
    for name in names:
        if name.lower().startswith("wave"):
            columns.append(fits.Column(name, "D", unit=unit, array=wave))
        elif name.lower() in ("throughput", "transmission", "t"):
            columns.append(fits.Column(name, "D", array=throughput))
        else:
            columns.append(fits.Column(name, "D", array=np.ones(5)))
    fits.BinTableHDU.from_columns(columns).writeto(tmp_path / "f.fits")
    band = Filter.read(tmp_path / "f.fits")
    assert_allclose(band.pivot.value, PIVOT, rtol=1e-6)
    assert band.throughput.max() == 0.9


def test_two_throughputs_in_one_table_are_refused(tmp_path):
    table = QTable({"wave": [7.0, 8.0] * u.um, "through_a": [1.0, 1.0], "through_b": [1.0, 2.0]})
    table.write(tmp_path / "two.ecsv")
    match = "several columns that may be meant, through_a, through_b"
    refuses(match, Filter.read, tmp_path / "two.ecsv", error=DataError)


def test_percent_are_hundredths(tmp_path):
    rows = MICRON.replace(" 0.", " ")
    text = Filter.read(write(tmp_path / "t.dat", "# wave(um) T(%)\n" + rows))
    table = QTable({"wave": text.wave, "throughput": text.throughput * 100 * u.percent})
    table.write(tmp_path / "t.ecsv")
    for band in (text, Filter.read(tmp_path / "t.ecsv")):
        assert_allclose(band.throughput.max(), 0.09)


def test_units_in_names_of_columns_and_beside_the_word_photon(tmp_path):
    body = MICRON.replace(" ", ",")
    for name in ("wavelength_um", "wave [um]", "lambda(micron)"):
        band = Filter.read(write(tmp_path / "c.csv", f"{name},throughput\n{body}"))
        assert_allclose(band.pivot.value, PIVOT, rtol=1e-6)
    # in the layout of CIGALE, whose own files are in Angstrom
    head = "# mine\n# photon\n"
    band = Filter.read(write(tmp_path / "c.dat", head + "# wavelengths in nm\n" + NANO))
    assert_allclose(band.pivot.value, PIVOT, rtol=1e-6)
    band = Filter.read(write(tmp_path / "c.dat", head + "# a band of 8 microns\n" + ANGSTROM))
    assert_allclose(band.pivot.value, PIVOT, rtol=1e-6)


def test_small_negative_points_are_zero_and_counted(tmp_path):
    band = Filter.read(write(tmp_path / "n.dat", "# um\n7.0 -1e-5\n7.1 0.5\n7.6 0.9\n8.8 -2e-6\n"))
    assert band.meta["n_negative"] == 2
    assert band == Filter([7.0, 7.1, 7.6, 8.8] * u.um, [0, 0.5, 0.9, 0], name="n")
    path = write(tmp_path / "m.dat", "# um\n7.0 0\n7.1 0.5\n7.6 -0.9\n8.8 0\n")
    refuses("has a throughput of -0.9, beside a peak of 0.5", Filter.read, path, error=DataError)


def test_vertical_edges_are_steps_in_either_direction(tmp_path):
    rows = ["7.0 0", "7.0 1", "8.0 1", "8.0 0"]
    for order in (rows, rows[::-1]):
        band = Filter.read(write(tmp_path / "b.dat", "# um\n" + "\n".join(order) + "\n"))
        # the closed form of a box
        assert_allclose(band.pivot.value, np.sqrt((64 - 49) / 2 / np.log(8 / 7)), rtol=1e-6)
    path = write(tmp_path / "c.dat", "# um\n7 0\n7.5 1\n7.5 2\n7.5 1\n8 0\n")
    refuses("has the wavelength 7.5 more than twice", Filter.read, path, error=DataError)
    same = Filter.read(write(tmp_path / "d.dat", "# um\n7 0\n7.5 1\n7.5 1\n8 0\n"))
    assert same.wave.size == 3


def test_descending_tables_are_read_and_missing_values_refused(tmp_path):
    QTable({"w": [8.8, 7.6, 7.1, 7.0] * u.um, "T": [0, 0.9, 0.5, 0]}).write(tmp_path / "d.ecsv")
    assert Filter.read(tmp_path / "d.ecsv").throughput.tolist() == [0, 0.5, 0.9, 0]
    (tmp_path / "b.csv").write_text("wavelength,throughput\n70000,0\n71000,0.5\n76000,\n88000,0\n")
    refuses("'throughput' must be finite", Filter.read, tmp_path / "b.csv", unit="AA")
    masked = MaskedColumn([0.0, 0.5, 0.9, 0.0], mask=[0, 0, 1, 0])
    QTable({"w": [7.0, 7.1, 7.6, 8.8] * u.um, "T": masked}).write(tmp_path / "m.ecsv")
    refuses("'throughput' must be finite", Filter.read, tmp_path / "m.ecsv")


@pytest.mark.parametrize("name", ["mips.24", "irac.ch1", "miri.f770w"])
@pytest.mark.parametrize("suffix", ["ecsv", "fits", "vot", "fits.gz", "vot.gz"])
def test_a_filter_that_is_written_is_read_with_its_convention(tmp_path, name, suffix):
    band = Filter(name)
    band.write(tmp_path / f"m.{suffix}")
    again = Filter.read(tmp_path / f"m.{suffix}")
    assert_allclose(again.catalog_factor, band.catalog_factor, rtol=1e-12)
    assert again.reference_wavelength == band.reference_wavelength
    assert again.reference_temperature == band.reference_temperature
    assert again.name == name


def test_a_filter_is_not_written_without_its_unit(tmp_path):
    refuses(
        "'path' must be a file of a format with units", Filter("F770W").write, tmp_path / "m.csv"
    )


def test_a_packed_curve_in_text_is_read(tmp_path):
    text = b"# um\n7.0 0\n7.1 0.5\n7.6 0.9\n8.8 0\n"
    (tmp_path / "a.dat").write_bytes(text)
    (tmp_path / "b.dat.gz").write_bytes(gzip.compress(text))
    assert Filter.read(tmp_path / "b.dat.gz").pivot == Filter.read(tmp_path / "a.dat").pivot


def test_filters_of_sedpy_are_filters():
    class SedpyFilter:
        name = "mine"
        wavelength = np.array([7.0e4, 7.1e4, 7.6e4, 8.2e4, 8.8e4])
        transmission = np.array([-1e-6, 0.5, 0.9, 0.8, 0.0])

    class SedpySet:
        filters = [SedpyFilter(), as_filter("F770W")]

    assert_allclose(as_filter(SedpyFilter()).pivot.value, PIVOT, rtol=1e-6)
    assert FilterSet([SedpyFilter(), "F770W"]).names == ("mine", "miri.f770w")
    assert FilterSet(SedpySet()).names == ("mine", "miri.f770w")
    assert FilterSet(SedpyFilter()).names == ("mine",)


def test_a_set_of_files_may_be_given_their_unit(tmp_path):
    paths = [write(tmp_path / f"{name}.dat", MICRON) for name in "ab"]
    refuses("does not state the unit", FilterSet, paths, error=DataError)
    filters = FilterSet(paths, unit="um")
    assert filters.names == ("a", "b")
    assert_allclose(filters.pivots.value, PIVOT, rtol=1e-6)


def test_words_in_a_table_of_numbers_are_refused_with_the_file(tmp_path):
    """A title above the names of the columns, as in the tables of optics of NIRCam."""
    path = tmp_path / "optics.csv"
    path.write_text('"Transmission",\nWavelength,Collimator\n0.6,0.9\n0.7,0.91\n')
    text = r"optics\.csv is no filter: its columns are not numbers: .*Wavelength"
    refuses(text, Filter.read, path, unit="um", error=DataError)


@pytest.mark.parametrize("mark", ["# ", "#"])
@pytest.mark.parametrize(("kind", "power"), [("photon", 0), ("energy", -1)])
def test_files_of_cigale_say_what_they_count(tmp_path, mark, kind, power):
    """Name, kind and description in comments, Angstrom, and noise of -1e-5 at the edges."""
    wave = np.linspace(20000.0, 24000.0, 41)
    value = np.exp(-0.5 * ((wave - 22000.0) / 600.0) ** 2)
    value[:3] = -1e-5
    rows = [f"{a:.1f} {b:.6e}" for a, b in zip(wave, value, strict=True)]
    path = tmp_path / "k.dat"
    path.write_text("\n".join([f"{mark}KS", f"{mark}{kind} ", f"{mark}Ks band", *rows]))
    band = Filter.read(path)
    assert band.name == "KS"
    assert band.meta["n_negative"] == 3
    # response to photons, from which the pivot follows
    response = np.clip(value, 0.0, None) * wave**power
    weighed = np.trapezoid(response * wave, wave) / np.trapezoid(response / wave, wave)
    assert band.pivot.to_value(u.AA) == pytest.approx(np.sqrt(weighed), rel=1e-5)


@pytest.mark.parametrize("row", ["7,5 0,9", "7,5;0,9", "7,5\t0,9"])
def test_commas_in_place_of_points_are_refused(tmp_path, row):
    path = tmp_path / "c.dat"
    path.write_text(f"7,0 0,1\n{row}\n8,0 0,1\n")
    message = r"c\.dat has commas within its numbers, such as '7,0 0,1'"
    refuses(message, Filter.read, path, unit="um", error=DataError)


def test_csv_without_names_keeps_its_first_sample(tmp_path):
    path = tmp_path / "c.csv"
    path.write_text("7.0,0.2\n7.5,1.0\n8.0,0.4\n8.1,0\n")
    curve = Filter.read(path, unit="um")
    # after the vertical edge that a filter begins with
    assert_allclose(curve.wave.value[1:], [7.0, 7.5, 8.0, 8.1])
    assert_allclose(curve.throughput, [0.0, 0.2, 1.0, 0.4, 0.0])


@pytest.mark.parametrize("kind", ["photon", "energy"])
@pytest.mark.parametrize(
    ("line", "factor"), [("um", 1.0), ("[nm]", 1e3), ("a band at 7.7 um", 1e4)]
)
def test_a_unit_alone_in_a_line_counts_beside_the_kind_of_detector(tmp_path, kind, line, factor):
    """CIGALE's layout is in Angstrom where only the description has a unit; before, "# um" counted for nothing."""
    path = tmp_path / "mine.dat"
    rows = [(7.0, 0.0), (7.5, 0.6), (8.0, 0.6), (8.5, 0.0)]
    text = "".join(f"{wave * factor} {throughput}\n" for wave, throughput in rows)
    path.write_text(f"# mine\n# {kind}\n# {line}\n{text}")
    assert 7.6 < Filter.read(path).pivot.to_value(u.um) < 7.9
