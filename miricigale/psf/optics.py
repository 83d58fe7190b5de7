"""Pupils, wavefronts and the light of a point source in the focal plane."""

import math
import tomllib

import numpy as np

from miricigale.psf import _core
from miricigale.refdata import locate
from miricigale.utils.arrays import centered
from miricigale.utils.caching import cached
from miricigale.utils.options import check_least, check_that
from miricigale.utils.parallel import single_threaded
from miricigale.utils.random import stream
from miricigale.utils.units import frozen_array
from miricigale.utils.values import value_class

#: One arcsecond in rad.
ARCSEC = math.pi / 180 / 3600

#: Share of the variance of a wavefront error that is in terms of single segments.
_SEGMENT_FRACTION = 0.6

#: Radius of HST's central obscuration over that of the pupil. That of the telescope is 0.33; with 0.40 the
#: light in the first ring agrees with STScI's empirical PSFs of WFC3/IR at F160W, whose cold mask is larger.
_HST_OBSCURATION = 0.40

#: Lines per pupil cell along y at which outlines are sampled.
_ROWS = 8


@value_class
class Pupil:
    """
    A pupil on a square grid, seen so that its axes are those of the image.

    Parameters
    ----------
    amplitude : `~numpy.ndarray`, shape (n, n)
        Transmission of each cell, 0 to 1, edges anti-aliased.
    segments : `~numpy.ndarray` of int, shape (n, n)
        Number of the mirror segment from 1; 0 outside.
    diameter : float
        Side of the grid in m.
    angle : float
        Angle of the telescope's own y axis from the image's y axis, clockwise, in deg.

    Examples
    --------
    >>> import numpy as np
    >>> from miricigale.psf import jwst_pupil
    >>> pupil = jwst_pupil(128)
    >>> opd = pupil.wavefront_error(75, seed=1)
    >>> light = pupil.amplitude > 0.5
    >>> print(f"{pupil.diameter:.2f} m, {opd[light].std():.0f} nm")
    6.62 m, 75 nm
    """

    amplitude: np.ndarray
    segments: np.ndarray
    diameter: float
    angle: float = 0.0

    def __post_init__(self):
        segments = frozen_array(self.segments, dtype=np.int16)
        self.__dict__.update(amplitude=frozen_array(self.amplitude), segments=segments)

    @property
    def n(self):
        """Cells per side."""
        return self.amplitude.shape[0]

    @property
    def step(self):
        """Side of a cell in m."""
        return self.diameter / self.n

    def wavefront_error(self, rms, *, seed=1):
        """
        Draw a wavefront error for the pupil.

        Piston, tip, tilt and focus of every segment, and defocus, astigmatism, coma,
        trefoil and spherical aberration of the whole; overall piston and tilt removed.
        The draw does not depend on the grid or on the image's orientation beyond the
        fineness of the grid.

        Parameters
        ----------
        rms : float
            In nm, over the pupil.
        seed : int, optional
            The same seed gives the same telescope at every wavelength.

        Returns
        -------
        opd : `~numpy.ndarray`, shape (n, n)
            Optical path difference in nm.

        Raises
        ------
        ValueError
            If ``rms`` is negative.
        """
        check_least(rms, "rms", 0)
        if rms == 0:
            return np.zeros_like(self.amplitude)
        axis = centered(self.n) * 2 / self.n
        v, u = np.meshgrid(axis, axis, indexing="ij")
        # back to the telescope's frame, so that the error turns with the telescope
        a = math.radians(self.angle)
        x = -u * math.cos(a) + v * math.sin(a)
        y = u * math.sin(a) + v * math.cos(a)
        rng = stream(seed, "psf", "wavefront")
        return _core.wavefront(self.amplitude, self.segments, x, y, rms, _SEGMENT_FRACTION, rng)


@cached
def jwst_constants():
    """The telescope's outlines and MIRI's couplings, from ``psf.jwst_pupil``; see its comments for units."""
    return tomllib.loads(locate("psf.jwst_pupil").read_text())


