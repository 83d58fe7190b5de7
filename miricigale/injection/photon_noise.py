"""The photon noise of light that is added to an image, as far as the image states it."""

import warnings

import astropy.units as u
import numpy as np

from miricigale.photometry.images.repeated_pixels import own_pixels
from miricigale.utils.exceptions import PhotometryWarning
from miricigale.utils.values import value_class

#: A pixel is bright whose value is further above the median than this many errors; least number of these.
_BRIGHT = 10.0
_LEAST_BRIGHT = 20
#: Side of the areas in pixels in which bright pixels are compared with the sky, and least pixels of sky in one.
_BLOCK = 32
_LEAST_SKY = 20
#: Light further above 0 than this many errors says what its variance is where it is.
_CLEAR = 5.0
#: Names of counts that are electrons, each of which is a photon.
_ELECTRONS = (u.electron, u.ph)


@value_class
class PhotonNoise:
    """
    Variance of the photon noise of light in an image.

    Parameters
    ----------
    factor : `~numpy.ndarray`, shape (ny, nx), or None
        Variance in (MJy/sr)^2 of each MJy/sr of light; None where the image does not state it.
    of_pixels : bool
        Whether this is the variance of a pixel as the errors of the image have it, which the covariance of the
        noise on the sky refers to; or that of the light of a pixel, whatever pixels are resampled to.
    in_errors : bool
        Whether the errors of the image have the photon noise of sources in them.
    text : str
        Where it is from, or what is lacking.
    """

    factor: np.ndarray
    of_pixels: bool
    in_errors: bool
    text: str

    @classmethod
    def unknown(cls, text):
        """Make that of an image that does not state it."""
        return cls(None, False, False, f"not drawn: {text}")

    @classmethod
    def of_variance(cls, image, variance, *, in_errors):
        """
        Find it in a map of the Poisson variance.

        Parameters
        ----------
        image : `~astropy.nddata.CCDData`
            The image, with errors, and with a background or without.
        variance : `~numpy.ndarray`, shape (ny, nx)
            Variance of the photon noise of its pixels in (MJy/sr)^2, which goes with the light in them and the
            background that was subtracted: this is found by the pixels that are bright.
        in_errors : bool
            Whether it is part of the errors.

        Returns
        -------
        noise : `PhotonNoise`
        """
        data = np.asarray(image.data, float)
        good = ~np.asarray(image.mask, bool) & np.isfinite(variance) & (variance > 0)
        if not good.any():
            return cls.unknown("VAR_POISSON has no value above 0")
        error = np.asarray(image.uncertainty.array, float)
        slopes, backgrounds = _lines(data, variance, error, good)
        if slopes.size < _LEAST_BRIGHT:
            return cls.unknown("no pixel is so bright that VAR_POISSON shows what light adds to it")
        slope = np.median(slopes)
        if not slope > 0:
            return cls.unknown("VAR_POISSON does not grow with light")
        # exposure times differ from place to place, and with them the variance of the same light
        light = data + np.median(backgrounds)
        lit = good & (light > _CLEAR * error)
        factor = np.full(data.shape, slope)
        np.divide(variance, light, out=factor, where=lit)
        text = f"VAR_POISSON: {slope:.3g} (MJy/sr)2 for 1 MJy/sr"
        return cls(factor, True, in_errors, text)

    @classmethod
    def of_header(cls, unit, keywords, factor):
        """
        Find it by the unit of the pixels and the exposure time.

        Parameters
        ----------
        unit : `~astropy.units.Unit` or None
            Unit of the pixels.
        keywords : dict
            ``EXPTIME`` in s, and ``GAIN`` in electrons for each count; None where they are not stated.
        factor : float or `~numpy.ndarray`, shape (ny, nx)
            MJy/sr of a pixel's unit.

        Returns
        -------
        noise : `PhotonNoise`
        """
        time = keywords["EXPTIME"]
        gain = keywords["GAIN"]
        is_rate = False
        counts = unit
        if unit is not None and not _is_count(unit):
            counts = unit * u.s
            is_rate = True
        if counts is None or not _is_count(counts):
            return cls.unknown(
                f"no VAR_POISSON, and pixels in {unit}, whose electrons are not stated"
            )
        text = []
        scale = 1.0
        if not any(counts.is_equivalent(base) for base in _ELECTRONS):
            if not gain or not gain > 0:
                return cls.unknown(f"no VAR_POISSON, and pixels in {unit} without GAIN")
            scale = 1.0 / gain
            text.append(f"GAIN {gain:g}")
        if is_rate:
            if not time or not time > 0:
                return cls.unknown(f"no VAR_POISSON, and pixels in {unit} without EXPTIME")
            scale /= time
            text.append(f"EXPTIME {time:g} s")
        return cls(factor * scale, False, False, ", ".join([f"pixels in {unit}"] + text))

    def variance(self, light):
        """Variance of the photon noise of light, in (MJy/sr)^2 and MJy/sr, (ny, nx); 0 if it is not known."""
        if self.factor is None:
            return np.zeros(np.shape(light))
        return self.factor * np.maximum(light, 0.0)

    def draw(self, light, covariance, rng):
        """
        Draw the photon noise of light.

        Parameters
        ----------
        light : `~numpy.ndarray`, shape (ny, nx)
            Light in MJy/sr.
        covariance : `~numpy.ndarray`, shape (2 m + 1, 2 m + 1), or None
            Covariance of the pixels' noise on the sky in units of their variance by separation; None: independent
            pixels.
        rng : `~numpy.random.Generator`
            Generator.

        Returns
        -------
        noise : `~numpy.ndarray`, shape (ny, nx)
            In MJy/sr, with the covariance of the noise on the sky.
        """
        if covariance is None:
            covariance = np.ones((1, 1))
        middle = covariance[len(covariance) // 2, len(covariance) // 2]
        if self.of_pixels:
            # structure of the sky that is no noise makes residuals larger than errors
            covariance = covariance / max(middle, 1.0)
        else:
            # pixels share photons when they are resampled, and none is lost
            covariance = covariance / max(covariance.sum(), middle)
        white = rng.standard_normal(np.shape(light))
        return np.sqrt(self.variance(light)) * _colored(white, covariance)

    def add(self, light, covariance, rng):
        """
        Add its photon noise to light.

        Parameters
        ----------
        light, covariance, rng
            As for `draw`.

        Returns
        -------
        light : `~numpy.ndarray`, shape (ny, nx)
            In MJy/sr; without noise if it is not known.
        variance : `~numpy.ndarray`, shape (ny, nx), or None
            By which the variance of the image grows, in (MJy/sr)^2; None if its errors lack photon noise.
        """
        if self.factor is None:
            return light, None
        added_variance = None
        if self.in_errors:
            added_variance = self.variance(light)
        return light + self.draw(light, covariance, rng), added_variance


def _lines(data, variance, error, good):
    """
    Compare bright pixels with the sky around them.

    Returns the variance of their light, and the background (MJy/sr) that is not in the data, both of shape (n,).
    """
    slopes = [np.zeros(0)]
    backgrounds = [np.zeros(0)]
    middle = np.median(data[good])
    ny, nx = data.shape
    for y in range(0, ny, _BLOCK):
        for x in range(0, nx, _BLOCK):
            part = np.s_[y : y + _BLOCK, x : x + _BLOCK]
            values = data[part]
            sky = good[part] & (values <= middle)
            if np.count_nonzero(sky) < _LEAST_SKY:
                continue
            level = np.median(values[sky])
            of_sky = np.median(variance[part][sky])
            bright = good[part] & (values - level > _BRIGHT * error[part])
            slope = (variance[part][bright] - of_sky) / (values[bright] - level)
            slopes.append(slope)
            with np.errstate(divide="ignore"):
                backgrounds.append(of_sky / slope - level)
    return np.concatenate(slopes), np.concatenate(backgrounds)


def _is_count(unit):
    """Whether a unit is one of counts."""
    return any(unit.is_equivalent(base) for base in (*_ELECTRONS, u.ct, u.adu, u.DN))


def _colored(white, covariance):
    """Make noise with a covariance by separation of white noise, (ny, nx)."""
    if covariance.shape == (1, 1):
        return np.sqrt(covariance[0, 0]) * white
    lag = len(covariance) // 2
    on_grid = np.zeros(white.shape)
    ny, nx = white.shape
    index = np.arange(-lag, lag + 1)
    # a small image meets itself
    np.add.at(on_grid, np.ix_(index % ny, index % nx), covariance)
    power = np.maximum(np.fft.rfft2(on_grid).real, 0.0)
    return np.fft.irfft2(np.sqrt(power) * np.fft.rfft2(white), s=white.shape)


def photon_noise(file):
    """
    Find the photon noise of light in an image.

    Parameters
    ----------
    file : `~miricigale.photometry.MosaicFile`
        The file.

    Returns
    -------
    noise : `PhotonNoise`
        By the extension VAR_POISSON; without it by the unit of the pixels, EXPTIME and, of counts, GAIN.
    """
    with warnings.catch_warnings():
        # those of the image are given where it is measured
        warnings.simplefilter("ignore", PhotometryWarning)
        image = own_pixels(file.read())
    if image.meta.get("repeated_pixels", 1) != 1:
        return PhotonNoise.unknown("each pixel is there several times")
    facts = file.read_photon_facts()
    if facts["variance"] is None or image.uncertainty is None:
        return PhotonNoise.of_header(facts["unit"], facts["keywords"], facts["factor"])
    return PhotonNoise.of_variance(image, facts["variance"], in_errors=facts["own_errors"])
