"""Sources that the prior lacks, and points on top of galaxies, on scenes whose fluxes are known."""

import types

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.mosaics import flagged
from miricigale.instrument import north_up_wcs
from miricigale.photometry import (
    ErrorSettings,
    ForcedFlags,
    ForcedPhotometer,
    SourceTemplates,
    detect_sources,
)
from miricigale.photometry.detection import residual_sources
from miricigale.photometry.detection.catalogs import joined_sky


@pytest.fixture(scope="module")
def crowd(tools):
    """Eighty-one points of which fifty have a companion at 0.45 to 1.2 arcsec, and two hidden ones apart."""
    rng = np.random.default_rng(1)
    east, north = tools.lattice(rng, 9, 4.0, 0.4)
    distance, angle = rng.uniform(0.45, 1.2, 50), rng.uniform(0, 2 * np.pi, 50)
    flux = 10 ** rng.uniform(0.7, 1.7, 81)
    hidden_flux = np.append(flux[:50] * 10 ** rng.uniform(-0.6, 0.1, 50), [3.0, 8.0])
    sky = tools.places(east, north)
    hidden = tools.places(
        np.append(east[:50] + distance * np.cos(angle), [-18.0, 2.0]),
        np.append(north[:50] + distance * np.sin(angle), [2.0, 18.0]),
    )
    every = joined_sky([sky, hidden]), np.append(flux, hidden_flux)
    image = tools.picture(*every, (360, 360), sigma=0.05, rng=rng)
    return types.SimpleNamespace(
        sky=sky, flux=flux, hidden=hidden, hidden_flux=hidden_flux, image=image
    )


@pytest.mark.parametrize("moved", [False, True])
def test_second_pass_finds_what_the_catalogue_lacks(tools, crowd, moved, monkeypatch):
    if moved:
        # as of very many pixels: strips, and the noise of some of their rows
        monkeypatch.setattr(residual_sources, "_ROWS", 48)
        monkeypatch.setattr(residual_sources, "_SOME", 20_000)
    ids = np.arange(300, 381)[::-1]
    # a catalogue that is wrong by (0.05, -0.03) arcsec lists new sources in its own frame
    offset = ([0.05, -0.03] if moved else [0.0, 0.0]) * u.arcsec
    sky, truth = (one.spherical_offsets_by(*offset) for one in (crowd.sky, crowd.hidden))
    catalog = QTable({"id": ids, "sky": sky})
    options = {"max_shift": 0.3 * u.arcsec if moved else None}
    first = tools.measured(crowd.image, catalog, **options)
    result = tools.measured(crowd.image, catalog, second_pass=True, **options)
    assert first.new_sources is None
    new = result.new_sources
    row, separation, _ = truth.match_to_catalog_sky(new["sky"])
    assert len(new) == 52
    assert sorted(row) == list(range(52))
    assert np.median(separation) < 0.01 * u.arcsec
    assert separation.max() < 0.08 * u.arcsec
    assert not np.isin(new["id"], ids).any()
    assert flagged(new["flags"], ForcedFlags.NOT_IN_CATALOG).all()
    assert not flagged(result.flags, ForcedFlags.NOT_IN_CATALOG).any()
    assert_array_equal(result.id, ids)
    pulls = (new["flux"].value[row] - crowd.hidden_flux) / new["flux_err"].value[row]
    assert 0.8 < pulls.std() < 1.25
    # their neighbours are freed of their light
    companion = slice(50)
    assert np.median(first.flux.value[companion] / crowd.flux[companion]) > 1.02
    ratio = result.flux.value / crowd.flux
    assert abs(np.median(ratio[companion]) - 1) < 0.005
    pulls = (result.flux.value - crowd.flux) / result.flux_err.value
    assert 0.85 < pulls.std() < 1.15
    assert not flagged(result.flags, ForcedFlags.UNEXPLAINED_NEIGHBOR).any()
    # the errors are those of a catalogue that has them all
    full = tools.measured(crowd.image, joined_sky([crowd.sky, crowd.hidden]))
    assert_allclose(result.flux_err.value, full.flux_err.value[:81], rtol=0.05)


