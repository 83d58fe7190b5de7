"""Injection into mosaics: completeness, limits and pulls against closed forms and independent simulations."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal
from scipy.special import ndtr

from helpers.errors import refuses
from helpers.mosaics import CENTER, FINE, HI, LO, lattice, places, render
from miricigale.cli import main
from miricigale.injection import CompletenessCurve, Injection, InjectionResult
from miricigale.injection.field import ImageField, joined_segments, recovered_rows
from miricigale.injection.light import light_on_file, light_on_image, psf_on_pixels
from miricigale.injection.population import counts_slope, draw_magnitudes, read_sources
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import MosaicFile, detect_sources, measure_files
from miricigale.photometry.images.arrays import draw_places
from miricigale.psf import gaussian_psf
from miricigale.utils.exceptions import OtherResultsError
from miricigale.utils.tables import match_sky
from miricigale.utils.units import ab_magnitude

FWHM = np.sqrt(8 * np.log(2))
PIXEL, SIDE, NOISE = 0.11, 330, 0.004
#: Error of the flux of a point in white noise (uJy): noise of a pixel times the root of 4 pi, times the width.
ERROR = NOISE * np.sqrt(4 * np.pi) * LO / PIXEL
PRESET = "default"
#: Exposure time of images in electrons per second.
TIME = 50.0


def psf_of(width):
    options = {"pixel_scale": 0.03 * u.arcsec, "fov": 16 * width * u.arcsec}
    return gaussian_psf(width * FWHM * u.arcsec, **options)


def write(path, sky, flux, rng, *, scale=PIXEL, width=LO, side=SIDE, noise=NOISE):
    """An image of points in white noise, in uJy."""
    wcs = north_up_wcs(CENTER, scale * u.arcsec, (side, side))
    data = render(sky, flux, width, wcs, (side, side)) * pixel_area_map(wcs, (side, side)) * 1e12
    header = wcs.to_header()
    header.update(BUNIT="uJy", FILTER="F430M", INSTRUME="NIRCAM" if scale == FINE else "")
    hdus = [fits.PrimaryHDU()]
    hdus.append(fits.ImageHDU(data + rng.normal(0, noise, data.shape), header, name="SCI"))
    hdus.append(fits.ImageHDU(np.full(data.shape, noise), header, name="ERR"))
    fits.HDUList(hdus).writeto(path)
    return path


def points(rng, low, high, n):
    """Own stars, of magnitudes about that of 5 sigma."""
    middle = ab_magnitude(5 * ERROR * u.uJy)
    magnitude = rng.uniform(middle + low, middle + high, n)
    return QTable({"irac.ch4": 10 ** (0.4 * (23.9 - magnitude)) * u.uJy})


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An image of 25 points; a small one of nine of them, with a prior; and the PSFs."""
    folder, rng = tmp_path_factory.mktemp("field"), np.random.default_rng(7)
    sky = places(*lattice(rng, 5, 6.0, 1.0))
    flux = ERROR * 10 ** rng.uniform(1, 2, len(sky))
    write(folder / "image.fits", sky, flux, rng)
    near = CENTER.separation(sky).arcsec < 10
    write(folder / "part.fits", sky[near], flux[near], rng, side=170)
    prior = {"scale": FINE, "width": HI, "side": 320, "noise": 0.0005}
    write(folder / "prior.fits", sky[near], flux[near], rng, **prior)
    psf_of(LO).write(folder / "psf.fits")
    psf_of(HI).write(folder / "sharp.fits")
    return folder


def image_of(folder, name="image"):
    return MosaicFile(folder / f"{name}.fits", filter="irac.ch4", psf=folder / "psf.fits")


@pytest.fixture(scope="module")
def result(folder):
    own = points(np.random.default_rng(3), -1.6, 0.6, 360)[45:]
    injection = Injection(own, n_trials=6, n_sources=45, preset=PRESET)
    return injection.run(image_of(folder), folder=folder / "run")


def on_free_sky(result):
    """Sources that are far from others and from the edges."""
    sources = result.sources
    _, apart, _ = sources["sky"].match_to_catalog_sky(result.photometry["sky"])
    inside = np.abs(np.stack([sources["x"], sources["y"]]) - SIDE / 2) < SIDE / 2 - 10
    return (apart.arcsec > 2.5) & inside.all(axis=0)


