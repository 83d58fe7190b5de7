"""Detection of sources on the high-resolution image."""

import dataclasses

import astropy.units as u
import numpy as np
import scipy.ndimage
import scipy.stats
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from photutils.segmentation import SegmentationImage, make_2dgaussian_kernel

from miricigale.photometry.arrays import image_arrays, pixel_scale
from miricigale.photometry.segments import dilate_segments, dilation_rule
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.sep_tools import background as sep_background
from miricigale.utils.sep_tools import extract
from miricigale.utils.tables import Flags
from miricigale.utils.units import ANGLE, FNU, to_array

__all__ = [
    "DETECTION_PRESETS",
    "DetectionFlags",
    "DetectionPreset",
    "bright_centroids",
    "detect_sources",
    "detection_purity",
]


class DetectionFlags(Flags):
    """Flags of detections, those of Source Extractor and sep."""

    #: Deblended from a neighbour, or blended with one.
    MERGED = 1
    #: Cut by the edge of the image.
    TRUNCATED = 2
    #: Too few levels to tell its shape.
    SINGULAR = 8


@dataclasses.dataclass(frozen=True)
class DetectionPreset:
    """
    Settings of a detection.

    Attributes
    ----------
    threshold : float
        In units of the noise of a pixel, on the filtered image.
    min_area : int
        Least number of connected pixels.
    fwhm : float or None
        Width of the Gaussian detection filter in pixels, None for none.
    n_levels, contrast : optional
        Number of levels and contrast of the deblending (contrast 1 is none).
    """

    threshold: float
    min_area: int
    fwhm: float | None = 5.0
    n_levels: int = 32
    contrast: float = 0.005

    def on_pixels(self, ratio):
        """
        The same settings for other pixels.

        Parameters
        ----------
        ratio : float
            The pixel on which they are stated over the image's.

        Returns
        -------
        preset : `DetectionPreset`
            Width and area cover the same sky, and the threshold is the same surface brightness
            where noise is white, since the noise of a pixel's brightness goes as its inverse side.
        """
        return dataclasses.replace(
            self,
            threshold=self.threshold / ratio,
            min_area=max(1, round(self.min_area * ratio**2)),
            fwhm=self.fwhm and self.fwhm * ratio,
        )


#: ``"default"``, and what the paper used on F160W at 0.06 arcsec and on MIRI images.
DETECTION_PRESETS = {
    "default": DetectionPreset(threshold=1.0, min_area=10, fwhm=3.0),
    "yang2021": DetectionPreset(threshold=0.25, min_area=60),
    "yang2021_miri": DetectionPreset(threshold=1.5, min_area=5),
}


