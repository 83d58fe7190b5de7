import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses, warned
from helpers.light import gaussian_image
from helpers.results import assert_equal_values
from miricigale.instrument import imager_wcs, north_up_wcs
from miricigale.photometry import (
    ErrorSettings,
    ForcedFlags,
    ForcedPhotometer,
    SourceTemplates,
    detect_sources,
    join_bands,
    measure_bands,
)
from miricigale.photometry.images.fits_images import grid_text, text_grid
from miricigale.profiles import sersic_stamp
from miricigale.psf import KernelField, MatchingKernel, gaussian_psf
from miricigale.utils.exceptions import DataError


@pytest.fixture(scope="module")
def scene(tools):
    """Galaxies (Gaussians of known width) and points, on a prior and on two bands."""
    rng = np.random.default_rng(5)
    n = 16
    sky = tools.places(*tools.lattice(rng, 4, 3.2, 0.2))
    size = np.where(np.arange(n) % 4 == 0, 0.0, rng.uniform(0.1, 0.25, n))
    sharp, wide = np.hypot(size, tools.HI), np.hypot(size, tools.LO)
    form = {"scale": tools.FINE, "sigma": 0.02 / (tools.FINE**2 * tools.SR * 1e12), "rng": rng}
    high = tools.picture(sky, np.full(n, 20.0), (290, 290), width=sharp, **form)
    images, flux = {}, {}
    for name, scale, size in (("one", 0.11, 158), ("two", 0.07, 249)):
        flux[name] = 10 ** rng.uniform(0.5, 2, n)
        form = {"scale": scale, "width": wide, "sigma": 1.0, "rng": rng}
        images[name] = tools.picture(sky, flux[name], (size, size), **form)
    segmentation, detected = detect_sources(high, threshold=1.0, n_pixels=10)
    assert len(detected) == n
    options = {"psf": tools.kernel.source, "n_threads": 2}
    templates = SourceTemplates.from_images(high, segmentation, detected, **options)
    return high, segmentation, detected, templates, images, sky, flux


@pytest.mark.parametrize("way", ["file", "pickle"])
def test_templates_come_back_bit_for_bit(scene, tmp_path, way):
    high, _, _, templates, *_ = scene
    rest = SourceTemplates.from_images(*scene[:3], psf=templates.psf, template="cutout")
    assert any(len(one.layers) > 1 for one in rest.light)
    for one in (templates, rest):
        if way == "file":
            path = tmp_path / "templates.fits"
            one.write(path, overwrite=True)
            back = SourceTemplates.read(path)
        else:
            back = pickle.loads(pickle.dumps(one))
        assert_equal_values(way, one, back)
        assert grid_text(back.wcs) == grid_text(high.wcs)


def test_one_set_of_templates_serves_all_bands(tools, scene):
    high, segmentation, detected, templates, images, sky, flux = scene
    assert {"point", "sersic"} <= set(templates.kind)
    results = measure_bands(images, {"one": tools.kernel, "two": tools.kernel}, templates)
    for name, result in results.items():
        alone = ForcedPhotometer(tools.kernel).measure(images[name], high, segmentation, detected)
        assert_array_equal(result.flux.value, alone.flux.value)
        assert_array_equal(result.flux_err.value, alone.flux_err.value)
        assert_array_equal(result.template, alone.template)
        index, _, _ = result.sky.match_to_catalog_sky(sky)
        pull = (result.flux.value - flux[name][index]) / result.flux_err.value
        assert np.abs(pull).max() < 5
    table = join_bands(results)
    assert list(table["id"]) == list(detected["id"])
    assert_array_equal(table["two"].value, results["two"].flux.value)
    assert table["one_err"].unit == u.uJy
    # bands of different sources
    some = {"one": results["one"].to_table()[3:], "two": results["two"].to_table()[:-2]}
    table = join_bands(some)
    assert list(table["id"]) == [*detected["id"][3:], *detected["id"][:3]]
    assert np.isnan(table["one"][-3:]).all()
    assert (table["one_flags"][-3:] == int(ForcedFlags.NO_DATA)).all()
    assert_array_equal(table["two"][-3:].value, results["two"].flux[:3].value)
    assert np.max(table["sky"].separation(detected["sky"][np.r_[3:16, :3]]).arcsec) < 1e-6


def test_rows_off_the_image_change_nothing(tools, scene):
    *_, templates, images, _, _ = scene
    far = QTable({"id": [99], "sky": SkyCoord([0.0], [0.0], unit="deg")})
    all_of = SourceTemplates.concatenate([templates, SourceTemplates.from_catalog(far)])
    assert len(all_of) == 17
    photometer = ForcedPhotometer(tools.kernel)
    one = photometer.measure(images["one"], templates=templates)
    other = photometer.measure(images["one"], templates=all_of)
    assert_array_equal(one.flux.value, other.flux.value[:-1])
    assert other.template[-1] == "none"
    assert np.isnan(other.flux[-1])
    # some of the rows, in another order
    rows = np.array([5, 2, 9])
    other = ("meta", "wcs", "flux", "components")
    assert_equal_values("rows", templates[rows], all_of[rows], skip=other)


