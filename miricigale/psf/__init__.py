"""
Point spread functions as photutils models, and the kernels between them.

Every PSF says in its ``meta`` what it includes, its pixel scale, its frame and angle.
"""

from miricigale.psf._stpsf import stpsf_grid, stpsf_psf
from miricigale.psf.effects import EFFECTS, cruciform_fraction
from miricigale.psf.energy import (
    encircled_energy,
    fwhm,
    psf_table,
    radius_of_encircled_energy,
)
from miricigale.psf.field import grid_weights, miri_psf_grid, psf_at, psf_grid
from miricigale.psf.kernels import REGULARIZATIONS, MatchingKernel
from miricigale.psf.library import MIRI_PIXEL_SCALE, hst_psf, miri_psf
from miricigale.psf.model import PSFInfo, from_photutils, make_psf, psf_info, read_psf
from miricigale.psf.optics import Pupil, hst_pupil, jwst_pupil
from miricigale.psf.resample import average_psf, psf_image, psf_mosaic, rotate_psf
from miricigale.psf.shapes import gaussian_psf, moffat_psf
from miricigale.psf.stars import psf_from_stars

__all__ = [
    "EFFECTS",
    "MIRI_PIXEL_SCALE",
    "REGULARIZATIONS",
    "MatchingKernel",
    "PSFInfo",
    "Pupil",
    "average_psf",
    "cruciform_fraction",
    "encircled_energy",
    "from_photutils",
    "fwhm",
    "gaussian_psf",
    "grid_weights",
    "hst_psf",
    "hst_pupil",
    "jwst_pupil",
    "make_psf",
    "miri_psf",
    "miri_psf_grid",
    "moffat_psf",
    "psf_at",
    "psf_from_stars",
    "psf_grid",
    "psf_image",
    "psf_info",
    "psf_mosaic",
    "psf_table",
    "radius_of_encircled_energy",
    "read_psf",
    "rotate_psf",
    "stpsf_grid",
    "stpsf_psf",
]