def test_bands_that_show_new_sources_are_measured_with_these_alone(tools, crowd, monkeypatch):
    from miricigale.photometry.fit import forced
    from miricigale.photometry.fit.bands import measure_prior

    counts = []
    package = forced.package

    def count(fit, *args):
        counts.append(len(fit.bank.order))
        return package(fit, *args)

    monkeypatch.setattr(forced, "package", count)
    photometer = ForcedPhotometer(tools.kernel, template="psf", second_pass=True)
    catalog = QTable({"id": np.arange(81), "sky": crowd.sky})
    name = "miri.f770w"
    prior = measure_prior({name: crowd.image}, {name: photometer}, None, None, catalog)[name]
    # errors and diagnostics are made of the last fit
    assert counts == [81 + 52]
    assert prior.meta["second_pass"]["fitted"]
    direct = photometer.measure(crowd.image, catalog=catalog)
    assert_array_equal(prior.sky[81:].ra.deg, direct.new_sources["sky"].ra.deg)
    known = photometer.replace(second_pass=False).measure(crowd.image, catalog=prior.sky)
    assert_array_equal(prior.flux.value, known.flux.value)
    assert_array_equal(prior.flux_err.value, known.flux_err.value)


def test_what_is_left_has_its_flux_and_place(tools, crowd, monkeypatch):
    """Two points that stand alone, and are not in the catalog, on the residual."""
    found, plain = [], residual_sources.residual_peaks
    keep = lambda *args: found.append(plain(*args)) or found[-1]  # noqa: E731
    monkeypatch.setattr("miricigale.photometry.fit.diagnostics.residual_peaks", keep)
    result = tools.measured(crowd.image, crowd.sky)
    xy = np.transpose(result.residual_image.wcs.world_to_pixel(crowd.hidden[-2:]))
    distance = np.linalg.norm(found[-1].refined - xy[:, None], axis=2)
    near = distance.argmin(axis=1)
    assert np.all(distance.min(axis=1) < 0.3)
    assert_allclose(found[-1].flux[near], crowd.hidden_flux[-2:], rtol=0.15)


def test_second_pass_with_nothing_to_find_changes_nothing(tools, field):
    plain = tools.measured(field.image, field.catalog)
    twice = tools.measured(field.image, field.catalog, second_pass=True)
    assert_array_equal(twice.flux.value, plain.flux.value)
    assert len(twice.new_sources) == 0
    assert twice.new_sources["flux"].unit == u.uJy


def test_the_evidence_decides_on_a_second_pass(tools, crowd):
    """Sources that are there are fitted; wings of a PSF too narrow, a sky and peaks of symmetric noise are not."""
    found = tools.measured(crowd.image, crowd.sky, second_pass=None)
    told = tools.measured(crowd.image, crowd.sky, second_pass=True)
    assert found.meta["second_pass"]["fitted"]
    assert found.meta["second_pass"]["false_rate"] < 0.1
    # those next to a source fifty times as bright are left out
    assert len(told.new_sources) - 3 <= len(found.new_sources) <= len(told.new_sources)
    rng = np.random.default_rng(3)
    sky, flux = tools.places(*tools.lattice(rng, 5, 4.0, 0.4)), np.full(25, 300.0)
    wide = tools.picture(sky, flux, (260, 260), sigma=0.02, width=1.03 * tools.LO, rng=rng)
    level = tools.picture(sky, flux, (260, 260), sigma=0.02, rng=rng)
    level.data += 0.002
    noisy = tools.picture(sky, 0.01 * flux, (260, 260), sigma=0.02, rng=rng)
    # rare pixels of either sign far from Gaussian
    y, x = rng.integers(0, 260, (2, 60))
    noisy.data[y, x] += rng.choice([-1, 1], 60) * 1.5
    for image in (wide, level, noisy):
        result = tools.measured(image, sky, second_pass=None)
        assert result.new_sources is None
        assert not result.meta["second_pass"]["fitted"]
    assert result.meta["second_pass"]["peaks"] > 3
    refuses(
        "'second_pass' must be False or True or None", tools.measured, noisy, sky, second_pass=2
    )


