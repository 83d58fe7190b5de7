"""PSFs from stpsf, STScI's own PSF simulator (optional)."""

import os

import numpy as np

from miricigale.filters.band_names import band_label
from miricigale.psf.effects import EFFECTS
from miricigale.psf.field import psf_at
from miricigale.psf.miri import MIRI_PIXEL_SCALE
from miricigale.psf.model import InstrumentPSF, PSFGrid
from miricigale.utils.exceptions import DataError
from miricigale.utils.optional_packages import require
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, to_array


def _instrument(filter_name):
    if "STPSF_PATH" not in os.environ:
        msg = "stpsf needs its data files: set the environment variable STPSF_PATH to their folder"
        raise DataError(msg)
    stpsf = require("stpsf", extra="stpsf")
    try:
        instrument = stpsf.MIRI()
    except (OSError, RuntimeError) as err:
        # no folder, no version.txt, or data of another version than stpsf asks for
        msg = f"stpsf cannot use the data of STPSF_PATH: {str(err).splitlines()[0]}"
        raise DataError(msg) from err
    instrument.filter = band_label(str(filter_name))
    return instrument


@takes_other_keywords
def stpsf_grid(filter, *, n_psfs=1, oversampling=4, fov=10.0 * ANGLE, position=None):
    """
    Return the PSFs of the MIRI imager over the field, from stpsf.

    Parameters
    ----------
    filter : str
        Such as ``"miri.f770w"``.
    n_psfs : int, optional
        A square number of positions.
    oversampling : int, optional
        Cells per pixel.
    fov : `~astropy.units.Quantity`, optional
        Width of the grids.
    position : (float, float), optional
        Of a single PSF on the detector (x, y in pixels); the middle by default. Grids of more are even.

    Returns
    -------
    grid : `~miricigale.psf.PSFGrid`
        `~miricigale.psf.psf_at` and `~miricigale.scene.Scene` take it. The pixel is the same all
        over the field.

    Raises
    ------
    ImportError
        If stpsf is not installed; the message says how to.
    `~miricigale.utils.exceptions.DataError`
        If ``STPSF_PATH`` is not set.

    References
    ----------
    Perrin et al. 2014, Proc. SPIE 9143, 91433X.

    Examples
    --------
    >>> from miricigale.psf import stpsf_grid
    >>> grid = stpsf_grid("miri.f770w", n_psfs=9)  # doctest: +SKIP
    """
    check_that(round(n_psfs**0.5) ** 2 == n_psfs, "n_psfs", "a square number", n_psfs)
    instrument = _instrument(filter)
    if position is not None:
        instrument.detector_position = position
    pixels = to_array(fov, ANGLE, "fov") / MIRI_PIXEL_SCALE.value
    grid = instrument.psf_grid(
        num_psfs=int(n_psfs),
        all_detectors=False,
        oversample=int(oversampling),
        fov_pixels=2 * int(np.ceil(pixels / 2)) + 1,
        nlambda=9,
        verbose=False,
        single_psf_centered=position is None,
    )
    name = f"miri.{str(filter).removeprefix('miri.').lower()}"
    facts = {
        "pixel_scale": MIRI_PIXEL_SCALE,
        "frame": "detector",
        "oversampling": int(oversampling),
    }
    facts |= {"includes": EFFECTS, "filter": name, "total_known": True}
    facts["meta"] = {"instrument": "MIRI", "source": "stpsf"}
    psfs = [InstrumentPSF(np.asarray(data), **facts) for data in grid.data]
    return PSFGrid(psfs, grid.grid_xypos)


@takes_other_keywords(options_of=(stpsf_grid,))
def stpsf_psf(filter, *, x=515.0, y=511.0, **options):
    """
    Return the PSF of the MIRI imager at one position of the detector, from stpsf.

    Parameters
    ----------
    filter : str
        Such as ``"miri.f770w"``.
    x, y : float, optional
        Position on the detector in pixels.
    **options
        Those of `stpsf_grid`. With ``n_psfs`` of 4 or more it is interpolated in the grid.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the detector frame, with jitter, cruciform, pixel and interpixel capacitance.
        stpsf keeps the light that the cruciform scatters out of its grid inside of it.

    Examples
    --------
    >>> from miricigale.psf import stpsf_psf
    >>> psf = stpsf_psf("miri.f770w", x=200, y=800)  # doctest: +SKIP
    """
    grid = stpsf_grid(filter, position=(x, y), **options)
    return psf_at(grid, x, y)
