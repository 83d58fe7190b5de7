"""AGN added to photometry, and counted again."""

import json
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from helpers.commands import command
from helpers.errors import refuses, warned
from miricigale import BayesFitter, ErrorModel, FitResults, SEDModel
from miricigale.agn import AGNSurvey, NoiseCurve, add_light, agn_light, injections
from miricigale.agn.injection_draws import FIRST, InjectionDraws, batch_sizes
from miricigale.agn.injections import write_batch
from miricigale.evaluation import Estimate
from miricigale.fitting import AGNBins, GridSettings
from miricigale.injection.photon_noise import PhotonNoise
from miricigale.utils.parallel import threads

BANDS = [
    "acs.f814w",
    "wfc3.f160w",
    "irac.ch1",
    "miri.f770w",
    "miri.f1000w",
    "miri.f1500w",
    "miri.f2100w",
]
AXES = {
    "redshift": [0.9, 1.0, 1.1],
    "age": [1.0, 3.0],
    "ebv": [0.1, 0.3],
    "frac_agn": [0.0, 0.3, 0.6, 0.9],
    "tau97": [3.0, 7.0],
}
#: Deep enough for no doubt.
DEPTH = 29.0
N, N_AGN = 24, 8
#: Files of results, among them tables of batches.
KEPT = (".ecsv", ".fits")
OPTIONS = {
    "calibration": None,
    "calibrate": False,
    "model_error": 0.02,
    "interpolate": 60,
}


@pytest.fixture(scope="module")
def model():
    return SEDModel.yang2021(libraries="bundled")


@pytest.fixture(scope="module")
def truth(model):
    rng = np.random.default_rng(5)
    table = QTable({"id": np.arange(N) + 1, "redshift": rng.uniform(0.93, 1.07, N)})
    table["age"] = rng.uniform(1.1, 2.9, N)
    table["ebv"] = rng.uniform(0.12, 0.28, N)
    table["mass"] = 10 ** rng.uniform(10.0, 11.0, N)
    table["tau97"] = rng.uniform(3.2, 6.8, N)
    table["frac_agn"] = np.where(np.arange(N) < N_AGN, rng.uniform(0.5, 0.8, N), 0.0)
    return table


@pytest.fixture(scope="module")
def photometry(model, truth):
    errors = ErrorModel.from_depths(dict.fromkeys(BANDS, DEPTH), fractional=0.02)
    return errors.perturb(model.fluxes(truth, BANDS)[["id", *BANDS]], seed=1)


@pytest.fixture(scope="module")
def run(model, photometry, tmp_path_factory):
    """Function that runs a survey in a folder of its own: the result and the folder."""
    folder = tmp_path_factory.mktemp("agn")
    catalog = folder / "catalog.ecsv"
    photometry.meta = {}
    photometry.write(catalog)

    def run_survey(name, executor=None):
        survey = AGNSurvey(
            20 * u.arcmin**2,
            redshift=(0.5, 1.5),
            log_luminosity=(43.5, 44.5),
            n_injections=8,
            seed=1,
        )
        output = folder / name
        options = OPTIONS | {"executor": executor, "models": lambda _: (model, AXES)}
        return survey.run(catalog, output, **options), output

    return run_survey


@pytest.fixture(scope="module")
def result(run):
    return run("first")


def test_no_light_leaves_the_photometry_as_it_is(photometry):
    curves = {band: NoiseCurve(np.array([1.0, 2.0]), np.array([0.1, 0.2])) for band in BANDS}
    none = dict.fromkeys(BANDS, np.zeros(N) * u.uJy)
    same = add_light(photometry, none, curves=curves, seed=1)
    for name in photometry.colnames:
        assert np.array_equal(np.asarray(same[name]), np.asarray(photometry[name]))