def test_injected_light_is_all_there_on_turned_pixels():
    wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, (300, 300))
    wcs.wcs.pc = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    psf = psf_on_pixels(psf_of(LO), wcs, (300, 300))
    sources = QTable({"sky": places([3.0, -4.0], [1.0, 2.0]), "profile": ["point", "sersic"]})
    sources["half_light_radius"] = [0.0, 0.3] * u.arcsec
    sources["sersic_index"], sources["axis_ratio"] = [1.0, 1.0], [1.0, 0.5]
    sources["position_angle"] = [0.0, 30.0] * u.deg
    area = pixel_area_map(wcs, (300, 300)) * 1e12
    for row, flux in ((0, 3.0), (1, 5.0)):
        part = sources[row : row + 1]
        light = light_on_image(part, [flux] * u.uJy, wcs, (300, 300), psf)
        assert_allclose(np.sum(light * area), flux, rtol=1e-3)
        # the closed form of a point
        if row == 0:
            expected = render(part["sky"], [flux], LO, wcs, (300, 300))
            assert_allclose(light, expected, atol=2e-3 * expected.max())


@pytest.mark.slow
def test_the_limit_of_forced_photometry_is_five_sigma(result):
    curve = result.curve("forced", kind="star")
    assert_allclose(curve.limit, ab_magnitude(5 * ERROR * u.uJy), atol=0.05)
    assert curve.limit_err < 0.04
    # Phi(snr - 5) at each magnitude, where no other source is
    sources = result.sources[on_free_sky(result)]
    snr = sources["flux_true"].value / ERROR
    for low, high in ((3, 4.5), (4.5, 5.5), (5.5, 7.5), (8, 20)):
        some = (snr > low) & (snr < high)
        expected = ndtr(snr[some] - 5).mean()
        error = np.sqrt(np.sum(ndtr(snr[some] - 5) * ndtr(5 - snr[some]))) / some.sum()
        assert abs(np.mean(sources["recovered"][some]) - expected) < 0.02 + 2.5 * error


@pytest.mark.slow
def test_pulls_of_injected_sources_are_normal(result):
    numbers = result.errors()
    n = numbers["n_measured"]
    assert n == len(result.sources) == 270
    assert abs(numbers["pull_median"]) < 3 * 1.2533 / np.sqrt(n)
    assert_allclose(numbers["pull_rms"], 1.0, atol=3 / np.sqrt(2 * n))
    assert abs(numbers["bias"]) < 3 * numbers["bias_err"]
    assert_allclose(result.sources["flux_err"].value[on_free_sky(result)], ERROR, rtol=0.02)
    assert result.false_rate() < 0.01


def write_electrons(path, sky, flux, rng, electrons, *, variance=False):
    """An image in electrons per second, of which a uJy has so many in all, with the noise of the sky and light."""
    shape = (SIDE, SIDE)
    wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, shape)
    light = render(sky, flux, LO, wcs, shape) * pixel_area_map(wcs, shape) * 1e12 * electrons
    of_sky = (NOISE * electrons) ** 2
    data = rng.poisson(light + of_sky) - of_sky
    header = wcs.to_header()
    header.update(BUNIT="electron/s", FILTER="F430M", EXPTIME=TIME)
    error = np.sqrt(of_sky)
    hdus = [fits.PrimaryHDU(), fits.ImageHDU(data / TIME, header, name="SCI")]
    if variance:
        of_light = np.maximum(light + of_sky, 0)
        hdus.append(fits.ImageHDU(np.sqrt(of_light) / TIME, header, name="ERR"))
        hdus.append(fits.ImageHDU(of_light / TIME**2, header, name="VAR_POISSON"))
    else:
        hdus.append(fits.ImageHDU(np.full(shape, error / TIME), header, name="ERR"))
    fits.HDUList(hdus).writeto(path)
    zero_point = ab_magnitude(TIME / electrons * u.uJy)
    return MosaicFile(path, filter="irac.ch4", psf=path.parent / "psf.fits", zero_point=zero_point)


