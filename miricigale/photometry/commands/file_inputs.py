"""What is measured: images, a prior and what belongs to them; checked and read, whole or in part."""

import collections
import dataclasses
import functools
import os

import astropy.units as u
import numpy as np
from astropy.nddata import StdDevUncertainty

from miricigale.filters import Filter
from miricigale.instrument import epoch_of, north_up_wcs
from miricigale.instrument.image import Image
from miricigale.instrument.image_planes import plane_data
from miricigale.instrument.sky_axes import grid_angle
from miricigale.photometry.commands.kernel_files import can_be_modeled, matching_kernel
from miricigale.photometry.images.fits_images import open_map
from miricigale.photometry.images.mosaic_headers import stated_filter
from miricigale.photometry.images.mosaics import MosaicFile
from miricigale.utils.exceptions import DataError, argument_error
from miricigale.utils.files import file_place
from miricigale.utils.named_values import field_names
from miricigale.utils.options import check_that
from miricigale.utils.positions import middle_pixel
from miricigale.utils.units import SURFACE_BRIGHTNESS
from miricigale.utils.values import value_class

#: Bytes of a process without images, for each pixel of the prior (or of an image of the detection) and of an
#: image that is measured, and of some thousand sources where they are dense: largest memory, as it was measured.
_BYTES = {"process": 450_000_000, "prior": 90, "image": 60, "sources": 750_000_000}

