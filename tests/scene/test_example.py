"""The field of the examples holds what it says, and measuring it gives it back."""

import astropy.units as u
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from helpers.errors import refuses
from miricigale.photometry import ForcedPhotometer
from miricigale.scene import example_field


def test_forced_photometry_gives_the_truth_back():
    field = example_field(["F444W", "f770w"], size=15 * u.arcsec, seed=3)
    assert list(field.images) == ["nircam.f444w", "miri.f770w"]
    image, psf = field.images["miri.f770w"], field.psfs["miri.f770w"]
    result = ForcedPhotometer(psf=psf, highres_psf=field.psfs["nircam.f444w"], template="sersic")
    result = result.measure(image, field.images["nircam.f444w"], catalog=field.truth)
    rows = {name: k for k, name in enumerate(field.truth["id"])}
    true = field.truth["miri.f770w"][[rows[name] for name in result.id]]
    usable = np.isfinite(result.flux.value) & (result.snr > 10)
    assert usable.sum() >= 5
    pulls = ((result.flux - true) / result.flux_err).value[usable]
    assert abs(np.median(pulls)) < 1


def test_noise_is_that_of_the_depth_of_candels():
    """5 sigma at 27.6 AB in F160W, in an aperture of 0.2 arcsec in radius (Stefanon et al. 2017)."""
    image = example_field(["wfc3.f160w"], size=10 * u.arcsec).images["wfc3.f160w"]
    pixel = 0.06 * u.arcsec
    sigma = (np.median(image.uncertainty.array) * image.unit * pixel**2).to(u.uJy)
    n_pixels = np.pi * (0.2 * u.arcsec / pixel).to_value(u.one) ** 2
    limit = (5 * sigma * np.sqrt(n_pixels)).to_value(u.ABmag)
    assert abs(limit - 27.6) < 0.01
    # and the sky between the sources scatters so
    faint = image.data[image.data < np.median(image.data)]
    below = np.median(image.data) - faint
    assert_allclose(np.median(below) * 1.4826, np.median(image.uncertainty.array), rtol=0.25)


def test_one_seed_one_field():
    one, two = (example_field(["F770W"], size=5 * u.arcsec) for _ in range(2))
    assert_array_equal(one.images["miri.f770w"].data, two.images["miri.f770w"].data)
    refuses("'size' must be 1 to 120 arcsec", example_field, size=10 * u.arcmin)
