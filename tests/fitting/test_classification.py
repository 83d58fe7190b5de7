"""Evidences of classes: a scale and a template in closed form, and sources of known class."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io.fits import BinTableHDU, Column
from astropy.modeling.models import BlackBody
from astropy.table import QTable, Table
from numpy.testing import assert_allclose
from scipy.special import logsumexp

from helpers.errors import refuses
from helpers.grids import photometry_table
from miricigale.filters import FilterSet
from miricigale.fitting import (
    BayesFitter,
    FitFlags,
    GridSettings,
    TemplateError,
    compare_classes,
    fit_file,
    red_dot_prior,
)
from miricigale.fitting.catalogs.classes import red_dot_grid, write_table
from miricigale.fitting.results.pulls import without_warnings
from miricigale.sed import (
    SED,
    ModelGrid,
    SEDModel,
    band_extinction,
    quasar_axes,
    read_spectra,
    red_dot_axes,
    red_dots,
    template_grid,
)
from miricigale.sed.components import Meiksin2006
from miricigale.utils.exceptions import DataError, MiricigaleWarning

BANDS = ["acs.f606w", "wfc3.f125w", "wfc3.f160w", "irac.ch1", "miri.f770w", "miri.f1500w"]


def planck(temperature, last=60.0):
    """Planck's law, the stand-in for a star: what is tested is what is done with spectra, not the library."""
    wave = np.geomspace(0.2, last, 3000) * u.um
    return SED(wave, (1e10 * BlackBody(temperature * u.K)(wave) * u.sr).to(u.uJy))


def noisy(flux, signal_to_noise, seed, names, bands=BANDS):
    """Photometry of fluxes, shape (n, nb), in uJy."""
    error = flux / signal_to_noise
    flux = flux + error * np.random.default_rng(seed).normal(size=flux.shape)
    return photometry_table(bands, flux, error, names)


@pytest.fixture(scope="module")
def stars():
    return {f"T{t:.0f}": planck(t) for t in np.geomspace(2500, 15000, 13)}


@pytest.mark.parametrize(
    "template_error", [None, TemplateError([0.3, 3, 30] * u.um, [0.02, 0.1, 0.2])]
)
def test_the_evidence_of_templates_with_a_scale_is_the_closed_form(stars, template_error):
    """ln of the mean over templates of exp(-chi2 / 2) at the best scale, over the norm of the Gaussians."""
    grid = template_grid(stars, BANDS)
    error = 0.05 if template_error is None else 0.0
    fitter = BayesFitter(grid, model_error=error, template_error=template_error)
    table = noisy(7.0 * grid.galaxy[0, [2, 9]], 10, 3, ["a", "b"])
    table[BANDS[1]][1] = np.nan
    results = fitter.fit(table)
    for row in (0, 1):
        flux = np.array([table[b][row].value for b in BANDS])
        sigma = np.array([table[f"{b}_err"][row].value for b in BANDS])
        part = error
        if template_error is not None:
            pivots = FilterSet.from_names(BANDS).pivots.to_value("um")
            part = np.interp(np.log(pivots), np.log([0.3, 3, 30]), [0.02, 0.1, 0.2])
        sigma = np.hypot(sigma, part * flux)
        use = np.isfinite(flux)
        f, s, model = flux[use], sigma[use], grid.galaxy[0][:, use]
        chi2 = np.sum((f / s) ** 2) - ((f * model / s**2).sum(1) ** 2 / ((model / s) ** 2).sum(1))
        norm = np.log(s).sum() + 0.5 * use.sum() * np.log(2 * np.pi)
        wanted = logsumexp(-0.5 * chi2) - np.log(len(model)) - norm
        assert results.log_evidence[row] == pytest.approx(wanted, rel=1e-9)
    assert results.best["redshift"].value.tolist() == [0, 0]
    # the scale is the mean flux of the six bands in uJy
    assert results.best["mass"][0].value == pytest.approx(7.0, rel=0.1)
    assert np.all(np.abs(results.best["template"].value - [2, 9]) <= 1)