def test_ids_that_are_text_do_not_clash(tools, crowd):
    names = np.array([f"source {k}" for k in range(80)] + ["new-2"])
    catalog = QTable({"id": names, "sky": crowd.sky})
    result = tools.measured(crowd.image, catalog, second_pass=True)
    assert result.new_sources["id"][:3].tolist() == ["new-1", "new-3", "new-4"]


@pytest.fixture(scope="module")
def nuclei(tools):
    """Galaxies with and without a point in their middle that the high-resolution image does not show."""
    rng = np.random.default_rng(1)
    n, half = 25, int(10.5 / tools.FINE)
    sky = tools.places(*tools.lattice(rng, 5, 3.2, 0.2))
    size = np.append(rng.uniform(0.2, 0.4, n - 1), 0.0)
    sharp, wide = np.hypot(size, tools.HI), np.hypot(size, tools.LO)
    form = {"scale": tools.FINE, "sigma": 0.01 / (tools.FINE**2 * tools.SR * 1e12), "rng": rng}
    high = tools.picture(sky, np.full(n, 20.0), (2 * half, 2 * half), width=sharp, **form)
    shape = (int(2 * half * tools.FINE / 0.11),) * 2
    host = 10 ** rng.uniform(1, 1.7, n)
    point = np.where(np.arange(n) < 8, 0.0, host * rng.uniform(0.3, 1, n))
    low = tools.picture(sky, host, shape, width=wide, sigma=0.02, rng=rng)
    low.data += tools.render(sky, point, tools.LO, low.wcs, shape)
    segmentation, _ = detect_sources(high, threshold=1.0, n_pixels=10)
    return types.SimpleNamespace(
        sky=sky, host=host, point=point, images=(low, high, segmentation), n=n
    )


def test_points_on_top_of_galaxies(tools, nuclei):
    catalog = QTable({"sky": nuclei.sky})
    fixed = {"errors": ErrorSettings(size_scatter=None)}
    low, *prior = nuclei.images
    templates = SourceTemplates.from_images(*prior, catalog, psf=tools.kernel.source)
    one, free, exact, two = (
        ForcedPhotometer(tools.kernel, **options).measure(low, templates=templates)
        for options in (fixed, {}, {"components": 2, **fixed}, {"components": 2})
    )
    assert one.flux_point is free.flux_point is None
    total = nuclei.host + nuclei.point
    # the last is a point, whose nucleus cannot be told from it and whose fit is good
    double = np.arange(nuclei.n) >= 8
    double[-1] = False
    assert np.all(one.flux.value[double] / total[double] > 1.05)
    # templates that may shrink hold the light of most points
    assert np.median(np.abs(free.flux.value[double] / total[double] - 1)) < 0.04
    for result in (exact, two):
        assert_array_equal(np.isfinite(result.flux_point.value), double)
        assert_allclose(result.flux.value[double], total[double], rtol=0.02)
        assert not flagged(result.flags, ForcedFlags.POOR_FIT).any()
    for found, truth in (
        (exact.flux_point, nuclei.point),
        (exact.flux - exact.flux_point, nuclei.host),
    ):
        ratio = found.value[double] / truth[double]
        assert_allclose(ratio, 1, atol=0.06)
        assert np.median(np.abs(ratio - 1)) < 0.015
    # that sizes may differ between the bands is in the errors of the points
    pulls = ((two.flux_point.value - nuclei.point) / two.flux_point_err.value)[double]
    assert 0.3 < pulls.std() < 1.3
    assert np.all(two.flux_point_err[double] > exact.flux_point_err[double])
    table = two.to_table("miri.f770w")
    assert_array_equal(table["miri.f770w_flux_point"], two.flux_point)
    assert_array_equal(table["miri.f770w_flux_point_err"], two.flux_point_err)


