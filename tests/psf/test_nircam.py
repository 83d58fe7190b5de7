import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose

from miricigale.psf import encircled_energy, fwhm, nircam_psf, psf_mosaic, read_psf


# in flight (jwst-docs, NIRCam Point Spread Functions); the pixel's response is a part of ours
@pytest.mark.parametrize(
    ("name", "published"),
    [("f115w", 0.040), ("f150w", 0.050), ("f200w", 0.066), ("f277w", 0.092), ("f356w", 0.116)]
    + [("f444w", 0.145)],
)
def test_width_is_that_in_flight(name, published):
    psf = nircam_psf(f"nircam.{name}", fov=2 * u.arcsec)
    width = fwhm(psf, method="gaussian").to_value(u.arcsec)
    assert width / published == pytest.approx(1.045, abs=0.035)


def test_energy_is_that_of_drizzled_psfs(data_file):
    """PRIMER-UDS, F444W on pixels of 0.04 arcsec."""
    path = data_file("uds/psf/uds-test-f444w_psf.fits.gz")
    radii = [0.15, 0.2, 0.3, 0.5, 0.8, 1.2, 1.6] * u.arcsec
    scale = 0.04 * u.arcsec
    # planes whose cores stand within 0.2 pixel of the center
    real = [
        encircled_energy(read_psf(path, plane=k, pixel_scale=scale, frame="sky"), radii)
        for k in (9, 15, 19)
    ]
    ours = encircled_energy(psf_mosaic(nircam_psf("nircam.f444w"), scale, 0 * u.deg), radii)
    assert_allclose(ours, np.mean(real, axis=0), atol=0.03)


def test_is_centered_normalized_and_says_what_it_is():
    psf = nircam_psf("nircam.f200w", oversampling=3, seed=4)
    assert psf.data.argmax() == psf.data.size // 2
    assert psf.pixel_scale.value == 0.031
    assert (psf.frame, psf.includes, psf.total_known) == ("detector", ("jitter", "pixel"), True)
    assert 0.97 < psf.enclosed < 1
    # wings fall as r**-3: the light outside of a radius as its inverse
    outside = 1 - encircled_energy(psf, [1.0, 2.0] * u.arcsec)
    assert outside[0] / outside[1] == pytest.approx(2, abs=0.35)