def test_light_brings_the_noise_of_sources_as_bright():
    n = 4000
    table = QTable({"id": np.arange(n)})
    table["miri.f770w"] = np.full(n, 1.0) * u.uJy
    table["miri.f770w_err"] = np.full(n, 0.1) * u.uJy
    table["miri.f770w_limit"] = np.arange(n) == 0
    # the error is a tenth of the flux
    curves = {"miri.f770w": NoiseCurve(np.array([1.0, 10.0]), np.array([0.1, 1.0]))}
    bright = add_light(table, {"miri.f770w": np.full(n, 4.0) * u.uJy}, curves=curves, seed=2)
    assert bright["miri.f770w"][0].value == 1.0
    flux, error = bright["miri.f770w"].value[1:], bright["miri.f770w_err"].value[1:]
    np.testing.assert_allclose(error, 0.5)
    # the noise of the flux itself was not drawn
    assert flux.mean() == pytest.approx(5.0, abs=0.03)
    assert flux.std() == pytest.approx(np.sqrt(0.5**2 - 0.1**2), rel=0.05)


def test_errors_grow_beyond_the_brightest_source_as_photon_noise_does():
    """The variance of n electrons is n: a catalog of up to 100 says what 5000 have."""
    rng = np.random.default_rng(4)
    flux = rng.uniform(1.0, 100.0, 2000)
    curve = NoiseCurve.of_band(flux, np.sqrt(20.0 + flux))
    far = np.array([300.0, 5000.0])
    np.testing.assert_allclose(curve.at(far), np.sqrt(20.0 + far), rtol=0.01)
    # errors without photon noise stay what they are
    flat = NoiseCurve.of_band(flux, np.full(2000, 3.0))
    np.testing.assert_allclose(flat.at(far), 3.0)


def test_nuclei_get_all_of_the_light_with_correlated_noise():
    n = 20000
    band, name = "miri.f770w", "miri.f770w_nucleus"
    table = QTable({"id": np.arange(n)})
    table[band] = np.full(n, 3.0) * u.uJy
    table[f"{band}_err"] = np.full(n, 0.3) * u.uJy
    table[name] = np.full(n, 1.0) * u.uJy
    table[f"{name}_err"] = np.full(n, 0.2) * u.uJy
    table[f"{name}_corr"] = np.full(n, -0.6)
    table[f"{name}_limit"] = np.arange(n) == 0
    table[name][1] = np.nan
    curves = {
        band: NoiseCurve(np.array([3.0, 7.0]), np.array([0.3, 0.6])),
        name: NoiseCurve(np.array([1.0, 5.0]), np.array([0.1, 0.3])),
    }
    bright = add_light(table, {band: np.full(n, 4.0) * u.uJy}, curves=curves, seed=3)
    # an upper limit and a nucleus that was not measured stay what they are
    assert bright[name][0].value == 1.0
    assert np.isnan(bright[name][1])
    np.testing.assert_allclose(bright[f"{name}_err"].value[:2], 0.2)
    # the same covariance with the total, whose error is twice as large
    np.testing.assert_allclose(bright[f"{name}_corr"][:2], -0.3)
    total = bright[band].value[2:]
    point = bright[name].value[2:]
    assert total.mean() == pytest.approx(7.0, abs=0.02)
    assert point.mean() == pytest.approx(5.0, abs=0.02)
    np.testing.assert_allclose(bright[f"{name}_err"].value[2:], 0.6)
    # what is stated is the noise that was there and that which was added
    stated = bright[f"{name}_corr"][2] * 0.6 * 0.6
    assert stated == pytest.approx(-0.6 * 0.3 * 0.2 + np.cov(total, point)[0, 1], abs=0.005)
    assert np.corrcoef(total, point)[0, 1] == pytest.approx(-0.6, abs=0.02)


def test_noise_curve_is_that_of_the_catalog():
    flux = np.linspace(0.0, 100.0, 2001)
    curve = NoiseCurve.of_band(flux, 1.0 + 0.1 * flux)
    assert curve.ratio(20.0, 40.0) == pytest.approx(7.0 / 3.0, rel=0.01)
    assert NoiseCurve.of_band(np.array([np.nan]), np.array([1.0])) is None