def _to_image(vertices, angle):
    """
    Turn (V2, V3) outlines to the image's axes.

    An image of the sky has V2 to the left where V3 is up (parity -1); V3 lies ``angle``
    deg clockwise of the image's +y.
    """
    a = math.radians(angle)
    v2, v3 = np.asarray(vertices, dtype=float).T
    return np.ascontiguousarray(
        np.stack([-v2 * math.cos(a) + v3 * math.sin(a), v2 * math.sin(a) + v3 * math.cos(a)], 1)
    )


@cached(maxsize=8)
def jwst_pupil(n=384, *, angle=4.83544897):
    """
    Return the entrance pupil of JWST as an image-plane axis sees it.

    Parameters
    ----------
    n : int, optional
        Cells per side.
    angle : float, optional
        V3IdlYAngle in deg: V3 lies that far clockwise of the detector's +y axis. The
        default is MIRI's (SIAF, MIRIM_FULL).

    Returns
    -------
    pupil : `Pupil`

    Raises
    ------
    ValueError
        If ``n`` is too small to resolve the struts.

    Examples
    --------
    >>> from miricigale.psf import jwst_pupil
    >>> pupil = jwst_pupil(128)
    >>> pupil.amplitude.shape, int(pupil.segments.max())
    ((128, 128), 18)
    """
    check_least(n, "n", 64)
    constants = jwst_constants()
    # corners of the B segments reach the circle in the telescope's frame only
    diameter = constants["diameter"] * 1.002
    step = diameter / n
    amplitude = np.zeros((n, n))
    segments = np.zeros((n, n), dtype=np.int16)
    best = np.zeros((n, n))
    for index, vertices in enumerate(constants["segments"].values(), start=1):
        covered = _core.polygon_coverage(_to_image(vertices, angle), n, step, _ROWS)
        amplitude += covered
        mine = covered > best
        segments[mine], best[mine] = index, covered[mine]
    blocked = np.zeros((n, n))
    for vertices in constants["struts"].values():
        covered = _core.polygon_coverage(_to_image(vertices, angle), n, step, _ROWS)
        blocked = np.maximum(blocked, covered)
    amplitude *= 1 - blocked
    return Pupil(np.minimum(amplitude, 1.0), segments, diameter, angle)


def _circle(radius, x=0.0, y=0.0, corners=720):
    # a polygon of the circle's own area
    t = 2 * np.pi * np.arange(corners) / corners
    r = radius * math.sqrt(2 * np.pi / corners / math.sin(2 * np.pi / corners))
    return np.stack([x + r * np.cos(t), y + r * np.sin(t)], axis=1)


@cached(maxsize=8)
def hst_pupil(n=256, *, angle=45.0):
    """
    Return the pupil of HST with its central obscuration, four vanes and three pads.

    Parameters
    ----------
    n : int, optional
        Cells per side.
    angle : float, optional
        Angle of a vane from the image's +y axis in deg.

    Returns
    -------
    pupil : `Pupil`

    Notes
    -----
    2.4 m, vanes 0.022 and pads 0.065 of the radius, the geometry of the Optical Telescope
    Assembly.

    References
    ----------
    Krist, Hook & Stoehr 2011, SPIE 8127, 81270J (Tiny Tim).

    Examples
    --------
    >>> from miricigale.psf import hst_pupil
    >>> pupil = hst_pupil(128)
    >>> print(f"{pupil.diameter:.2f} m across, {pupil.amplitude.mean():.2f} of the grid open")
    2.40 m across, 0.64 of the grid open
    """
    diameter = 2.4
    radius = 0.5 * diameter
    step = diameter / n
    amplitude = _core.polygon_coverage(_circle(radius), n, step, _ROWS)
    segments = (amplitude > 0).astype(np.int16)
    amplitude *= 1 - _core.polygon_coverage(_circle(_HST_OBSCURATION * radius), n, step, _ROWS)
    half = 0.011 * radius
    blocked = np.zeros((n, n))
    for k in range(2):
        a = math.radians(angle + 90 * k)
        along = np.array([-math.sin(a), math.cos(a)])
        across = np.array([math.cos(a), math.sin(a)])
        s, t = np.array([[-1, -1, 1, 1], [-1, 1, 1, -1]])[..., None]
        corners = s * radius * along + t * half * across
        blocked = np.maximum(blocked, _core.polygon_coverage(corners, n, step, _ROWS))
    turn = math.radians(angle - 45.0)
    for px, py in ((0.8921, 0.0), (-0.4615, 0.7555), (-0.4564, -0.7606)):
        x = radius * (px * math.cos(turn) - py * math.sin(turn))
        y = radius * (px * math.sin(turn) + py * math.cos(turn))
        pad = _core.polygon_coverage(_circle(0.065 * radius, x, y, 90), n, step, _ROWS)
        blocked = np.maximum(blocked, pad)
    return Pupil(amplitude * (1 - blocked), segments, diameter, 0.0)


