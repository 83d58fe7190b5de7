"""Images in FITS files of any origin: which extension, which filter, which pixels on the sky."""

import contextlib
import json
import re

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from miricigale.filters.band_names import find_filter
from miricigale.instrument import imager_filters
from miricigale.instrument.header_wcs import compared_pixels, image_wcs
from miricigale.instrument.image_planes import plane_shape
from miricigale.instrument.sky_axes import grid_angle as grid_angle
from miricigale.utils.exceptions import PhotometryWarning, argument_error, data_error, warn
from miricigale.utils.files import open_fits, split_extension
from miricigale.utils.options import check_data


def _exact(has_cd):
    """Return the names of the numbers of a WCS that a header rounds."""
    if has_cd:
        return "crpix", "crval", "cd"
    return "crpix", "crval", "cdelt", "pc"


def grid_text(wcs):
    """
    Write a WCS as text.

    Parameters
    ----------
    wcs : `~astropy.wcs.WCS`
        Celestial, of two axes.

    Returns
    -------
    text : str
        JSON: its header, and all digits of what a header rounds.

    Raises
    ------
    ValueError
        If a header cannot hold it, such as one with lookup tables.
    """
    exact = {name: getattr(wcs.wcs, name).tolist() for name in _exact(wcs.wcs.has_cd())}
    cards = wcs.to_header(relax=True).cards
    header = {c.keyword: c.value for c in cards if c.keyword not in ("COMMENT", "HISTORY", "")}
    text = json.dumps({"header": header, **exact})
    x = y = np.array([0.0, 1000.0])
    restored = text_grid(text).pixel_to_world_values(x, y)
    if not np.allclose(restored, wcs.pixel_to_world_values(x, y), rtol=0, atol=1e-9):
        raise argument_error("wcs", "one that a FITS header can hold", f"{wcs!r}")
    return text


def text_grid(text):
    """
    Read the WCS that `grid_text` wrote.

    Parameters
    ----------
    text : str
        The text.

    Returns
    -------
    wcs : `~astropy.wcs.WCS`
    """
    state = json.loads(text)
    wcs = WCS(fits.Header(state["header"]))
    has_cd = "cd" in state
    if has_cd:
        # the header has PC and CDELT instead
        del wcs.wcs.pc
    for name in _exact(has_cd):
        setattr(wcs.wcs, name, state[name])
    wcs.wcs.set()
    return wcs


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


def extension_index(hdus, extension, path):
    """
    Find the index of an extension by its number, its name, or name and EXTVER (``"SCI,2"``).

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is none.
    """
    wanted = extension
    if isinstance(extension, str):
        name, _, version = extension.rpartition(",")
        if name and version.strip().isdigit():
            wanted = name.strip(), int(version)
    try:
        return hdus.index_of(wanted)
    except (KeyError, IndexError):
        names = [hdu.name if hdu.ver == 1 else f"{hdu.name},{hdu.ver}" for hdu in hdus]
        raise data_error(path, f"has no such extension, only {names}") from None


def find_image(hdus, extension, path, names, *, no_images=()):
    """
    Find the index of the extension with the image.

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
    no_images : iterable of str, optional
        Names of extensions that are never taken for the first image.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If there is no image, more than one of these names, or one that is a cube.

    Warns
    -----
    `~miricigale.utils.exceptions.PhotometryWarning`
        If the first of several images is taken, by none of these names.
    """
    images = [k for k, hdu in enumerate(hdus) if plane_shape(hdu) is not None]
    if extension is not None:
        index = extension_index(hdus, extension, path)
        got = getattr(hdus[index], "shape", None)
        check_data(index in images, path, f"is no two-dimensional image: {got or 'without data'}")
        return index
    for hdu in hdus:
        # a table or a cube beside it is not what was meant
        if hdu.name in names and hdu.is_image and not hdu.shape and plane_shape(hdu) is None:
            raise data_error(path, f"has no data in its extension {hdu.name} (NAXIS = 0)")
    named = [k for k in images if hdus[k].name in names]
    if not named:
        _check_no_cube(hdus, path, names)
        images = [k for k in images if hdus[k].name not in no_images]
        if len(images) > 1:
            labels = [hdus[k].name or str(k) for k in images]
            text = f"{path} has {len(images)} images ({', '.join(labels)}): the first is used"
            warn(f"{text}; {path}[{labels[1]}] is another", PhotometryWarning)
    candidates = named or images[:1]
    shapes = [getattr(hdu, "shape", ()) for hdu in hdus]
    check_data(candidates, path, f"has no two-dimensional image, only {shapes}")
    name = hdus[candidates[0]].name
    count = len(candidates)
    problem = f"has {count} extensions {name}; say which as {path}[{name},2] or {path}[NUMBER]"
    check_data(count <= 1, path, problem)
    return candidates[0]


def _check_no_cube(hdus, path, names):
    """Refuse a file whose image has more than two axes, before a map beside it is taken for the image."""
    for hdu in hdus:
        if hdu.name in names and hdu.is_image and len(hdu.shape) > 2:
            problem = f"has the shape {hdu.shape} in its extension {hdu.name}, wanted is an image: cut a plane"
            raise data_error(path, problem)


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
        own_shape = plane_shape(hdu)
        problem = (
            f"({role}) has the shape {own_shape}, {image_path} {shape}: not on the same pixels"
        )
        check_data(own_shape == shape, path, problem)
        map_wcs = image_wcs(hdu.header, hdus)
        if map_wcs is not None:
            check_same_grid(map_wcs, wcs, shape, path, image_path)
        yield hdu


def filter_name(get):
    """Return the filter that a header (``get(keyword)``) names, ``instrument.filter``; None if it names none."""
    instrument = str(get("INSTRUME") or "").strip().lower()
    names = []
    for key in ("FILTER", "FILTER1", "FILTER2"):
        name = str(get(key) or "").strip().lower()
        if name and not name.startswith("clear"):
            names.append(name)
    pupil = str(get("PUPIL") or "").strip().lower()
    # NIRCam's narrow filters are in the pupil wheel, in front of a wide one
    if instrument == "nircam" and re.fullmatch(r"f\d{3}[a-z]\d?", pupil):
        names = [pupil]
    if len(names) != 1:
        return None
    if not instrument:
        # bands of MIRI have names of their own; F200W may be of NIRCam or NIRISS, F814W of ACS or WFC3
        name = find_filter(names[0])
        if name in imager_filters():
            return name
        return None
    return f"{instrument}.{names[0]}"


def cut_wcs(wcs, section, path):
    """
    Cut the coordinates of an image to a part of it (slices of rows and columns), exactly.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If they have distortions by tables, which cannot be cut.
    """
    cut = wcs.slice(section)
    rows, columns = section
    y = np.array([0.0, rows.stop - rows.start - 1.0])
    x = np.array([0.0, columns.stop - columns.start - 1.0])
    corners = wcs.pixel_to_world(x + columns.start, y + rows.start)
    problem = "has coordinates with tables of distortion, and cannot be read in parts"
    check_data(
        np.all(cut.pixel_to_world(x, y).separation(corners) < 1e-4 * u.arcsec), path, problem
    )
    return cut


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

    x, y = compared_pixels(shape)
    place = pixel_to_pixel(reference, wcs, x, y)
    distance = np.hypot(place[0] - x, place[1] - y)
    if not np.all(distance <= 0.1):
        far = np.inf
        if np.isfinite(distance).any():
            far = np.nanmax(distance)
        problem = f"is not on the pixels of {reference_path}: by their coordinates up to {far:.4g} pixels apart"
        raise data_error(path, problem)
