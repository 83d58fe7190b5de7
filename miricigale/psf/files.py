"""PSFs in FITS files: our own layout, and images that others made."""

import dataclasses
import os

import astropy.units as u
import numpy as np
from astropy.io import fits

from miricigale.instrument.header_wcs import header_wcs
from miricigale.instrument.sky_axes import grid_angle
from miricigale.psf import _core
from miricigale.psf.model import InstrumentPSF, make_psf
from miricigale.utils.arrays import peak_index
from miricigale.utils.exceptions import PSFWarning, argument_error, data_error, warn
from miricigale.utils.file_formats import register
from miricigale.utils.files import file_place, open_fits, split_extension
from miricigale.utils.options import check_data, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.store import open_parts, write_parts
from miricigale.utils.units import ANGLE, scalar

#: Units of an `InstrumentPSF`'s quantities in files.
_UNITS = {"pixel_scale": ANGLE, "angle": u.deg, "pa_aper": u.deg}
_LAYOUT = "psf-1"
#: Part by which two statements of one scale may differ.
_SAME_SCALE = 0.02
#: Pixels along a side of the smallest image of a PSF.
_LEAST_SIDE = 4
#: Extensions of STPSF's files, the best first: with the distortion and the detector's effects, finely sampled.
_STPSF_ORDER = ("OVERDIST", "DET_DIST", "OVERSAMP", "DET_SAMP")


@dataclasses.dataclass(frozen=True)
class PSFFile:
    """
    Images of a PSF or kernel in any FITS file, with the pixel and the angle that its header states.

    Parameters
    ----------
    path : str
        The file, for messages.
    planes : `~numpy.ndarray`, shape (n, ny, nx)
        One image, or those of a cube.
    header : `~astropy.io.fits.Header`
        That of the image; PA_APER, PIXELSCL and PIXSCALE may come from the primary header.
    cell : float or None
        Side of a cell in arcsec; None if it is not stated.
    turn : float or None
        Position angle of +y in degrees; None if it is not stated.
    """

    path: str
    planes: np.ndarray
    header: fits.Header
    cell: float | None
    turn: float | None

    @classmethod
    def open(cls, path, wanted="a PSF", *, ext=None, plane=None):
        """
        Read the image of a PSF or kernel, or several planes of a cube.

        Parameters
        ----------
        path : path-like
            The file, or ``file.fits[EXTENSION]`` or ``file.fits[EXTENSION,PLANE]``.
        wanted : str, optional
            What the file should be, for messages.
        ext : int or str, optional
            The extension, if the path names none. By default the first with an image; of STPSF's files that
            with distortion and the detector's effects.
        plane : int or "mean", optional
            Of a cube: one plane, or all.

        Returns
        -------
        psf_file : `PSFFile`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If there is no such extension, or it is no image (of a cube with ``plane``).
        ValueError
            If the image is mirrored.

        Warns
        -----
        `~miricigale.utils.exceptions.PSFWarning`
            If several extensions hold images and none was named: which is taken.
        """
        name, path_extension, path_plane = file_place(path)
        if path_extension is not None:
            ext = path_extension
        if path_plane is not None:
            plane = path_plane
        with open_fits(name, wanted=wanted, output_verify="silentfix") as hdus:
            if ext is None:
                ext = _best_extension(hdus, name)
            try:
                hdu = hdus[ext]
            except (KeyError, IndexError):
                names = [hdu.name for hdu in hdus]
                raise data_error(path, f"has no such extension, only {names}") from None
            planes = _planes(hdu, path, wanted, plane)
            header = hdu.header.copy()
            for key in ("PA_APER", "PIXELSCL", "PIXSCALE"):
                if key not in header and key in hdus[0].header:
                    header[key] = hdus[0].header[key]
        cell, turn = header_grid(header)
        return cls(os.fspath(path), planes, header, cell, turn)

    @property
    def on_detector(self):
        """Whether the axes are those of the detector, as in the files of STPSF and WebbPSF (bool)."""
        return {"OVERSAMP", "PIXELSCL"} <= set(self.header)

    def pixel_scale(self, user_scale, *, oversampling=1, argument="pixel_scale"):
        """
        Return the side of a pixel: that of the header, with which a stated one must agree.

        Parameters
        ----------
        user_scale : `~astropy.units.Quantity` or None
            What the user says.
        oversampling : int, optional
            Cells along a side of a pixel.
        argument : str, optional
            The name of ``user_scale``, for messages.

        Returns
        -------
        pixel_scale : `~astropy.units.Quantity` or None
            None if neither the user nor the header states it.

        Raises
        ------
        ValueError
            If the two differ by more than 2 %.
        """
        if self.cell is None:
            if user_scale is None:
                return None
            return scalar(user_scale, ANGLE, argument) * ANGLE
        in_header = self.cell * oversampling
        if user_scale is None:
            return in_header * ANGLE
        scale = scalar(user_scale, ANGLE, argument)
        if abs(scale / in_header - 1) > _SAME_SCALE:
            wanted = f"{in_header:.4g} arcsec, as the header of {self.path} says"
            if oversampling > 1:
                wanted += f" with {oversampling} cells along a pixel"
            raise argument_error(argument, wanted, user_scale)
        return scale * ANGLE

    def angle(self, user_angle, *, argument="angle"):
        """
        Return the position angle of +y: that of the header, with which a stated one must agree.

        Parameters
        ----------
        user_angle : `~astropy.units.Quantity` or None
            What the user says.
        argument : str, optional
            The name of ``user_angle``, for messages.

        Returns
        -------
        angle : `~astropy.units.Quantity` or None
            None if neither the user nor the header states it.

        Raises
        ------
        ValueError
            If the two differ by more than 0.5 degrees.
        """
        if user_angle is None:
            if self.turn is None:
                return None
            return self.turn * u.deg
        angle = scalar(user_angle, u.deg, argument)
        if self.turn is not None and abs((angle - self.turn + 180) % 360 - 180) > 0.5:
            raise argument_error(
                argument, f"{self.turn:.4g} deg, as the header of {self.path} says", user_angle
            )
        return angle * u.deg

    def make_psf(self, **options):
        """
        Make the PSF: the mean of the planes, each with its core in the same place.

        Parameters
        ----------
        **options
            Those of `~miricigale.psf.make_psf`. The center is found in the core unless ``origin`` says where it
            is.

        Returns
        -------
        psf : `InstrumentPSF`

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If a plane holds no light, or pixels that are not finite.
        """
        for data in self.planes:
            if not np.all(np.isfinite(data)) or not data.max() > 0 or not data.sum() > 0:
                raise data_error(
                    self.path, "is no PSF: it has no light, or pixels that are not finite"
                )
        shape = self.planes.shape[1:]
        problem = f"has {shape} pixels, a PSF needs {_LEAST_SIDE} along either side"
        check_data(min(shape) >= _LEAST_SIDE, self.path, problem)
        options["meta"] = {"file": self.path, **options.get("meta", {})}
        if len(self.planes) == 1:
            data = self.planes[0]
            options.setdefault("origin", core_position(data))
            return make_psf(data, **options)
        if "origin" in options:
            return make_psf(self.planes.mean(axis=0), **options)
        centers = np.array([core_position(data) for data in self.planes])
        middle = centers.mean(axis=0)
        centered = []
        for plane, center in zip(self.planes, centers, strict=True):
            centered.append(_shifted(plane, middle - center))
        return make_psf(np.mean(centered, axis=0), origin=tuple(middle), **options)


