import itertools
import shutil
import tarfile
import tomllib
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from helpers.components import values_of
from helpers.errors import refuses
from miricigale import conf
from miricigale.refdata.libraries import write_library
from miricigale.refdata.libraries.skirtor import read_skirtor
from miricigale.sed import _core
from miricigale.sed.components import ParametricTorus, Skirtor2016, TorusSpectra
from miricigale.utils.exceptions import DataError

LAWS = ("smc", "calzetti", "gaskell")


@pytest.fixture(scope="module")
def torus():
    return ParametricTorus()


@pytest.fixture(scope="module")
def wave(torus):
    return np.unique(np.concatenate([torus.nodes(), np.geomspace(0.008, 1e4, 1500)]))


class Bare(ParametricTorus):
    """A torus that sends out one watt whatever happens, and hides nothing."""

    name = "bare"

    def torus_spectra(self, wave, values):
        face_on = _core.disk_spectrum(wave, values["disk_slope"], self.disk)
        dust = _core.planck_lambda(wave, 300.0)
        return TorusSpectra(face_on, face_on, dust / np.trapezoid(dust, wave))


# ------------------------------------------------------------------------------- disk


@pytest.mark.parametrize("disk", sorted(_core.DISKS))
@pytest.mark.parametrize("delta", [-0.5, 0.0, 0.5])
def test_disk_has_unit_power_and_no_steps(disk, delta):
    breaks = _core.DISKS[disk][0]
    light = lambda x: np.exp(x) * _core.disk_spectrum(np.exp([x]), delta, disk)[0]  # noqa: E731
    total = sum(quad(light, *ends)[0] for ends in itertools.pairwise(np.log(breaks)))
    assert total == pytest.approx(1.0, rel=1e-6)
    for edge in breaks[1:-1]:
        low, high = _core.disk_spectrum(edge * np.array([1 - 1e-9, 1 + 1e-9]), delta, disk)
        assert low == pytest.approx(high, rel=1e-6)


@pytest.mark.parametrize(
    ("disk", "inside"), [("skirtor", (0.2, 4.0)), ("schartmann2005", (0.2, 9.0))]
)
def test_slope_of_the_disk_in_the_optical(disk, inside):
    inside = np.array(inside)
    for delta in (-0.36, 0.0, 0.7):
        light = _core.disk_spectrum(inside, delta, disk)
        slope = np.diff(np.log(light)) / np.diff(np.log(inside))
        assert slope[0] == pytest.approx(-1.5 + delta, rel=1e-9)


@pytest.mark.parametrize("disk", sorted(_core.DISKS))
def test_other_disks_have_the_same_power_and_leave_the_dust_alone(torus, disk):
    other = ParametricTorus(disk=disk)
    wave = np.unique(np.concatenate([torus.nodes(), other.nodes()]))
    values = values_of(torus, inclination=30.0)
    plain = torus.torus_spectra(wave, values)
    for delta in (-0.8, 0.4):
        changed = other.torus_spectra(wave, values | {"disk_slope": delta})
        power = [np.trapezoid(s.face_on, wave) for s in (plain, changed)]
        assert power[1] == pytest.approx(power[0], rel=1e-12)
        assert_array_equal(changed.dust, plain.dust)
        # what the torus lets through is a property of the torus
        both = (plain.face_on > 0) & (changed.face_on > 0)
        through = [s.disk[both] / s.face_on[both] for s in (plain, changed)]
        assert_allclose(through[1], through[0], rtol=1e-12)


# ------------------------------------------------------------------------- polar dust


def test_smc_law_is_the_published_power_law():
    got = _core.polar_curve(np.array([1.0, 0.55, 0.15]), "smc")
    assert_allclose(got, [1.39, 2.848, 13.54], rtol=1e-3)


def test_calzetti_law_has_its_ratio_of_total_to_selective_extinction():
    blue, visual = _core.polar_curve(np.array([0.44, 0.55]), "calzetti")
    assert visual == pytest.approx(4.05, abs=0.02)
    assert blue - visual == pytest.approx(1.0, abs=0.06)
    # as for starbursts down to the Lyman limit, on and not off below it
    wave = np.geomspace(0.0913, 5.0, 500)
    assert_allclose(_core.polar_curve(wave, "calzetti"), _core.leitherer_calzetti(wave), rtol=1e-12)
    below = _core.polar_curve(np.array([0.0911, 0.05, 0.02]), "calzetti")
    assert below[0] == pytest.approx(_core.polar_curve(np.array([0.0913]), "calzetti")[0], rel=0.01)
    assert np.all(np.diff(below) > 0)