def test_light_of_an_agn_is_that_of_the_model(model, truth, photometry):
    fitter = BayesFitter(model, BANDS, axes=AXES, model_error=0.02)
    hosts = fitter.fit(photometry[:3])
    table = QTable({"redshift": hosts.best["redshift"], "mass": hosts.best["mass"]})
    for name in ("age", "ebv"):
        table[name] = hosts.best[name]
    for name, value in hosts.constants.items():
        table[name] = np.full(3, value)
    table["tau97"] = [3.0, 5.0, 7.0]
    table["frac_agn"] = [0.2, 0.5, 0.9]
    whole = model.fluxes(table, BANDS)
    table["frac_agn"] = 0.0
    galaxy = model.fluxes(table, BANDS)
    light, fraction = agn_light(
        model, hosts, whole["accretion_power"], {"tau97": table["tau97"]}, BANDS
    )
    np.testing.assert_allclose(fraction, [0.2, 0.5, 0.9])
    for band in BANDS:
        np.testing.assert_allclose((galaxy[band] + light[band]).value, whole[band].value, rtol=1e-9)
    none, fraction = agn_light(
        model, hosts, [0.0, 0.0, 0.0] * u.W, {"tau97": table["tau97"]}, BANDS
    )
    assert all(np.all(none[band].value == 0) for band in BANDS)
    assert np.all(fraction == 0)


def test_posteriors_in_bins_are_those_of_the_fit(model, photometry, tmp_path):
    bins = AGNBins((0.5, 1.5), (40.0,))
    settings = GridSettings(interpolate=60, agn_bins=bins)
    fitter = BayesFitter(model, BANDS, axes=AXES, model_error=0.3, settings=settings)
    results = fitter.fit(photometry[:3])
    np.testing.assert_allclose(results.agn_weights.sum(axis=(1, 2, 3)), 1.0, rtol=1e-5)
    # no AGN is a node of the grid, and all others are brighter than the edge
    absent = results.agn_weights[:, 0, 0, 0]
    np.testing.assert_allclose(absent, results.pdf["frac_agn"][:, 0], atol=1e-6)
    assert np.all(results.agn_weights[:, :, 1:, 0] == 0)
    results.write(tmp_path / "fit.fits")
    again = FitResults.read(tmp_path / "fit.fits")
    assert np.array_equal(again.agn_weights, results.agn_weights)
    on_nodes = fitter.replace(settings=GridSettings(interpolate=0, agn_bins=bins))
    assert np.all(np.isnan(on_nodes.fit(photometry[:1]).agn_weights))


@pytest.mark.slow
def test_all_agn_are_counted_where_there_is_no_doubt(result, truth):
    survey, _ = result
    above = survey.totals[survey.totals["frac_agn"] == 0.4]
    assert above["n_selected"][0] == N_AGN
    assert above["n"][0] == pytest.approx(N_AGN, abs=0.5)
    # the prior of the fits has three AGN in four
    measured = survey.prior[0]
    assert measured["shipped"] == pytest.approx(0.25)
    assert measured["measured"] == pytest.approx(1.0 - N_AGN / N, abs=0.12)
    assert np.array_equal(survey.sources["selected"], truth["frac_agn"] > 0)
    number = survey.numbers["n"].sum()
    assert number == pytest.approx(N_AGN, abs=1)


@pytest.mark.slow
def test_bright_agn_are_complete_and_others_are_pure(result):
    survey, _ = result
    bright = survey.numbers[-1]
    assert bright["n_injected"] == 4
    # the data are good: those with a fraction above the limit are selected, and no others
    fraction = np.asarray(survey.injected["frac_agn"])
    clear = np.abs(fraction - 0.4) > 0.07
    assert clear.sum() >= 5
    assert np.array_equal(survey.injected["selected"][clear], fraction[clear] > 0.4)
    assert bright["above"] == 1.0
    some = survey.numbers["n_selected"] > 0
    np.testing.assert_allclose(survey.numbers["purity"][some], 1.0, atol=0.02)