def _planes(hdu, path, wanted, plane):
    """Return the image of an extension, or the planes of its cube, shape (n, ny, nx)."""
    data = None
    if hdu.is_image:
        data = hdu.data
    shape = getattr(data, "shape", None)
    kind = "a cube"
    n_axes = 3
    if plane is None:
        kind = "an image"
        n_axes = 2
        if shape is not None and shape[:-2] == (1,):
            # a cube of one plane is an image
            shape = shape[1:]
    if shape is None or len(shape) != n_axes:
        hint = "; say FILE[EXTENSION,PLANE] or FILE[EXTENSION,mean] of a cube"
        raise data_error(path, f"must be {kind} with {wanted}, got the shape {shape}{hint}")
    if isinstance(plane, int) and not 0 <= plane < shape[0]:
        raise data_error(path, f"is a cube with the planes 0 to {shape[0] - 1}")
    if isinstance(plane, int):
        data = data[plane]
    return np.array(data, dtype=float).reshape(-1, *shape[-2:])


def _shifted(data, offset):
    """Return an image moved by x, y in cells; 0 comes in at its edges."""
    if np.hypot(offset[0], offset[1]) < 1e-6:
        return data
    y, x = np.indices(data.shape)
    return _core.interpolate(data, x - offset[0], y - offset[1])


def _best_extension(hdus, name):
    """Number of the extension with the PSF or kernel of a file, said if there are several."""
    images = [k for k, hdu in enumerate(hdus) if hdu.is_image and hdu.shape]
    if not images:
        return 0
    names = [str(hdus[k].name).upper() for k in images]
    for wanted in _STPSF_ORDER:
        if wanted in names:
            chosen = images[names.index(wanted)]
            why = " (the best of STPSF's: distortion and detector effects, finely sampled)"
            break
    else:
        chosen = images[0]
        why = " (the first)"
    if len(images) > 1:
        labels = {k: str(hdus[k].name or k) for k in images}
        label = labels.pop(chosen)
        warn(
            f"{name} has several images: extension {label} is taken{why}, not {', '.join(labels.values())}; "
            f"{name}[NUMBER] names one",
            PSFWarning,
        )
    return chosen


