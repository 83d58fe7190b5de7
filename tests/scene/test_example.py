"""The field of the examples holds what it says, and measuring it gives it back."""

import astropy.units as u
import numpy as np
from numpy.testing import assert_array_equal

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


def test_one_seed_one_field():
    one, two = (example_field(["F770W"], size=5 * u.arcsec) for _ in range(2))
    assert_array_equal(one.images["miri.f770w"].data, two.images["miri.f770w"].data)
    refuses("'size' must be 1 to 120 arcsec", example_field, size=10 * u.arcmin)
