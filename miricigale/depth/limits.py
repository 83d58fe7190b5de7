"""How faint a point source an exposure reaches through an aperture: the closed form."""

import itertools

import astropy.units as u
import numpy as np
from astropy.table import QTable
from photutils.aperture import CircularAnnulus, CircularAperture

from miricigale.depth.noise import ExposureNoise, noise_power, pattern_amplitude
from miricigale.depth.published import etc_setup, scaled_limit
from miricigale.instrument import frame_time, imager_filters
from miricigale.psf import MIRI_PIXEL_SCALE, instrument_psf, miri_psf, psf_image
from miricigale.utils.exceptions import argument_error
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_least, check_positive, check_that
from miricigale.utils.units import ANGLE, SURFACE_BRIGHTNESS, TIME, to_array

# positions of the source's center within the pixel, per axis, over which is averaged
_PHASES = (np.arange(4) + 0.5) / 4 - 0.5


def extraction_weights(radius, annulus=None, *, offset=(0.0, 0.0)):
    """
    Weight of each pixel, (n, n) with n odd, in the flux: aperture less the sky of the annulus.

    Overlap of pixel and circle, and in the annulus minus the ratio of the areas. Radii are in
    pixels; ``annulus`` is None if the sky is known, ``offset`` that of the center from the middle
    pixel's, x, y.
    """
    half = int(np.ceil(max(radius, *(annulus or (0.0,))))) + 2
    center = (half + offset[0], half + offset[1])
    shape = (2 * half + 1, 2 * half + 1)
    weights = CircularAperture(center, radius).to_mask(method="exact").to_image(shape)
    if annulus is not None:
        sky = CircularAnnulus(center, *annulus).to_mask(method="exact").to_image(shape)
        weights = weights - sky * (weights.sum() / sky.sum())
    return weights


def _radii(aperture, annulus, setup):
    """Radii in arcsec, checked."""
    radius = setup.radius if aperture is None else aperture
    radius = float(to_array(radius, ANGLE, "aperture", ndim=0, finite=True))
    check_that(0 < radius < 8, "aperture", "between 0 and 8 arcsec", aperture)
    if annulus is None:
        return radius, None
    edges = to_array(annulus, ANGLE, "annulus", ndim=1, finite=True)
    wanted = "an inner and outer radius outside the aperture, up to 10 arcsec"
    check_that(edges.size == 2 and radius <= edges[0] < edges[1] <= 10, "annulus", wanted, annulus)
    return radius, (float(edges[0]), float(edges[1]))


def _extraction(radius, annulus, psf, correlation, filter):
    """Light in the extraction and noise powers, means over positions within the pixel."""
    psf = instrument_psf(psf)
    have = psf.filter
    # other packages write F770W where we write miri.f770w
    if isinstance(have, str) and have.lower().rpartition(".")[2] != filter.rpartition(".")[2]:
        raise argument_error("psf", f"one of the filter {filter}", f"one of {have}")
    check_that("pixel" in psf.includes, "psf", "a PSF that includes the pixel", psf.includes)
    scale = MIRI_PIXEL_SCALE.value
    edges = None if annulus is None else tuple(edge / scale for edge in annulus)
    values = []
    for offset in itertools.product(_PHASES, _PHASES):
        weights = extraction_weights(radius / scale, edges, offset=offset)
        share = psf_image(psf, pixel_scale=MIRI_PIXEL_SCALE, shape=weights.shape, offset=offset)
        light, shot = np.sum(weights * share), np.sum(weights**2 * share)
        values.append((light, noise_power(weights), shot, noise_power(weights, correlation)))
    return np.mean(values, axis=0)


