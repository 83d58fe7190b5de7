"""PSFs of the nine MIRI imaging filters."""

import math

import astropy.units as u
import numpy as np

from miricigale.filters.band_names import known_filter
from miricigale.instrument import aperture, pixel_to_v2v3
from miricigale.psf import _core
from miricigale.psf.effects import (
    EFFECTS,
    cruciform,
    cruciform_fraction,
    cruciform_shift,
    detector_response,
    halo_share,
)
from miricigale.psf.model import make_psf
from miricigale.psf.optics import jwst_constants
from miricigale.psf.telescope import Telescope, checked_grid, odd_cells
from miricigale.utils.caching import cached
from miricigale.utils.options import check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE

#: Geometric mean of the imager's pixel, 0.110498 x 0.111336 arcsec (SIAF, MIRIM_FULL).
MIRI_PIXEL_SCALE = math.sqrt(0.110498 * 0.111336) * u.arcsec

#: V3IdlYAngle of the imager in deg (SIAF, MIRIM_FULL).
_V3_ANGLE = 4.83544897

MIRI_FILTERS = tuple(f"miri.f{n}w" for n in (560, 770, 1000, 1130, 1280, 1500, 1800, 2100, 2550))

#: Extra blur that in-flight images ask for: 0.03 arcsec rms in radius, here per axis.
_IN_FLIGHT_BLUR = {"miri.f560w": 0.03 / math.sqrt(2)}


def local_pixel(x, y, *, subarray="FULL"):
    """
    Return the pixel at a 0-based position of a sub-array, as the distortion has it.

    The Jacobian, (2, 2), in arcsec along the axes of the ideal plane (parity of an image of the sky, +y at
    V3IdlYAngle from V3) per pixel: its columns are the sides of the pixel.

    Raises
    ------
    ValueError
        If the position is not on the sub-array.
    """
    part = aperture(subarray)
    ny, nx = part.shape
    good = -0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5
    check_that(good, "position", f"on the {nx} x {ny} pixels of {subarray}", (x, y))
    half = 0.5 * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    v2, v3 = pixel_to_v2v3(x + half[0], y + half[1], subarray=subarray)
    a = math.radians(part.v3_ideal_y_angle)
    ideal_x = part.parity * (math.cos(a) * v2 - math.sin(a) * v3)
    ideal_y = math.sin(a) * v2 + math.cos(a) * v3
    return np.array([[i[0] - i[1], i[2] - i[3]] for i in (ideal_x, ideal_y)])