@pytest.mark.slow
def test_injected_agn_are_found_at_their_luminosities(result):
    injected = result[0].injected
    good = (injected["frac_agn"] > 0.3) & (injected["frac_agn"] < 0.85)
    apart = (injected["log_luminosity_fitted"] - injected["log_luminosity"])[good]
    assert good.sum() >= 2
    assert np.all(np.abs(apart) < 0.15)


@pytest.mark.slow
def test_workers_and_a_second_call_change_no_byte(result, run):
    _, first = result
    with threads(2) as executor:
        _, second = run("second", executor)
    names = sorted(path.name for path in first.glob("*.ecsv"))
    assert len(names) == 5
    before = {name: (first / name).read_bytes() for name in names}
    assert before == {name: (second / name).read_bytes() for name in names}
    states = {path: path.stat().st_mtime_ns for path in first.rglob("part-*.fits")}
    run("first")
    assert before == {name: (first / name).read_bytes() for name in names}
    assert states == {path: path.stat().st_mtime_ns for path in states}
    page = (first / "page.html").read_text()
    for words in ("Luminosity function", "Selection function", "Prior of fracAGN"):
        assert words in page


@pytest.mark.slow
def test_injected_agn_are_in_the_nuclei_that_were_measured(model, truth, photometry, tmp_path):
    host = truth.copy()
    host["frac_agn"] = 0.0
    host_light = model.fluxes(host, BANDS)
    light = model.fluxes(truth, BANDS)
    bands = BANDS[3:5]
    table = photometry.copy()
    table.meta = {}
    for band in bands:
        table[f"{band}_flux_point"] = light[band] - host_light[band]
        table[f"{band}_flux_point_err"] = 0.5 * table[f"{band}_err"]
    catalog = tmp_path / "catalog.fits"
    table.write(catalog)
    survey = AGNSurvey(
        20 * u.arcmin**2, redshift=(0.5, 1.5), log_luminosity=(43.5, 44.5), n_injections=6, seed=2
    )
    options = OPTIONS | {"models": lambda _: (model, AXES), "nuclei": True}
    result = survey.run(catalog, tmp_path / "agn", **options)
    injected = QTable.read(tmp_path / "agn" / "injected" / "batch-01.fits")
    rows = np.searchsorted(table["id"], result.injected["host"])
    for band in bands:
        added = injected[band].value - table[band].value[rows]
        in_nucleus = injected[f"{band}_nucleus"].value - table[f"{band}_flux_point"].value[rows]
        error = np.hypot(injected[f"{band}_err"].value, injected[f"{band}_nucleus_err"].value)
        assert np.all(np.abs(added - in_nucleus) < 4.0 * error)
        assert np.all(in_nucleus > 0)
    fit = FitResults.read(next((tmp_path / "agn" / "injected").glob("*/part-*.fits")))
    assert fit.meta["fit"]["nuclei"] == bands
    # AGN of known fraction are measured: their points are 0 in the galaxies
    good = result.injected["frac_agn"] < 0.85
    apart = result.injected["frac_agn_fitted"] - result.injected["frac_agn"]
    assert good.sum() >= 3
    assert np.all(np.abs(apart[good]) < 0.1)


class StubImages:
    """Images on which AGN are measured as twice as bright as they are."""

    bands = (BANDS[3],)
    prior_band = "nircam.f444w"
    content = "of the field"
    photon_noise = {BANDS[3]: PhotonNoise.unknown("the header is silent")}
    n_calls = 0

    def add_agn(self, photometry, lit, hosts, light, *, seed):
        self.n_calls += 1
        table = lit.copy()
        band = BANDS[3]
        table[band] = photometry[band] + 2.0 * light[band]
        table["n_images"] = np.arange(len(table)) % 2
        self.light = light
        self.hosts = hosts
        return table


