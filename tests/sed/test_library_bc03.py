import dataclasses
import gzip

import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.components import values_of
from helpers.errors import refuses
from miricigale import conf
from miricigale.refdata.libraries import add_library, write_library
from miricigale.refdata.libraries.bc03 import read_bc03
from miricigale.refdata.libraries.ised import read_ised
from miricigale.sed import SEDModel
from miricigale.sed.components import BC03Library, ConstantSFH
from miricigale.utils.exceptions import DataError

AGE = np.array([0.0, 125893.0, 1e6, 1e7, 1e8, 1e9, 1e10, 2e10])
WAVE = np.concatenate([np.geomspace(91, 1e5, 200), [1.3e5, 2.6e5, 8e5, 1.6e6]])
TEXT = "Padova (1994) + S. Charlot (1997). X=0.70, Y=0.28, Z={:g}"
NAME = "bc2003_lr_m62_chab_ssp"


def content(*, metallicity=0.02, law=0, slopes=(), age=AGE, wave=WAVE, text=TEXT):
    """Numbers of a file of GALAXEV: light falls with age, beyond 1 um as a power of wavelength."""
    level = 1e-3 * metallicity**-0.1 / (1 + age / 1e6)
    spectra = (level[:, None] * np.minimum(wave / 1e4, (wave / 1e4) ** -3.5)).astype("f4")
    n = age.size
    mass = (1 - 0.045 * np.log10(1 + age / 1e4)).astype("f4")
    remnants = (0.02 * np.log10(1 + age / 1e7)).astype("f4")
    others = [np.full(n, i + 0.5, dtype="f4") for i in range(12)]
    others[1], others[9] = mass, remnants
    line = text.format(metallicity)
    out = {"age": age.astype("f4"), "wave": wave.astype("f4"), "spectra": spectra}
    return out | {"law": law, "slopes": slopes, "text": line, "vectors": others}


def binary(parts, order="<", n_vectors=12):
    """Fortran's unformatted records, as GALAXEV writes them."""

    def packed(item):
        if isinstance(item, bytes):
            return item
        item = np.asarray(item)
        return item.astype(order + item.dtype.str[1:]).tobytes()

    def record(*items):
        data = b"".join(map(packed, items))
        size = packed(np.int32(len(data)))
        return size + data + size

    integer = np.int32
    text = parts["text"].ljust(80).encode()
    segments = [np.array([x, 0.1, 100, 0, 1, 1], dtype="f4") for x in parts["slopes"]]
    one = np.ones(4, dtype="f4")
    n = parts["age"].size
    out = record(
        *(integer(n), parts["age"], np.array([0.1, 100], dtype="f4")),
        *(integer(len(segments)), *segments, np.array([1, 1.5, 0.67], dtype="f4")),
        *(integer(parts["law"]), np.array(1e9, dtype="f4"), text, one, text, text),
        *(integer(-2), integer(0)),
    )
    out += record(integer(parts["wave"].size), parts["wave"])
    index = np.linspace(0, 1, 52).astype("f4")
    for row in parts["spectra"]:
        out += record(integer(row.size), row, integer(52), index)
    for vector in parts["vectors"][:n_vectors]:
        out += record(integer(n), vector)
    return out


def ascii_text(parts, n_vectors=12):
    """Fortran's list-directed output: a new line for each record, wrapped at 80 columns or so."""

    def record(*items):
        words = []
        for item in items:
            item = np.atleast_1d(item)
            form = "{:d}" if item.dtype.kind == "i" else "{:.8E}"
            words += [form.format(x) for x in item.tolist()]
        rows = [words[i : i + 5] for i in range(0, len(words), 5)]
        return "".join("  " + "   ".join(row) + "\n" for row in rows)

    n = parts["age"].size
    out = record(n, parts["age"])
    segments = [x for s in parts["slopes"] for x in (s, 0.1, 100.0, 0.0, 1.0, 1.0)]
    out += record(0.1, 100.0, len(parts["slopes"]), *segments)
    out += record(1.0, 1.5, 0.67, parts["law"], 1e9)
    out += " 4*1.000000 -2 F\n" + 3 * (parts["text"] + "\n")
    out += record(parts["wave"].size, parts["wave"])
    for row in parts["spectra"]:
        out += record(row.size, row, 52, np.linspace(0, 1, 52))
    for vector in parts["vectors"][:n_vectors]:
        out += record(n, vector)
    return out.encode()


FORMS = {
    "little": (".ised", binary),
    "big": (".ised", lambda parts: binary(parts, ">")),
    "ascii": (".ised_ASCII", ascii_text),
}