def test_profiles_of_a_catalog_that_lack_numbers_are_points(tools):
    """Each has the number of its fault; a round one needs no angle."""
    catalog = QTable({"id": np.arange(5), "sky": tools.places(np.linspace(-2, 2, 5))})
    catalog["half_light_radius"] = [np.nan, 0.3, 0.3, 0.3, 0.3] * u.arcsec
    catalog["sersic_index"] = [1.0, np.nan, 1.0, 1.0, 1.0]
    catalog["axis_ratio"] = [0.5, 0.5, 0.5, 1.0, 0.5]
    catalog["position_angle"] = [0.0, 0.0, 0.0, np.nan, 0.0] * u.deg
    catalog["profile"] = ["sersic", "sersic", "sersic", "sersic", "point"]
    text = (
        "2 of 4 Sersic profiles are drawn as points: half_light_radius is missing or not positive "
        "in 1, sersic_index is missing or outside 0.2 to 10 in 1"
    )
    templates = warned(text, SourceTemplates.from_catalog, catalog, template="sersic")
    assert templates.kind.tolist() == ["point", "point", "sersic", "sersic", "point"]
    wcs = north_up_wcs(tools.CENTER, tools.FINE * u.arcsec, (200, 200))
    xy = np.stack(wcs.world_to_pixel(catalog["sky"]), axis=1)
    light = templates.drawn(wcs, xy)
    assert [stamp is None for stamp in light] == [True, True, False, False, True]
    assert np.isfinite(light[3].data).all()


def test_components_of_one_source(tools):
    # a galaxy with a point in its middle, each given by hand, on a noiseless image
    wcs = north_up_wcs(tools.CENTER, tools.FINE * u.arcsec, (200, 200))
    sky = tools.places([0.3], [0.1])
    x, y = (float(v[0]) for v in wcs.world_to_pixel(sky))
    light, (y0, x0) = sersic_stamp(x=x, y=y, r_eff=5.0, n=1.0, axis_ratio=0.6, theta=0.4)
    given = [7.0 * light], [(y0, x0)], QTable({"id": [1], "sky": sky})
    galaxy = SourceTemplates.from_arrays(*given, wcs=wcs, convolved=False)
    point = SourceTemplates.from_catalog(QTable({"id": [2], "sky": sky}))
    both = SourceTemplates.concatenate([galaxy, point])
    assert both.kind.tolist() == ["sersic", "point"]
    image = np.zeros((200, 200))
    image[y0 : y0 + light.shape[0], x0 : x0 + light.shape[1]] = 30.0 * light / light.sum()
    from scipy.ndimage import gaussian_filter

    # pixels of the profile are means already, so that the PSF is narrower by a pixel's own width
    width = np.sqrt((tools.LO / tools.FINE) ** 2 - 1 / 12)
    image = gaussian_filter(image, width, truncate=8, mode="constant")
    area = tools.FINE**2 * tools.SR * 1e12
    image = image / area + tools.render(sky, [12.0], tools.LO, wcs, (200, 200))
    result = ForcedPhotometer(tools.kernel).measure(tools.as_ccd(image, wcs, 0.01), templates=both)
    assert_allclose(result.flux.value, [30.0, 12.0], rtol=2e-3)
    assert result.covariance[0, 1] < 0


def test_grids_survive_as_text(tools):
    wcs = north_up_wcs(tools.CENTER, tools.FINE * u.arcsec, (290, 290))
    turned, (c, s) = wcs.deepcopy(), (np.cos(0.3), np.sin(0.3))
    turned.wcs.crval = [53.1 + 1e-13, -27.8 / 3]
    turned.wcs.cd = np.array([[-c, s], [s, c]]) * 0.06 / 3600
    turned.wcs.set()
    x = np.array([0.0, 100.0, 289.0])
    for one in (wcs, turned):
        grids = text_grid(grid_text(one)), one
        assert_array_equal(*(grid.pixel_to_world_values(x, 3 * x) for grid in grids))
    distorted = imager_wcs(tools.CENTER, 71 * u.deg)
    back = text_grid(grid_text(distorted)).pixel_to_world_values(x, x)
    assert_allclose(back, distorted.pixel_to_world_values(x, x), rtol=0, atol=1e-9)


