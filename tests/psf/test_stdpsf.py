"""Grids of PSFs in the format that photutils reads."""

import astropy.units as u
import numpy as np
import pytest
from numpy.testing import assert_allclose
from photutils.psf import GriddedPSFModel

from helpers.errors import refuses
from miricigale.psf import gaussian_psf, psf_grid


def grid(oversampling, positions):
    widths = np.linspace(0.2, 0.3, len(positions)) * u.arcsec
    psfs = [
        gaussian_psf(
            width, pixel_scale=0.11 * u.arcsec, fov=2 * u.arcsec, oversampling=oversampling
        )
        for width in widths
    ]
    return psf_grid(psfs, positions)


POSITIONS = [(9, 19), (99, 19), (9, 199), (99, 199), (9, 399), (99, 399)]


def test_photutils_reads_the_grid_with_its_values(tmp_path):
    ours = grid(4, POSITIONS)
    ours.write_stdpsf(tmp_path / "g.fits")
    theirs = GriddedPSFModel.read(tmp_path / "g.fits", format="stdpsf")
    assert_allclose(theirs.grid_xypos, ours.grid_xypos)
    yy, xx = np.mgrid[190:211, 40:61]
    for model in (theirs, ours):
        model.x_0, model.y_0, model.flux = 50.3, 200.6, 1.0
    assert_allclose(theirs(xx, yy), ours(xx, yy), rtol=1e-6)
    with pytest.raises(OSError, match="exist"):
        ours.write_stdpsf(tmp_path / "g.fits")


def test_what_the_format_cannot_hold_is_refused(tmp_path):
    path = tmp_path / "g.fits"
    refuses("'oversampling' must be 4 for STDPSF", grid(3, POSITIONS).write_stdpsf, path)
    refuses(
        "whole pixels for STDPSF", grid(4, [(1.5, 2), (9, 2), (1.5, 9), (9, 9)]).write_stdpsf, path
    )