def aperture_noise(
    filter,
    time=1e4 * u.s,
    *,
    n_sigma=10.0,
    aperture=None,
    annulus=None,
    background=None,
    residual=None,
    correlation=1.0,
    n_dithers=1,
    n_groups=None,
    readout="FASTR1",
    subarray="FULL",
    psf=None,
    detector=None,
):
    """
    Noise and light in a circular aperture, and the flux of the point source that is measured there.

    Photon noise of sky, dark current and source, read noise of optimally fitted ramps, and,
    if asked for, a residual pattern, summed in the aperture.

    Parameters
    ----------
    filter : str
        One of `~miricigale.instrument.imager_filters`.
    time : `~astropy.units.Quantity`, optional
        Total exposure time, all dithers.
    n_sigma : float, optional
        Flux over its error.
    aperture : `~astropy.units.Quantity`, optional
        Radius; that of the exposure time calculator's own limits by default
        (`etc_setup`).
    annulus : `~astropy.units.Quantity`, shape (2,), optional
        Inner and outer radius of a sky annulus whose mean is taken off. By default the sky is
        known, as in those limits.
    background : `~astropy.units.Quantity`, optional
        Surface brightness of sky and telescope; the low background by default.
    residual : str, float or None, optional
        Fraction of the sky that stays as a fixed pattern
        (`~miricigale.detector.Residual`), or ``"etc"``
        (`residual_amplitude`). It does not average down with time.
    correlation : float, optional
        Gaussian width of the pattern's correlation in pixels.
    n_dithers : int, optional
        Positions over which the time is divided; the pattern averages down with them.
    n_groups : int, optional
        Groups of an integration; those of the calculator's limits by default.
    readout, subarray : str, optional
        As in `~miricigale.instrument.Exposure`.
    psf : `~photutils.psf.ImagePSF`, optional
        PSF with the pixel in it; `~miricigale.psf.miri_psf` by default.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        `~miricigale.instrument.miri_detector` by default.

    Returns
    -------
    values : dict
        ``flux`` and, without the pattern, ``flux_white``; within the extraction the standard
        deviations ``white`` of photons and read noise and ``residual`` of the pattern,
        ``pattern``, that of a pattern of amplitude 1, and ``shot``, the variance for each uJy of
        the source (all uJy); ``light``, the share of the source in it; ``radius`` (arcsec) and
        ``background`` (MJy/sr).

    Raises
    ------
    KeyError
        If a name is not known.
    ValueError
        If a number is out of its range, the time is shorter than one integration or the sky
        fills the well within it.

    Notes
    -----
    Means over the positions of a source within a pixel. Time lost to cosmic rays, resets
    between integrations and bad pixels is not counted. Optimal extraction instead of an
    aperture: `fitted_noise`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.depth import aperture_noise
    >>> found = aperture_noise("F770W", 3000 * u.s, n_sigma=5, residual="etc")
    >>> for name in ("flux", "flux_white", "white", "residual", "light"):
    ...     print(f"{name:10s} {found[name]:.3f}")
    flux       0.165
    flux_white 0.131
    white      0.017
    residual   0.013
    light      0.662
    """
    setup = etc_setup(filter)
    filter = setup.filter  # with the instrument's name, if that was left out
    radius, edges = _radii(aperture, annulus, setup)
    amplitude = pattern_amplitude(residual, filter)
    seconds = float(to_array(time, TIME, "time", ndim=0, finite=True))
    groups = setup.n_groups if n_groups is None else n_groups
    step = frame_time(readout, subarray).to_value(TIME)
    check_positive(n_sigma, "n_sigma")
    check_least(n_dithers, "n_dithers", 1)
    check_least(groups, "n_groups", 2, whole=True)
    check_that(0 <= correlation <= 30, "correlation", "from 0 to 30 pixels", correlation)
    wanted = f"at least one integration of {groups} groups, {groups * step:.4g} s"
    check_that(seconds >= groups * step * (1 - 1e-9), "time", wanted, time)
    noise = ExposureNoise(
        filter=filter,
        background=background,
        n_groups=int(groups),
        group_time=step,
        n_ramps=seconds / (groups * step),
        detector=detector,
        subarray=subarray,
    )
    wanted = "so few that the sky does not fill the well"
    check_that(noise.rate * groups * step < noise.detector.full_well, "n_groups", wanted, groups)
    variance, growth, sky, electrons = noise.variance(), noise.growth, noise.sky, noise.electrons

    psf = miri_psf(filter) if psf is None else psf
    light, white, shot, pattern = _extraction(radius, edges, psf, correlation, filter)
    check_that(light > 0, "annulus", "such that light of the source is left", annulus)
    shot_noise = n_sigma**2 * growth * shot / (light**2 * electrons)
    white_noise = n_sigma**2 * variance * white / (light * electrons) ** 2
    residual_noise = (n_sigma * amplitude * sky / (light * electrons)) ** 2 * pattern / n_dithers

    def limit(known):
        # F^2 = n^2 (V + growth shot F), solved for F
        return float((shot_noise + np.sqrt(shot_noise**2 + 4 * known)) / 2)

    return {
        "flux": limit(white_noise + residual_noise),
        "flux_white": limit(white_noise),
        "radius": radius,
        "light": float(light),
        "background": noise.background.value,
        "white": float(np.sqrt(variance * white) / electrons),
        "residual": float(amplitude * sky * np.sqrt(pattern / n_dithers) / electrons),
        # what a calibration of the amplitude needs, per unit amplitude
        "pattern": float(sky * np.sqrt(pattern / n_dithers) / electrons),
        "shot": float(growth * shot / electrons),
    }