def test_upper_limits_and_files_of_template_grids(stars, tmp_path):
    """The limit of a band excludes the hotter stars; the grid is the same after a file."""
    grid = template_grid(stars, BANDS)
    grid.write(tmp_path / "stars.fits")
    again = ModelGrid.read(tmp_path / "stars.fits")
    assert again.galaxy_properties.colnames == []
    assert again.meta["templates"] == list(stars)
    table = noisy(grid.galaxy[0, [0]], 20, 1, ["cool"])
    table["acs.f606w"] = 10 * table["acs.f606w"]
    table["acs.f606w_limit"] = [True]
    free, limited = (BayesFitter(g, model_error=0.05).fit(table) for g in (grid, again))
    assert limited.n_limits.tolist() == [1]
    assert_allclose(limited.log_evidence, free.log_evidence, rtol=1e-12)
    assert limited.best["template"].value.tolist() == [0]


@pytest.fixture(scope="module")
def fitters(stars):
    """Thin grids of the three classes, in steps of 0.05 in ln(1 + z), and few models between their nodes."""
    model, z = SEDModel.survey(), np.expm1(np.arange(0.1, 1.8, 0.05))
    galaxies = {
        "tau": [0.1, 1.0], "age": [0.1, 0.3, 1.0, 3.0], "ebv": [0.0, 0.2, 0.5, 0.8], "q_pah": [2.5],
        "tau97": [5.0], "frac_agn": [0.0, 0.3, 0.7], "redshift": z,
    }  # fmt: skip
    quasars = quasar_axes() | {"redshift": z, "tau97": [5.0]}
    options = {"model_error": 0.1, "settings": GridSettings(interpolate=150)}
    galaxy, quasar = (
        BayesFitter(model, BANDS, axes=axes, **options) for axes in (galaxies, quasars)
    )
    star = BayesFitter(template_grid(stars, BANDS), model_error=0.1)
    return {"galaxy": galaxy, "quasar": quasar, "star": star}


def sources(n, seed):
    """Galaxies, quasars and stars between the nodes of the grids, S/N 20, as bright in F160W."""
    rng, model = np.random.default_rng(seed), SEDModel.survey()
    z = np.expm1(rng.uniform(0.2, 1.6, (2, n)))
    both = {"q_pah": rng.uniform(0.5, 4.5, n), "tau97": rng.uniform(3, 11, n)}
    both["mass"] = np.full(n, 1e10)
    galaxies = both | {
        "redshift": z[0], "tau": 10 ** rng.uniform(-1, 0.3, n), "ebv": rng.uniform(0, 0.7, n),
        "age": np.minimum(10 ** rng.uniform(-1, 0.5, n), 0.8 * model.cosmology.age(z[0]).value),
        "frac_agn": np.where(rng.random(n) < 0.5, 0.0, rng.uniform(0, 0.7, n)),
    }  # fmt: skip
    quasars = both | {
        "redshift": z[1], "tau": np.full(n, 0.5), "age": np.full(n, 0.5), "ebv": rng.uniform(0.1, 0.4, n),
        "frac_agn": rng.uniform(0.8, 0.99, n), "inclination": rng.uniform(10, 40, n),
        "disk_slope": rng.uniform(-0.3, 0.3, n), "ebv_polar": rng.uniform(0.0, 0.2, n),
    }  # fmt: skip
    tables = [model.fluxes(QTable(table), BANDS) for table in (galaxies, quasars)]
    flux = [np.column_stack([table[b].value for b in BANDS]) for table in tables]
    temperatures = np.exp(rng.uniform(np.log(2700), np.log(12000), n))
    stars = {str(i): planck(t) for i, t in enumerate(temperatures)}
    flux = np.concatenate([*flux, template_grid(stars, BANDS).galaxy[0]])
    names = [f"{kind}{i}" for kind in ("galaxy", "quasar", "star") for i in range(n)]
    return noisy(10 * flux / flux[:, [2]], 20, seed, names)