@pytest.mark.slow
@pytest.mark.parametrize("variance", [False, True])
def test_bright_sources_scatter_by_their_electrons(folder, tmp_path, variance):
    """
    A point of F electrons that a Gaussian PSF fits with equal weights has the variance 4/3 F besides the sky's.

    With errors that have the photon noise in them, pulls of the optimal weights are normal.
    """
    rng = np.random.default_rng(5)
    sky = places(*lattice(rng, 5, 6.0, 1.0))
    psf_of(LO).write(tmp_path / "psf.fits")
    # the photon noise of injected sources has three times the variance of the sky's
    flux = 400 * ERROR
    electrons = 4 / 3 * flux / (3 * ERROR**2)
    file = write_electrons(
        tmp_path / "electrons.fits", sky, np.full(25, flux), rng, electrons, variance=variance
    )
    own = QTable({"irac.ch4": np.full(45, flux) * u.uJy})
    injection = Injection(own, n_trials=3, n_sources=45, preset=PRESET)
    result = injection.run(file, folder=tmp_path / "run")
    sources = result.sources[on_free_sky(result)]
    scatter = np.std(sources["flux"].value - flux)
    tolerance = 3 / np.sqrt(2 * len(sources))
    if variance:
        pulls = (sources["flux"].value - flux) / sources["flux_err"].value
        assert_allclose(np.std(pulls), 1.0, rtol=tolerance)
        assert scatter < 2 * ERROR
        assert "VAR_POISSON" in result.meta["photon_noise"]
    else:
        assert_allclose(scatter, 2 * ERROR, rtol=tolerance)
        assert_allclose(np.median(sources["flux_err"].value), ERROR, rtol=0.03)
        assert f"EXPTIME {TIME:g} s" in result.meta["photon_noise"]
    assert len(sources) > 50
    assert result.meta["photon_noise"] in (tmp_path / "run" / "index.html").read_text("utf-8")


@pytest.mark.slow
def test_completeness_of_detection_is_that_of_simulated_fields(result, folder, tmp_path):
    """Sources of the same magnitudes are simulated in fields of other noise, and detected there."""
    rng = np.random.default_rng(11)
    magnitude, found = [], []
    for k in range(10):
        sky = places(*lattice(rng, 7, 4.6, 1.0))
        flux = points(rng, -1.6, 0.6, len(sky))["irac.ch4"]
        path = write(tmp_path / f"{k}.fits", sky, flux.value, rng)
        image = MosaicFile(path, filter="irac.ch4").read()
        _, detections = detect_sources(image, preset=PRESET)
        rows, _ = match_sky(detections["sky"], sky, radius=LO * FWHM * u.arcsec)
        magnitude.append(ab_magnitude(flux))
        found.append(rows >= 0)
    truth = CompletenessCurve.fit(np.concatenate(magnitude), np.concatenate(found))
    free = on_free_sky(result)
    curve = CompletenessCurve.fit(
        result.sources["magnitude"][free], result.sources["detected"][free]
    )
    # of both samples, and of the noise of one field
    error = np.hypot(np.hypot(curve.limit_err, truth.limit_err), 0.016)
    assert error < 0.05
    assert abs(curve.limit - truth.limit) < 2.5 * error
    fine = np.linspace(truth.limit - 1, truth.limit + 0.5, 30)
    assert np.mean(np.abs(curve(fine) - truth(fine))) < 0.05


@pytest.mark.slow
def test_a_finished_run_stands_and_workers_change_nothing(result, folder, tmp_path):
    from concurrent.futures import ThreadPoolExecutor

    own = points(np.random.default_rng(3), -1.6, 0.6, 360)[45:]
    injection = Injection(own, n_trials=1, n_sources=45, preset=PRESET)
    with ThreadPoolExecutor(2) as executor:
        again = injection.run(
            image_of(folder), folder=tmp_path / "b", executor=executor, n_threads=2
        )
    some = result.sources[result.sources["trial"] == 1]
    for name in ("flux", "flux_err", "detected", "x"):
        assert_array_equal(again.sources[name], some[name])
    before = (folder / "run" / "sources.fits").stat().st_mtime_ns
    injection.replace(n_trials=6).run(image_of(folder), folder=folder / "run")
    assert (folder / "run" / "sources.fits").stat().st_mtime_ns == before
    with pytest.raises(OtherResultsError):
        injection.replace(seed=2).run(image_of(folder), folder=tmp_path / "b")
    assert "Completeness by true magnitude" in (tmp_path / "b" / "index.html").read_text()


