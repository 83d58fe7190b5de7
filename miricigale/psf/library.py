"""PSFs by name: the nine MIRI imaging filters, WFC3/IR mosaics."""

import functools
import math

import astropy.units as u
import numpy as np
from scipy.optimize import brentq

from miricigale.filters import Filter
from miricigale.instrument import aperture, pixel_to_v2v3
from miricigale.psf import _core
from miricigale.psf.effects import (
    EFFECTS,
    cruciform,
    cruciform_fraction,
    cruciform_shift,
    detector_response,
)
from miricigale.psf.model import make_psf
from miricigale.psf.optics import hst_pupil, jwst_constants, jwst_pupil, polychromatic_psf
from miricigale.refdata import citations
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.units import ANGLE, WAVE, to_array

__all__ = [
    "MIRI_FILTERS",
    "MIRI_PIXEL_SCALE",
    "WFC3_FILTERS",
    "hst_psf",
    "local_pixel",
    "miri_psf",
    "odd_cells",
]

#: Geometric mean of the imager's pixel, 0.110498 x 0.111336 arcsec (SIAF, MIRIM_FULL).
MIRI_PIXEL_SCALE = math.sqrt(0.110498 * 0.111336) * u.arcsec

MIRI_FILTERS = tuple(f"miri.f{n}w" for n in (560, 770, 1000, 1130, 1280, 1500, 1800, 2100, 2550))
WFC3_FILTERS = ("wfc3.f105w", "wfc3.f125w", "wfc3.f140w", "wfc3.f160w")

#: Width of the WFC3/IR pixel in arcsec and of the drop relative to it in the mosaics.
_WFC3_PIXEL, _WFC3_PIXFRAC = 0.128, 0.8

#: Extra blur that in-flight images ask for: 0.03 arcsec rms in radius, here per axis.
_IN_FLIGHT_BLUR = {"miri.f560w": 0.03 / math.sqrt(2)}


def filter_name(filter_, known):
    """The name of a filter that has a PSF, out of the known ones."""
    name = filter_ if isinstance(filter_, str) else getattr(filter_, "name", None)
    if name not in known:
        raise unknown_name("PSF for the filter", name, known)
    return name


@functools.lru_cache(maxsize=64)
def band_quantiles(name, n, spectral_index=0.0):
    """
    Wavelengths of equal weight that stand for a band.

    The photon rate of a source with ``F_nu ~ nu**spectral_index`` is cut into ``n``
    equal parts; each is represented by its median.

    Parameters
    ----------
    name : str
        Name of the filter.
    n : int
        Number of wavelengths.
    spectral_index : float, optional
        Index of the spectrum.

    Returns
    -------
    wavelengths : `~numpy.ndarray`, shape (n,)
        In um, ascending, read-only.
    """
    band = Filter.from_name(name)
    wave = to_array(band.wave, WAVE, "wave")
    rate = np.asarray(band.throughput, dtype=float) * wave ** (-1.0 - spectral_index)
    total = np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(wave))])
    inside = np.concatenate([[True], np.diff(total) > 0])
    result = np.interp((np.arange(n) + 0.5) / n, total[inside] / total[-1], wave[inside])
    result.flags.writeable = False
    return result


def odd_cells(width, cell):
    """Odd number of cells that covers a width, nearest to it."""
    return 2 * round(0.5 * width / cell - 0.5) + 1


def checked_grid(oversampling, fov, default):
    """Cells per pixel and width in arcsec of a PSF's grid."""
    if isinstance(oversampling, float) or oversampling < 1:
        raise argument_error("oversampling", "a positive integer", oversampling)
    width = default if fov is None else float(to_array(fov, ANGLE, "fov"))
    if not width > 0:
        raise argument_error("fov", "positive", fov)
    return int(oversampling), width


@functools.lru_cache(maxsize=4)
def _miri_optics(name, cell, n, rms, seed, n_wavelengths, index, n_pupil):
    pupil = jwst_pupil(n_pupil)
    opd = pupil.wavefront_error(rms, seed=seed)
    waves = band_quantiles(name, n_wavelengths, index)
    data = polychromatic_psf(pupil, opd, waves, step=cell, n=n)
    data.flags.writeable = False
    return data


