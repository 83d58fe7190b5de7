"""Images, catalogs, PSFs and results of forced photometry in the forms that users have."""

import astropy.units as u
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.nddata import CCDData, NDData, StdDevUncertainty
from astropy.table import QTable
from matplotlib.figure import Figure
from numpy.testing import assert_allclose, assert_array_equal
from photutils.psf import CircularGaussianPRF

from helpers.commands import command
from helpers.errors import refuses
from helpers.scenes import tan_wcs
from miricigale.filters import Filter
from miricigale.instrument import Exposure, north_up_wcs, pixel_area_map
from miricigale.photometry import (
    ErrorModel,
    ForcedFlags,
    ForcedPhotometer,
    SourceTemplates,
    detect_sources,
)
from miricigale.psf import MatchingKernel, gaussian_psf, miri_psf, psf_image, psf_mosaic
from miricigale.utils.exceptions import PSFWarning

NOISE = {0.03: 0.002, 0.09: 0.01}
FWHM = {0.03: 0.12, 0.09: 0.27}


@pytest.fixture(scope="module")
def sky():
    rng = np.random.default_rng(2)
    x, y = (v.ravel() + rng.uniform(-1, 1, 16) for v in np.meshgrid(*[np.linspace(12, 84, 4)] * 2))
    return tan_wcs((96, 96), 0.09).pixel_to_world(x, y)


@pytest.fixture(scope="module")
def flux():
    return np.random.default_rng(3).uniform(2, 30, 16)


def drawn(n, scale, sky, flux):
    """Points with Gaussian PSFs, a flux in uJy in each pixel."""
    wcs, rng = tan_wcs((n, n), scale), np.random.default_rng(4)
    y, x = np.mgrid[:n, :n]
    data = rng.normal(0, NOISE[scale], (n, n))
    for at, value in zip(np.transpose(wcs.world_to_pixel(sky)), flux, strict=True):
        star = CircularGaussianPRF(x_0=at[0], y_0=at[1], flux=value, fwhm=FWHM[scale] / scale)
        data += star(x, y)
    error = StdDevUncertainty(np.full((n, n), NOISE[scale]))
    return CCDData(data, unit="uJy", wcs=wcs, uncertainty=error)


@pytest.fixture(scope="module")
def images(sky, flux):
    return drawn(96, 0.09, sky, flux), drawn(288, 0.03, sky, flux)


@pytest.fixture(scope="module")
def psfs():
    # with the response of the pixel, as the sources are drawn
    wide, sharp = (
        gaussian_psf(np.hypot(FWHM[s], s * np.sqrt(8 * np.log(2) / 12)) * u.arcsec,
                     pixel_scale=s * u.arcsec, fov=f * u.arcsec)
        for s, f in ((0.09, 4), (0.03, 2))
    )  # fmt: skip
    return {"psf": wide, "highres_psf": sharp}


@pytest.fixture(scope="module")
def photometer(psfs):
    return ForcedPhotometer(**psfs)


def test_the_kernel_is_that_of_the_psfs(photometer, psfs):
    made = MatchingKernel.from_psfs(psfs["highres_psf"], psfs["psf"], pixel_scale=0.03 * u.arcsec)
    assert_array_equal(photometer.kernel.array, made.array)
    assert_array_equal(photometer.replace(second_pass=True).kernel.array, made.array)


def test_points_need_a_psf_and_positions(images, psfs, sky, flux):
    points = ForcedPhotometer(psf=psfs["psf"])
    for catalog in (sky, {"ra": sky.ra.deg, "dec": sky.dec.deg}, QTable({"sky": sky})):
        result = points.measure(images[0], catalog=catalog)
        pulls = (result.flux.value - flux) / result.flux_err.value
        # 16 sources of a signal-to-noise ratio of 100 to 700
        assert np.abs(pulls).max() < 4
        assert np.sqrt(np.mean(pulls**2)) < 1.6
    by_hand = points.measure(images[0], sky)
    assert_array_equal(by_hand.flux.value, result.flux.value)


