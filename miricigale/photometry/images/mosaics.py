"""Images that observers bring, in any unit and with any map of the noise, as images in MJy/sr."""

import dataclasses
import functools
import logging

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.nddata import CCDData, Cutout2D, NDData, StdDevUncertainty

from miricigale.filters.band_names import find_filter
from miricigale.instrument.data_models import is_data_model, read_data_model
from miricigale.instrument.header_wcs import check_kind_of_exposure, image_wcs, is_exposure
from miricigale.instrument.image import Image
from miricigale.instrument.image_planes import (
    NOISE_MAPS,
    PLANES,
    VARIANCE_PARTS,
    check_plane,
    companion,
    noise_kind,
    noise_planes,
    plane_data,
    plane_shape,
)
from miricigale.photometry.images.calibration import calibration, parsed_unit
from miricigale.photometry.images.fits_images import (
    Opened,
    cut_wcs,
    filter_name,
    find_image,
    open_image,
    open_map,
)
from miricigale.photometry.images.mosaic_headers import (
    SAME_ANGLE,
    MosaicHeader,
    angles_of_exposures,
    own_facts,
    unit_of,
)
from miricigale.photometry.images.pixel_marks import marked_good
from miricigale.photometry.images.sky_noise import mask_filled, sky_noise
from miricigale.utils.arrays import box_shape, quiet_division
from miricigale.utils.exceptions import PhotometryWarning, argument_error, data_error, warn
from miricigale.utils.files import is_path
from miricigale.utils.options import check_data, check_that
from miricigale.utils.other_keywords import takes_other_keywords
from miricigale.utils.units import SURFACE_BRIGHTNESS, scalar

_log = logging.getLogger(__name__)

#: Keywords of electrons for each count.
_GAINS = ("GAIN", "EGAIN", "CCDGAIN")
#: A scale of the noise further from 1 than this factor is warned of.
_ODD_SCALE = 10.0


@takes_other_keywords
def as_mosaic(image, argument="image"):
    """
    Make an image of whatever holds one.

    Parameters
    ----------
    image : `~astropy.nddata.NDData`, `~astropy.nddata.Cutout2D`, path-like, HDU, HDUs or data model of ``jwst``
        Files, HDUs and data models are read as by `read_mosaic`. A cutout has the unit of its data.
    argument : str, optional
        The argument's name for messages.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        Itself, if it is one.

    Raises
    ------
    ValueError
        If it is nothing of these, or has no unit.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropy.nddata import NDData
    >>> from miricigale.photometry import as_mosaic
    >>> image = as_mosaic(NDData(np.zeros((4, 4)), unit=u.MJy / u.sr))
    >>> type(image).__name__, image.unit
    ('CCDData', Unit("MJy / sr"))
    """
    if isinstance(image, CCDData):
        return image
    if is_path(image):
        return read_mosaic(image)
    if is_data_model(image):
        return read_data_model(image, read_mosaic)
    if isinstance(image, (fits.PrimaryHDU, fits.ImageHDU, fits.CompImageHDU)):
        image = fits.HDUList([image])
    if isinstance(image, fits.HDUList):
        return read_mosaic(Opened(image))
    if isinstance(image, Cutout2D):
        wanted = "a Cutout2D of a Quantity, or CCDData(cutout.data, unit=..., wcs=cutout.wcs)"
        is_quantity = isinstance(image.data, u.Quantity)
        check_that(is_quantity, argument, wanted, "a Cutout2D without unit")
        return CCDData(image.data.value, unit=image.data.unit, wcs=image.wcs)
    wanted = "a CCDData, an NDData with unit and WCS, HDUs or the path of a FITS file"
    if not isinstance(image, NDData) or image.unit is None:
        raise argument_error(argument, wanted, type(image).__name__)
    return CCDData(image)


