"""Noise of point and extended sources that are fitted on the mosaic of an exposure."""

import astropy.units as u
import numpy as np
import scipy.fft
from astropy.stats import gaussian_sigma_to_fwhm
from scipy.ndimage import gaussian_filter

from miricigale.depth.noise import ExposureNoise, noise_power, pattern_amplitude
from miricigale.instrument import Exposure
from miricigale.instrument import frame_time as read_time
from miricigale.psf import MIRI_PIXEL_SCALE, instrument_psf, miri_psf, psf_image
from miricigale.utils.exceptions import argument_error
from miricigale.utils.options import check_choice, check_least, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import ANGLE, check_count, positive, scalar

#: Factors on the noise of the sky by name: what surveys in flight lose against an ideal fit, and nothing.
EXCESS = {"flight": 1.4, "ideal": 1.0}

#: Samples of a pixel's side, and pixels of the detector on which sources are weighed.
_SAMPLES = 4
_SIZE = 91


def extraction_map(share, boxes):
    """
    Return the weight of the detector's pixels in the flux that is fitted on a mosaic, shape (n, n).

    ``share`` (n, n) is the light of a detector's pixel whose middle is there, sampled
    ``_SAMPLES`` times a side. A template fitted with equal weights to a mosaic that is the
    exposures smeared with K counts each detector pixel with P * K * K, where P is the PSF;
    without K that is the optimal extraction. K is the convolution of squares of the widths
    ``boxes`` in detector pixels. Every lattice of pixels finds unit flux in the mean.
    """
    n = share.shape[0]
    period = scipy.fft.next_fast_len(n + 8 * _SAMPLES, True)
    fy = np.fft.fftfreq(period)[:, None]
    fx = np.fft.rfftfreq(period)
    smear = np.ones(1)
    for box in boxes:
        width = box * _SAMPLES
        smear = smear * np.sinc(fy * width) * np.sinc(fx * width)
    smeared = scipy.fft.rfft2(share, s=(period, period)) * smear**2
    weight = scipy.fft.irfft2(smeared, s=(period, period))[:n, :n]
    return weight * _SAMPLES**2 / np.sum(weight * share)