def forms(image, folder):
    """The same image in other forms."""
    area = pixel_area_map(image.wcs, image.shape) * 1e12  # uJy in MJy, sr
    name = folder / f"{image.shape[0]}.fits"
    image.write(name, overwrite=True)
    brightness = StdDevUncertainty(image.uncertainty.array / area)
    nano = StdDevUncertainty(image.uncertainty.array * 1e3)
    return (
        name,
        str(name),
        image.to_hdu(),
        NDData(image.data, unit=image.unit, wcs=image.wcs, uncertainty=image.uncertainty),
        CCDData(image.data / area, unit="MJy/sr", wcs=image.wcs, uncertainty=brightness),
        CCDData(image.data * 1e3, unit="nJy", wcs=image.wcs, uncertainty=nano),
    )


@pytest.mark.filterwarnings("ignore:.*belong to no source of the catalog")
def test_images_of_any_form_give_the_same(images, photometer, sky, flux, tmp_path):
    expected = photometer.measure(*images, catalog=sky)
    assert_allclose(expected.flux.value, flux, rtol=0.03)
    # the third argument may be the positions, without segments
    assert_array_equal(photometer.measure(*images, sky).flux.value, expected.flux.value)
    for pair in zip(*(forms(image, tmp_path) for image in images), strict=True):
        result = photometer(*pair, catalog=sky)
        assert_allclose(result.flux.value, expected.flux.value, rtol=1e-4)
        assert_allclose(result.flux_err.value, expected.flux_err.value, rtol=1e-3)


def test_sources_are_detected_where_none_are_given(images, photometer, sky, flux):
    result = photometer.measure(*images)
    _, detected = detect_sources(images[1])
    assert len(result) == len(detected)
    index, separation, _ = sky.match_to_catalog_sky(result.sky)
    assert separation.max() < 0.05 * u.arcsec
    assert_allclose(result.flux.value[index], flux, rtol=0.03)


def test_what_is_no_image_or_kernel_is_named(images, psfs, sky):
    refuses("'kernel, psf' must be one of them given, got neither", ForcedPhotometer)
    kernel = MatchingKernel.identity(psfs["psf"])
    refuses("one of them given, got both", ForcedPhotometer, kernel, psf=psfs["psf"])
    sharp = {"highres_psf": psfs["psf"]}
    refuses("'highres_psf' must be given with 'psf'", ForcedPhotometer, kernel, **sharp)
    refuses(
        "'kernel' must be a MatchingKernel, a KernelField, a file", ForcedPhotometer, psfs["psf"]
    )
    refuses("'psf' must be that of the image on the sky, psf_mosaic", ForcedPhotometer, psf="F770W")
    refuses("'psf' must be a PSF on pixels of known size", ForcedPhotometer, psf=3.0)
    bands = {"F770W": psfs["psf"], "F1000W": psfs["psf"]}
    refuses(
        "'psf' must be that of one band .*measure_bands.*F770W, F1000W", ForcedPhotometer, psf=bands
    )
    points = ForcedPhotometer(psf=psfs["psf"])
    refuses("'image' must be a CCDData, an NDData with unit", points.measure, np.ones((9, 9)), sky)
    refuses("'catalog' must be given without a high-resolution", points.measure, images[0])


@pytest.mark.parametrize("unit", ["nJy", "uJy/pix", "uJy/arcsec2", "0.5 MJy/sr"])
def test_model_and_residual_are_in_the_unit_that_is_asked_for(images, psfs, sky, unit):
    """In that of the image they add up to it, and models of points to their fluxes."""
    image = images[0]
    unit = u.Unit(unit)
    result = ForcedPhotometer(psf=psfs["psf"]).measure(image, sky)
    brightness = result.model_image.unit
    scale = brightness.to(unit) if unit.is_equivalent(brightness) else None
    if scale is None:
        pixel = u.pix if u.pix in unit.bases else u.one
        area = pixel_area_map(image.wcs, image.shape) * u.sr
        scale = (brightness * area).to_value(unit * pixel)
    model, residual = result.images_in(unit)
    assert model.unit == residual.unit == unit
    assert_allclose(model.data, result.model_image.data * scale)
    assert_allclose(residual.uncertainty.array, result.residual_image.uncertainty.array * scale)
    assert_array_equal(residual.mask, result.residual_image.mask)
    if unit == u.nJy:
        assert_allclose(model.data.sum(), 1e3 * result.flux.value.sum(), rtol=0.05)
    # in the unit of the image they add up to it
    model, residual = result.images_in(image)
    assert residual.unit == image.unit
    assert_allclose(model.data + residual.data, image.data, rtol=1e-5, atol=1e-4)
    refuses("'unit' must be convertible", result.images_in, "DN/s", error=u.UnitsError)


