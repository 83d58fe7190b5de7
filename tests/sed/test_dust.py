import shutil

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.modeling.models import BlackBody
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import brentq

from helpers.components import values_of
from helpers.errors import refuses
from miricigale.refdata.libraries import write_library
from miricigale.refdata.libraries.dale2014 import read_dale2014
from miricigale.sed import SEDModel, _core
from miricigale.sed.components.dust import (
    Casey2012,
    Dale2014,
    DraineLi2007,
    DraineLi2007Alpha,
    load_dl07,
)
from miricigale.utils.exceptions import DataError

EVERY = [Casey2012, Dale2014, DraineLi2007, DraineLi2007Alpha]
ALPHA = np.arange(1, 65) / 16.0


# ------------------------------------------------------- files like Dale et al.'s


def synthetic_wave():
    start = [0.36, 0.45, 0.58, 0.75, 1.0, 1.009, 1.019, 1.028]
    return np.append(start, np.geomspace(1.038, 224591.141, 1010))


def synthetic_stars(wave):
    return _core.planck_lambda(wave, 4000.0) / _core.planck_lambda(1.0, 4000.0)


def synthetic_dust(wave, alpha):
    """Blackbodies of 90 to 30 K as alpha grows, of 40 times the power of the stars."""
    dust = _core.modified_blackbody(wave, 90.0 - 15.0 * alpha, 1.5)
    stars = synthetic_stars(wave)
    return 40.0 * dust / np.trapezoid(dust, wave) * np.trapezoid(stars, wave)


@pytest.fixture(scope="module")
def dale_folder(tmp_path_factory):
    """A folder with files of the distributed format, made of known starlight and dust."""
    folder = tmp_path_factory.mktemp("dale2014")
    wave = synthetic_wave()
    stars, columns, colors = synthetic_stars(wave), [wave], []
    for alpha in ALPHA:
        dust = synthetic_dust(wave, alpha)
        columns.append(np.log10((stars + dust) * wave))
        at60, at100 = np.interp([60.0, 100.0], wave, synthetic_dust(wave, alpha))
        colors.append(np.log10(at60 * 60.0**2 / (at100 * 100.0**2)))
    formats = ["%10.3f"] + ["%9.5f"] * ALPHA.size
    np.savetxt(folder / "spectra.0.00AGN.dat", np.column_stack(columns), fmt=formats)
    head = "Ndhmod\n64\nNdh alpha lgfnu60_fnu100 lgLIR_M[Lsol] lgLIR_C[Lsol]"
    table = np.column_stack([np.arange(1, 65), ALPHA, colors])
    np.savetxt(folder / "dhcal.dat", table, fmt="%02d %.4f %7.4f 12.0 11.9", header=head)
    save_stars(folder, 0.0)
    return folder


def save_stars(folder, slope):
    """The file of starlight, of the synthetic stars times a power of wavelength."""
    grid = np.geomspace(0.1, 160.0, 4000)
    light = synthetic_stars(grid) * grid**slope
    table = np.column_stack([grid * 1e4, light, 0 * light, light])
    np.savetxt(folder / "stellar_SED_age13Gyr_tau10Gyr.spec", table, header="made for a test")


def registered(library, folder):
    """Use a library as that of the data folder while a module is tested."""
    write_library(library, folder / "sed/dale2014.fits")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MIRICIGALE_DATA", str(folder))
        yield library


@pytest.fixture
def dale(dale_folder, tmp_path):
    yield from registered(read_dale2014(dale_folder), tmp_path)


@pytest.fixture(scope="module")
def real(data_file):
    """The distributed files."""
    return read_dale2014(data_file("dale2014"))


@pytest.fixture
def real_dale(real, tmp_path):
    yield from registered(real, tmp_path)


# ---------------------------------------------------------------- every component


@pytest.mark.parametrize("cls", EVERY)
def test_templates_are_not_negative_end_at_the_nodes_and_send_out_one_watt(cls, dale):
    part, rng = cls(), np.random.default_rng(1)
    nodes = part.nodes()
    for _ in range(20):
        values = {n: rng.uniform(*p.bounds) for n, p in part.parameters.items()}
        template = part.template(nodes, **values)
        assert template.min() >= 0.0
        assert np.trapezoid(template, nodes) == pytest.approx(1.0, rel=1e-12)
    outside = np.array([0.5 * nodes[0], 2.0 * nodes[-1]])
    assert_array_equal(part.template(outside), 0.0)