def test_gaskell_law_joins_smoothly_and_is_flat_in_the_ultraviolet():
    """Table 3 of Gaskell et al. 2004: A(B)/A(V) = 1.182; the two pieces meet at 3.69 um^-1."""
    k = lambda x: _core.polar_curve(1.0 / np.asarray(x, dtype=float), "gaskell") * 0.182  # noqa: E731
    blue, visual = k([1 / 0.44, 1 / 0.55])
    assert visual == pytest.approx(1.0, abs=0.01)
    assert blue == pytest.approx(1.182, abs=0.002)
    low, high = k([3.69 - 1e-9, 3.69 + 1e-9])
    assert low == pytest.approx(high, abs=2e-4)
    slopes = [np.diff(k(x))[0] / 0.01 for x in ([3.68, 3.69], [3.69, 3.70])]
    assert slopes[0] == pytest.approx(slopes[1], abs=2e-3)
    assert k([8.0])[0] / k([3.69])[0] < 1.03
    infrared = k(np.linspace(0.01, 1.6, 400))
    assert infrared[0] == 0.0
    assert np.all(np.diff(infrared) >= 0.0)


@pytest.mark.parametrize("law", LAWS)
def test_no_law_makes_the_disk_brighter(law):
    assert np.all(_core.polar_curve(np.geomspace(1e-4, 1e4, 2000), law) >= 0.0)


def test_unknown_law_is_refused():
    refuses(r"'polar_law' must be .*gaskell, smc_wd01, got 'mrn'", ParametricTorus, polar_law="mrn")


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(("opening", "slope"), [(20.0, 0.0), (40.0, -0.4), (60.0, 0.4)])
def test_polar_dust_energy_by_integration_over_solid_angle(wave, law, opening, slope):
    """Along every line of sight that misses the torus, what is lost of cos i (1 + 2 cos i)."""
    bare = Bare(polar_law=law)
    values = values_of(bare, ebv_polar=0.25, opening_angle=opening, inclination=85.0)
    parts = bare.templates(wave, values | {"disk_slope": slope})
    got = np.trapezoid(parts.polar, wave) / np.trapezoid(parts.torus, wave)
    face_on = _core.disk_spectrum(wave, slope)
    through = 10 ** (-0.4 * 0.25 * _core.polar_curve(wave, law))
    angle = np.linspace(0.0, np.radians(90 - opening), 4001)
    pattern = np.cos(angle) * (1 + 2 * np.cos(angle)) / 3
    # both hemispheres, of 4 pi: int dOmega / 4 pi = int sin i di
    per_angle = pattern * np.trapezoid(face_on * (1 - through), wave) * np.sin(angle)
    assert got == pytest.approx(np.trapezoid(per_angle, angle), rel=1e-6)