#: Images of a measurement: the prior, others of the detection, and those that are measured by name of the filter.
Pixels = collections.namedtuple("Pixels", "prior detection images")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inputs:
    """Files and options of a measurement; each attribute as for `~miricigale.photometry.measure_files`."""

    images: tuple
    highres: MosaicFile
    detection: tuple = ()
    segmentation: object = None
    catalog: object = None
    kernels: tuple = (None,)
    confidence: float = 0.95
    psf_stars: bool | None = False
    seed: int = 1
    options: dict = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, image, highres, *, detection=(), kernel=None, **settings):
        """Make inputs of the arguments of `~miricigale.photometry.measure_files`."""
        images = _as_list(image)
        kernels = _as_list(kernel)
        if kernel is None:
            kernels = [None] * len(images)
        if len(kernels) != len(images):
            raise argument_error("kernel", f"one for each of {len(images)} images", len(kernels))
        # settings that are none of these are options of the photometer
        names = settings.keys() - field_names(cls)
        options = {name: settings.pop(name) for name in sorted(names)}
        return cls(
            highres=_as_file(highres),
            images=tuple(map(_as_file, images)),
            detection=tuple(map(_as_file, detection)),
            kernels=tuple(kernels),
            options=options,
            **settings,
        )

    @property
    def prior_meta(self):
        """What the table says of the prior: dict."""
        return {"highres": str(self.highres.path)}

    @property
    def bands(self):
        """Names of the filters."""
        return [file.header.filter for file in self.images]

    @property
    def _named(self):
        named = [("segmentation", self.segmentation), ("catalog", self.catalog)]
        named.append(("highres_psf", self.highres.psf))
        for file in self.images:
            named.append(("psf", file.psf))
        for path in self.kernels:
            named.append(("kernel", path))
        return [(argument, path) for argument, path in named if path is not None]

    @property
    def paths(self):
        """Files that are read, maps of the noise left out."""
        files = [*self.images, self.highres, *self.detection]
        return [file.path for file in files] + [path for _, path in self._named]

    def check(self):
        """Refuse, before any image is read, what is missing, or not what it should be."""
        for image in self.images:
            _check_order(image, self.highres)
        _check_headers(self.images, self.highres, self.kernels)
        for image in self.images:
            _check_images(image, self.highres)
        for argument, path in self._named:
            if not os.path.isfile(file_place(path)[0]):
                msg = f"no file {path} ('{argument}')"
                raise DataError(msg)
        for image, kernel in zip(self.images, self.kernels, strict=True):
            if self.catalog is not None:
                _check_catalog(self.catalog, image, self.highres)
            _check_psfs(image, self.highres, kernel)
        self._check_bands()

    def _check_bands(self):
        """Refuse several images of one filter."""
        if len(set(self.bands)) < len(self.bands):
            wanted = "of different filters (or exposures, _cal, of one, measured whole)"
            raise argument_error("image", wanted, self.bands)

    @property
    def labels(self):
        """What the images of models and residuals are called, one for each image; empty for a single one."""
        if len(self.images) == 1:
            return [""]
        return list(map(short_band, self.bands))

    def n_bytes(self, prior=None, images=None):
        """Estimate the memory (bytes) of parts of these shapes with sources, or of the whole images without."""
        n_bytes = _BYTES["process"]
        if prior is None:
            prior = self.highres.header.shape
        else:
            n_bytes += _BYTES["sources"]
        if images is None:
            images = [image.header.shape for image in self.images]
        n_bytes += _BYTES["prior"] * np.prod(prior, dtype=float) * (1 + len(self.detection))
        for shape in images:
            n_bytes += _BYTES["image"] * np.prod(shape, dtype=float)
        return int(n_bytes)

    def read(self, prior=None, images=None):
        """
        Read the images, or a part of them.

        Parameters
        ----------
        prior : tuple of slice, optional
            The part of the prior; None with ``images`` where it has none.
        images : list of (tuple of slice or None), optional
            The same of each image.

        Returns
        -------
        pixels : `Pixels`
            Of the parts without data there are images that hold no source.
        """
        if images is None:
            images_of_bands = {}
            for band, file in zip(self.bands, self.images, strict=True):
                images_of_bands[band] = file.read()
            detection = [file.read() for file in self.detection]
            return Pixels(self.highres.read(), detection, images_of_bands)
        # a place far from everything, for images of which the part has nothing
        away = self.highres.header.wcs.pixel_to_world(0, 0).icrs
        away = away.directional_offset_by(0 * u.deg, 90 * u.deg)
        images_of_bands = {}
        for band, file, part in zip(self.bands, self.images, images, strict=True):
            image = part and file.replace(section=part).read()
            images_of_bands[band] = image or _blank(
                (3, 3), north_up_wcs(away, 1 * u.arcsec, (3, 3))
            )
        whole_header = self.highres.header
        if prior is None:
            return Pixels(_blank((3, 3), whole_header.wcs), [], images_of_bands)
        highres = self.highres.replace(section=prior)
        sharp = highres.read()
        if sharp is None:
            # its pixels are those of the segments
            sharp = _blank(highres.header.shape, highres.header.wcs)
        detection = []
        for file in self.detection:
            image = file.replace(section=prior).read()
            if image is not None:
                detection.append(image)
        return Pixels(sharp, detection, images_of_bands)

    def fit_options(self, n_threads=None):
        """Return options of a `~miricigale.photometry.ForcedPhotometer`, with the defaults of files."""
        defaults = {"background_order": 0, "second_pass": None, "n_threads": n_threads}
        return defaults | self.options

    def photometers(self, n_threads=None):
        """Make the `~miricigale.photometry.ForcedPhotometer` of each band: dict by name of the filter."""
        from miricigale.photometry import ForcedPhotometer

        options = self.fit_options(n_threads)
        photometers = {}
        for band, file, path in zip(self.bands, self.images, self.kernels, strict=True):
            kernel = matching_kernel(file, self.highres, path)
            stars = self.psf_stars if path is None else False
            photometers[band] = ForcedPhotometer(kernel, psf_stars=stars, **options)
        return photometers

    def find_sources(self, pixels, catalog, part=None):
        """Find segments and sources (as `~miricigale.photometry.read_prior`); ``part`` is () without a prior."""
        from miricigale.photometry import chi_image, read_prior
        from miricigale.photometry.detection.prior_catalog import (
            SEGMENTS,
            detected_prior,
            sources_of,
        )

        prior = pixels.prior
        detection = pixels.detection
        if self.segmentation is None or part == ():
            if detection:
                prior = chi_image([prior] + list(detection))
            return detected_prior(prior, catalog)
        if part is None:
            return read_prior(prior, segmentation=self.segmentation, catalog=catalog)
        header = self.highres.header
        wanted = "a segmentation map"
        grid = header.shape, header.wcs, self.highres.path
        with open_map(self.segmentation, wanted, "the segmentation", SEGMENTS, grid) as hdu:
            return sources_of(prior, np.array(plane_data(hdu, part)), catalog)

    def measure(self, pixels, photometers, segments, sources):
        """Measure the sources: a `Measurement`."""
        results = self._results(pixels, photometers, segments, sources)
        return Measurement(self, pixels, photometers, segments, results)

    def _results(self, pixels, photometers, segments, sources):
        """Return the `~miricigale.photometry.ForcedPhotometryResult` of each band: dict by name of the filter."""
        from miricigale.photometry.fit.bands import measure_prior

        return measure_prior(pixels.images, photometers, pixels.prior, segments, sources)


