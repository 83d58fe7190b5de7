"""Images in FITS files of any origin: which extension, which filter, which pixels on the sky."""

import contextlib
import re
import warnings

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.instrument.asdf_extension import asdf_wcs
from miricigale.utils.exceptions import PhotometryWarning, argument_error, data_error, warn
from miricigale.utils.files import open_fits, split_extension
from miricigale.utils.options import check_data


class Opened(fits.HDUList):
    """The HDUs of a user, in place of the path of their file."""

    def __str__(self):
        return self.filename() or "the list of HDUs"


@contextlib.contextmanager
def open_image(path, wanted):
    """
    Open ``file.fits[EXTENSION]``: yields its HDUs and the extension (str, int or None).

    ``wanted`` is what the file should be, for messages.
    """
    if isinstance(path, Opened):
        yield path, None
        return
    name, extension = split_extension(path)
    with open_fits(name, wanted=wanted) as hdus:
        yield hdus, extension


def find_image(hdus, extension, path, names):
    """
    Index of the extension with the image.

    Parameters
    ----------
    hdus : `~astropy.io.fits.HDUList`
        The file.
    extension : str, int or None
        What was asked for.
    path : path-like
        The file, for messages.
    names : iterable of str
        Names of extensions that are preferred to the first image.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no image, or more than one of these names.
    """
    images = [k for k, hdu in enumerate(hdus) if hdu.is_image and len(hdu.shape) == 2]
    if extension is not None:
        try:
            found = [hdus.index_of(extension)]
        except (KeyError, IndexError):
            known = [hdu.name for hdu in hdus]
            raise data_error(path, f"has no such extension, only {known}") from None
        check_data(found[0] in images, path, f"is no two-dimensional image: {hdus[found[0]].shape}")
        return found[0]
    named = [k for k in images if hdus[k].name in names]
    found = named or images[:1]
    shapes = [getattr(hdu, "shape", ()) for hdu in hdus]
    check_data(found, path, f"has no two-dimensional image, only {shapes}")
    what = f"has {len(found)} extensions {hdus[found[0]].name}"
    check_data(len(found) <= 1, path, f"{what}; say which as {path}[NUMBER]")
    return found[0]


@contextlib.contextmanager
def open_map(path, wanted, role, names, image):
    """
    Open a map on the pixels of an image; yields its HDU.

    ``wanted`` and ``names`` are as for `open_image` and `find_image`, ``role`` is what the map is to the
    image, ``image`` the shape, the WCS and the file of the image.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If it has another shape, or its coordinates are elsewhere.
    """
    shape, wcs, image_path = image
    with open_image(path, wanted) as (hdus, extension):
        hdu = hdus[find_image(hdus, extension, path, names)]
        what = f"({role}) has the shape {hdu.shape}, {image_path} {shape}: not on the same pixels"
        check_data(hdu.shape == shape, path, what)
        own = read_wcs(hdu.header, hdus)
        if own is not None:
            check_same_grid(own, wcs, shape, path, image_path)
        yield hdu


def read_wcs(header, hdus):
    """
    The celestial coordinates of an image, None without any.

    Those of its header; those of the extension ASDF of JWST's pipeline (a gwcs), as polynomials good to 0.01
    pixels, if the header has none, or those of a single exposure without its distortion.

    Raises
    ------
    ImportError
        If the coordinates are in the ASDF extension alone and gwcs is not installed.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If distortion is in the ASDF extension alone and gwcs is not installed.
    """
    from astropy.wcs import WCS, FITSFixedWarning

    with warnings.catch_warnings():
        # dates and the like that are written in another way
        warnings.simplefilter("ignore", FITSFixedWarning)
        wcs = WCS(header, hdus)
    if "ASDF" not in hdus:
        return wcs if wcs.has_celestial else None
    if not wcs.has_celestial:
        return asdf_wcs(header, hdus)
    if is_exposure(lambda key: header.get(key, hdus[0].header.get(key))) and wcs.sip is None:
        try:
            return asdf_wcs(header, hdus)
        except ImportError as err:
            msg = (
                f"{hdus.filename()}: the coordinates in the header lack the distortion, which is in "
                f"the extension ASDF: positions are pixels off. {err}"
            )
            warn(msg, PhotometryWarning)
    return wcs


def is_exposure(get):
    """Whether a header (``get(keyword)``) is that of a single exposure of JWST, not resampled."""
    return get("S_WCS") == "COMPLETE" and get("S_RESAMP") != "COMPLETE"


def filter_name(get):
    """The filter that a header (``get(keyword)``) names, ``instrument.filter``; None if it names none."""
    instrument = str(get("INSTRUME") or "").strip().lower()
    names = [str(get(key) or "").strip().lower() for key in ("FILTER", "FILTER1", "FILTER2")]
    names = [name for name in names if name and not name.startswith("clear")]
    pupil = str(get("PUPIL") or "").strip().lower()
    # NIRCam's narrow filters are in the pupil wheel, in front of a wide one
    if instrument == "nircam" and re.fullmatch(r"f\d{3}[a-z]\d?", pupil):
        names = [pupil]
    return f"{instrument}.{names[0]}" if instrument and len(names) == 1 else None


def cut_wcs(wcs, section, path):
    """
    The coordinates of a part (slices of rows and columns) of an image, exact.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If they have distortions by tables, which cannot be cut.
    """
    cut = wcs.slice(section)
    y, x = (np.array([0.0, one.stop - one.start - 1.0]) for one in section)
    there = wcs.pixel_to_world(x + section[1].start, y + section[0].start)
    what = "has coordinates with tables of distortion, and cannot be read in parts"
    check_data(np.all(cut.pixel_to_world(x, y).separation(there) < 1e-4 * u.arcsec), path, what)
    return cut


def part_of(hdu, section):
    """The data of an image extension, or a part of them, without reading the rest."""
    return hdu.data if section is None else hdu.section[section]


def grid_angle(wcs, shape):
    """
    Position angle (a quantity in deg, east of north) of an image's +y axis at its middle.

    Raises
    ------
    ValueError
        If the image is mirrored (east to the right where north is up).
    """
    x, y = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    middle = wcs.pixel_to_world(x, y)
    up, right = wcs.pixel_to_world(x, y + 1), wcs.pixel_to_world(x + 1, y)
    angle = middle.position_angle(up).to(u.deg)
    turn = (angle - middle.position_angle(right)).to_value(u.deg) % 360
    if turn > 180:
        raise argument_error("wcs", "of an image of the sky (east left of north)", "a mirrored one")
    return angle


def check_same_grid(wcs, reference, shape, path, reference_path):
    """
    Refuse a map whose pixels are elsewhere on the sky than those of its image.

    They may be 0.1 pixels apart, in the corners and the middle; the paths are for the message.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If they differ.
    """
    from astropy.wcs.utils import pixel_to_pixel

    ny, nx = shape
    x = np.array([0, nx - 1, 0, nx - 1, (nx - 1) / 2])
    y = np.array([0, 0, ny - 1, ny - 1, (ny - 1) / 2])
    there = pixel_to_pixel(reference, wcs, x, y)
    distance = np.hypot(there[0] - x, there[1] - y)
    if not np.all(distance <= 0.1):
        far = np.nanmax(distance) if np.isfinite(distance).any() else np.inf
        what = f"is not on the pixels of {reference_path}: by their coordinates up to {far:.4g} pixels apart"
        raise data_error(path, what)