def test_results_are_indexed_like_their_table(images, psfs, sky):
    result = ForcedPhotometer(psf=psfs["psf"]).measure(images[0], sky)
    assert_array_equal(result["flux"].value, result.flux.value)
    assert result[3]["id"] == result.loc[4]["id"] == 4
    parts = result[:5], result[result.snr > 0], result[[1, 2]]
    assert [len(part) for part in parts] == [5, 16, 2]
    assert list(result.columns) == result.to_table().colnames
    frame = result.to_pandas()
    assert_allclose(frame["ra"], sky.ra.deg)
    assert_allclose(result.ra.deg, sky.ra.deg)
    assert_array_equal(QTable(result)["flux"].value, result.flux.value)
    assert list(frame.columns[:3]) == ["id", "ra", "dec"]
    assert_allclose(result.magnitude.value, 23.9 - 2.5 * np.log10(result.flux.value))
    assert_allclose(result.mag_err.value, 1.0857362 / result.snr, rtol=1e-6)
    assert result.flag_names()[0] == []
    assert result.flags[0] is ForcedFlags(0)
    assert not result.flags.flags.writeable
    assert "sources: 16" in result.summary()
    # on the pixels of the image
    x, y = images[0].wcs.world_to_pixel(sky)
    assert_allclose([result["x"], result["y"]], [x, y], atol=1e-6)
    panels = result.plot_source(4, size=1 * u.arcsec)
    whole = result.residual_image.data + result.model_image.data
    drawn = panels[0].get_images()[0].get_array()
    column, row = round(float(result.x[3])), round(float(result.y[3]))
    # the middle of the cutout is the pixel of the source
    assert drawn[drawn.shape[0] // 2, drawn.shape[1] // 2] == pytest.approx(whole[row, column])
    plt.close("all")
    refuses("no source with the id 99", result.plot_source, 99, error=KeyError)
    matches = result.match_to_catalog(sky[3:5])
    assert matches["second"][3:5].tolist() == [0, 1]
    assert matches["status"][2] == "unmatched"
    message = "no column 'fluxx'; known: .*; did you mean 'flux'"
    refuses(message, result.__getitem__, "fluxx", error=KeyError)
    assert result.residual is result.residual_image
    assert_array_equal(result.match(sky[3:5])["second"], matches["second"])
    image = result.plot_residual().get_images()[0]
    assert_array_equal(image.get_array(), result.plot_residual_image().get_images()[-1].get_array())
    plt.close("all")
    refuses("did you mean", getattr, result, "plot_fluxx", error=AttributeError)


def test_a_kernel_is_applied_and_drawn(psfs, images):
    kernel = MatchingKernel.from_psfs(psfs["highres_psf"], psfs["psf"])
    assert kernel.pixel_scale == 0.03 * u.arcsec
    convolved = kernel(images[1])
    assert_array_equal(convolved.data, kernel.apply(images[1].data))
    assert (convolved.unit, convolved.uncertainty) == (u.uJy, None)
    lines = kernel.plot(ax=Figure().subplots()).lines
    curves = {line.get_label(): line.get_ydata() for line in lines}
    # the closed form of a Gaussian
    radius = lines[0].get_xdata()
    assert_allclose(curves["convolved"], curves["wide PSF"], atol=5e-3)
    sigma = psfs["highres_psf"].fwhm.value / np.sqrt(8 * np.log(2))
    truth = 1 - np.exp(-0.5 * (radius / sigma) ** 2)
    assert_allclose(curves["sharp PSF"], truth, atol=0.02)
    refuses("'array' must be a square array", MatchingKernel, psfs["psf"], pixel_scale=1 * u.arcsec)


def test_errors_of_several_exposures_are_those_of_each():
    deep = Exposure("F770W", n_groups=100)
    short = Exposure("F1500W", n_groups=40)
    both = ErrorModel.from_exposure([deep, short])
    for exposure in (deep, short):
        limit = ErrorModel.from_exposure(exposure, n_dithers=1).limiting_flux(exposure.filter)
        assert both.limiting_flux(exposure.filter) == limit
    limits = both.limiting_flux()
    assert_allclose(limits.value, [both.limiting_flux(band).value for band in both.filters])
    refuses("no band of this error model 'F1000W'", both.limiting_flux, "F1000W", error=KeyError)
    single = ErrorModel.from_exposure(short)
    # columns are found by any name of the band
    fluxes = QTable({"id": [1], "miri.f1500w": [9.0] * u.uJy})
    perturbed = single.perturb(fluxes, seed=1)
    assert perturbed["F1500W_err"] == single.sigma(9 * u.uJy)
    # a model of one band needs no name
    assert single.limiting_magnitude() == single.limiting_magnitude("F1500W")
    limit = single.limiting_flux(n_sigma=7)
    assert single.snr(limit) == pytest.approx(7, rel=1e-6)
    # dithers add up
    deep = deep.replace(pointing="53 -27")
    dithered = ErrorModel.from_exposure(deep.dithered(4))
    whole = ErrorModel.from_exposure(deep, 4 * deep.exposure_time, n_dithers=4)
    assert dithered.limiting_flux("F770W") == whole.limiting_flux("F770W")
    other = deep.replace(n_groups=50)
    refuses("of one n_groups, got 100, 50", ErrorModel.from_exposure, [deep, other])
    refuses("a list of exposures", ErrorModel.from_exposure, ["F770W"])


def test_errors_of_an_exposure():
    exposure = Exposure("F770W", time=1 * u.h)
    model = ErrorModel.from_exposure(exposure)
    form = {name: getattr(exposure, name) for name in ("n_integrations", "frame_time")}
    same = ErrorModel.from_exposure("JWST/MIRI.F770W", exposure.exposure_time, **form)
    for name in ("F770W", "miri.f770w", Filter("F770W")):
        assert model.limiting_flux(name) == same.limiting_flux("miri.f770w")
    assert ErrorModel.from_depths({"IRAC1": 26.0}).filters == ("irac.ch1",)
    refuses("'time' must be given, or an Exposure", ErrorModel.from_exposure, "F770W")


def test_catalogs_of_pandas_with_missing_positions(images, psfs, sky):
    ra = np.where(np.arange(16) == 2, np.nan, sky.ra.deg)
    catalog = pd.DataFrame({"RA": ra, "DEC": sky.dec.deg, "NUMBER": np.arange(16) + 100})
    result = ForcedPhotometer(psf=psfs["psf"]).measure(images[0], catalog=catalog)
    assert result.id[0] == 100
    assert np.flatnonzero(~np.isfinite(result.flux.value)).tolist() == [2]


def test_psfs_without_pixels_are_on_those_of_their_images(images, sky, flux, tmp_path):
    image, highres = images
    # the pixels' response is in the stars, which are drawn by their integrals over pixels
    half = 20
    y, x = np.mgrid[-half : half + 1, -half : half + 1]
    stamps = {}
    for scale, fwhm in FWHM.items():
        stamps[scale] = CircularGaussianPRF(flux=1.0, fwhm=fwhm / scale)(x, y)
    array = stamps[0.09]
    stated = ForcedPhotometer(psf=(array, 0.09 * u.arcsec)).measure(image, sky)
    sampled = ForcedPhotometer(psf=array).measure(image, sky)
    assert_allclose(sampled.flux.value, stated.flux.value, rtol=1e-4)
    assert np.all(np.abs(sampled.flux.value - flux) < 5 * sampled.flux_err.value)
    # so is a file whose header is bare
    fits.writeto(tmp_path / "psf.fits", array)
    of_file = ForcedPhotometer(psf=tmp_path / "psf.fits").measure(image, sky)
    assert_allclose(of_file.flux.value, stated.flux.value, rtol=1e-4)
    photometer = ForcedPhotometer(psf=array, highres_psf=stamps[0.03], template="psf")
    assert "PSFs on the pixels of the images" in repr(photometer)
    both = photometer.measure(image, highres, catalog=sky)
    assert np.all(np.abs(both.flux.value - flux) < 5 * both.flux_err.value)
    refuses("'psf' must be a PSF that states its pixels for exposures", photometer.measure,
            [image, image], highres)  # fmt: skip
    # models are drawn, and several bands measured, on the same pixels
    templates = SourceTemplates.from_catalog(QTable({"sky": sky, "id": np.arange(16)}))
    drawn_light = ForcedPhotometer(psf=array).render(image, templates, flux * u.uJy)
    total = np.sum(drawn_light * pixel_area_map(image.wcs, image.shape) * u.sr).to_value(u.uJy)
    assert total == pytest.approx(flux.sum(), rel=1e-3)
    refuses("given to measure.. where 'highres_psf'", photometer.measure, image, sky)


def test_a_psf_and_its_filter_have_the_fluxes_of_the_command(tmp_path, capsys):
    """A stamp of unit sum misses the wings; the model of the filter says how much."""
    scale = 0.11 * u.arcsec
    sky = SkyCoord([53.1], [-27.8], unit="deg")
    model = psf_mosaic(miri_psf("F770W"), scale, 0 * u.deg)
    light = psf_image(model, pixel_scale=scale, shape=101)
    stamp = psf_image(model, pixel_scale=scale, shape=25)
    share = stamp.sum()
    assert 0.8 < share < 0.9
    error = np.full(light.shape, 0.01)
    data = 20 * light + np.random.default_rng(1).normal(0, 0.01, light.shape)
    wcs = north_up_wcs(sky[0], scale, light.shape)
    image = CCDData(data, unit="uJy", wcs=wcs, uncertainty=StdDevUncertainty(error))
    fits.writeto(tmp_path / "psf.fits", stamp / share)
    for psf in (stamp / share, (stamp / share, scale), tmp_path / "psf.fits"):
        with pytest.warns(PSFWarning, match="fluxes lack what lies beyond.*filter='F770W' of"):
            bare = ForcedPhotometer(psf=psf).measure(image, sky)
        with pytest.warns(PSFWarning, match="is taken to hold 0.8"):
            whole = ForcedPhotometer(psf=psf, filter="F770W").measure(image, sky)
        assert_allclose(bare.flux.value, 20 * share, rtol=5e-3)
        assert_allclose(whole.flux.value, 20, rtol=5e-3)
    # a sum below 1 is the part of the light, 3 % less than in the model here, of an array as of a file
    fits.writeto(tmp_path / "stated.fits", 0.97 * stamp)
    fluxes = []
    for psf in (0.97 * stamp, (0.97 * stamp, scale), tmp_path / "stated.fits"):
        photometer = ForcedPhotometer(psf=psf, filter="F770W")
        fluxes.append(photometer.measure(image, sky).flux[0].to_value(u.uJy))
    assert_allclose(fluxes, 20 / 0.97, rtol=5e-3)
    assert_allclose(fluxes[:2], fluxes[2], rtol=1e-6)
    # positions may be a file beside the image, and FILTER alone is a band that no other camera has
    path = tmp_path / "image.fits"
    image.header["FILTER"] = "F770W"
    image.write(path, hdu_uncertainty="ERR")
    QTable({"id": [7], "ra": sky.ra, "dec": sky.dec}).write(tmp_path / "catalog.fits")
    photometer = ForcedPhotometer(psf=tmp_path / "psf.fits", filter="F770W", background_order=0)
    with pytest.warns(PSFWarning, match="is taken to hold 0.8"):
        result = photometer.measure(path, tmp_path / "catalog.fits")
    assert result.table["id"].tolist() == [7]
    catalog = tmp_path / "catalog.fits"
    for k, places in enumerate(([path, "--catalog", catalog], [path, catalog])):
        output = tmp_path / f"table-{k}.ecsv"
        with pytest.warns(PSFWarning, match="is taken to hold 0.8.*fluxes are 1.14"):
            command(capsys, "photometry", *places, "--psf", tmp_path / "psf.fits", "-o", output)
        assert_allclose(QTable.read(output)["miri.f770w"], result.flux, rtol=1e-6)
    kernel = MatchingKernel.identity(model)
    refuses("'filter' must be given with 'psf'", ForcedPhotometer, kernel, filter="F770W")


def test_an_image_without_noise_asks_for_its_uncertainty(images, psfs, sky):
    image = images[0].copy()
    y, x = np.mgrid[:96, :96]
    # a Gaussian, which is not quite 0 anywhere
    image.data = np.exp(-0.5 * ((x - 48.0) ** 2 + (y - 48.0) ** 2) / 4)
    image.uncertainty = None
    message = "must be an image with noise that can be measured, or with an uncertainty"
    refuses(f"'image' {message}", ForcedPhotometer(psf=psfs["psf"]).measure, image, sky)
    photometer = ForcedPhotometer(**psfs)
    sharp = images[1].copy()
    sharp.data = np.where(sharp.data > 0.1, sharp.data, 0.0)
    sharp.uncertainty = None
    labels = (sharp.data > 0).astype(int)
    refuses(f"'highres' {message}", photometer.measure, images[0], sharp, labels)