def detect_sources(
    image,
    *,
    preset="yang2021",
    threshold=None,
    min_area=None,
    fwhm=None,
    n_levels=None,
    contrast=None,
    subtract_background=False,
    box=64,
    filter_size=6,
    stated_on=None,
    dilation=None,
):
    """
    Detect sources with Source Extractor's algorithm.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        In units of surface brightness, with WCS. Without an uncertainty the noise is
        measured on the image.
    preset : str, optional
        Name in `DETECTION_PRESETS`, for the settings that are not given.
    threshold : float, optional
        In units of the noise of a pixel; it applies to the image after filtering, as
        Source Extractor's DETECT_THRESH does.
    min_area : int, optional
        Least number of connected pixels.
    fwhm : float, optional
        Width of the Gaussian filter in pixels; 0 for no filter.
    n_levels, contrast : optional
        Deblending.
    subtract_background : bool, optional
        Whether a background is measured and subtracted first.
    box, filter_size : int, optional
        Its box in pixels and its median filter in boxes.
    stated_on : `~astropy.units.Quantity`, optional
        Pixel scale on which the settings are stated: they are brought to the image's pixels
        (see `DetectionPreset.on_pixels`; the box too). By default they are for the image's own.
    dilation : str or `DilationRule`, optional
        How far segments are grown after detection, or a name in `DILATION_RULES`; as they
        were detected by default. Positions, shapes and flags are those of the detection.

    Returns
    -------
    segmentation : `~photutils.segmentation.SegmentationImage`
        Label 0 is the sky.
    catalog : `~astropy.table.QTable`
        A row for each label: ``id`` and ``label``, ``sky``, ``x``, ``y`` (0-based pixels), ``flux``
        and ``flux_err`` (uJy, the light in the segment), ``a``, ``b`` (arcsec, rms along
        the axes), ``theta`` (deg from +x to +y), ``n_pixels``, ``n_detected`` (pixels before
        dilation), ``snr``, ``flags``.

    Raises
    ------
    ValueError
        If a setting is out of range.
    KeyError
        If there is no such preset or rule.

    References
    ----------
    Bertin & Arnouts 1996, A&AS 117, 393; Barbary 2016, JOSS 1, 58.
    """
    given = {
        "threshold": threshold,
        "min_area": min_area,
        "fwhm": fwhm,
        "n_levels": n_levels,
        "contrast": contrast,
    }
    background = (box, filter_size) if subtract_background else None
    arrays, settings = _prepare(image, preset, given, background, stated_on)
    rule = None if dilation is None else dilation_rule(dilation)
    objects, found = _extract(arrays.flux, arrays, settings)
    labels = found
    if rule is not None:
        scale = pixel_scale(arrays.wcs)
        labels = dilate_segments(found, rule, pixel_scale=scale, mask=~arrays.usable).data
    catalog = _catalog(objects, found, labels, arrays)
    catalog.meta.update(provenance(preset=preset, **dataclasses.asdict(settings)))
    if rule is not None:
        catalog.meta["dilation"] = dataclasses.asdict(rule)
    return SegmentationImage(labels), catalog


