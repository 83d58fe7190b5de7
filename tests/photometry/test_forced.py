import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pytest
import scipy.ndimage
from astropy.coordinates import SkyCoord
from astropy.nddata import CCDData
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.light import gaussian_image, pixel_gaussian
from helpers.mosaics import flagged, stamps_of
from helpers.results import assert_equal_values
from helpers.scenes import catalog_at
from miricigale.instrument import imager_wcs, north_up_wcs, pixel_area_map
from miricigale.photometry import (
    ErrorSettings,
    ForcedFlags,
    ForcedPhotometer,
    detect_sources,
)
from miricigale.photometry.detection.catalogs import joined_sky
from miricigale.psf import MatchingKernel
from miricigale.utils.exceptions import MiricigaleWarning


def test_noiseless_point_sources_come_back_exactly(tools, field):
    result = tools.measured(field.image, field.catalog)
    assert_allclose(result.flux.to_value(u.uJy), field.flux, rtol=1e-6, atol=1e-6)
    assert np.abs(result.residual_image.data).max() < 1e-6 * field.image.data.max()
    assert list(result.id) == list(field.catalog["id"])
    assert not result.flags.any()
    with pytest.raises(ValueError, match="read-only"):
        result.flux[0] = 1 * u.uJy
    with pytest.raises(AttributeError):
        result.flux = None
    assert [ax.get_title() for ax in result.plot()] == ["image", "model", "residual"]
    plt.close()


@pytest.mark.parametrize("grid", ["fine", "turned", "distorted"])
def test_flux_does_not_depend_on_the_grid(tools, field, grid):
    shape = {"fine": (480, 480), "turned": (340, 340), "distorted": (1024, 1032)}[grid]
    if grid == "distorted":
        wcs = imager_wcs(tools.CENTER, 71 * u.deg)
    else:
        wcs = north_up_wcs(tools.CENTER, (0.06 if grid == "fine" else 0.13) * u.arcsec, shape)
    if grid == "turned":
        c, s = np.cos(0.6), np.sin(0.6)
        wcs.wcs.pc = [[c, -s], [s, c]]
        wcs.wcs.set()
    data = tools.render(field.sky, field.flux, tools.LO, wcs, shape)
    # the scene itself conserves flux on this grid
    assert_allclose((data * pixel_area_map(wcs, shape)).sum() * 1e12, field.flux.sum(), rtol=1e-6)
    image = tools.as_ccd(data, wcs, 0.01)
    result = ForcedPhotometer(tools.kernel).measure(image, catalog=field.catalog)
    assert_allclose(result.flux.value, field.flux, rtol=1e-4, atol=1e-4)
    model = (result.model_image.data * pixel_area_map(wcs, shape)).sum() * 1e12
    assert_allclose(model, field.flux.sum(), rtol=1e-4)