# ------------------------------------------------------------- Dale et al. 2014


def test_subtraction_of_starlight_leaves_the_dust(dale_folder):
    """The files hold stars and blackbodies: what is left is the blackbodies."""
    library = read_dale2014(dale_folder)
    assert_array_equal(library.axes["alpha"], ALPHA)
    seen = library.wave > 2.5
    for i in (0, 31, 63):
        truth = synthetic_dust(library.wave, ALPHA[i])
        truth /= np.trapezoid(truth, library.wave)
        removed, kept = (library.spectra[name][i] for name in ("removed", "kept"))
        # what is left of the stars is the rounding of the file
        assert np.all(np.abs(removed - truth)[seen] < 1e-3 * kept[seen])
    assert library.meta["starlight"] == "stellar_SED_age13Gyr_tau10Gyr.spec"
    # where it is kept, the starlight between 2 um and 1 cm is part of the one watt
    wave = synthetic_wave()
    both = synthetic_stars(wave) + synthetic_dust(wave, 2.0)
    used = (wave >= 2.0) & (wave <= 1e4)
    truth = both[used] / np.trapezoid(both[used], wave[used])
    assert_allclose(library.spectra["kept"][31], truth, rtol=1e-3)


def test_starlight_is_scaled_at_the_wavelength_of_cigale(dale_folder, tmp_path):
    """
    Starlight bluer by l^-1/2 than the file's leaves 1 - (l / 1.028)^-1/2 of it.

    CIGALE scales at the eighth row of the templates, 1.028 um.
    """
    folder = tmp_path / "dale"
    shutil.copytree(dale_folder, folder)
    save_stars(folder, -0.5)
    library = read_dale2014(folder)
    # dust of 30 K is nothing in the near infrared; the ratio of two wavelengths has no scale
    removed, kept = (library.spectra[name][63] for name in ("removed", "kept"))
    near = (library.wave > 2.0) & (library.wave < 5.0)
    closed = 1.0 - (library.wave[near] / 1.028) ** -0.5
    ratio = removed[near] / kept[near]
    assert_allclose(ratio / ratio[-1], closed / closed[-1], rtol=5e-3)