def _center(pupil, opd, wavelength):
    """Return the offset of the image's core from the axis in rad (Gaussian-weighted centroid)."""
    scale = wavelength / pupil.diameter
    grid = np.linspace(-4, 4, 65) * scale
    function = pupil.amplitude * np.exp(2j * np.pi * opd / wavelength)
    image = _core.matrix_dft_intensity(function, pupil.step, wavelength, grid, grid)
    x = 0.0
    y = 0.0
    for _ in range(20):
        wx = np.exp(-0.5 * ((grid - x) / (0.6 * scale)) ** 2)
        wy = np.exp(-0.5 * ((grid - y) / (0.6 * scale)) ** 2)
        weighted = image * wy[:, None] * wx
        total = weighted.sum()
        # twice the step: for a core as wide as the window this converges at once
        dx = 2 * (np.sum(weighted.sum(0) * grid) / total - x)
        dy = 2 * (np.sum(weighted.sum(1) * grid) / total - y)
        x = x + dx
        y = y + dy
        if math.hypot(dx, dy) < 1e-5 * scale:
            break
    return x, y


def polychromatic_psf(pupil, opd, wavelengths, *, step, n):
    """
    Return the light of a point source summed over a band, before any detector, as a fraction in each cell, (n, n).

    Parameters
    ----------
    pupil : `Pupil`
        The pupil in the axes of the image.
    opd : `~numpy.ndarray`, shape (n_pupil, n_pupil)
        Optical path difference in nm.
    wavelengths : `~numpy.ndarray`, shape (m,)
        In um, of equal weight.
    step : float
        Side of an image cell in arcsec.
    n : int
        Cells per side, odd; the core's centroid stands on the middle one.

    Raises
    ------
    ValueError
        If ``n`` is even or the grid is wider than the transform's period.
    """
    check_that(n % 2 != 0, "n", "odd", n)
    wavelengths = np.asarray(wavelengths, float) * 1e-6
    opd = np.asarray(opd, float) * 1e-9
    period = wavelengths.min() / pupil.step / ARCSEC
    wanted = f"an image below {period:.1f} arcsec (a finer pupil allows more)"
    check_that(n * step <= period, "n", wanted, f"{n} x {step:.4g} arcsec = {n * step:.1f} arcsec")
    weight = 1.0 / wavelengths.size
    mean = float(np.average(wavelengths, weights=np.full(wavelengths.size, weight)))
    axis = (np.arange(n) - (n - 1) // 2) * step * ARCSEC
    image = np.zeros((n, n))
    power = float(pupil.amplitude.sum())
    across = centered(pupil.n) * pupil.step
    # the same bits on any number of cores
    with single_threaded():
        # the core goes to the middle by a tilt: one matrix then serves both axes
        shift = _center(pupil, opd, mean)
        path = opd - shift[0] * across - shift[1] * across[:, None]
        for wavelength in wavelengths:
            function = pupil.amplitude * np.exp(2j * np.pi * path / wavelength)
            image += weight * _core.matrix_dft_intensity(
                function, pupil.step, wavelength, axis, axis, power=power
            )
    return image