def core_position(data):
    """
    Find the bright core of a PSF.

    Parameters
    ----------
    data : `~numpy.ndarray`, shape (ny, nx)
        The PSF.

    Returns
    -------
    x, y : float
        Center under a round window as wide as the core, 0-based; where that does not settle, the centroid of
        the cells above 0.3 of the peak around it.
    """
    x, y, _ = _core.core_moments(data)
    ny, nx = data.shape
    if 0 <= x <= nx - 1 and 0 <= y <= ny - 1:
        return x, y
    y, x = np.indices(data.shape)
    core = np.where(data > 0.3 * data.max(), data, 0.0)
    # only the brightest peak
    peak = peak_index(data)
    core[np.hypot(y - peak[0], x - peak[1]) > 0.25 * min(data.shape)] = 0
    return float((core * x).sum() / core.sum()), float((core * y).sum() / core.sum())


def header_grid(header):
    """
    Return the side of a pixel (arcsec) and position angle of +y (deg) that the header of a PSF or kernel states.

    By world coordinates, or PIXELSCL or PIXSCALE (arcsec); None for what is not stated.

    Raises
    ------
    ValueError
        If the image is mirrored, or its pixels are not square.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        If two of these differ: which counts.
    """
    scales = {}
    for key in ("PIXELSCL", "PIXSCALE"):
        if isinstance(header.get(key), (int, float)) and header[key] > 0:
            scales[key] = float(header[key])
    wcs = None
    if "CTYPE1" in header:
        wcs = header_wcs(header, where="the PSF or kernel")
    if wcs is not None:
        wcs.wcs.set()
        matrix = wcs.pixel_scale_matrix
        # rows of longitude and latitude, either of which may be the first
        a, b = matrix[wcs.wcs.lng]
        c, d = matrix[wcs.wcs.lat]
        if a * d - b * c > 0:
            raise argument_error("path", "a file with east to the left where north is up", wcs)
        _check_square(matrix * 3600)
        angle = float(np.degrees(np.arctan2(b, d)))
        if not str(wcs.wcs.lngtyp).startswith("RA"):
            angle = float(grid_angle(wcs, (header["NAXIS2"], header["NAXIS1"])).value)
        cell = float(np.sqrt(b * c - a * d)) * 3600
        _warn_of_contradiction({"world coordinates": cell} | scales)
        return cell, angle
    _warn_of_contradiction(scales)
    return next(iter(scales.values()), None), None


def _check_square(matrix):
    """Refuse coordinates (arcsec) with pixels that are longer than wide."""
    width, height = np.hypot(matrix[0], matrix[1])
    if abs(width / height - 1) > _SAME_SCALE:
        raise argument_error(
            "path",
            "a file with square pixels, to which others are resampled",
            f"{width:.4g} by {height:.4g} arcsec",
        )


def _warn_of_contradiction(scales):
    """Warn if scales of pixels (arcsec), by what states them, differ."""
    if not scales:
        return
    first, *further_names = scales
    for name in further_names:
        if abs(scales[name] / scales[first] - 1) > _SAME_SCALE:
            warn(
                f"the header of the PSF or kernel states pixels of {scales[first]:.4g} arcsec ({first}) and of "
                f"{scales[name]:.4g} ({name}): the first are used",
                PSFWarning,
            )


def states_pixel(path):
    """Return whether a file of a PSF states the size of its pixels."""
    if split_extension(path)[1] is None and is_written(path):
        return True
    return PSFFile.open(path).cell is not None


