"""Moments of model fluxes from models that a scan of the nodes draws, against those of whole fits."""

from concurrent.futures import ThreadPoolExecutor

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from miricigale.fitting import BayesFitter, GridSettings, TemplateError
from miricigale.fitting.grid.node_fluxes import flux_moments
from miricigale.fitting.survey.band_errors import left_out_predictions
from miricigale.sed import SEDModel

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w"]
MIRI = "miri.f770w"
AXES = {"redshift": np.linspace(0.5, 3.0, 26), "age": [0.5, 1.0, 2.0], "ebv": [0.1, 0.3]}
NAMES = ("model_flux", "model_flux_std", "chi2", "redshift", "sigma")
N = 24


def make_fitter(axes, *, agn, **options):
    error = TemplateError([0.3, 2.0] * u.um, [0.08, 0.04])
    model = SEDModel.yang2021(agn=agn, libraries="bundled")
    grid = model.grid(axes, [*BANDS, MIRI])
    settings = GridSettings(interpolate=0)
    options = {"model_error": 0.0, "template_error": error, "settings": settings} | options
    return BayesFitter(grid, BANDS, **options)


@pytest.fixture(scope="module")
def fitter():
    return make_fitter(AXES, agn=False)


@pytest.fixture(scope="module")
def photometry(fitter):
    """Galaxies on nodes with noise of a tenth of the flux; the last band is missing in some of them."""
    rng = np.random.default_rng(2)
    grid = fitter.grid
    z = rng.integers(grid.redshift.size, size=N)
    fluxes = 3e10 * grid.galaxy[z, rng.integers(grid.galaxy.shape[1], size=N)]
    table = QTable({"id": np.arange(N), "z_spec": grid.redshift[z]})
    for band in BANDS:
        flux = fluxes[:, grid.filters.index(band)]
        table[band] = flux * (1.0 + 0.1 * rng.normal(size=N)) * u.uJy
        table[f"{band}_err"] = 0.1 * flux * u.uJy
    table[BANDS[-1]][::5] = np.nan * u.uJy
    return table


def assert_moments_of_fit(moments, results, rows=slice(None)):
    """To rounding: what the sum over all nodes gave."""
    for name in NAMES[:3] + NAMES[4:]:
        assert_allclose(getattr(moments, name)[rows], getattr(results, name)[rows], rtol=1e-9)
    assert_allclose(moments.redshift[rows], results.mean("redshift").value[rows], rtol=1e-9)


def test_moments_are_those_of_the_sum_over_nodes(fitter, photometry):
    """Without AGN the scan is the posterior: means differ by the error of 1,024 draws."""
    moments = flux_moments(fitter, photometry)
    results = fitter.fit(photometry)
    assert moments.filters == results.filters
    assert_array_equal(np.isfinite(moments.sigma), np.isfinite(results.sigma))
    off = (moments.model_flux - results.model_flux) / results.model_flux_std
    # one draw from each 1,024th part: the error is below that of independent draws
    assert np.max(np.abs(off)) < 1.0 / np.sqrt(1024)
    assert_allclose(moments.model_flux_std, results.model_flux_std, rtol=0.05)
    off = (moments.redshift - results.mean("redshift").value) / results.std("redshift").value
    assert np.max(np.abs(off)) < 1.0 / np.sqrt(1024)
    # the best model is among those drawn
    assert_allclose(moments.chi2, results.chi2, atol=1e-9)
    assert_allclose(moments.reduced_chi2, results.reduced_chi2, atol=1e-9)
    used = np.isfinite(results.sigma)
    assert_allclose(moments.sigma[used], results.sigma[used], rtol=1e-9)


def test_predictions_without_each_band_are_those_of_the_fit(fitter, photometry):
    """For bands that are fitted and MIRI, which is not."""
    predicted, predicted_std = left_out_predictions(flux_moments(fitter, photometry))
    wanted, wanted_std = left_out_predictions(fitter.fit(photometry))
    assert_array_equal(np.isfinite(predicted), np.isfinite(wanted))
    good = np.isfinite(wanted)
    assert good[:, -1].all()
    assert np.max(np.abs(predicted - wanted)[good] / wanted_std[good]) < 0.1
    assert_allclose(predicted_std[good], wanted_std[good], rtol=0.05)


def test_agn_have_their_weight(photometry):
    """The scan has each galaxy with its best AGN; draws are weighted by the sums over all of them."""
    axes = AXES | {"tau97": [3.0, 7.0], "frac_agn": [0.0, 0.2, 0.5, 0.8]}
    fitter = make_fitter(axes, agn=True)
    moments = flux_moments(fitter, photometry)
    results = fitter.fit(photometry)
    off = (moments.model_flux - results.model_flux) / results.model_flux_std
    assert np.max(np.abs(np.median(off, axis=0))) < 0.02
    assert np.sqrt(np.mean(np.square(off))) < 0.04
    assert_allclose(moments.model_flux_std, results.model_flux_std, rtol=0.1)


def test_sums_serve_where_the_scan_does_not(fitter, photometry):
    """Limits, models that are far off, and objects without a model."""
    table = photometry.copy()
    table[f"{BANDS[0]}_limit"] = np.arange(N) == 3
    table[BANDS[2]][6] *= 3.0
    for band in BANDS:
        table[band][9] = np.nan * u.uJy
    moments = flux_moments(fitter, table)
    results = fitter.fit(table)
    assert_moments_of_fit(moments, results, [3, 6])
    assert not moments.fitted[9]
    assert moments.fitted.sum() == N - 1
    assert_array_equal(moments.fitted, results.fitted)


def test_known_redshifts_and_bands_that_may_be_wrong(fitter, photometry):
    z = photometry["z_spec"]
    moments = flux_moments(fitter, photometry, redshift=z)
    assert_moments_of_fit(moments, fitter.fit(photometry, redshift=z))
    mixed = fitter.replace(outliers={BANDS[3]: 0.1})
    assert_moments_of_fit(flux_moments(mixed, photometry), mixed.fit(photometry))
    # a band of the grid that is not fitted changes nothing
    other = fitter.replace(outliers={MIRI: 0.1})
    wanted = flux_moments(fitter, photometry)
    for name in NAMES:
        assert_array_equal(getattr(flux_moments(other, photometry), name), getattr(wanted, name))


def test_densities_of_redshift_count(fitter, photometry):
    nodes = np.linspace(0.4, 3.1, 271)
    density = np.exp(-0.5 * ((nodes - photometry["z_spec"].value[:, None]) / 0.05) ** 2)
    moments = flux_moments(fitter, photometry, redshift_prior=(nodes, density))
    results = fitter.fit(photometry, redshift_prior=(nodes, density))
    std = results.std("redshift").value
    assert np.all(std < 0.08)
    assert np.max(np.abs(moments.redshift - results.mean("redshift").value)) < 0.02


def test_executors_change_nothing(fitter, photometry):
    wanted = flux_moments(fitter, photometry)
    # more than a piece
    repeated = np.arange(1200) % N
    table = photometry[repeated]
    table["id"] = np.arange(1200)
    with ThreadPoolExecutor(2) as executor:
        moments = flux_moments(fitter, table, executor=executor)
    for name in NAMES:
        assert_array_equal(getattr(moments, name), getattr(wanted, name)[repeated])
