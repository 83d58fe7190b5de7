"""Detection of sources on the high-resolution image."""

import dataclasses

import astropy.units as u
import numpy as np
import scipy.ndimage
from astropy.coordinates import SkyCoord
from astropy.table import QTable
from photutils.segmentation import SegmentationImage, make_2dgaussian_kernel

from miricigale.photometry.arrays import image_arrays, pixel_scale
from miricigale.utils.exceptions import argument_error, unknown_name
from miricigale.utils.meta import provenance
from miricigale.utils.sep_tools import background as sep_background
from miricigale.utils.sep_tools import extract
from miricigale.utils.tables import Flags
from miricigale.utils.units import ANGLE, FNU

__all__ = [
    "DETECTION_PRESETS",
    "DetectionFlags",
    "DetectionPreset",
    "bright_centroids",
    "detect_sources",
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

    Returns
    -------
    segmentation : `~photutils.segmentation.SegmentationImage`
        Label 0 is the sky.
    catalog : `~astropy.table.QTable`
        A row for each label: ``id`` and ``label``, ``sky``, ``x``, ``y`` (0-based pixels), ``flux``
        and ``flux_err`` (uJy, the light in the segment), ``a``, ``b`` (arcsec, rms along
        the axes), ``theta`` (deg from +x to +y), ``n_pixels``, ``snr``, ``flags``.

    Raises
    ------
    ValueError
        If a setting is out of range.
    KeyError
        If there is no such preset.

    References
    ----------
    Bertin & Arnouts 1996, A&AS 117, 393; Barbary 2016, JOSS 1, 58.
    """
    if preset not in DETECTION_PRESETS:
        raise unknown_name("detection preset", preset, DETECTION_PRESETS)
    given = {
        "threshold": threshold,
        "min_area": min_area,
        "fwhm": fwhm,
        "n_levels": n_levels,
        "contrast": contrast,
    }
    settings = dataclasses.replace(
        DETECTION_PRESETS[preset], **{k: v for k, v in given.items() if v is not None}
    )
    if not settings.threshold > 0:
        raise argument_error("threshold", "positive", settings.threshold)
    arrays = image_arrays(image, "image")
    flux = arrays.flux
    if subtract_background:
        flux = flux - sep_background(flux, ~arrays.usable, box, filter_size)[0]
    kernel = None
    if settings.fwhm:
        size = 2 * int(np.ceil(0.9 * settings.fwhm)) - 1
        kernel = make_2dgaussian_kernel(settings.fwhm, max(size, 3)).array
    objects, labels = extract(
        flux,
        settings.threshold,
        err=arrays.sigma,
        mask=~arrays.usable,
        min_area=settings.min_area,
        filter_kernel=kernel,
        deblend_n_thresholds=settings.n_levels,
        deblend_contrast=settings.contrast,
    )
    catalog = _catalog(objects, labels, flux, arrays)
    catalog.meta.update(provenance(preset=preset, **dataclasses.asdict(settings)))
    return SegmentationImage(labels), catalog


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


def _catalog(objects, labels, flux, arrays):
    n = len(objects)
    index = np.arange(1, n + 1)
    variance = np.where(arrays.usable, arrays.sigma, 0.0) ** 2
    flat = labels.ravel()
    total = np.bincount(flat, flux.ravel(), n + 1)[1:]
    noise = np.sqrt(np.bincount(flat, variance.ravel(), n + 1)[1:])
    scale = pixel_scale(arrays.wcs)
    x, y = bright_centroids(flux, labels, (objects["x"], objects["y"]))
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
        "n_pixels": (np.bincount(flat, minlength=n + 1)[1:], "Pixels of the segment"),
        "snr": (snr, "flux over flux_err"),
        "flags": (objects["flag"].astype(int) & known, DetectionFlags.describe()),
    }
    table = QTable({name: values for name, (values, _) in columns.items()})
    for name, (_, description) in columns.items():
        table[name].info.description = description
    return table