def test_polar_dust_is_a_modified_blackbody(wave):
    bare = Bare()
    values = values_of(bare, ebv_polar=0.2, temperature_polar=130.0, emissivity_polar=1.3)
    polar = bare.templates(wave, values).polar
    shape = (1 - np.exp(-((200.0 / wave) ** 1.3))) * wave**-5.0
    shape /= np.expm1(np.minimum(14387.769 / (wave * 130.0), 600.0))
    bright = polar > 1e-12 * polar.max()
    ratio = polar[bright] / shape[bright]
    assert_allclose(ratio, ratio[0], rtol=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_polar_dust_dims_the_disk_only_where_the_line_of_sight_misses_the_torus(wave, law):
    torus = ParametricTorus(polar_law=law)
    for angle, dimmed in ((30.0, True), (50.0, True), (50.1, False), (70.0, False)):
        values = values_of(torus, inclination=angle)
        parts = [torus.templates(wave, values | {"ebv_polar": e}) for e in (0.0, 0.3)]
        visible = (wave > 0.1) & (wave < 1.0)
        seen = [p.disk[visible] / p.accretion_power for p in parts]
        curve = 10 ** (-0.4 * 0.3 * _core.polar_curve(wave[visible], law))
        assert_allclose(seen[1] / seen[0], curve if dimmed else 1.0, rtol=1e-10)


def test_without_polar_dust_its_parameters_make_no_difference(torus, wave):
    values = values_of(torus, ebv_polar=0.0)
    assert set(torus.inert(values)) == {"temperature_polar", "emissivity_polar"}
    first = torus.templates(wave, values)
    second = torus.templates(wave, values | {"temperature_polar": 500.0, "emissivity_polar": 1.0})
    assert_array_equal(first.total, second.total)
    assert not first.polar.any()


def test_wavelengths_without_dust_emission_are_refused(torus):
    wave, values = np.geomspace(0.05, 0.2, 50), values_of(torus, ebv_polar=0.1)
    refuses(r"'wave' must be a grid .* 50 points from 0\.05", torus.templates, wave, values)


def test_without_light_there_is_no_polar_dust():
    """Where the grid ends before its emission, too: nothing taken, nothing sent out."""
    wave = np.geomspace(0.05, 0.2, 50)
    grid, none = _core.polar_grid(wave, _core.polar_curve(wave, "smc")), np.zeros(50)
    for dust, total in ((none, 0.0), (np.ones(50), 0.15)):
        parts, *powers = _core.add_polar(grid, none, none, dust, 0.2, 100.0, 1.6, 0.1, True)
        assert_allclose(powers, [0.0, total], rtol=1e-12)
        assert_allclose(parts[1], dust / 0.15, rtol=1e-12)
        assert not parts[[0, 2]].any()


# ------------------------------------------------------------------------------ power


def test_torus_and_polar_dust_are_normalized_to_one_watt(torus, wave):
    parts = torus.templates(wave, values_of(torus, ebv_polar=0.2))
    assert np.trapezoid(parts.torus + parts.polar, wave) == pytest.approx(1.0, rel=1e-12)
    assert np.all(parts.polar >= 0)


@pytest.mark.parametrize("slope", [-0.5, 0.0, 0.5])
def test_accretion_power_is_the_disk_over_all_directions(wave, slope):
    """Disk light without any dust, summed over the sphere, for each watt of dust emission."""
    bare = Bare()
    values = values_of(bare, ebv_polar=0.2, disk_slope=slope, inclination=10.0)
    parts = bare.templates(wave, values)
    mu = np.linspace(0.0, 1.0, 2001)
    disk = np.trapezoid(_core.disk_spectrum(wave, slope), wave)
    over_angles = np.trapezoid(disk * mu * (1 + 2 * mu) / 3, mu)
    # the torus of Bare has one watt: its share of the template is the scale of the template
    scale = np.trapezoid(parts.torus, wave)
    assert parts.accretion_power == pytest.approx(over_angles * scale, rel=1e-6)


def test_face_on_disk_without_dust_is_hardly_dimmed(torus, wave):
    base = torus.torus_spectra(wave, values_of(torus, inclination=0.0, ebv_polar=0.0))
    seen = np.trapezoid(base.disk, wave) / np.trapezoid(base.face_on, wave)
    assert seen == pytest.approx(1.0, abs=0.06)


# ------------------------------------------------------------------- parametric torus


@pytest.mark.parametrize(("tau", "q"), [(5.0, 1.0), (9.0, 0.0)])
def test_torus_emits_what_the_disk_loses(torus, wave, tau, q):
    """Energy over all directions: disk = what is seen of the disk + dust emission."""
    values = values_of(torus, ebv_polar=0.0, tau97=tau, q=q)
    edge = np.cos(np.radians(47.0))
    x, w = np.polynomial.legendre.leggauss(40)
    total = 0.0
    for low, high in ((0.0, edge), (edge, 1.0)):
        for node, weight in zip(0.5 * (x + 1), 0.5 * w, strict=True):
            angle = float(np.degrees(np.arccos(low + (high - low) * node)))
            parts = torus.torus_spectra(wave, values | {"inclination": angle})
            total += (high - low) * weight * np.trapezoid(parts.disk + parts.dust, wave)
    emitted = 7 / 18 * np.trapezoid(torus.torus_spectra(wave, values).face_on, wave)
    assert total == pytest.approx(emitted, rel=2e-3)


@pytest.mark.parametrize("opening", [20.0, 30.0, 40.0, 50.0, 60.0])
@pytest.mark.parametrize("q", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("tau", [1.0, 7.0, 15.0])
def test_no_torus_takes_more_than_shines_on_it_nor_less_than_nothing(torus, tau, q, opening):
    """The disk's light between equator and edge, int mu (1 + 2 mu) dmu, in closed form."""
    constants = tomllib.loads(Path(torus.path).read_text())
    s = np.sin(np.radians(opening + constants["extinction"]["edge"]))
    belt = (s**2 / 2 + 2 * s**3 / 3) / (7 / 6)
    values = values_of(torus, tau97=tau, opening_angle=opening, q=q)
    assert 0.5 * belt < torus.absorbed_share(values) < belt


def test_opening_angles_beyond_the_fit_are_refused():
    for angle in (10.0, 70.0):
        refuses("'opening_angle' must be from 20", ParametricTorus, opening_angle=angle)


def test_silicate_feature_turns_from_emission_to_absorption(torus, wave):
    def strength(angle):
        dust = torus.torus_spectra(wave, values_of(torus, inclination=angle, q=0.0, tau97=9.0)).dust
        low, mid, high = np.interp([7.5, 9.7, 13.5], wave, dust * wave)
        return np.log(mid / np.sqrt(low * high))

    assert strength(10.0) > 0.1
    assert strength(90.0) < -0.3


def test_steeper_density_makes_a_hotter_torus(torus, wave):
    def color(p):
        dust = torus.torus_spectra(wave, values_of(torus, p=p)).dust
        return np.divide(*np.interp([4.0, 20.0], wave, dust))

    assert color(0.0) < color(1.0) < color(1.5)


def test_hidden_disk_is_weak_in_the_visible(torus, wave):
    values = values_of(torus, tau97=7.0, inclination=70.0, opening_angle=40.0, q=1.0)
    parts = torus.torus_spectra(wave, values)
    assert 1e-5 < np.interp(0.5, wave, parts.disk) / np.interp(0.5, wave, parts.face_on) < 1e-3


def test_torus_against_skirtor(real, torus, wave):
    """Shape in 2-40 um and the scale of dust light over disk light; tau 5, i 80 left out."""
    grid = np.geomspace(2, 40, 61)
    shape, scale = [], []
    for k in range(real.n_rows):
        tau, angle = (float(real.axes[a][k]) for a in ("tau97", "inclination"))
        if tau == 5 and angle == 80:
            continue
        theirs = real.spectra["dust"][k] * real.wave
        values = values_of(torus, q=0.0, tau97=tau, inclination=angle)
        ours = torus.torus_spectra(wave, values).dust
        ratio = np.log10(np.interp(grid, wave, ours * wave))
        log = np.log10(np.maximum(theirs, 1e-30))
        ratio -= np.interp(np.log(grid), np.log(real.wave), log)
        shape.append(ratio - ratio.mean())
        power = np.trapezoid(theirs / real.wave, real.wave)
        scale.append(np.log10(np.trapezoid(ours, wave) / power))
    assert np.sqrt(np.mean(np.square(shape))) < 0.058
    assert np.sqrt(np.mean(np.square(shape), axis=1)).max() < 0.15
    assert abs(np.mean(scale)) < 0.01
    assert np.std(scale) < 0.05


# ---------------------------------------------------------------------------- SKIRTOR

FLUX = 1e11 * 3.839e26 / (4 * np.pi * (1e7 * 3.0856775814913673e16) ** 2)  # W/m2
SHORT = 10 ** (np.arange(66) * 0.06 - 3)  # the library's steps: 0.06, 0.0144 and 0.06 dex
LONG = 10 ** (3 - np.arange(26) * 0.06)[::-1]
WAVE = np.concatenate([SHORT, np.geomspace(SHORT[-1], LONG[0], 42)[1:-1], LONG])


def spectrum(tau, p, q, opening, ratio, angle):
    """Columns of a made-up torus with SKIRTOR's disk: 132 rows, lambda F_lambda in W/m2."""
    mu = np.cos(np.radians(angle))
    disk = _core.disk_spectrum(WAVE, 0.0, "stalevski2016") * WAVE
    transparent = disk * 18 / 7 * mu * (1 + 2 * mu) / 3
    hidden = np.exp(-tau / WAVE) if angle > 90 - opening else np.ones(WAVE.size)
    direct, scattered = transparent * hidden, 0.02 * disk / (1 + WAVE**2)
    body = _core.planck_lambda(WAVE, 300.0 + 40 * p - 30 * q + ratio)
    dust = WAVE * body / np.trapezoid(body, WAVE) * (0.6 - 0.002 * angle)
    columns = [direct + scattered + dust, direct, scattered, dust, 0.03 * dust, transparent]
    return np.column_stack([WAVE, *(FLUX * c for c in columns)])


def text(table):
    names = ("lambda (micron)", "total flux; lambda*F_lambda (W/m2)", "direct stellar flux",
             "scattered stellar flux", "total dust emission flux", "dust emission scattered flux",
             "transparent flux")  # fmt: skip
    head = "".join(f"# column {k + 1}: {name}\n" for k, name in enumerate(names))
    return head + "".join(" ".join(f"{x:.8e}" for x in row) + "\n" for row in table)


def file_name(tau, p, q, opening, ratio, angle):
    return f"t{tau:g}_p{p:g}_q{q:g}_oa{opening:g}_R{ratio:g}_Mcl0.97_i{angle:g}_sed.dat"


@pytest.fixture
def folder(tmp_path):
    """A complete part of 2 x 1 x 2 x 1 x 1 x 3 spectra, in folders as in a source tree."""
    root = tmp_path / "cigale"
    for tau in (3, 7):
        below = root / "database_builder" / "skirtor2016" / f"t{tau}"
        below.mkdir(parents=True)
        for q in (0, 1.5):
            for angle in (0, 40, 70):
                key = (tau, 0.5, q, 40, 20, angle)
                (below / file_name(*key)).write_text(text(spectrum(*key)))
    (root / "README.dat").write_text("nothing of ours")
    return root


def a_file(folder, pattern="t7_p0.5_q0_*_i40_sed.dat"):
    return next(folder.rglob(pattern))


def test_folder_is_read_as_written(folder):
    library = read_skirtor(folder)
    assert library.n_rows == 12
    assert "12 of 19,200" in library.summary[0]
    levels = {"tau97": [3, 7], "q": [0, 1.5], "inclination": [0, 40, 70]}
    assert {name: library.levels[name].tolist() for name in levels} == levels
    assert len(library.meta["files"]) == 12
    assert_allclose(library.wave, WAVE, rtol=1e-7)
    key = (7, 0.5, 1.5, 40, 20, 70)
    table = spectrum(*key)
    row = library.row(**dict(zip(library.axes, key, strict=True)))
    # per watt of accretion: 4 pi d^2 F_lambda / L
    for name, column in (("dust", table[:, 4]), ("disk", table[:, 2] + table[:, 3])):
        want = column / FLUX / WAVE
        assert_allclose(library.spectra[name][row], want, rtol=2e-7, atol=1e-37)
    assert library.spectra["dust"].dtype == np.float32


@pytest.mark.parametrize("kind", ["zip", "gztar"])
def test_archives_and_folders_of_archives_are_the_same(folder, tmp_path, kind):
    wanted = read_skirtor(folder)
    (folder / "__MACOSX").mkdir()
    (folder / "__MACOSX/._t7_p0.5_q0_oa40_R20_Mcl0.97_i40_sed.dat").write_text("junk")
    archive = shutil.make_archive(tmp_path / "store/skirtor", kind, tmp_path, folder.name)
    for path in (archive, tmp_path / "store"):
        library = read_skirtor(path)
        assert_array_equal(library.spectra["disk"], wanted.spectra["disk"])
        assert_array_equal(library.axes["q"], wanted.axes["q"])


def test_archives_that_unpack_beyond_the_bound_are_refused(tmp_path):
    """A member that is all holes: nothing is stored of its 80 GB."""
    name = "t7_p0.5_q0_oa40_R20_Mcl0.97_i40_sed.dat"
    archive, info = tmp_path / "skirtor.tar", tarfile.TarInfo(name)
    sparse = {"GNU.sparse.major": "0", "GNU.sparse.minor": "1", "GNU.sparse.name": name}
    info.pax_headers = sparse | {"GNU.sparse.size": "80000000000", "GNU.sparse.map": "0,0"}
    with tarfile.open(archive, "w", format=tarfile.PAX_FORMAT) as out:
        out.addfile(info)
    with conf.set_temp("unpacked_size", 1):
        refuses("would unpack to", read_skirtor, archive, error=DataError)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: text(t)[:7000], "must have 132 rows of 7 num"),
        (lambda t: text(t).replace("e-", "x-", 1), "has text in a spectrum"),
        (lambda t: "# nothing", "must have 132 rows of 7 numbers .* got 0 words"),
        (lambda t: text(t * [1, *6 * [1e3]]), r"of 1e11 Lsun at 10 Mpc.*another unit"),
        (lambda t: text(t[:, [0, 1, 2, 3, 5, 4, 6]]), "not direct .* columns in another order"),
        (lambda t: text(t * [1.1, *6 * [1]]), "wavelengths"),
        (lambda t: text(np.where(t == t[50, 4], -t, t)), "negative, infinite or missing"),
    ],
)
def test_wrong_files_are_refused_by_name(folder, change, says):
    path = a_file(folder)
    path.write_text(change(np.loadtxt(path)))
    refuses(rf"t7_p0\.5_q0_.*i40_sed\.dat.*{says}", read_skirtor, folder, error=DataError)