@pytest.mark.slow
def test_sources_of_known_class_are_sorted(fitters):
    """At S/N 20 in six bands nine of ten of each class are found, stars always (Planck's law is narrow)."""
    n = 20
    data = sources(n, 11)
    with without_warnings():
        table = compare_classes({name: f.fit(data) for name, f in fitters.items()})
    right = np.char.startswith(table["id"].astype(str), table["class"].astype(str))
    galaxy, quasar, star = right.reshape(3, n).sum(axis=1)
    assert galaxy >= 0.9 * n
    assert quasar >= 0.9 * n
    assert star == n
    # the probabilities are what the ratios say
    ratio = np.array([table["log_ratio_quasar"], table["log_ratio_star"]])
    wanted = 1.0 / (1.0 + np.exp(ratio).sum(axis=0))
    assert_allclose(table["probability_galaxy"], wanted, rtol=1e-9, atol=1e-300)


def test_spectra_at_redshifts_are_seen_behind_the_medium():
    """A power law is the same at any redshift but for what hydrogen absorbs of it."""
    wave = np.geomspace(0.01, 40, 3000)
    spectra = {"a": SED(wave * u.um, wave**0.7 * u.uJy), "b": planck(5000) * 1e-9}
    bands = ["acs.f606w", "nircam.f200w", "nircam.f444w"]
    grid = template_grid({"a": spectra["a"]}, bands, redshift=[1.0, 4.0])
    here = template_grid({"a": spectra["a"]}, bands).galaxy[0, 0]
    assert_allclose(grid.galaxy[:, 0, 1] / grid.galaxy[:, 0, 2], here[1] / here[2], rtol=1e-4)
    seen = SED(wave * 5 * u.um, Meiksin2006().transmission(wave * 5, 4.0) * wave**0.7 * u.uJy)
    flux = FilterSet.from_names(bands).synthetic_fluxes(seen)
    assert_allclose(grid.galaxy[1, 0], flux / flux.mean(), rtol=1e-6)
    assert grid.galaxy[1, 0, 0] < 0.8 * here[0] * grid.galaxy[1, 0, 1] / here[1]
    refuses("'redshift' must be finite, asc", template_grid, spectra, bands, redshift=[2, 1])


@pytest.fixture(scope="module")
def dots():
    """Spectra of little red dots, of all values by default."""
    return red_dots()


@pytest.mark.slow
def test_little_red_dots_are_no_dwarfs(fitters, dots):
    """Broken power laws with H alpha of 700 A are red dots, at 0.15 of 1 + z; galaxies stay such."""
    bands = [
        "acs.f814w",
        "nircam.f115w",
        "nircam.f150w",
        "nircam.f277w",
        "nircam.f444w",
        "miri.f770w",
    ]
    z, wave = np.linspace(4.6, 7.4, 12), np.geomspace(0.03, 5, 4000)
    fnu = np.where(wave < 0.3645, (wave / 0.3645) ** -0.2, (np.minimum(wave, 0.9) / 0.3645) ** 3.2)
    # a box of 40 A over 17 times the continuum at 0.66 um
    line = np.abs(wave / 0.6563 - 1) < 0.003
    fnu[line] *= 1.0 + 700.0 / (0.006 * 6563.0)
    grid = template_grid({"dot": SED(wave * u.um, fnu * u.uJy)}, bands, redshift=z)
    light = noisy(grid.galaxy[:, 0], 12, 3, z.astype(str), bands)
    error = {"model_error": 0.1}
    shapes = template_grid(dots, bands, redshift=np.expm1(np.arange(1.1, 2.3, 0.04)))
    nodes = GridSettings(interpolate=0)
    classes = {"red_dot": BayesFitter(shapes, settings=nodes, **error)}
    axes = {name: axis.values for name, axis in fitters["galaxy"].priors.axes.items()}
    axes |= {"redshift": np.expm1(np.arange(0.02, 2.1, 0.05))}
    model = SEDModel.survey()
    galaxies = BayesFitter(model, bands, axes=axes, settings=nodes, **error)
    classes = {"galaxy": galaxies} | classes
    with without_warnings():
        found = {name: fitter.fit(light) for name, fitter in classes.items()}
    assert np.sum(compare_classes(found)["class"] == "red_dot") >= 11
    middle = found["red_dot"].median("redshift").value
    assert np.median(np.abs(middle - z) / (1 + z)) < 0.15
    grid, rng = classes["galaxy"].grid, np.random.default_rng(5)
    z, galaxy = rng.permutation(np.argwhere(grid.allowed))[:40].T
    flux = grid.galaxy[z, galaxy]
    table = noisy(flux / flux.mean(axis=1, keepdims=True), 12, 6, np.arange(40), bands)
    with without_warnings():
        found = {name: fitter.fit(table) for name, fitter in classes.items()}
    assert np.sum(compare_classes(found)["class"] == "galaxy") >= 38


