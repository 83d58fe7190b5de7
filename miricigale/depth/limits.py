"""How faint a point source an exposure reaches through an aperture: the closed form."""

import itertools

import astropy.units as u
import numpy as np
from astropy.table import QTable
from photutils.aperture import CircularAnnulus, CircularAperture

from miricigale.depth.fitted import fitted_noise, psf_of
from miricigale.depth.noise import ExposureNoise, noise_power, pattern_amplitude
from miricigale.depth.published import etc_setup, scaled_limit
from miricigale.filters import FilterSet
from miricigale.instrument import Exposure, frame_time, frames_per_group, imager_filters
from miricigale.psf import MIRI_PIXEL_SCALE, miri_psf, psf_image
from miricigale.utils.meta import provenance
from miricigale.utils.options import check_choice, check_least, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, SURFACE_BRIGHTNESS, TIME, scalar, to_array

# positions of the source's center within the pixel, per axis, over which is averaged
_PHASES = (np.arange(4) + 0.5) / 4 - 0.5
#: Exposure time to which limits refer unless another is given.
_TIME = 1e4 * u.s


def extraction_weights(radius, annulus=None, *, offset=(0.0, 0.0)):
    """
    Return the weight of each pixel, (n, n) with n odd, in the flux: aperture less the sky of the annulus.

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
    """Return the radii in arcsec, checked."""
    radius = aperture
    if aperture is None:
        radius = setup.radius
    radius = scalar(radius, ANGLE, "aperture")
    check_that(0 < radius < 8, "aperture", "between 0 and 8 arcsec", aperture)
    if annulus is None:
        return radius, None
    edges = to_array(annulus, ANGLE, "annulus", ndim=1, finite=True)
    wanted = "an inner and outer radius outside the aperture, up to 10 arcsec"
    check_that(edges.size == 2 and radius <= edges[0] < edges[1] <= 10, "annulus", wanted, annulus)
    return radius, (float(edges[0]), float(edges[1]))


def _extraction(radius, annulus, psf, correlation, filter):
    """Return the light in the extraction and noise powers, means over positions within the pixel."""
    psf = psf_of(psf, filter)
    scale = MIRI_PIXEL_SCALE.value
    edges = None
    if annulus is not None:
        edges = tuple(edge / scale for edge in annulus)
    values = []
    for offset in itertools.product(_PHASES, _PHASES):
        weights = extraction_weights(radius / scale, edges, offset=offset)
        share = psf_image(psf, pixel_scale=MIRI_PIXEL_SCALE, shape=weights.shape, offset=offset)
        light = np.sum(weights * share)
        shot = np.sum(weights**2 * share)
        values.append((light, noise_power(weights), shot, noise_power(weights, correlation)))
    return np.mean(values, axis=0)


@takes_other_keywords
def aperture_noise(
    filter,
    time=1e4 * u.s,
    *,
    n_sigma=5.0,
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
    Return the noise and light in a circular aperture, and the flux of the point source that is measured there.

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
    seconds = scalar(time, TIME, "time")
    groups = setup.n_groups if n_groups is None else n_groups
    n_frames = frames_per_group(readout)
    step = n_frames * frame_time(readout, subarray).to_value(TIME)
    check_positive(n_sigma, "n_sigma")
    check_least(n_dithers, "n_dithers", 1)
    check_least(groups, "n_groups", 2, whole=True)
    check_that(0 <= correlation <= 30, "correlation", "from 0 to 30 pixels", correlation)
    _check_time(time, groups, step)
    noise = ExposureNoise(
        filter=filter,
        background=background,
        n_groups=int(groups),
        group_time=step,
        n_ramps=seconds / (groups * step),
        detector=detector,
        subarray=subarray,
        n_frames=n_frames,
    )
    _check_well(noise)
    variance, growth, sky, electrons = noise.variance(), noise.growth, noise.sky, noise.electrons

    psf = miri_psf(filter) if psf is None else psf
    light, white, shot, pattern = _extraction(radius, edges, psf, correlation, filter)
    check_that(light > 0, "annulus", "such that light of the source is left", annulus)
    shot_noise = n_sigma**2 * growth * shot / (light**2 * electrons)
    white_noise = n_sigma**2 * variance * white / (light * electrons) ** 2
    residual_noise = (n_sigma * amplitude * sky / (light * electrons)) ** 2 * pattern / n_dithers

    return {
        "flux": _limit(shot_noise, white_noise + residual_noise),
        "flux_white": _limit(shot_noise, white_noise),
        "radius": radius,
        "light": float(light),
        "background": noise.background.value,
        "white": float(np.sqrt(variance * white) / electrons),
        "residual": float(amplitude * sky * np.sqrt(pattern / n_dithers) / electrons),
        # what a calibration of the amplitude needs, per unit amplitude
        "pattern": float(sky * np.sqrt(pattern / n_dithers) / electrons),
        "shot": float(growth * shot / electrons),
    }


def _check_time(time, n_groups, step):
    """Refuse a time shorter than an integration; ``step`` is the time of a group in s."""
    wanted = f"at least one integration of {n_groups} groups, {n_groups * step:.4g} s"
    check_that(time.to_value(TIME) >= n_groups * step * (1 - 1e-9), "time", wanted, time)


def _check_well(noise):
    """Refuse integrations in which the sky fills the well."""
    filled = noise.rate * noise.n_groups * noise.group_time
    wanted = "so few that the sky does not fill the well"
    check_that(filled < noise.detector.full_well, "n_groups", wanted, noise.n_groups)


@takes_other_keywords(options_of=(aperture_noise, fitted_noise))
def sensitivity(
    filter,
    time=None,
    *,
    n_sigma=5.0,
    method="fit",
    excess=None,
    residual=None,
    n_dithers=1,
    **options,
):
    """
    Return the flux of the point source that an exposure measures with a given significance.

    It is the limit of `~miricigale.photometry.ErrorModel.from_exposure` and of plans, and by default that of
    surveys in flight.

    Parameters
    ----------
    filter : str, list of str or `~miricigale.instrument.Exposure`
        One of `~miricigale.instrument.imager_filters`, or several; or an exposure, whose filter, time, groups,
        readout and subarray are taken.
    time : `~astropy.units.Quantity`, optional
        Total exposure time, all dithers, 10 ks by default; not with an exposure.
    n_sigma : float, optional
        Flux over its error.
    method : {"fit", "aperture"}, optional
        How the source is measured: fitted with the PSF on a mosaic (`fitted_noise`), or in an aperture, by default
        that of the exposure time calculator (`aperture_noise`).
    excess : {"flight", "ideal"} or float, optional
        Factor on the noise of the sky of a fit, as for `fitted_noise`: ``"flight"`` by default. There is none for
        an aperture.
    residual, n_dithers, n_groups, readout, subarray, background, psf, detector : optional
        As for `aperture_noise`; ramps of a fit are by default those of an `~miricigale.instrument.Exposure` of the
        time.
    **options
        ``aperture``, ``annulus`` and ``correlation`` of `aperture_noise`, or ``size`` and ``mosaic`` of
        `fitted_noise`.

    Returns
    -------
    flux : `~astropy.units.Quantity`
        Total flux of the source, uJy; shape (n,) for n filters.

    Raises
    ------
    KeyError
        If a name is not known.
    ValueError
        If a number is out of its range, an option is one of the other method, the time is shorter than one
        integration or the sky fills the well within it.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.depth import sensitivity
    >>> for options in ({}, {"excess": "ideal"}, {"method": "aperture"}):
    ...     print(f"{sensitivity('miri.f1000w', 1665 * u.s, **options).to(u.ABmag):.2f}", options)
    24.96 mag(AB) {}
    25.32 mag(AB) {'excess': 'ideal'}
    24.91 mag(AB) {'method': 'aperture'}
    """
    if isinstance(filter, (list, tuple, FilterSet)):
        settings = {"method": method, "excess": excess, "residual": residual}
        settings |= {"n_dithers": n_dithers}
        limits = [
            sensitivity(band, time, n_sigma=n_sigma, **settings, **options) for band in filter
        ]
        return u.Quantity(limits)
    if isinstance(filter, Exposure):
        exposure = filter
        check_that(time is None, "time", "left out with an exposure", time)
        filter = exposure.filter
        time = exposure.exposure_time
        for name in ("n_groups", "readout", "subarray"):
            options.setdefault(name, getattr(exposure, name))
    if time is None:
        time = _TIME
    check_choice(method, "method", ("fit", "aperture"))
    unused = {"fit": ("aperture", "annulus", "correlation"), "aperture": ("size", "mosaic")}
    for name in unused[method]:
        check_that(name not in options, name, f"left out with method={method!r}", options.get(name))
    if method == "aperture":
        check_that(excess is None, "excess", "left out with method='aperture'", excess)
        options |= {"n_sigma": n_sigma, "residual": residual, "n_dithers": n_dithers}
        aperture = aperture_noise(filter, time, **options)
        return aperture["flux"] * u.uJy
    limit = _fit_limit(filter, time, n_sigma, residual, excess, n_dithers, options)
    return limit * u.uJy


def _fit_limit(filter, time, n_sigma, residual, excess, n_dithers, options):
    """Return the flux in uJy that a fit measures with the given significance; options as for `sensitivity`."""
    check_positive(n_sigma, "n_sigma")
    filter = etc_setup(filter).filter
    check_least(n_dithers, "n_dithers", 1, whole=True)
    if options.get("psf") is not None:
        options["psf"] = psf_of(options["psf"], filter)
    names = ("n_groups", "readout", "subarray")
    form = {name: options.pop(name) for name in names if name in options}
    options |= _ramps(filter, time, n_dithers, **form) | {"n_dithers": n_dithers}
    step = options["n_frames"] * options["frame_time"].to_value(TIME)
    seconds = scalar(time, TIME, "time")
    noise = ExposureNoise(
        filter=filter,
        background=options.get("background"),
        n_groups=int(seconds / options["n_integrations"] / step * (1 + 1e-9)),
        group_time=step,
        n_ramps=options["n_integrations"],
        detector=options.get("detector"),
        subarray=options["subarray"],
        n_frames=options["n_frames"],
    )
    _check_well(noise)
    if excess is None:
        excess = "flight"
    sky, photon = fitted_noise(filter, time, residual=residual, excess=excess, **options)
    return _limit(n_sigma**2 * photon, (n_sigma * sky) ** 2)


def _limit(linear, constant):
    """
    Return the flux whose own photons add to its noise: the positive root of F^2 = linear F + constant.

    A flux F of n sigma with the variance V + s F has F^2 = n^2 (V + s F).
    """
    return float((linear + np.sqrt(linear**2 + 4 * constant)) / 2)


def _ramps(filter, time, n_dithers, *, n_groups=None, readout="FASTR1", subarray="FULL"):
    """Integrations, frame time and sub-array for `fitted_noise`; by default those of an `Exposure` of the time."""
    if n_groups is None:
        exposure = Exposure(filter, time=time / n_dithers, readout=readout, subarray=subarray)
        n_integrations = n_dithers * exposure.n_integrations
        return {
            "n_integrations": n_integrations,
            "frame_time": exposure.frame_time,
            "n_frames": exposure.n_frames,
            "subarray": subarray,
        }
    check_least(n_groups, "n_groups", 2, whole=True)
    frame = frame_time(readout, subarray)
    n_frames = frames_per_group(readout)
    step = n_frames * frame.to_value(TIME)
    seconds = scalar(time, TIME, "time")
    _check_time(time, n_groups, step)
    return {
        "n_integrations": round(seconds / (n_groups * step)),
        "frame_time": frame,
        "n_frames": n_frames,
        "subarray": subarray,
    }


#: Columns of `sensitivity_table` by what `aperture_noise` calls them.
_COLUMNS = {"noise": "white", "residual": "residual", "limit_white": "flux_white", "limit": "flux"}


@takes_other_keywords(options_of=(aperture_noise,))
def sensitivity_table(filters=None, time=1e4 * u.s, *, residual="etc", n_sigma=5.0, **options):
    """
    Return the limits of several filters in apertures, compared with those of the exposure time calculator.

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
        extraction), ``limit_white`` and ``limit`` in the aperture without and with the residual,
        ``etc_40`` and ``etc_20`` scaled to the time and significance. For limits of surveys in flight see
        `sensitivity`.

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
     miri.f770w        0.07  0.12   0.12
    miri.f2100w        1.73  2.35   2.35
    """
    if isinstance(filters, str):
        filters = [filters]
    if filters is None:
        names = imager_filters()
    else:
        names = list(filters)
    seconds = scalar(time, TIME, "time")
    rows = []
    for name in names:
        noise = aperture_noise(name, time, n_sigma=n_sigma, residual=residual, **options)
        row = {"filter": etc_setup(name).filter, "radius": noise["radius"] * ANGLE}
        row |= {"light": noise["light"], "background": noise["background"] * SURFACE_BRIGHTNESS}
        for column, key in _COLUMNS.items():
            row[column] = noise[key] * u.uJy
        for column, version in (("etc_40", "4.0"), ("etc_20", "2.0")):
            row[column] = scaled_limit(name, time, n_sigma=n_sigma, version=version)
        rows.append(row)
    meta = provenance(time=seconds, n_sigma=float(n_sigma), residual=str(residual))
    return QTable(rows, meta=meta)
