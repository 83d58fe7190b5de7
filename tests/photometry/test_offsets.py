"""Maps of offsets and backgrounds that vary, on scenes that were distorted by a known amount."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from numpy.testing import assert_allclose

from miricigale.photometry import ForcedPhotometer, read_mosaic, read_prior
from miricigale.photometry.fit.offsets import source_offsets
from miricigale.photometry.templates.templates import Block
from miricigale.utils.exceptions import MiricigaleWarning

SHAPE, SIGMA = (400, 400), 0.02


def distorted(tools, n=100, square=0.0, wrong=0):
    """Points on a grid, their offsets (x, y) in arcsec up to 0.1 across the field, and the image."""
    rng = np.random.default_rng(3)
    east, north = (one[:n] for one in tools.lattice(rng, 10, 4.0, 1.0))
    flux = 10 ** rng.uniform(0, 1.7, n)
    a, b = east / 22, north / 22
    d_east = 0.05 * a + 0.02 * b + 0.03 + square * a**2
    d_north = -0.04 * a + 0.05 * b - 0.01
    # some do not stand where the catalogue says
    away = np.where(np.arange(n) < wrong, 0.15, 0.0)
    there = tools.places(east + d_east + away, north + d_north)
    image = tools.picture(there, flux, SHAPE, sigma=SIGMA, rng=rng)
    # +x is west
    return tools.places(east, north), flux, np.stack([-d_east, d_north], axis=1), image


OPTIONS = {"max_shift": 0.3 * u.arcsec}


@pytest.mark.parametrize(("order", "square", "wrong"), [(1, 0.0, 0), (1, 0.0, 12), (2, 0.04, 0)])
def test_distortion_is_recovered(tools, order, square, wrong):
    sky, flux, offset, image = distorted(tools, square=square, wrong=wrong)
    catalog = QTable({"id": np.arange(100, 200), "sky": sky})
    with pytest.warns(MiricigaleWarning, match="from its templates"):
        plain = tools.measured(image, catalog)
    result = tools.measured(image, catalog, offset_order=order, **OPTIONS)
    found = result.offset_map.evaluate(sky).to_value(u.arcsec)
    assert np.ptp(offset, axis=0).min() > 0.08
    assert_allclose(found, offset, atol=2e-3)
    table = result.offset_map.sources
    assert (~table["used"]).sum() == wrong
    right = np.arange(wrong, 100)
    measured = np.stack([table["dx"].value, table["dy"].value], axis=1)[table["used"]]
    member = table["id"][table["used"]] - 100
    pulls = (measured - offset[member]) / table["offset_err"].value[table["used"], None]
    assert 0.3 < pulls.std() < 1.1
    pulls = ((result.flux.value - flux) / result.flux_err.value)[right]
    assert 0.8 < pulls.std() < 1.2
    assert ((plain.flux.value - flux) / plain.flux_err.value)[right].std() > 2
    assert result.shift is None
    ax = result.offset_map.plot()
    assert ax.get_xlabel() == "x (pixels)"


def test_too_few_sources_lower_the_order(tools):
    sky, _, _, image = distorted(tools, n=6)
    with pytest.warns(MiricigaleWarning, match="order 2 needs 18 .* got 6: order 0 is taken"):
        result = tools.measured(image, sky, offset_order=2, **OPTIONS)
    assert result.offset_map.field.order == 0


def test_without_bright_sources_there_is_one_shift(tools):
    sky, _, offset, image = distorted(tools, n=2)
    with pytest.warns(MiricigaleWarning, match="order 0 needs 3 .* got 2: one shift"):
        result = tools.measured(image, sky, offset_order=1, **OPTIONS)
    assert result.offset_map is None
    assert_allclose(result.shift.value, offset.mean(axis=0), atol=0.01)


@pytest.mark.parametrize("order", [None, 0, 1, 2])
@pytest.mark.parametrize("scatter", [0.0, 0.008])
@pytest.mark.filterwarnings("ignore:.*lies about:miricigale.utils.exceptions.MiricigaleWarning")
def test_one_shift_has_the_error_of_its_light(tools, order, scatter):
    """
    The error is that of the gradients of all light (Cramer-Rao), whatever else is fitted.

    For Gaussians of rms s (pixels) it is sqrt(8 pi) s^2 sigma / sqrt(sum of flux^2). With scatter, bright sources
    are moved one by one before the last fit.
    """
    rng = np.random.default_rng(5)
    east, north = tools.lattice(rng, 10, 4.0, 1.0)
    flux = 10 ** rng.uniform(0, 1.7, 100)
    away = rng.normal(0, scatter, (2, 100))
    there = tools.places(east + 0.04 + away[0], north - 0.03 + away[1])
    image = tools.picture(there, flux, SHAPE, sigma=SIGMA, rng=rng)
    options = {"background_order": order, "errors": tools.WHITE, **OPTIONS}
    result = tools.measured(image, tools.places(east, north), **options)
    sigma = SIGMA * 1e12 * tools.SR * 0.11**2
    error = np.sqrt(8 * np.pi) * (tools.LO / 0.11) ** 2 * sigma / np.sqrt(np.sum(flux**2)) * 0.11
    assert_allclose(result.shift_err.to_value(u.arcsec), error, rtol=0.1)
    weights = flux**2 / np.sum(flux**2)
    mean = np.array([-0.04, -0.03]) + [-weights @ away[0], weights @ away[1]]
    # sources that were moved one by one no longer tell of the shift
    bound = 5 * error if scatter == 0 else 3 * scatter * np.sqrt(np.sum(weights**2)) + 5 * error
    assert_allclose(result.shift.to_value(u.arcsec), mean, atol=bound)
    assert_allclose(result.meta["offset_err"], error, rtol=0.1, atol=1e-5)
    assert_allclose(result.meta["offset"], result.shift.to_value(u.arcsec), atol=1e-5)
    pulls = (result.flux.value - flux) / result.flux_err.value
    assert 0.8 < pulls.std() < 1.2
    if order is not None:
        assert_allclose(result.background.value, 0, atol=5 * result.background_err.value)
        assert len(result.background_field.coefficients) == [1, 3, 6][order]
    # the shift is still there where sources are added
    more = tools.measured(image, tools.places(east, north)[5:], second_pass=True, **options)
    assert len(more.new_sources) >= 5
    assert_allclose(more.shift.value, result.shift.value, atol=0.01)
    assert_allclose(more.shift_err.to_value(u.arcsec), error, rtol=0.2)


def test_new_sources_of_a_distorted_image_are_in_the_catalogue_s_frame(tools):
    sky, flux, _, image = distorted(tools)
    result = tools.measured(image, sky[5:], offset_order=1, second_pass=True, **OPTIONS)
    assert len(result.new_sources) == 5
    row, separation, _ = sky[:5].match_to_catalog_sky(result.new_sources["sky"])
    assert separation.max() < 0.02 * u.arcsec
    new = result.new_sources[row]
    assert_allclose((new["flux"].value - flux[:5]) / new["flux_err"].value, 0, atol=3)


def test_background_that_varies(tools, field):
    ny, nx = field.image.shape
    y, x = np.mgrid[:ny, :nx]
    sky = 0.4 + 0.3 * (x / nx) - 0.2 * (y / ny) ** 2 + 0.1 * (x / nx) * (y / ny)
    image = tools.as_ccd(field.image.data + sky, field.wcs, 0.01)
    constant = tools.measured(image, field.catalog, background_order=0)
    varying = tools.measured(image, field.catalog, background_order=2)
    assert np.abs(constant.flux.value - field.flux).max() > 0.3
    assert_allclose(varying.flux.value, field.flux, rtol=1e-5, atol=1e-5)
    assert_allclose(varying.background_field(x, y), sky, atol=1e-6)
    assert_allclose(varying.background.to_value("MJy/sr"), sky.mean(), rtol=1e-4)
    assert np.abs(varying.residual_image.data).max() < 1e-5 * field.image.data.max()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # the scale of the weights, the kernel's centre
def test_real_images_are_aligned(data_file):
    """F770W of PRIMER-UDS against F444W: within a tenth of a native pixel (0.11 arcsec)."""
    from astropy.io import fits

    from miricigale.psf import MatchingKernel

    uds = data_file("uds")
    start, psfs = f"{uds}/uds-test-", f"{uds}/psf/uds-test-f444w"
    image, prior = (
        read_mosaic(f"{start}{band}_sci.fits.gz", weight=f"{start}{band}_wht.fits.gz")
        for band in ("f770w", "f444w")
    )
    segments, sources = read_prior(prior, segmentation=f"{start}LW_seg.fits.gz")
    kernel, psf = (
        fits.getdata(f"{psfs}_{name}.fits.gz").mean(axis=0) for name in ("kernel_f770w", "psf")
    )
    kernel = MatchingKernel.from_array(kernel, pixel_scale=0.04 * u.arcsec, source=psf)
    # shifts need no profiles beyond the segments
    options = {"background_order": 0, "max_shift": 0.2 * u.arcsec, "wings": False}
    photometer = ForcedPhotometer(kernel, **options)
    one = photometer.measure(image, prior, segments, sources)
    mapped = photometer.replace(offset_order=0).measure(image, prior, segments, sources)
    found = mapped.offset_map.evaluate(sources["sky"][0]).to_value(u.arcsec)
    assert mapped.offset_map.sources["used"].sum() >= 15
    assert np.hypot(*found) < 0.011
    # as one shift of all sources is
    assert_allclose(found, one.shift.to_value(u.arcsec), atol=0.005)


def test_steps_and_errors_of_a_gaussian():
    """A Gaussian of width w: steps to first order, errors of sqrt(2) w over its signal-to-noise, others' light."""
    width, flux, sky, sigma, moved = 3.0, 5000.0, 0.4, 0.5, np.array([0.05, -0.08])
    y, x = np.mgrid[:61, :61]

    def light(dx=0.0, dy=0.0):
        square = (x - 30 - dx) ** 2 + (y - 30 - dy) ** 2
        return np.exp(-0.5 * square / width**2) / (2 * np.pi * width**2)

    noise = np.random.default_rng(1).normal(0, sigma, x.shape)
    box, start = np.array([[0, 0, 61, 61]]), np.array([0, 61 * 61])
    block = Block(0, box, start, light().astype(np.float32).ravel())
    bank = SimpleNamespace(
        blocks=lambda: [block],
        xy=np.array([[30.0, 30.0]]),
        map=lambda do, parts: list(map(do, parts)),
    )
    fit = SimpleNamespace(
        bank=bank,
        psf_width=width,
        flux=np.array([flux]),
        inverse_sigma=np.full(x.shape, np.float32(1 / sigma)),
    )
    change, model = flux * (light(*moved) - light()), flux * light() + sky
    step, _, others = source_offsets(fit, fit.flux, change, model, np.array([0]))
    # differences of neighbors are smaller than derivatives
    smaller = 1 - 1 / (4 * width**2)
    assert_allclose(smaller * step[0], moved, rtol=0.01)
    assert_allclose(others, sky * 4 * np.pi * width**2 / flux, rtol=0.01)
    step, error, _ = source_offsets(fit, fit.flux, noise, model, np.array([0]))
    snr = flux / (2 * np.sqrt(np.pi) * width) / sigma
    assert_allclose(smaller * error, np.sqrt(2) * width / snr, rtol=0.05)
    assert (np.abs(step) < 4 * error).all()
