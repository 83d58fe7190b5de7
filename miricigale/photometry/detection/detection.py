"""Detection of sources on the high-resolution image."""

import dataclasses

import astropy.units as u
import numpy as np
import scipy.ndimage
from astropy.coordinates import SkyCoord
from astropy.stats import poisson_conf_interval
from photutils.segmentation import SegmentationImage, make_2dgaussian_kernel

from miricigale.photometry.detection.segments import dilate_segments, dilation_rule
from miricigale.photometry.images.arrays import image_arrays, pixel_scale
from miricigale.photometry.images.mosaics import as_mosaic
from miricigale.utils.arrays import quiet_division
from miricigale.utils.exceptions import PhotometryWarning, warn
from miricigale.utils.meta import provenance
from miricigale.utils.missing_values import floats
from miricigale.utils.named_values import without_none
from miricigale.utils.options import check_names, check_positive, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.package_tables import column_texts
from miricigale.utils.sep_tools import background as sep_background
from miricigale.utils.sep_tools import extract
from miricigale.utils.tables import Flags, described_columns
from miricigale.utils.units import ANGLE, FNU, is_ascending, positive


class DetectionFlags(Flags):
    """
    Flags of detections, those of Source Extractor and sep.

    Examples
    --------
    >>> from miricigale.photometry import DetectionFlags
    >>> DetectionFlags.names(3)
    ['merged', 'truncated']
    """

    MERGED = 1, "Deblended from a neighbor, or blended with one."
    TRUNCATED = 2, "Cut by the edge of the image."
    SINGULAR = 8, "Too few levels to tell its shape."