def detection_purity(
    image,
    *,
    snr_edges=None,
    preset="yang2021",
    threshold=None,
    min_area=None,
    fwhm=None,
    n_levels=None,
    contrast=None,
    subtract_background=False,
    box=64,
    filter_size=6,
    stated_on=None,
):
    """
    Estimate which share of the detections is real, from the image's negative.

    Noise that is symmetric makes as many detections on the negative image as on the image;
    sources make none there.

    Parameters
    ----------
    image : `~astropy.nddata.CCDData`
        As `detect_sources` takes it.
    snr_edges : array_like, shape (n + 1,), optional
        Signal-to-noise of segments (column ``snr`` of `detect_sources`) between which detections
        are counted; ten bins from the least to the largest of the negative image and one above by
        default.
    preset, threshold, min_area, fwhm, n_levels, contrast : optional
        Settings, as of `detect_sources`.
    subtract_background, box, filter_size, stated_on : optional
        Likewise. The background is estimated once, on the image, and subtracted from both.

    Returns
    -------
    table : `~astropy.table.QTable`
        A row for each bin: ``snr_low``, ``snr_high``, ``n_positive``, ``n_negative``, ``purity``
        (1 - n_negative / n_positive; below 0 where there are more negative detections, NaN without
        positive ones), ``purity_low``, ``purity_high``, its 68 % interval by the Poisson error of
        ``n_negative``, and ``purity_above``, the purity of all detections from ``snr_low`` on.
        ``meta`` has the total ``n_positive`` and ``n_negative``, those outside of the bins included.

    Raises
    ------
    ValueError
        If edges do not ascend, or a setting is out of range.

    Notes
    -----
    Sources cover part of the image, and noise peaks that touch them are no detections of their own: at low
    signal-to-noise the purity of a single bin is too low where sources are dense (F444W of a deep field: 51
    detections on the image, 95 on its negative at 5 to 7 sigma); ``purity_above`` is the safer one.
    Holes beside bright sources (a background taken too high, ringing of a resampling) are counted as noise,
    so that the purity is too low there; noise with a tail to positive values, such as cosmic rays that
    were left, is not seen.

    References
    ----------
    Gehrels 1986, ApJ 303, 336 (Poisson intervals).
    """
    given = {
        "threshold": threshold,
        "min_area": min_area,
        "fwhm": fwhm,
        "n_levels": n_levels,
        "contrast": contrast,
    }
    background = (box, filter_size) if subtract_background else None
    arrays, settings = _prepare(image, preset, given, background, stated_on)
    positive, negative = (
        _segment_snr(flux, arrays, settings) for flux in (arrays.flux, -arrays.flux)
    )
    if snr_edges is None:
        snr_edges = [0.0, np.inf]
        if len(negative):
            top = np.nextafter(negative.max(), np.inf)
            low = min(negative.min(), positive.min(initial=np.inf))
            snr_edges = np.append(np.linspace(low, max(top, low + 1e-6), 11), np.inf)
    edges = np.asarray(snr_edges, float)
    if edges.ndim != 1 or len(edges) < 2 or not np.all(np.diff(edges) > 0):
        raise argument_error("snr_edges", "two numbers or more that ascend", snr_edges)
    counts = [np.histogram(snr, edges)[0] for snr in (positive, negative)]
    n_positive, n_negative = counts
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = (
            scipy.stats.chi2.ppf(0.8413, 2 * (n_negative + 1)) / 2,
            np.where(n_negative > 0, scipy.stats.chi2.ppf(0.1587, 2 * n_negative) / 2, 0.0),
        )
        purity, low, high = (
            np.where(n_positive > 0, 1 - n / n_positive, np.nan) for n in (n_negative, *limits)
        )
        above = [np.cumsum(n[::-1])[::-1] for n in counts]
        purity_above = np.where(above[0] > 0, 1 - above[1] / above[0], np.nan)
    columns = {
        "snr_low": (edges[:-1], "Least signal-to-noise of a segment"),
        "snr_high": (edges[1:], "Largest signal-to-noise, not included"),
        "n_positive": (n_positive, "Detections on the image"),
        "n_negative": (n_negative, "Detections on its negative"),
        "purity": (purity, "1 - n_negative / n_positive"),
        "purity_low": (low, "Lower end of the 68 % interval"),
        "purity_high": (high, "Upper end of the 68 % interval"),
        "purity_above": (purity_above, "Purity of all detections from snr_low on"),
    }
    table = QTable({name: values for name, (values, _) in columns.items()})
    for name, (_, description) in columns.items():
        table[name].info.description = description
    table.meta.update(
        provenance(n_positive=len(positive), n_negative=len(negative)),
        **dataclasses.asdict(settings),
    )
    return table


def _prepare(image, preset, given, background, stated_on):
    """Arrays with the background (box, filter) taken off, and settings on the image's pixels."""
    if preset not in DETECTION_PRESETS:
        raise unknown_name("detection preset", preset, DETECTION_PRESETS)
    settings = dataclasses.replace(
        DETECTION_PRESETS[preset], **{k: v for k, v in given.items() if v is not None}
    )
    if not settings.threshold > 0:
        raise argument_error("threshold", "positive", settings.threshold)
    arrays = image_arrays(image, "image")
    ratio = 1.0
    if stated_on is not None:
        stated = float(to_array(stated_on, ANGLE, "stated_on"))
        if not stated > 0:
            raise argument_error("stated_on", "positive", stated_on)
        ratio = stated / pixel_scale(arrays.wcs)
        settings = settings.on_pixels(ratio)
    if background is not None:
        box = max(1, round(background[0] * ratio))
        level = sep_background(arrays.flux, ~arrays.usable, box, background[1])[0]
        arrays = dataclasses.replace(arrays, flux=arrays.flux - level)
    return arrays, settings


def _extract(flux, arrays, settings):
    """Objects and labels of an image of flux per pixel."""
    kernel = None
    if settings.fwhm:
        size = 2 * int(np.ceil(0.9 * settings.fwhm)) - 1
        kernel = make_2dgaussian_kernel(settings.fwhm, max(size, 3)).array
    return extract(
        flux,
        settings.threshold,
        err=arrays.sigma,
        mask=~arrays.usable,
        min_area=settings.min_area,
        filter_kernel=kernel,
        deblend_n_thresholds=settings.n_levels,
        deblend_contrast=settings.contrast,
    )