def local_pixel(x, y, *, subarray="FULL"):
    """
    The pixel at a position of the imager, as the distortion has it.

    Parameters
    ----------
    x, y : float
        0-based position in the sub-array.
    subarray : str, optional
        One of `~miricigale.instrument.subarrays`.

    Returns
    -------
    jacobian : `~numpy.ndarray`, shape (2, 2)
        Arcsec along the axes of the ideal plane (parity of an image of the sky, +y at
        V3IdlYAngle from V3) per pixel: its columns are the sides of the pixel.

    Raises
    ------
    ValueError
        If the position is not on the sub-array.
    """
    part = aperture(subarray)
    ny, nx = part.shape
    if not (-0.5 <= x <= nx - 0.5 and -0.5 <= y <= ny - 0.5):
        raise argument_error("position", f"on the {nx} x {ny} pixels of {subarray}", (x, y))
    half = 0.5 * np.array([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]])
    v2, v3 = pixel_to_v2v3(x + half[0], y + half[1], subarray=subarray)
    a = math.radians(part.v3_ideal_y_angle)
    ideal_x = part.parity * (math.cos(a) * v2 - math.sin(a) * v3)
    ideal_y = math.sin(a) * v2 + math.cos(a) * v3
    return np.array([[i[0] - i[1], i[2] - i[3]] for i in (ideal_x, ideal_y)])


