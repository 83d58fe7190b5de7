"""Errors of bands from what the others predict: closed forms, drawn numbers, catalogs with known errors."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from helpers.errors import refuses
from miricigale.fitting import (
    BayesFitter,
    GridSettings,
    SurveyCalibration,
    TemplateError,
    calibrate_bands,
)
from miricigale.fitting.catalogs.catalog_calibration import (
    MAX_SOURCES,
    SourceSample,
    calibrate_file,
)
from miricigale.fitting.catalogs.from_files import calibrates_itself
from miricigale.fitting.survey.band_errors import (
    DEFAULT_PRIOR,
    MIRI_PRIOR,
    PredictedFluxes,
    estimate_band_errors,
    left_out_predictions,
    long_instruments,
    prior_of_band,
)
from miricigale.sed import SEDModel
from miricigale.utils.exceptions import OtherResultsError
from miricigale.utils.row_files import open_rows

BANDS = ["acs.f606w", "acs.f814w", "wfc3.f125w", "wfc3.f160w", "nircam.f277w", "nircam.f444w"]
BANDS += ["miri.f560w", "miri.f770w"]
MIRI = BANDS[-2:]


def test_a_flux_is_taken_out_of_a_gaussian():
    """The mean of a prediction and a flux, weighted by variances, gives the prediction back."""
    predicted, spread = np.array([[3.0, 1.0]]), np.array([[0.6, 0.5]])
    flux, sigma = np.array([[4.0, 7.0]]), np.array([[0.3, np.inf]])
    weight = 1 / spread**2 + 1 / sigma**2
    results = SimpleNamespace(
        model_flux=(predicted / spread**2 + flux / sigma**2) / weight,
        model_flux_std=1 / np.sqrt(weight),
        flux=flux,
        sigma=sigma,
        limit=np.zeros((1, 2), dtype=bool),
        chi2=np.array([2.0]),
        reduced_chi2=np.array([2.0]),
        fitted=np.array([True]),
    )
    mean, std = left_out_predictions(results)
    assert_allclose(mean, predicted, rtol=1e-12)
    assert_allclose(std, spread, rtol=1e-12)
    # a fit that nothing fits predicts nothing, nor do others where the flux alone makes the model flux
    results.model_flux_std = np.array([[0.299, 0.5]])
    mean, _ = left_out_predictions(results)
    assert np.isnan(mean[0, 0])
    assert mean[0, 1] == pytest.approx(1.0)
    results.fitted = np.array([False])
    assert np.all(np.isnan(left_out_predictions(results)[0]))


def drawn_fluxes(n, *, factor, part, wrong, zero_point, seed):
    """Fluxes about predictions with errors of 0.3 to 20 % that are too small, and some that are wrong."""
    rng = np.random.default_rng(seed)
    truth = 10 ** rng.uniform(-1, 2, n)
    spread = 0.05 * truth
    model_error = np.full(n, 0.03)
    predicted = truth + spread * rng.normal(size=n)
    err = truth * 10 ** rng.uniform(-2.5, -0.7, n)
    wide = np.where(rng.random(n) < wrong, 5.0, 1.0)
    noise = np.sqrt((factor * err) ** 2 + ((part**2 + 0.03**2) * truth**2))
    flux = (truth + wide * noise * rng.normal(size=n)) / zero_point
    return PredictedFluxes(flux, err / zero_point, predicted, spread, model_error)


@pytest.mark.parametrize(
    ("factor", "part", "wrong", "zero_point"), [(2.5, 0.1, 0.05, 1.06), (1.0, 0.02, 0.0, 1.0)]
)
def test_errors_that_fluxes_were_drawn_with(factor, part, wrong, zero_point):
    truth = {"factor": factor, "part": part, "wrong": wrong, "zero_point": zero_point}
    errors = estimate_band_errors(drawn_fluxes(4000, seed=3, **truth), DEFAULT_PRIOR)
    assert errors.factor == pytest.approx(factor, rel=0.08)
    assert errors.part == pytest.approx(part, abs=0.012)
    assert errors.wrong == pytest.approx(wrong, abs=0.012)
    assert abs(errors.zero_point - zero_point) < 4 * errors.zero_point_err
    # of a mean of values with these errors
    assert 0.0005 < errors.zero_point_err < 0.004


def test_without_fluxes_the_prior_remains_and_with_many_it_does_not_count():
    """MIRI's errors may be right, too: the prior of 3.3 gives way to fluxes that scatter by their errors."""
    none = PredictedFluxes(*np.zeros((5, 0)))
    errors = estimate_band_errors(none, MIRI_PRIOR)
    assert_allclose([errors.factor, errors.part, errors.wrong], [3.3, 0.15, 2 / 42], rtol=1e-3)
    assert errors.zero_point == 1.0
    none = estimate_band_errors(none, DEFAULT_PRIOR)
    assert_allclose([none.factor, none.part, none.zero_point], [1.0, 0.02, 1.0], rtol=1e-3)
    assert none.zero_point_err == pytest.approx(0.04, rel=1e-3)
    fluxes = drawn_fluxes(500, factor=1.0, part=0.02, wrong=0.0, zero_point=1.0, seed=8)
    errors = estimate_band_errors(fluxes, MIRI_PRIOR)
    assert errors.factor == pytest.approx(1.0, abs=0.2)
    assert errors.part < 0.05


