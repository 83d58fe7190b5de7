"""Calibration of a survey, priors of mass, redshift and AGN fraction: closed forms and made-up catalogs."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, vstack
from numpy.testing import assert_allclose

from helpers.errors import refuses
from helpers.grids import make_grid, photometry_table
from miricigale.fitting import (
    BayesFitter,
    GridSettings,
    MassFunction,
    agn_fraction_prior,
    mock_analysis,
)
from miricigale.fitting.survey.survey import SurveyCalibration, calibrate
from miricigale.sed import SEDModel
from miricigale.sed.cosmology import COSMOLOGY
from miricigale.utils.exceptions import DataError


def test_prior_of_mass_and_redshift():
    """Two galaxies of the same light at two redshifts: odds are those of density times volume of the cells."""
    grid = make_grid(3, n_z=2, n_tau=2, n_age=1, frac=[0.0, 0.3])
    galaxy = np.repeat(np.repeat(grid.galaxy[:1, :1], 2, axis=1), 2, axis=0)
    galaxy[1] *= 0.1
    properties = QTable({"stellar_mass": [0.5, 0.8], "sfr_100myr": [1e-9, 1e-9] / u.yr})
    grid = replace(
        grid, galaxy=galaxy, galaxy_properties=properties, agn=np.repeat(grid.agn[:1], 2, axis=0)
    )
    grid = replace(grid, dust_luminosity=np.full(2, 1e-300))
    flux = 1e10 * galaxy[0, 0]
    table = photometry_table(grid.filters, flux, 0.5 * flux)
    settings = GridSettings(mass_function=MassFunction(10.5, -1.4, -2.0), rtol=0.0, interpolate=0)
    z = grid.redshift
    mass = np.array([1e10, 1e11])[:, None] * [0.5, 0.8]
    x = mass / 10**10.5
    prior = x**-0.4 * np.exp(-x) * (1 + z[:, None]) ** -2.0
    prior *= COSMOLOGY.differential_comoving_volume(z).value[:, None]
    # cells of z = 0.2 and 2 are from 0 to 1.1 and on to 2.9
    prior *= [[1.1], [1.8]]
    found = BayesFitter(grid, model_error=0.0, settings=settings).fit(table)
    assert_allclose(found.pdf["redshift"][0], prior.sum(axis=1) / prior.sum(), rtol=1e-4)
    assert_allclose(found.pdf["tau"][0], prior.sum(axis=0) / prior.sum(), rtol=1e-4)
    refuses(
        "'mass_function' must be a function",
        BayesFitter,
        grid,
        settings=GridSettings(mass_function=1.0),
    )


def test_prior_of_agn_fractions_is_that_of_accretion_rates():
    """A tenth is active; above f the number is the integral of lambda^-0.5 exp(-lambda) over log lambda."""
    fractions = [0.0, 0.2, 0.6]
    weights = agn_fraction_prior(fractions)
    assert weights.sum() == pytest.approx(1)
    log = np.linspace(-2, 2, 200001)
    number = 10 ** (-0.5 * log) * np.exp(-(10**log))
    # f = 0.4: L_AGN of dust = 2/3 of 10 Lsun/Msun, half of 66 lambda
    rate = np.log10(2 / 3 * 10 / 33)
    above = np.trapezoid(number[log >= rate], log[log >= rate]) / np.trapezoid(number, log)
    assert weights[2] == pytest.approx(0.1 * above, rel=1e-3)
    refuses("'frac_agn' must be ascending", agn_fraction_prior, [0.1, 0.2])


BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w"]
BANDS += ["miri.f560w", "miri.f770w"]


@pytest.fixture(scope="module")
def survey():
    """A fitter, and a catalog in which a zero point is 15 % off and MIRI scatters by three times its errors."""
    model, rng, n = SEDModel.yang2021(agn=False), np.random.default_rng(4), 240
    axes = {"redshift": np.linspace(0.5, 3.0, 26), "age": [0.5, 1.0, 2.0], "ebv": [0.1, 0.3]}
    truth = {name: rng.choice(values, n) for name, values in axes.items()}
    truth["age"] = rng.choice([0.5, 1.0, 2.0], n, p=[0.7, 0.2, 0.1])
    fluxes = model.fluxes(truth | {"mass": np.full(n, 1e10)}, BANDS)
    table = QTable({"id": np.arange(n), "z_spec": truth["redshift"]})
    for band in BANDS:
        error = 0.04 * fluxes[band]
        wide = 3.0 if band.startswith("miri") else 1.0
        point = 0.85 if band == "nircam.f277w" else 1.0
        table[band] = point * (fluxes[band] + wide * error * rng.normal(size=n))
        table[f"{band}_err"] = point * error
    return BayesFitter(model, BANDS, axes=axes), table


@pytest.mark.slow
def test_calibration_finds_what_was_done_to_a_catalog(survey, tmp_path):
    """Zero points, the instrument that scatters, how frequent ages are; files keep all of it."""
    fitter, table = survey
    found = calibrate(fitter, table, redshift="z_spec", reference="wfc3.f160w", name="test")
    rows = dict(zip(found.bands["band"], found.bands, strict=True))
    assert rows["nircam.f277w"]["zero_point"] == pytest.approx(1 / 0.85, abs=0.03)
    others = [rows[band]["zero_point"] for band in BANDS[:4]]
    assert_allclose(others, 1.0, atol=0.03)
    miri = rows["miri.f560w"]
    assert np.hypot(0.04 * miri["error_factor"], miri["error_part"]) == pytest.approx(
        0.12, rel=0.25
    )
    assert_allclose(found.priors["age"][1], [0.7, 0.2, 0.1], atol=0.1)
    scores = {row["fit"]: row for row in found.scores}
    assert abs(scores["after"]["bias"]) < 0.01
    assert scores["after"]["outliers"] <= scores["before"]["outliers"]
    found.write(tmp_path / "test.ecsv")
    again = SurveyCalibration.read(tmp_path / "test.ecsv")
    assert again.mass_function == found.mass_function
    assert_allclose(again.template_error.error, found.template_error.error)
    fits = [
        fitter.replace(calibration=one, model_error=None).fit(table[:5]) for one in (found, again)
    ]
    assert_allclose(fits[0].pdf["redshift"], fits[1].pdf["redshift"])
    assert fits[1].meta["fit"]["calibration"] == "test"
    assert_allclose(
        fits[1].flux[:, 4], table["nircam.f277w"][:5].value * rows["nircam.f277w"]["zero_point"]
    )
    (tmp_path / "other.ecsv").write_text("no table", encoding="utf-8")
    text = "other.ecsv.*a calibration of a survey"
    refuses(text, SurveyCalibration.read, tmp_path / "other.ecsv", error=DataError)
    damaged = (tmp_path / "test.ecsv").read_text().replace("template_error", "templates")
    (tmp_path / "other.ecsv").write_text(damaged, encoding="utf-8")
    text = "other.ecsv is no calibration.*or a damaged one"
    refuses(text, SurveyCalibration.read, tmp_path / "other.ecsv", error=DataError)
    mock = mock_analysis(
        fitter.replace(calibration=found, model_error=None), fits[0], table[:5], seed=1
    )
    ratio = mock.recovered.flux[:, 4] / fits[0].best_flux[:, 4]
    assert np.median(ratio) == pytest.approx(1, abs=0.06)
    refuses(
        "'photometry' must be with 100 known redshifts",
        calibrate,
        fitter,
        table[:80],
        redshift="z_spec",
    )


@pytest.mark.slow
def test_errors_of_a_calibration_are_half_of_the_difference_of_its_halves(survey):
    """Halves of the same sources have their own calibration; of other sources it is the mean, and the error."""
    fitter, table = survey
    fitter = fitter.replace(settings=GridSettings(interpolate=0))
    halves = [table[:60], table[60:120]]

    def calibrated(first, second):
        catalog = vstack([halves[first], halves[second]])[np.arange(120).reshape(2, 60).T.ravel()]
        catalog["id"] = np.arange(120)
        return calibrate(fitter, catalog, redshift="z_spec", name="test")

    both, first, second = calibrated(0, 1), calibrated(0, 0), calibrated(1, 1)
    a, b = (one.priors["age"][1] for one in (first, second))
    assert np.ptp(a - b) > 1e-3
    assert_allclose(first.errors["age"], 0, atol=1e-12)
    assert_allclose(both.priors["age"][1], (a + b) / 2, rtol=1e-9)
    assert_allclose(both.errors["age"], np.abs(a - b) / 2, rtol=1e-9)
    a, b = (one.bands["zero_point"] for one in (first, second))
    assert_allclose(both.bands["zero_point_err"], np.abs(a - b) / 2, rtol=1e-9, atol=1e-12)