@dataclasses.dataclass(frozen=True)
class MosaicFile:
    """
    A file with an image, and what is known of it beyond its header.

    Parameters
    ----------
    path : path-like
        FITS, packed or not; ``file.fits[EXTENSION]`` names an extension. By default the
        image is in SCI, or in the first extension with one.
    filter : str, optional
        Name of the filter; that of the header must be the same, if it has one.
    unit : unit-like, optional
        Unit of the pixels instead of the header's ``BUNIT``: a surface brightness, a flux in
        each pixel (``"10 nJy"``), or a rate of counts.
    zero_point : float or `~astropy.units.Quantity`, optional
        AB magnitude of one count (or one count a second, if those are the pixels' values).
        Without it rates of counts are calibrated by the header's PHOTMJSR or by PHOTFLAM and PHOTPLAM,
        and counts likewise after division by EXPTIME.
    error, variance, inverse_variance, weight : path-like, optional
        File with a map of the noise, on the pixels of the image; at most one. Errors and variances
        are in the unit of the image and its square, or in that of their own ``BUNIT``, and are taken
        as they are, as inverse variances are. The scale of weights is measured on the sky. By default the first
        extension of the image's own file among ERR, ERROR, RMS, UNCERT, SIGMA, STDDEV, UNC, NOISE and STD
        (errors), VAR, VARIANCE and STAT, IVAR and INVVAR, WHT and WEIGHT, of the image's EXTVER, that is not all 0
        or NaN; then the sum of JWST's VAR_POISSON, VAR_RNOISE and VAR_FLAT. UTYPE says of what kind those of
        astropy are.
    background_box : int, optional
        If given, a background is measured in boxes of so many pixels and subtracted.
    psf : path-like, optional
        PSF of the image with the pixel and the drizzling in it: ``file.fits``, ``file.fits[EXTENSION]``, or of
        a cube ``file.fits[EXTENSION,PLANE]`` (``mean`` for the mean of all planes). Its center is found.
        That of MIRI, NIRCam's wide filters and WFC3/IR is compared with the model
        (`~miricigale.psf.checked_psf`), which is taken where none is given (`~miricigale.psf.filter_psf`).
    psf_scale, psf_angle : `~astropy.units.Quantity`, optional
        Pixel of the PSF and position angle of its +y; by default those of its header. Else the angle is that of
        the image, and so is the pixel where the filter has a model PSF that tests it; else it must be given.
    pa_aper : `~astropy.units.Quantity`, optional
        Position angle of the detector's +y axis, if the header does not state it.
    section : tuple of slice, optional
        Rows and columns (with start and stop) that are read, of the maps of the noise too, as if the
        file had no others.

    Examples
    --------
    >>> from miricigale.photometry import MosaicFile, measure_files
    >>> image = MosaicFile("f770w_sci.fits", weight="f770w_wht.fits", filter="F770W")
    >>> prior = MosaicFile("f444w_sci.fits", weight="f444w_wht.fits", filter="F444W")
    >>> table = measure_files(image, prior)  # doctest: +SKIP
    """

    path: object
    _: dataclasses.KW_ONLY
    filter: str | None = None
    unit: object = None
    zero_point: object = None
    error: object = None
    variance: object = None
    inverse_variance: object = None
    weight: object = None
    background_box: int | None = None
    psf: object = None
    psf_scale: u.Quantity | None = None
    psf_angle: u.Quantity | None = None
    pa_aper: u.Quantity | None = None
    section: tuple | None = None

    replace = dataclasses.replace

    def __post_init__(self):
        if self.filter is not None:
            object.__setattr__(self, "filter", find_filter(str(self.filter)) or str(self.filter))
        maps = [name for name in NOISE_MAPS if getattr(self, name) is not None]
        check_that(len(maps) <= 1, ", ".join(NOISE_MAPS), "at most one of them", " and ".join(maps))
        if self.background_box is not None and not self.background_box >= 1:
            raise argument_error("background_box", "at least 1 pixel", self.background_box)

    @functools.cached_property
    def header(self):
        """
        The contents of the header, a `MosaicHeader`, without reading the image.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If the file is missing or damaged, or has no image with celestial coordinates.
        ValueError
            If the header states another filter or angle than ``filter`` and ``pa_aper``.
        """
        with open_image(self.path, "an image") as (hdus, extension):
            index = find_image(hdus, extension, self.path, ("SCI",), no_images=PLANES)
            header = hdus[index].header
            first = hdus[0].header
            wcs = image_wcs(header, hdus)
            shape = plane_shape(hdus[index])
            angles = angles_of_exposures(hdus)
        check_data(wcs is not None, self.path, "has no celestial coordinates (WCS) in its header")
        if self.section is not None:
            wcs = cut_wcs(wcs, self.section, self.path)
            shape = box_shape(self.section)

        def get(key):
            return header.get(key, first.get(key))

        # facts that the package's own files carry, then those of the header
        check_kind_of_exposure(get, self.path)
        meta = own_facts(header)
        name = filter_name(get) or meta.get("filter")
        good = self.filter is None or name in (None, self.filter)
        check_that(good, "filter", f"{name!r}, the filter in {self.path}", repr(self.filter))
        # a mosaic of our own has a list of angles; in the header of jwst's stands that of the first exposure
        if angles is None:
            angles = get("PA_APER")
        values = {
            "filter": self.filter or name,
            "pa_aper": angles,
            "subarray": get("SUBARRAY"),
        }
        for key, value in values.items():
            if value is None:
                values[key] = meta.get(key)
            if values[key] is not None:
                meta[key] = values[key]
        unit = unit_of(header)
        if self.unit is not None:
            unit = str(self.unit)
        return MosaicHeader(
            index=index,
            shape=shape,
            wcs=wcs,
            filter=values["filter"],
            pa_aper=self._checked_angle(values["pa_aper"]),
            unit=unit,
            exposure=is_exposure(get),
            keywords={key: get(key) for key in ("PHOTMJSR", "PHOTFLAM", "PHOTPLAM", "EXPTIME")},
            meta=meta,
        )

    def _checked_angle(self, header_angle):
        """Return the position angle (deg) that was given or that the header states, which must agree; or None."""
        if header_angle is not None:
            header_angle = np.asarray(header_angle, float) * u.deg
        if self.pa_aper is None:
            return header_angle
        angle = scalar(self.pa_aper, u.deg, "pa_aper") * u.deg
        if header_angle is None:
            return angle
        difference = (angle - header_angle).to_value(u.deg)
        if np.max(np.abs((difference + 180) % 360 - 180)) > SAME_ANGLE:
            wanted = f"PA_APER of {self.path}, {np.round(header_angle.value, 2)} deg"
            raise argument_error("pa_aper", wanted, angle)
        return angle

    def read_photon_facts(self):
        """
        Read what the file states of photon noise.

        Returns
        -------
        facts : dict
            ``variance``, that of the extension VAR_POISSON in (MJy/sr)^2, or None; ``factor``, MJy/sr of the
            pixels' unit; this ``unit``, or None; ``keywords``: EXPTIME, and GAIN by any of its usual names;
            ``own_errors``, whether errors are those of the file itself, not weights nor another map.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            As `read` does.
        """
        header = self.header
        with open_image(self.path, "an image") as (hdus, _):
            factor = self._factor()[0]
            variance = None
            hdu = companion(hdus, header.index, "VAR_POISSON")
            if hdu is not None and plane_shape(hdu) == plane_shape(hdus[header.index]):
                values = self._in_unit(hdu, "variance", self.path)
                variance = values * np.square(factor)
            own_errors = False
            if all(getattr(self, kind) is None for kind in NOISE_MAPS):
                usable = np.isfinite(plane_data(hdus[header.index], self.section))
                own_kind = self._own_noise_map(hdus, header, usable)[0]
                own_errors = own_kind in ("error", "variance")
            own = hdus[header.index].header
            keywords = {"EXPTIME": header.keywords["EXPTIME"], "GAIN": None}
            for name in _GAINS:
                if keywords["GAIN"] is None:
                    keywords["GAIN"] = own.get(name, hdus[0].header.get(name))
        unit = parsed_unit(header.unit)
        facts = {"variance": variance, "factor": factor, "unit": unit, "keywords": keywords}
        return facts | {"own_errors": own_errors}

    def _factor(self):
        """Factor from the pixels' unit to MJy/sr, of each pixel where fluxes are in pixels; and what states it."""
        from miricigale.instrument import pixel_area_map

        header = self.header
        factor, how = calibration(self.path, header.unit, self.zero_point, header.keywords)
        if factor.unit.is_equivalent(u.MJy):
            area = pixel_area_map(header.wcs, header.shape)
            return factor.to_value(u.MJy) / area, how
        return factor.to_value(SURFACE_BRIGHTNESS), how

    def read(self, added=None, added_variance=None):
        """
        Read the image.

        Parameters
        ----------
        added : `~numpy.ndarray`, shape (ny, nx), optional
            Surface brightness in MJy/sr that is added to the pixels before anything is measured on them.
        added_variance : `~numpy.ndarray`, shape (ny, nx), optional
            Variance in (MJy/sr)^2 by which the errors of the pixels grow, if there are any.

        Returns
        -------
        image : `~astropy.nddata.CCDData`
            In MJy/sr, with WCS and mask (True where a pixel is not finite, has no weight or no
            error, is one of an area of one number (0, or -99 and the like), or is marked in an extension
            MASK, BPM or BADPIX or, as not to be used, in DQ or FLAGS), and with a
            `~astropy.nddata.StdDevUncertainty` unless there is no map of the noise. Fluxes in
            pixels are divided by the solid angle of each pixel. ``meta`` has ``filter``, ``pa_aper``
            (deg), ``source`` (the file), ``source_unit``, ``calibration``, ``noise``, ``noise_scale``
            (rms of the source-free pixels in units of the map's errors), ``weight_scale``
            (by which errors of a weight map were multiplied), ``sky_over_noise`` (median over rms
            of those pixels), ``n_filled`` (pixels in areas of one number) and ``n_masked``, as
            far as they are known. None of a section without a usable pixel.

        Raises
        ------
        `~miricigale.utils.exceptions.DataError`
            If a file is missing or damaged, has no unit or coordinates, or a map is not on the
            pixels of the image.
        ValueError
            If the header names another filter, a count rate cannot be calibrated, or an error or (inverse)
            variance is below 0 where the image has data.

        Warns
        -----
        `~miricigale.utils.exceptions.PhotometryWarning`
            If there is no map of the noise, its scale departs from 1 by more than 10 times, or areas
            of one number are masked, or a mask excludes most pixels with data.
        """
        # pixels as they are, and the factor to MJy/sr
        header = self.header
        meta = {**header.meta, "source": str(self.path)}
        with open_image(self.path, "an image") as (hdus, _):
            data = _native(plane_data(hdus[header.index], self.section))
            factor, how = self._factor()
            factor = np.asarray(factor, data.dtype)
            usable = np.isfinite(data)
            good, scheme = marked_good(hdus, header.index, self, usable & (data != 0))
            usable &= good
            if scheme is not None:
                meta["dq_scheme"] = scheme
            kind, values, source = self._noise_map(hdus, header, usable)
        meta.update(source_unit=header.unit, calibration=how)
        sigma = None
        if kind is None:
            self._warn_of_no_noise(data[usable])
            meta["noise"] = "none"
        else:
            negative = np.count_nonzero(values[usable] < 0)
            wanted = "a map of 0 (no data) or more"
            got = f"{negative} pixels below 0 in {source}, for {self.path}"
            check_that(kind == "weight" or not negative, kind, wanted, got)
            sigma = _sigma(kind, values)
            usable &= np.isfinite(sigma) & (sigma > 0)
            meta["noise"] = f"{kind} ({source})"
        # areas without data that nothing marks
        filled = mask_filled(data, usable, self.path)
        if filled:
            meta["n_filled"] = filled
        if self.section is not None and not usable.any():
            return None
        problem = "has no usable pixel: all are masked, not finite or without weight"
        check_data(usable.any(), self.path, problem)
        # to MJy/sr, then what is measured on the image
        data *= factor
        if added is not None:
            data += added
        if self.background_box is not None:
            from miricigale.utils.sep_tools import background

            data -= background(data, ~usable, self.background_box)[0]
            meta["background_box"] = int(self.background_box)
        # noise of the sky in units of the errors
        relative = np.where(usable, data, 0)
        if sigma is not None:
            sigma *= factor
            relative = relative / np.where(usable, sigma, 1)
        level, scale, _ = sky_noise(relative, usable)
        if sigma is not None:
            self._tell_scale(kind, scale)
            meta["noise_scale"] = float(f"{scale:.6g}")
        if kind == "weight":
            problem = "has weights of unknown scale, for its sky is constant"
            check_data(scale > 0, self.path, problem)
            meta["weight_scale"] = meta["noise_scale"]
            sigma *= sigma.dtype.type(scale)
        # facts of the image
        meta["sky_over_noise"] = float(f"{level / (scale or 1):.4g}")
        meta["n_masked"] = int(np.count_nonzero(~usable))
        uncertainty = None
        if sigma is not None:
            if added_variance is not None:
                sigma = np.sqrt(np.square(sigma) + added_variance).astype(data.dtype)
            uncertainty = StdDevUncertainty(sigma)
        return Image(
            data,
            unit=SURFACE_BRIGHTNESS,
            wcs=header.wcs,
            mask=~usable,
            uncertainty=uncertainty,
            meta=meta,
        )

    def _warn_of_no_noise(self, values):
        """Warn that there is no map of the noise, and of how many of the usable pixels are exactly 0."""
        msg = f"{self.path} has no map of the noise, which will be measured on the image"
        n_zero = np.count_nonzero(values == 0)
        if n_zero > 1e-3 * values.size:
            msg += f", and {n_zero / values.size:.0%} of its pixels are exactly 0"
        warn(msg, PhotometryWarning)

    def _tell_scale(self, kind, scale):
        """Log the noise of the sky in units of the map's errors; warn if it is far from 1."""
        done = "errors are kept"
        if kind == "weight":
            done = "errors are multiplied by it"
        text = "%s: noise is %.4g times the errors of the %s map; %s"
        _log.info(text, self.path, scale, kind, done)
        if not 1 / _ODD_SCALE < scale < _ODD_SCALE:
            msg = (
                f"{self.path}: noise on the sky is {scale:.4g} times what the {kind} map says ({done}); "
                "is it the map of this image, in its unit?"
            )
            warn(msg, PhotometryWarning)

    def _noise_map(self, hdus, header, usable):
        """Read the map of the noise: its kind, values and place; the kind is None if there is none."""
        for kind, names in NOISE_MAPS.items():
            path = getattr(self, kind)
            if path is None:
                continue
            whole_header = header
            if self.section is not None:
                whole_header = self.replace(section=None).header
            image = whole_header.shape, whole_header.wcs, self.path
            wanted = f"a map of the {kind.replace('_', ' ')}"
            with open_map(path, wanted, f"the {kind} of {self.path}", names, image) as hdu:
                own_kind = noise_kind(hdu)
                # inverse variances are weights too
                is_other = own_kind not in (None, kind) and {own_kind, kind} != {
                    "inverse_variance",
                    "weight",
                }
                if is_other:
                    said = hdu.header.get("UTYPE", hdu.name)
                    got = f"{path}, whose extension is {said}: give it as '{own_kind}'"
                    raise argument_error(kind, wanted, got)
                return kind, self._in_unit(hdu, kind, path), str(path)
        return self._own_noise_map(hdus, header, usable)

    def _own_noise_map(self, hdus, header, usable):
        """Read the map of the noise as `_noise_map`, of the image's own file."""
        shape = plane_shape(hdus[header.index])
        # maps of the file, the first that holds noise
        empty = []
        for kind, hdu in noise_planes(hdus, header.index):
            if plane_shape(hdu) is None and not hdu.shape:
                empty.append(f"{hdu.name} (no data)")
                continue
            check_plane(hdu, shape, self.path, f"a map of the {kind.replace('_', ' ')}")
            values = self._in_unit(hdu, kind, f"{self.path}[{hdu.name}]")
            if not self._has_noise(values, usable, hdu):
                empty.append(f"{hdu.name} (nowhere finite and above 0)")
                continue
            if empty:
                msg = f"{self.path}: {', '.join(empty)} holds no noise; {hdu.name} ({kind}) is used"
                warn(msg, PhotometryWarning)
            return kind, values, f"extension {hdu.name}"
        # the variance of JWST is the sum of its parts
        names = []
        planes = []
        for name in VARIANCE_PARTS:
            hdu = companion(hdus, header.index, name)
            if hdu is not None and plane_shape(hdu) == shape:
                plane = self._in_unit(hdu, "variance", self.path)
                names.append(hdu.name)
                planes.append(np.where(np.isfinite(plane), plane, 0))
        if planes:
            total = np.sum(planes, axis=0)
            if self._has_noise(total, usable, None):
                return "variance", total, f"extensions {' + '.join(names)}"
        if any("nowhere" in text for text in empty):
            problem = f"holds no noise in {', '.join(empty)}, and no other map of it"
            raise data_error(
                self.path, f"{problem}: give 'error', 'variance' or 'weight', or remove it"
            )
        return None, None, None

    def _has_noise(self, values, usable, hdu):
        """Return whether a map of the noise has a value above 0 (or one below, which is refused later)."""
        has_value = np.isfinite(values) & (values != 0)
        if np.any(has_value):
            return True
        if self.section is None or hdu is None or not np.any(usable):
            # a part without data says nothing of the map
            return self.section is not None
        plane = plane_data(hdu)
        return bool(np.any(np.isfinite(plane) & (plane != 0)))

    def _in_unit(self, hdu, kind, path):
        """Read a map of the noise in the unit that the image states, as far as both do."""
        values = _native(plane_data(hdu, self.section))
        # a unit given by the caller holds for the map too
        unit = "" if self.unit is not None else self.header.unit
        text = unit_of(hdu.header)
        power = _POWERS.get(kind)
        have = parsed_unit(text)
        wanted = parsed_unit(unit)
        # headers of many variance maps state the unit of the image itself
        if None in (power, have, wanted) or have in (wanted, wanted**power):
            return values
        try:
            factor = have.to(wanted**power)
        except u.UnitConversionError:
            role = kind.replace("_", " ")
            problem = f"(the {role}) is in {text!r}, the image in {unit!r}: give 'unit' if a header is wrong"
            raise data_error(path, problem) from None
        _log.info("%s: from %s to %s", path, have, wanted**power)
        return values * values.dtype.type(factor)