def test_without_the_stellar_file_bundled_populations_are_subtracted(dale_folder, tmp_path):
    for name in ("spectra.0.00AGN.dat", "dhcal.dat"):
        shutil.copy(dale_folder / name, tmp_path)
    library = read_dale2014(tmp_path)
    assert "ssp.bc03" in library.meta["starlight"]
    assert any("ssp.bc03" in line for line in library.summary)
    assert sorted(library.meta["files"]) == ["dhcal.dat", "spectra.0.00AGN.dat"]
    # whatever the starlight is, dust beyond 20 um does not feel it
    far = library.wave > 20.0
    truth = synthetic_dust(library.wave, 2.0)
    got = library.spectra["removed"][31]
    ratio = got[far] / truth[far]
    assert np.ptp(ratio) / ratio.mean() < 1e-3


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("spectra.0.00AGN.dat", lambda t: t[: len(t) // 2], "row .* columns|1018 rows, got"),
        ("spectra.0.00AGN.dat", lambda t: t[: t.rindex("\n", 0, -9) + 1], "1018 rows, got 1017"),
        ("spectra.0.00AGN.dat", lambda t: "hello\n" + t, "columns"),
        ("spectra.0.00AGN.dat", lambda t: t.replace("  0.450 ", "  nan "), "finite"),
        ("spectra.0.00AGN.dat", lambda t: t.replace("  0.450 ", "  0.650 "), "ascending"),
        ("dhcal.dat", lambda t: t.replace("02 0.1250", "02 0.1300"), "64 steps"),
        ("dhcal.dat", lambda t: t[: t.index("40 2.5")], "64 steps .* got 39 rows"),
        ("stellar_SED_age13Gyr_tau10Gyr.spec", lambda t: t[: len(t) // 3], "columns|starlight"),
    ],
)
def test_damaged_files_are_refused_by_name(dale_folder, tmp_path, name, change, message):
    folder = tmp_path / "dale"
    shutil.copytree(dale_folder, folder)
    text = (folder / name).read_text()
    assert change(text) != text
    (folder / name).write_text(change(text))
    with pytest.raises(DataError, match=message) as caught:
        read_dale2014(folder)
    assert name in str(caught.value)


def test_columns_in_another_order_are_refused(dale_folder, tmp_path):
    folder = tmp_path / "dale"
    shutil.copytree(dale_folder, folder)
    table = np.loadtxt(folder / "spectra.0.00AGN.dat")
    table[:, 1:] = table[:, :0:-1]
    np.savetxt(folder / "spectra.0.00AGN.dat", table, fmt="%.5f")
    with pytest.raises(DataError, match=r"does not fit .*dhcal\.dat: log f60/f100 differs by"):
        read_dale2014(folder)


def test_other_places_are_refused_by_name(dale_folder, tmp_path):
    match = r"nowhere .* no such file or folder"
    refuses(match, read_dale2014, tmp_path / "nowhere", error=DataError)
    match = r"must hold one spectra\.0\.00AGN\.dat, got none"
    refuses(match, read_dale2014, tmp_path, error=DataError)
    path = tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(path)
    refuses(r"other\.fits cannot be read as templates", read_dale2014, path, error=DataError)
    half = tmp_path / "half"
    half.mkdir()
    shutil.copy(dale_folder / "spectra.0.00AGN.dat", half)
    refuses(r"half has spectra.* without dhcal\.dat", read_dale2014, half, error=DataError)
    for name in ("a", "b"):
        shutil.copytree(dale_folder, tmp_path / "two" / name)
    refuses("must hold one", read_dale2014, tmp_path / "two", error=DataError)
    (tmp_path / "cut.zip").write_bytes(b"PK\x03\x04" + bytes(500))
    refuses(r"cut\.zip", read_dale2014, tmp_path / "cut.zip", error=DataError)


@pytest.mark.parametrize("starlight", ["removed", "kept"])
def test_templates_are_exact_at_their_alphas_and_linear_between(dale, starlight):
    spectra, part = dale.spectra[starlight], Dale2014(starlight=starlight)
    nodes = part.nodes()
    for i in (0, 17, 63):
        assert_allclose(part.template(nodes, alpha=ALPHA[i]), spectra[i], rtol=1e-12)
    got = part.template(nodes, alpha=0.25 * ALPHA[30] + 0.75 * ALPHA[31])
    assert_allclose(got, 0.25 * spectra[30] + 0.75 * spectra[31], rtol=1e-12)


def test_distributed_templates_have_the_colors_that_are_listed(real_dale):
    """dhcal.dat lists log f_nu(60)/f_nu(100) of IRAS bands; ours are monochromatic."""
    wave = real_dale.wave
    fluxes = [np.interp([60.0, 100.0], wave, row * wave**2) for row in real_dale.spectra["removed"]]
    colors = np.log10(np.divide(*np.transpose(fluxes)))
    assert_allclose(colors, real_dale.values["log_f60_f100"], rtol=0, atol=0.04)
    assert real_dale.meta["negative"] == 0
    assert any("CIGALE 0.9" in line for line in real_dale.summary)


def test_total_infrared_luminosity_from_three_bands(real_dale):
    """L(3-1100 um) = 1.559 nuL(24) + 0.7686 nuL(70) + 1.347 nuL(160): Dale & Helou 2002."""
    wave = real_dale.wave
    part = (wave >= 3.0) & (wave <= 1100.0)
    for row in real_dale.spectra["removed"]:
        bands = np.interp([24.0, 70.0, 160.0], wave, row * wave)
        total = np.trapezoid(row[part], wave[part])
        assert bands @ [1.559, 0.7686, 1.347] == pytest.approx(total, rel=0.03)


def test_starlight_matters_only_below_three_micron(real_dale):
    """What docs/method/sed/dale2014.rst states: 22 % at 2 um, 0.4 % at most beyond 5 um."""
    wave = real_dale.wave
    removed, kept = (real_dale.spectra[name] for name in ("removed", "kept"))
    assert np.all(np.abs(kept[:, 0] / removed[:, 0] - 1.28) < 0.02)
    far = wave > 5.0
    assert_allclose(kept[:, far] / removed[:, far], 1.0, atol=0.005)


def test_alpha_sequence_against_dale_2014(real_dale):
    """What is stated of the mapping: 0.10 dex in 5-25 um, 0.06 beyond."""
    ours, theirs = DraineLi2007Alpha(), Dale2014()
    grid, rows = np.geomspace(5.0, 1000.0, 500), []
    for alpha in (1.0, 1.5, 2.0, 2.5, 3.0, 3.5):
        pair = [part.template(grid, alpha=alpha) for part in (ours, theirs)]
        ratio = np.log10(pair[0] / pair[1])
        rows.append(ratio - np.log10(np.divide(*(np.trapezoid(y, grid) for y in pair))))
    rows = np.array(rows)
    assert np.sqrt(np.mean(rows[:, grid <= 25] ** 2)) == pytest.approx(0.10, abs=0.01)
    assert np.sqrt(np.mean(rows[:, grid > 25] ** 2)) == pytest.approx(0.06, abs=0.01)


@pytest.mark.parametrize("alpha", [1.0, 2.0, 3.5])
def test_feature_at_3_um_against_dale_2014(real_dale, alpha):
    """What is stated of the mapping: 0.23 to 0.30 of its feature, 0.15 % of the infrared light at alpha = 2."""
    ours, theirs = (
        share_at_3_um(part.nodes(), part.template(part.nodes(), alpha=alpha))
        for part in (DraineLi2007Alpha(), Dale2014())
    )
    assert 0.22 < theirs / ours < 0.31
    if alpha == 2.0:
        assert theirs == pytest.approx(0.0015, rel=0.05)


# -------------------------------------------------------------------- Casey 2012


@pytest.mark.parametrize(("temperature", "beta"), [(50.0, 1.8), (100.0, 1.0), (80.0, 2.0)])
def test_blackbody_is_planck_times_one_minus_exp_of_minus_tau(temperature, beta):
    part = Casey2012()
    wave = part.nodes()
    got = part.parts(values_of(part, temperature_dust=temperature, emissivity_dust=beta))[0]
    planck = BlackBody(temperature=temperature * u.K)(wave * u.um).value / wave**2
    truth = planck * (1.0 - np.exp(-((200.0 / wave) ** beta)))
    # hot enough to stay clear of underflow
    ratio = (got / truth)[wave > 5.0]
    assert_allclose(ratio, ratio[0], rtol=1e-6)


@pytest.mark.parametrize("alpha", [1.5, 2.0, 3.0])
def test_power_law_has_its_slope_in_the_mid_infrared(alpha):
    """S_nu ~ l^alpha where l << l_c, the blackbody of 35 K being nothing there."""
    part = Casey2012()
    wave = part.nodes()
    mid = (wave > 3.0) & (wave < 8.0)
    spectrum = part.spectrum(values_of(part, alpha_mir=alpha))[mid]
    turn = part.turnover(alpha, 35.0)
    snu = spectrum * wave[mid] ** 2 * np.exp((wave[mid] / turn) ** 2)
    slope = np.polyfit(np.log(wave[mid]), np.log(snu), 1)[0]
    assert slope == pytest.approx(alpha, abs=1e-3)


@pytest.mark.parametrize("temperature", [35.0, 50.0, 80.0, 100.0])
@pytest.mark.parametrize("alpha", [1.0, 1.5, 2.0, 3.0])
def test_turnover_is_where_the_slope_of_the_blackbody_is_alpha(temperature, alpha):
    """L(alpha, T) is a fit to the root of that equation; l_c is three quarters of it."""

    def excess(wave):
        x, tau = 14387.77 / wave / temperature, (200.0 / wave) ** 1.5
        return -3.0 + x / (1.0 - np.exp(-x)) - 1.5 * tau / np.expm1(tau) - alpha

    root = brentq(excess, 8.0, 400.0)
    assert Casey2012.turnover(alpha, temperature) / 0.75 == pytest.approx(root, rel=0.015)


def test_power_law_meets_the_blackbody_at_the_turnover():
    part = Casey2012()
    values = values_of(part, temperature_dust=45.0)
    turn = part.turnover(values["alpha_mir"], 45.0)
    blackbody, power_law = (np.interp(turn, part.nodes(), y) for y in part.parts(values))
    # its cut-off has it at 1/e there
    assert power_law / blackbody == pytest.approx(np.exp(-1.0), rel=1e-4)


def test_straight_lines_between_the_nodes_are_good_enough(monkeypatch):
    """Ten times as many nodes change means over 20 % in wavelength by less than 1.3e-4."""
    from miricigale.sed.components import dust

    part = Casey2012()
    wave = part.nodes()
    steps = np.diff(wave)[:, None] * np.arange(10) / 10
    fine = np.append((wave[:-1, None] + steps).ravel(), wave[-1])
    for values in (
        values_of(part),
        values_of(part, temperature_dust=20.0, alpha_mir=5.0),
        values_of(part, temperature_dust=140.0, emissivity_dust=3.0, alpha_mir=4.0),
    ):
        coarse = part.spectrum(values)
        with monkeypatch.context() as patch:
            patch.setattr(dust, "NODES", fine)
            truth = part.spectrum(values)
        coarse = coarse / np.trapezoid(coarse, wave)
        truth = truth / np.trapezoid(truth, fine)
        for center in np.geomspace(1.3, 2600.0, 30):
            x = np.geomspace(0.9 * center, 1.1 * center, 4001)
            means = [
                np.trapezoid(np.interp(x, w, y), x) for w, y in ((wave, coarse), (fine, truth))
            ]
            assert means[0] == pytest.approx(means[1], rel=1.3e-4, abs=0)


# -------------------------------------------------------------- Draine & Li 2007


@pytest.mark.parametrize(("u_min", "q_pah"), [(1.0, 2.5), (0.8, 4.58), (25.0, 0.47)])
def test_dust_at_a_node_is_the_table(u_min, q_pah):
    part = DraineLi2007()
    table = load_dl07(part.path)
    i = np.argmin(np.abs(table["qpah"] - q_pah))
    j = np.argmin(np.abs(table["umin"] - u_min))
    for gamma, name in ((0.0, "single"), (1.0, "powerlaw")):
        got = part.template(part.nodes(), u_min=u_min, q_pah=q_pah, gamma=gamma)
        assert_allclose(got, table[name][i, j], rtol=1e-4)


@pytest.mark.parametrize("gamma", [0.0, 0.02, 0.3, 1.0])
def test_power_per_dust_mass_is_the_mean_intensity(gamma):
    """Draine & Li 2007, equation 33: (1 - g) Umin + g Umin ln(Umax/Umin) / (1 - Umin/Umax)."""
    part = DraineLi2007()
    table = load_dl07(part.path)
    for j, umin in enumerate(table["umin"]):
        mean = part.mean_intensity(values_of(part, u_min=umin, gamma=gamma))
        i = int(np.argmin(np.abs(table["u"] - umin)))
        power = (1 - gamma) * table["single_power"][:, i] + gamma * table["powerlaw_power"][:, j]
        assert_allclose(power / mean, 1.0, atol=0.01)


def test_gamma_changes_spectra_as_mass_fractions_do():
    """Per dust mass the spectrum is linear in gamma: the template is that over <U>."""
    part = DraineLi2007()
    nodes = part.nodes()
    none, all_, some = (part.template(nodes, gamma=g) for g in (0.0, 1.0, 0.2))
    weights = [part.mean_intensity(values_of(part, gamma=g)) for g in (0.0, 1.0)]
    mixed = 0.8 * weights[0] * none + 0.2 * weights[1] * all_
    assert_allclose(some, mixed / np.trapezoid(mixed, nodes), rtol=0.01)


def test_pah_features_stand_out():
    part = DraineLi2007()
    wave = np.array([7.0, 7.7, 10.0, 11.3])
    rich = part.template(wave, q_pah=4.58, u_min=1.0, gamma=0.0) * wave
    poor = part.template(wave, q_pah=0.47, u_min=1.0, gamma=0.0) * wave
    assert rich[1] > 3 * rich[2]
    assert np.all(rich[[1, 3]] > 3 * poor[[1, 3]])


@pytest.mark.parametrize("part", [DraineLi2007, DraineLi2007Alpha])
def test_without_the_feature_at_3_um_the_continuum_is_a_power_law(part):
    dust = part()
    wave = dust.nodes()
    full, half, none = (dust.spectrum(values_of(dust, pah_33=x)) for x in (1.0, 0.5, 0.0))
    inside = (wave >= 3.0) & (wave < 3.65)
    assert_allclose(none[~inside], full[~inside])
    assert_allclose(half, (full + none) / 2)
    # sums of power laws are not one, but nearly so, and there is no step where the feature ends
    to_next = slice(np.argmax(inside), np.searchsorted(wave, 3.65) + 1)
    slope = np.diff(np.log(none[to_next])) / np.diff(np.log(wave[to_next]))
    assert np.ptp(slope) < 0.2
    assert full[inside].max() > 10 * none[inside].max()


def share_at_3_um(wave, spectrum):
    """Power above a power law from 3.0 to 3.65 um, over that of 8-1000 um."""
    feature = (wave >= 3.0) & (wave <= 3.65)
    x, y = np.log(wave[feature]), spectrum[feature]
    above = y - np.exp(np.interp(x, x[[0, -1]], np.log(y[[0, -1]])))
    infrared = (wave >= 8.0) & (wave <= 1000.0)
    power = np.trapezoid(spectrum[infrared], wave[infrared])
    return np.trapezoid(above, wave[feature]) / power


def test_power_of_the_feature_at_3_um_goes_to_the_other_wavelengths():
    dust = DraineLi2007()
    wave = dust.nodes()
    full, fifth, none = (dust.template(wave, q_pah=4.58, pah_33=x) for x in (1.0, 0.2, 0.0))
    for spectrum in (full, fifth, none):
        assert np.trapezoid(spectrum, wave) == pytest.approx(1.0, rel=1e-12)
    far = wave > 4.0
    gain = none[far] / full[far]
    assert_allclose(gain, gain[0], rtol=1e-12)
    lost = share_at_3_um(wave, full) * np.trapezoid(full[wave > 8.0], wave[wave > 8.0])
    assert gain[0] == pytest.approx(1.0 / (1.0 - lost), rel=2e-4)
    assert share_at_3_um(wave, fifth) == pytest.approx(0.2 * share_at_3_um(wave, full), rel=0.01)


def test_feature_at_3_um_of_a_survey_is_that_of_galaxies():
    """
    0.1 % of the infrared light in star-forming galaxies (Lai et al. 2020, ApJ 905, 55), q_PAH being 3.4 % (Shivaei
    et al. 2024, A&A 690, A89), and ten times less in those poor in metals (Lyu et al. 2025, arXiv:2502.18464).
    """
    dust = SEDModel.survey(libraries="bundled", agn=False).component("dust")
    wave = dust.nodes()
    rich, poor = (share_at_3_um(wave, dust.template(wave, q_pah=q)) for q in (3.4, 0.47))
    assert rich == pytest.approx(0.001, rel=0.3)
    assert poor < 0.15 * rich
    # as published the table has several times as much, in dust of any field of starlight
    published = DraineLi2007()
    for u_min in (0.5, 25.0):
        all_of_it = published.template(wave, q_pah=3.4, u_min=u_min)
        assert share_at_3_um(wave, all_of_it) > 0.004


def test_a_foreign_table_is_refused(tmp_path):
    path = tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((2, 2))).writeto(path)
    refuses("not a Draine & Li table", load_dl07, str(path), error=DataError)


@pytest.mark.parametrize(("u_min", "gamma"), [(1.0, 0.0), (0.7, 0.1), (25.0, 1.0)])
def test_mean_intensity_over_the_dust_mass(u_min, gamma):
    """Draine & Li 2007, equation 23: a share gamma of the mass with dM/dU as U^-2 up to 1e6, the rest at u_min."""
    spread = np.geomspace(u_min, 1e6, 20_001)
    mean = np.trapezoid(spread**-1.0, spread) / np.trapezoid(spread**-2.0, spread)
    got = DraineLi2007.mean_intensity({"u_min": u_min, "gamma": gamma})
    assert got == pytest.approx((1 - gamma) * u_min + gamma * mean, rel=1e-5)