def test_instruments_whose_bands_are_long():
    assert long_instruments(BANDS) == [MIRI]
    assert long_instruments(["sedpy.jwst_f770w", *BANDS[:5]]) == [["sedpy.jwst_f770w"]]
    assert long_instruments(["irac.ch1", "irac.ch4", *BANDS[:4]]) == []
    # three bands do not predict a fourth
    assert long_instruments([*BANDS[:3], *MIRI]) == []
    assert prior_of_band("sedpy.jwst_f770w") is MIRI_PRIOR
    assert prior_of_band("sedpy.jwst_f444w") is DEFAULT_PRIOR


AXES = {"redshift": np.linspace(0.5, 3.0, 26), "age": [0.5, 1.0, 2.0], "ebv": [0.1, 0.3]}


@pytest.fixture(scope="module")
def model_fluxes():
    """Fluxes of 400 galaxies on the nodes of a small grid, and their redshifts."""
    model = SEDModel.yang2021(agn=False)
    rng = np.random.default_rng(4)
    truth = {name: rng.choice(values, 400) for name, values in AXES.items()}
    mass = 10 ** rng.uniform(9.5, 11, 400)
    return model, truth["redshift"], model.fluxes(truth | {"mass": mass}, BANDS)


def catalog(model_fluxes, *, factor=1.0, part=0.0, zero_point=1.0, wrong=0.0, seed=5):
    """Catalog whose errors in MIRI are too small, F277W has another zero point, and F160W wrong fluxes."""
    _, redshift, fluxes = model_fluxes
    rng = np.random.default_rng(seed)
    n = len(redshift)
    table = QTable({"id": np.arange(n), "z_spec": redshift})
    for band in BANDS:
        flux = fluxes[band].to_value(u.uJy)
        error = flux * 10 ** rng.uniform(-2.0, -1.0, n)
        is_miri = band in MIRI
        noise = np.hypot((factor if is_miri else 1.0) * error, (part if is_miri else 0.0) * flux)
        # models of the fit have errors of 2 %
        noise = np.hypot(noise, 0.02 * flux)
        if band == "wfc3.f160w":
            noise = np.where(rng.random(n) < wrong, 5.0 * noise, noise)
        scale = 1.0 / zero_point if band == "nircam.f277w" else 1.0
        table[band] = scale * (flux + noise * rng.normal(size=n)) * u.uJy
        table[f"{band}_err"] = scale * error * u.uJy
    return table