@takes_other_keywords(options_of=(MosaicFile,))
def read_mosaic(path, **options):
    """
    Read an image of any origin.

    Parameters
    ----------
    path : path-like
        FITS, packed or not; ``file.fits[EXTENSION]`` names an extension.
    **options
        Fields of `MosaicFile`: ``filter``, ``unit``, ``zero_point``, ``error``, ``variance``,
        ``inverse_variance``, ``weight`` and ``background_box``.

    Returns
    -------
    image : `~astropy.nddata.CCDData`
        See `MosaicFile.read`.

    Examples
    --------
    >>> from miricigale.photometry import read_mosaic
    >>> image = read_mosaic("f444w_sci.fits.gz", weight="f444w_wht.fits.gz")  # doctest: +SKIP
    """
    wanted = "the path of a file; miricigale.photometry.chi_image joins several images"
    is_file = is_path(path) or isinstance(path, fits.HDUList)
    check_that(is_file, "path", wanted, type(path).__name__)
    return MosaicFile(path, **options).read()


def _native(data):
    """Copy data in native byte order; single precision stays single."""
    data = np.asarray(data)
    if data.dtype.kind == "f" and data.dtype.itemsize <= 4:
        return np.array(data, dtype=np.float32)
    return np.array(data, dtype=np.float64)


#: Power of the image's unit that a map of the noise has; the scale of weights is measured.
_POWERS = {"error": 1, "variance": 2, "inverse_variance": -2}


def _sigma(kind, values):
    """Return 1-sigma errors in the unit of the image, infinite where there are none."""
    with quiet_division():
        if kind == "error":
            return values
        if kind == "variance":
            return np.sqrt(np.where(values > 0, values, np.inf))
        return 1 / np.sqrt(np.where(values > 0, values, 0))