@pytest.fixture
def write(tmp_path):
    def write(name=NAME, *, form="little", zipped=False, **changes):
        ending, writer = FORMS[form]
        data = writer(content(**changes))
        path = tmp_path / f"{name}{ending}{'.gz' if zipped else ''}"
        path.write_bytes(gzip.compress(data) if zipped else data)
        return path

    return write


# ------------------------------------------------------------------------- one file


@pytest.mark.parametrize("zipped", [False, True])
@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("name", "slopes"), [(NAME, ()), ("bc2003_lr_m62_salp_ssp", (1.35,))])
def test_every_form_of_a_file_gives_what_was_written(write, form, zipped, name, slopes):
    path = write(name, form=form, zipped=zipped, slopes=slopes)
    got, want = read_ised(path), content(slopes=slopes)
    assert_array_equal(got.age, want["age"])
    assert_array_equal(got.wave, want["wave"])
    assert_allclose(got.spectra, want["spectra"], rtol=1e-7)
    assert_allclose(got.quantities["mass"], want["vectors"][1], rtol=1e-7)
    assert_allclose(got.quantities["sfr"], 2.5)
    assert_allclose(got.quantities["remnants"], want["vectors"][9], rtol=1e-7)
    assert got.law == 0
    assert got.metallicity == 0.02
    assert got.slopes == slopes
    assert got.mass_limits == pytest.approx((0.1, 100))
    assert got.texts == (TEXT.format(0.02),) * 3


@pytest.mark.parametrize("form", FORMS)
def test_a_file_cut_anywhere_is_refused(write, form):
    path = write(form=form)
    data, record = path.read_bytes(), 4 * AGE.size + 12
    # the last two vectors need not be there
    needed = len(data) - 2 * record if form != "ascii" else int(0.98 * len(data))
    cuts = np.random.default_rng(11).integers(60, needed, 40)
    for cut in [0, 1, 3, 4, 50, *cuts, needed - record, needed - 1]:
        path.write_bytes(data[:cut])
        match = rf"{path.name} cannot be read as a file of GALAXEV"
        refuses(match, read_ised, path, error=DataError)


@pytest.mark.parametrize("data", [b"nothing of the kind\n" * 100, bytes(5000), b"12 of them\n"])
def test_foreign_files_are_refused(tmp_path, data):
    path = tmp_path / "foreign.ised"
    path.write_bytes(data)
    refuses(r"foreign\.ised cannot be read as a file of GALAXEV", read_ised, path, error=DataError)


@pytest.mark.parametrize(
    ("row", "match"),
    [
        (np.full(WAVE.size, np.nan), "spectra must be finite"),
        (np.full(WAVE.size, np.inf), "spectra must be finite"),
        (np.full(WAVE.size, -1e-9), "spectra must be 0 or more"),
        (np.ones(WAVE.size - 1), rf"record 7 must hold {WAVE.size} numbers, got"),
    ],
)
def test_impossible_spectra_are_refused(tmp_path, row, match):
    parts = content()
    parts["spectra"] = [*parts["spectra"][:4], row.astype("f4"), *parts["spectra"][5:]]
    path = tmp_path / "bad.ised"
    path.write_bytes(binary(parts))
    refuses(rf"bad\.ised .*{match}", read_ised, path, error=DataError)


def test_composites_of_the_authors(data_file):
    """Exponential rates normalized to 1 Msun in infinite time, of a Chabrier IMF, solar."""
    part = read_ised(data_file("bc03/bc2003_lr_m62_chab_tau3_dust00.ised.gz"))
    assert part.spectra.shape == (221, 1221)
    assert (part.law, part.tau, part.metallicity) == (4, 3e9, 0.02)
    assert "exponential, tau 3 Gyr" in part.history
    assert_allclose(part.quantities["sfr"][1:], np.exp(-part.age[1:] / 3e9) / 3e9, rtol=1e-6)
    # the bolometric flux is the integral of the spectrum
    rows = part.age > 0
    total = np.trapezoid(part.spectra[rows].astype(float), part.wave, axis=1)
    assert_allclose(total, part.quantities["bolometric"][rows], rtol=0.01)
    delayed = read_ised(data_file("bc03/bc2003_lr_m62_chab_delayed1_dust00.ised.gz"))
    assert "delayed, tau 1 Gyr" in delayed.history


# ---------------------------------------------------------------------- a library


@pytest.fixture
def folder(write, tmp_path):
    write("bc2003_lr_m42_chab_ssp", metallicity=0.004, form="big")
    write("bc2003_lr_m72_chab_ssp", metallicity=0.05, form="ascii", zipped=True)
    write(NAME)
    (tmp_path / "bc2003_lr_m62_chab_ssp.1color").write_text("not a spectrum\n")
    return tmp_path