def sensitivity(filter, time=1e4 * u.s, *, n_sigma=10.0, residual=None, **options):
    """
    Flux of the point source that an exposure measures with a given significance.

    Parameters
    ----------
    filter, time, n_sigma, residual, **options
        As for `aperture_noise`, which says what is counted.

    Returns
    -------
    flux : `~astropy.units.Quantity`
        Total flux of the source, uJy.

    Raises
    ------
    KeyError
        If a name is not known.
    ValueError
        If a number is out of its range, the time is shorter than one integration or the sky
        fills the well within it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.depth import sensitivity
    >>> print(f"{sensitivity('miri.f1000w'):.2f}, {sensitivity('miri.f1000w', residual='etc'):.2f}")
    0.32 uJy, 0.47 uJy
    >>> short = {"n_sigma": 5, "residual": "etc", "n_dithers": 3}
    >>> print(f"{sensitivity('miri.f1000w', 1665 * u.s, **short):.2f}")
    0.41 uJy
    """
    found = aperture_noise(filter, time, n_sigma=n_sigma, residual=residual, **options)
    return found["flux"] * u.uJy


#: Columns of `sensitivity_table` by what `aperture_noise` calls them.
_COLUMNS = {"noise": "white", "residual": "residual", "limit_white": "flux_white", "limit": "flux"}


def sensitivity_table(filters=None, time=1e4 * u.s, *, residual="etc", n_sigma=10.0, **options):
    """
    Limits of several filters, compared with those of the exposure time calculator.

    Parameters
    ----------
    filters : iterable of str, optional
        All nine imaging filters by default.
    time, n_sigma, residual, **options
        As for `aperture_noise`.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row per filter: ``radius``, ``light`` (share in the aperture, less the annulus),
        ``background``, ``noise`` and ``residual`` (standard deviations within the
        extraction), ``limit_white`` and ``limit`` without and with the residual, ``etc_40``
        and ``etc_20`` scaled to the time and significance.

    Examples
    --------
    >>> from miricigale.depth import sensitivity_table
    >>> table = sensitivity_table(["miri.f770w", "miri.f2100w"])
    >>> for name in ("limit_white", "limit", "etc_40"):
    ...     table[name].info.format = ".2f"
    >>> print(table["filter", "limit_white", "limit", "etc_40"])
       filter   limit_white limit etc_40
                    uJy      uJy   uJy
    ----------- ----------- ----- ------
     miri.f770w        0.14  0.25   0.25
    miri.f2100w        3.47  4.70   4.70
    """
    if isinstance(filters, str):
        filters = [filters]
    names = imager_filters() if filters is None else list(filters)
    seconds = float(to_array(time, TIME, "time", ndim=0, finite=True))
    rows = []
    for name in names:
        found = aperture_noise(name, time, n_sigma=n_sigma, residual=residual, **options)
        row = {"filter": etc_setup(name).filter, "radius": found["radius"] * ANGLE}
        row |= {"light": found["light"], "background": found["background"] * SURFACE_BRIGHTNESS}
        for column, key in _COLUMNS.items():
            row[column] = found[key] * u.uJy
        for column, version in (("etc_40", "4.0"), ("etc_20", "2.0")):
            row[column] = scaled_limit(name, time, n_sigma=n_sigma, version=version)
        rows.append(row)
    meta = provenance(time=seconds, n_sigma=float(n_sigma), residual=str(residual))
    return QTable(rows, meta=meta)