@pytest.fixture(scope="module")
def prior_files(folder):
    return image_of(folder, "part"), MosaicFile(folder / "prior.fits", psf=folder / "sharp.fits")


@pytest.mark.slow
def test_no_injected_sources_give_the_users_own_result(folder, prior_files, tmp_path):
    own = measure_files(*prior_files)
    none = Injection(n_trials=1, n_sources=0).run(*prior_files, folder=tmp_path / "none")
    assert len(none.sources) == 0
    again = QTable.read(tmp_path / "none" / "trials" / "trial-001-photometry.fits")
    for table in (none.photometry, again):
        assert_array_equal(table["id"], own["id"])
        for name in ("irac.ch4", "irac.ch4_err", "irac.ch4_flags"):
            assert_array_equal(table[name], own[name])


@pytest.mark.pictures
@pytest.mark.slow
def test_sources_are_put_into_the_prior_too(folder, prior_files, tmp_path, capsys):
    """By the command, with own stars and galaxies of known colors, and a segmentation map."""
    image, prior = prior_files
    segments, _ = detect_sources(prior.read())
    header = fits.getheader(prior.path, "SCI")
    fits.PrimaryHDU(segments.data, header).writeto(tmp_path / "seg.fits")
    rng = np.random.default_rng(2)
    own = points(rng, -3.0, -2.0, 10)
    own["nircam.f430m"] = own["irac.ch4"]
    own["half_light_radius"] = np.where(np.arange(10) % 2, 0.3, 0.0) * u.arcsec
    own["sersic_index"], own["axis_ratio"] = np.ones(10), np.full(10, 0.7)
    own["position_angle"] = np.full(10, 40.0) * u.deg
    own.write(tmp_path / "own.ecsv")
    files = [str(one.path) for one in prior_files]
    options = ["--filter", "irac.ch4", "--psf", str(image.psf), "--highres-psf", str(prior.psf)]
    options += ["--sources", str(tmp_path / "own.ecsv"), "--trials", "1", "--number", "10"]
    options += ["--segmentation", str(tmp_path / "seg.fits"), "--no-progress", "--threads", "1"]
    assert main(["inject", *files, *options, "-o", str(tmp_path / "run")]) == 0
    assert "10 sources; page: index.html" in capsys.readouterr().out
    found = QTable.read(tmp_path / "run" / "sources.fits")
    assert_array_equal(found["row"], np.arange(10))
    assert np.all(found["in_prior"])
    galaxy = np.asarray(found["kind"]).astype(str) == "galaxy"
    free = np.asarray(found["neighbor_light"]) < 0.1
    assert np.all(np.asarray(found["template"]).astype(str)[galaxy & free] == "sersic")
    pull = ((found["flux"] - found["flux_true"]) / found["flux_err"]).value[free]
    assert abs(np.mean(pull)) < 3 / np.sqrt(len(pull))
    assert 0.6 < np.sqrt(np.mean(pull**2)) < 1.5


def test_a_source_hidden_by_a_brighter_one_is_not_recovered():
    known, found = places([0.0, 9.0]), places([0.02, 9.0, 5.0])
    sky = places([0.0, 5.0, 9.0, 12.0])
    rows = recovered_rows(found, known, np.array([5.0, 0.5]), sky, np.ones(4), 0.3 * u.arcsec)
    assert_array_equal(rows, [-1, 2, 1, -1])


def test_segments_of_others_stay_theirs():
    segments, own = np.zeros((2, 8, 8), int)
    segments[:, :3] = 1
    own[2:6, 2:6] = 4
    both, labels = joined_segments(segments, own, np.array([[4.0, 4.0], [1.0, 1.0], [7.0, 7.0]]))
    assert_array_equal(labels, [2, 0, 0])
    assert np.count_nonzero(both == 2) == 12
    assert_array_equal(both[:, :3], 1)
    # of two sources in one segment the second has none
    both, labels = joined_segments(segments, own, np.array([[4.0, 4.0], [5.0, 4.0]]))
    assert_array_equal(labels, [2, 0])
    assert set(np.unique(both)) == {0, 1, 2}