@takes_other_keywords
def fitted_noise(
    filter,
    time,
    *,
    background=None,
    size=0.0 * u.arcsec,
    psf=None,
    n_integrations=None,
    frame_time=None,
    n_frames=1,
    n_dithers=1,
    residual=None,
    mosaic=0.11 * u.arcsec,
    detector=None,
    subarray="FULL",
    excess="flight",
):
    """
    Return the noise of sources fitted on the mosaic of an exposure.

    Parameters
    ----------
    filter : str
        One of the imaging filters.
    time : `~astropy.units.Quantity`
        Total exposure time.
    background : `~astropy.units.Quantity`, optional
        Surface brightness of sky and telescope; the low background by default.
    size : `~astropy.units.Quantity`, optional
        FWHM of the source (a Gaussian) before the PSF; a point by default.
    psf : `~photutils.psf.ImagePSF`, optional
        PSF of the exposure; `~miricigale.psf.miri_psf` by default.
    n_integrations : int, optional
        Ramps into which the time is divided (over all dithers); those of an `~miricigale.instrument.Exposure` of
        the time of one dither by default, as for `sensitivity`.
    frame_time : `~astropy.units.Quantity`, optional
        Time of one frame; that of FASTR1 in the sub-array by default.
    n_frames : int, optional
        Frames that are averaged to one group.
    n_dithers : int, optional
        Positions over which the time is divided; a residual pattern averages down with them.
    residual : str, float or None, optional
        Fraction of the sky that stays as a fixed pattern (`~miricigale.detector.Residual`, of its
        default correlation), or ``"etc"`` for what the exposure time calculator's limits imply.
    mosaic : `~astropy.units.Quantity` or None, optional
        Pixel of the drizzled mosaic (drops of a whole pixel) that is measured; None for the optimal
        extraction from the exposures themselves.
    detector : `~miricigale.instrument.DetectorProperties`, optional
        `~miricigale.instrument.miri_detector` if not given.
    subarray : str, optional
        As in `~miricigale.instrument.Exposure`.
    excess : {"flight", "ideal"} or float, optional
        Factor on the noise of the sky. ``"flight"`` (1.4) gives the limits that surveys publish (see the notes),
        ``"ideal"`` (1) is the fit of a source of known shape on a clean sky.

    Returns
    -------
    sky : float
        Standard deviation of the flux of a faint source, uJy.
    photon : float
        Variance by the source's own photons, uJy^2 for each uJy.

    Raises
    ------
    ValueError
        If a number is out of its range, or an integration has less than two frames.

    Notes
    -----
    With P the share of light of each pixel and K the smearing of the mosaic, a template that is
    fitted with equal weights to the mosaic counts each pixel of the detector with W = P * K * K,
    normalized to sum(W P) = 1: the sky comes in with sum(W^2), the source's own photons with
    sum(W^2 P), the pattern with sum(W_i W_j rho_ij). Ramps are fitted optimally, as in
    `sensitivity`.

    With ``excess="flight"`` limits are within 0.15 mag of those that CEERS, COSMOS-Web and SMILES reach (F1800W
    of CEERS, 0.5 mag deeper, excepted): the page on the accuracy of plans has the table and the sources. Much of
    it is that surveys measure in apertures.

    Examples
    --------
    >>> import astropy.units as u
    >>> from miricigale.depth import fitted_noise
    >>> for excess in ("flight", "ideal"):
    ...     sky, photon = fitted_noise("miri.f770w", 3000 * u.s, excess=excess)
    ...     print(f"error of a faint source, {excess}: {sky:.4f} uJy")
    error of a faint source, flight: 0.0263 uJy
    error of a faint source, ideal: 0.0188 uJy
    """
    seconds = positive(time, u.s, "time")
    if n_integrations is None:
        check_least(n_dithers, "n_dithers", 1, whole=True)
        exposure = Exposure(filter, time=seconds / n_dithers * u.s, subarray=subarray)
        n_integrations = n_dithers * exposure.n_integrations
    if frame_time is None:
        frame_time = read_time(subarray=subarray)
    for name, value in (("n_integrations", n_integrations), ("n_dithers", n_dithers)):
        check_that(int(value) == value and value >= 1, name, "an integer of at least 1", value)
    n_frames = check_count(n_frames, "n_frames")
    step = n_frames * scalar(frame_time, u.s, "frame_time")
    n_groups = int(seconds / n_integrations / step * (1 + 1e-9))
    group = "frames" if n_frames == 1 else "groups"
    check_that(n_groups >= 2, "time", f"at least two {group} of {step} s in each integration", time)
    factor = excess_factor(excess)
    share = _share(filter, psf, size)
    boxes = ()
    if mosaic is not None:
        boxes = (1.0, _pixels(mosaic, "mosaic"))
    weight = extraction_map(share, boxes)
    noise = ExposureNoise(
        filter=filter,
        background=background,
        n_groups=n_groups,
        group_time=step,
        n_ramps=seconds / (n_groups * step),
        detector=detector,
        subarray=subarray,
        n_frames=n_frames,
    )
    electrons = noise.electrons
    power = np.sum(weight**2) / _SAMPLES**2
    sky = noise.variance() * power / electrons**2
    amplitude = pattern_amplitude(residual, filter)
    if amplitude:
        # the pattern is that of whole pixels, wherever the source falls
        phases = np.ndindex(_SAMPLES, _SAMPLES)
        pattern = np.mean([noise_power(weight[y::_SAMPLES, x::_SAMPLES], 1.0) for y, x in phases])
        sky += (amplitude * noise.sky / electrons) ** 2 * pattern / n_dithers
    photon = noise.growth * np.sum(weight**2 * share) / _SAMPLES**2 / electrons
    return float(factor * np.sqrt(sky)), float(photon)


def excess_factor(excess):
    """Return the factor on the noise of the sky: a number, or that of a name in ``EXCESS``."""
    if isinstance(excess, str):
        check_choice(excess, "excess", EXCESS)
        return EXCESS[excess]
    check_positive(excess, "excess")
    return float(excess)


def psf_of(psf, filter, *, with_pixel=True):
    """A PSF as `~miricigale.psf.InstrumentPSF`, after checking that it is of a filter and includes the pixel."""
    psf = instrument_psf(psf)
    have = psf.filter
    # other packages write F770W where we write miri.f770w
    if isinstance(have, str) and have.lower().rpartition(".")[2] != filter.rpartition(".")[2]:
        raise argument_error("psf", f"one of the filter {filter}", f"one of {have}")
    good = "pixel" in psf.includes or not with_pixel
    check_that(good, "psf", "a PSF that includes the pixel", psf.includes)
    return psf


def _pixels(angle, name):
    value = scalar(angle, ANGLE, name) / u.Quantity(MIRI_PIXEL_SCALE, ANGLE).value
    check_that(0 < value < 5, name, "positive and below 0.5 arcsec", angle)
    return value


def _share(filter, psf, size):
    """Return the light of a source in a pixel, by the place of the pixel's middle."""
    pixel = u.Quantity(MIRI_PIXEL_SCALE, ANGLE) / _SAMPLES
    n = _SIZE * _SAMPLES
    if psf is None:
        psf = miri_psf(filter)
    else:
        psf = psf_of(psf, filter, with_pixel=False)
    share = psf_image(psf, pixel_scale=pixel, shape=n + 1 - n % 2) * _SAMPLES**2
    width = scalar(size, ANGLE, "size")
    check_that(width >= 0, "size", "at least 0", size)
    width = width / gaussian_sigma_to_fwhm / pixel.value
    if width > 0:
        return gaussian_filter(share, width)
    return share
