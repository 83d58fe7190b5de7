"""Errors of an image with correlated noise: closed forms, empty apertures of a real image, and the command."""

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable
from numpy.testing import assert_allclose
from photutils.aperture import ApertureStats, CircularAperture
from scipy.signal import fftconvolve

from helpers.errors import refuses
from helpers.light import gaussian_image
from miricigale.cli import main
from miricigale.instrument import north_up_wcs, pixel_area_map
from miricigale.photometry import image_errors, read_mosaic
from miricigale.psf import make_psf

SCALE = 0.1


def test_errors_on_drizzled_white_noise_are_those_of_the_kernel(tools):
    """Each weighted sum of white noise drizzled with a kernel has the variance of the weights through it."""
    rng, shape = np.random.default_rng(4), (900, 900)
    # a drop of 1.5 pixels about each, and noise that is twice as large in one half
    drop = np.outer(*[[0.25, 1.0, 0.25]] * 2) / 2.25
    sigma = np.where(np.arange(900) < 450, 0.02, 0.04) * np.ones(shape)
    data = sigma * fftconvolve(rng.normal(size=shape), drop, "same")
    wcs = north_up_wcs(tools.CENTER, SCALE * u.arcsec, shape)
    stated = 0.5 * sigma
    image = tools.as_ccd(data, wcs, 1.0, mask=rng.random(shape) < 0.02)
    image.uncertainty.array[...] = stated
    psf = make_psf(gaussian_image(41, 2.0), pixel_scale=SCALE * u.arcsec, frame="sky", enclosed=1.0)
    diameters = [0.5, 1.2]
    found = image_errors(image, diameters=diameters * u.arcsec, psf=psf, n_sigma=3, seed=1)
    pixel = np.median(pixel_area_map(wcs, shape)) * 1e12
    profile = gaussian_image(41, 2.0) / gaussian_image(41, 2.0).sum()
    weights = {"psf": profile / np.sum(profile**2)}
    for diameter in diameters:
        circle = CircularAperture((20, 20), diameter / 2 / SCALE).to_mask(method="exact")
        weights[f"{diameter:g}"] = circle.to_image((41, 41))
    for row in found.table:
        weight = weights[row["aperture"]]
        error = pixel * np.sqrt(np.sum(fftconvolve(weight, drop) ** 2))
        for half, noise in ((np.s_[40:860, 40:400], 0.02), (np.s_[40:860, 500:860], 0.04)):
            limit = np.nanmedian(found.limits[row["aperture"]][half].to_value(u.uJy))
            assert limit == pytest.approx(3 * noise * error, rel=0.03)
        white = pixel * 0.5 * np.sqrt(np.sum(weight**2))
        assert row["factor"] == pytest.approx(error / white, rel=0.03)
        assert row["scatter"] == pytest.approx(1, abs=0.06)
        light = np.sum(weight * profile) if row["aperture"] != "psf" else 1.0
        assert row["enclosed"] == pytest.approx(light, abs=1e-3)
    # sums over many pixels, over those of white noise of the same size
    assert found.factor == pytest.approx(drop.sum() / np.sqrt(np.sum(drop**2)), rel=0.03)
    assert found.table.meta["noise_over_stated"] == pytest.approx(
        2 * np.sum(drop**2) ** 0.5, rel=0.02
    )
    refuses("'diameters' must be positive", image_errors, image, diameters=[0.0] * u.arcsec)


@pytest.mark.pictures
@pytest.mark.slow
def test_the_command_states_what_empty_apertures_of_a_real_image_scatter_by(
    data_file, tmp_path, capsys
):
    uds = data_file("uds")
    start, output = f"{uds}/uds-test-f770w_", tmp_path / "errors.fits"
    command = ["errors", f"{start}sci.fits.gz", "--weight", f"{start}wht.fits.gz", "--filter", "F770W",
               "--psf", f"{uds}/psf/uds-test-f770w_psf.fits.gz[0,mean]", "-o", str(output)]  # fmt: skip
    with pytest.warns(UserWarning, match="noise on the sky is 2.. times what the weight map says"):
        assert main([*command, "--apertures", "0.4", "0.8"]) == 0
    table = QTable.read(tmp_path / "errors.ecsv")
    assert list(table["aperture"]) == ["psf", "0.4", "0.8"]
    # each pixel is there four times
    assert np.all(table["factor"] > 3.5)
    assert "Errors of uds-test-f770w_sci.fits.gz" in (tmp_path / "errors.html").read_text()
    with pytest.warns(UserWarning, match="noise on the sky"):
        image = read_mosaic(f"{start}sci.fits.gz", weight=f"{start}wht.fits.gz", filter="F770W")
    labels = fits.getdata(f"{uds}/uds-test-LW_seg.fits.gz")
    busy = fftconvolve(((labels > 0) | image.mask).astype(float), np.ones((25, 25)), "same") > 0.5
    y, x = np.nonzero(~busy)
    chosen = np.random.default_rng(2).permutation(len(x))[:1500]
    area = pixel_area_map(image.wcs, image.shape) * 1e12
    with fits.open(output) as maps:
        for row in table[1:]:
            circles = CircularAperture(
                np.stack([x, y], axis=1)[chosen], float(row["aperture"]) / 0.08
            )
            sums = ApertureStats(image.data * area, circles).sum
            limit = maps[f"LIMIT_{row['aperture']}"].data[y[chosen], x[chosen]]
            pulls = 5 * (sums - np.median(sums)) / limit
            assert 1.4826 * np.median(np.abs(pulls)) == pytest.approx(1, abs=0.08)
    assert main([*command]) == 2
    assert "--output must be a new file" in capsys.readouterr().err
    assert_allclose(table["stated"] * table["factor"], table["error"])
