"""Models drawn from posteriors, with draws made by hand."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import chi2

from helpers.errors import refuses
from helpers.grids import brute_force, draw_photometry, make_grid, node_fitter
from helpers.results import assert_same_tables
from miricigale.filters import Filter, FilterSet
from miricigale.fitting import GridSettings, Samples
from miricigale.sed import SED, SEDModel
from miricigale.utils.exceptions import DataError

BANDS = ["acs.f606w", "wfc3.f160w", "miri.f770w", "miri.f2100w"]
AXES = {"redshift": [0.5, 1.0, 1.5], "age": [1.0, 3.0], "ebv": [0.1, 0.4]}
AXES |= {"frac_agn": [0.0, 0.3, 0.8], "ebv_polar": [0.0, 0.2], "temperature_polar": [100.0, 200.0]}


def values_at(grid, index):
    """Values of the parameters of a draw."""
    z, g, k, f = index
    values = {"redshift": grid.redshift[z], "frac_agn": grid.frac_agn[f]}
    for table, row in ((grid.galaxy_parameters, g), (grid.agn_parameters, k)):
        values |= {name: table[name][row] for name in table.colnames}
    return values


def draw_models(grid, n=3, draws=40, seed=0):
    rng = np.random.default_rng(seed)
    sizes = (grid.redshift.size, grid.n_galaxies, max(grid.n_agn, 1), grid.frac_agn.size)
    index = np.stack([rng.integers(size, size=(n, draws)) for size in sizes], axis=-1)
    scale = 1e10 * rng.lognormal(0.0, 0.3, (n, draws))
    index[-1], scale[-1] = -1, np.nan
    return index, scale


@pytest.fixture(scope="module")
def model():
    return SEDModel.yang2021(libraries="bundled")


@pytest.fixture(scope="module")
def real(model):
    grid = model.grid(AXES, BANDS, cache=False)
    index, scale = draw_models(grid)
    return Samples(grid, ["a", "b", "c"], [0, 0, 1], index, scale, model, {"seed": 3})


@pytest.fixture(scope="module")
def samples(grid):
    index, scale = draw_models(grid, n=4)
    return Samples(grid, np.arange(4), np.zeros(4, int), index, scale)


def test_values_are_those_of_the_models(samples):
    grid = samples.grid
    z, g, k, f = samples.index[1, 7]
    table = samples.to_table()
    assert len(table) == 4 * 40
    row = table[(table["id"] == 1) & (table["draw"] == 7)][0]
    assert row["redshift"] == grid.redshift[z]
    assert row["frac_agn"] == grid.frac_agn[f]
    assert u.isclose(row["age"], grid.galaxy_parameters["age"][g])
    assert row["mass"] == samples.scale[1, 7] * u.Msun
    sfr = samples.scale[1, 7] * u.Msun * grid.galaxy_properties["sfr"][g]
    assert u.isclose(row["sfr"], sfr)
    power = samples.scale[1, 7] * grid.dust_luminosity[g]
    power *= grid.frac_agn[f] / (1 - grid.frac_agn[f])
    accretion = power * grid.agn_properties["accretion_power"][k] * u.W
    assert u.isclose(row["accretion_power"], accretion)
    assert all(table[name].info.description for name in table.colnames)
    assert np.isnan(table["mass"][table["id"] == 3]).all()
    assert table.colnames[:3] == ["id", "draw", "flags"]


def test_moments_and_percentiles_are_those_of_the_draws(samples):
    mass = samples.scale[0]
    assert samples.mean("mass")[0].value == pytest.approx(mass.mean())
    assert samples.std("mass")[0].value == pytest.approx(mass.std())
    got = samples.percentile("mass", [0.16, 0.5])
    assert_allclose(got[0].value, np.percentile(mass, [16, 50]))
    assert_array_equal(samples.percentile("mass", 0.5), got[:, 1])
    assert np.isnan(got[3]).all()
    edges, weights = samples.pdf("age", 0)
    age = samples.values("age").value[0]
    assert_allclose(weights, [np.mean(age == x) for x in samples.axes["age"].values])
    assert edges.unit == u.Gyr
    a, b, joint = samples.pdf_2d("age", "mass", 0)
    assert joint.shape == (a.size - 1, b.size - 1) == (4, 30)
    assert_allclose(joint.sum(axis=1), weights)
    edges, weights = samples.pdf("mass", 0)
    assert weights[0] == pytest.approx(np.mean(mass < edges[1].to_value(u.Msun)))


def test_parameters_without_effect_have_their_prior(real):
    """Without polar dust its temperature is anything; the draws share it as the prior has it."""
    n = 4000
    grid = real.grid
    no_dust = int(np.flatnonzero(grid.agn_parameters["ebv_polar"].value == 0)[0])
    index = np.zeros((1, n, 4), int)
    index[..., 2], index[..., 3] = no_dust, 1
    axes = node_fitter(grid, priors={"temperature_polar": [1.0, 3.0]}).priors.axes
    one = Samples(grid, ["x"], [0], index, np.ones((1, n)), axes=axes)
    part = np.mean(one.values("temperature_polar").value == 200.0)
    assert abs(part - 0.75) < 5 * np.sqrt(0.75 * 0.25 / n)
    # the same in any company
    two = Samples(grid, ["y", "x"], [0, 0], np.repeat(index, 2, axis=0), np.ones((2, n)), axes=axes)
    assert_array_equal(two["x"].values("temperature_polar"), one.values("temperature_polar")[0])
    index[..., 2:] = -1, 0
    none = Samples(grid, ["x"], [0], index, np.ones((1, n)))
    assert np.isnan(none.values("temperature_polar")).all()
    assert none.values("accretion_power").max() == 0


def test_fractions_in_both_definitions(real, model):

    for i, j in ((0, 3), (1, 11)):
        derived = model.derived(**values_at(real.grid, real.index[i, j]))
        for name in ("frac_agn_ir", "frac_agn_dust", "a_v"):
            got = real.values(name)[i, j].value
            assert got == pytest.approx(derived[name].value, rel=1e-9), name


def test_fluxes_in_bands_of_the_grid_and_others(real, model):
    got = real.fluxes(BANDS[1:3]).value
    z, g, k, f = real.index[0, 5]
    want = real.scale[0, 5] * real.grid.flux(z, g, k, f)[1:3]
    assert_allclose(got[0, 5], want, rtol=1e-12)
    # a grid made with the band has the same fluxes
    other = model.grid(AXES, ["miri.f1500w"], cache=False)
    want = Samples(other, real.ids, real.flags, real.index, real.scale).fluxes()
    table = real.predict(["miri.f1500w", "wfc3.f160w"])
    assert_allclose(real.fluxes(["miri.f1500w"]), want, rtol=1e-9)
    mean = want[:, :, 0].mean(axis=1)
    assert_allclose(table["miri.f1500w"], mean, rtol=1e-9)
    assert_allclose(table["miri.f1500w_err"], want[:, :, 0].std(axis=1), rtol=1e-9)
    p84 = np.percentile(want.value, 84, axis=1)[:, 0]
    assert_allclose(table["miri.f1500w_p84"].value, p84, rtol=1e-9)
    assert np.isnan(table["wfc3.f160w"][2])
    # filters that no library knows come in a set
    curve = FilterSet.from_names(["miri.f1500w"])[0]
    mine = FilterSet([dataclasses.replace(curve, name="mine")])
    assert_allclose(real.fluxes(mine), want, rtol=1e-9)


def test_spectra_against_single_models(real, model):
    i, j = 1, 4
    sed = model.evaluate(**values_at(real.grid, real.index[i, j]), mass=real.scale[i, j])
    wave, observed = real.spectra("b", rest=False)
    # wavelengths are those of the median redshift of the draws: the light of bands is the same
    filters = FilterSet.from_names(BANDS)
    seen = filters.synthetic_fluxes(SED(wave, observed[j])).to_value(u.uJy)
    assert_allclose(seen, filters.synthetic_fluxes(sed).to_value(u.uJy), rtol=1e-3)
    # in the rest frame the flux at 10 pc is L_nu / (4 pi d^2)
    wave, rest = real.spectra("b")
    near = sed.redshifted(0.0, cosmology=model.cosmology)
    red = wave > 0.13 * u.um  # where nothing is absorbed on the way
    area = 4 * np.pi * (10 * u.pc) ** 2
    got = (rest[j, red] / area).to_value(u.uJy)
    assert_allclose(got, near.fnu_at(wave[red]).value, rtol=1e-6)


def test_band_of_the_spectrum(real):
    table = real.sed_band("a", (0.16, 0.5, 0.84))
    _, spectra = real.spectra("a")
    assert table["p50"].unit == u.W / u.Hz
    assert_allclose(table["p50"].value, np.median(spectra.value, axis=0))
    assert np.all(table["p16"] <= table["p84"])
    # equal draws have a band of no width, and it is the spectrum
    index = np.tile(real.index[:1, :1], (1, 10, 1))
    same = Samples(real.grid, ["s"], [0], index, np.full((1, 10), 1e10), real.model)
    band = same.sed_band("s", rest=False)
    assert_allclose(band["p16"].value, band["p84"].value, rtol=1e-12)
    flux = SED(band["wave"], band["p50"], redshift=0.0)
    want = 1e10 * real.grid.flux(*index[0, 0])
    got = FilterSet.from_names(BANDS).synthetic_fluxes(flux).to_value(u.uJy)
    assert_allclose(got, want, rtol=1e-3)


def test_what_is_refused(real, model, samples):
    args = (real.grid, real.ids, real.flags)
    refuses("'index' must be of shape", Samples, *args, real.index[:, :5], real.scale)
    refuses("'index' must be within the grid's", Samples, *args, real.index + 10, real.scale)
    with pytest.raises(KeyError, match="no object with the id 'd' among 3"):
        real.loc["d"]
    refuses("no parameter 'mood'", real.values, "mood", error=KeyError)
    bare = Samples(*args, real.index, real.scale)
    refuses("'model' must be an SEDModel", bare.predict, ["miri.f1500w"])
    other = real.with_model(SEDModel.yang2021(agn=False))
    refuses(r"'model' must be the one of the grid \(components", other.sed_band, "a")
    refuses(r"'key' must be .* got 'c' \(no_band\)", real.sed_band, "c")
    refuses("'filters' must be a list", real.predict, "miri.f770w")
    refuses("'levels' must be all between 0 and 1", real.sed_band, "a", (0.16, 84))
    with pytest.raises(ValueError, match="read-only"):
        samples.scale[0, 0] = 1
    assert isinstance(samples.to_table(["mass"]), QTable)


def test_write_and_read(real, model, tmp_path):
    path = tmp_path / "samples.fits"
    real.write(path)
    again = Samples.read(path, real.grid, model=model)
    one, two = real.to_table(), again.to_table()
    # parameters without effect too, which are drawn from their prior
    assert_same_tables(one, two)
    assert again.meta == one.meta == two.meta
    assert_array_equal(again.fluxes(), real.fluxes())
    assert_array_equal(again.spectra("a")[1], real.spectra("a")[1])
    # the grid may have been on disk too
    real.grid.write(tmp_path / "grid.fits")
    grid = type(real.grid).read(tmp_path / "grid.fits")
    assert_array_equal(Samples.read(path, grid).values("mass"), real.values("mass"))
    refuses("already exists", real.write, path, error=OSError)
    real["b"].write(path, overwrite=True)
    assert list(Samples.read(path, real.grid).ids) == ["b"]


def test_files_that_are_no_samples_are_refused(real, grid, samples, tmp_path):
    path = tmp_path / "samples.fits"
    samples.write(path)
    with fits.open(path) as hdus:
        assert hdus[0].header["FORMAT"] == "miricigale-samples-2"
    text = "'grid' must be the one of the samples, <ModelGrid 4 red"
    refuses(text, Samples.read, path, real.grid)
    text = "'grid' must be the ModelGrid that was fitted, got str"
    refuses(text, Samples.read, path, "grid.fits")
    half = tmp_path / "half.fits"
    with fits.open(path) as hdus:
        fits.HDUList([hdus[0], hdus["TEXT"]]).writeto(half)
    text = r"half\.fits is not a complete file of samples"
    refuses(text, Samples.read, half, grid, error=DataError)
    grid.write(path, overwrite=True)
    refuses("holds no samples", Samples.read, path, grid, error=DataError)
    refuses(r"absent\.fits", Samples.read, tmp_path / "absent.fits", grid, error=DataError)


def test_draws_with_a_prior_keep_it_in_files(tmp_path):
    grid = make_grid()
    fitter = node_fitter(grid, priors={"temperature_polar": [1.0, 3.0]})
    drawn = fitter.sample(draw_photometry(grid, 2)[0], 500, seed=4)
    drawn.write(tmp_path / "s.fits")
    again = Samples.read(tmp_path / "s.fits", grid)
    assert_array_equal(again.values("temperature_polar"), drawn.values("temperature_polar"))
    assert again.meta == drawn.meta


def test_draws_are_those_of_the_object_whatever_its_company(grid, photometry):
    fitter = node_fitter(grid)
    whole = fitter.sample(photometry, 50, seed=4)
    turned = fitter.sample(photometry[::-1], 50, seed=4)
    assert_array_equal(whole.index, turned.index[::-1])
    assert_array_equal(whole.scale, turned.scale[::-1])
    with ThreadPoolExecutor(2) as pool:
        spread = fitter.sample(photometry, 50, seed=4, executor=pool)
    assert_array_equal(whole.scale, spread.scale)
    other = fitter.sample(photometry, 50, seed=5)
    assert np.any(whole.index != other.index)
    for bad in (0, 1.5, True):
        refuses("'n_draws' must be an integer >= 1", fitter.sample, photometry, bad, seed=1)


def test_draws_have_the_joint_posterior_of_all_models():
    """Frequencies of (galaxy, torus, fraction) against the weights of all models, by chi2."""
    grid = make_grid(3)
    table, _ = draw_photometry(grid, 3, seed=5)
    fitter = node_fitter(grid, settings=GridSettings(rtol=0))
    results = fitter.fit(table)
    n = 20_000
    samples = fitter.sample(table, n, seed=9)
    for i in range(3):
        want = brute_force(grid, results.flux[i], results.sigma[i])["weights"]
        got = np.zeros(want.shape)
        np.add.at(got, tuple(samples.index[i].T), 1)
        # one cell for all that is rare
        common = n * want > 10
        expected = np.append(n * want[common], n * want[~common].sum())
        seen = np.append(got[common], got[~common].sum())
        keep = expected > 0
        statistic = np.sum((seen - expected)[keep] ** 2 / expected[keep])
        assert chi2.sf(statistic, keep.sum() - 1) > 1e-4


def test_histories_hold_the_mass_that_was_formed(real):
    """The integral of each history is its mass, and its end the rate of the last 100 Myr."""
    draws = real["a"].n_draws
    # all quantiles of the draws, so that their mean is that of the draws
    levels = tuple((np.arange(draws) + 0.5) / draws)
    table = real.sfh_band("a", levels)
    step = np.diff(table["lookback"].to_value(u.yr))[0]
    rates = np.array([table[name].value for name in table.colnames[1:]])
    assert_allclose(rates.mean(axis=0).sum() * step, real.mean("mass")[0].value, rtol=0.03)
    recent = table["lookback"] < 100 * u.Myr
    assert_allclose(rates.mean(axis=0)[recent].mean(), real.mean("sfr_100myr")[0].value, rtol=0.05)
    axes = real.plot_sfh("a")
    assert axes.get_xlabel() == "lookback time (Gyr)"
    assert len(axes.collections) == len(axes.lines) == 1
    plt.close("all")


def test_bands_are_named_and_mixed_as_elsewhere(real):
    """Names, usual names and filters of one's own stand in one list."""
    box = Filter(np.linspace(9.0, 12.0, 31) * u.um, np.ones(31), name="box")
    table = real.predict(["F770W", "F1000W", box])
    expected = real.predict(FilterSet(["miri.f770w", "miri.f1000w", box]))
    assert_same_tables(table, expected)
    assert "miri.f1000w_p16" in table.colnames