def test_a_folder_is_one_library(folder):
    library = read_bc03(folder)
    assert_array_equal(library.levels["metallicity"], [0.004, 0.02, 0.05])
    assert library.meta["imf"] == "Chabrier"
    assert library.meta["version"] == 2003
    assert len(library.meta["files"]) == 3
    for z in (0.004, 0.02, 0.05):
        want = content(metallicity=z)
        for i, age in enumerate(AGE.astype("f4").astype(float) / 1e6):
            got = library.spectra["luminosity"][library.row(metallicity=z, age=age)]
            known = np.isin(library.wave, want["wave"].astype(float) / 1e4)
            assert known.sum() == WAVE.size
            # Lsun/A in W/um, with the solar luminosity of GALAXEV
            assert_allclose(got[known], want["spectra"][i] * 3.826e30, rtol=1e-6)


def test_living_mass_is_without_remnants(write):
    library, parts = read_bc03(write()), content()
    living = library.values["surviving"]
    assert living[0] == 1.0
    assert_allclose(living[1:], (parts["vectors"][1] - parts["vectors"][9])[1:])
    assert_allclose(library.values["remnants"], parts["vectors"][9])
    # the files of 2016 have living stars
    age = np.where(AGE == 125893.0, 1e5, AGE)
    library = read_bc03(write("bc2003_lr_xmiless_m62_chab_ssp", age=age))
    assert_allclose(library.values["surviving"][1:], content(age=age)["vectors"][1][1:])
    assert library.meta["version"] == 2016
    with pytest.raises(DataError, match="whether its mass of stars includes remnants"):
        read_bc03(write(age=np.where(AGE == 125893.0, 3e5, AGE)))


@pytest.mark.parametrize("remnants_counted", [True, False])
def test_mass_of_gas_tells_what_the_mass_of_stars_is(tmp_path, remnants_counted):
    parts = content(age=np.where(AGE == 125893.0, 3e5, AGE))
    mass, remnants = parts["vectors"][1], parts["vectors"][9]
    gas = 1 - mass - (0 if remnants_counted else remnants)
    parts["vectors"] += [gas, np.ones_like(gas)]
    path = tmp_path / f"{NAME}.ised"
    path.write_bytes(binary(parts, n_vectors=14))
    want = mass - remnants if remnants_counted else mass
    assert_allclose(read_bc03(path).values["surviving"][1:], want[1:])
    parts["vectors"][12] = 2 * gas
    path.write_bytes(binary(parts, n_vectors=14))
    refuses("do not sum to 1 Msun", read_bc03, path, error=DataError)


def test_far_infrared_is_dense_and_goes_on(write):
    """Between sparse points and beyond the last a power law stays one."""
    short = WAVE[WAVE < 3e5]
    library = read_bc03(write(wave=short))
    assert library.wave[-1] == pytest.approx(160.0)
    far = library.wave > 10
    assert np.diff(np.log(library.wave[far])).max() < 1 / 30 + 1e-9
    row = library.spectra["luminosity"][3].astype(float)
    slope = np.diff(np.log(row[far])) / np.diff(np.log(library.wave[far]))
    assert_allclose(slope, -3.5, atol=2e-4)
    assert "continued from 26 to 160 um" in library.summary


def test_names_of_2016_and_a_metallicity_from_the_name(write):
    path = write("bc2003_hr_stelib_m52_chab_ssp", text="no metallicity here")
    assert read_bc03(path).levels["metallicity"] == [0.008]
    path = write("bc2003_hr_xmiless_m162_kroup_ssp", metallicity=0.019, slopes=(0.3, 1.3))
    library = read_bc03(path)
    assert (library.meta["imf"], library.levels["metallicity"][0]) == ("Kroupa", 0.019)


@pytest.mark.parametrize(
    ("name", "changes", "match"),
    [
        (NAME, {"metallicity": 0.008}, "states Z = 0.008, but its name .m62. means Z = 0.02"),
        ("mine_chab", {"text": "nothing"}, "states no metallicity"),
        ("bc2003_lr_m62_salp_ssp", {}, "holds a Chabrier IMF, but its name means Salpeter"),
        (NAME, {"slopes": (1.35,)}, "holds a Salpeter IMF, but its name means Chabrier"),
        ("bc2003_lr_m62_ssp", {"slopes": (0.3, 1.3)}, "names no IMF"),
        (NAME, {"law": 6}, "composite population .delayed, tau 1 Gyr.*wanted a single burst"),
    ],
)
def test_files_that_contradict_themselves_are_refused(write, name, changes, match):
    refuses(match, read_bc03, write(name, **changes), error=DataError)