@pytest.mark.slow
def test_injected_agn_are_measured_on_images(run, model, tmp_path):
    catalog = run("first")[1].parent / "catalog.ecsv"
    survey = AGNSurvey(
        20 * u.arcmin**2, redshift=(0.5, 1.5), log_luminosity=(43.5, 44.5), n_injections=6, seed=2
    )
    images = StubImages()
    options = OPTIONS | {"models": lambda _: (model, AXES)}
    result = survey.run(catalog, tmp_path / "agn", images=images, **options)
    injected = QTable.read(tmp_path / "agn" / "injected" / "batch-01.fits")
    table = QTable.read(catalog)
    rows = np.searchsorted(table["id"], images.hosts)
    added = injected[BANDS[3]] - table[BANDS[3]][rows]
    np.testing.assert_allclose(added.value, 2.0 * images.light[BANDS[3]].value, rtol=1e-5)
    # other bands have the light itself, and the prior's is known
    added = injected[BANDS[0]] - table[BANDS[0]][rows]
    error = injected[f"{BANDS[0]}_err"].value
    assert np.all(np.abs(added - images.light[BANDS[0]]).value < 4.0 * error)
    assert np.all(images.light["nircam.f444w"].value > 0)
    assert result.injected["n_images"].tolist() == [0, 1, 0, 1, 0, 1]
    page = (tmp_path / "agn" / "page.html").read_text()
    assert "3 of them were put into images" in page
    assert "not drawn: the header is silent" in page
    images.bands = ("miri.f560w",)
    refuses(
        "'images' must be of bands that are fitted",
        survey.run,
        catalog,
        tmp_path / "b",
        images=images,
        **options,
    )


def test_purities_are_of_both_priors(result):
    """Right objects of all bins are those of the list, by either prior."""
    survey, _ = result
    numbers = survey.numbers[survey.numbers["n_selected"] > 0]
    sources = survey.sources[survey.sources["selected"]]
    for prior in ("", "_shipped"):
        right = np.sum(numbers["n_selected"] * numbers[f"purity{prior}"])
        assert right == pytest.approx(np.sum(sources[f"agn_probability{prior}"]))


def test_the_page_shows_ends_of_intervals(result):
    """Wilson's interval of 2 of 4 is 50 +- 22.4 %, and of 4 of 4 it is 80 to 100 %: closed forms."""
    survey, folder = result
    assert survey.numbers["n_injected"].tolist() == [4, 4]
    page = (folder / "page.html").read_text()
    assert "50 (28 to 72) %" in page
    assert "100 (80 to 100) %" in page
    # a single bin of redshift is that of all
    assert len(np.unique(survey.prior["frac_agn_high"])) == len(survey.prior)


def test_injected_agn_have_fewer_models(run, model, tmp_path):
    catalog = run("first")[1].parent / "catalog.ecsv"
    survey = AGNSurvey(20 * u.arcmin**2, redshift=(0.5, 1.5), n_injections=4, injected_models=40)
    result = survey.run(catalog, tmp_path, **OPTIONS, models=lambda _: (model, AXES))
    models = {}
    for folder in ("fits", "injected/batch-01"):
        manifest = json.loads((tmp_path / folder / "manifest.json").read_text())
        models[folder] = manifest["job"]["settings"]["interpolate"]
    assert models == {"fits": 60, "injected/batch-01": 40}
    assert result.meta["injected_models"] == 40
    assert "40 models between the nodes" in (tmp_path / "page.html").read_text()


def test_a_catalog_without_mid_infrared_bands_is_warned_of(photometry, model, tmp_path):
    """An AGN's dust is seen by no band up to 4.4 um at z = 1."""
    names = ["id"]
    for band in (*BANDS[:2], "nircam.f444w"):
        names += [band, f"{band}_err"]
    table = photometry.copy()
    table["nircam.f444w"] = table["irac.ch1"]
    table["nircam.f444w_err"] = table["irac.ch1_err"]
    table[names].write(tmp_path / "catalog.ecsv")
    survey = AGNSurvey(20 * u.arcmin**2, redshift=(0.5, 1.5), n_injections=0)
    options = OPTIONS | {"models": lambda _: (model, AXES)}
    arguments = (tmp_path / "catalog.ecsv", tmp_path / "agn")
    warned("no band beyond 5 um .the longest is at 4.4 um", survey.run, *arguments, **options)


