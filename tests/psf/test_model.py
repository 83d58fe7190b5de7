"""A PSF keeps what is known of it through copies, pickles and files."""

import copy
import pickle

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io.registry import IORegistryError
from numpy.testing import assert_array_equal
from photutils.psf import ImagePSF

from helpers.errors import refuses
from miricigale.psf import (
    InstrumentPSF,
    KernelField,
    MatchingKernel,
    encircled_energy,
    gaussian_psf,
    instrument_psf,
    make_psf,
    miri_psf,
    miri_psf_grid,
    psf_at,
)
from miricigale.utils.exceptions import DataError

PSF = miri_psf("miri.f770w", fov=3 * u.arcsec, oversampling=2, position=(100, 200))
TURNED = make_psf(
    PSF.data, pixel_scale=PSF.pixel_scale, frame="sky", angle=30 * u.deg, oversampling=2,
    enclosed=0.9, includes=("pixel",), meta={"file": "a.fits", "n": 3}, pa_aper=4 * u.deg,
)  # fmt: skip


def same(one, other):
    assert type(one) is type(other)
    assert_array_equal(one.data, other.data)
    assert one.facts == other.facts
    assert one.meta == other.meta


@pytest.mark.parametrize("psf", [PSF, TURNED])
def test_copies_pickles_and_files_keep_all(psf, tmp_path):
    psf.write(tmp_path / "psf.fits")
    for one in (
        copy.copy(psf), copy.deepcopy(psf), psf.copy(), psf.deepcopy(),
        pickle.loads(pickle.dumps(psf)), InstrumentPSF.read(tmp_path / "psf.fits"), psf.replace(),
    ):  # fmt: skip
        same(one, psf)
        assert one(0.3, 0.4) == psf(0.3, 0.4)
    refuses("overwrite", psf.write, tmp_path / "psf.fits", error=OSError)
    refuses(r"\.ecsv must end in", psf.write, tmp_path / "psf.ecsv", error=IORegistryError)
    MatchingKernel(np.eye(3), 0.1 * u.arcsec).write(tmp_path / "kernel.fits")
    refuses("holds no PSFs", InstrumentPSF.read, tmp_path / "kernel.fits", error=DataError)


def test_grids_are_copied_and_pickled():
    grid = miri_psf_grid("miri.f1500w", n_psfs=4, fov=3 * u.arcsec, oversampling=2)
    for one in (copy.deepcopy(grid), grid.copy(), pickle.loads(pickle.dumps(grid))):
        same(psf_at(one, 300, 700), psf_at(grid, 300, 700))
        assert one.filter == "miri.f1500w"


def test_a_plain_model_of_photutils_lacks_its_pixel():
    plain = ImagePSF(TURNED.data, oversampling=2)
    refuses("pixels of known size, .*from_photutils", encircled_energy, plain, 1 * u.arcsec)
    assert instrument_psf(PSF) is PSF


def test_fields_of_kernels_are_copied_pickled_and_written(tmp_path):
    kind = {"pixel_scale": 0.06 * u.arcsec, "fov": 2 * u.arcsec}
    sharp, *wide = (gaussian_psf(width * u.arcsec, **kind) for width in (0.2, 0.4, 0.5))
    kernels = [MatchingKernel.from_psfs(sharp, psf) for psf in wide]
    field = KernelField(kernels, SkyCoord([53.0, 53.1], [-27.0, -27.0], unit="deg"), "nearest")
    field.write(tmp_path / "field.fits")
    places = SkyCoord([53.01, 53.09], [-27.0, -27.01], unit="deg")
    for one in (
        copy.deepcopy(field), pickle.loads(pickle.dumps(field)),
        KernelField.read(tmp_path / "field.fits"),
    ):  # fmt: skip
        assert_array_equal(one.weights(places), field.weights(places))
        for mine, theirs in zip(one.kernels, field.kernels, strict=True):
            assert_array_equal(mine.array, theirs.array)
            assert_array_equal(mine.matched, theirs.matched)
            assert mine.regularization == theirs.regularization
            assert mine.meta["max_error"] == theirs.meta["max_error"]
            assert mine.pixel_scale == theirs.pixel_scale