@pytest.mark.slow
def test_tables_of_classes_are_the_same_in_parquet(fitters, tmp_path):
    pytest.importorskip("pyarrow")
    data = sources(2, 5)
    data.write(tmp_path / "data.fits")
    with without_warnings():
        names = ("galaxy", "star")
        found = {n: fit_file(fitters[n], tmp_path / "data.fits", tmp_path / n) for n in names}
    for kind in ("fits", "parquet"):
        write_table(found, tmp_path / f"table.{kind}")
    table, packed = (QTable.read(tmp_path / f"table.{kind}") for kind in ("fits", "parquet"))
    assert packed.colnames == table.colnames
    assert table.colnames[:3] == ["id", "class", "class_probability"]
    for name in ("class", "flags", "redshift_p50", "redshift_p16_galaxy", "log_ratio_star"):
        np.testing.assert_array_equal(packed[name].tolist(), table[name].tolist())


#: Little red dots with spectra: redshifts of de Graaff et al. 2025 (arXiv:2511.21820), and fluxes and errors in
#: nJy of Kokorev et al. 2024 (arXiv:2401.09981) in F606W, F814W, F115W, F150W, F200W, F277W, F356W, F410M and
#: F444W. Every third, by redshift, of those outside of COSMOS that are in both.
WITH_SPECTRA = """
3.702  20.7  67.4 68.1 90.2 171.9 616.8 586.8 692.5 725.4   8.1  6.1 3.6 3.1 2.7 2.7 2.6 3.9 3.4
4.054  42.4  84.1 83.2 89.2 150.1 340.9 587.5 547.3 640.5   5.1  4.9 4.0 3.3 2.8 2.5 2.7 4.0 3.5
4.543   8.5  24.4 31.4 32.6  31.1  85.5 218.5 128.4 138.8   3.6  4.0 2.0 2.8 2.3 2.2 1.8 3.4 2.6
4.957  -3.4   4.2 17.8 26.3  32.9 148.9 372.6 576.2 439.9   4.5  5.0 2.9 3.4 2.9 2.1 2.3 4.8 3.4
5.154   4.3  44.3 48.9 64.2  83.8 338.7 455.1 896.7 761.0   8.9 10.3 5.4 4.5 3.8 3.2 3.3 5.5 4.7
5.442  -8.8  30.9 34.2 23.4  26.7  43.7  82.0 251.9 149.4   7.5  7.3 5.4 4.4 3.6 3.3 3.2 6.5 5.0
5.630  -3.6   8.6 11.7 15.4  13.4  23.3  64.0  93.4 134.1   5.2  7.3 2.9 3.7 2.9 2.3 2.3 4.4 4.1
5.685  -2.3  -1.8 15.0 18.0  20.5  66.2 141.1 189.7 260.0   3.2  3.6 1.9 2.8 2.2 1.9 1.7 3.5 2.8
6.732  -5.8  -4.8 43.3 54.6  60.2  71.2 201.3 187.1 194.7   4.0  4.5 3.1 3.6 4.0 2.1 2.2 4.0 3.5
7.098  -3.1   2.7 26.7 34.4  30.7  39.0  77.2 202.3 144.4   6.2  6.2 4.8 4.0 3.3 2.5 2.4 4.6 3.7
7.769  -3.8   6.0  2.3 17.9  14.9  20.9  39.4  70.0  85.7   4.4  6.0 2.7 3.2 2.7 2.2 2.0 4.1 3.3
"""