def test_points_are_where_the_galaxies_are(tools, nuclei):
    # positions of a catalog that are wrong by 30 mas are no positions of nuclei
    rng = np.random.default_rng(3)
    east, north = rng.normal(0, 0.03, (2, nuclei.n)) * u.arcsec
    double = (np.arange(nuclei.n) >= 8) & (np.arange(nuclei.n) < 24)
    photometer = ForcedPhotometer(tools.kernel, errors=ErrorSettings(size_scatter=None))
    for sky in (nuclei.sky, nuclei.sky.spherical_offsets_by(east, north)):
        catalog = QTable({"sky": sky, "components": np.where(double, 2, 1)})
        result = photometer.measure(*nuclei.images, catalog)
        ratio = result.flux_point.value[double] / nuclei.point[double]
        assert_allclose(ratio, 1, atol=0.06)
        assert np.std(ratio) < 0.02
        total = nuclei.host + nuclei.point
        assert_allclose(result.flux.value[double], total[double], rtol=0.02)


def test_the_catalogue_says_who_has_two_components(tools, nuclei):
    number = np.where(np.arange(nuclei.n) % 2 == 0, 2, 1)
    catalog = QTable({"sky": nuclei.sky, "components": number})
    result = ForcedPhotometer(tools.kernel).measure(*nuclei.images, catalog)
    double = (number == 2) & (np.arange(nuclei.n) < 24)
    assert_array_equal(np.isfinite(result.flux_point.value), double)
    # a point on top of a point
    assert flagged(result.flags, ForcedFlags.ONE_COMPONENT).tolist() == [False] * 24 + [True]
    assert_allclose(result.flux.value[24], nuclei.host[24] + nuclei.point[24], rtol=0.01)
    catalog["components"] = 3
    photometer = ForcedPhotometer(tools.kernel)
    refuses("column 'components' of 1 and 2", photometer.measure, *nuclei.images, catalog)


def test_covariance_of_two_components_is_that_of_least_squares(tools):
    # one Gaussian galaxy and a point, of known templates, on white noise: (A^T A)^-1 by hand
    shape, sigma, width, sky = (121, 121), 0.05, 0.35, tools.places([0.0])
    sharp, wide = np.hypot(width, tools.HI), np.hypot(width, tools.LO)
    high = tools.picture(sky, [1.0], (221, 221), scale=tools.FINE, width=sharp)
    high.uncertainty.array[:] = high.data.max() * 1e-6
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, shape)
    templates = [tools.render(sky, [1.0], one, wcs, shape) for one in (wide, tools.LO)]
    matrix = np.array([[np.sum(a * b) for b in templates] for a in templates]) / sigma**2
    expected = np.linalg.inv(matrix)
    image = tools.as_ccd(30 * templates[0] + 12 * templates[1], wcs, sigma)
    catalog = QTable({"sky": sky, "components": [2]})
    photometer = ForcedPhotometer(tools.kernel, template="cutout", wings=False, errors=tools.WHITE)
    result = photometer.measure(image, high, np.ones((221, 221), int), catalog)
    assert_allclose(result.flux.value, 42, rtol=2e-3)
    assert_allclose(result.flux_point.value, 12, rtol=0.01)
    assert_allclose(result.flux_point_err.value**2, expected[1, 1], rtol=0.01)
    assert_allclose(result.flux_err.value**2, expected.sum(), rtol=0.01)
    joint = result.joint_covariance.toarray()
    assert_allclose(joint[0, 1], expected[0, 1] + expected[1, 1], rtol=0.01)
    correlation = (expected[0, 1] + expected[1, 1]) / np.sqrt(expected.sum() * expected[1, 1])
    assert_allclose(result.flux_point_corr, correlation, rtol=0.01)
    assert_allclose(
        result.to_table("miri.f770w")["miri.f770w_flux_point_corr"], correlation, rtol=0.01
    )