def short_band(band):
    """Name of a filter without its instrument."""
    return str(band).rpartition(".")[2]


@value_class
class Measurement:
    """What was measured, and of what."""

    inputs: Inputs
    pixels: Pixels
    photometers: dict  # By name of the filter, as the results.
    segments: np.ndarray  # Of the prior.
    results: dict  # `~miricigale.photometry.ForcedPhotometryResult`.

    @functools.cached_property
    def table(self):
        """The table of all bands."""
        from miricigale.photometry.fit.bands import join_bands

        inputs = self.inputs
        results = self.results
        if len(results) == 1:
            ((band, result),) = results.items()
            table = result.to_table(band, confidence=inputs.confidence)
        else:
            tables = {}
            for band, result in results.items():
                tables[band] = result.to_table(confidence=inputs.confidence)
            table = join_bands(tables)
        paths = [str(file.path) for file in inputs.images]
        table.meta["image"] = paths
        if len(paths) == 1:
            table.meta["image"] = paths[0]
        table.meta |= inputs.prior_meta
        return table

    def products(self, name):
        """Return models (``"model"``) or residuals (``"residual"``), one for each image that was read."""
        return [getattr(result, f"{name}_image") for result in self.results.values()]

    def write_page(self, path):
        """Write the page, of those bands that have data."""
        from miricigale.photometry.commands.page import Measured, write_page
        from miricigale.psf import KernelField

        measured = []
        for name, result in self.results.items():
            image, pulls = self._shown(name)
            if "source" not in image.meta:
                continue
            kernel = self.photometers[name].kernel
            if result.psf_stars is not None:
                kernel = result.psf_stars.kernel
            if result.exposures is not None or isinstance(kernel, KernelField):
                kernel = kernel.mean
            measured.append(Measured(name, result, image, kernel, pulls))
        confidence = self.inputs.confidence
        seed = self.inputs.seed
        write_page(path, measured, self.pixels.prior, self.segments, confidence, seed)

    def _shown(self, band):
        """Return the image of a band for the page, and pulls at empty positions (None: the page makes them)."""
        return self.pixels.images[band], None


def _as_list(value):
    """Return a list or tuple as it is, anything else as a list of one."""
    if isinstance(value, (list, tuple)):
        return value
    return [value]


def _as_file(image):
    """Return a `MosaicFile`, or make one of a path."""
    if isinstance(image, MosaicFile):
        return image
    return MosaicFile(image)


def _blank(shape, wcs):
    """Make an image without a source, of which a row alone has data."""
    mask = np.arange(shape[0])[:, None] + np.zeros(shape) > 0
    noise = StdDevUncertainty(np.ones(shape, np.float32))
    data = np.zeros(shape, np.float32)
    return Image(data, unit=SURFACE_BRIGHTNESS, wcs=wcs, mask=mask, uncertainty=noise)


def _check_headers(images, highres, kernels):
    """Refuse, in one message, all headers that lack a filter or an orientation that is needed."""
    from miricigale.psf import MODEL_FILTERS

    files = [(image, "", kernel) for image, kernel in zip(images, kernels, strict=True)]
    files.append((highres, "highres_", None if None in kernels else kernels[0]))
    lacking = []
    for file, prefix, kernel in files:
        name = file.header.filter
        is_modeled = file.psf is None and kernel is None
        if name is None and (file is not highres or is_modeled):
            lacking.append(
                f"'{prefix}filter' must be given, for the header of {file.path} does not name it,"
                " or not its instrument"
            )
        # the models of WFC3/IR have no orientation
        is_turned = name is None or (name in MODEL_FILTERS and not name.startswith("wfc3."))
        if is_modeled and is_turned and file.header.pa_aper is None:
            lacking.append(
                f"'{prefix}pa_aper' must be given (or '{prefix}psf'), for the header of {file.path} has"
                " no PA_APER"
            )
    # a single one has a message of its own
    if len(lacking) > 1:
        raise ValueError("; ".join(lacking))


