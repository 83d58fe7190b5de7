"""PSFs of others' files: one reader for the class and the command."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits

from helpers.errors import refuses
from miricigale.photometry import MosaicFile
from miricigale.photometry.commands.kernel_files import image_psf
from miricigale.psf import MatchingKernel, make_psf, read_psf
from miricigale.psf.files import PSFFile, core_position, header_grid
from miricigale.utils.exceptions import DataError, PSFWarning

CELL = 0.05
FWHM = 0.3


def gaussian(n=81, dx=0.0, dy=0.0, fwhm=FWHM):
    """A round Gaussian of unit sum, off the middle by some cells."""
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    sigma = fwhm / CELL / 2.3548
    data = np.exp(-((x - dx) ** 2 + (y - dy) ** 2) / (2 * sigma**2))
    return data / data.sum()


@pytest.fixture
def mosaic(tmp_path):
    """An image whose filter has no model PSF."""
    header = fits.Header(
        {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 53.1, "CRVAL2": -27.8}
    )
    header.update(CRPIX1=20.5, CRPIX2=20.5, CDELT1=-CELL / 3600, CDELT2=CELL / 3600, BUNIT="MJy/sr")
    fits.PrimaryHDU(np.zeros((40, 40), np.float32), header).writeto(tmp_path / "image.fits")
    return tmp_path / "image.fits"


def test_class_and_command_find_the_core_of_a_psf_off_center(mosaic, tmp_path):
    path = tmp_path / "psf.fits"
    fits.PrimaryHDU(gaussian(dx=1.4, dy=-0.7), fits.Header({"PIXSCALE": CELL})).writeto(path)
    by_class = read_psf(path)
    by_command = image_psf(MosaicFile(mosaic, psf=path, filter="irac.ch1"))
    for psf in (by_class, by_command):
        assert psf.fwhm.to_value(u.arcsec) == pytest.approx(FWHM, rel=0.01)
    np.testing.assert_allclose(by_class.origin, (41.4, 39.3), atol=0.02)
    # where files of PSFs are named, with an extension too
    fits.PrimaryHDU(gaussian(fwhm=0.4), fits.Header({"PIXSCALE": CELL})).writeto(
        tmp_path / "wide.fits"
    )
    kernel = MatchingKernel.from_psfs(
        f"{path}[0]", str(tmp_path / "wide.fits"), pixel_scale=CELL * u.arcsec
    )
    y, x = np.indices(kernel.array.shape) - kernel.array.shape[0] // 2
    shift = [(kernel.array * axis).sum() * CELL for axis in (x, y)]
    np.testing.assert_allclose(shift, 0, atol=0.002)


def test_planes_of_a_cube_are_averaged_with_their_cores_in_one_place(mosaic, tmp_path):
    path = tmp_path / "dithers.fits"
    cube = np.stack([gaussian(dx=1.2, dy=-0.4), gaussian(dx=-0.8, dy=0.6)])
    fits.PrimaryHDU(cube, fits.Header({"PIXSCALE": CELL})).writeto(path)
    place = f"{path}[0,mean]"
    for psf in (read_psf(place), image_psf(MosaicFile(mosaic, psf=place, filter="irac.ch1"))):
        assert psf.fwhm.to_value(u.arcsec) == pytest.approx(FWHM, rel=0.01)
        np.testing.assert_allclose(psf.origin, (40.2, 40.1), atol=0.02)
        np.testing.assert_allclose(psf.data, gaussian(dx=0.2, dy=0.1), atol=1e-3 * psf.data.max())


def test_statements_about_a_psf_of_our_own_are_refused(mosaic, tmp_path):
    """Its file has the pixel and the angle."""
    path = tmp_path / "own.fits"
    make_psf(gaussian(), pixel_scale=CELL * u.arcsec).write(path)
    refuses("'pixel_scale' must be left out", read_psf, path, pixel_scale=CELL * u.arcsec)
    file = MosaicFile(mosaic, psf=path, psf_scale=CELL * u.arcsec, filter="irac.ch1")
    refuses("'psf_scale' must be left out", image_psf, file)


def stpsf_file(path, names):
    """A file in STPSF's layout, each extension of another width (arcsec)."""
    hdus = []
    for k, (name, width) in enumerate(names.items()):
        header = fits.Header({"OVERSAMP": 1, "PIXELSCL": CELL, "EXTNAME": name})
        data = gaussian(fwhm=width)
        hdus.append(fits.PrimaryHDU(data, header) if k == 0 else fits.ImageHDU(data, header))
    fits.HDUList(hdus).writeto(path)
    return path


STPSF = {"OVERSAMP": 0.2, "DET_SAMP": 0.22, "OVERDIST": 0.24, "DET_DIST": 0.26}


@pytest.mark.parametrize(
    ("names", "taken"),
    [
        (list(STPSF), "OVERDIST"),
        (["OVERSAMP", "DET_SAMP", "DET_DIST"], "DET_DIST"),
        (["OVERSAMP", "DET_SAMP"], "OVERSAMP"),
    ],
)
def test_the_extension_with_the_detector_is_taken_and_said(names, taken, mosaic, tmp_path):
    path = stpsf_file(tmp_path / "stpsf.fits", {name: STPSF[name] for name in names})
    file = MosaicFile(mosaic, psf=path, filter="irac.ch1")
    for reader in (lambda: read_psf(path), lambda: image_psf(file)):
        with pytest.warns(PSFWarning, match=f"several images: extension {taken} is taken"):
            psf = reader()
        assert psf.fwhm.to_value(u.arcsec) == pytest.approx(STPSF[taken], rel=0.02)