def _distorted_optics(telescope, map_, oversampling, n, cell):
    """Return the optics' image on cells that are parallelograms: ``map_`` of the nominal cell."""
    # fine enough for splines between the samples at the shortest wavelength
    finer = math.ceil(4 / oversampling)
    # in coarse steps, so that places share one image of the optics
    widening = math.ceil(np.abs(map_).sum(axis=1).max() * 50) / 50
    reach = max(widening, 1.02) * (n // 2) * finer
    n_fine = 2 * (math.ceil(reach) + 12) + 1
    fine = telescope.image(cell / finer, n_fine)
    axis = (np.arange(n) - n // 2) * float(finer)
    x = map_[0, 0] * axis + map_[0, 1] * axis[:, None] + n_fine // 2
    y = map_[1, 0] * axis + map_[1, 1] * axis[:, None] + n_fine // 2
    return _core.interpolate(fine, x, y) * abs(np.linalg.det(map_)) * finer**2


@cached(maxsize=24)
def _miri_data(telescope, oversampling, fov, includes, calibration, position=None):
    """Return the data and pixel (arcsec) of a PSF; ``position`` is (x, y, sub-array)."""
    name = telescope.filter
    scale = MIRI_PIXEL_SCALE.value
    cell = scale / oversampling
    # light scattered in from just beyond the edge: two pixels more than asked for
    margin = 2 * oversampling
    n = odd_cells(fov, cell) + 2 * margin
    shift = (0.0, 0.0)
    if position is None:
        data = telescope.image(cell, n)
    else:
        x, y, subarray = position
        map_ = local_pixel(x, y, subarray=subarray) / scale
        data = _distorted_optics(telescope, map_, oversampling, n, cell)
        scale *= math.sqrt(abs(np.linalg.det(map_)))
        corner = aperture(subarray).origin
        shift = cruciform_shift(x + corner[0], y + corner[1])
    constants = jwst_constants()
    jitter = 0.0
    if "jitter" in includes:
        extra = 0.0
        if calibration == "flight":
            extra = _IN_FLIGHT_BLUR.get(name, 0.0)
        jitter = math.hypot(constants["jitter"], extra) / scale
    if "cruciform" in includes:
        data = cruciform(
            data, name, shift=shift, oversampling=oversampling, calibration=calibration
        )
    data = detector_response(
        data,
        oversampling=oversampling,
        pixel="pixel" in includes,
        ipc=tuple(constants["ipc"]) if "ipc" in includes else None,
        jitter=jitter,
    )
    data = data[margin:-margin, margin:-margin] * oversampling**2
    data.flags.writeable = False
    return data, scale


@takes_other_keywords
def miri_psf(
    filter,
    *,
    oversampling=4,
    fov=None,
    wavefront_error=75 * u.nm,
    seed=1,
    includes=EFFECTS,
    calibration="flight",
    position=None,
    subarray="FULL",
):
    """
    Return the PSF of the MIRI imager, from the telescope's pupil.

    Matrix Fourier transforms of the segmented pupil with a random wavefront error, summed
    over the filter's band (nine wavelengths of equal photon rate of a source of constant F_nu), then
    what the detector does to it.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`
        One of the nine imaging filters, such as ``"miri.f770w"``.
    oversampling : int, optional
        Cells per pixel.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; 21 arcsec by default. Light beyond it is missing from the data,
        and from their sum.
    wavefront_error : `~astropy.units.Quantity`, optional
        Root mean square of the wavefront error.
    seed : int, optional
        Seed of the wavefront; the same telescope in all filters.
    includes : iterable of str, optional
        What is applied, out of ``"jitter"``, ``"cruciform"``, ``"pixel"`` and ``"ipc"``.
        A simulation with the PSF must not apply these again.
    calibration : {"flight", "stpsf"}, optional
        With ``"flight"``, F560W scatters twice the light of stpsf's cruciform, 35 % of it into a
        diffuse halo, and gets, as part of the jitter, a blur of 0.03 arcsec (rms of the
        radius; 0.021 per axis).
    position : tuple of float, optional
        Where on the array, 0-based pixels x, y: the image is then sampled by the pixel
        that the distortion makes there (its sides, turn and shear) and the cruciform's
        center shifted as stars in flight have it. Without a position the pixel is square
        and the cruciform centered, as at about (598, 511) of the full frame.
    subarray : str, optional
        Whose pixels ``position`` counts, one of `~miricigale.instrument.subarrays`.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the detector frame (+x, +y along the columns and rows; V3 lies 4.84 deg
        clockwise of +y), pixel 0.11092 arcsec: the geometric mean of the true
        0.1105 x 0.1113, or that of the pixel at ``position``. The sum of the data is
        ``oversampling**2`` times the fraction of light on the grid. The core's centroid is
        the middle cell. The meta has ``wavefront_error`` (nm), ``seed``, ``calibration``,
        ``cruciform_fraction`` (all light that the detector scatters), ``halo_fraction`` (of it,
        the diffuse part) and ``citations``.

    Raises
    ------
    KeyError
        If there is no such filter.
    ValueError
        If an option is out of its range.

    References
    ----------
    Soummer et al. 2007, Optics Express 15, 15935; Perrin et al. 2014, Proc. SPIE 9143,
    91433X; Gaspar et al. 2021, PASP 133, 014504 (cruciform).

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.psf import miri_psf
    >>> psf = miri_psf("miri.f1500w", fov=8 * u.arcsec, oversampling=2)
    >>> psf.frame, psf.includes
    ('detector', ('jitter', 'cruciform', 'pixel', 'ipc'))
    """
    name = known_filter(filter, MIRI_FILTERS, "PSF for the filter")
    oversampling, width = checked_grid(oversampling, fov, 21.0)
    unknown = set(includes) - set(EFFECTS)
    check_that(not unknown, "includes", f"out of {EFFECTS}", sorted(unknown))
    telescope = Telescope.of(name, _V3_ANGLE, wavefront_error, seed)
    # written order, whatever the caller's
    effects = tuple(effect for effect in EFFECTS if effect in includes)
    place = None
    if position is not None:
        place = (*map(float, position), subarray)
    data, scale = _miri_data(telescope, oversampling, width, effects, calibration, place)
    scattered = 0.0
    if "cruciform" in effects:
        scattered = cruciform_fraction(name, calibration=calibration)
    meta = {
        "instrument": "MIRI",
        "calibration": calibration,
        "cruciform_fraction": scattered,
        "halo_fraction": scattered * halo_share(name, calibration=calibration),
    }
    form = {"pixel_scale": scale * ANGLE, "oversampling": oversampling, "frame": "detector"}
    form |= {"filter": name, "total_known": True, "meta": {**telescope.meta, **meta}}
    form |= {"position": position, "subarray": None if position is None else subarray}
    return make_psf(data, includes=effects, **form)