def test_what_does_not_fit_is_refused(tools, scene, tmp_path):
    high, segmentation, detected, templates, images, *_ = scene
    photometer = ForcedPhotometer(tools.kernel)
    coarse = north_up_wcs(tools.CENTER, 0.03 * u.arcsec, (9, 9))
    first, joined = {"corners": [(0, 0)], "catalog": detected[:1], "wcs": coarse}, [templates] * 2
    other = SourceTemplates.from_arrays([np.ones((3, 3))], **first)
    image, measure = images["one"], photometer.measure
    both = {"catalog": detected, "templates": templates}
    refuses("'templates' must be given alone", measure, image, **both)
    refuses("must be SourceTemplates", measure, image, templates=detected, error=TypeError)
    refuses("'templates' must be on the kernel's pixels", measure, image, templates=other)
    refuses("'parts' must be on one grid", SourceTemplates.concatenate, [templates, other])
    refuses("'id' must be a table whose ids are unique", SourceTemplates.concatenate, joined)
    refuses("two-dimensional, finite", SourceTemplates.from_arrays, [-np.ones((3, 3))], **first)
    made = SourceTemplates.from_images
    refuses("an array that is odd", made, high, segmentation, detected, psf=np.ones((4, 4)))
    refuses("must be one for each image", measure_bands, images, {"one": tools.kernel}, templates)
    wide = gaussian_psf(0.5 * u.arcsec, pixel_scale=tools.FINE * u.arcsec, fov=3 * u.arcsec)
    blurred = SourceTemplates.from_images(high, segmentation, detected, psf=wide)
    warned("is it of the same image", photometer.measure, images["one"], templates=blurred)
    path = tmp_path / "image.fits"
    high.write(path)
    refuses("holds no templates of sources", SourceTemplates.read, path, error=DataError)


def test_psf_that_changes_over_the_field(tools):
    # the width grows by a quarter from east to west: point sources and galaxies (Gaussians)
    rng = np.random.default_rng(11)
    shape = (190, 420)
    wcs = north_up_wcs(tools.CENTER, 0.11 * u.arcsec, shape)

    def width(x):
        return 0.22 + 0.055 * np.asarray(x) / (shape[1] - 1)

    x = np.tile(np.linspace(20, 400, 12), 5) + rng.uniform(-3, 3, 60)
    y = np.repeat(np.linspace(20, 170, 5), 12) + rng.uniform(-3, 3, 60)
    sky, flux = wcs.pixel_to_world(x, y), 10 ** rng.uniform(1, 2, 60)
    size = np.where(np.arange(60) % 2 == 0, 0.0, 0.2)
    low = tools.picture(sky, flux, shape, width=np.hypot(width(x), size))
    form = {"scale": tools.FINE, "sigma": 0.003 / (tools.FINE**2 * tools.SR * 1e12), "rng": rng}
    sharp = np.hypot(tools.HI, size)
    high = tools.picture(sky, np.full(60, 20.0), (350, 772), width=sharp, **form)
    segmentation, _ = detect_sources(high, threshold=1.0, n_pixels=10)
    catalog, psf = QTable({"sky": sky}), tools.kernel.source
    templates = SourceTemplates.from_images(high, segmentation, catalog, psf=psf)
    points = templates.kind == "point"
    assert points.tolist() == (size == 0).tolist()

    def kernel(at):
        psfs = tools.kernel.source, gaussian_image(67, width(at) / tools.FINE)
        form = {"pixel_scale": tools.FINE * u.arcsec, "regularization": 1e-4}
        return MatchingKernel.from_psfs(*psfs, **form)

    nodes = np.linspace(0, shape[1] - 1, 5)
    everywhere = [(a, b) for a in nodes for b in (0, 189)]
    places = wcs.pixel_to_world(*np.array(everywhere).T)
    field = KernelField([kernel(a) for a, _ in everywhere], places)
    result = ForcedPhotometer(field).measure(low, templates=templates)
    assert_allclose(result.flux.value / flux, 1, atol=5e-3)
    nearest = KernelField(field.kernels, field.sky, "nearest")
    ratio = ForcedPhotometer(nearest).measure(low, templates=templates).flux.value / flux
    # half a step of the width between two places
    assert np.abs(ratio - 1).max() < 0.5 * 0.055 / 4 / 0.22 + 5e-3
    # one kernel for all: a Gaussian of width t fitted to one of width s
    middle = shape[1] / 2
    plain = ForcedPhotometer(kernel(middle), errors=ErrorSettings(size_scatter=None))
    ratio = plain.measure(low, templates=templates).flux.value / flux
    t2, s2 = width(middle) ** 2 + size**2, width(x) ** 2 + size**2
    assert_allclose(ratio, 2 * t2 / (t2 + s2), atol=5e-3)
    assert np.abs(ratio - 1).max() > 0.09
    # all at one place, or all alike, are as one kernel
    same = KernelField([kernel(middle)] * 3, field.sky[:3])
    plain = ForcedPhotometer(same, errors=ErrorSettings(size_scatter=None))
    alike = plain.measure(low, templates=templates).flux.value / flux
    assert_allclose(alike, ratio, rtol=1e-7)
    none = ForcedPhotometer(field).measure(low, templates=templates[:0])
    assert len(none) == 0