def _check_order(image, highres):
    """Refuse an image and a prior that stand in each other's place."""
    wanted = image.filter
    image_filter = None
    if wanted is not None:
        image_filter = stated_filter(image.path)
    # a swap shows in the filters that the headers state
    if image_filter not in (None, wanted) and stated_filter(highres.path) == wanted:
        msg = (
            f"'image' and 'highres' seem to be swapped: {highres.path} is the image in {wanted}, "
            f"{image.path} is in {image_filter}"
        )
        raise ValueError(msg)


def _check_images(image, highres):
    """Refuse images that are not what they should be, or do not overlap."""
    # headers refuse what contradicts them
    headers = [(image.path, image.header), (highres.path, highres.header)]
    check_filter(image)
    for path, header in headers:
        try:
            grid_angle(header.wcs, header.shape)
        except ValueError as err:
            msg = f"{path}: {err}"
            raise ValueError(msg) from err
    if not (_overlap(image.header, highres.header) or _overlap(highres.header, image.header)):
        middle = _middle(image.header).to_string("decimal", precision=4)
        highres_middle = _middle(highres.header).to_string("decimal", precision=4)
        msg = (
            f"'image' and 'highres' show different fields: the middle of {image.path} is at "
            f"{middle}, that of {highres.path} at {highres_middle} deg"
        )
        raise ValueError(msg)


def check_filter(image):
    """Refuse an image, a `MosaicFile`, whose filter is not known, or not one of the library."""
    name = image.header.filter
    if name is None:
        wanted = f"given, for the header of {image.path} does not name it"
        raise argument_error("filter", wanted, None)
    if name not in Filter.names() and not name.startswith("sedpy."):
        wanted = f"a filter that 'miricigale filters' lists, for {image.path}"
        raise argument_error("filter", wanted, repr(name))


def _middle(header):
    return header.wcs.pixel_to_world(*middle_pixel(header.shape)).icrs


def _inside(sky, header):
    """Return whether some positions are on an image."""
    from miricigale.photometry.images.arrays import sky_pixels

    return np.isfinite(sky_pixels(sky, header.wcs, header.shape, 0.0)).any()


def _overlap(first, second):
    """Return whether some of a coarse grid of pixels of one image are on the other."""
    ny, nx = first.shape
    y, x = np.meshgrid(np.linspace(0, ny - 1, 15), np.linspace(0, nx - 1, 15), indexing="ij")
    return _inside(first.wcs.pixel_to_world(x.ravel(), y.ravel()), second)


def _check_psfs(image, highres, kernel):
    """Refuse images whose PSF is neither given nor known."""
    from miricigale.psf import MODEL_FILTERS

    if kernel is not None:
        check_that(image.psf is None, "psf", "left out where a kernel is given", image.psf)
        return
    for file, prefix in ((image, ""), (highres, "highres_")):
        name = file.header.filter
        if file.psf is not None or can_be_modeled(file.header):
            continue
        if name in MODEL_FILTERS:
            wanted = f"given (or '{prefix}psf'), for the header of {file.path} has no PA_APER"
            raise argument_error(prefix + "pa_aper", wanted, None)
        name = name or "an image whose filter is unknown ('highres_filter')"
        wanted = f"given (or 'kernel'), for there is no model PSF for {name}"
        raise argument_error(prefix + "psf", wanted, None)


def _check_catalog(path, image, highres):
    """Refuse a catalog of another field."""
    from miricigale.photometry.detection.prior_catalog import read_catalog

    sky = read_catalog(path, epoch=epoch_of(highres.header))["sky"]
    for argument, file in (("image", image), ("highres", highres)):
        check_on_image(sky, path, file, argument)


def check_on_image(sky, path, file, argument):
    """Refuse the positions of a catalog, of a path, of which none is on an image, a `MosaicFile`."""
    from astropy.coordinates import SkyCoord

    if _inside(sky, file.header):
        return
    msg = f"none of the {len(sky)} sources of {path} is on {file.path} ('{argument}')"
    is_known = np.isfinite(sky.ra.deg)
    hours = SkyCoord(15 * sky.ra[is_known], sky.dec[is_known])
    if _inside(hours, file.header):
        msg += ": is ra in hours? Wanted are degrees, or a column with a unit"
    elif is_known.any():
        first = sky[is_known][0].to_string("decimal", precision=4)
        middle = _middle(file.header).to_string("decimal", precision=4)
        msg += f": the first is at {first}, the middle of the image at {middle} deg"
    raise ValueError(msg)