def galaxies(tools, noise=0.002, n=30, seed=7, spacing=3.2):
    """Isolated Gaussian galaxies, as the two images show them."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(n)))
    sky = tools.places(*(one[:n] for one in tools.lattice(rng, side, spacing, 0.2)))
    size, flux = rng.uniform(0.05, 0.25, n), 10 ** rng.uniform(0.5, 2, n)
    half = int((side + 1.5) * spacing / 2 / tools.FINE)
    sigma, sharp = noise / (tools.FINE**2 * tools.SR * 1e12), np.hypot(size, tools.HI)
    form = {"scale": tools.FINE, "width": sharp, "sigma": sigma, "rng": rng}
    high = tools.picture(sky, np.full(n, 20.0), (2 * half, 2 * half), **form)
    n_low = int(2 * half * tools.FINE / 0.11)
    low = tools.picture(sky, flux, (n_low, n_low), width=np.hypot(size, tools.LO))
    return sky, flux, high, low


def test_extended_sources_through_kernel_and_cutouts(tools):
    sky, flux, high, low = galaxies(tools)
    segmentation, detected = detect_sources(high, threshold=1.0, n_pixels=10)
    assert len(detected) == len(sky)
    result = ForcedPhotometer(tools.kernel).measure(low, high, segmentation, QTable({"sky": sky}))
    assert not result.flags.any()
    ratio = result.flux.value / flux
    assert abs(np.median(ratio) - 1) < 0.005
    assert_allclose(ratio, 1, atol=0.02)
    # a point-source template does not know that they are extended
    assert np.median(tools.measured(low, sky).flux.value / flux) < 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "snr", "bias"), [(0.05, 40, 0.06), (0.16, 20, 0.1)])
def test_noisy_templates(tools, noise, snr, bias):
    ratios, as_they_are, less = [], [], []
    for seed in range(3):
        sky, flux, high, low = galaxies(tools, noise=noise, n=49, seed=seed)
        segmentation, _ = detect_sources(high, threshold=1.0, n_pixels=10)
        catalog = QTable({"sky": sky})
        result = ForcedPhotometer(tools.kernel).measure(low, high, segmentation, catalog)
        # the image has hardly any noise: what the templates' noise leaves is a poor fit
        good = result.flags == 0
        assert np.nanmedian(result.template_snr) < snr
        ratios.append((result.flux.value / flux)[good])
        # the segments as they are, without regard to their noise
        quiet = tools.as_ccd(high.data, high.wcs, high.uncertainty.array[0, 0] * 1e-3)
        plain = ForcedPhotometer(tools.kernel, wings=False)
        result = plain.measure(low, quiet, segmentation, catalog)
        as_they_are.append((result.flux.value / flux)[good])
        less.append(
            (plain.measure(low, high, segmentation, catalog).flux / result.flux).value[good]
        )
    assert abs(np.median(np.concatenate(ratios)) - 1) < bias
    assert np.median(np.concatenate(as_they_are)) < 1 - bias / 2
    # what noise adds to the power of a template is taken off
    assert np.min(np.concatenate(less)) > 1.0005


def test_templates_and_flags_say_what_was_used(tools):
    sky, _, high, low = galaxies(tools, noise=0.01, n=9)
    segmentation, detected = detect_sources(high, threshold=1.0, n_pixels=10)
    # a blank place, one that is far off, and a second source on a segment
    double = sky[0].spherical_offsets_by(0.15 * u.arcsec, 0 * u.arcsec).reshape(1)
    catalog = QTable({"sky": joined_sky([sky, tools.places([1.6, 3600.0], [1.6, 0.0]), double])})
    photometer = ForcedPhotometer(tools.kernel)
    result = photometer.measure(low, high, segmentation, catalog)
    # Gaussians of this significance are profiles of index 1/2
    assert result.template.tolist() == ["sersic"] * 9 + ["point", "none", "point"]
    assert np.all(result.template_snr[:9] > 20)
    assert np.isnan(result.template_snr[9:]).all()
    assert np.flatnonzero(flagged(result.flags, ForcedFlags.NO_SEGMENT)).tolist() == [9]
    assert np.flatnonzero(flagged(result.flags, ForcedFlags.SHARED_SEGMENT)).tolist() == [11]
    assert np.flatnonzero(np.isnan(result.flux)).tolist() == [10]
    table = result.to_table("miri.f770w")
    assert_array_equal(table["miri.f770w_template"], result.template)
    assert_array_equal(table["miri.f770w_template_snr"], result.template_snr)
    as_asked = ForcedPhotometer(tools.kernel, template="cutout")
    result = as_asked.measure(low, high, segmentation, catalog)
    assert result.template.tolist() == ["cutout"] * 9 + ["point", "none", "point"]
    # a detection's own table gives its labels
    assert not photometer.measure(low, high, segmentation, detected).flags.any()


def test_poor_fits_and_unexplained_neighbours_are_flagged(tools):
    # the first is as the catalogue says, the second is wider; the third has a companion at 0.9
    # arcsec, the fourth one at 2.5 arcsec (the PSF's full width is 0.59 arcsec)
    sky = tools.places([-6.0, -2.0, 2.0, 6.0])
    every = joined_sky([sky, tools.places([2.0, 6.0], [0.9, 2.5])])
    form = {"width": np.hypot(tools.LO, [0.0, 0.25, 0.0, 0.0, 0.0, 0.0]), "sigma": 0.1}
    flux = [40.0] * 4 + [20.0] * 2
    image = tools.picture(every, flux, (200, 200), rng=np.random.default_rng(8), **form)
    result = tools.measured(image, sky)
    assert result.snr.min() > 100
    assert flagged(result.flags, ForcedFlags.POOR_FIT).tolist() == [False, True, True, False]
    neighbour = flagged(result.flags, ForcedFlags.UNEXPLAINED_NEIGHBOR)
    assert neighbour.tolist() == [False, False, True, False]
    # with all sources in the catalogue nothing is left
    result = tools.measured(image, every)
    assert not flagged(result.flags, ForcedFlags.UNEXPLAINED_NEIGHBOR).any()
    assert flagged(result.flags, ForcedFlags.POOR_FIT).tolist() == [False, True, *[False] * 4]


def sersic_galaxies(tools, index, seed, noise, n_side=5, spacing=5.4):
    """Isolated galaxies of one index on a noisy image of 0.06 arcsec, and on one of 0.12 arcsec."""
    from miricigale.profiles import sersic_image

    rng = np.random.default_rng(seed)
    n, cell = n_side**2, 0.03
    size = 4 * int((n_side + 1.2) * spacing / cell / 4)
    grid = (np.arange(n_side) - (n_side - 1) / 2) * spacing / cell + (size - 1) / 2
    x, y = (a.ravel() + rng.uniform(-9, 9, n) for a in np.meshgrid(grid, grid))
    scene, radius = np.zeros((size, size)), rng.uniform(0.2, 0.4, n)
    for k in range(n):
        row, column = int(y[k]) - 150, int(x[k]) - 150
        scene[row : row + 301, column : column + 301] += sersic_image(
            (301, 301), x=x[k] - column, y=y[k] - row, r_eff=radius[k] / cell, n=index,
            axis_ratio=rng.uniform(0.4, 1), theta=rng.uniform(0, np.pi),
        )  # fmt: skip
    images = []
    for sigma, step, error in ((tools.HI, 2, noise), (tools.LO, 4, 1e-4)):
        # the small cells have a width of their own
        width = np.sqrt((sigma / cell) ** 2 - 1 / 12)
        light = scipy.ndimage.gaussian_filter(scene, width, truncate=7, mode="constant")
        light = scipy.ndimage.shift(light, -(step - 1) / 2, order=5)[::step, ::step] * step**2
        wcs = north_up_wcs(tools.CENTER, step * cell * u.arcsec, light.shape)
        area = pixel_area_map(wcs, light.shape) * 1e12
        images.append(tools.as_ccd(light / area, wcs, 1.0))
        images[-1].data += rng.normal(0, error, light.shape) / area
        images[-1].uncertainty.array[:] = error / area
    sky = images[0].wcs.pixel_to_world((x - 0.5) / 2, (y - 0.5) / 2)
    return sky, radius, *images


@pytest.mark.parametrize(("index", "noise"), [(0.7, 2e-3), (3.5, 2e-3), (1.5, 6e-4)])
def test_galaxies_of_all_indices(tools, index, noise):
    from miricigale.utils.tables import match_sky

    sky, _, high, low = sersic_galaxies(tools, index, 3, noise)
    segmentation, detected = detect_sources(high)
    row, _ = match_sky(detected["sky"], sky, radius=0.3 * u.arcsec)
    result = ForcedPhotometer(tools.kernel).measure(low, high, segmentation, detected)
    row = row[row >= 0]
    assert len(row) >= 23
    ratio = result.flux.value[row]
    snr = np.median(result.template_snr[row])
    assert 8 < snr < 100
    assert np.mean(result.template[row] == "point") < 0.1
    assert abs(np.median(ratio) - 1) < (0.04 if noise < 1e-3 else 0.08)
    scatter = 1.4826 * np.median(np.abs(ratio - np.median(ratio)))
    assert scatter < (0.04 if noise < 1e-3 else 0.1)


def test_noise_in_the_template_is_taken_off_the_diagonal(tools):
    # noise of known variance in the cutout: expectation of the corrected power is that of the truth
    from miricigale.photometry.detection.cutouts import Cutout
    from miricigale.photometry.templates.templates import BankSources, FineTemplates, TemplateBank

    rng, sigma, n = np.random.default_rng(2), 0.02, 200
    fine = FineTemplates(tools.kernel.array, tools.kernel.target)
    light = gaussian_image(19, 2.0)
    light /= light.sum()
    noisy = [light + rng.normal(0, sigma, light.shape) for _ in range(n)]
    parts = [Cutout(a, (20, 20), noise=sigma**2 * light.size) for a in [light, *noisy]]
    poly = np.zeros((n + 1, 2, 6))
    poly[:, 0, 1] = poly[:, 1, 2] = 11 / 6
    poly[:, :, 0] = 29.0
    at = np.full((n + 1, 2), 29.0)
    sources = BankSources(parts, at, np.full((n + 1, 2), 40.0), poly)
    bank = TemplateBank(fine, sources, (81, 81))
    from miricigale.photometry.templates.normal_equations import normal_matrix

    matrix, _, power, _ = normal_matrix(bank, np.ones((81, 81)))
    assert_allclose(matrix.diagonal(), power, rtol=1e-6)
    power = power[np.argsort(bank.order)]
    terms = bank.noise_terms()[np.argsort(bank.order)]
    assert np.mean(power[1:]) > 1.1 * power[0]
    assert_allclose(np.mean(power[1:] - terms[1:]), power[0], rtol=0.02)


def test_templates_that_did_not_move_are_taken_as_they_are(tools, monkeypatch):
    from miricigale.photometry.detection.cutouts import Cutout
    from miricigale.photometry.templates.templates import BankSources, FineTemplates, TemplateBank

    rng, n = np.random.default_rng(4), 60
    fine = FineTemplates(tools.kernel.array, tools.kernel.target)
    stamps = [rng.random(rng.integers(9, 25, 2)) for _ in range(n)]
    parts = [Cutout(a, (20, 30)) if k % 5 else None for k, a in enumerate(stamps)]
    poly = np.zeros((n, 2, 6))
    poly[:, 0, 1] = poly[:, 1, 2] = 11 / 6
    xy = rng.uniform(-10, 210, (n, 2))
    poly[:, :, 0] = xy * 11 / 6
    bank = TemplateBank(fine, BankSources(parts, poly[:, :, 0], xy, poly), (200, 200))
    before = list(bank.blocks())
    moved = np.where(rng.random((n, 1)) < 0.2, rng.uniform(-1, 1, (n, 2)), 0.0)
    made, plain = [], FineTemplates.coefficients

    def coefficients(self, group, *args):
        made.extend(map(id, group))
        return plain(self, group, *args)

    monkeypatch.setattr(FineTemplates, "coefficients", coefficients)
    shifted = bank.shifted(moved)
    shifted.reuse(bank)
    first = list(shifted.blocks())
    changed = {id(one) for one, m in zip(parts, moved, strict=True) if one and m.any()}
    assert 5 < len(changed) < 20
    assert set(made) <= changed
    more = bank.with_points(xy[:3] + 0.3, poly[:3]).shifted(np.append(moved, np.zeros((3, 2)), 0))
    more.reuse(shifted)
    second = list(more.blocks())
    assert set(made) <= changed
    # a bank without one of the points, and with another
    fewer = bank.with_points(xy[[0, 3]] + 0.3, poly[[0, 3]]).shifted(
        np.append(moved, np.zeros((2, 2)), 0)
    )
    fewer.reuse(more)
    third = list(fewer.blocks())
    assert set(made) <= changed
    for found, own in ((first, shifted), (second, more), (third, fewer), (before, bank)):
        own.forget()
        for one, two in zip(found, own.blocks(), strict=True):
            assert_array_equal(one.values, two.values)
    # stamps that are dropped on the way are the same, once more
    for one, two in zip(third, fewer.blocks(last=True), strict=True):
        assert_array_equal(one.values, two.values)
    assert fewer._kept is None
    # where memory does not hold both nothing is taken, and the first ones go
    more.max_bytes = 6.0 * more.start[-1]
    more.forget()
    made.clear()
    more.reuse(bank)
    list(more.blocks())
    assert len(made) > len(changed)
    made.clear()
    list(bank.blocks())
    assert len(made) > len(changed)


def test_changes_of_templates_are_whitened_and_spread_once(tools, monkeypatch):
    from miricigale.photometry.detection.cutouts import Cutout
    from miricigale.photometry.templates import normal_equations
    from miricigale.photometry.templates.templates import BankSources, FineTemplates, TemplateBank

    # in several blocks of each bank
    monkeypatch.setattr("miricigale.photometry.templates.templates._PART", 500)
    rng = np.random.default_rng(7)
    n = 40
    fine = FineTemplates(tools.kernel.array, tools.kernel.target)
    poly = np.zeros((n, 2, 6))
    poly[:, 0, 1] = poly[:, 1, 2] = 11 / 6
    xy = rng.uniform(0, 150, (n, 2))
    poly[:, :, 0] = xy * 11 / 6
    bank = TemplateBank(fine, BankSources([None] * n, poly[:, :, 0], xy, poly), (150, 150))
    owner = rng.integers(0, n, 2 * n)
    corners = np.rint(poly[owner, ::-1, 0]).astype(int) - 8
    cutouts = [Cutout(rng.normal(size=(17, 17)), tuple(corner)) for corner in corners]
    changes = bank.at_resolution(owner, cutouts)
    inverse_sigma = rng.uniform(0.5, 2.0, (150, 150)).astype(np.float32)
    data = rng.normal(size=(150, 150)).astype(np.float32)
    correlation = np.outer([0.3, 1.0, 0.3], [0.2, 1.0, 0.2])
    counts = {id(bank): 0, id(changes): 0}
    whitened = normal_equations._whitened

    def count(own_bank, block, *args):
        counts[id(own_bank)] += len(block.box)
        return whitened(own_bank, block, *args)

    monkeypatch.setattr(normal_equations, "_whitened", count)
    cross, matrix, projection = normal_equations.change_matrices(
        bank, changes, inverse_sigma, [data], correlation
    )
    # products have the weights of both on the side of the changes
    assert counts == {id(bank): 0, id(changes): 2 * n}
    # dense products of whole images
    white = stamps_of(bank, data.shape) * inverse_sigma
    white_changes = stamps_of(changes, data.shape) * inverse_sigma
    spread = [scipy.ndimage.convolve(w, correlation, mode="constant") for w in white_changes]
    scale = np.sqrt(np.sum(white**2, axis=(1, 2)))
    change_scale = np.sqrt(np.sum(white_changes**2, axis=(1, 2)))
    expected = np.einsum("iyx,jyx->ij", white, spread)
    assert_allclose((cross.toarray() - expected) / scale[:, None] / change_scale, 0.0, atol=1e-6)
    expected = np.einsum("iyx,jyx->ij", white_changes, spread)
    difference = (matrix.toarray() - expected) / change_scale[:, None] / change_scale
    assert_allclose(difference, 0.0, atol=1e-6)
    expected = np.einsum("iyx,yx->i", white_changes, data)
    assert_allclose((projection[:, 0] - expected) / change_scale, 0.0, atol=1e-5)


def test_sersic_templates(tools):
    from miricigale.profiles import sersic_image

    rng = np.random.default_rng(0)
    n, shape = 6, (300, 300)
    wcs = north_up_wcs(tools.CENTER, tools.FINE * u.arcsec, shape)
    sky = tools.positions(rng, n, 6.0)
    x, y = wcs.world_to_pixel(sky)
    radius, index, ratio, pa = rng.uniform(
        [[0.2], [0.8], [0.4], [0]], [[0.5], [2], [1], [180]], (4, n)
    )
    flux = 10 ** rng.uniform(1, 2, n)
    scene = sum(
        sersic_image(shape, x=x[k], y=y[k], total_flux=flux[k], r_eff=radius[k] / tools.FINE,
                     n=index[k], axis_ratio=ratio[k], theta=np.radians(90 + pa[k]))
        for k in range(n)
    )  # fmt: skip
    scene = scipy.ndimage.gaussian_filter(scene, tools.LO / tools.FINE, truncate=8, mode="constant")
    image = tools.as_ccd(scene / (pixel_area_map(wcs, shape) * 1e12), wcs, 0.01)
    forms = {"half_light_radius": radius * u.arcsec, "position_angle": pa * u.deg}
    forms |= {"profile": "sersic", "sersic_index": index, "axis_ratio": ratio}
    catalog = catalog_at(sky, **forms)
    result = ForcedPhotometer(tools.kernel, template="sersic").measure(image, catalog=catalog)
    assert_allclose(result.flux.value / flux, 1, atol=0.02)


def test_background_and_shift_are_found(tools, field):
    moved = field.sky.spherical_offsets_by(0.06 * u.arcsec, -0.03 * u.arcsec)
    image = tools.render(moved, field.flux, tools.LO, field.wcs, field.image.shape) + 0.7
    image = tools.as_ccd(image, field.wcs, 0.01)
    settings = {"background_order": 0, "max_shift": 0.3 * u.arcsec}
    result = ForcedPhotometer(tools.kernel, **settings).measure(image, catalog=field.catalog)
    # +x is west
    assert_allclose(result.shift.to_value(u.arcsec), [-0.06, -0.03], atol=2e-4)
    assert_allclose(result.background.to_value("MJy/sr"), 0.7, atol=1e-4)
    assert_allclose(result.flux.value, field.flux, rtol=2e-3, atol=2e-3)
    # half a pixel is noticed without that
    with pytest.warns(MiricigaleWarning, match="arcsec .x, y. from its templates: 'max_shift'"):
        plain = tools.measured(image, field.catalog, background_order=0)
    assert_allclose(plain.meta["offset"], [-0.06, -0.03], atol=0.006)
    assert np.all(np.array(plain.meta["offset_err"]) < 0.01)
    # that of a fitted shift stands there too
    assert_allclose(result.meta["offset"], result.shift.value, atol=1e-5)
    assert_allclose(result.meta["offset_err"], result.shift_err.value, atol=1e-5)
    settings["max_shift"] = 0.02 * u.arcsec
    with pytest.warns(MiricigaleWarning, match="beyond 'max_shift'"):
        assert tools.measured(image, field.catalog, **settings).shift is None


def test_masked_pixels_do_not_count(tools, field):
    rng = np.random.default_rng(0)
    mask = rng.random(field.image.shape) < 0.2
    data = field.image.data.copy()
    data[mask] = np.where(rng.random(mask.sum()) < 0.5, 1e6, np.nan)
    image = tools.as_ccd(data, field.wcs, 0.01, mask=mask)
    result = tools.measured(image, field.catalog)
    assert_allclose(result.flux.value, field.flux, rtol=1e-5, atol=1e-5)
    assert flagged(result.flags, ForcedFlags.MASKED).mean() > 0.9
    assert np.isnan(result.residual_image.data[mask]).all()
    assert_allclose(result.coverage, 0.8, atol=0.15)


def test_the_rim_of_a_turned_footprint_is_an_edge(tools):
    """A mosaic that is turned against its pixels ends inside the array; a bad pixel is no edge."""
    shape = (120, 120)
    sky = tools.places([0.0, 3.0, -2.5], [0.0, 3.0, 1.0])
    image = tools.picture(sky, np.full(3, 50.0), shape)
    y, x = np.indices(shape)
    x0, y0 = image.wcs.world_to_pixel(sky)
    # through the second source, across the line from the first
    turned = (x - x0[1]) * (x0[1] - x0[0]) + (y - y0[1]) * (y0[1] - y0[0]) > 0
    bad = np.hypot(x - x0[2], y - y0[2]) < 2
    image.data[turned | bad] = np.nan
    result = tools.measured(image, sky)
    assert flagged(result.flags, ForcedFlags.EDGE).tolist() == [False, True, False]
    assert flagged(result.flags, ForcedFlags.MASKED).tolist() == [False, True, True]


def test_edges_and_absent_data(tools):
    sky = tools.places([0.0, -6.55, -7.2, -9.0, -600.0], [0.0, -3.0, 0.0, 3.0, 0.0])
    result = tools.measured(tools.picture(sky, np.full(5, 50.0), (120, 120)), sky)
    assert flagged(result.flags, ForcedFlags.EDGE).tolist() == [False, True, True, True, True]
    assert flagged(result.flags, ForcedFlags.NO_DATA).tolist() == [False, False, True, True, True]
    assert_allclose(result.flux.value[:2], 50.0, rtol=1e-3)
    assert np.isnan(result.flux.value[2:]).all()
    assert np.isnan(result.flux_err.value[2:]).all()
    table = result.to_table("miri.f770w")
    assert table["miri.f770w"].unit == u.uJy
    assert "edge" in table["miri.f770w_flags"].info.description


def test_blends_are_flagged_and_twins_not_counted_twice(tools):
    sky, flux = tools.places([0.0, 0.15, 3.0, 3.0]), np.array([10.0, 20.0, 30.0, 0.0])
    result = tools.measured(tools.picture(sky, flux, (120, 120)), sky)
    assert flagged(result.flags, ForcedFlags.BLENDED).tolist() == [True, True, False, False]
    assert flagged(result.flags, ForcedFlags.DEGENERATE).tolist() == [False, False, False, True]
    assert_allclose(result.flux.value[:3], flux[:3], rtol=1e-4)
    assert result.covariance[0, 1] < 0
    # a source without light of its own is crowded by any neighbour
    assert result.crowded.tolist() == [True, True, False, True]


@pytest.mark.slow
def test_threads_do_not_change_a_bit(tools, monkeypatch):
    # pieces so small that there are many for each thread
    monkeypatch.setattr("miricigale.photometry.templates.templates._PART", 5000)
    monkeypatch.setattr("miricigale.photometry.templates.normal_equations._PAIRS", 7)
    sky, _, high, low = galaxies(tools, noise=0.02, n=36, spacing=1.6)
    noise = np.random.default_rng(3).normal(0, 0.5, low.data.shape)
    low.data[:] += scipy.ndimage.gaussian_filter(noise, 1.0)
    segmentation, _ = detect_sources(high, threshold=1.0, n_pixels=10)
    photometer = ForcedPhotometer(tools.kernel, background_order=0)
    arguments = low, high, segmentation, QTable({"sky": sky})
    alone, *shared = (photometer.replace(n_threads=n).measure(*arguments) for n in (1, 2, 3))
    assert alone.noise_correlation.shape[0] > 1
    assert np.isfinite(alone.flux.value).all()
    for one in shared:
        assert_equal_values("result", alone, one, skip=("wcs", "meta"))


def test_integration_over_pixels(tools):
    # a target without the pixel's response: pixels of the image are averages of the scene
    n, scale = 90, 0.2
    wcs = north_up_wcs(tools.CENTER, scale * u.arcsec, (n, n))
    sky = tools.CENTER.spherical_offsets_by(0.03 * u.arcsec, 0.05 * u.arcsec)
    x, y = wcs.world_to_pixel(sky)
    gx, gy = (pixel_gaussian(n, p, tools.LO / scale) for p in (x, y))
    image = tools.as_ccd(100.0 * gy[:, None] * gx / (pixel_area_map(wcs, (n, n)) * 1e12), wcs, 0.1)
    catalog = QTable({"sky": sky.reshape(1)})
    assert_allclose(tools.measured(image, catalog, integrate=True).flux.value, 100.0, rtol=1e-5)
    assert tools.measured(image, catalog).flux.value[0] < 97.5


@pytest.mark.parametrize(
    ("change", "error", "text"),
    [
        ({"template": "galaxy"}, ValueError, "'template' must be 'auto'"),
        ({"max_shift": -1 * u.arcsec}, ValueError, "'max_shift' must be positive"),
        ({"max_shift": 0.3}, u.UnitsError, "'max_shift' must be a quantity"),
        ({"n_threads": 1.5}, ValueError, "'n_threads' must be at least 1 and an integer"),
        ({"components": 3}, ValueError, "'components' must be 1 or 2"),
        ({"errors": 0.1}, ValueError, "'errors' must be ErrorSettings, got 0.1"),
        ({"offset_order": 1}, ValueError, "'max_shift' must be given with 'offset_order'"),
        ({"offset_order": 4}, ValueError, "'offset_order' must be an integer from 0 to 3"),
        ({"background_order": True}, ValueError, "must be an integer from 0 to 4"),
    ],
)
def test_bad_settings_are_refused(tools, change, error, text):
    refuses(text, ForcedPhotometer, tools.kernel, error=error, **change)
    refuses("'psf_error' must be at least 0 and below 1, got 2", ErrorSettings, psf_error=2)


def test_bad_inputs_are_refused(tools, field):
    photometer = ForcedPhotometer(tools.kernel)
    image, catalog = field.image, field.catalog
    wrong = CCDData(image.data, unit="adu", wcs=field.wcs)
    below = tools.as_ccd(image.data, field.wcs, -0.01)
    for given, message, error in (
        ((image.data, None, None, catalog), "'image' must be a CCDData", ValueError),
        ((image, None, None, {"ra": [1]}), "'catalog' must be a table with posi", ValueError),
        ((image, image, None, catalog), "'highres' must be on the kernel's pixels", ValueError),
        ((wrong, None, None, catalog), "'image' must be convertible to MJy / sr", u.UnitsError),
        ((below, None, None, catalog), "'image' must be an image with uncertainties", ValueError),
    ):
        refuses(message, photometer.measure, *given, error=error)


def test_positions_that_are_not_known_are_flagged(tools, field):
    catalog = field.catalog.copy()
    ra = catalog["sky"].ra.deg.copy()
    ra[[3, 7]] = np.nan
    catalog["sky"] = SkyCoord(ra, catalog["sky"].dec.deg, unit="deg")
    result = tools.measured(field.image, catalog)
    lost = flagged(result.flags, ForcedFlags.NO_DATA)
    assert np.flatnonzero(lost).tolist() == np.flatnonzero(np.isnan(result.flux)).tolist() == [3, 7]
    assert not result.crowded[lost].any()
    with pytest.warns(MiricigaleWarning, match="none of the 1 sources is on or near"):
        result = tools.measured(field.image, tools.places([3600.0]))
    assert flagged(result.flags, ForcedFlags.NO_DATA).all()


def test_arrays_with_the_mistakes_of_files(tools):
    """Areas of zeros and labels of another map, without files."""
    rng, shape = np.random.default_rng(6), (400, 400)
    sky, flux = tools.places(*tools.lattice(rng, 5, 4.0, 0.0)), np.geomspace(3, 30, 25)
    form = {"scale": tools.FINE, "sigma": 5e-3, "rng": rng}
    sharp = tools.picture(sky, flux, shape, width=tools.HI, **form)
    wide = tools.picture(sky, flux, shape, **form)
    labels = tools.disks(sky, sharp.wcs, shape, np.sqrt(60))
    catalog = QTable({"sky": sky, "label": np.arange(1, 26)})
    photometer = ForcedPhotometer(tools.kernel)
    assert_allclose(photometer.measure(wide, sharp, labels, catalog).flux.value, flux, rtol=0.03)
    filled = wide.copy()
    filled.data[:, :90] = 0
    with pytest.warns(MiricigaleWarning, match="has 36000 pixels in areas that are exactly"):
        result = photometer.measure(filled, sharp, labels, catalog)
    good = np.isfinite(result.flux.value) & (result.coverage > 0.5)
    assert np.count_nonzero(good) == 20
    assert_allclose(result.flux.value[good], flux[good], rtol=0.05)
    catalog["label"] = np.roll(catalog["label"], 1)
    message = r"'catalog\['label'\]' must be labels of .*25 of 25 sources"
    refuses(message, photometer.measure, wide, sharp, labels, catalog)


def test_a_kernel_alone_measures_segments(tools, field):
    """Without PSFs the templates are the segments: what they hold, by closed form."""
    form, kept = {"scale": tools.FINE, "width": tools.HI, "sigma": 1e-3}, np.arange(0, 60, 2)
    highres = tools.picture(field.sky, field.flux, (500, 500), **form)
    labels = tools.disks(field.sky[kept], highres.wcs, (500, 500), 8, kept + 1)
    array = tools.kernel.array / tools.kernel.array.sum()
    bare = MatchingKernel.from_array(array, pixel_scale=tools.FINE * u.arcsec)
    photometer = warned("kernel has no PSFs: sources are their segments", ForcedPhotometer, bare)
    catalog = field.catalog.copy()
    catalog["label"] = np.where(np.isin(np.arange(60), kept), np.arange(60) + 1, 0)
    result = photometer.measure(field.image, highres, labels, catalog)
    lost = flagged(result.flags, ForcedFlags.NO_SEGMENT)
    assert np.flatnonzero(~lost).tolist() == kept.tolist()
    assert np.isnan(result.flux[lost]).all()
    assert np.isfinite(result.flux[~lost]).all()
    for kind in ("psf", "sersic"):
        message = "'kernel' must be a MatchingKernel with its PSFs for"
        refuses(message, ForcedPhotometer, bare, template=kind)


def test_upper_limits_hold_the_stated_part_of_fluxes_that_are_not_negative(tools, field):
    """By counting draws of true fluxes, uniform above 0, that give the measured ones."""
    image = tools.picture(
        field.sky, np.zeros(60), (260, 260), sigma=0.05, rng=np.random.default_rng(2)
    )
    result = tools.measured(image, field.catalog)
    rows = np.argsort(result.snr)[[0, 20, 40, 59]]
    true = np.random.default_rng(3).uniform(0, 8, 2_000_000)
    for confidence in (0.68, 0.95):
        limit = (result.upper_limit(confidence) / result.flux_err).value
        for row in rows:
            weight = np.exp(-0.5 * (result.snr[row] - true) ** 2)
            assert np.sum(weight[true < limit[row]]) / weight.sum() == pytest.approx(
                confidence, abs=4e-3
            )
    table = result.to_table("miri.f770w", confidence=0.95)
    assert_array_equal(table["miri.f770w_upper"], result.upper_limit(0.95))
    refuses("'confidence' must be between 0 and 1 .*, got 1", result.upper_limit, 1)