@pytest.mark.slow
def test_redshifts_of_little_red_dots_are_those_of_their_spectra(dots):
    """Published photometry and redshifts, none of which the models were made with."""
    rows = np.array([line.split() for line in WITH_SPECTRA.split("\n") if line], dtype=float)
    z, (flux, error) = rows[:, 0], 1e-3 * np.array([rows[:, 1:10], rows[:, 10:]])
    names = ("f115w", "f150w", "f200w", "f277w", "f356w", "f410m", "f444w")
    bands = ["acs.f606w", "acs.f814w", *(f"nircam.{name}" for name in names)]
    axis = red_dot_axes()["redshift"][::2]
    fitter = BayesFitter(
        template_grid(dots, bands, redshift=axis),
        model_error=0.1,
        priors={"redshift": red_dot_prior(axis)},
        settings=GridSettings(interpolate=0),
    )
    with without_warnings():
        results = fitter.fit(photometry_table(bands, flux, error, z.astype(str)))
    apart = (results.median("redshift").value - z) / (1.0 + z)
    assert abs(np.median(apart)) < 0.05
    assert np.sum(np.abs(apart) < 0.15) >= 9
    # models fit, and are of the envelopes that the spectra have
    assert np.median(results.reduced_chi2) < 1.5
    assert 3500 < np.median(results.median("temperature").value) < 6300