def test_other_grids_are_refused_by_name(folder):
    key = (4, 0.5, 0, 40, 20, 0)
    other = folder / file_name(*key)
    other.write_text(text(spectrum(*key)))
    match = "tau97 4, which is not of SKIRTOR 2016: it has 3 5 7 9 11"
    refuses(match, read_skirtor, folder, error=DataError)
    other.unlink()
    a_file(folder).unlink()
    match = r"11 spectra, but .* make 12; .* t7_p0\.5_q0_oa40_R20_Mc"
    refuses(match, read_skirtor, folder, error=DataError)


def test_face_on_spectra_are_wanted(folder):
    for path in folder.rglob("*_i0_sed.dat"):
        path.unlink()
    refuses("no spectrum at inclination 0", read_skirtor, folder, error=DataError)


def test_one_model_twice_is_taken_once_if_it_is_the_same(folder):
    path = a_file(folder)
    copy = folder / "copy" / path.name
    copy.parent.mkdir()
    copy.write_bytes(path.read_bytes())
    assert read_skirtor(folder).n_rows == 12
    copy.write_text(text(np.loadtxt(path) * np.array([1, *6 * [1.001]])))
    refuses("the same model with different numbers", read_skirtor, folder, error=DataError)


def test_other_things_are_refused(tmp_path, folder):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match=r"empty holds no spectrum; wanted the SKIRTOR library"):
        read_skirtor(tmp_path / "empty")
    refuses(r"nowhere does not exist", read_skirtor, tmp_path / "nowhere", error=DataError)
    (tmp_path / "notes.txt").write_text("hello")
    refuses(r"notes\.txt", read_skirtor, tmp_path / "notes.txt", error=DataError)
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(tmp_path / "image.fits")
    with pytest.raises(DataError, match=r"image\.fits cannot be read as the SKIRTOR library"):
        read_skirtor(tmp_path / "image.fits")
    half = tmp_path / "half.tar.gz"
    with tarfile.open(half, mode="w:gz") as out:
        out.add(folder, "nested")
    half.write_bytes(half.read_bytes()[: half.stat().st_size // 2])
    match = r"half\.tar\.gz cannot be read as a packed file: .*ended"
    refuses(match, read_skirtor, half, error=DataError)


def write_fits(path, change=lambda name, column: column):
    """A file in lightningpy's layout, wavelengths descending: two optical depths."""
    rows = [(tau, angle) for angle in (0, 40, 70) for tau in (3, 7)]
    tables = [spectrum(tau, 1, 0, 40, 20, angle)[::-1] for tau, angle in rows]
    nu = 2.99792458e14 / WAVE[::-1]
    columns = {"INCLINATION": [float(a) for _, a in rows], "TAU": [float(t) for t, _ in rows]}
    columns |= {"WAVE_REST": [WAVE[::-1]] * 6, "NU_REST": [nu] * 6}
    names = ("TOTAL", "DISK_DIRECT", "DISK_SCATTERED", "DUST_TOTAL", "DUST_SCATTERED")
    for k, name in enumerate((*names, "TRANSPARENT"), 1):
        columns[f"LNU_{name}"] = [t[:, k] / FLUX * 1e11 / nu for t in tables]
    units = {"INCLINATION": "deg", "WAVE_REST": "um", "NU_REST": "Hz", "TAU": None}
    table = Table({name: change(name, np.array(values)) for name, values in columns.items()})
    for name in table.colnames:
        table[name].unit = units.get(name, "solLum / Hz")
    table.write(path)


def test_fits_grid_is_the_same_as_text(tmp_path):
    write_fits(tmp_path / "grid.fits")
    library = read_skirtor(tmp_path / "grid.fits")
    for tau in (3, 7):
        for angle in (0, 40, 70):
            key = (tau, 1, 0, 40, 20, angle)
            (tmp_path / file_name(*key)).write_text(text(spectrum(*key)))
    texts = read_skirtor(tmp_path)
    for name in library.spectra:
        assert_allclose(library.spectra[name], texts.spectra[name], rtol=1e-6, atol=1e-37)
    for name in library.axes:
        assert_array_equal(library.axes[name], texts.axes[name])


@pytest.mark.parametrize(
    ("column", "factor", "says"),
    [
        ("LNU_TRANSPARENT", 1.5, "another unit"),
        ("NU_REST", 1.1, "do not belong together"),
        ("LNU_DUST_TOTAL", -1.0, "column LNU_DUST_TOTAL, has negative, infinite or missing"),
        ("WAVE_REST", 10.0, "must have wavelengths from 0.001 to 1000 um"),
    ],
)
def test_wrong_fits_grids_are_refused(tmp_path, column, factor, says):
    path = tmp_path / "grid.fits"
    write_fits(path, lambda name, array: array * (factor if name == column else 1.0))
    refuses(rf"grid\.fits.*{says}", read_skirtor, path, error=DataError)


@pytest.fixture
def skirtor(folder, tmp_path):
    write_library(read_skirtor(folder), tmp_path / "skirtor2016.fits")
    part = Skirtor2016(p=0.5, q=1.5, disk="stalevski2016")
    part.path = str(tmp_path / "skirtor2016.fits")
    return part


def power(light, nodes):
    """Integral of a spectrum at WAVE: straight lines below 25 um, power laws beyond, at these nodes."""
    nodes = np.unique([*WAVE, *nodes[(nodes > 25) & (nodes < WAVE[-1])]])
    law = np.exp(np.interp(np.log(nodes), np.log(WAVE), np.log(np.maximum(light, 1e-300))))
    return np.trapezoid(np.where(nodes < 25, np.interp(nodes, WAVE, light), law), nodes)


def full_grid(part):
    return np.unique(np.concatenate([part.nodes(), np.geomspace(0.001, 1000, 3000)]))


@pytest.mark.parametrize("angle", [0.0, 40.0, 70.0])
def test_skirtor_gives_the_library_where_nothing_is_changed(skirtor, angle):
    wave = full_grid(skirtor)
    base = skirtor.torus_spectra(wave, values_of(skirtor, inclination=angle))
    table = spectrum(7, 0.5, 1.5, 40, 20, angle)
    dust = power(table[:, 4] / WAVE, skirtor.nodes())
    assert np.trapezoid(base.dust, wave) == pytest.approx(1.0, rel=1e-6)
    at = np.searchsorted(wave, WAVE * (1 - 1e-6))[:-1]
    assert_allclose(base.dust[at], (table[:, 4] / WAVE / dust)[:-1], rtol=1e-5, atol=1e-25)
    # power laws instead of straight lines between 132 points: 0.3 %; scattered light, 2 % of the
    # disk at inclination 0, takes the disk's color there
    disk = (table[:, 2] + table[:, 3]) / WAVE / dust
    assert_allclose(base.disk[at], disk[:-1], rtol=0.015, atol=1e-12)
    assert np.interp([1e-4, 2e3], wave, base.dust, left=0, right=0).tolist() == [0, 0]


def test_skirtor_accretion_power_is_that_of_the_files(skirtor):
    """1e11 Lsun, and the little that dust scatters upwards."""
    wave = full_grid(skirtor)
    parts = skirtor.templates(wave, values_of(skirtor, inclination=70.0, ebv_polar=0.0))
    table = spectrum(7, 0.5, 1.5, 40, 20, 70)
    dust = np.trapezoid(table[:, 4] / WAVE, WAVE) / FLUX
    assert parts.accretion_power * dust == pytest.approx(1.0, abs=0.02)
    assert np.trapezoid(parts.torus, wave) == pytest.approx(1.0, rel=1e-12)


def test_skirtor_keeps_its_power_with_another_disk(skirtor):
    other = Skirtor2016(p=0.5, q=1.5, disk="schartmann2005")
    other.path = skirtor.path
    wave = np.unique(np.concatenate([full_grid(skirtor), other.nodes()]))
    first, second = (
        part.torus_spectra(wave, values_of(part, inclination=40.0, disk_slope=slope))
        for part, slope in ((skirtor, 0.0), (other, -0.36))
    )
    power = [np.trapezoid(s.face_on, wave) for s in (first, second)]
    assert power[1] == pytest.approx(power[0], rel=1e-12)
    assert_array_equal(first.dust, second.dust)
    inside = (wave > 0.2) & (wave < 4)
    slope = np.gradient(np.log(second.face_on[inside]), np.log(wave[inside]))
    assert_allclose(slope, -1.86, rtol=1e-6)


def test_skirtor_says_what_it_has(skirtor):
    values = values_of(skirtor)
    assert skirtor.invalid(values) is None
    assert not skirtor.missing(tau97=3.0, q=[0.0, 1.5], age=5.0)
    assert skirtor.missing(q=[0.0, 1.0], tau97=3.0) == {"q": (0.0, 1.5)}
    says = skirtor.invalid(values | {"tau97": 5.0, "inclination": 45.0})
    assert "'tau97' must be one of 3, 7, got 5" in says
    assert "'inclination' must be one of 0, 40, 70, got 45" in says
    with pytest.raises(ValueError, match=r"'q' must be one of 0, 1\.5, got 1 "):
        skirtor.torus_spectra(full_grid(skirtor), values | {"q": 1.0})


# ------------------------------------------------------------------ the real SKIRTOR


@pytest.fixture(scope="module")
def real(data_file):
    return read_skirtor(data_file("skirtor2016/SKIRTOR.fits.gz"))


def test_real_spectra_conserve_energy(real):
    """Over the sphere, disk and dust send out what the disk makes, to 5 %."""
    assert_array_equal(real.levels["tau97"], [3, 5, 7, 9, 11])
    for tau in real.levels["tau97"]:
        rows = [real.row(tau97=tau, p=1, q=0, opening_angle=40, radius_ratio=20, inclination=i)
                for i in range(90, -10, -10)]  # fmt: skip
        light = real.spectra["disk"][rows] + real.spectra["dust"][rows]
        mu = np.cos(np.radians(np.arange(90, -10, -10)))
        total = np.trapezoid(np.trapezoid(light, real.wave, axis=1), mu)
        assert total == pytest.approx(1.0, abs=0.05)


def test_disk_of_the_real_library_is_the_form_of_2016(real):
    """Where nothing is in the way the library's disk is its power law, but for scattered light."""
    top = real.row(tau97=3, p=1, q=0, opening_angle=40, radius_ratio=20, inclination=0)
    shape = _core.disk_spectrum(real.wave, 0.0, "stalevski2016") * 18 / 7
    inside = real.wave < 30
    assert_allclose(real.spectra["disk"][top][inside] / shape[inside], 1.0, atol=0.1)


# ------------------------------------------------------- best models of CIGALE 2022


def best_model(data_file, name):
    """Rest wavelengths in um, columns and header of a best model."""
    path = data_file(f"cigale_seyferts/best_models/{name}_best_model.fits.gz")
    with fits.open(path) as hdus:
        header, rows = dict(hdus[1].header), hdus[1].data
        wave = rows["wavelength"] * 1e-3 / (1.0 + float(header["universe.redshift"]))
        return wave, {name: np.array(rows[name]) for name in rows.names}, header


@pytest.mark.parametrize("name", ["ESO_428-14", "Mrk_493", "Mrk_509", "NGC_4748"])
def test_polar_dust_with_grains_takes_what_that_of_cigale_2022_takes(data_file, name):
    """What polar dust sends out over the disk's power, for E(B-V) 0.03, 0.1 and 1, and two opening angles."""
    _, _, header = best_model(data_file, name)
    names = ("polar_dust_luminosity", "accretion_power", "EBV", "oa")
    dust, power, ebv, opening = (float(header[f"agn.{key}"]) for key in names)
    part, wave = Bare(polar_law="smc_wd01", disk="schartmann2005"), np.geomspace(0.001, 2000, 6000)
    # the parametric torus ends at 20 deg: the share of the disk's light in the cone is known
    inside = max(opening, 20.0)
    wanted = dust / power * _core.polar_share(inside) / _core.polar_share(opening)
    angles = {"opening_angle": inside, "inclination": 10.0}
    parts = part.templates(wave, values_of(part, ebv_polar=ebv, disk_slope=-0.36, **angles))
    got = np.trapezoid(parts.polar, wave) / parts.accretion_power
    assert got == pytest.approx(wanted, rel=3e-3)


def test_grains_leave_the_law_alone_beyond_a_tenth_of_a_micron(wave):
    tori = [ParametricTorus(polar_law=law) for law in ("smc", "smc_wd01")]
    values = values_of(tori[0], ebv_polar=0.2, inclination=10.0, opening_angle=40.0)
    one, two = (torus.templates(wave, values) for torus in tori)
    long = wave >= 0.1
    scale = one.accretion_power / two.accretion_power
    assert_allclose(two.disk[long] * scale, one.disk[long], rtol=1e-9)
    # grains of the SMC take less of the ionizing light than the power law continued
    assert np.all(two.disk[wave < 0.05] * scale >= one.disk[wave < 0.05])


@pytest.mark.parametrize("name", ["ESO_428-14", "Mrk_509"])
def test_torus_between_the_librarys_wavelengths_is_that_of_cigale(data_file, real, tmp_path, name):
    """CIGALE's own torus at the 132 wavelengths gives its spectrum at all others to 0.6 %, also beyond 70 um."""
    wave, columns, _ = best_model(data_file, name)
    torus = columns["agn.SKIRTOR2016_torus"]
    good = torus > 0
    light = np.exp(np.interp(np.log(real.wave), np.log(wave[good]), np.log(torus[good])))
    spectra = {n: np.array(array) for n, array in real.spectra.items()}
    spectra["dust"][:] = np.where(real.wave < wave[good][0], 0.0, light / light.max())
    library = type(real)(real.name, real.wave, real.axes, spectra, real.units)
    write_library(library, tmp_path / "skirtor2016.fits")
    part = Skirtor2016(q=0.0)
    part.path = str(tmp_path / "skirtor2016.fits")
    nodes = part.nodes()
    ours = np.interp(wave, nodes, part.torus_spectra(nodes, values_of(part)).dust)
    for low, high, limit in ((3.5, 25.0, 0.001), (32.0, 900.0, 0.006)):
        inside = (wave > low) & (wave < high)
        ratio = ours[inside] / torus[inside]
        assert np.abs(ratio / np.median(ratio) - 1.0).max() < limit