@dataclasses.dataclass(frozen=True)
class DetectionPreset:
    """
    Settings of a detection.

    Attributes
    ----------
    threshold : float
        In units of the noise of a pixel, on the filtered image.
    n_pixels : int
        Least number of connected pixels.
    fwhm : float or None
        Width of the Gaussian detection filter in pixels, None or 0 for none.
    n_levels, contrast : optional
        Number of levels and contrast of the deblending (contrast 1 is none).

    Examples
    --------
    >>> from miricigale.photometry import DETECTION_PRESETS, DetectionPreset
    >>> DETECTION_PRESETS["yang2021"]
    DetectionPreset(threshold=0.25, n_pixels=60, fwhm=5.0, n_levels=32, contrast=0.005)
    >>> DetectionPreset(threshold=1.5, n_pixels=10, fwhm=3).on_pixels(0.5)
    DetectionPreset(threshold=3.0, n_pixels=2, fwhm=1.5, n_levels=32, contrast=0.005)
    """

    threshold: float
    n_pixels: int
    fwhm: float | None = 5.0
    n_levels: int = 32
    contrast: float = 0.005

    def on_pixels(self, ratio):
        """
        Bring the settings to other pixels.

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
            n_pixels=max(1, round(self.n_pixels * ratio**2)),
            fwhm=self.fwhm and self.fwhm * ratio,
        )


# sigma of a pixel that the dark half of an image may spread to be taken for sky
_SKY_SPREAD = 3.0

_SKY_LEFT = (
    "its sky may not be subtracted (subtract_background=True; on the command line "
    "--highres-background-box 64)"
)

#: ``"default"``, the threshold and area of the paper on F160W at 0.06 arcsec, and its settings for MIRI
#: images. The paper states no filter for F160W: there too it is the one of 5 pixels for MIRI.
DETECTION_PRESETS = {
    "default": DetectionPreset(threshold=1.0, n_pixels=10, fwhm=3.0),
    "yang2021": DetectionPreset(threshold=0.25, n_pixels=60),
    "yang2021_miri": DetectionPreset(threshold=1.5, n_pixels=5),
}


@takes_other_keywords
def detect_sources(
    image,
    *,
    preset="yang2021",
    threshold=None,
    n_pixels=None,
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
    image : `~astropy.nddata.CCDData`, path-like or other (see `as_mosaic`)
        In units of surface brightness or of the flux in a pixel, with WCS. Without an uncertainty the noise is
        measured on the image.
    preset : str or `DetectionPreset`, optional
        Settings, or their name in `DETECTION_PRESETS`.
    threshold : float, optional
        In units of the noise of a pixel, in place of that of the preset; it applies to the image after
        filtering, as Source Extractor's DETECT_THRESH does.
    n_pixels : int, optional
        Least number of connected pixels, in place of that of the preset.
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
        A row for each label: ``id`` and ``label``, ``sky``, ``x_centroid``, ``y_centroid`` (0-based
        pixels), ``flux`` and ``flux_err`` (uJy, the light in the segment), ``semimajor_axis``,
        ``semiminor_axis`` (arcsec, rms along the axes), ``orientation`` (deg from +x to +y),
        ``n_pixels``, ``n_detected`` (pixels before dilation), ``snr``, ``flags``.

    Raises
    ------
    ValueError
        If a setting is out of range, or the sky of the image is above the threshold.
    KeyError
        If there is no such preset or rule.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If one segment has more than half of the image.

    References
    ----------
    Bertin & Arnouts 1996, A&AS 117, 393; Barbary 2016, JOSS 1, 58.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import detect_sources
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> segments, sources = detect_sources(image, preset="default")
    >>> print(f"{len(sources)} source, signal-to-noise {sources['snr'][0]:.0f}")
    1 source, signal-to-noise 26
    """
    arrays, settings = _prepared(
        image, preset, subtract_background=subtract_background, box=box, filter_size=filter_size,
        stated_on=stated_on, threshold=threshold, n_pixels=n_pixels,
    )  # fmt: skip
    # refuse an unknown rule before the detection
    rule = None
    if dilation is not None:
        rule = dilation_rule(dilation)
    objects, detected = _extract(arrays.flux, arrays, settings)
    # one segment all over the image is its sky
    largest = np.bincount(detected.ravel(), minlength=2)[1:].max() / np.count_nonzero(arrays.usable)
    if largest > 0.5:
        msg = f"one segment has {largest:.0%} of the image: {_SKY_LEFT}"
        warn(msg, PhotometryWarning)
    name = preset if isinstance(preset, str) else "own"
    labels = detected
    meta = provenance(preset=name, **dataclasses.asdict(settings))
    if rule is not None:
        scale = pixel_scale(arrays.wcs)
        labels = dilate_segments(detected, rule, pixel_scale=scale, mask=~arrays.usable).data
        meta["dilation"] = dataclasses.asdict(rule)
    return SegmentationImage(labels), _catalog(objects, detected, labels, arrays, meta)