def test_red_dots_are_seen_behind_the_milky_way(monkeypatch):
    """Dust dims the bands of each spectrum as it does the spectrum itself."""
    bands = ["acs.f814w", "nircam.f150w", "nircam.f444w", "miri.f770w"]
    # the first and the last value of each parameter are enough
    axes = {name: values[[0, -1]] for name, values in red_dot_axes().items()}
    axes["redshift"] = red_dot_axes()["redshift"][[10, 30, 50]]
    monkeypatch.setattr("miricigale.sed.red_dot_axes", lambda: dict(axes))
    monkeypatch.setattr("miricigale.sed.red_dot_spectra.red_dot_axes", lambda: dict(axes))
    (clear, _), (dimmed, _) = (red_dot_grid(bands, ebv=ebv) for ebv in (0.0, 0.2))
    spectra, z = list(red_dots().values()), clear.redshift
    assert clear.galaxy.shape == (3, len(spectra), 4)
    for row, k in ((0, 0), (len(spectra) // 2, 1), (-1, 2)):
        seen = SED(spectra[row].wave * (1.0 + z[k]), spectra[row].fnu)
        wanted = band_extinction(bands, 0.2, sed=seen, beyond="transparent")
        found = -2.5 * np.log10(dimmed.galaxy[k, row] / clear.galaxy[k, row])
        # of F814W light is in a part only, below Lyman alpha
        assert_allclose(found, [wanted[band][0].value for band in bands], atol=0.03)


def test_the_prior_of_red_dots_is_log_normal():
    """Median at 5.5 and 68 % within a factor exp(0.25) of 6.5 in 1 + z, of nodes however they lie."""
    even = np.expm1(np.linspace(np.log(2.0), np.log(20.0), 2001))
    odd = np.sort(np.random.default_rng(2).uniform(1.0, 19.0, 3000))
    for z in (even, odd):
        below = np.cumsum(red_dot_prior(z))
        wanted = 6.5 * np.exp([-0.25, 0.0, 0.25]) - 1.0
        assert_allclose(np.interp(wanted, z, below), [0.1587, 0.5, 0.8413], atol=0.005)
    refuses("'redshift' must be two or more, ascending", red_dot_prior, [3.0, 2.0])


def test_an_object_has_the_redshift_of_its_class(fitters):
    """Redshifts, fit and flags are the winner's own; those of the others stand beside it."""
    n = 4
    data = sources(n, 11)
    data["wfc3.f160w"][0] = np.nan
    for band in BANDS:
        data[band][1] = np.nan
    with without_warnings():
        fits = {name: fitter.fit(data) for name, fitter in fitters.items()}
    table = compare_classes(fits)
    label = table["class"].astype(str)
    assert set(label[2:]) == {"galaxy", "quasar", "star"}
    tables = {name: fit.to_table() for name, fit in fits.items()}
    levels = ("p16", "p50", "p84")
    for row, name in enumerate(label):
        # what was not fitted is as in the first class
        own = tables[name or "galaxy"][row]
        for column in ("redshift_mean", "redshift_std", "redshift_best", "redshift_odds"):
            wanted = own[column] if name != "star" else 0.0 if column != "redshift_odds" else np.nan
            assert_allclose(table[column][row], wanted, rtol=1e-12)
        for level in levels:
            wanted = 0.0 if name == "star" else own[f"redshift_{level}"]
            assert_allclose(table[f"redshift_{level}"][row], wanted, rtol=1e-12)
        for column in ("chi2_best", "reduced_chi2", "log_evidence"):
            assert_allclose(table[column][row], own[column], rtol=1e-12)
        other = int(FitFlags.OTHER_CLASS) if name in ("quasar", "star") else 0
        assert table["flags"][row] == own["flags"] + other
        if name:
            chosen = table[f"probability_{name}"][row]
            assert table["class_probability"][row] == chosen
            assert chosen == max(table[f"probability_{one}"][row] for one in fits)
    assert label[1] == ""
    assert np.isnan(table["class_probability"][1])
    for name in ("galaxy", "quasar"):
        for level in levels:
            wanted = tables[name][f"redshift_{level}"]
            assert_allclose(table[f"redshift_{level}_{name}"], wanted, rtol=1e-12)
        assert_allclose(table[f"reduced_chi2_{name}"], tables[name]["reduced_chi2"], rtol=1e-12)
    # stars have no redshift that was fitted
    assert "redshift_p50_star" not in table.colnames
    # where redshifts are given nothing is said of them
    given = np.full(len(data), 1.0)
    fits = {
        name: fitters[name].fit(data[2:4], redshift=given[2:4]) for name in ("galaxy", "quasar")
    }
    known = compare_classes(fits)
    assert not [name for name in known.colnames if "redshift" in name]
    assert known["class"].tolist() == label[2:4].tolist()


def test_priors_of_classes_and_what_is_refused(fitters):
    data = sources(2, 5)
    data["wfc3.f160w"][0] = np.nan
    for band in BANDS:
        data[band][1] = np.nan
    fits = {name: fitters[name].fit(data) for name in ("quasar", "star")}
    plain = compare_classes(fits)
    prior = {"quasar": 1.0, "star": np.full(6, 7.0)}
    table = compare_classes(fits, prior=prior)
    odds, before = (t["probability_star"] / t["probability_quasar"] for t in (table, plain))
    some = (before > 1e-200) & np.isfinite(before)
    assert_allclose(odds[some], 7.0 * before[some], rtol=1e-9)
    # what has no band has no class
    assert fits["star"].flags[1] & FitFlags.NO_BAND
    assert table["class"][1] == ""
    assert np.isnan(table["probability_star"][1])
    refuses("two classes", compare_classes, {"star": fits["star"]})
    brighter = data.copy()
    brighter["wfc3.f125w"] = 1.01 * brighter["wfc3.f125w"]
    fewer = BayesFitter(fitters["star"].grid, BANDS[1:])
    for other, text in (
        (fits["star"][:3], "'star' of the same data as 'quasar', got other objects"),
        (fitters["star"].fit(brighter), "got other values of 'flux'"),
        (fewer.fit(data), "got the bands"),
    ):
        refuses(text, compare_classes, fits | {"star": other})
    for prior, text in (({"star": 1}, "of the classes"), ({"star": 0, "quasar": 0}, "not all 0")):
        refuses(text, compare_classes, fits, prior=prior)


def test_spectra_of_files(tmp_path):
    """Angstrom and F_lambda where a file says nothing; a vector is several; the Rayleigh-Jeans side goes on."""
    wave = np.geomspace(2000, 25000, 400)
    folder = tmp_path / "atlas"
    folder.mkdir()
    flam = 1e-17 * (wave / 5000) ** -2.0
    np.savetxt(folder / "flat.dat", np.column_stack([wave, flam]), header="wave flux")
    table = Table({"WAVELENGTH": wave, "FLUX": np.column_stack([flam, 2 * flam])})
    table["WAVELENGTH"].unit, table["FLUX"].unit = "Angstrom", "erg / (s cm2 Angstrom)"
    table.write(folder / "two.fits")
    spectra = read_spectra(folder)
    assert list(spectra) == ["flat", "two[0]", "two[1]"]
    # F_lambda ~ wave^-2 is a flat F_nu: 1e-17 at 5000 Angstrom is 8.339 uJy
    for name, level in zip(spectra, (8.339, 8.339, 16.678), strict=True):
        assert_allclose(spectra[name].fnu.value, level, rtol=1e-3)
    refuses(r"template 'flat'.*irac\.ch1", template_grid, spectra, BANDS)
    bands = ["wfc3.f125w", "miri.f770w", "miri.f1500w"]
    with pytest.warns(MiricigaleWarning, match="3 of 3 spectra continued to"):
        grid = template_grid(spectra, bands, beyond="rayleigh-jeans")
    ratio = grid.galaxy[0, 0, 1] / grid.galaxy[0, 0, 2]
    assert ratio == pytest.approx((15.065 / 7.639) ** 2, rel=0.02)
    (folder / "none.txt").write_text("wave flux\n1 nan\n2 1\n")
    refuses(r"none\.txt cannot be read as a spectrum", read_spectra, folder, error=DataError)
    refuses("no files of spectra", read_spectra, tmp_path, error=DataError)


def test_no_spectrum_of_a_library_is_lost_or_filled(tmp_path):
    """Names of model atmospheres have points in them; a value that is lacking is no flux of 0."""
    wave = np.linspace(1000, 3000, 5)
    for name in ("lte030-4.5-0.0.dat", "lte030-4.5-0.5.dat"):
        np.savetxt(tmp_path / name, np.column_stack([wave, wave]))
    assert list(read_spectra(tmp_path)) == ["lte030-4.5-0.0", "lte030-4.5-0.5"]
    np.savetxt(tmp_path / "lte030-4.5-0.0.txt", np.column_stack([wave, wave]))
    refuses(r"0\.0\.txt has the name of another file", read_spectra, tmp_path, error=DataError)
    gaps = tmp_path / "gaps.csv"
    gaps.write_text("wave,flux\n1000,1\n2000,\n3000,1\n")
    refuses(r"gaps\.csv cannot be read as a spectrum.*finite", read_spectra, gaps, error=DataError)


def test_atmospheres_of_all_gravities_are_read(tmp_path):
    """STScI's tables of model atmospheres: a column for each gravity, 0 where there is no model."""
    wave = np.linspace(1000, 30000, 50)
    table = Table({"WAVELENGTH": wave, "g00": 0 * wave, "g40": wave**-2.0, "g45": 2 * wave**-2.0})
    for name in table.colnames:
        table[name].unit = "Angstrom" if name == "WAVELENGTH" else "erg / (s cm2 Angstrom)"
    table.write(tmp_path / "ckp00_10000.fits")
    spectra = read_spectra(tmp_path)
    assert list(spectra) == ["ckp00_10000[g40]", "ckp00_10000[g45]"]
    low, high = (one.fnu.value for one in spectra.values())
    assert_allclose(high, 2 * low)
    assert_allclose(low, low[0])


@pytest.mark.parametrize(
    ("units", "scale"),
    # F_lambda of 1e-17 at 5000 Angstrom is 8.339 uJy; F_nu of 1e-29 erg/s/cm2/Hz is 1 uJy
    [(("ANGSTROMS", "FLAM"), 1e-17), (("angstroms", "flam"), 1e-17), (("MICRONS", "FNU"), 1e-29)],
)
def test_units_as_stsci_writes_them(tmp_path, units, scale):
    """The Pickles atlas says ANGSTROMS and FLAM, which FITS does not know: no warning, and no flux lost."""
    wave = np.linspace(4000, 6000, 201) * (1e-4 if units[0] == "MICRONS" else 1.0)
    arrays = {"WAVELENGTH": wave, "FLUX": np.full(201, scale)}
    pairs = zip(arrays, units, strict=True)
    columns = [Column(name, "D", unit=unit, array=arrays[name]) for name, unit in pairs]
    BinTableHDU.from_columns(columns).writeto(tmp_path / "pickles_1.fits")
    (sed,) = read_spectra(tmp_path).values()
    assert sed.wave[100].to_value("Angstrom") == pytest.approx(5000)
    level = 1.0 if units[1] == "FNU" else 8.339
    assert sed.fnu[100].to_value("uJy") == pytest.approx(level, rel=1e-4)