@pytest.fixture(scope="module")
def fitter(model_fluxes):
    error = TemplateError([1.0] * u.um, [0.02])
    return BayesFitter(model_fluxes[0], BANDS, axes=AXES, model_error=0.0, template_error=error)


def rows_of(calibration):
    return dict(zip(calibration.bands["band"], calibration.bands, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("known", [None, "z_spec"])
def test_a_catalog_says_what_was_done_to_it(model_fluxes, fitter, known):
    """At free redshifts and at known ones: factor, part, zero point, share of wrong fluxes."""
    table = catalog(model_fluxes, factor=2.5, part=0.1, zero_point=1.12, wrong=0.15)
    found = calibrate_bands(fitter, table, redshift=known, name="mine")
    rows = rows_of(found)
    assert found.name == "mine"
    assert [str(band) for band in rows] == BANDS
    assert rows["nircam.f277w"]["zero_point"] == pytest.approx(1.12, abs=0.02)
    for band in (*BANDS[:4], "nircam.f444w"):
        assert rows[band]["zero_point"] == pytest.approx(1.0, abs=0.015)
    assert rows["wfc3.f160w"]["wrong"] == pytest.approx(0.15, abs=0.07)
    assert rows["acs.f814w"]["wrong"] < 0.05
    for band in MIRI:
        assert rows[band]["zero_point"] == 1.0
        assert rows[band]["error_factor"] == pytest.approx(2.5, rel=0.15)
        assert rows[band]["error_part"] == pytest.approx(0.1, rel=0.25)
    # fits allow for wrong fluxes in MIRI alone
    outlier = dict(zip(BANDS, found.bands["outlier"], strict=True))
    assert all(outlier[band] == 0.0 for band in BANDS[:6])
    assert all(outlier[band] == rows[band]["wrong"] for band in MIRI)
    # the errors of models are the fitter's
    assert found.template_error([0.5] * u.um) == pytest.approx(0.02)
    calibrated = fitter.replace(calibration=found, model_error=None, template_error=None)
    fit = calibrated.fit(table[:4])
    flux = table["nircam.f277w"][:4].to_value(u.uJy)
    assert_allclose(fit.flux[:, 4], rows["nircam.f277w"]["zero_point"] * flux, rtol=1e-12)
    line = next(line for line in found.summary().splitlines() if "miri.f770w" in line)
    assert "1.000 " in line


def test_errors_that_are_right_stay(model_fluxes, fitter):
    """A simulated catalog: factors near 1 in MIRI, too, in spite of its prior."""
    rows = rows_of(calibrate_bands(fitter, catalog(model_fluxes)))
    for band in BANDS:
        assert rows[band]["error_factor"] == pytest.approx(1.0, abs=0.2), band
        assert rows[band]["zero_point"] == pytest.approx(1.0, abs=0.015)
        assert rows[band]["error_part"] < 0.04


def test_scores_of_other_sources_are_not_those_of_a_catalog(model_fluxes, fitter):
    base = SurveyCalibration.survey().without_priors()
    assert base.scores is not None
    some = fitter.replace(calibration=base, model_error=None, template_error=None)
    found = calibrate_bands(some, catalog(model_fluxes)[:5])
    assert found.scores is None
    assert found.template_error is base.template_error


@pytest.mark.parametrize("n", [1, 10, 50])
def test_few_sources_have_the_prior(model_fluxes, fitter, n):
    found = calibrate_bands(fitter, catalog(model_fluxes, factor=2.5)[:n])
    rows = rows_of(found)
    for band in MIRI:
        assert tuple(rows[band]["error_factor", "error_part"]) == (3.3, 0.15)
    for band in BANDS[:6]:
        assert tuple(rows[band]["zero_point", "error_factor", "error_part"]) == (1.0, 1.0, 0.02)
    assert np.all(found.bands["n"] == 0)
    assert found.summary().count("prior") == len(BANDS)


def test_catalogs_without_miri_and_with_too_few_other_bands(model_fluxes, fitter):
    table = catalog(model_fluxes, zero_point=1.1)
    without = table[[name for name in table.colnames if not name.startswith("miri")]]
    rows = rows_of(calibrate_bands(fitter.replace(filters=BANDS[:6]), without))
    assert list(rows) == BANDS[:6]
    assert rows["nircam.f277w"]["zero_point"] == pytest.approx(1.1, abs=0.02)
    few = rows_of(calibrate_bands(fitter.replace(filters=[*BANDS[:2], MIRI[0]]), table))
    assert few[MIRI[0]]["error_factor"] == 3.3
    assert all(row["n"] == 0 for row in few.values())


def test_the_choice_of_sources_does_not_depend_on_pieces(model_fluxes):
    """2,400 rows in pieces of any size; half of the sample is sources that MIRI should see."""
    table = catalog(model_fluxes)
    table = table[np.random.default_rng(1).integers(len(table), size=2400)]
    table["id"] = np.arange(len(table))
    # MIRI covers a fifth of the field, and some fluxes are limits
    for band in MIRI:
        table[band][480:] = np.nan * u.uJy
    table["acs.f606w_limit"] = np.arange(len(table)) % 7 == 0

    def chosen(size, seed=0):
        sample = SourceSample(BANDS, (0.5, 3.0), seed)
        for start in range(0, len(table), size):
            sample.add(table[start : start + size], redshift="z_spec")
        return sample

    whole = chosen(2400)
    rows = whole.rows
    assert len(whole) == len(rows) == MAX_SOURCES
    assert np.all(np.diff(rows) > 0)
    assert 250 <= np.count_nonzero(rows < 480) < 320
    assert_allclose(whole.redshift, table["z_spec"][rows])
    assert_allclose(whole.table["acs.f814w"], table["acs.f814w"][rows])
    assert np.array_equal(whole.table["acs.f606w_limit"], table["acs.f606w_limit"][rows])
    for size in (97, 600):
        other = chosen(size)
        assert np.array_equal(other.rows, rows)
        assert_allclose(other.table["miri.f770w"], whole.table["miri.f770w"])
    assert not np.array_equal(chosen(2400, seed=1).rows, rows)


def test_fitters_that_cannot_be_calibrated(model_fluxes, fitter):
    table = catalog(model_fluxes)
    mixed = fitter.replace(model_error={"acs.f606w": 0.1, "miri.f770w": 0.2}, template_error=None)
    refuses(
        "with a calibration, a template error or one model error", calibrate_bands, mixed, table
    )
    refuses("'seed' must be a non-negative integer", calibrate_bands, fitter, table, seed=-1)


@pytest.mark.slow
def test_a_catalog_on_disk_is_measured_once_and_by_pieces(
    model_fluxes, fitter, tmp_path, monkeypatch
):
    """The numbers of the table in memory, for pieces of any size; a second call reads them."""
    table = catalog(model_fluxes, factor=2.5, part=0.1, zero_point=1.12)
    path = tmp_path / "cat.fits"
    table.write(path)
    wanted = calibrate_bands(fitter, table).bands
    names = ("n", "zero_point", "error_factor", "error_part", "wrong")
    for size in (1000, 70):
        output = tmp_path / f"out{size}"
        options = {"resume": True, "executor": None}
        calibrated = calibrate_file(fitter, open_rows(path, size), output, options=options)
        found = SurveyCalibration.read(output / "calibration.ecsv")
        assert found.name.startswith("bands of cat.fits (")
        for name in names:
            assert_allclose(found.bands[name], wanted[name], rtol=1e-9)
        assert calibrated.zero_points["nircam.f277w"] == found.bands["zero_point"][4]
    monkeypatch.setattr("miricigale.fitting.catalogs.catalog_calibration.calibrate_sample", None)
    again = calibrate_file(fitter, open_rows(path, 70), output, options=options)
    assert again.calibration.name == found.name
    # known redshifts, another catalog or other models are another fit
    known = options | {"redshift": "z_spec"}
    text = "holds a calibration of another fit: 'bands of cat.fits.*resume=False to replace it"
    other = {"fitter": fitter, "rows": open_rows(path, 70), "output": output}
    refuses(text, calibrate_file, **other, options=known, error=OtherResultsError)
    table[:300].write(path, overwrite=True)
    other["rows"] = open_rows(path, 70)
    refuses(text, calibrate_file, **other, options=options, error=OtherResultsError)
    monkeypatch.undo()
    calibrate_file(**other, options=options | {"resume": False})
    assert SurveyCalibration.read(output / "calibration.ecsv").name != found.name


def test_what_is_known_of_redshifts_is_used(model_fluxes, fitter):
    """A density that is narrow about the known redshift gives what the redshift gives."""
    table = catalog(model_fluxes, factor=2.5, part=0.1)
    table = table[[name for name in table.colnames if not name.startswith("acs.")]]
    some = fitter.replace(filters=BANDS[2:])
    nodes = np.linspace(0.4, 3.1, 271)
    density = np.exp(-0.5 * ((nodes - table["z_spec"][:, None]) / 0.02) ** 2)
    by_density = calibrate_bands(some, table, redshift_prior=(nodes, density)).bands
    known = calibrate_bands(some, table, redshift="z_spec").bands
    for name in ("error_factor", "error_part", "zero_point"):
        assert_allclose(by_density[name], known[name], rtol=0.05)
    # sources without a redshift are left out, and few are left
    table["z_spec"][20:] = np.nan
    assert np.all(calibrate_bands(some, table, redshift="z_spec").bands["n"] == 0)


@pytest.mark.parametrize(
    ("given", "wanted"),
    [
        ({}, True),
        ({"axes": "far-infrared"}, True),
        ({"axes": "yang2021"}, False),
        ({"calibrate": False}, False),
        ({"calibrate": None}, False),
        ({"calibration": None}, False),
        ({"calibration": "calibration.ecsv"}, False),
        ({"model_error": 0.1}, False),
        ({"models": len}, False),
        ({"calibrate": "z_spec", "calibration": "calibration.ecsv"}, "z_spec"),
    ],
)
def test_catalogs_that_calibrate_themselves(given, wanted):
    """Those of real galaxies, unless errors were given."""
    default = {"calibrate": True, "calibration": "default", "axes": "survey"}
    default |= {"models": None, "model_error": None}
    assert calibrates_itself(**default | given) == wanted


def test_calibrate_is_a_column_or_a_truth_value():
    text = "'calibrate' must be True, False, None or a column of known redshifts, got 3"
    refuses(text, calibrates_itself, 3, "default", "survey", None, None)


@pytest.mark.slow
def test_fitters_of_real_galaxies_have_the_prior_of_bands_that_were_not_measured():
    """Unless other errors are given; the calibration itself says nothing of bands."""
    bands = ["acs.f814w", "F160W", "miri.f770w"]
    fitter = BayesFitter(
        SEDModel.survey(), bands, axes="survey", settings=GridSettings(interpolate=0)
    )
    assert fitter.calibration.name == "CEERS"
    assert fitter.model_errors == {"acs.f814w": 0.02, "wfc3.f160w": 0.02, "miri.f770w": 0.15}
    assert fitter.settings()["error_factor"]["miri.f770w"] == 3.3
    outlier = fitter.calibration.of_bands("outlier", fitter.bands, 0.0)
    assert outlier == {"acs.f814w": 0.0, "wfc3.f160w": 0.0, "miri.f770w": pytest.approx(2 / 42)}
    changed = fitter.replace(n_bands_min=3)
    assert changed.model_errors == fitter.model_errors
    as_published = fitter.replace(calibration=SurveyCalibration.survey())
    assert set(as_published.model_errors.values()) == {0.0}
    assert set(fitter.replace(model_error=0.1).model_errors.values()) == {0.1}