def _segment_snr(flux, arrays, settings):
    """Signal-to-noise of the segments found on an image."""
    objects, labels = _extract(flux, arrays, settings)
    total, noise = _segment_sums(labels, flux, arrays, len(objects))
    return total / noise


def _segment_sums(labels, flux, arrays, n):
    """Light of each segment and its error for white noise."""
    flat = labels.ravel()
    variance = np.where(arrays.usable, arrays.sigma, 0.0) ** 2
    total = np.bincount(flat, flux.ravel(), n + 1)[1:]
    return total, np.sqrt(np.bincount(flat, variance.ravel(), n + 1)[1:])


def bright_centroids(flux, labels, fallback):
    """
    Centroids of the bright part of each segment.

    The centroid of a whole segment found at a low threshold is led astray by its ragged
    rim.

    Parameters
    ----------
    flux : `~numpy.ndarray`, shape (ny, nx)
        Light.
    labels : int `~numpy.ndarray`, shape (ny, nx)
        1 to n, 0 for the sky.
    fallback : tuple of `~numpy.ndarray`, shape (n,)
        Positions x, y of those without a bright part.

    Returns
    -------
    x, y : `~numpy.ndarray`, shape (n,)
        0-based pixels.
    """
    n = len(fallback[0])
    if n == 0:
        return np.empty(0), np.empty(0)
    smooth = scipy.ndimage.gaussian_filter(flux, 1.5)
    # the sky is most of the image and has no peak
    y, x = np.nonzero(labels)
    weight, label = smooth[y, x], labels[y, x]
    peak = np.append(np.inf, scipy.ndimage.maximum(weight, label, np.arange(1, n + 1)))
    core = weight > 0.3 * peak[label]
    y, x, weight, label = y[core], x[core], weight[core], label[core]
    total = np.bincount(label, weight, n + 1)[1:]
    found = []
    for values, otherwise in ((x, fallback[0]), (y, fallback[1])):
        moment = np.bincount(label, weight * values, n + 1)[1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            found.append(np.where(total > 0, moment / total, otherwise))
    return found


def _catalog(objects, found, labels, arrays):
    """The table of the detections: segments as found, and as they are returned."""
    n = len(objects)
    index = np.arange(1, n + 1)
    flux = arrays.flux
    total, noise = _segment_sums(labels, flux, arrays, n)
    scale = pixel_scale(arrays.wcs)
    x, y = bright_centroids(flux, found, (objects["x"], objects["y"]))
    sky = arrays.wcs.pixel_to_world(x, y) if n else SkyCoord([], [], unit="deg")
    with np.errstate(divide="ignore", invalid="ignore"):
        snr = total / noise
    known = sum(int(flag) for flag in DetectionFlags)
    columns = {
        "id": (index, "Number of the detection"),
        "label": (index, "Label in the segmentation image"),
        "sky": (sky.icrs, "Position of the bright part"),
        "x": (x, "Centroid of the bright part, 0-based"),
        "y": (y, "Centroid of the bright part, 0-based"),
        "flux": (total * FNU, "Light in the segment"),
        "flux_err": (noise * FNU, "Its error for noise that is not correlated"),
        "a": (objects["a"] * scale * ANGLE, "Rms along the major axis"),
        "b": (objects["b"] * scale * ANGLE, "Rms along the minor axis"),
        "theta": (np.degrees(objects["theta"]) * u.deg, "Direction of the major axis, +x to +y"),
        "n_pixels": (_sizes(labels, n), "Pixels of the segment"),
        "n_detected": (_sizes(found, n), "Pixels of the segment before dilation"),
        "snr": (snr, "flux over flux_err"),
        "flags": (objects["flag"].astype(int) & known, DetectionFlags.describe()),
    }
    table = QTable({name: values for name, (values, _) in columns.items()})
    for name, (_, description) in columns.items():
        table[name].info.description = description
    return table


def _sizes(labels, n):
    """Pixels of each of n segments."""
    return np.bincount(labels.ravel(), minlength=n + 1)[1:]