def _distorted_optics(map_, oversampling, n, cell, *optics):
    """The optics' image on cells that are parallelograms: ``map_`` of the nominal cell."""
    # fine enough for splines between the samples at the shortest wavelength
    finer = math.ceil(4 / oversampling)
    # in coarse steps, so that places share one image of the optics
    widening = math.ceil(np.abs(map_).sum(axis=1).max() * 50) / 50
    reach = max(widening, 1.02) * (n // 2) * finer
    n_fine = 2 * (math.ceil(reach) + 12) + 1
    fine = _miri_optics(optics[0], cell / finer, n_fine, *optics[1:])
    axis = (np.arange(n) - n // 2) * float(finer)
    x = map_[0, 0] * axis + map_[0, 1] * axis[:, None] + n_fine // 2
    y = map_[1, 0] * axis + map_[1, 1] * axis[:, None] + n_fine // 2
    return _core.interpolate(fine, x, y) * abs(np.linalg.det(map_)) * finer**2


@functools.lru_cache(maxsize=24)
def _miri_data(
    name,
    oversampling,
    fov,
    rms,
    seed,
    includes,
    calibration,
    n_wavelengths,
    index,
    n_pupil,
    position=None,
):
    scale = MIRI_PIXEL_SCALE.value
    cell = scale / oversampling
    # light scattered in from just beyond the edge: two pixels more than asked for
    margin = 2 * oversampling
    n = odd_cells(fov, cell) + 2 * margin
    optics = (rms, seed, n_wavelengths, index, n_pupil)
    shift = (0.0, 0.0)
    if position is None:
        data = _miri_optics(name, cell, n, *optics)
    else:
        x, y, subarray = position
        map_ = local_pixel(x, y, subarray=subarray) / scale
        data = _distorted_optics(map_, oversampling, n, cell, name, *optics)
        scale *= math.sqrt(abs(np.linalg.det(map_)))
        corner = aperture(subarray).origin
        shift = cruciform_shift(x + corner[0], y + corner[1])
    constants = jwst_constants()
    jitter = 0.0
    if "jitter" in includes:
        extra = _IN_FLIGHT_BLUR.get(name, 0.0) if calibration == "flight" else 0.0
        jitter = math.hypot(constants["jitter"], extra) / scale
    if "cruciform" in includes:
        data = cruciform(
            data, name, oversampling=oversampling, calibration=calibration, shift=shift
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


def miri_psf(
    filter,
    *,
    oversampling=4,
    fov=None,
    wavefront_error=75 * u.nm,
    seed=1,
    includes=EFFECTS,
    calibration="flight",
    n_wavelengths=9,
    spectral_index=0.0,
    n_pupil=384,
    position=None,
    subarray="FULL",
):
    """
    PSF of the MIRI imager, from the telescope's pupil.

    Matrix Fourier transforms of the segmented pupil with a random wavefront error, summed
    over the filter's band, then what the detector does to it.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`
        One of the nine imaging filters, such as ``"miri.f770w"``.
    oversampling : int, optional
        Cells per pixel.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; 21 arcsec by default. Light beyond it is missing from the data,
        and the sum says so.
    wavefront_error : `~astropy.units.Quantity`, optional
        Root mean square of the wavefront error.
    seed : int, optional
        Seed of the wavefront; the same telescope in all filters.
    includes : iterable of str, optional
        What is applied, out of ``"jitter"``, ``"cruciform"``, ``"pixel"`` and ``"ipc"``.
        Whoever simulates with the PSF must not apply these again.
    calibration : {"flight", "stpsf"}, optional
        With ``"flight"``, F560W gets twice the cruciform of stpsf and, as part of the
        jitter, a blur of 0.03 arcsec (rms of the radius; 0.021 per axis).
    n_wavelengths : int, optional
        Wavelengths per band, of equal weight.
    spectral_index : float, optional
        The source's spectrum is ``F_nu ~ nu**spectral_index``.
    n_pupil : int, optional
        Cells across the pupil.
    position : tuple of float, optional
        Where on the array, 0-based pixels x, y: the image is then sampled by the pixel
        that the distortion makes there (its sides, turn and shear) and the cruciform's
        centre shifted as stars in flight have it. Without a position the pixel is square
        and the cruciform centred, as at about (598, 511) of the full frame.
    subarray : str, optional
        Whose pixels ``position`` counts, one of `~miricigale.instrument.subarrays`.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the detector frame (+x, +y along the columns and rows; V3 lies 4.84 deg
        clockwise of +y), pixel 0.11092 arcsec: the geometric mean of the true
        0.1105 x 0.1113, or that of the pixel at ``position``. The sum of the data is
        ``oversampling**2`` times the fraction of light on the grid. The core's centroid is
        the middle cell. The meta has the entries of `~miricigale.psf.make_psf` and
        ``filter``, ``wavefront_error`` (nm), ``seed``, ``calibration``,
        ``cruciform_fraction``, ``citations``; with a position also ``position`` and
        ``subarray``.

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
    >>> psf.meta["frame"], psf.meta["includes"]
    ('detector', ['jitter', 'cruciform', 'pixel', 'ipc'])
    """
    name = filter_name(filter, MIRI_FILTERS)
    oversampling, width = checked_grid(oversampling, fov, 21.0)
    unknown = set(includes) - set(EFFECTS)
    if unknown:
        raise argument_error("includes", f"out of {EFFECTS}", sorted(unknown))
    if isinstance(n_wavelengths, float) or n_wavelengths < 1:
        raise argument_error("n_wavelengths", "a positive integer", n_wavelengths)
    rms = float(to_array(wavefront_error, u.nm, "wavefront_error"))
    # written order, whatever the caller's
    effects = tuple(effect for effect in EFFECTS if effect in includes)
    place = {}
    if position is not None:
        place = {"position": tuple(float(v) for v in position), "subarray": subarray}
    data, scale = _miri_data(
        name,
        oversampling,
        width,
        rms,
        int(seed),
        effects,
        calibration,
        int(n_wavelengths),
        float(spectral_index),
        int(n_pupil),
        (*place["position"], subarray) if place else None,
    )
    scattered = cruciform_fraction(name, calibration=calibration) if "cruciform" in effects else 0.0
    return make_psf(
        data,
        pixel_scale=scale * ANGLE,
        oversampling=oversampling,
        frame="detector",
        includes=effects,
        filter=name,
        instrument="MIRI",
        wavefront_error=rms,
        seed=int(seed),
        calibration=calibration,
        cruciform_fraction=scattered,
        citations=citations("psf.jwst_pupil"),
        normalization="total",
        **place,
    )


@functools.lru_cache(maxsize=8)
def _hst_optics(name, cell, n, n_wavelengths, angle):
    pupil = hst_pupil(angle=angle)
    waves = band_quantiles(name, n_wavelengths)
    data = polychromatic_psf(pupil, np.zeros((pupil.n, pupil.n)), waves, step=cell, n=n)
    data.flags.writeable = False
    return data


def _hst_blurred(data, oversampling, scale, sigma):
    boxes = (_WFC3_PIXEL / scale, _WFC3_PIXEL * _WFC3_PIXFRAC / scale)
    return detector_response(data, oversampling=oversampling, boxes=boxes, jitter=sigma / scale)


@functools.lru_cache(maxsize=16)
def _hst_blur(name, fwhm, scale, n_wavelengths):
    """Gaussian sigma in arcsec with which the mosaic's PSF has the width asked for."""
    oversampling = max(1, math.ceil(scale / 0.015))
    cell = scale / oversampling
    middle = odd_cells(2.4, cell) // 2
    data = _hst_optics(name, cell, 2 * middle + 1, n_wavelengths, 45.0)

    def excess(sigma):
        image = _hst_blurred(data, oversampling, scale, sigma)
        return _core.half_maximum_width(image, middle, middle) * cell - fwhm

    sharpest = fwhm + excess(0.0)
    if sharpest > fwhm:
        wanted = f"at least the {sharpest:.4f} arcsec that optics and pixels alone have"
        raise argument_error("fwhm", wanted, f"{fwhm} arcsec")
    return brentq(excess, 0.0, fwhm, xtol=1e-5)


def hst_psf(
    filter="wfc3.f160w",
    *,
    pixel_scale=0.06 * u.arcsec,
    fwhm=None,
    oversampling=4,
    fov=None,
    n_wavelengths=9,
    angle=0.0 * u.deg,
):
    """
    PSF of a north-up WFC3/IR mosaic.

    The annular pupil with its vanes over the band, the detector's pixel (0.128 arcsec),
    the drop (0.8 of it), the mosaic's pixel, and a Gaussian for all else (interpixel
    capacitance, jitter, registration), so wide that the FWHM is the one asked for.

    Parameters
    ----------
    filter : str or `~miricigale.filters.Filter`, optional
        A WFC3/IR filter.
    pixel_scale : `~astropy.units.Quantity`, optional
        Pixel of the mosaic.
    fwhm : `~astropy.units.Quantity`, optional
        Of the mosaic's PSF. By default 0.20 arcsec at F160W, and in other filters what
        the same blur gives.
    oversampling : int, optional
        Cells per mosaic pixel.
    fov : `~astropy.units.Quantity`, optional
        Width of the grid; 10 arcsec by default.
    n_wavelengths : int, optional
        Wavelengths per band, of equal weight.
    angle : `~astropy.units.Quantity`, optional
        Position angle of the telescope's +y; the vanes are at 45 deg to it.

    Returns
    -------
    psf : `~photutils.psf.ImagePSF`
        In the sky frame, normalised as `miri_psf`.

    Raises
    ------
    KeyError
        If there is no such filter.
    ValueError
        If the FWHM is below what optics and pixels have.

    References
    ----------
    Krist, Hook & Stoehr 2011, SPIE 8127, 81270J; Skelton et al. 2014, ApJS 214, 24
    (mosaics of 0.06 arcsec pixels).
    """
    name = filter_name(filter, WFC3_FILTERS)
    oversampling, width = checked_grid(oversampling, fov, 10.0)
    scale = float(to_array(pixel_scale, ANGLE, "pixel_scale"))
    if fwhm is None:
        sigma = _hst_blur("wfc3.f160w", 0.20, scale, n_wavelengths)
    else:
        target = float(to_array(fwhm, ANGLE, "fwhm"))
        sigma = _hst_blur(name, target, scale, n_wavelengths)
    cell = scale / oversampling
    # vanes at 45 deg to +y; on the sky an angle east of north is counter-clockwise
    vane = (45.0 + float(to_array(angle, u.deg, "angle"))) % 360.0
    data = _hst_optics(name, cell, odd_cells(width, cell), n_wavelengths, vane)
    data = _hst_blurred(data, oversampling, scale, sigma) * oversampling**2
    return make_psf(
        data,
        pixel_scale=pixel_scale,
        oversampling=oversampling,
        frame="sky",
        includes=("pixel", "ipc", "jitter", "drizzle"),
        filter=name,
        instrument="WFC3/IR",
        blur=sigma,
        normalization="total",
        telescope_angle=float(to_array(angle, u.deg, "angle")),
    )