def test_magnitudes_follow_the_counts():
    rng = np.random.default_rng(1)
    drawn = draw_magnitudes(40000, 0.35, 15.0, 25.0, rng)
    assert drawn.min() >= 15
    assert drawn.max() <= 25
    assert_allclose(counts_slope(drawn, 25.0), 0.35, rtol=0.02)
    # ten to the slope times the step
    counts = np.histogram(drawn, [22, 23, 24, 25])[0]
    assert_allclose(counts[1:] / counts[:-1], 10**0.35, rtol=0.05)


def test_places_are_on_data_and_apart():
    usable = np.zeros((60, 80), bool)
    usable[10:50, 20:60] = True
    xy = draw_places(usable, 20, 6.0, np.random.default_rng(1))
    apart = np.hypot(*(xy[:, None] - xy).T)
    assert len(xy) == 20
    assert np.min(apart[~np.eye(20, dtype=bool)]) >= 6
    assert usable[tuple(np.rint(xy.T[::-1]).astype(int))].all()
    assert len(draw_places(usable, 500, 6.0, np.random.default_rng(1))) < 100


def test_own_sources_that_cannot_be_drawn_are_refused():
    wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, (50, 50))
    table = QTable({"F770W": [1.0, -1.0] * u.uJy})
    args = ("miri.f770w", None, wcs)
    refuses("positive fluxes, got 1 others", read_sources, table, *args)
    table["F770W"] = [1.0, 2.0] * u.uJy
    table["half_light_radius"] = [0.0, 0.4] * u.arcsec
    refuses("'sersic_index'", read_sources, table, *args)
    table["sersic_index"], table["axis_ratio"] = [1.0, 1.0], [1.0, 0.5]
    table["position_angle"] = [0.0, 10.0] * u.deg
    assert list(read_sources(table, *args)["profile"]) == ["point", "sersic"]
    table["profile"] = ["star", "sersic"]
    refuses("'point' and 'sersic' in 'profile', got .'star'.", read_sources, table, *args)


def test_fluxes_in_the_prior_are_those_that_name_its_filter():
    wcs = north_up_wcs(CENTER, PIXEL * u.arcsec, (50, 50))
    table = QTable({"flux": [1.0, 2.0] * u.uJy})
    args = ("miri.f770w", "nircam.f444w", wcs)
    assert np.isnan(read_sources(table, *args)["prior_flux"].value).all()
    same = read_sources(table, "miri.f770w", "miri.f770w", wcs)
    assert_array_equal(same["prior_flux"], same["flux"])
    table["F770W"] = table["flux"]
    table["F444W"] = [0.0, np.nan] * u.uJy
    assert_array_equal(read_sources(table, *args)["prior_flux"].value, [0.0, np.nan])
    table["F444W"] = [-1.0, 1.0] * u.uJy
    refuses("at least 0, or missing, got 1 others", read_sources, table, *args)


@pytest.mark.parametrize("plateau", [1.0, 0.8])
def test_curves_find_limit_and_plateau(plateau):
    rng = np.random.default_rng(4)
    magnitude = rng.uniform(21, 26, 6000)
    share = plateau * ndtr(5 * 10 ** (0.4 * (25 - magnitude)) - 5)
    curve = CompletenessCurve.fit(magnitude, rng.uniform(size=6000) < share)
    fine = np.linspace(23, 26, 30001)
    exact = plateau * ndtr(5 * 10 ** (0.4 * (25 - fine)) - 5)
    assert_allclose(curve.limit, fine[np.argmin(np.abs(exact - 0.5))], atol=0.03)
    assert abs(curve.limit - fine[np.argmin(np.abs(exact - 0.5))]) < 3 * curve.limit_err
    assert_allclose(curve.plateau, plateau, atol=0.02)
    assert_allclose(curve(fine), exact, atol=0.03)
    assert CompletenessCurve.fit(magnitude, np.ones(6000, bool)) is None