@takes_other_keywords
def detection_purity(image, *, snr_edges=None, preset="yang2021", **settings):
    """
    Estimate which share of the detections is real, from the image's negative.

    Noise that is symmetric makes as many detections on the negative image as on the image;
    sources make none there.

    Parameters
    ----------
    image, preset
        As for `detect_sources`.
    snr_edges : array_like, shape (n + 1,), optional
        Signal-to-noise of segments (column ``snr`` of `detect_sources`) between which detections
        are counted; ten bins from the least to the largest of the negative image and one above by
        default.
    **settings
        Other options of `detect_sources` but ``dilation``. A background is estimated once, on the image, and
        subtracted from both.

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

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.coordinates import SkyCoord
    >>> from astropy.nddata import CCDData
    >>> from miricigale.instrument import north_up_wcs
    >>> from miricigale.photometry import detection_purity
    >>> from miricigale.psf import gaussian_psf, psf_image
    >>> psf = gaussian_psf(0.4 * u.arcsec, pixel_scale=0.1 * u.arcsec, fov=4 * u.arcsec)
    >>> sky = SkyCoord([53.1], [-27.8], unit="deg")
    >>> wcs = north_up_wcs(sky[0], 0.1 * u.arcsec, (61, 61))
    >>> light = psf_image(psf, pixel_scale=0.1 * u.arcsec, shape=61)
    >>> noise = np.random.default_rng(1).normal(0, 0.01, (61, 61))
    >>> image = CCDData(2 * light + noise, unit="uJy", wcs=wcs)
    >>> table = detection_purity(image, preset="default", snr_edges=[5, 10, 100])
    >>> print(table["snr_low", "n_positive", "n_negative"])
    snr_low n_positive n_negative
    ------- ---------- ----------
        5.0          0          0
       10.0          1          0
    """
    arrays, settings = _prepared(image, preset, **settings)
    positive = _segment_snr(arrays.flux, arrays, settings)
    negative = _segment_snr(-arrays.flux, arrays, settings)
    if snr_edges is None:
        snr_edges = [0.0, np.inf]
        if len(negative):
            top = np.nextafter(negative.max(), np.inf)
            low = min(negative.min(), positive.min(initial=np.inf))
            snr_edges = np.append(np.linspace(low, max(top, low + 1e-6), 11), np.inf)
    edges = floats(snr_edges)
    good = is_ascending(edges, min_size=2)
    check_that(good, "snr_edges", "two numbers or more that ascend", snr_edges)
    n_positive, _ = np.histogram(positive, edges)
    n_negative, _ = np.histogram(negative, edges)
    n_low, n_high = poisson_conf_interval(n_negative, interval="frequentist-confidence")
    # of all detections from each edge on
    n_positive_above = np.cumsum(n_positive[::-1])[::-1]
    n_negative_above = np.cumsum(n_negative[::-1])[::-1]
    texts = column_texts("miricigale.photometry", "purity")
    meta = provenance(n_positive=len(positive), n_negative=len(negative))
    columns = {
        "snr_low": edges[:-1],
        "snr_high": edges[1:],
        "n_positive": n_positive,
        "n_negative": n_negative,
        "purity": _purity(n_positive, n_negative),
        "purity_low": _purity(n_positive, n_high),
        "purity_high": _purity(n_positive, n_low),
        "purity_above": _purity(n_positive_above, n_negative_above),
    }
    return described_columns(columns, texts, {**meta, **dataclasses.asdict(settings)})


def _purity(n_positive, n_negative):
    """Return the share of real detections; NaN without any."""
    with quiet_division():
        return np.where(n_positive > 0, 1 - n_negative / n_positive, np.nan)


def _prepared(
    image, preset, *, subtract_background=False, box=64, filter_size=6, stated_on=None, **changes
):
    """Return arrays with the background subtracted, and settings on the image's pixels."""
    if not isinstance(preset, DetectionPreset):
        check_names([preset], "detection preset", DETECTION_PRESETS)
        preset = DETECTION_PRESETS[preset]
    settings = dataclasses.replace(preset, **without_none(changes))
    check_positive(settings.threshold, "threshold")
    arrays = image_arrays(as_mosaic(image, "image"), "image")
    ratio = 1.0
    if stated_on is not None:
        ratio = positive(stated_on, ANGLE, "stated_on") / pixel_scale(arrays.wcs)
        settings = settings.on_pixels(ratio)
    if subtract_background:
        box = max(1, round(box * ratio))
        level = sep_background(arrays.flux, ~arrays.usable, box, filter_size)[0]
        arrays = dataclasses.replace(arrays, flux=arrays.flux - level)
    return arrays, settings


def _extract(flux, arrays, settings):
    """Extract objects and labels from an image of flux per pixel."""
    _check_sky(flux, arrays, settings)
    kernel = None
    if settings.fwhm:
        size = 2 * int(np.ceil(0.9 * settings.fwhm)) - 1
        kernel = make_2dgaussian_kernel(settings.fwhm, max(size, 3)).array
    try:
        return extract(
            flux,
            settings.threshold,
            err=arrays.sigma,
            mask=~arrays.usable,
            min_area=settings.n_pixels,
            filter_kernel=kernel,
            deblend_n_thresholds=settings.n_levels,
            deblend_contrast=settings.contrast,
        )
    except ValueError as err:
        msg = f"sources cannot be told apart: {err}; {_SKY_LEFT}"
        raise ValueError(msg) from None