def test_injected_agn_are_not_warned_of_their_few_models(run, model, tmp_path):
    """Fits of one model each are not converged; only those of the catalog say so."""
    catalog = run("first")[1].parent / "catalog.ecsv"
    survey = AGNSurvey(20 * u.arcmin**2, redshift=(0.5, 1.5), n_injections=8, injected_models=1)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        survey.run(catalog, tmp_path, **OPTIONS, models=lambda _: (model, AXES))
    texts = [str(warning.message) for warning in caught]
    assert not any(f"of {8} fits are not converged" in text for text in texts)


def test_images_are_measured_once(run, model, tmp_path):
    """A stopped call, resumed with other workers, writes the bytes of one in a piece."""
    catalog = run("first")[1].parent / "catalog.ecsv"
    survey = AGNSurvey(
        20 * u.arcmin**2, redshift=(0.5, 1.5), log_luminosity=(43.5, 44.5), n_injections=6, seed=2
    )
    options = OPTIONS | {"models": lambda _: (model, AXES)}
    survey.run(catalog, tmp_path / "whole", images=StubImages(), **options)
    images = StubImages()
    stopped = tmp_path / "stopped"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(injections, "write_batch", stop)
        with pytest.raises(KeyboardInterrupt):
            survey.run(catalog, stopped, images=images, **options)
    assert images.n_calls == 1
    with threads(2) as executor:
        survey.run(catalog, stopped, images=images, executor=executor, **options)
    assert images.n_calls == 1
    names = [path.relative_to(stopped) for path in stopped.rglob("*") if path.suffix in KEPT]
    assert len(names) == 9
    for name in names:
        assert (tmp_path / "whole" / name).read_bytes() == (stopped / name).read_bytes(), name
    # other images are measured
    images.content = "of another field"
    survey.run(catalog, stopped, images=images, **options)
    assert images.n_calls == 2


def stop(*args, **kwargs):
    """In place of the fit of a batch."""
    raise KeyboardInterrupt


