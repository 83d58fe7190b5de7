"""Files of exposures: kernels by place and roll, and the joint fit of several of one filter."""

import types

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData, StdDevUncertainty
from astropy.table import QTable
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from helpers.mosaics import CENTER, FINE, LO, disks, kernel, lattice, picture, places, render
from miricigale.instrument import Exposure, imager_wcs
from miricigale.instrument.image_files import read_image, write_image
from miricigale.photometry import (
    ExposureKernels,
    ForcedPhotometer,
    MosaicFile,
    SourceTemplates,
    measure_files,
)
from miricigale.psf import gaussian_psf, miri_psf_grid
from miricigale.scene import Scene

#: A filter without a model PSF, which could not be a Gaussian.
BAND = "irac.ch4"
SHAPE = (64, 72)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Two exposures of four points with their DQ and sky, a prior, its segments and the kernel."""
    folder = tmp_path_factory.mktemp("exposures")
    rng = np.random.default_rng(5)
    sky = places(*lattice(rng, 2, 2.6, 0.2))
    flux = np.array([3.0, 8.0, 5.0, 12.0])
    images = []
    for k, roll in enumerate((20, 50)):
        wcs = imager_wcs(places(0.3 * k), roll * u.deg, subarray="SUB64")
        data = render(sky, flux, LO, wcs, SHAPE) + 0.4 * k + rng.normal(0, 0.02, SHAPE)
        dq = (rng.random(SHAPE) < 0.03).astype(np.uint32)
        data[dq > 0] = 1e3
        primary = fits.PrimaryHDU()
        primary.header.update(
            TELESCOP="JWST", INSTRUME="MIRI", S_WCS="COMPLETE", EXP_TYPE="MIR_IMAGE"
        )
        science = fits.ImageHDU(data.astype(np.float32), wcs.to_header(relax=True), name="SCI")
        science.header["BUNIT"] = "MJy/sr"
        error = fits.ImageHDU(np.full(SHAPE, 0.02, np.float32), name="ERR")
        path = folder / f"dither{k}_cal.fits"
        fits.HDUList([primary, science, error, fits.ImageHDU(dq, name="DQ")]).writeto(path)
        images.append(MosaicFile(path, filter=BAND))
    prior = picture(sky, flux, (140, 140), scale=FINE, width=0.09, sigma=0.02, rng=rng)
    prior.meta["filter"] = "irac.ch1"
    write_image(prior, folder / "prior.fits")
    labels = disks(sky, prior.wcs, prior.shape, 6)
    fits.PrimaryHDU(labels, prior.wcs.to_header()).writeto(folder / "seg.fits")
    kernel.write(folder / "kernel.fits")
    options = {"segmentation": folder / "seg.fits", "kernel": [folder / "kernel.fits"] * 2}
    return types.SimpleNamespace(
        images=images, prior=MosaicFile(folder / "prior.fits"), options=options, flux=flux, sky=sky
    )


def test_exposures_of_one_filter_are_fitted_together(files, tmp_path):
    paths = {name: tmp_path / f"{name}.fits" for name in ("model", "residual")}
    table = measure_files(files.images, files.prior, **files.options, **paths)
    error = table[f"{BAND}_err"].value
    # both, each with its white noise: sigma sqrt(4 pi) width / pixel, smaller by the root of two
    expected = 0.02 * 1e12 * np.sqrt(4 * np.pi) * LO * 0.1108 * (1 * u.arcsec**2).to_value(u.sr)
    assert_allclose(np.median(error), expected / np.sqrt(2), rtol=0.06)
    assert np.abs((table[BAND].value - files.flux) / error).max() < 4
    for k, file in enumerate(files.images):
        model, residual = (
            read_image(path.with_name(f"{name}_dither{k}.fits")) for name, path in paths.items()
        )
        image = file.read()
        assert_array_equal(residual.mask, image.mask)
        good = ~image.mask
        assert_allclose((model.data + residual.data)[good], image.data[good], atol=1e-5)


@pytest.mark.slow
def test_the_page_lists_the_exposures(files, tmp_path):
    page = tmp_path / "page.html"
    measure_files(files.images, files.prior, **files.options, page=page)
    text = page.read_text()
    for part in ("Exposures were fitted together", "dither0_cal.fits", "dither1_cal.fits"):
        assert part in text


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"background_order": None}, "'background_order' must be 0 to 4 for exposures"),
        ({"components": 2}, "'components' must be 1 for exposures"),
        ({"psf_stars": True}, "'psf_stars' must be left out for exposures"),
    ],
)
def test_options_that_exposures_do_not_have_are_refused(files, options, match):
    refuses(match, measure_files, files.images, files.prior, **files.options, **options)


def test_mosaics_of_one_filter_are_no_exposures(files):
    mosaics = [MosaicFile(files.prior.path, filter=BAND)] * 2
    refuses("'filter' must be", measure_files, mosaics, files.prior, **files.options)


@pytest.fixture(scope="module")
def stars():
    """A star on three exposures, two of them of one roll, through the model PSFs of their places."""
    form = {"fov": 6 * u.arcsec, "oversampling": 3, "n_psfs": 4}
    psf = miri_psf_grid("F1500W", subarray="SUB64", **form)
    rng = np.random.default_rng(6)
    images = []
    for roll, east in ((30, 0.0), (30, 0.4), (110, -0.2)):
        pointing = places(east)
        exposure = Exposure(
            "F1500W", n_groups=9, subarray="SUB64", pointing=pointing, roll=roll * u.deg
        )
        star = QTable({"id": [1], "sky": CENTER.reshape(1), "profile": ["point"]})
        star["miri.f1500w"] = [100.0] * u.uJy
        image = Scene(star, exposure, psf=psf).render()
        light = image.data + rng.normal(0, 0.02, image.shape)
        noise = StdDevUncertainty(np.full(image.shape, 0.02))
        meta = {"filter": "miri.f1500w", "subarray": "SUB64", "pa_aper": exposure.pa_aper.value}
        images.append(CCDData(light, unit=image.unit, wcs=image.wcs, uncertainty=noise, meta=meta))
    return images, form


def test_kernels_are_those_of_the_places_and_rolls(stars):
    images, form = stars
    prior = picture(CENTER.reshape(1), [1.0], (40, 40), scale=FINE)
    sharp = gaussian_psf(0.15 * u.arcsec, pixel_scale=FINE * u.arcsec, fov=6 * u.arcsec)
    kernels = ExposureKernels.from_images(images, prior, sharp, **form)
    first, second, turned = kernels.kernels
    assert first.kernels is second.kernels
    assert turned.kernels is not first.kernels
    templates = SourceTemplates.from_catalog(QTable({"id": [1], "sky": CENTER.reshape(1)}))
    result = ForcedPhotometer(kernels.kernels).measure(images, templates=templates)
    assert_allclose(result.flux.value, 100, rtol=2e-3)
    assert_allclose(result.exposures.table["sky"].value, 0, atol=0.01)
    # one PSF for all, not turned, leaves more
    alike = ForcedPhotometer([first] * 3)
    poor = alike.measure(images, templates=templates)
    residuals = [np.abs(one.exposures.residual_images[2].data).max() for one in (result, poor)]
    assert residuals[0] < 0.5 * residuals[1]


def test_an_exposure_without_a_known_filter_is_refused(stars):
    images, form = stars
    other = images[0].copy()
    other.meta["filter"] = "nircam.f444w"
    prior = picture(CENTER.reshape(1), [1.0], (40, 40), scale=FINE)
    match = r"'images\[0\]' must be exposures of one of the imager's filters"
    sharp = gaussian_psf(0.15 * u.arcsec, pixel_scale=FINE * u.arcsec, fov=6 * u.arcsec)
    refuses(match, ExposureKernels.from_images, [other], prior, sharp, **form)
