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
from miricigale.fitting import BayesFitter, FitFlags, TemplateError, compare_classes
from miricigale.fitting.pulls import without_warnings
from miricigale.sed import (
    SED,
    ModelGrid,
    SEDModel,
    quasar_axes,
    read_spectra,
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
    """Thin grids of the three classes, in steps of 0.05 in ln(1 + z)."""
    model, z = SEDModel.survey(), np.expm1(np.arange(0.1, 1.8, 0.05))
    galaxies = {
        "tau": [0.1, 1.0], "age": [0.1, 0.3, 1.0, 3.0], "ebv": [0.0, 0.2, 0.5, 0.8], "q_pah": [2.5],
        "tau97": [5.0], "frac_agn": [0.0, 0.3, 0.7], "redshift": z,
    }  # fmt: skip
    quasars = quasar_axes() | {"redshift": z, "tau97": [5.0]}
    galaxy, quasar = (
        BayesFitter(model, BANDS, axes=axes, model_error=0.1) for axes in (galaxies, quasars)
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


def test_little_red_dots_are_no_dwarfs(fitters):
    """Broken power laws between the nodes, with a line, are red dots, at 0.15 of 1 + z; galaxies stay such."""
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
    fnu += 0.2 * fnu.max() * (np.abs(wave / 0.6563 - 1) < 0.003)
    grid = template_grid({"dot": SED(wave * u.um, fnu * u.uJy)}, bands, redshift=z)
    dots = noisy(grid.galaxy[:, 0], 12, 3, z.astype(str), bands)
    error = {"model_error": 0.1}
    shapes = template_grid(red_dots(), bands, redshift=np.expm1(np.arange(1.1, 2.3, 0.04)))
    classes = {"red_dot": BayesFitter(shapes, **error)}
    axes = {name: axis.values for name, axis in fitters["galaxy"].priors.axes.items()}
    axes |= {"redshift": np.expm1(np.arange(0.02, 2.1, 0.05))}
    model = SEDModel.survey()
    classes = {"galaxy": BayesFitter(model, bands, axes=axes, **error)} | classes
    with without_warnings():
        found = {name: fitter.fit(dots) for name, fitter in classes.items()}
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