def test_sources_that_do_not_bracket_it_have_no_limit():
    rng = np.random.default_rng(0)
    magnitude = rng.uniform(20, 22, 200)
    # all are bright, and others hide a few
    shown = rng.uniform(size=200) > 0.06
    curve = CompletenessCurve.fit(magnitude, shown)
    assert np.isnan([curve.limit, curve.limit_err]).all()
    assert_allclose(curve.plateau, np.mean(shown), atol=0.03)
    sources = QTable({"magnitude": magnitude, "detected": shown, "recovered": shown})
    assert "limit" not in InjectionResult(sources, None, None, None)._repr_html_()


def test_sources_without_room_are_refused(folder, tmp_path):
    own = points(np.random.default_rng(3), -1.6, 0.6, 500)
    injection = Injection(own, n_trials=1, n_sources=500, preset=PRESET)
    with pytest.raises(ValueError, match=r"'n_sources' must be at most \d+, which have room"):
        injection.run(image_of(folder), folder=tmp_path / "full")


@pytest.mark.slow
def test_own_sources_are_injected_in_turn_where_the_image_has_data(folder, tmp_path):
    own = points(np.random.default_rng(3), -1.6, 0.6, 6)
    own["sky"] = places([0.0, 60.0, -4.0, 4.0, 4.0, -60.0], [0.0, 0.0, 4.0, 4.0, -4.0, 0.0])
    injection = Injection(own, n_trials=2, n_sources=3, preset=PRESET)
    # an extension may be named
    image = image_of(folder, "part")
    image = image.replace(path=f"{image.path}[SCI]")
    found = injection.run(image, folder=tmp_path / "run").sources
    assert_array_equal(found["row"], [0, 2, 3, 4, 0, 2])
    assert np.isfinite(found["flux"]).all()
    injection = injection.replace(catalog=own[[1, 5]])
    with pytest.raises(ValueError, match="one with sources on the image"):
        injection.run(image, folder=tmp_path / "elsewhere")


def test_a_small_image_gets_a_source(tmp_path):
    rng = np.random.default_rng(3)
    write(tmp_path / "small.fits", places([0.0]), [2.0], rng, side=54)
    psf_of(LO).write(tmp_path / "psf.fits")
    image = MosaicFile(tmp_path / "small.fits", filter="irac.ch4", psf=tmp_path / "psf.fits")
    own = points(rng, -1.6, 0.6, 3)
    result = Injection(own, n_trials=1, preset=PRESET).run(image, folder=tmp_path / "run")
    assert len(result.sources) == 1


def test_options_without_a_prior_are_those_of_files_and_refused_at_once(folder, tmp_path):
    photometer = ImageField(image_of(folder), PRESET, {}).photometer
    assert photometer.background_order == 0
    assert photometer.second_pass is None
    with pytest.raises(ValueError, match="'background_order' must be an integer"):
        Injection(n_trials=1).run(image_of(folder), folder=tmp_path / "run", background_order=-3)
    assert not (tmp_path / "run").exists()


def test_light_on_repeated_pixels_is_repeated(tmp_path):
    rng = np.random.default_rng(3)
    small = write(tmp_path / "small.fits", places([2.0]), [1.0], rng, side=60)
    with fits.open(small) as hdus:
        own = np.array(hdus["SCI"].data)
        wcs = north_up_wcs(CENTER, PIXEL / 2 * u.arcsec, (120, 120))
        header = wcs.to_header()
        header.update(BUNIT="uJy", FILTER="F430M")
        planes = [
            (np.kron(own, np.ones((2, 2))) / 4, "SCI"),
            (np.full((120, 120), NOISE / 4), "ERR"),
        ]
        large = [fits.PrimaryHDU(), *(fits.ImageHDU(one[0], header, name=one[1]) for one in planes)]
        fits.HDUList(large).writeto(tmp_path / "large.fits")
    sources = QTable(
        {"sky": places([-1.0]), "profile": ["point"], "half_light_radius": [0.0] * u.arcsec}
    )
    sources["sersic_index"] = sources["axis_ratio"] = [1.0]
    sources["position_angle"] = [0.0] * u.deg
    files = [
        MosaicFile(tmp_path / f"{name}.fits", filter="irac.ch4") for name in ("small", "large")
    ]
    light, enlarged = (light_on_file(one, sources, [2.0] * u.uJy, psf_of(LO)) for one in files)
    assert light.max() > 0
    assert_allclose(enlarged, np.kron(light, np.ones((2, 2))), rtol=1e-5, atol=1e-7 * light.max())