def test_brackets_name_an_extension_everywhere(mosaic, tmp_path):
    path = stpsf_file(tmp_path / "stpsf.fits", STPSF)
    for place in (f"{path}[3]", f"{path}[DET_DIST]"):
        file = MosaicFile(mosaic, psf=place, filter="irac.ch1")
        for psf in (read_psf(place), image_psf(file)):
            assert psf.fwhm.to_value(u.arcsec) == pytest.approx(0.26, rel=0.02)
    refuses("no such extension", read_psf, f"{path}[9]", error=DataError)


@pytest.mark.parametrize("oversampling", [2.5, 0, "four"])
def test_oversampling_of_a_header_is_a_whole_number(oversampling, tmp_path):
    path = tmp_path / "psf.fits"
    header = fits.Header({"OVERSAMP": oversampling, "PIXELSCL": CELL})
    fits.writeto(path, np.ones((9, 9)), header)
    refuses("which is no whole number of 1 or more", read_psf, path, error=DataError)


def test_planes_of_a_cube_are_named(tmp_path):
    path = tmp_path / "cube.fits"
    cube = np.stack([gaussian(fwhm=0.2), gaussian(fwhm=0.4)])
    fits.PrimaryHDU(cube, fits.Header({"PIXSCALE": CELL})).writeto(path)
    refuses(r"say FILE\[EXTENSION,PLANE\]", read_psf, path, error=DataError)
    assert read_psf(f"{path}[0,1]").fwhm.to_value(u.arcsec) == pytest.approx(0.4, rel=0.02)
    mean = read_psf(f"{path}[0,mean]")
    np.testing.assert_allclose(mean.data, cube.mean(axis=0), atol=1e-12)
    assert PSFFile.open(f"{path}[0,mean]").planes.shape == cube.shape
    # a cube of one plane is an image
    fits.PrimaryHDU(cube[:1], fits.Header({"PIXSCALE": CELL})).writeto(tmp_path / "single.fits")
    assert read_psf(tmp_path / "single.fits").fwhm.to_value(u.arcsec) == pytest.approx(
        0.2, rel=0.02
    )


def test_the_grid_of_a_psf_with_declination_first():
    angle = np.radians(25.0)
    cd = CELL / 3600 * np.array([[-np.cos(angle), np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for names, rows in ((("RA---TAN", "DEC--TAN"), cd), (("DEC--TAN", "RA---TAN"), cd[::-1])):
        header = fits.Header(
            {"NAXIS": 2, "NAXIS1": 41, "NAXIS2": 41, "CTYPE1": names[0], "CTYPE2": names[1]}
        )
        values = {"RA---TAN": 53.1, "DEC--TAN": -27.8}
        header.update(CRVAL1=values[names[0]], CRVAL2=values[names[1]], CRPIX1=21, CRPIX2=21)
        for i in range(2):
            for j in range(2):
                header[f"CD{i + 1}_{j + 1}"] = rows[i, j]
        np.testing.assert_allclose(header_grid(header), (CELL, 25.0), rtol=1e-6)


def test_the_core_is_that_of_the_brightest_peak():
    data = gaussian(dx=2.3, dy=-1.1) + 0.5 * gaussian(dx=30, dy=30)
    np.testing.assert_allclose(core_position(data), (42.3, 38.9), atol=0.02)


def _on_sky(tmp_path, width, height, **keywords):
    """A PSF with pixels of a width and height in arcsec."""
    header = fits.Header({"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"} | keywords)
    header.update(CD1_1=-width / 3600, CD2_2=height / 3600, CD1_2=0.0, CD2_1=0.0)
    fits.PrimaryHDU(gaussian(), header).writeto(tmp_path / "sky.fits", overwrite=True)
    return tmp_path / "sky.fits"


def test_pixels_that_are_not_square_are_refused(tmp_path):
    match = "square pixels, .* got 0.05 by 0.06 arcsec"
    refuses(match, read_psf, _on_sky(tmp_path, 0.05, 0.06))
    # the rounding of a header is none
    assert read_psf(_on_sky(tmp_path, 0.05, 0.0501)).fwhm.to_value(u.arcsec) == pytest.approx(
        FWHM, rel=0.01
    )


def test_two_scales_in_one_header_are_warned_of(tmp_path):
    path = _on_sky(tmp_path, CELL, CELL, PIXELSCL=0.1)
    with pytest.warns(PSFWarning, match=r"0.05 arcsec \(world coordinates\) and of 0.1 \(PIXELSCL"):
        assert read_psf(path).fwhm.to_value(u.arcsec) == pytest.approx(FWHM, rel=0.01)
    header = fits.Header({"PIXELSCL": CELL, "PIXSCALE": 0.06})
    fits.PrimaryHDU(gaussian(), header).writeto(path, overwrite=True)
    with pytest.warns(PSFWarning, match=r"\(PIXELSCL\) and of 0.06 \(PIXSCALE\)"):
        read_psf(path)


def test_a_psf_of_few_pixels_is_refused(tmp_path):
    header = fits.Header({"PIXSCALE": CELL})
    fits.PrimaryHDU(gaussian(3), header).writeto(tmp_path / "p.fits")
    refuses(r"has \(3, 3\) pixels, a PSF needs 4", read_psf, tmp_path / "p.fits", error=DataError)