@pytest.mark.parametrize(
    ("name", "changes", "match"),
    [
        ("bc2003_hr_m72_chab_ssp", {"wave": WAVE[::2]}, "are not one set: .* wavelengths"),
        ("bc2003_lr_m72_salp_ssp", {"slopes": (1.35,)}, "are not one set: .* IMF"),
        ("bc2003_lr_m72_chab_ssp", {"age": np.append(AGE, 3e10)}, "are not one set: .* ages"),
        ("copy_m72_chab", {"metallicity": 0.02, "text": "Z=0.02"}, "but its name"),
    ],
)
def test_mixtures_are_refused(write, tmp_path, name, changes, match):
    write()
    write(name, **({"metallicity": 0.05} | changes))
    refuses(match, read_bc03, tmp_path, error=DataError)


def test_the_same_metallicity_twice_is_refused_but_a_pattern_picks_one(write, tmp_path):
    write()
    write(form="ascii")
    match = r"the same metallicity as bc2003_lr_m62_chab_ssp\.ised,"
    refuses(match, read_bc03, tmp_path, error=DataError)
    assert len(read_bc03(tmp_path / "*_ssp.ised").meta["files"]) == 1
    refuses(r"wanted files .*got none", read_bc03, tmp_path / "*.none", error=DataError)


# ------------------------------------------------------------------ the component


@pytest.fixture
def registered(folder, tmp_path):
    with conf.set_temp("data_folder", str(tmp_path / "data")):
        add_library("ssp.bc03_user", folder)
        yield BC03Library()


def test_component_gives_the_table_of_each_metallicity(registered):
    want = content(metallicity=0.004)
    age, spectra, living = registered.table(0.004)
    assert_allclose(age, AGE / 1e6, rtol=1e-6)
    visual = np.searchsorted(registered.nodes(), 0.55)
    wave = registered.nodes()[visual]
    level = np.interp(wave, want["wave"] / 1e4, want["spectra"][4]) * 3.826e30
    assert spectra[4, visual] == pytest.approx(level, rel=1e-3)
    assert_allclose(living[1:], (want["vectors"][1] - want["vectors"][9])[1:], rtol=1e-6)
    assert living[0] == 1.0
    assert registered.metallicities() == (0.004, 0.02, 0.05)
    assert registered.invalid(values_of(registered)) is None
    says = registered.invalid(values_of(registered, metallicity=0.008))
    assert "must be one of 0.004, 0.02, 0.05, got 0.008" in says
    assert registered.settings["imf"] == registered.imf == "Chabrier"
    assert "Chabrier" in registered.library


def test_ionizing_photons_of_a_ramp(registered):
    """L = c lambda below 1 um: photons c (l^3 - l0^3) / (3 h c) below the Lyman limit."""
    got = registered.ionizing(0.02)
    level = 1e-3 * 0.02**-0.1 / (1 + AGE / 1e6) * 3.826e30
    hc = 6.62607015e-34 * 2.99792458e14
    want = level * (0.0912**3 - 0.0091**3) / 3 / hc
    assert_allclose(got, want, rtol=1e-5)


def test_whole_models_use_the_library(registered):
    model = SEDModel([ConstantSFH(age=0.1), registered])
    table = QTable({"redshift": [0.5, 0.5, 0.5], "metallicity": [0.02, 0.004, 0.01]})
    fluxes = model.fluxes(table, ["megacam.r", "irac.ch1"])
    flux = fluxes["megacam.r"].value
    # the made-up light goes as metallicity^-0.1
    assert flux[1] / flux[0] == pytest.approx(5**0.1, rel=1e-5)
    assert np.isnan(flux[2])
    assert fluxes["flags"][2] > 0


def test_without_the_files_the_error_says_what_to_do(tmp_path):
    with conf.set_temp("data_folder", str(tmp_path)):
        part = BC03Library()
        assert "BC03Library" in repr(part)
        refuses(r"miricigale data add ssp\.bc03_user PATH", part.nodes, error=DataError)


def test_libraries_of_former_versions_name_the_surviving_mass_living(write, tmp_path):
    library = read_bc03(write())
    values = dict(library.values)
    values["living"] = values.pop("surviving")
    write_library(dataclasses.replace(library, values=values), tmp_path / "old.fits")
    stars = BC03Library()
    stars.path = str(tmp_path / "old.fits")
    assert_array_equal(stars.table(0.02)[2], library.values["surviving"])