def test_bins_share_what_is_left():
    none = np.zeros(3, int)
    sizes = batch_sizes(none, none, none, error=0.02, n_left=10**6)
    assert sizes.tolist() == [FIRST] * 3
    assert batch_sizes(none, none, none, error=0.02, n_left=8).tolist() == [3, 3, 2]
    # where nothing could be injected, nothing more is; where none or all are selected, it is enough
    drawn = np.array([FIRST, FIRST, FIRST])
    injected = np.array([0, FIRST, FIRST])
    selected = np.array([0, 0, FIRST])
    assert not batch_sizes(drawn, injected, selected, error=0.02, n_left=10**6).any()
    sizes = batch_sizes(drawn, drawn, drawn // 2, error=0.0, n_left=10**6)
    assert sizes.tolist() == [FIRST] * 3


@pytest.mark.parametrize("share", [0.02, 0.05, 0.3, 0.9])
def test_completeness_is_known_with_the_wanted_error(share):
    """Stopping by what was selected must bias no share by 1 %, and leave its interval right."""
    rng = np.random.default_rng(1)
    errors = []
    n_inside = 0
    for _ in range(300):
        n = np.zeros(1, int)
        selected = np.zeros(1, int)
        sizes = batch_sizes(n, n, selected, error=0.02, n_left=10**6)
        while sizes.any():
            n += sizes
            selected += rng.binomial(sizes, share)
            sizes = batch_sizes(n, n, selected, error=0.02, n_left=10**6)
        measured = Estimate.of_fraction(selected[0], n[0])
        errors.append(measured.value - share)
        n_inside += measured.low <= share <= measured.high
    assert abs(np.mean(errors)) < 0.008
    assert np.std(errors) < 0.022
    # 68 % of 300, with a scatter of 8
    assert n_inside > 175


def test_hosts_take_turns_and_luminosities_fill_the_bins():
    hosts = [np.array([3, 5, 8]), np.array([], int), np.array([1, 2])]
    draws = InjectionDraws(hosts, (43.0, 44.0), 7)
    assert draws.cells == [(0, 0), (0, 1), (2, 0), (2, 1)]
    first = np.zeros(4, int)
    cell, row, luminosity = draws.draw(first, np.full(4, 60))
    for k, (i, _) in enumerate(draws.cells):
        number = np.bincount(row[cell == k], minlength=9)[hosts[i]]
        assert np.all(number == 60 // hosts[i].size)
    # a uniform distribution: no share of it is off by more than two AGN
    place = np.sort(luminosity[cell == 0] - 43.0)
    assert np.max(np.abs(place - (np.arange(60) + 0.5) / 60)) < 2.5 / 60
    assert np.all((luminosity[cell == 1] >= 44.0) & (luminosity[cell == 1] < 45.0))
    # batches are parts of the same sequence
    parts = [draws.draw(first, np.full(4, 25)), draws.draw(first + 25, np.full(4, 35))]
    for k in range(4):
        joined = np.concatenate([part[2][part[0] == k] for part in parts])
        assert np.array_equal(joined, luminosity[cell == k])
        joined = np.concatenate([part[1][part[0] == k] for part in parts])
        assert np.array_equal(joined, row[cell == k])


def test_other_injections_replace_nothing(photometry, tmp_path):
    path = tmp_path / "batch-01.fits"
    photometry = photometry.copy()
    photometry.meta = {}
    write_batch(photometry, path, resume=True)
    before = path.read_bytes()
    (tmp_path / "batch-01").mkdir()
    write_batch(photometry, path, resume=True)
    match = "batch-01 holds fits of other injected AGN"
    refuses(match, write_batch, photometry[:3], path, resume=True)
    assert path.read_bytes() == before
    write_batch(photometry[:3], path, resume=False)
    assert path.read_bytes() != before


def test_refusals(run, tmp_path):
    area = 20 * u.arcmin**2
    refuses("'limit' must be from 0.1 to below 1, got 0.05", AGNSurvey, area, limit=0.05)
    refuses("'area' must be", AGNSurvey, 0 * u.arcmin**2)
    refuses("'area' must be at most the sky of 41253 deg2", AGNSurvey, 50000 * u.deg**2)
    refuses("'redshift' must be edges of 0 or more", AGNSurvey, area, redshift=(-1, 2))
    refuses("'redshift' must be 2 or more ascending", AGNSurvey, area, redshift="ab")
    refuses("log10 of luminosities", AGNSurvey, area, log_luminosity=(1e44, 1e45))
    refuses("'n_injections' must be", AGNSurvey, area, n_injections=-1)
    refuses("'injected_models' must be", AGNSurvey, area, injected_models=0)
    refuses("'completeness_error' must be from 0", AGNSurvey, area, completeness_error=-0.1)
    survey = AGNSurvey(area)
    refuses("'interpolate' must be above 0", survey.run, "no.fits", tmp_path, interpolate=0)


def test_command_states_its_plan_and_names_its_options(photometry, tmp_path, capsys):
    catalog = tmp_path / "catalog.ecsv"
    photometry.write(catalog)
    arguments = ["agn", catalog, "--area", 20, "--injections", 76, "-o", tmp_path / "agn"]
    said = command(capsys, *arguments, "--classes", "quasars", "--plan").out
    assert "24 objects and at most 76 injected AGN in 2 classes: 200 fits" in said
    # 20 square degrees in place of square arcmin would be 3600 times as many
    small = ["agn", catalog, "--area", 20 / 3600, "--plan"]
    warned("24 objects .* are 4.32e.03 for each, and the deepest fields", command, capsys, *small)
    assert not (tmp_path / "agn").exists()
    assert "--limit must be from 0.1" in command(capsys, *arguments, "--limit", 0, status=2).err
    said = command(capsys, *arguments, "--components", 2, status=2).err
    assert "--components must be given with --images" in said
    said = command(capsys, *arguments, "--images", "a.fits", status=2).err
    assert "--images must be one image at least and the prior" in said
    said = command(capsys, *arguments, "--interpolate", 0, status=2).err
    assert "--interpolate must be above 0" in said