def _check_sky(flux, arrays, settings):
    """Refuse an image whose sky is above the threshold: all of it would be one source."""
    usable = arrays.usable
    with quiet_division():
        snr = np.where(usable, flux / arrays.sigma, 0.0)
    low, middle = np.percentile(snr[usable], [10, 50])
    # in noise they are 1.3 apart, in a crowded field much more
    if middle <= settings.threshold or middle - low > _SKY_SPREAD:
        return
    smooth = scipy.ndimage.gaussian_filter(snr, (settings.fwhm or 0.0) / 2.3548)
    dark = np.percentile(smooth[usable], 10)
    wanted = "one whose sky is below the threshold"
    got = f"one in which 90 % of the pixels are above {dark:.3g} sigma: {_SKY_LEFT}"
    check_that(dark <= settings.threshold, "image", wanted, got)


def _segment_snr(flux, arrays, settings):
    """Return the signal-to-noise of the segments found on an image."""
    objects, labels = _extract(flux, arrays, settings)
    total, noise = _segment_sums(labels, flux, arrays, len(objects))
    return total / noise


def _segment_sums(labels, flux, arrays, n):
    """Sum the light of each segment (uJy), and its error for white noise."""
    flat = labels.ravel()
    variance = np.where(arrays.usable, arrays.sigma, 0.0) ** 2
    total = np.bincount(flat, flux.ravel(), n + 1)[1:]
    return total, np.sqrt(np.bincount(flat, variance.ravel(), n + 1)[1:])


def bright_centroids(flux, labels, fallback):
    """
    Calculate the centroids x, y, (n,), of the bright part of each segment, label 1 first.

    The centroid of a whole segment found at a low threshold is led astray by its ragged rim.
    ``fallback`` are positions of those without a bright part.
    """
    n = len(fallback[0])
    if n == 0:
        return np.empty(0), np.empty(0)
    smooth = scipy.ndimage.gaussian_filter(flux, 1.5)
    # the sky is most of the image and has no peak
    y, x = np.nonzero(labels)
    weight = smooth[y, x]
    label = labels[y, x]
    peak = np.append(np.inf, scipy.ndimage.maximum(weight, label, np.arange(1, n + 1)))
    # the bright part: above three tenths of the smoothed peak
    core = weight > 0.3 * peak[label]
    y = y[core]
    x = x[core]
    weight = weight[core]
    label = label[core]
    total = np.bincount(label, weight, n + 1)[1:]
    centroids = []
    for values, otherwise in ((x, fallback[0]), (y, fallback[1])):
        moment = np.bincount(label, weight * values, n + 1)[1:]
        with quiet_division():
            centroids.append(np.where(total > 0, moment / total, otherwise))
    return centroids


def _catalog(objects, detected, labels, arrays, meta):
    """Make the table of the detections: ``detected`` are segments as found, ``labels`` as they are returned."""
    n = len(objects)
    index = np.arange(1, n + 1)
    flux = arrays.flux
    # light of the segments as returned, positions of those that were detected
    total, noise = _segment_sums(labels, flux, arrays, n)
    scale = pixel_scale(arrays.wcs)
    x, y = bright_centroids(flux, detected, (objects["x"], objects["y"]))
    sky = arrays.wcs.pixel_to_world(x, y) if n else SkyCoord([], [], unit="deg")
    with quiet_division():
        snr = total / noise
    flags = objects["flag"].astype(int) & sum(int(flag) for flag in DetectionFlags)
    columns = {
        "id": index,
        "label": index,
        "sky": sky.icrs,
        "x_centroid": x,
        "y_centroid": y,
        "flux": total * FNU,
        "flux_err": noise * FNU,
        "semimajor_axis": objects["a"] * scale * ANGLE,
        "semiminor_axis": objects["b"] * scale * ANGLE,
        "orientation": np.degrees(objects["theta"]) * u.deg,
        "n_pixels": np.bincount(labels.ravel(), minlength=n + 1)[1:],
        "n_detected": np.bincount(detected.ravel(), minlength=n + 1)[1:],
        "snr": snr,
        "flags": flags,
    }
    texts = column_texts("miricigale.photometry", "detections")
    return described_columns(columns, texts | {"flags": DetectionFlags.describe()}, meta)