@takes_other_keywords(options_of=(make_psf,))
def read_psf(
    path,
    *,
    frame=None,
    ext=None,
    plane=None,
    pixel_scale=None,
    oversampling=None,
    angle=None,
    **options,
):
    """
    Read a PSF from an image in any FITS file, or from one that `InstrumentPSF.write` made.

    Parameters
    ----------
    path : path-like, or tuple of it and `~astropy.units.Quantity`
        The file; ``file.fits[EXTENSION]`` and ``file.fits[EXTENSION,PLANE]`` name an extension and a plane. Or a
        pair of the file and its pixel, ``("file.fits", 0.11 * u.arcsec)``, as functions take it for a PSF.
    frame, oversampling : optional
        As for `make_psf`; by default those of STPSF's files (the detector's frame, OVERSAMP), else the sky and 1.
    ext : int or str, optional
        The extension. By default the first with an image, or of STPSF's files OVERDIST, DET_DIST, OVERSAMP or
        DET_SAMP, the first of these that is there.
    plane : int or "mean", optional
        Which plane of a cube, or the mean of all.
    pixel_scale, angle : `~astropy.units.Quantity`, optional
        As for `make_psf`. Where the header states them (world coordinates; PIXELSCL or
        PIXSCALE, arcsec per cell) they can be left out, and must agree with it if given.
    **options
        Further options of `make_psf`, such as ``includes`` and ``enclosed``. The center is found in the core
        unless ``origin`` says where it is.

    Returns
    -------
    psf : `InstrumentPSF`
        Its ``pa_aper`` is that of the header, for a PSF in the detector frame:
        `~miricigale.psf.MatchingKernel.from_psfs` turns by it if no angle is given.

    Raises
    ------
    `~miricigale.utils.exceptions.DataError`
        If the file is missing or no FITS, or there is no 2D image there.
    ValueError
        If scale or angle are unknown or not the header's, or something is stated of a file that
        `InstrumentPSF.write` made.

    Warns
    -----
    `~miricigale.utils.exceptions.PSFWarning`
        If several extensions hold images and none was named: which is taken.

    Examples
    --------
    >>> from miricigale.psf import read_psf
    >>> psf = read_psf("f770w_psf.fits", ext=1, enclosed=0.95)  # doctest: +SKIP
    """
    if isinstance(path, tuple) and len(path) == 2:
        path, stated_scale = path
        check_that(pixel_scale is None, "pixel_scale", "left out of a pair", pixel_scale)
        pixel_scale = stated_scale
    if split_extension(path)[1] is None and is_written(path):
        arguments = {"frame": frame, "ext": ext, "plane": plane, "pixel_scale": pixel_scale}
        arguments |= {"oversampling": oversampling, "angle": angle, **options}
        for name, value in arguments.items():
            wanted = f"left out: {path} is a file of InstrumentPSF.write, which has it"
            check_that(value is None, name, wanted, value)
        return _read_psf(path)
    psf_file = PSFFile.open(path, ext=ext, plane=plane)
    header = psf_file.header
    if oversampling is None:
        oversampling = _stated_oversampling(path, header)
    pixel_scale = psf_file.pixel_scale(pixel_scale, oversampling=oversampling)
    wanted = (
        f"given, for the header does not state it: read_psf({str(path)!r}, pixel_scale=0.11 * u.arcsec), or the "
        f"pair ({str(path)!r}, 0.11 * u.arcsec) in place of a PSF"
    )
    check_that(pixel_scale is not None, "pixel_scale", wanted, None)
    if frame is None:
        frame = "sky"
        if psf_file.on_detector:
            frame = "detector"
    if frame == "detector" and isinstance(header.get("PA_APER"), (int, float)):
        options.setdefault("pa_aper", float(header["PA_APER"]) * u.deg)
    if frame == "sky":
        angle = psf_file.angle(angle)
    if angle is None:
        angle = 0.0 * u.deg
    return psf_file.make_psf(
        pixel_scale=pixel_scale, frame=frame, oversampling=oversampling, angle=angle, **options
    )


def _stated_oversampling(path, header):
    """Read OVERSAMP of a header, 1 without it; a `DataError` unless it is a whole number."""
    value = header.get("OVERSAMP", 1)
    is_whole = isinstance(value, (int, float)) and value >= 1 and value == int(value)
    check_data(
        is_whole, path, f"has an OVERSAMP of {value!r}, which is no whole number of 1 or more"
    )
    return int(value)


def is_written(path):
    """Tell whether `InstrumentPSF.write` made a file."""
    with open_fits(path, wanted="a PSF") as hdus:
        return hdus[0].header.get("FORMAT") == _LAYOUT


def _write_psf(psf, path, *, overwrite=False):
    facts = psf.facts
    for name, unit in _UNITS.items():
        if facts[name] is not None:
            facts[name] = facts[name].to_value(unit)
    text = {"facts": facts, "meta": psf.meta}
    write_parts(path, _LAYOUT, text=text, arrays={"psf": psf.data}, overwrite=overwrite)


def _read_psf(path):
    with open_parts(path, (_LAYOUT,), wanted="PSFs") as parts:
        facts = parts.text["facts"]
        for name, unit in _UNITS.items():
            if facts[name] is not None:
                facts[name] = facts[name] * unit
        return InstrumentPSF(parts.array("psf"), **facts, meta=parts.text["meta"])


register(InstrumentPSF, read=_read_psf, write=_write_psf)
